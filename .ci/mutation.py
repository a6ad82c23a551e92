"""The mutation score of the modules that [tool.mutmut] in pyproject.toml names, from a seeded
sample of their mutants.

    python .ci/mutation.py [--sample 20] [--seed 0] [--least 0.8] [MODULE ...]

A mutant counts as noticed if a test fails or runs into the time limit. `mutmut show NAME` shows one
that was not. `mutmut run` runs all of them, for hours.
"""

import argparse
import json
import random
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.utils.format_utils import get_mutant_name

SURVIVED, NO_TESTS = 0, (5, 33)  # exit codes in mutmut's own files


def mutants(module: Path) -> list[str]:
    """The names of all mutants of a module."""
    mutated = mutate_file_contents(str(module), module.read_text(encoding="utf-8"))
    return [get_mutant_name(module, name) for name in mutated.mutant_names]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "modules", nargs="*", metavar="MODULE", help="such as guidance; by default all"
    )
    parser.add_argument("--sample", type=int, default=20, help="mutants of each module")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--least", type=float, default=0.8, help="the score that each module must have"
    )
    order = parser.parse_args()
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
    every = [Path(file) for file in project["tool"]["mutmut"]["only_mutate"]]
    modules = [module for module in every if not order.modules or module.stem in order.modules]
    drawn = {}
    for module in modules:
        names = mutants(module)
        drawn[module] = random.Random(f"{order.seed} {module}").sample(
            names, min(order.sample, len(names))
        )
    shutil.rmtree("mutants", ignore_errors=True)
    command = [
        "mutmut",
        "run",
        "--max-children",
        "2",
        *(name for names in drawn.values() for name in names),
    ]
    with open("mutation.log", "wb") as log:  # its progress would fill the screen
        if subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode:
            sys.exit(f"mutmut failed: see {log.name}")
    weak = []
    for module, names in drawn.items():
        codes = json.loads(Path(f"mutants/{module}.meta").read_text(encoding="utf-8"))[
            "exit_code_by_key"
        ]
        missed = [name for name in names if codes[name] == SURVIVED or codes[name] in NO_TESTS]
        score = 1.0 - len(missed) / len(names)
        print(
            f"{score:4.0%} of {len(names)} mutants noticed: {module}", *sorted(missed), sep="\n    "
        )
        weak += [module.stem] * (score < order.least)
    if weak:
        sys.exit(f"fewer than {order.least:.0%} of the mutants were noticed in {', '.join(weak)}")


if __name__ == "__main__":
    main()
