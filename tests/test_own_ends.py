"""Controllers of one's own that end, hang, or change what is not theirs: one line that names them, and nobody else's
run is lost."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from commands import error_line, nmfd
from tasks import acted

from nmfd.api import load_scenario
from nmfd.controllers import custom
from nmfd.errors import InputError
from nmfd.runs import run_folder
from nmfd.runs.workers import Failure, outcomes

SOURCE = """
import ctypes, itertools, os, signal, sys, threading, time
import numpy as np
from nmfd import Controls
TOP

class Mine:
    def __init__(self, planning):
        self.shape = planning.network.adjacency.shape
        INIT

    def reset(self, seed=0):
        RESET

    def act(self, observation):
        perimeter, splits, note = np.full(self.shape, 0.5), None, ""
        if observation.step >= 2:
            ACT
        return Controls(perimeter=perimeter, splits=splits, note=note)
"""
PLACES = ("TOP", "INIT", "RESET", "ACT")
LIMIT = 0.3  # s


def written(path: Path, place: str, code: str) -> str:
    """The controller in a file at `path` that does `code` there; its name."""
    text = SOURCE
    for other in PLACES:
        indent = next(line for line in SOURCE.splitlines() if line.strip() == other).partition(other)[0]
        lines = code.replace("\n", f"\n{indent}") if other == place else "pass"
        text = text.replace(f"{indent}{other}\n", f"{indent}{lines}\n")
    path.write_text(text, encoding="utf-8")
    return f"{path}:Mine"


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return replace(load_scenario(tiny.write(tmp_path_factory.mktemp("city"))), own_time_limit=LIMIT)


def said(name: str, scenario) -> str:
    """The one line that the controller ends in, in this process; "" if it does not."""
    try:
        acted((name, scenario))
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 900
        return str(error)
    return ""


ODD = """
class Odd(BaseException):
    def __str__(self):
        raise ValueError
class Word(str):
    def __format__(self, spec):
        raise ValueError
"""


@pytest.mark.parametrize(
    "place, code, expected",
    [
        *((place, "raise BaseException('one\\ntwo')", "BaseException: one two") for place in PLACES),
        *(
            (place, "while True: pass", f"took longer than {LIMIT} s; make it faster, or allow more with --time-limit")
            for place in PLACES
        ),
        ("ACT", "time.sleep(1e6)", "took longer than"),
        ("ACT", "threading.Event().wait()", "took longer than"),
        ("ACT", "raise SystemExit(3)", "SystemExit: 3"),
        ("ACT", "raise GeneratorExit", "GeneratorExit"),
        ("ACT", ODD + "raise Odd", "Odd: (which cannot be printed)"),
        ("ACT", ODD + "raise KeyError(Word('a'))", "KeyError: 'a'"),
        ("ACT", "raise ValueError('x' * 10**6)", "x..."),
        ("ACT", "raise ValueError('\\x1b[2J\\ud800')", "?[2J?"),
        ("ACT", "from nmfd.errors import InputError\nraise InputError('a\\nb')", "a b"),
        ("TOP", "os.chdir('/')", "left the folder"),
        ("ACT", "os.chdir('/')", "left the folder"),
        ("ACT", "perimeter = perimeter + 0.1j", "expected real numbers of shape (2, 2), got complex128 ones instead"),
        ("ACT", "perimeter = perimeter.astype(object) + 0.1j", "expected numbers of shape (2, 2)"),
        ("ACT", "perimeter = perimeter.astype(str)", "got str"),
        ("ACT", "perimeter = np.ma.masked_all((2, 2))", "got masked ones"),
        ("ACT", "perimeter = (x for x in 'ab')", "expected finite numbers of shape (2, 2), got shape () instead"),
        ("ACT", "perimeter = np.broadcast_to(0.5, (10**6, 10**6))", "got shape (1000000, 1000000) instead"),
        ("ACT", "perimeter = [[0.5], [0.5, 0.5]]", "expected numbers of shape (2, 2), got list"),
        ("ACT", "perimeter[0, 1] = -np.inf", "numbers that are not finite"),
        ("ACT", "import torch\nperimeter = torch.ones(2, 2, requires_grad=True)", "expected numbers of shape (2, 2)"),
        ("ACT", "class Lazy:\n    def __array__(self, *a, **b): raise SystemExit\nperimeter = Lazy()", "SystemExit"),
        ("ACT", ODD + "note = Odd()", ""),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_one_line(tmp_path, scenario, place, code, expected):
    before = os.getcwd()
    found = said(written(tmp_path / "mine.py", place, code), scenario)
    assert expected in found and bool(found) == bool(expected)
    assert not expected or "mine.py" in found
    assert os.getcwd() == before


def test_what_all_share_stays_as_it_is(tmp_path, scenario):
    import torch

    code = "import torch\nnp.seterr(all='raise')\ntorch.set_default_dtype(torch.float16)\ntorch.set_grad_enabled(False)"
    before = np.geterr(), torch.get_default_dtype(), torch.is_grad_enabled()
    assert said(written(tmp_path / "mine.py", "ACT", code), scenario) == ""
    assert (np.geterr(), torch.get_default_dtype(), torch.is_grad_enabled()) == before


LETHAL = {
    "exits": ("ACT", "os._exit(0)", "act: its process died (status 0)"),
    "swallows": (
        "ACT",
        "while True:\n    try:\n        while True: pass\n    except BaseException: pass",
        "act: took longer",
    ),
    "counts": ("ACT", "sum(itertools.count())", "act: took longer than its time limit, and its process was ended"),
    "closes": ("ACT", "os.closerange(0, 100)", "its process died (status 1)"),
    "leaves": ("ACT", "threading.Thread(target=time.sleep, args=[1e6]).start(); raise ValueError", "act: ValueError"),
    "begs": ("RESET", "signal.signal(signal.SIGTERM, signal.SIG_IGN)", None),
}


@pytest.mark.slow
def test_a_process_that_ends_or_hangs_costs_its_own_run(tmp_path, scenario, monkeypatch):
    monkeypatch.setattr("nmfd.runs.workers.GRACE", 0.2)
    monkeypatch.setattr("nmfd.runs.workers.LEAVE", 1.0)
    names = {written(tmp_path / f"{key}.py", *LETHAL[key][:2]): LETHAL[key][2] for key in LETHAL}
    tasks = [(name, scenario) for name in names]
    found = {task[0]: outcome for task, outcome in outcomes(acted, tasks, 2, group=lambda task: task[0])}
    for name, expected in names.items():
        if expected is None:
            assert found[name] == 5
        else:
            assert isinstance(found[name], Failure) and expected in found[name].reason, found
            assert name in found[name].reason or "closes" in name  # noticed only when it was to say what came of it
            assert "\n" not in found[name].reason


@pytest.mark.slow
def test_commands_name_it_and_keep_the_others(tmp_path, monkeypatch):
    tiny.write(tmp_path)
    monkeypatch.chdir(tmp_path)
    for key in ("exits", "fails"):
        written(Path(f"{key}.py"), "ACT", "os._exit(0)" if key == "exits" else "raise BaseException('no')")
    written(Path("never.py"), "INIT", "os._exit(0)")
    written(Path("hangs.py"), "TOP", "sum(itertools.count())")
    command = ("benchmark", "scenario", "--out", "out", "--controllers")
    assert "never.py:Mine: Mine(): its process died (status 0)" in error_line(
        nmfd(*command, "no-control,never.py:Mine"), "nmfd"
    )
    assert "hangs.py:Mine: import: took longer" in error_line(
        nmfd(*command, "no-control,hangs.py:Mine", "--time-limit", 0.2), "nmfd"
    )
    assert not Path("out").exists()
    line = error_line(nmfd(*command, "exits.py:Mine,fails.py:Mine,no-control"), "nmfd")
    assert "exits.py:Mine, seed 0: exits.py:Mine: act: its process died (status 0)" in line
    assert "fails.py:Mine: act: BaseException: no" in line
    assert [row["controller"] for row in run_folder.read_summary(Path("out/summary.csv"))] == ["no-control"]


def test_it_is_asked_once_for_its_name_and_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(Path("mine.py"), "TOP", "open('asked', 'a').write('x')")
    assert custom.table_name("mine.py:Mine") == "mine.py:Mine"
    assert custom.fingerprint("mine.py:Mine") == custom.fingerprint("mine.py:Mine")
    assert Path("asked").read_text(encoding="utf-8") == "x"
