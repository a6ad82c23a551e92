"""What plants, controllers and the closed loop hand to one another."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What a controller sees at the start of control interval `step`.

    step: k = 0, 1, ...
    time: seconds since the start [s]
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j; zero in the NMFD
    estimate, estimated_backlog: (R, R) [veh], what a controller sees instead where the plant only estimates them
    problem: what the plant could not do in the interval that has just ended, "" if nothing
    """

    step: int
    time: float
    accumulation: np.ndarray
    backlog: np.ndarray
    estimate: np.ndarray | None = None
    estimated_backlog: np.ndarray | None = None
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class Controls:
    """What a controller asks for during one control interval.

    perimeter: (R, R) [-], [i, h] = u_ih, share of the desired transfer flow from i to h that may pass;
        ignored where h is not adjacent to i
    splits: (R, R, R) [-], [i, h, j] = theta_ihj, share of the vehicles in i bound for j that head for h;
        None without route guidance: drivers keep the routes they have (in the regional model the nominal splits)
    status: "ok", or why these controls are a fallback
    """

    perimeter: np.ndarray
    splits: np.ndarray | None
    status: str = "ok"


class Plant(Protocol):
    """A city, regional or microscopic. `step` is one control interval."""

    def reset(self, seed: int) -> Measurement:
        """Start again from the beginning; the exact state."""

    def step(self, controls: Controls) -> Measurement:
        """Apply `controls` for one control interval; the exact state at its end."""

    def completed(self) -> float:
        """Trips ended since the reset [veh]."""

    def close(self) -> None:
        """Release what the plant holds; nothing may be called afterwards but `reset`."""


class Controller(Protocol):
    """Anything that turns measurements into controls."""

    name: str

    def reset(self, seed: int = 0) -> None:
        """Forget everything of an earlier run; what the controller draws by lot follows from `seed`."""

    def act(self, measurement: Measurement) -> Controls:
        """The controls of the interval that begins now."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One closed-loop run of T control intervals.

    controller, plant, seed
    step: control interval [s]
    accumulation: (T+1, R, R) [veh]
    backlog: (T+1, R, R) [veh]
    completed: (T+1,) [veh], cumulative
    perimeter: (T, R, R) [-]
    splits: (T, R, R, R) [-]; the nominal splits where there was no route guidance
    decision_time: (T,) [s], wall time of `Controller.act`
    status: T strings, "ok" or the declared fallback
    wall_time: of the whole loop [s]
    estimate: (T+1, R, R) [veh], the accumulation that the controller saw where the plant estimated it, else None
    """

    controller: str
    plant: str
    seed: int
    step: float
    accumulation: np.ndarray
    backlog: np.ndarray
    completed: np.ndarray
    perimeter: np.ndarray
    splits: np.ndarray
    decision_time: np.ndarray
    status: tuple[str, ...] = field(repr=False)
    wall_time: float
    estimate: np.ndarray | None = None

    def to_frame(self) -> "pd.DataFrame":
        """The states as a table: one row per time and pair of regions, (T+1) R R rows.

        Columns controller, plant, seed; time_s; region, destination (x_ij: in region i, bound for j);
        accumulation_veh; backlog_veh (waiting to enter region i).
        """
        return self._table(self.accumulation, ("region", "destination"), {
            "accumulation_veh": self.accumulation, "backlog_veh": self.backlog})

    def controls_frame(self) -> "pd.DataFrame":
        """The perimeter controls as a table: one row per control interval and pair of regions, T R R rows.

        Columns controller, plant, seed; time_s, when the interval begins; region, next_region (u_ih: from i to h);
        perimeter [-]; 0 between regions that are not adjacent.
        """
        return self._table(self.perimeter, ("region", "next_region"), {"perimeter": self.perimeter})

    def _table(self, like: np.ndarray, axes: tuple[str, ...], values: dict[str, np.ndarray]) -> "pd.DataFrame":
        import pandas as pd

        interval, *regions = (index.ravel() for index in np.indices(like.shape))
        return pd.DataFrame({
            "controller": self.controller, "plant": self.plant, "seed": self.seed, "time_s": self.step * interval,
            **dict(zip(axes, regions, strict=True)), **{name: array.ravel() for name, array in values.items()}})
