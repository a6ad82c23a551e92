"""cosim study: stages, verdicts, what it recommends, the page, and how it goes on."""

import json
from dataclasses import replace

import made_up
import pandas as pd
import pytest
import tiny_city
from commands import cosim, error_line, good

from cosim.studying import page, stages
from cosim.studying.stages import AT_CRITICAL, EVERYWHERE, LABELS, Level, Outcome
from cosim.studying.verdict import judge
from cosim.sumo.net import city_of
from nmfd.api import load_scenario

PRESSURE = "max-pressure"
GUIDED = "route-guidance+guidance-period-60"
SHARE = dict.fromkeys(LABELS, 1.0) | {PRESSURE: 0.8, GUIDED: 0.5, "actuated": 1.3}
LEFT = {GUIDED: 30.0}  # of 600 trips


@pytest.fixture
def ran(monkeypatch):
    """Made-up runs on the demo city instead of SUMO's; it locks at 1.3 times its demand."""
    done = []
    city = city_of(load_scenario("demo").network)
    monkeypatch.setattr(made_up, "SHARE", SHARE)
    monkeypatch.setattr(stages, "LEVELS", (1.0, 1.3))

    def made(scenario, strategy, *, seed, demand):
        done.append((strategy.name, demand, seed))
        if len(done) == made.interrupted:
            raise KeyboardInterrupt
        if strategy.name == "metering":
            return "the disk is full"
        left = LEFT.get(strategy.name, 0.0) + 100.0 * (demand > 1.0)
        facts = {"completed_veh": 600.0 - left, "removed_veh": 0.0, "teleports": 0}
        run = made_up.result(scenario, strategy, seed=seed, demand=demand, city=city)
        return run.add(facts)

    made.interrupted = 0
    made_up.instead_of_sumo(monkeypatch, made)
    made.done = done
    return made


def test_from_a_scenario_to_a_page(ran, out):
    """An interrupted study goes on. Guidance saves most time, but leaves trips; max-pressure is
    recommended."""
    ran.interrupted = 7
    assert cosim("study demo --out", out).exit_code != 0
    assert not (out / "study.html").exists()
    ran.interrupted = 0
    again = ran.done.pop()
    text = good(cosim("study demo --out", out))
    assert again in ran.done
    assert len(set(ran.done)) == len(ran.done)  # nothing twice
    compared = {seed for name, _, seed in ran.done if name != "no-control"}
    assert stages.LOADING_SEED not in compared
    table = text.partition("\n\n")[0].splitlines()
    assert max(map(len, table)) <= 100
    assert table[1].split()[:2] == ["strategy", "verdict"]
    verdicts = {line[:26].strip(): line[26:].strip() for line in table[2:]}
    assert verdicts["max-pressure signals"].startswith("gains")
    assert verdicts["guidance"].startswith("gains")
    assert verdicts["actuated signals"].startswith("harms")
    assert "guidance: leaves 30 of 600 trips more unserved; not recommended" in text
    assert "metering: not judged; a run failed, for the reason in runs.csv" in text
    assert "Yes: max-pressure signals would save" in text
    broken = "breaks at demand times 1.3, where fewer trips are completed than at the demand before"
    assert f"{broken}: 16.7% of its trips" in " ".join(text.split())
    assert text.splitlines()[-1].startswith(f"Next: cosim watch demo --controller {PRESSURE} ")
    shown = (out / "study.html").read_text(encoding="utf-8")
    assert all(f"<td>{label}</td>" in shown for label in EVERYWHERE.values())
    assert "metering: not judged" in shown
    assert shown.count('onclick="look(') == 2 * page.MOST_PLACES
    assert shown.count("<td>60 s, E</td>") == page.MOST_PLACES  # at signals, without control


def test_a_folder_holds_one_study(tmp_path):
    (tmp_path / "study.json").write_text(json.dumps({"source": "city.sumocfg"}))
    line = error_line(cosim("study demo --out", tmp_path))
    assert "holds another study (source, regions changed)" in line


def outcome(strategy, *changes, more_left=0.0):
    """Without control the time spent is 100 with every seed."""
    return Outcome(
        strategy=strategy,
        verdict=judge(changes),
        means={},
        more_left=more_left,
        spent={seed: 100.0 + change for seed, change in enumerate(changes)},
    )


def studied(*levels):
    shown = [Level(demand=1.0 + 0.3 * n, outcomes=tuple(one)) for n, one in enumerate(levels)]
    return page.Study(
        source="city.sumocfg",
        place="scenarios/city",
        scenario=load_scenario("demo"),
        load=stages.Loading({1.0: 0.0}, 1.0, None),
        levels=tuple(shown),
        out=None,
    )


GAIN = (-9.0, -10.0, -11.0)


@pytest.mark.parametrize(
    "levels, expected",
    [
        ([[outcome(PRESSURE, *GAIN)]], (1.0, PRESSURE)),
        ([[outcome(PRESSURE, *GAIN, more_left=0.01)]], None),
        ([[outcome(PRESSURE, *GAIN)], [outcome(PRESSURE, 9.0, 10.0, 11.0)]], None),
        ([[outcome(PRESSURE, *GAIN)], [outcome(PRESSURE, 9.0, -8.0, 30.0)]], None),  # likely harm
        ([[outcome(PRESSURE, 0.0, 0.1, 0.0)], [outcome(PRESSURE, *GAIN)]], (1.3, PRESSURE)),
        ([[outcome(PRESSURE, *GAIN), outcome(GUIDED, -20.0, -21.0, -22.0)]], (1.0, GUIDED)),
        ([[outcome(PRESSURE, *GAIN), outcome(GUIDED, -9.5, -10.5, -11.5)]], (1.0, PRESSURE)),
        ([[outcome(PRESSURE, *GAIN), outcome(GUIDED, -12.0, -9.0, -13.0)]], (1.0, PRESSURE)),
        (
            [[outcome("pi-gating", *GAIN), outcome("metering", -12.0, -9.0, -11.0)]],
            (1.0, "pi-gating"),
        ),
        ([[outcome(PRESSURE, -30.0, 20.0, -30.0)]], None),
    ],
)
def test_nothing_is_recommended_that_harms_or_leaves_trips(levels, expected):
    best = studied(*levels).recommended
    assert (None if best is None else (best[0].demand, best[1].strategy)) == expected


def test_the_answer_says_that_the_best_is_not_told_apart():
    study = studied([outcome(PRESSURE, *GAIN), outcome(GUIDED, -12.0, -9.0, -13.0)])
    said = page.answer(study)
    assert said.startswith("Yes: max-pressure signals would save 10.0")
    assert said.endswith(
        " With 11.3 ± 5.2 %, guidance is not told apart from that, which is simpler."
    )


def test_the_answer_says_what_helps_only_today():
    only_today = [outcome(PRESSURE, *GAIN), outcome(GUIDED, 0.0, 0.1, 0.0)]
    harming = outcome(PRESSURE, 9.0, 10.0, 11.0)
    said = page.answer(studied(only_today, [harming]))
    assert said.startswith("Today max-pressure signals would save 10.0")
    assert said.endswith("with more traffic harm, or leave more trips unserved.")
    said = page.answer(studied(only_today, [harming, outcome(GUIDED, *GAIN)]))
    assert said.startswith("Today max-pressure signals would save 10.0")
    assert " With more traffic guidance would save 10.0" in said
    assert page.answer(studied([outcome(PRESSURE, *GAIN)])).startswith("Yes: max-pressure")


def test_the_next_line_follows_from_the_verdict():
    nothing = [outcome(PRESSURE, 0.0, 0.1, 0.0)]
    assert page.next_line(studied(nothing)).endswith("keep the signals as they are.")
    gain = page.next_line(studied(nothing, [outcome(PRESSURE, *GAIN)]))
    assert gain.endswith(f"--controller {PRESSURE} --against no-control --demand 1.3")
    undecided = studied([outcome(PRESSURE, -20.0, 6.0, -10.0, -12.0)])
    needed = undecided.levels[0].outcomes[0].verdict.needed
    assert f"--most-seeds {needed}" in page.next_line(undecided)
    assert page.answer(undecided).startswith("Cannot say yet: max-pressure signals")


@pytest.mark.parametrize(
    "completed, broken, under",
    [
        ([60, 80, 100, 90], 1.15, 1.0),
        ([60, 50, 40], 0.8, 1.0),  # broken below its own demand, which is run all the same
        ([60, 80, 100, 110, 120, 115], 1.45, 1.3),
        (range(60, 70), None, 2.0),
    ],
)
def test_a_study_loads_as_identify_does(completed, broken, under):
    done = []

    class Runner:
        workers = 1

        def done(self, names, levels, seeds):
            done.extend(levels)
            rows = {"demand": levels, "trips": 200, "removed_veh": 0}
            return pd.DataFrame(rows | {"completed_veh": completed[len(done) - 1]})

    load = stages.loading(Runner())
    assert (load.broken, load.under) == (broken, under)
    assert len(done) == len(completed) == len(load.left)


def test_more_seeds_at_most_double():
    far = replace(judge((-20.0, 6.0, -10.0)), needed=80)
    near = replace(far, needed=4)
    assert stages.more_seeds(3, [far], 10) == 6
    assert stages.more_seeds(3, [far, near], 10) == 4
    assert stages.more_seeds(6, [far], 10) == 10


@pytest.mark.slow
def test_from_a_sumo_configuration_to_a_page(tmp_path, out, monkeypatch):
    monkeypatch.setattr(stages, "LEVELS", (1.0,))
    for name in [*EVERYWHERE]:
        if name != PRESSURE:
            monkeypatch.delitem(EVERYWHERE, name)
    source = tiny_city.city(tmp_path)
    text = good(cosim("study", source, "--most-seeds 3 --workers 2 --out", out))
    labels = ", ".join(AT_CRITICAL.values())
    empty = "every region was nearly empty in all runs without control"
    assert f"{labels}: not judged; {empty}" in " ".join(text.split())  # over two lines
    assert "The critical accumulations of the regions were not measured." in text
    assert (out / "study.html").is_file()
    assert (out / "scenarios" / "city" / "scenario.toml").is_file()
