"""Figures of merit of a trajectory."""

import numpy as np

from nmfd.types import Trajectory


def total_time_spent(trajectory: Trajectory) -> float:
    """dt * sum over k = 0 .. T-1 of all vehicles, running and waiting to enter [veh s] (design.md, section 2)."""
    vehicles = trajectory.accumulation[:-1].sum() + trajectory.backlog[:-1].sum()
    return float(trajectory.step * vehicles)


def summary(trajectory: Trajectory) -> dict[str, float | int | str]:
    """One row of summary.csv: column (with its unit in the name) -> value, such as "total_time_spent_veh_s"."""
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
        "solver_failures": sum(status != "ok" for status in trajectory.status),
    }
