"""Figures of merit of a trajectory."""

import math
from collections import Counter

import numpy as np

from nmfd.arrays import PerRegion
from nmfd.types import Status, Trajectory

# What was not as it should be with decisions: column of summary.csv -> its heading in every table, and what it counts.
COUNTED = {
    "solver_failures": ("failures", "of the solver or policy"),
    "fallbacks": ("fallbacks", "controls of something behind the controller"),
    "late_decisions": ("late", "decisions after their deadline, at most the control interval"),
    "sensor_faults": ("sensor", "decisions on a wrong or missing measurement"),
    "plant_faults": ("plant", "intervals in which the city could not do what was commanded"),
}

# Columns of summary.csv: type, and what they say.
SUMMARY: dict[str, tuple[type, str]] = {
    "controller": (str, "the strategy"),
    "seed": (int, "of trips, drivers and guidance"),
    "plant": (str, "what was driven: a regional model, or the city in SUMO"),
    "total_time_spent_veh_s": (float, "running, waiting to enter, and as long as it could be of those removed"),
    "final_accumulation_veh": (float, "inside at the end"),
    "max_accumulation_veh": (float, "inside at the end of an interval, the most"),
    "completed_veh": (float, "trips that reached their end"),
    "evaluation_time_s": (float, "wall time of all decisions"),
    "control_step_ms_median": (float, "wall time of a decision"),
    "control_step_ms_max": (float, "of the longest decision"),
    **{column: (int, text) for column, (_, text) in COUNTED.items()},
}


def total_time_spent(trajectory: Trajectory) -> float:
    """dt * sum over k = 0 .. T-1 of all vehicles, running, waiting to enter, and removed before that [veh s].

    The objective of Tumu et al., with those who wait outside; the state at the end of the horizon is not counted. A
    vehicle that was removed on its way counts as if it were still there until the end of the horizon, the most that it
    could have spent: a trip that is not made never counts as less than one that is.

        >>> run = nmfd.run("economic_mpc", "no-control", steps=2)
        >>> bool(total_time_spent(run) == run.step * run.accumulation[:2].sum())  # nobody waits or was removed
        True
    """
    vehicles = trajectory.accumulation[:-1].sum() + trajectory.backlog[:-1].sum() + trajectory.removed[:-1].sum()
    return float(trajectory.step * vehicles)


def percent_change(value: float, reference: float) -> float:
    """How far `value` is above `reference` [%]; NaN, not defined, where that is 0.

    >>> percent_change(150.0, 100.0)
    50.0
    """
    return 100.0 * (value / reference - 1.0) if reference else math.nan


def gini(values: PerRegion, weights: PerRegion) -> float:
    """Gini coefficient of `values` (N,), none below 0, each that of `weights` (N,) people:

        G = sum_ij w_i w_j |v_i - v_j| / (2 W sum_i w_i v_i), W = sum_i w_i

    0 where all have the same, nearly 1 where few have everything; NaN of nobody.

        >>> float(gini(np.array([0.0, 100.0]), np.array([1.0, 1.0])))
        0.5
    """
    people, total = weights.sum(), (weights * values).sum()
    if not total:
        return 0.0 if people else math.nan
    apart = np.abs(values[:, None] - values[None, :])
    return float(weights @ apart @ weights / (2.0 * people * total))


def decisions(trajectory: Trajectory, kind: Status) -> int:
    """How many decisions have `kind` in their status."""
    return int(((trajectory.status & kind.value) != 0).sum())


def late_decisions(trajectory: Trajectory) -> int:
    """Decisions that took longer than the control interval or their own deadline, by the wall clock."""
    return int(((trajectory.decision_time > trajectory.step) | (trajectory.status & Status.LATE.value != 0)).sum())


def notes(trajectory: Trajectory, most: int = 3) -> str:
    """What was said of the decisions that were not OK, the `most` frequent ones, such as "2 x solver failed: ..."."""
    counted = Counter(note for note, status in zip(trajectory.note, trajectory.status, strict=True) if status)
    return "; ".join(f"{count} x {note}" for note, count in counted.most_common(most))


def summary(trajectory: Trajectory) -> dict[str, float | int | str]:
    """One row of summary.csv: column (with its unit in the name) -> value, such as "total_time_spent_veh_s".

    >>> round(summary(nmfd.run("economic_mpc", "no-control", steps=20))["max_accumulation_veh"])
    12558
    """
    total = trajectory.accumulation.sum(axis=(1, 2))
    decision_ms = 1e3 * trajectory.decision_time
    return {
        "controller": trajectory.controller,
        "seed": trajectory.seed,
        "plant": trajectory.plant,
        "total_time_spent_veh_s": total_time_spent(trajectory),
        "final_accumulation_veh": float(total[-1]),
        "max_accumulation_veh": float(total.max()),
        "completed_veh": float(trajectory.completed[-1]),
        "evaluation_time_s": float(trajectory.decision_time.sum()),
        "control_step_ms_median": float(np.median(decision_ms)),
        "control_step_ms_max": float(decision_ms.max()),
        "solver_failures": decisions(trajectory, Status.SOLVER_FAILURE),
        "fallbacks": decisions(trajectory, Status.FALLBACK),
        "late_decisions": late_decisions(trajectory),
        "sensor_faults": decisions(trajectory, Status.SENSOR_FAULT),
        "plant_faults": decisions(trajectory, Status.PLANT_FAULT),
    }
