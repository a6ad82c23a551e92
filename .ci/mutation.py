"""Mutation score of the modules in [tool.mutmut] of pyproject.toml.

    python .ci/mutation.py [--sample 20] [--seed 0] [--least 0.8] [MODULE ...]

The score is that of a seeded sample of the mutants of each module. A mutant counts as noticed if a
test fails or runs into the time limit. `mutmut show NAME` shows one that was not. `mutmut run` runs
all of them, for hours.
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

SURVIVED = 0  # exit codes in mutmut's own files
NO_TESTS = (5, 33)


def main() -> None:
    order = arguments()
    drawn = {}
    for module in chosen_modules(order.modules):
        names = mutants(module)
        generator = random.Random(f"{order.seed} {module}")
        drawn[module] = generator.sample(names, min(order.sample, len(names)))
    run([name for names in drawn.values() for name in names])
    weak = []
    for module, names in drawn.items():
        missed = unnoticed(module, names)
        score = 1.0 - len(missed) / len(names)
        print(f"{score:4.0%} of {len(names)} mutants noticed: {module}")
        for name in missed:
            print(f"    {name}")
        if score < order.least:
            weak.append(module.stem)
    if weak:
        sys.exit(f"fewer than {order.least:.0%} of the mutants were noticed in {', '.join(weak)}")


def arguments() -> argparse.Namespace:
    """Return the options of the command line."""
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
    return parser.parse_args()


def chosen_modules(stems: list[str]) -> list[Path]:
    """Return the modules with these stems, all if there are none."""
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
    modules = [Path(file) for file in project["tool"]["mutmut"]["only_mutate"]]
    if not stems:
        return modules
    return [module for module in modules if module.stem in stems]


def mutants(module: Path) -> list[str]:
    """Return the names of all mutants of a module."""
    mutated = mutate_file_contents(str(module), module.read_text(encoding="utf-8"))
    return [get_mutant_name(module, name) for name in mutated.mutant_names]


def run(names: list[str]) -> None:
    """Run the tests on these mutants."""
    shutil.rmtree("mutants", ignore_errors=True)
    command = ["mutmut", "run", "--max-children", "2", *names]
    with open("mutation.log", "wb") as log:  # its progress would fill the screen
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT)
    if done.returncode:
        sys.exit(f"mutmut failed: see {log.name}")


def unnoticed(module: Path, names: list[str]) -> list[str]:
    """Return the mutants of a module that no test noticed, by name."""
    report = json.loads(Path(f"mutants/{module}.meta").read_text(encoding="utf-8"))
    missed = []
    for name in sorted(names):
        code = report["exit_code_by_key"][name]
        if code == SURVIVED or code in NO_TESTS:
            missed.append(name)
    return missed


if __name__ == "__main__":
    main()
