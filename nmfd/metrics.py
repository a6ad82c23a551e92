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
    "fallbacks": ("fallbacks", "decisions replaced by the controller's fallback"),
    "late_decisions": ("late", "decisions after their deadline, at most the control interval"),
    "sensor_faults": ("sensor", "decisions on a wrong or missing measurement"),
    "plant_faults": ("plant", "intervals in which the city could not do what was commanded"),
}
# The status that each of COUNTED counts.
KINDS = (
    Status.SOLVER_FAILURE,
    Status.FALLBACK,
    Status.LATE,
    Status.SENSOR_FAULT,
    Status.PLANT_FAULT,
)

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

    In a regional model: dt * sum over k = 0 .. T-1 of all vehicles, also those that wait outside,
    the objective of Tumu et al. In SUMO: the sum over private vehicles, to the millisecond, from
    the wanted departure to the end of the trip, the removal, or the end of the run.

        >>> run = nmfd.run("economic_mpc", "no-control", steps=2)
        >>> inside = run["accumulation"][:2].sum()  # no vehicle waits or was removed
        >>> bool(total_time_spent(run) == run.step * inside)
        True
    """
    return result.total_time_spent


def largest_accumulation(states: Iterable[StatesOverTime]) -> PerRegion:
    """Return the largest accumulation (R,) [veh] of each region in any run.

    states: accumulations of each run (veh, (T+1, R, R))
    """
    return np.max([x.sum(axis=2).max(axis=0) for x in states], axis=0)


def percent_change(value: float, reference: float) -> float:
    """Return the change from a reference [%]; NaN if the reference is 0.

    >>> percent_change(150.0, 100.0)
    50.0
    """
    if not reference:
        return math.nan
    return 100.0 * (value / reference - 1.0)


def decision_ms(row: Mapping[str, float]) -> str:
    """Return the processor times [ms] of decisions as text.

    They are those of the first, the median and the longest decision of a row of `summary`.
    """
    times = [row[f"control_step_ms_{which}"] for which in ("first", "median", "max")]
    return " / ".join(f"{time:.3g}" for time in times)


def notes(result: Result) -> str:
    """Return the three most frequent notes of decisions that were not OK.

    An example: "2 x solver failed: ...; 1 x ...".
    """
    counted: Counter = Counter()
    for note, status in zip(result["note"], result["status"], strict=True):
        if status:
            counted[note] += 1
    return "; ".join(f"{count} x {note}" for note, count in counted.most_common(3))


def summary(result: Result) -> dict[str, float | int | str]:
    """Return the row of a run: figures of merit, and all scalar facts.

    >>> round(summary(nmfd.run("economic_mpc", "no-control", steps=20))["max_accumulation_veh"])
    12558
    """
    facts = {name: value for name, value in result.attrs.items() if name not in NO_COLUMNS}
    if "accumulation" not in result:
        return facts
    inside = result["accumulation"].sum(axis=(1, 2))
    decision_ms = 1e3 * result["decision_time"]
    row = {name: facts.pop(name) for name in ("controller", "seed", "plant")}
    row["total_time_spent_veh_s"] = total_time_spent(result)
    row["final_accumulation_veh"] = float(inside[-1])
    row["max_accumulation_veh"] = float(inside.max())  # at the ends of intervals
    row["completed_veh"] = float(facts.pop("completed_veh", result["completed"][-1]))
    row["gate_range"] = float(np.ptp(result["perimeter"], axis=0).max())
    row["price_range"] = float(np.ptp(result["prices"], axis=0).max())
    # Processor times, of all threads.
    row["evaluation_time_s"] = float(result["decision_time"].sum())
    row["control_step_ms_first"] = float(decision_ms[0])
    row["control_step_ms_median"] = float(np.median(decision_ms))
    row["control_step_ms_max"] = float(decision_ms.max())
    for name, kind in zip(COUNTED, KINDS, strict=True):
        row[name] = int(((result["status"] & kind.value) != 0).sum())
    row["wall_time_s"] = float(result.wall_time)
    return row | facts
