"""What plants, controllers and the closed loop hand to one another."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from nmfd.quantities import quantity, variables

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


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
    wall_time: of the whole loop [s]
    """

    controller: str
    plant: str
    seed: int
    step: float
    wall_time: float
    accumulation: np.ndarray = quantity("time", "region", "destination", unit="veh", text="vehicles inside")
    backlog: np.ndarray = quantity("time", "region", "destination", unit="veh", text="vehicles waiting to enter")
    completed: np.ndarray = quantity("time", unit="veh", text="trips ended, cumulative")
    perimeter: np.ndarray = quantity(
        "interval", "region", "next_region", unit="1",
        text="share of the desired transfer flow that may pass; 0 between regions that are not adjacent")
    splits: np.ndarray = quantity(
        "interval", "region", "next_region", "destination", unit="1",
        text="share of the vehicles that heads for the next region; nominal where there was no route guidance")
    decision_time: np.ndarray = quantity("interval", unit="s", text="wall time of Controller.act; not in files")
    status: tuple[str, ...] = quantity("interval", unit="", text="ok, or the declared fallback", repr=False)
    estimate: np.ndarray | None = quantity(
        "time", "region", "destination", unit="veh", default=None,
        text="vehicles inside as the controller saw them, where the plant estimated them")

    @property
    def variables(self) -> dict[str, tuple]:
        """The arrays and their times as xarray.Dataset takes them: name -> (dimensions, array, attributes)."""
        times = self.step * np.arange(len(self.accumulation))
        return {
            "time": ("time", times, {"long_name": "time since the start", "units": "s"}),
            "interval": ("interval", times[:-1], {"long_name": "beginning of the interval", "units": "s"}),
            **variables(Trajectory, vars(self))}

    @property
    def labels(self) -> dict[str, str | int | float]:
        """What run this is: controller, plant, seed and step [s]."""
        return {name: getattr(self, name) for name in ("controller", "plant", "seed", "step")}

    def to_dataset(self) -> "xr.Dataset":
        """Everything but `wall_time`, with named dimensions, times in seconds, and units as attributes."""
        import xarray as xr  # with the pandas under it half a second of the start-up, which few commands need

        return xr.Dataset(self.variables, attrs=self.labels)

    def to_frame(self) -> "pd.DataFrame":
        """The states as a table: one row per time and pair of regions, (T+1) R R rows.

        Columns controller, plant, seed; time_s; region, destination (x_ij: in region i, bound for j);
        accumulation_veh; backlog_veh (waiting to enter region i).
        """
        return self._table({"time": "time_s", "accumulation": "accumulation_veh", "backlog": "backlog_veh"})

    def controls_frame(self) -> "pd.DataFrame":
        """The perimeter controls as a table: one row per control interval and pair of regions, T R R rows.

        Columns controller, plant, seed; time_s, when the interval begins; region, next_region (u_ih: from i to h);
        perimeter [-]; 0 between regions that are not adjacent.
        """
        return self._table({"interval": "time_s", "perimeter": "perimeter"})

    def _table(self, columns: dict[str, str]) -> "pd.DataFrame":
        data = self.to_dataset()
        rows = data[[name for name in columns if name in data.data_vars]].to_dataframe().reset_index()
        for place, name in enumerate(("controller", "plant", "seed")):
            rows.insert(place, name, getattr(self, name))
        return rows.rename(columns=columns)
