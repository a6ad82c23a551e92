"""When a standstill may be booked, and what is booked."""

import re
from pathlib import Path

import copies
import numpy as np
import pytest

from cosim.evaluation.simulate import Task, simulate
from cosim.plant.standstill import ERROR, LOOK, Standstill
from cosim.sumo.session import Session
from nmfd.metrics import total_time_spent
from nmfd.types import State


def first_booked(inside, waiting, left, trips, steps):
    """The control step from which on the rest is booked, of a run with these numbers of vehicles; None for none."""
    watched = Standstill(trips, 90.0, steps)
    for k in range(steps):
        state = State(
            step=k,
            time=90.0 * k,
            accumulation=np.array([[float(inside[k])]]),
            backlog=np.array([[float(waiting[k])]]),
            completed=float(left[k]),
        )
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


def test_what_is_booked(tmp_path, monkeypatch):
    """As if everybody stood from the second interval on: counts end, everybody spends time, and goes on emitting."""
    folder = copies.peak(tmp_path)
    file = Path(folder, "scenario.toml")
    file.write_text(re.sub(r"ramp_up = [\d.]+", "ramp_up = 60.0", file.read_text(encoding="utf-8")), encoding="utf-8")
    task = Task(scenario=folder, controller="no-control", seed=1030, demand_factor=0.3, steps=4)
    monkeypatch.setattr(Standstill, "reached", lambda self, state, left: state.step >= 2)
    monkeypatch.setattr(Session, "expected", lambda self: 0)
    simulated = simulate(task)
    text = file.read_text(encoding="utf-8").replace("[sumo]\n", "[sumo]\nbook_standstill = true\n")
    file.write_text(text, encoding="utf-8")
    booked = simulate(task)
    assert (simulated.data.attrs["booked_intervals"], booked.data.attrs["booked_intervals"]) == (0, 2)
    there, trajectory = simulated.accumulation, booked
    np.testing.assert_array_equal(trajectory.accumulation, there[[0, 1, 2, 2, 2]])
    inside, waiting = there[2].sum(), simulated.backlog[2].sum()
    assert inside > 0 and total_time_spent(trajectory) == 90.0 * (
        trajectory.accumulation[:4].sum() + trajectory.backlog[:4].sum()
    )
    for key in ("departures", "arrivals", "crossings", "gateway_flow"):
        assert not booked[key][2:].any(), key
        np.testing.assert_array_equal(booked[key][:2], simulated[key][:2], err_msg=key)
    np.testing.assert_array_equal(booked["edge_vehicles"][2:], booked["edge_vehicles"][[1, 1]])
    spent = booked.data.attrs["mean_trip_time_s"] * booked.data.attrs["departed_veh"]
    assert spent >= 180.0 * inside and booked.data.attrs["co2_kg"] > 0 and waiting >= 0
