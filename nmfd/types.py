"""What plants, controllers and the closed loop hand to one another."""

from dataclasses import dataclass, field
from enum import Flag
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    import pandas as pd


class Status(Flag):
    """What was not as it should be with one decision: OK, or several of these together. `Controls.note` says why.

    SOLVER_FAILURE: what computes the controls gave no answer that it vouches for: a solver that failed, diverged or
        stopped short of its tolerance, a policy or controller whose numbers are none
    FALLBACK: the controls are not those of the controller that was asked for, but of something behind it
    SENSOR_FAULT: the controller was given a wrong, late or incomplete observation
    PLANT_FAULT: the city could not do what was commanded, or was not whole, during the interval

    Decisions that took longer than the control interval are no status, for wall times are not part of a result: they
    are counted in the tables (nmfd.metrics.late_decisions).
    """

    OK = 0
    SOLVER_FAILURE = 1
    FALLBACK = 2
    SENSOR_FAULT = 4
    PLANT_FAULT = 8


@dataclass(frozen=True, kw_only=True)
class State:
    """What a plant is in at the start of control interval `step`: the truth, which only tables and pictures see.

    step: k = 0, 1, ...
    time: seconds since the start [s]
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j; zero in the NMFD
    completed: trips ended since the start [veh]
    problem: what the plant could not do in the interval that has just ended, "" if nothing
    """

    step: int
    time: float
    accumulation: np.ndarray
    backlog: np.ndarray
    completed: float
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a controller is given at the start of control interval `step`: with noise, with faults, or an estimate.

    step, time: as of the State
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j
    """

    step: int
    time: float
    accumulation: np.ndarray
    backlog: np.ndarray

    def copy(self) -> "Observation":
        """The same with arrays of its own."""
        return Observation(
            step=self.step, time=self.time, accumulation=self.accumulation.copy(), backlog=self.backlog.copy())


@dataclass(frozen=True, kw_only=True)
class Controls:
    """What a controller asks for during one control interval.

    perimeter: (R, R) [-], [i, h] = u_ih, share of the desired transfer flow from i to h that may pass;
        ignored where h is not adjacent to i
    splits: (R, R, R) [-], [i, h, j] = theta_ihj, share of the vehicles in i bound for j that head for h;
        None without route guidance: drivers keep the routes they have (in the regional model the nominal splits)
    status: OK, or what these controls are instead; note: the same in words, "" if OK
    """

    perimeter: np.ndarray
    splits: np.ndarray | None
    status: Status = Status.OK
    note: str = ""


class Plant(Protocol):
    """A city, regional or microscopic. `step` is one control interval."""

    def reset(self, seed: int) -> State:
        """Start again from the beginning."""

    def step(self, controls: Controls) -> State:
        """Apply `controls` for one control interval; the state at its end."""

    def observe(self) -> Observation | None:
        """What the plant's own instruments tell now; None where it has none, and the state itself is measured."""

    def close(self) -> None:
        """Release what the plant holds; nothing may be called afterwards but `reset`."""


class Controller(Protocol):
    """Anything that turns observations into controls."""

    name: str

    def reset(self, seed: int = 0) -> None:
        """Forget everything of an earlier run; what the controller draws by lot follows from `seed`."""

    def act(self, observation: Observation) -> Controls:
        """The controls of the interval that begins now. The arrays of `observation` are the controller's own."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One closed-loop run of T control intervals.

    controller, plant, seed
    step: control interval [s]
    accumulation: (T+1, R, R) [veh]
    backlog: (T+1, R, R) [veh]
    completed: (T+1,) [veh], cumulative
    observed: (T+1, R, R) [veh], the accumulation as the controller was given it; the last one it would have been
    observed_backlog: (T+1, R, R) [veh], the same of the backlog
    estimated: whether what was observed is an estimate of the plant's own instruments
    perimeter: (T, R, R) [-]
    splits: (T, R, R, R) [-]; the nominal splits where there was no route guidance
    decision_time: (T,) [s], wall time of `Controller.act`
    status: (T,) int, nmfd.types.Status of every decision; note: T strings, the same in words, "" if OK
    wall_time: of the whole loop [s]
    """

    controller: str
    plant: str
    seed: int
    step: float
    accumulation: np.ndarray
    backlog: np.ndarray
    completed: np.ndarray
    observed: np.ndarray
    observed_backlog: np.ndarray
    estimated: bool
    perimeter: np.ndarray
    splits: np.ndarray
    decision_time: np.ndarray
    status: np.ndarray
    note: tuple[str, ...] = field(repr=False)
    wall_time: float

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
