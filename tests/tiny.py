"""A scenario small enough for tests: two or three regions in a row, 0-1-2, twenty control
intervals."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nmfd.model.mfd import Mfd, PiecewiseLinear, trapezoid
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, Result

NETWORK = """
name = "{name}"

[perimeter]
min = 0.1
max = 0.9

[mfd]
a = 4.133e-9
b = -8.282e-6
c = 0.0042
jam = 1000.0
"""
REGION = """
[[regions]]
position = [{position}.0, 0.0]
adjacent = {adjacent}
"""
SCENARIO = """
name = "tiny"
network = "../network"
step = 30.0
steps = 20
protected = [1]

measurement_std = 0.5

[[demand]]
from = 0
to = 1
start = 0.0
peak = 2.0
ramp_up = 60.0
flat = 120.0
ramp_down = 60.0
"""
# A file with a controller of one's own, Mine: every gate half open.
CONTROLLER = """
import numpy as np
from nmfd import Controls
class Mine:
    def __init__(self, scenario):
        self.shape = scenario.network.adjacency.shape
    def reset(self, seed=0):
        pass
    def act(self, measurement):
        return Controls(perimeter=np.full(self.shape, 0.5, dtype=np.float32), splits=None)
"""


def row_network(regions: int = 2) -> str:
    """network.toml of `regions` regions in a row."""
    return NETWORK.format(name=f"row{regions}") + "".join(
        REGION.format(
            position=region, adjacent=[h for h in (region - 1, region + 1) if 0 <= h < regions]
        )
        for region in range(regions)
    )


def write(folder: Path, *, scenario: str = SCENARIO, network: str | None = None) -> Path:
    """The folder of a scenario in `folder`, its network beside it."""
    for name, text in (
        ("network", row_network() if network is None else network),
        ("scenario", scenario),
    ):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}.toml").write_text(text)
    return folder / "scenario"


def limited(network: RegionalModel, *, seed: int = 0) -> RegionalModel:
    """`network` with exit rates, detours, capacities and storage, all of a size that matters."""
    random, shape = np.random.default_rng(seed), network.adjacency.shape
    most = max(mfd.capacity for mfd in network.mfds)
    return replace(
        network,
        exit_rates=random.uniform(0.5, 1.5, shape),
        equal_ways=True,
        capacity=random.uniform(0.1, 0.6, shape) * most * network.adjacency,
        storage=random.uniform(0.8, 1.6, network.regions) * np.array([m.jam for m in network.mfds]),
    )


@dataclass(frozen=True, kw_only=True)
class Exponential(Mfd):
    """A kind of one's own: g = free n exp(-n / critical)."""

    free: float
    middle: float
    jam: float

    def rate_up_to_jam(self, accumulation, xp=np):
        return self.free * xp.exp(-accumulation / self.middle)


def mixed(network: RegionalModel) -> RegionalModel:
    """`network` with curves of all kinds, about as wide and high as its own."""
    jam, high = network.mfds[0].jam, network.mfds[0].capacity
    own = Exponential(free=np.e * high / (0.3 * jam), middle=0.3 * jam, jam=jam)
    flat = trapezoid(free=4.0 * high / jam, capacity=high, wave=2.0 * high / jam, jam=1.1 * jam)
    lines = PiecewiseLinear(
        accumulations=(0.2 * jam, 0.35 * jam, 0.6 * jam, jam),
        outflows=(0.8 * high, high, 0.7 * high, 0.1 * high),
    )
    others = own, flat, lines, replace(flat, outflows=(0.9 * high, high, 0.2 * high))
    return replace(network, mfds=(*others, *network.mfds)[: network.regions])


@dataclass
class Acting:
    """A controller that is a function of what it sees."""

    act: Callable
    name: str = "acting"

    def reset(self, seed=0):
        pass


def random_controls(random, network, batch=()):
    """Admissible perimeter (*batch, R, R) and splits (*batch, R, R, R)."""
    shape = (*batch, network.regions, network.regions)
    perimeter = random.uniform(network.u_min, network.u_max, shape) * network.adjacency
    splits = random.uniform(size=(*shape, network.regions)) ** 3 * network.split_mask
    sums = splits.sum(axis=-2, keepdims=True)
    return perimeter, splits / np.where(sums > 0, sums, 1.0)


def seen(accumulation, step: int = 0) -> Observation:
    """What is measured of (R, R) vehicles, with nobody outside."""
    return Observation(
        step=step,
        time=30.0 * step,
        accumulation=accumulation,
        backlog=np.zeros_like(accumulation),
    )


def part(scenario: Scenario, begin: int, steps: int) -> Scenario:
    """`steps` intervals of a scenario, from its interval `begin` on."""
    return replace(scenario, steps=steps, demand=scenario.demand[begin : begin + steps])


def gates_at(scenario: Scenario, u: float) -> Controls:
    """All gates at u."""
    return Controls(perimeter=np.where(scenario.network.adjacency, u, 0.0))


def made(**fields) -> Result:
    """A Result of `fields`, by default of a run without noise, faults or failures."""
    steps = len(fields["perimeter"])
    usual = {
        "observed": fields["accumulation"],
        "observed_backlog": fields["backlog"],
        "removed": np.zeros_like(fields["backlog"]),
        "prices": np.zeros(fields["perimeter"].shape[:2]),
        "estimated": False,
        "decision_time": np.zeros(steps),
        "status": np.zeros(steps, dtype=int),
        "note": ("",) * steps,
        "wall_time": 1.0,
    }
    values = usual | fields
    attrs = {
        name: values.pop(name)
        for name in ("controller", "plant", "seed", "step", "estimated", "wall_time")
    }
    return Result.make(attrs, **values)
