"""Trajectories that nobody drove, for tests of what is made of them."""

import numpy as np

from cosim.plant.record import Record
from nmfd.quantities import quantities
from nmfd.types import Trajectory


def made(**fields) -> Trajectory:
    """A Trajectory of `fields`; what they do not say is as in a run without noise, faults or failures."""
    steps = len(fields["perimeter"])
    usual = {
        "observed": fields["accumulation"], "observed_backlog": fields["backlog"], "estimated": False,
        "decision_time": np.zeros(steps), "status": np.zeros(steps, dtype=int), "note": ("",) * steps, "wall_time": 1.0}
    return Trajectory(**usual | fields)


def record(steps: int, *, regions: int, gateways: int = 3, edges: int = 5) -> dict[str, np.ndarray]:
    """The arrays of a Record, at random."""
    sizes, random = {"interval": steps, "gateway": gateways, "edge": edges}, np.random.default_rng(0)
    return {name: random.random([sizes.get(axis, regions) for axis in about["dimensions"]])
            for name, about in quantities(Record).items()}
