"""cosim bound: what a schedule adds to a controller's commands, the search for the best one; SUMO is not started."""

import math
from functools import cache
from pathlib import Path

import copies
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from trajectories import in_city

from cosim.cli.main import main
from cosim.evaluation import bound, experiment
from cosim.evaluation.simulate import Task
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.controllers.scheduled import Scheduled, channels
from nmfd.errors import InputError
from nmfd.model.planning import planning_model
from nmfd.types import Controls, Observation

PEAK = Path(__file__).parents[1] / "scenarios" / "grid7_peak"
METERED = "dpc-pcrg+max-pressure+guidance-period-60+metering"
CENTRE, TRIPS = 3, 100


@pytest.fixture(scope="module")
def planning():
    return planning_model(load_scenario(PEAK))


class Fixed:
    """Commands the same all the time."""

    name, deadline = "fixed", 7.0

    def __init__(self, controls):
        self.controls, self.seed = controls, None

    def reset(self, seed=0):
        self.seed = seed

    def act(self, observation):
        return self.controls


def controls(planning, *, prices=None, metering=None):
    return Controls(
        perimeter=np.where(planning.network.adjacency, 0.5, 0.0), splits=None, prices=prices, metering=metering
    )


def act(controller, step):
    return controller.act(
        Observation(step=step, time=90.0 * step, accumulation=np.zeros((7, 7)), backlog=np.zeros((7, 7)))
    )


def test_gates_into_protected_regions_are_shifted_and_stay_within_their_bounds(planning):
    last = planning.steps - 1
    controller = Scheduled(Fixed(controls(planning)), {"gates": (0.0, 0.3, -9.0)}, planning)
    into = planning.network.adjacency[:, CENTRE]
    for step, expected in ((0, 0.5), (last / 4.0, 0.65), (last / 2.0, 0.8), (last, planning.network.u_min)):
        u = act(controller, step).perimeter
        assert u[into, CENTRE] == pytest.approx(expected)
        assert np.array_equal(np.delete(u, CENTRE, axis=1), np.delete(controls(planning).perimeter, CENTRE, axis=1))
        assert not u[~into, CENTRE].any()


def test_prices_of_protected_regions_are_raised_and_never_negative(planning):
    prices = np.full(7, 0.4)
    controller = Scheduled(Fixed(controls(planning, prices=prices)), {"prices": (-1.0, 1.0)}, planning)
    others = np.delete(np.arange(7), CENTRE)
    for step, expected in ((0, 0.0), (planning.steps - 1, 1.4)):
        told = act(controller, step).prices
        assert told[CENTRE] == pytest.approx(expected) and (told[others] == 0.4).all()
    assert (prices == 0.4).all()


def test_rates_are_multiplied_and_what_is_not_commanded_stays_so(planning):
    rates = np.arange(7.0)
    controller = Scheduled(
        Fixed(controls(planning, metering=rates)), {"entries": (math.log(2.0),), "prices": (1.0,)}, planning
    )
    now = act(controller, 5)
    assert now.metering == pytest.approx(2.0 * rates) and now.prices is None
    assert act(Scheduled(Fixed(controls(planning)), {"entries": (1.0,)}, planning), 5).metering is None


def test_a_schedule_of_zeros_is_the_controller_itself(planning):
    inner = Fixed(controls(planning, prices=np.full(7, 0.4), metering=np.ones(7)))
    controller = Scheduled(inner, dict.fromkeys(("gates", "prices", "entries"), (0.0,) * 6), planning)
    controller.reset(seed=5)
    now = act(controller, 17)
    assert inner.seed == 5 and (controller.name, controller.deadline) == ("fixed", 7.0)
    for name in ("perimeter", "prices", "metering"):
        assert np.array_equal(getattr(now, name), getattr(inner.controls, name))


def test_channels_are_those_that_the_controller_commands(planning):
    scenario = load_scenario(PEAK)
    found = {
        name: channels(registry.make(name, scenario), planning_model(scenario, name))
        for name in (METERED, "dpc-pcrg+max-pressure+guidance-period-60", "pi-gating")
    }
    assert found[METERED] == ("gates", "prices", "entries")
    assert found["dpc-pcrg+max-pressure+guidance-period-60"] == ("gates", "prices")
    assert found["pi-gating"] == ("gates",)
    open_city = load_scenario(Path(PEAK.parent, "economic_mpc"))
    assert channels(registry.make("no-control", open_city), planning_model(open_city)) == (
        ("gates",) if open_city.protected else ()
    )


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return copies.peak(tmp_path_factory.mktemp("city"))


@pytest.fixture
def runs(monkeypatch):
    """The tasks that are run; total time spent is lowest with gates 0.2 lower and prices 1 higher all the time."""
    tasks = []
    monkeypatch.setattr(experiment, "load_city", cache(experiment.load_city))
    monkeypatch.setattr(experiment, "read_signals", lambda city, *_: ([], []))
    monkeypatch.setattr(experiment, "check_strategy", lambda *_: None)

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
        for task in todo:
            tasks.append(task)
            schedule = dict(task.schedule)
            away = (
                np.square(np.add(schedule.get("gates", 0.0), 0.2)).mean()
                + np.square(np.subtract(schedule.get("prices", 0.0), 1.0)).mean()
            )
            yield (
                task,
                in_city(
                    task,
                    1e6
                    * task.demand_factor
                    * (2.0 if task.controller == "max-pressure" else 1.0 + 0.1 * away + task.seed / 1e6),
                    TRIPS,
                    TRIPS,
                ),
            )

    monkeypatch.setattr(experiment, "outcomes", outcomes)
    return tasks


def order(city, out, **others):
    chosen = {"candidates": 25, "knots": 1, "seeds": (1000, 1001), "levels": (1.6,)} | others
    return bound.Bound(scenario=city, controller="dpc-pcrg+max-pressure+guidance-period-60", out=out, **chosen)


def test_every_seed_has_a_search_that_begins_with_the_controller_itself(city, tmp_path, runs):
    ordered = order(city, tmp_path / "out", against="max-pressure")
    table = bound.bound(ordered)
    assert list(table["seed"]) == [1000, 1001] and (table["demand"] == 1.6).all() and (table["candidates"] == 25).all()
    first = [task for task in runs if task.seed == 1001][0]
    assert first.schedule == () and all(task.schedule for task in runs[1:25])
    assert {task.demand_factor for task in runs} == {1.6} and len(runs) == 2 * 25 + 2
    for row in table.to_dict("records"):
        floor = 1.6e6 * (1.0 + row["seed"] / 1e6)
        assert row["controller_veh_s"] == pytest.approx(floor + 1.6e6 * 0.104, rel=1e-6)
        assert floor <= row["bound_veh_s"] < floor + 1.6e6 * 0.01
        assert row["room_pct"] == pytest.approx(100.0 * (row["bound_veh_s"] / row["controller_veh_s"] - 1.0))
        saved = [3.2e6 - row[name] for name in ("controller_veh_s", "bound_veh_s")]
        assert row["against_veh_s"] == pytest.approx(3.2e6) and row["used_pct"] == pytest.approx(
            100.0 * saved[0] / saved[1]
        )
        assert row["prices[0]"] == pytest.approx(1.0, abs=0.35) and row["gates[0]"] == pytest.approx(-0.2, abs=0.25)
    kept = pd.read_csv(tmp_path / "out" / "bound.csv")
    pd.testing.assert_frame_equal(kept[list(table.columns)], table, check_exact=False)
    told = bound.text(ordered, table)
    assert "room" in told and f"{table['used_pct'].iloc[0]:.0f} %" in told


@pytest.mark.slow
def test_a_search_goes_on_with_more_candidates_as_if_it_had_not_ended(city, tmp_path, runs):
    whole = bound.bound(order(city, tmp_path / "whole", candidates=8))
    done = len(runs)
    bound.bound(order(city, tmp_path / "out", candidates=4))
    assert len(runs) == done + 8
    pd.testing.assert_frame_equal(bound.bound(order(city, tmp_path / "out", candidates=8)), whole)
    assert len(runs) == 2 * done
    with pytest.raises(InputError, match="another configuration"):
        bound.bound(order(city, tmp_path / "out", knots=3))


def test_runs_with_another_schedule_are_runs_of_another_controller(city, runs):
    task = Task(scenario=city, controller="pi-gating", seed=1000)
    plain = experiment.shared_configuration([task])
    added = experiment.shared_configuration(
        [Task(scenario=city, controller="pi-gating", seed=1000, schedule=(("gates", (0.1, 0.2)),))]
    )
    assert plain[0] == added[0] and plain[1] != added[1]


@pytest.mark.parametrize(("options", "said"), [({"knots": 11}, "--knots"), ({"against": "pi-gatin"}, "pi-gatin")])
def test_what_cannot_be_searched_is_said_before_anything_is_run(city, tmp_path, runs, options, said):
    with pytest.raises(InputError, match=said):
        bound.bound(order(city, tmp_path / "out", **options))
    assert not runs and not (tmp_path / "out").exists()


def test_controllers_without_anything_to_add_to_are_refused(city, tmp_path):
    own = tmp_path / "mine.py"
    own.write_text("class Mine: pass\n")
    for controller, said in ((f"{own}:Mine", "of your own"), ("dpc-pcgr", "dpc-pcrg")):
        answer = CliRunner().invoke(
            main, ["bound", str(city), "--controller", controller, "--out", str(tmp_path / "out")]
        )
        assert answer.exit_code and said in answer.output + str(answer.exception) and not (tmp_path / "out").exists()
