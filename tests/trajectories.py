"""Trajectories that nobody drove, for tests of what is made of them."""

import numpy as np

from nmfd.types import Trajectory


def made(**fields) -> Trajectory:
    """A Trajectory of `fields`; what they do not say is as in a run without noise, faults or failures."""
    steps = len(fields["perimeter"])
    usual = {
        "observed": fields["accumulation"], "observed_backlog": fields["backlog"], "estimated": False,
        "decision_time": np.zeros(steps), "status": np.zeros(steps, dtype=int), "note": ("",) * steps, "wall_time": 1.0}
    return Trajectory(**usual | fields)
