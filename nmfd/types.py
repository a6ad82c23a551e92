"""What plants, controllers and the closed loop hand to one another."""

from dataclasses import dataclass
from enum import Flag
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from nmfd.arrays import (
    Cumulative,
    Flags,
    Intervals,
    PairsOverTime,
    PerPair,
    PerRegion,
    PerTurn,
    RegionsOverTime,
    StatesOverTime,
    TurnsOverTime,
)
from nmfd.html import html_table
from nmfd.quantities import quantity, variables

if TYPE_CHECKING:
    import pandas
    import xarray


class Status(Flag):
    """What was not as it should be with one decision: OK, or several of these together. `Controls.note` says why.

    SOLVER_FAILURE: what computes the controls gave no answer that it vouches for: a solver that failed, diverged or
        stopped short of its tolerance, a policy or controller whose numbers are none
    FALLBACK: the controls are not those of the controller that was asked for, but of something behind it
    SENSOR_FAULT: the controller was given a wrong, late or incomplete observation
    PLANT_FAULT: the city could not do what was commanded, or was not whole, during the interval
    LATE: the decision took longer than the control interval, or than the controller's own `deadline` [s], by the clock
        of the closed loop. The only part of a run's file that depends on wall time

        >>> Status.FALLBACK in (Status.SOLVER_FAILURE | Status.FALLBACK)
        True
    """

    OK = 0
    SOLVER_FAILURE = 1
    FALLBACK = 2
    SENSOR_FAULT = 4
    PLANT_FAULT = 8
    LATE = 16


@dataclass(frozen=True, kw_only=True)
class State:
    """What a plant is in at the start of control interval `step`: the truth, which only tables and pictures see.

    step: k = 0, 1, ...
    time: seconds since the start [s]
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j; zero in the NMFD
    completed: trips that reached their end since the start [veh]
    removed: (R, R) [veh], [i, j] = taken out in i, or before they entered it, on their way to j, since the start: by
        whatever removes vehicles from a simulation; zero if None, as in the NMFD
    problem: what the plant could not do in the interval that has just ended, "" if nothing
    """

    step: int
    time: float
    accumulation: PerPair
    backlog: PerPair
    completed: float
    removed: PerPair | None = None
    problem: str = ""

    @property
    def unfinished(self) -> PerPair:
        """(R, R) [veh]: those that spend time: running, waiting to enter, and removed (nmfd.metrics)."""
        spending = self.accumulation + self.backlog
        return spending if self.removed is None else spending + self.removed


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a controller is given at the start of control interval `step`: with noise, with faults, or an estimate.

    step, time: as of the State
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j
    """

    step: int
    time: float
    accumulation: PerPair
    backlog: PerPair

    def copy(self) -> "Observation":
        """The same with arrays of its own."""
        return Observation(
            step=self.step, time=self.time, accumulation=self.accumulation.copy(), backlog=self.backlog.copy()
        )


@dataclass(frozen=True, kw_only=True)
class Controls:
    """What a controller asks for during one control interval.

    perimeter: (R, R) [-], [i, h] = u_ih, share of the desired transfer flow from i to h that may pass;
        ignored where h is not adjacent to i
    splits: (R, R, R) [-], [i, h, j] = theta_ihj, share of the vehicles in i bound for j that head for h;
        None without route guidance: drivers keep the routes they have (in the regional model the nominal splits)
    prices: (R,) [-], by how much longer than it is guided drivers who are bound for elsewhere are told that a way
        through region i takes: 1 for twice as long. In a city they are how `splits` come about: drivers are guided by
        these travel times, and shares are not commanded besides. The regional model takes `splits`. None: no prices
    metering: (R,) [veh/s], the most trips that may begin in region i; who is due beyond that waits outside, in the
        backlog. Only cities with `+metering` can do that. None: nobody is made to wait
    status: OK, or what these controls are instead; note: the same in words, "" if OK
    """

    perimeter: PerPair
    splits: PerTurn | None
    status: Status = Status.OK
    note: str = ""
    prices: PerRegion | None = None
    metering: PerRegion | None = None


@runtime_checkable
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


@runtime_checkable
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
    estimated: whether what was observed is an estimate of the plant's own instruments
    wall_time: of the whole loop [s]
    """

    controller: str
    plant: str
    seed: int
    step: float
    estimated: bool
    wall_time: float
    accumulation: StatesOverTime = quantity("time", "region", "destination", unit="veh", text="vehicles inside")
    backlog: StatesOverTime = quantity("time", "region", "destination", unit="veh", text="vehicles waiting to enter")
    completed: Cumulative = quantity("time", unit="veh", text="trips that reached their end, cumulative")
    observed: StatesOverTime = quantity(
        "time",
        "region",
        "destination",
        unit="veh",
        text="vehicles inside as the controller was given them; the last as it would have been",
    )
    observed_backlog: StatesOverTime = quantity(
        "time", "region", "destination", unit="veh", text="vehicles waiting to enter as the controller was given them"
    )
    perimeter: PairsOverTime = quantity(
        "interval",
        "region",
        "next_region",
        unit="1",
        text="share of the desired transfer flow that may pass; 0 between regions that are not adjacent",
    )
    splits: TurnsOverTime = quantity(
        "interval",
        "region",
        "next_region",
        "destination",
        unit="1",
        text="share of the vehicles that heads for the next region; nominal where there was no route guidance",
    )
    decision_time: Intervals = quantity("interval", unit="s", text="wall time of Controller.act; not in files")
    status: Flags = quantity(
        "interval",
        unit="1",
        text="what was not as it should be with the decision, 0 if nothing (nmfd.types.Status)",
        attributes={
            "flag_masks": [kind.value for kind in Status],
            "flag_meanings": " ".join(str(kind.name).lower() for kind in Status),
        },
    )
    note: tuple[str, ...] = quantity("interval", unit="", text="the status in words", repr=False)
    removed: StatesOverTime = quantity(
        "time", "region", "destination", unit="veh", text="vehicles taken out on their way, cumulative", default=None
    )
    prices: RegionsOverTime = quantity(
        "interval",
        "region",
        unit="1",
        text="by how much longer than it is drivers were told that a way through the region takes",
        default=None,
    )

    def __post_init__(self) -> None:
        """Nobody is removed, and nothing has a price, where nothing is said of it."""
        if self.removed is None:
            object.__setattr__(self, "removed", np.zeros_like(self.backlog))
        if self.prices is None:
            object.__setattr__(self, "prices", np.zeros(self.perimeter.shape[:2]))

    @property
    def variables(self) -> dict[str, tuple]:
        """The arrays and their times as xarray.Dataset takes them: name -> (dimensions, array, attributes)."""
        times = self.step * np.arange(len(self.accumulation))
        return {
            "time": ("time", times, {"long_name": "time since the start", "units": "s"}),
            "interval": ("interval", times[:-1], {"long_name": "beginning of the interval", "units": "s"}),
            **variables(Trajectory, vars(self)),
        }

    def _repr_html_(self) -> str:
        """Its regions, for notebooks."""
        present, names = self.accumulation + self.backlog + self.removed, [*range(self.accumulation.shape[1]), "all"]
        inside, waiting, spending = (
            np.column_stack([x.sum(axis=2), x.sum(axis=(1, 2))]).T for x in (self.accumulation, self.backlog, present)
        )
        lines = [
            [
                name,
                f"{x.mean():,.0f}",
                f"{x.max():,.0f}",
                f"{x[-1]:,.0f}",
                f"{queue.max():,.0f}",
                f"{self.step * spent[:-1].sum():.3e}",
            ]
            for name, x, queue, spent in zip(names, inside, waiting, spending, strict=True)
        ]
        return html_table(
            ["region", "mean [veh]", "most [veh]", "end [veh]", "most waiting [veh]", "time spent [veh s]"],
            lines,
            f"{self.controller}, plant {self.plant}, seed {self.seed}: {len(self.status)} control intervals of "
            f"{self.step:g} s, {self.completed[-1]:,.0f} trips completed, {int((self.status != 0).sum())} decisions "
            "not as they should be",
        )

    @property
    def labels(self) -> dict[str, str | int | float]:
        """What run this is: controller, plant, seed, step [s] and estimated (0 or 1)."""
        return {
            "controller": self.controller,
            "plant": self.plant,
            "seed": self.seed,
            "step": self.step,
            "estimated": int(self.estimated),
        }

    def to_xarray(self) -> "xarray.Dataset":
        """Everything but `wall_time`, with named dimensions, times in seconds, and units as attributes."""
        import xarray  # with the pandas under it half a second of the start-up, which few commands need

        return xarray.Dataset(self.variables, attrs=self.labels)

    to_dataset = to_xarray  # its name before

    def to_frame(self) -> "pandas.DataFrame":
        """The states as a table: one row per time and pair of regions, (T+1) R R rows.

        Columns controller, plant, seed; time_s; region, destination (x_ij: in region i, bound for j);
        accumulation_veh; backlog_veh (waiting to enter region i).

            >>> table = nmfd.run("economic_mpc", "no-control", steps=2).to_frame()
            >>> table.columns.tolist()[3:]
            ['time_s', 'region', 'destination', 'accumulation_veh', 'backlog_veh']
            >>> len(table) == 3 * 7 * 7
            True
        """
        return self._table({"time": "time_s", "accumulation": "accumulation_veh", "backlog": "backlog_veh"})

    def controls_frame(self) -> "pandas.DataFrame":
        """The perimeter controls as a table: one row per control interval and pair of regions, T R R rows.

        Columns controller, plant, seed; time_s, when the interval begins; region, next_region (u_ih: from i to h);
        perimeter [-]; 0 between regions that are not adjacent.
        """
        return self._table({"interval": "time_s", "perimeter": "perimeter"})

    def _table(self, columns: dict[str, str]) -> "pandas.DataFrame":
        data = self.to_xarray()
        rows = data[[name for name in columns if name in data.data_vars]].to_dataframe().reset_index()
        for place, name in enumerate(("controller", "plant", "seed")):
            rows.insert(place, name, getattr(self, name))
        return rows.rename(columns=columns)
