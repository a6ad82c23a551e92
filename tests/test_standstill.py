"""When a standstill may be booked, and what is booked."""

import re
from pathlib import Path

import copies
import numpy as np
import pytest

from cosim.evaluation.simulate import Task, simulate
from cosim.plant.standstill import ERROR, LOOK, Standstill
from nmfd.metrics import total_time_spent
from nmfd.types import State


def first_booked(inside, waiting, left, trips, steps):
    """The control step from which on the rest is booked, of a run with these numbers of vehicles; None for none."""
    watched = Standstill(trips, 90.0, steps)
    for k in range(steps):
        state = State(step=k, time=90.0 * k, accumulation=np.array([[float(inside[k])]]),
                      backlog=np.array([[float(waiting[k])]]), completed=float(left[k]))
        if watched.reached(state, float(left[k])):
            return k
    return None


def test_a_lock_is_booked_once_all_trips_are_due_and_nobody_left_for_a_while():
    steps, trips = 40, 1000
    left = np.minimum(10 * np.arange(steps), 100)  # nobody after step 10
    due = np.minimum(50 * np.arange(steps), trips)  # nobody new after step 20
    waiting = np.full(steps, 100)
    assert first_booked(due - left - waiting, waiting, left, trips, steps) == 20
    assert first_booked(due - left - waiting, waiting, left, trips + 1, steps) is None


@pytest.mark.parametrize("inside, booked", [(100, False), (100_000, True)])
def test_what_still_leaves_must_not_matter(inside, booked):
    """One vehicle per interval leaves: 40 intervals of half of them would be wrong."""
    steps = 60
    left = np.arange(steps)
    at = first_booked(inside - left, 0 * left, left, inside, steps)
    assert at is not None  # near the end it never matters
    assert (at == LOOK) == booked
    rest = 90.0 * (steps - at)
    assert rest**2 / 2.0 / 90.0 <= ERROR * 90.0 * (inside * steps)


def test_an_empty_city_is_no_standstill():
    assert first_booked(np.zeros(20), np.zeros(20), np.full(20, 7), 7, 20) is None


@pytest.mark.slow
def test_a_locked_run_is_booked_within_a_thousandth(tmp_path):
    """Every signal of the centre is out of order and red: the city locks for certain."""
    folder = copies.peak(tmp_path)
    file = Path(folder, "scenario.toml")
    text = re.sub(r"ramp_up = [\d.]+|flat = [\d.]+|ramp_down = [\d.]+", lambda m: m[0].split("=")[0] + "= 400.0",
                  file.read_text())
    file.write_text(text)
    task = Task(scenario=folder, controller="no-control", seed=1030, demand_factor=2.5, steps=64)
    simulated = simulate(task)
    file.write_text(text.replace("[sumo]\n", "[sumo]\nbook_standstill = true\n"))
    booked = simulate(task)
    assert booked.facts["booked_intervals"] > 5 and simulated.facts["booked_intervals"] == 0
    first = 64 - booked.facts["booked_intervals"]
    for name in ("accumulation", "backlog"):
        np.testing.assert_array_equal(
            getattr(booked.trajectory, name)[: first + 1], getattr(simulated.trajectory, name)[: first + 1])
    assert total_time_spent(booked.trajectory) == pytest.approx(total_time_spent(simulated.trajectory), rel=1e-3)
    for column in ("mean_trip_time_s", "mean_departure_delay_s", "co2_kg", "fuel_kg"):
        assert booked.facts[column] == pytest.approx(simulated.facts[column], rel=0.01), column
    assert booked.record["edge_vehicles"].shape == simulated.record["edge_vehicles"].shape
    assert booked.record["departures"].sum() == simulated.record["departures"].sum()
