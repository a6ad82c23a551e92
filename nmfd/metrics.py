"""Figures of merit of a run."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from nmfd.arrays import PerRegion, StatesOverTime
from nmfd.types import Result, Status

# Counts of decisions that are not OK: column -> its heading in every table, and its meaning.
COUNTED = {
    "solver_failures": ("failures", "of the solver, or decisions short of its tolerance"),
    "fallbacks": ("fallbacks", "controls of something behind the controller"),
    "late_decisions": ("late", "decisions after their deadline, at most the control interval"),
    "sensor_faults": ("sensor", "decisions on a wrong or missing measurement"),
    "plant_faults": ("plant", "intervals in which the city could not do what was commanded"),
}
KINDS = (
    Status.SOLVER_FAILURE,
    Status.FALLBACK,
    Status.LATE,
    Status.SENSOR_FAULT,
    Status.PLANT_FAULT,
)  # of COUNTED

# Attributes of a Result that are no column of a table of runs.
NO_COLUMNS = {
    "step",
    "estimated",
    "wall_time",
    "key",
    "scenario_folder",
    "version",
    "settings",
}


def total_time_spent(result: Result) -> float:
    """Return the total time spent [veh s].

    In a regional model dt * sum over k = 0 .. T-1 of all vehicles, the objective of Tumu et al.,
    with those that wait outside. In SUMO the sum over private vehicles, from the wanted departure
    to the end, the removal, or the end of the run, to the millisecond.

        >>> run = nmfd.run("economic_mpc", "no-control", steps=2)
        >>> bool(total_time_spent(run) == run.step * run["accumulation"][:2].sum())  # no vehicle waits or was removed
        True
    """
    return result.total_time_spent


def largest_accumulation(states: Iterable[StatesOverTime]) -> PerRegion:
    """Return the largest accumulation (R,) [veh] of each region in any run. states: (T+1, R, R)
    [veh] of each run"""
    return np.max([x.sum(axis=2).max(axis=0) for x in states], axis=0)


def percent_change(value: float, reference: float) -> float:
    """Return the change from `reference` to `value` [%]; NaN if `reference` is 0.

    >>> percent_change(150.0, 100.0)
    50.0
    """
    return 100.0 * (value / reference - 1.0) if reference else math.nan


def decision_ms(row: Mapping[str, float]) -> str:
    """Return the processor times [ms] of the first, the median and the longest decision of a row as
    text."""
    return " / ".join(
        f"{row[f'control_step_ms_{which}']:.3g}" for which in ("first", "median", "max")
    )


def notes(result: Result) -> str:
    """Return the three most frequent notes of decisions that were not OK, such as "2 x solver
    failed: ..."."""
    counted = Counter(
        note for note, status in zip(result["note"], result["status"], strict=True) if status
    )
    return "; ".join(f"{count} x {note}" for note, count in counted.most_common(3))


def summary(result: Result) -> dict[str, float | int | str]:
    """Return one row of a table of runs: the figures of merit and all scalar facts of the run.

    >>> round(summary(nmfd.run("economic_mpc", "no-control", steps=20))["max_accumulation_veh"])
    12558
    """
    facts = {name: value for name, value in result.data.attrs.items() if name not in NO_COLUMNS}
    if "accumulation" not in result:
        return facts
    total = result["accumulation"].sum(axis=(1, 2))
    decision_ms = 1e3 * result["decision_time"]
    return {
        **{name: facts.pop(name) for name in ("controller", "seed", "plant")},
        "total_time_spent_veh_s": total_time_spent(result),
        "final_accumulation_veh": float(total[-1]),  # inside at the end
        "max_accumulation_veh": float(total.max()),  # inside at the end of an interval, the most
        "completed_veh": float(
            facts.pop("completed_veh", result["completed"][-1])
        ),  # trips that reached their end
        "evaluation_time_s": float(
            result["decision_time"].sum()
        ),  # processor time of all decisions, of all threads
        "control_step_ms_first": float(decision_ms[0]),
        "control_step_ms_median": float(np.median(decision_ms)),
        "control_step_ms_max": float(decision_ms.max()),
        **{
            name: int(((result["status"] & kind.value) != 0).sum())
            for name, kind in zip(COUNTED, KINDS, strict=True)
        },
        "wall_time_s": float(result.wall_time),
        **facts,
    }
