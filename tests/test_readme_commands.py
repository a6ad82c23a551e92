"""The commands of the READMEs that users begin with run one after another, in reduced sizes."""

import shutil

import pytest
import tiny_city
from commands import MAINS, call, good
from documents import ROOT, read

STEPS = ["--steps", 2]
REDUCED = {  # what is added; of an option that is there already the last counts. The city is tiny_city
    "nmfd benchmark": ["--seeds", 1], "nmfd train": ["--steps", 1, "--no-compile", "--anyway"], "nmfd show": [],
    "nmfd new-controller": [], "nmfd export": [],
    "cosim run": STEPS, "cosim compare": [], "cosim report": [], "cosim evaluate": [*STEPS, "--seeds", 1],
    "cosim sweep": ["--steps", 1, "--seeds", 1, "--compliance", 100],
    "cosim import": ["--regions", 3, "--no-run", "--method", "geometric"],
    "cosim identify": ["--levels", 6, "--seeds", 1, "--own", "--iterations", 10], "cosim list": [], "nmfd list": []}
NOT_RUN = {  # what takes long or needs more, and where it is tested
    "cosim watch": "test_watch.py", "cosim video": "test_video.py", "cosim tune": "test_tuning.py",
    "cosim frontier": "test_tuning.py", "nmfd bound": "test_bound.py", "nmfd robustness": "test_robustness.py",
    "nmfd scaling": "test_scaling.py", "nmfd ablation": "test_ablation.py", "nmfd adaptation": "test_adaptation.py",
    "cosim get": "test_get.py", "cosim demo": "test_demo.py", "nmfd identify": "test_measured.py"}
LONG = ("scenarios/grid7_peak", "networks/grid7")  # whose loading runs and training take minutes: of mycity they do not


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "nmfd/README.md", "cosim/README.md"])
def test_the_commands_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("networks", "scenarios"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns(
            "reference", "tutorials", "build", "bologna", "luxembourg", "*.md", "ppo.*"))
    tiny_city.city(tmp_path)  # city.sumocfg
    done, ran = set(), 0
    for program, command, *words in (words for words in read(ROOT / name).commands if words[0] in MAINS):
        if (kind := f"{program} {command}") in NOT_RUN:
            continue
        assert kind in REDUCED, f"{kind}: say in REDUCED or NOT_RUN whether it is run here"
        shape = (kind, *sorted(word for word in words if word.startswith("--")), words[0])
        if shape in done or (command in ("identify", "train") and words[0] in LONG):
            continue
        if command == "export":
            pytest.importorskip("onnxscript", reason="no extra onnx")
        good(call(program, command, *words, *REDUCED[kind]))
        done.add(shape)
        ran += 1
    assert ran >= 5


def test_what_is_not_run_here_is_tested_elsewhere():
    there = [kind.split() for kind in NOT_RUN if kind.split()[1] in MAINS[kind.split()[0]].commands]
    assert there and all((ROOT / "tests" / NOT_RUN[" ".join(kind)]).is_file() for kind in there)
    assert not set(NOT_RUN) & set(REDUCED)
