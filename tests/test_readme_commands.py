"""The commands of all READMEs run one after another, in reduced sizes; those of the notebooks in
test_tutorials.py."""

import shutil
from pathlib import Path

import pytest
import tiny_city
from commands import MAINS, call, good
from documents import FILES, NOTEBOOKS, ROOT, read

STEPS = ["--steps", 2]
# What is added; of an option that is there already the last counts. The city is tiny_city.
REDUCED = {
    "nmfd benchmark": ["--seeds", 1],
    "nmfd train": ["--steps", 1],
    "nmfd new-controller": [],
    "cosim run": STEPS,
    "cosim compare": [],
    "cosim report": [],
    "cosim evaluate": [*STEPS, "--seeds", 1, "--demand", 1],
    "cosim import": ["--regions", 3],
    "cosim identify": ["--levels", 6, "--seeds", 1, "--with", "own"],
}
NOT_RUN = {  # what takes long or needs more, and where it is tested
    "cosim watch": "test_view.py",
    "cosim study": "test_study.py",
    "cosim tune": "test_tuning.py",
    "nmfd bound": "test_bound.py",
    "nmfd robustness": "test_robustness.py",
    "cosim get": "test_get.py",
    "cosim mfd": "test_edge_mfds.py",
    "cosim demo": "test_demo.py",
    "nmfd identify": "test_measured.py",
}
LONG = (
    "scenarios/grid7_peak",
    "networks/grid7",
    "scenarios/demo",
)  # whose loading runs and training take minutes
FIRST = ["README.md", "nmfd/README.md", "cosim/README.md"]  # with every controller that they name
HERE = [
    str(file.relative_to(ROOT).as_posix())
    for file in FILES
    if file not in NOTEBOOKS
    and any(
        words[0] in MAINS and "..." not in words and " ".join(words[:2]) not in NOT_RUN
        for words in read(file).commands
    )
]


def reduced(name: str, kind: str, words: list[str]) -> list[str]:
    """Of lists of controllers the first two, and what REDUCED has."""
    if "--controllers" in words and name not in FIRST:
        at = words.index("--controllers") + 1
        words = [*words[:at], ",".join(words[at].split(",")[:2]), *words[at + 1 :]]
    return [*words, *map(str, REDUCED[kind])]


def instead(words: list[str]) -> list[str]:
    """The tiny city stands for one that the project does not have, its own demand for one that is
    made, which takes minutes (test_import.py makes one); what was made of an earlier one goes."""
    city, out = Path(words[0]), Path(words[words.index("--out") + 1])
    for folder in (out, Path("scenarios", out.name), Path("runs")):
        shutil.rmtree(folder, ignore_errors=True)
    if "--demand" in words:
        return ["city.sumocfg", "--mesoscopic", "--out", str(out)]
    if not city.exists():
        city.parent.mkdir(parents=True, exist_ok=True)
        tiny_city.city(city.parent).rename(city)
    return words


@pytest.mark.slow
@pytest.mark.parametrize("name", HERE)
def test_the_commands_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("networks", "scenarios"):
        shutil.copytree(
            ROOT / folder,
            tmp_path / folder,
            ignore=shutil.ignore_patterns("reference", "tutorials", "*.md", "ppo.*"),
        )
    tiny_city.city(tmp_path)  # city.sumocfg
    done, ran = set(), 0
    for program, command, *words in (
        words for words in read(ROOT / name).commands if words[0] in MAINS
    ):
        if (kind := f"{program} {command}") in NOT_RUN or "..." in words:
            continue
        assert kind in REDUCED, f"{kind}: say in REDUCED or NOT_RUN whether it is run here"
        shape = (kind, *sorted(word for word in words if word.startswith("--")), words[0])
        if (shape in done and command != "import") or (
            command in ("identify", "train") and words[0] in LONG
        ):
            continue
        if command == "import":
            words = instead(words)
        good(call(program, command, *reduced(name, kind, words)))
        done.add(shape)
        ran += 1
    assert ran >= (5 if name in FIRST else 1)


def test_what_is_not_run_here_is_tested_elsewhere():
    there = [kind.split() for kind in NOT_RUN if kind.split()[1] in MAINS[kind.split()[0]].commands]
    assert there
    assert all((ROOT / "tests" / NOT_RUN[" ".join(kind)]).is_file() for kind in there)
    assert not set(NOT_RUN) & set(REDUCED)
