"""Controllers compared: task sets that never change, entries, their ranks, and whose failure is whose."""

import csv
import itertools
import json
import math
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import copies
import pandas as pd
import pytest
import tiny
import tiny_city
from commands import cosim, error_line, good, nmfd

from cosim.compete import entry, page, run, table, task_set, verified, verify
from cosim.compete.metrics import METRICS, TTS
from cosim.evaluation.simulate import Task
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.workers import Watch
from nmfd.studies import benchmark

TASKS = """
name = "mine"
text = "two tasks"
[[tasks]]
id = "nominal"
text = "as planned"
scenario = "scenario"
plant = "acyclic"
seeds = [1, 2, 3, 4, 5]
time_limit = 0.2
steps = 8
[[tasks]]
id = "noisy"
text = "with noise"
scenario = "scenario"
plant = "nmfd"
noise = 0.3
seeds = [0]
time_limit = 5.0
steps = 8
"""
# By the seed, in turns: good, late (but within the limit), wrong in two ways, broken, and slow.
TROUBLE = """
import time
import numpy as np
from nmfd import Controls

class Trouble:
    deadline = 1e-6

    def __init__(self, planning):
        self.open = np.where(planning.network.adjacency, 0.9, 0.0)

    def reset(self, seed=0):
        self.seed = seed

    def act(self, observation):
        if observation.step < 2:
            return Controls(perimeter=self.open, splits=None)
        match self.seed:
            case 1:
                time.sleep(1e-3)
            case 2:
                return Controls(perimeter=self.open * np.nan, splits=None)
            case 3:
                return Controls(perimeter=np.ones((9, 9)), splits=None)
            case 4:
                raise RuntimeError("no more")
            case 5:
                time.sleep(60)
        return Controls(perimeter=self.open, splits=None)
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with a scenario and a task set."""
    tiny.write(tmp_path)
    (tmp_path / "mine.toml").write_text(TASKS, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def here(monkeypatch):
    """Controllers of one's own in this process: their own take a second each to start."""
    monkeypatch.setattr("nmfd.runs.workers._here", Watch())
    monkeypatch.setattr(registry, "runs_apart", lambda name: False)
    monkeypatch.setattr("nmfd.runs.files.synced", lambda path: None)


def competed(*controllers: str, only: str = "", out: str = "out") -> dict[str, entry.Entry]:
    order = run.Order(
        task_set=task_set.read("mine.toml"), controllers=controllers, out=Path(out), only=(only,) if only else ()
    )
    return {one.controller: one for one in run.compete(order)}


@pytest.mark.usefixtures("here", "unchecked")
def test_who_is_late_wrong_and_slow_in_turns_fails_alone(place):
    Path("trouble.py").write_text(TROUBLE, encoding="utf-8")
    good(nmfd("new-controller", "mine.py"))
    before = competed("no-control", "mine.py:MyController")
    alone = table.read(["out"])
    assert [row.rank for row in alone.overall] == [1, 1] and not before["no-control"].missing
    found = competed("trouble.py:Trouble")["trouble.py:Trouble"]
    nominal = found.outcome("nominal")
    assert [one.seed for one in nominal.runs] == [1] and found.outcome("noisy").complete
    late, punctual = nominal.runs[0].metrics, before["no-control"].outcome("nominal").runs[0].metrics
    assert late["late_decisions"] >= 2 and late[TTS] == punctual[TTS] and punctual["late_decisions"] == 0
    for failure, words in zip(
        nominal.failed,
        (
            "perimeter: expected finite numbers of shape (2, 2)",
            "got shape (9, 9)",
            "RuntimeError: no more",
            "took longer than 0.2 s",
        ),
        strict=True,
    ):
        assert words in failure.reason and "trouble.py:Trouble" in failure.reason
    assert found.missing == ("nominal",)
    beside = table.read(["out"])
    rows = {(row.name, row.task): row for group in (beside.overall, *beside.by_task.values()) for row in group}
    trouble = rows["trouble.py:Trouble", table.ALL]
    assert (trouble.rank, trouble.worth, trouble.runs, trouble.failed) == (None, None, 2, 4)
    assert rows["trouble.py:Trouble", "noisy"].worth == pytest.approx(1.0)
    for group in (alone.overall, alone.by_task["nominal"]):
        assert all(rows[row.name, row.task] == row for row in group)
    page.write(Path("page.html"), beside)
    text = Path("page.html").read_text(encoding="utf-8")
    assert "seed 4: " in text and "RuntimeError: no more" in text and "4 failed" in text


@pytest.mark.usefixtures("here")
def test_it_goes_on_and_a_changed_controller_is_run_again(place, monkeypatch):
    calls = itertools.count()
    monkeypatch.setattr(run, "provenance", lambda: {"date": str(next(calls)), "versions": {"torch": "2"}})
    Path("mine.py").write_text(tiny.CONTROLLER, encoding="utf-8")
    name = "mine.py:Mine"
    first = competed(name, only="noisy")[name]
    assert first.missing == ("nominal",) and first.outcome("nominal").missing == (1, 2, 3, 4, 5)
    assert first.outcome("noisy").depends_on["source_hash"] and [one["date"] for one in first.sessions] == ["0"]
    again = competed(name)[name]
    assert not again.missing and [one["date"] for one in again.sessions] == ["0", "1"]
    assert [outcome.runs[0].session for outcome in again.tasks] == [1, 0]
    assert again.outcome("noisy").runs[0].metrics == first.outcome("noisy").runs[0].metrics
    Path("mine.py").write_text(tiny.CONTROLLER.replace("0.5", "0.125"), encoding="utf-8")
    changed = competed(name, only="noisy")[name]
    assert changed.missing == ("nominal",) and [one["date"] for one in changed.sessions] == ["2"]  # not half of each
    assert changed.outcome("noisy").depends_on != first.outcome("noisy").depends_on
    assert changed.outcome("noisy").runs[0].metrics[TTS] > first.outcome("noisy").runs[0].metrics[TTS]
    assert entry.read(Path("out") / "mine.py%3AMine.json") == changed


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("plant", ["acyclic", "nmfd"])
def test_an_entry_counts_without_its_run_folder_while_it_is_of_the_same(place, monkeypatch, plant):
    """What is missing of it alone is run, elsewhere; of a changed controller everything."""
    calls, made = itertools.count(), []
    monkeypatch.setattr(run, "provenance", lambda: {"date": str(next(calls)), "versions": {"torch": "2"}})
    monkeypatch.setattr(
        benchmark,
        "run_one",
        lambda task, run_one=benchmark.run_one, **others: (made.append(task), run_one(task, **others))[1],
    )
    Path("mine.toml").write_text(TASKS.replace('"acyclic"', f'"{plant}"'), encoding="utf-8")
    Path("mine.py").write_text(tiny.CONTROLLER, encoding="utf-8")
    name = "mine.py:Mine"
    first = competed(name, only="nominal")[name]
    assert len(made) == 5
    part = first.changed(
        tasks=tuple(one.changed(runs=one.runs[:3]) if one.task == "nominal" else one for one in first.tasks)
    )
    Path("elsewhere").mkdir()
    entry.write(entry.path(Path("elsewhere"), name), part)
    again = competed(name, out="elsewhere")[name]
    assert made[5:] == [(name, 4), (name, 5), (name, 0)] and not again.missing
    runs = again.outcome("nominal").runs
    assert [one.metrics[TTS] for one in runs] == [one.metrics[TTS] for one in first.outcome("nominal").runs]
    assert [again.sessions[one.session]["date"] for one in runs] == ["0", "0", "0", "1", "1"]
    assert again.outcome("nominal").depends_on == first.outcome("nominal").depends_on
    assert competed(name, out="elsewhere")[name] == again and len(made) == 8
    # Of the first three, whose session no run has any more, and the others, all is known as before.
    last = again.changed(
        tasks=tuple(one.changed(runs=one.runs[3:]) if one.task == "nominal" else one for one in again.tasks)
    )
    Path("third").mkdir()
    entry.write(entry.path(Path("third"), name), last)
    third = competed(name, out="third")[name]
    assert made[8:] == [(name, 1), (name, 2), (name, 3)] and not third.missing
    assert [third.sessions[one.session]["date"] for one in third.outcome("nominal").runs] == ["3", "3", "3", "1", "1"]
    shutil.rmtree("elsewhere/nominal")
    Path("mine.py").write_text(tiny.CONTROLLER.replace("0.5", "0.125"), encoding="utf-8")
    changed = competed(name, out="elsewhere", only="noisy")[name]
    assert changed.missing == ("nominal",) and not changed.outcome("nominal").runs


def test_what_is_run_for_an_entry():
    sets = config.checked(task_set.TaskSet, tomllib.loads(TASKS), "mine.toml")
    regional = sets.tasks[0]
    fixed = regional.changed(plant="sumo")
    pressed = fixed.changed(signals="max-pressure")
    for name, expected in (
        ("no-control", ("no-control", "no-control", "max-pressure")),
        ("max-pressure-cyclic", ("no-control", "max-pressure-cyclic", "max-pressure")),
        ("pi-gating+guided", ("pi-gating", "pi-gating+guided", "pi-gating+guided+max-pressure")),
        (
            "dpc-pc+actuated+rerouting-30",
            ("dpc-pc", "dpc-pc+actuated+rerouting-30", "dpc-pc+rerouting-30+max-pressure"),
        ),
    ):
        assert tuple(run.strategy(name, task) for task in (regional, fixed, pressed)) == expected


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('"acyclic"', '"sumo"\nnoise = 1.0', "tasks[0].noise: is for regional models"),
        ('"acyclic"', '"acyclic"\nsignals = "max-pressure"', "tasks[0].signals: is for SUMO"),
        ('id = "noisy"', 'id = "Nominal"', "tasks[1].id: Nominal is there twice"),
        ('id = "noisy"', 'id = "../noisy"', "tasks[1].id: expected"),
        ("seeds = [0]", "seeds = []", "tasks[1].seeds: expected"),
        ("seeds = [0]", "seed = [0]", "unknown key; did you mean seeds"),
        ('scenario = "scenario"', 'scenario = "nothing"', "nominal: scenario: there is no nothing/scenario.toml"),
        ("time_limit = 5.0", "time_limit = 0.0", "time_limit: expected a number above 0"),
    ],
)
def test_a_wrong_task_set(place, old, new, words):
    Path("mine.toml").write_text(TASKS.replace(old, new), encoding="utf-8")
    assert words in error_line(cosim("compete", "no-control", "--tasks", "mine.toml", "--out", "out"))
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "words, expected",
    [
        (("no-control", "--tasks", "v0"), "no task set of that name comes with the package; choose from v1"),
        (
            ("no-control", "--tasks", "mine.toml", "--only", "nominal,x*"),
            "--only: no task matches 'x*'; there are nominal",
        ),
        (("no-contrl", "--tasks", "mine.toml"), "did you mean no-control"),
        ((), "expected controllers to run, or --table DIR"),
        (("--table", "scenario"), "scenario: holds no entries"),
        (("no-control", "--scheduler-ca", "x"), "--scheduler: missing"),
    ],
)
def test_wrong_words(place, words, expected):
    assert expected in error_line(cosim("compete", *words))
    assert not Path("runs").exists()


@pytest.mark.parametrize("name", ["v1"])
def test_a_released_set_is_what_it_was(name):
    loaded = task_set.read(name)
    assert loaded.worlds is not None and list(loaded.worlds) == [task.id for task in loaded.tasks.tasks]
    for task in loaded.tasks.tasks:
        loaded.check_world(task, task_set.world(task, loaded.scenario(task)))
        assert min(task.seeds) >= 3200 and max(task.seeds) < 3300  # kept for this


def test_a_released_set_that_was_changed_is_refused(tmp_path, monkeypatch):
    for file in task_set.HERE.glob("*.toml"):
        shutil.copy(file, tmp_path)
    monkeypatch.setattr(task_set, "HERE", tmp_path)
    content = (tmp_path / "v1.toml").read_text(encoding="utf-8")
    (tmp_path / "v1.toml").write_text(f"# a comment\n{content}", encoding="utf-8")
    loaded = task_set.read("v1")
    with pytest.raises(InputError, match="economic-nominal: its scenario or network has changed since v1 was released"):
        loaded.check_world(loaded.tasks.tasks[0], "another")
    (tmp_path / "v1.toml").write_text(content.replace("time_limit = 30.0", "time_limit = 60.0"), encoding="utf-8")
    with pytest.raises(InputError, match="is not the task set v1 that was released"):
        task_set.read("v1")


def test_the_world_of_a_task_is_that_of_its_plant(place):
    loaded = task_set.read("mine.toml")
    nominal, noisy = loaded.tasks.tasks
    before = [task_set.world(task, loaded.scenario(task)) for task in (nominal, noisy)]
    with Path("scenario/scenario.toml").open("a", encoding="utf-8") as file:
        file.write("\n[controllers.pi-gating]\nkp = 2.0\n")
    assert [task_set.world(task, loaded.scenario(task)) for task in (nominal, noisy)] == before
    assert task_set.world(nominal.changed(demand=1.1), loaded.scenario(nominal.changed(demand=1.1))) != before[0]
    assert task_set.world(noisy.changed(seeds=(1,)), loaded.scenario(noisy)) != before[1]


def made(name: str, spent: dict[str, dict[int, float]], seeds=(1, 2)) -> entry.Entry:
    """An entry with this total time spent by task and seed; a run with a negative one failed."""

    def outcome(task: str, values: dict[int, float]) -> entry.Outcome:
        runs = [
            entry.Run(seed=seed, session=0, metrics=dict.fromkeys(METRICS, 1.0) | {TTS: value})
            for seed, value in values.items()
            if value >= 0
        ]
        failed = [entry.Failure(seed=seed, reason="<i>no</i>") for seed, value in values.items() if value < 0]
        return entry.Outcome(
            task=task,
            text="a <b>task</b>",
            strategy=name,
            plant="sumo",
            scenario="tiny",
            scenario_hash="a",
            network="n",
            network_hash="b",
            world="w",
            demand=1.0,
            time_limit=1.0,
            depends_on={},
            seeds=seeds,
            runs=tuple(runs),
            failed=tuple(failed),
            missing=tuple(seed for seed in seeds if seed not in values),
        )

    tasks = tuple(outcome(task, values) for task, values in spent.items())
    return entry.Entry(
        controller=name,
        task_set=entry.TaskSetName(name="v0", named="v0", hash="h", released=True),
        command="cosim compete",
        sessions=({"date": "2026-01-01", "versions": {"torch": "2"}, "commit": None},),
        tasks=tasks,
        missing=tuple(one.task for one in tasks if not one.complete),
        metrics=entry.about_metrics(),
    )


ENTRIES = {
    "no-control": {"a": {1: 100.0, 2: 400.0}, "b": {1: 10.0, 2: 10.0}},
    "half": {"a": {1: 50.0, 2: 200.0}, "b": {1: 10.0, 2: 10.0}},
    "quarter": {"a": {1: 25.0, 2: 100.0}, "b": {1: 10.0}},
    "<script>alert(1)</script>": {"a": {1: 1.0, 2: -1.0}, "b": {1: 1.0, 2: 1.0}},
}


def written(folder: Path, entries=ENTRIES) -> Path:
    folder.mkdir()
    for name, spent in entries.items():
        entry.write(entry.path(folder, name), made(name, spent))
    return folder


def test_the_rank(tmp_path):
    board = table.read([str(written(tmp_path / "all"))])
    overall = {row.name: row for row in board.overall}
    assert [row.name for row in board.overall][:2] == ["half", "no-control"]
    assert (overall["half"].rank, overall["half"].worth) == (1, pytest.approx(0.5**0.5))
    assert (overall["no-control"].rank, overall["no-control"].worth) == (2, pytest.approx(1.0))
    assert overall["quarter"].rank is None and overall["quarter"].missing == 1  # however good it is
    assert overall["<script>alert(1)</script>"].rank is None
    in_a = {row.name: (row.rank, row.worth) for row in board.by_task["a"]}
    assert in_a["quarter"] == (1, pytest.approx(0.25)) and in_a["half"] == (2, pytest.approx(0.5))
    assert in_a["<script>alert(1)</script>"] == (None, None)
    fewer = table.read([str(written(tmp_path / "fewer", {name: ENTRIES[name] for name in ("no-control", "half")}))])
    assert {row.name: row.worth for row in fewer.overall} == {
        name: overall[name].worth for name in ("no-control", "half")
    }
    without = table.read([str(written(tmp_path / "without", {"half": ENTRIES["half"]}))])
    assert without.overall[0].rank is None and without.by_task["a"][0].metrics[TTS] == 125.0


def test_the_page_and_the_csv(tmp_path):
    folder = written(tmp_path / "all")
    assert "half" in good(cosim("compete", "--table", folder))
    text = (folder / "leaderboard.html").read_text(encoding="utf-8")
    assert "&lt;script&gt;alert(1)" in text and not any(tag in text for tag in ("<script>alert", "<i>no", "<b>task"))
    assert text.count("<script>") == 1 and "1 missing" in text and "1 failed" in text
    with (folder / "leaderboard.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * len(ENTRIES) and {row["task"] for row in rows} == {"all tasks", "a", "b"}
    assert [row["rank"] for row in rows if row["task"] == "all tasks"] == ["1", "2", "", ""]


def test_the_entries_that_come_with_the_package(tmp_path):
    board = table.read(["v1"])
    loaded = task_set.read("v1")
    assert board.hash == loaded.hash and board.released and "no-control" in board.entries
    for task, about in board.tasks.items():
        assert about.world == loaded.worlds[task]
    assert good(cosim("compete", "--table", "v1", "--out", tmp_path))
    assert "--out: missing" in error_line(cosim("compete", "--table", "v1"))


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda one: one["task_set"].update(name="v9"), "its task set is v9, but that of"),
        (lambda one: one["task_set"].update(hash="other"), "its hash is other, but that of"),
        (lambda one: one["tasks"][0].update(world="other"), "a: is another task there than in"),
        (lambda one: one["tasks"].pop(), "b: is another task there than in"),
        (lambda one: one.pop("tasks"), "tasks: missing"),
        (lambda one: one.update(controller=3), "controller: expected"),
        (lambda one: one["tasks"][0]["runs"][0]["metrics"].update(TTS=1.0), "a: 'TTS' is no metric of version"),
        (lambda one: one["tasks"][0]["runs"][0]["metrics"].update({TTS: float("nan")}), "tasks[0].runs[0].metrics"),
    ],
)
def test_entries_that_cannot_be_compared(tmp_path, change, words):
    folder = written(tmp_path / "all")
    content = json.loads((folder / "quarter.json").read_text(encoding="utf-8"))
    change(content)
    (folder / "quarter.json").write_text(json.dumps(content), encoding="utf-8")
    line = error_line(cosim("compete", "--table", folder))
    assert words in line and "quarter.json" in line and not (folder / "leaderboard.html").exists()


def test_a_file_that_is_no_entry(tmp_path):
    folder = written(tmp_path / "all")
    (folder / "other.json").write_text("[1", encoding="utf-8")
    assert "other.json: is no entry" in error_line(cosim("compete", "--table", folder))


@pytest.mark.usefixtures("here")
def test_a_row_is_made_again_and_compared(place):
    competed("no-control", "pi-gating", only="noisy")
    same = "11 figures to the last digit, the kept run to the byte"
    assert same in good(cosim("verify", "out/noisy", "--row", "pi-gating*"))
    assert "17 figures to the last digit" in good(cosim("verify", "out", "--row", "pi-gating*"))
    summary = Path("out/noisy/summary.csv")
    rows = summary.read_text(encoding="utf-8")
    spent = next(row["total_time_spent_veh_s"] for row in csv.DictReader(rows.splitlines()))
    summary.write_text(rows.replace(spent, spent[:-1] + str((int(spent[-1]) + 1) % 10)), encoding="utf-8")
    done = cosim("verify", "out/noisy", "--row", "no-control,*")
    assert done.exit_code == 1 and f"total_time_spent_veh_s differs: {spent[:-1]}" in done.stdout
    assert "1 of 11 figures differ" in done.stderr
    assert "within 1e-12" in good(cosim("verify", "out/noisy", "--row", "no-control,*", "--within", "1e-12"))
    assert good(cosim("verify", "out/noisy", "--list")).split() == ["no-control,0", "pi-gating,0"]
    assert "no row matches 'x'; there are no-control,0" in error_line(cosim("verify", "out/noisy", "--row", "x"))
    assert "does not say how its rows were made" in error_line(cosim("verify", "network"))


@pytest.mark.usefixtures("here")
def test_all_rows_are_made_again_and_what_came_of_them_is_kept(place, monkeypatch):
    competed("no-control", "pi-gating", only="noisy")
    text = good(cosim("verify", "out/noisy", "--all"))
    assert "out/noisy: 2 rows: 2 the same; see runs/verified.csv" in text

    def table():
        with Path("runs/verified.csv").open(newline="", encoding="utf-8") as stream:
            return {
                (row["folder"], row["row"]): (row["verdict"], row["compared"], row["equal"], row["what"])
                for row in csv.DictReader(stream)
            }

    assert table() == dict.fromkeys(
        [("out/noisy", "no-control,0"), ("out/noisy", "pi-gating,0")], ("the same", "11", "11", "")
    )
    made, again, now = [], verify.verify, {"commit": "this", "dirty": False}
    monkeypatch.setattr(verified, "provenance", lambda: now)
    monkeypatch.setattr(verified, "verify", lambda row, within: made.append(row.label) or again(row, within))
    assert "2 the same" in good(cosim("verify", "out/noisy", "--all")) and len(made) == 2  # of another commit
    assert "2 the same" in good(cosim("verify", "out/noisy", "--all")) and len(made) == 2
    now["dirty"] = True
    assert "2 the same" in good(cosim("verify", "out/noisy", "--all")) and len(made) == 4
    assert "1 rows: 1 the same" in good(cosim("verify", "out", "--all", "--row", "pi-gating,*"))
    assert len(table()) == 3 and len(made) == 5
    now["commit"] = "another"
    assert "2 the same" in good(cosim("verify", "out/noisy", "--all", "--missing")) and len(made) == 5
    # Of another commit, of which one row comes out differently and one cannot be made.
    now.update(commit=None, dirty=None)

    def changed(row, within):
        if row.label.startswith("pi"):
            raise InputError("no such thing")
        return replace(again(row, within), differ={"completed_veh": (1, 2)})

    monkeypatch.setattr(verified, "verify", changed)
    done = cosim("verify", "out/noisy", "--all")
    assert done.exit_code == 1 and "2 of 2 rows did not come out the same" in done.stderr
    assert "1 different, 1 failed" in done.stdout and "no-control,0: different, completed_veh" in done.stderr
    assert [line[0] for line in table().values()] == ["the same", "different", "failed"]
    assert table()["out/noisy", "pi-gating,0"] == ("failed", "0", "0", "no such thing")
    assert list(Path("runs").iterdir()) == [Path("runs/verified.csv")]
    assert "version 0." in Path("runs/verified.csv").read_text(encoding="utf-8")


@pytest.mark.usefixtures("here")
def test_two_processes_let_the_table_grow_at_a_time(place, monkeypatch):
    competed("no-control", "pi-gating", only="noisy")
    again = verify.verify

    def slow(row, within):
        monkeypatch.setattr(verified, "verify", again)
        assert "1 the same" in good(cosim("verify", "out/noisy", "--all", "--row", "pi-gating,*"))
        return again(row, within)

    monkeypatch.setattr(verified, "verify", slow)
    assert "1 the same" in good(cosim("verify", "out/noisy", "--all", "--row", "no-control,*"))
    assert [line["row"] for line in verified._read(Path("runs/verified.csv"))] == ["pi-gating,0", "no-control,0"]


@pytest.mark.usefixtures("place")
def test_a_row_of_a_policy_that_was_given_is_made_again_with_it():
    made = Path(shutil.copytree("scenario", "scenario/less"))
    file = made / "scenario.toml"
    file.write_text(file.read_text(encoding="utf-8").replace("../network", "../../network"), encoding="utf-8")
    good(nmfd("train", "scenario", "--controller", "dpc-pc", "--steps", 2, "--no-compile"))
    good(nmfd("benchmark", made, "--controllers", "dpc-pc", "--policy", "dpc-pc=scenario/dpc-pc.pt", "--out", "out"))
    assert "The same" in good(cosim("verify", "out"))
    Path("scenario/dpc-pc.pt").unlink()
    assert "less/dpc-pc.pt: no such policy" in error_line(cosim("verify", "out"))


@pytest.mark.usefixtures("here")
def test_what_all_rows_cannot_be_written_to(place):
    competed("no-control", only="noisy")
    assert "--out is for --all" in cosim("verify", "out/noisy", "--out", "x").stderr
    assert "--missing is for --all" in cosim("verify", "out/noisy", "--missing").stderr
    assert "--seed chooses one row" in cosim("verify", "out/noisy", "--all", "--seed", 1).stderr
    for content, words in (("a,b\n1,2\n", "expected folder, row"), ("", "is no table of cosim verify (")):
        Path("other").mkdir(exist_ok=True)
        Path("other/verified.csv").write_text(content, encoding="utf-8")
        assert words in error_line(cosim("verify", "out/noisy", "--all", "--out", "other"))
        assert Path("other/verified.csv").read_text(encoding="utf-8") == content


def asked(command: str, seeds: str = "0 1", **more) -> dict:
    """The trail of a table that a command made."""
    session = {"command": command, "commit": "abc", "dirty": False, "versions": {"python": "2.7"}}
    return {**session, "runs": [{**session, "seeds": seeds.split()}], **more}


def table_of(folder: Path, trail_of_it: dict, **changed) -> None:
    rows = pd.DataFrame(
        {
            "demand": [1.0, 1.0, 1.3],
            "controller": "no-control",
            "seed": [0, 1, 0],
            "completed_veh": [5.0, 6.0, 7.0],
            "co2_kg": [0.1 + 0.2, math.nan, 0.5],
            "wall_time_s": 1.0,
        }
    )
    folder.mkdir()
    rows.assign(**changed, trail=[json.dumps(trail_of_it), "", ""]).to_csv(folder / "runs.csv", index=False)


def test_a_published_table_is_made_again_by_the_command_that_it_names(place, monkeypatch):
    made = []

    def simulated(task, out):
        made.append(task)
        return {"completed_veh": 5 + task.seed, "co2_kg": 0.1 + 0.2, "wall_time_s": 2.0, "demand": 1.0}

    monkeypatch.setattr(verify, "_simulated", simulated)
    table_of(
        place / "out",
        asked(
            "cosim evaluate --seeds=2 scenario --controllers 'no-*,x' --first-seed 0 --steps 3 "
            "--policy x=y.pt --policy no-control=mine.pt"
        ),
    )
    assert good(cosim("verify", "out", "--list")).split() == ["1,no-control,0", "1,no-control,1"]  # 1.3: nobody asked
    text = good(cosim("verify", "out", "--row", "*,0"))
    assert "The same: 3 figures to the last digit" in text and "commit: abc then" in text and "python: 2.7 then" in text
    assert made == [Task(scenario=Path("scenario"), controller="no-control", seed=0, steps=3, policy=Path("mine.pt"))]
    assert "The same: 2 figures" in good(cosim("verify", "out", "--row", "*,1"))  # an empty one is none
    table_of(
        place / "other",
        asked("cosim evaluate scenario --controllers no-control --seeds 2 --first-seed 0"),
        completed_veh=[5.0, 7.0, 7.0],
    )
    done = cosim("verify", "other", "--row", "*,1")
    assert done.exit_code == 1 and "completed_veh differs: 7.0 published, 6 made again" in done.stdout
    near = good(cosim("verify", "other", "--row", "*,1", "--within", 0.2))
    assert "2 figures within 0.2, 1 to the last digit" in near
    table_of(
        place / "rounded",
        asked("cosim evaluate scenario --controllers no-control --seeds 2 --first-seed 0"),
        completed_veh=[5.0, 6.0 + 1e-14, 7.0],
    )  # of another version
    assert "2 figures within 1e-09, 1 to the last digit" in good(cosim("verify", "rounded", "--row", "*,1"))
    assert cosim("verify", "rounded", "--row", "*,1", "--within", 0).exit_code == 1


@pytest.mark.parametrize(
    "found, words",
    [
        (
            asked("cosim evaluate scenario --controllers no-control", not_again={"no-*": "too old"}),
            "made again: too old",
        ),
        (asked("cosim evaluate scenario --controllers no-control"), "names no command"),  # seeds from 2000 up
        (asked("cosim sweep scenario --controllers no-control --first-seed 0"), "names no command"),
        (asked("cosim evaluate nowhere --controllers no-control --first-seed 0"), "there is no nowhere"),
        (asked("cosim evaluate scenario --first-seed 0"), "is no command of version"),
        (asked("cosim evaluate scenario --controllers no-control --seeds many"), "is no command of version"),
        (asked("unknown"), "names no command"),
        ({}, "names no command"),
    ],
)
def test_tables_that_cannot_be_made_again(place, found, words):
    table_of(place / "out", found)
    line = error_line(cosim("verify", "out"))
    assert words in line and "runs.csv" in line
    Path("out/runs.csv").write_text("a,trail\n1,\n", encoding="utf-8")
    assert "runs.csv: is no table of runs" in error_line(cosim("verify", "out"))


def test_a_scenario_that_is_elsewhere_now_can_be_given(place, monkeypatch):
    made = []
    monkeypatch.setattr(verify, "_simulated", lambda task, out: made.append(task.scenario) or {"completed_veh": 5})
    table_of(place / "out", asked("cosim evaluate nowhere --controllers no-control --first-seed 0"))
    assert "give it with --scenario" in error_line(cosim("verify", "out"))
    assert "The same: 1 figures" in good(cosim("verify", "out", "--row", "*,0", "--scenario", "scenario"))
    assert made == [Path("scenario")]
    assert "scenario.toml" in error_line(cosim("verify", "out", "--scenario", "out"))
    good(nmfd("benchmark", "scenario", "--controllers", "no-control", "--out", "regional"))
    Path("scenario").rename("moved")
    assert "give it with --scenario" in error_line(cosim("verify", "regional"))
    assert "The same" in good(cosim("verify", "regional", "--scenario", "moved"))


@pytest.mark.usefixtures("place")
def test_what_is_unknown_of_a_table_is_said(monkeypatch):
    monkeypatch.setattr(verify, "_simulated", lambda task, out: {"completed_veh": 5})
    unknown = dict.fromkeys(("command", "commit", "dirty", "versions"), "unknown")
    table_of(Path("out"), {**unknown, "readme": ["cosim evaluate scenario --controllers no-control --first-seed 0"]})
    text = good(cosim("verify", "out", "--row", "1,*,0"))
    assert "unknown then: python, " in text and ", commit, uncommitted changes" in text and " now" not in text


def test_what_is_published_names_its_commands():
    """Every row of the evaluations that are of this version, but one, for whose seed nobody asked (its README)."""
    for city, rows in (("bologna", 29), ("luxembourg", 12), ("demo", 20), ("grid7_peak", 186)):
        assert len(verify.rows(Path(__file__).parents[1] / "scenarios" / city / "reference")) == rows


@pytest.mark.slow
def test_a_table_of_a_city_is_made_again(place):
    tiny_city.city(place)
    tiny_city.imported(place)
    good(
        cosim(
            "evaluate",
            "scenarios/tiny",
            "--controllers",
            "no-control,pi-gating",
            "--seeds",
            1,
            "--first-seed",
            0,
            "--steps",
            2,
            "--demand",
            "1,1.3",
            "--out",
            "evaluated",
        )
    )
    Path("published").mkdir()
    shutil.copy("evaluated/runs.csv", "published")
    for row in ("1.3,pi-gating,0", "1,no-control,0"):
        text = good(cosim("verify", "published", "--row", row))
        assert "The same" in text and " then" not in text, text  # hashes, versions and commit, too
    file = Path("scenarios/tiny/scenario.toml")
    text = re.sub(r"demand_factor = .*", "demand_factor = 0.7", file.read_text(encoding="utf-8"))
    file.write_text(text, encoding="utf-8")
    done = cosim("verify", "published", "--row", "1,no-control,0")
    assert done.exit_code == 1, done.stderr
    assert "demand_hash: " in done.stdout and "total_time_spent_veh_s differs" in done.stdout


@pytest.mark.slow
def test_strangers_in_sumo(place):
    """The template and one that is late, wrong and slow in turns, in processes of their own, on grid7."""
    copies.peak(place)
    Path("mine.toml").write_text(
        TASKS.replace('"scenario"', '"scenarios/peak"')
        .replace('"acyclic"', '"sumo"')
        .replace("time_limit = 0.2", "time_limit = 3.0")
        .replace("seeds = [1, 2, 3, 4, 5]", "seeds = [1, 5]"),
        encoding="utf-8",
    )
    Path("trouble.py").write_text(TROUBLE, encoding="utf-8")
    good(nmfd("new-controller", "mine.py"))
    command = ("compete", "--tasks", "mine.toml", "--only", "nominal", "--out", "out", "--workers", "2")
    good(cosim(*command, "no-control", "mine.py:MyController"))
    alone = table.read(["out"])
    assert "nominal, seed 5: " in good(cosim(*command, "trouble.py:Trouble", "bound-pc"))
    beside = table.read(["out"])
    rows = {(row.name, row.task): row for group in beside.by_task.values() for row in group}
    assert all(rows[row.name, row.task] == row for group in alone.by_task.values() for row in group)
    trouble, without = rows["trouble.py:Trouble", "nominal"], rows["bound-pc", "nominal"]
    assert (trouble.runs, trouble.failed, without.failed) == (1, 1, 2) and trouble.metrics["late_decisions"] >= 1
    assert "no such plan for bound-pc" in without.reasons[0]
    known = rows["no-control", "nominal"].metrics
    assert known["co2_kg"] > 0 and known["locked"] == 1.0 and 0.0 <= known["delay_gini"] < 1.0
    assert known["mean_delay_s"] > known["mean_departure_delay_s"]
