"""Types that plants, controllers and the closed loop exchange."""

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Flag
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.errors import InputError, uninterrupted

if TYPE_CHECKING:
    import xarray


class Status(Flag):
    """Status of one decision: OK, or a combination of these.

    `Controls.note` gives the reason.

    SOLVER_FAILURE: the solver failed, diverged or stopped short of its tolerance
    FALLBACK: the controls are those of a fallback, not of the controller
    SENSOR_FAULT: the observation was wrong, late or incomplete
    PLANT_FAULT: the city could not execute the command, or was not whole, during the interval
    LATE: the decision took longer than the control interval, or than the controller's own
        `deadline` (s)

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
    """True state of a plant at the start of control interval `step`.

    Controllers get an Observation instead.

    step: k = 0, 1, ...
    time: since the start (s)
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j; zero
        in the NMFD
    completed: completed trips since the start [veh]
    removed: (R, R) [veh], [i, j] = removed from the simulation in i, or before they entered it, on
        their way to j, since the start; None for zero, as in the NMFD
    problem: the part of the last command that the plant could not execute, "" if none
    realised: (R, R) [-], u that passed in the last interval, where that may differ from the
        command; None before the first one, and in regional plants, which do what is commanded
    """

    step: int
    time: float
    accumulation: PerPair
    backlog: PerPair
    completed: float
    removed: PerPair | None = None
    problem: str = ""
    realised: PerPair | None = None

    @property
    def unfinished(self) -> PerPair:
        """Return the vehicles that spend time (veh, (R, R)).

        They run, wait to enter, or were removed (nmfd.metrics).
        """
        spending = self.accumulation + self.backlog
        if self.removed is None:
            return spending
        return spending + self.removed


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Input of a controller at the start of control interval `step`.

    It has noise and faults, or is an estimate.

    step, time: those of the State
    accumulation: (R, R) [veh], [i, j] = in region i bound for j
    backlog: (R, R) [veh], [i, j] = waiting outside the network to enter region i, bound for j
    realised: that of the State, from the signals
    """

    step: int
    time: float
    accumulation: PerPair
    backlog: PerPair
    realised: PerPair | None = None


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Command of a controller for one control interval.

    `Controls(perimeter=u)` is enough.

    perimeter: u_ih, share of the desired transfer flow from i to h that may pass
        (-, (R, R) [i, h]); ignored where h is not adjacent to i
    splits: theta_ihj, share of the vehicles in i bound for j that head for h (-, (R, R, R)
        [i, h, j]); None without route guidance: drivers keep their routes (in the regional model
        the nominal splits)
    status: OK, or the reasons why these are other controls
    note: the status in words, "" if OK
    prices: added share of the travel time through region i that guided drivers bound for other
        regions see (-, (R,)), such as 1 for twice as long. In a city, guidance by these travel
        times replaces `splits`; the regional model takes `splits`. None: no prices
    metering: largest rate of trips that may begin in region i (veh/s, (R,)); further trips wait
        outside, in the backlog. Only cities with `+metering` obey it. None: no limit
    """

    perimeter: PerPair
    splits: PerTurn | None = None
    status: Status = Status.OK
    note: str = ""
    prices: PerRegion | None = None
    metering: PerRegion | None = None


@runtime_checkable
class Plant(Protocol):
    """City, regional or microscopic.

    `step` is one control interval. A method `close` releases what the plant holds. A plant whose
    drivers answer `Controls.prices` instead of obeying `splits` has `guides_by_prices` True.
    """

    def reset(self, seed: int) -> State:
        """Start again from the beginning."""

    def step(self, controls: Controls) -> State:
        """Apply `controls` for one control interval; return the state at its end."""

    def observe(self) -> Observation | None:
        """Return the estimate of the plant's own instruments.

        It is None without any; the state is then measured with noise.
        """


@runtime_checkable
class Controller(Protocol):
    """Function from observations to controls, with a state of its own."""

    name: str

    def reset(self, seed: int = 0) -> None:
        """Start a new run; all random draws follow from `seed`."""

    def act(self, observation: Observation) -> Controls:
        """Return the controls of the interval that begins now.

        observation: the controller's own copy
        """


class Quantity(NamedTuple):
    """Named axes, unit ("" of texts) and meaning of a variable of a Result."""

    dimensions: tuple[str, ...]
    unit: str
    text: str

    def variable(self, values: Any) -> tuple:
        """Return dimensions, array and attributes, as xarray.Dataset takes them."""
        array = np.asarray(values)
        if array.dtype.kind == "U":
            array = array.astype(object)  # as netCDF returns texts
        attributes = {"long_name": self.text}
        if self.unit:
            attributes["units"] = self.unit
        return self.dimensions, array, attributes


_PAIRS = ("time", "region", "destination")
_TURNS = ("interval", "region", "next_region", "destination")
VARIABLES: dict[str, Quantity] = {
    "accumulation": Quantity(_PAIRS, "veh", "vehicles inside"),
    "backlog": Quantity(_PAIRS, "veh", "vehicles waiting to enter"),
    "completed": Quantity(("time",), "veh", "completed trips, cumulative"),
    "removed": Quantity(_PAIRS, "veh", "vehicles removed on their way, cumulative"),
    "observed": Quantity(_PAIRS, "veh", "vehicles inside as observed by the controller"),
    "observed_backlog": Quantity(
        _PAIRS, "veh", "vehicles waiting to enter as observed by the controller"
    ),
    "perimeter": Quantity(
        _TURNS[:3], "1", "share of the desired transfer flow that may pass; 0 if not adjacent"
    ),
    "splits": Quantity(
        _TURNS, "1", "share of vehicles that heads for the next region; nominal without guidance"
    ),
    "prices": Quantity(
        ("interval", "region"), "1", "added share of the travel time through the region"
    ),
    "status": Quantity(("interval",), "1", "status of the decision, 0 if OK (nmfd.types.Status)"),
    "note": Quantity(("interval",), "", "the status in words"),
    "decision_time": Quantity(
        ("interval",), "s", "processor time of Controller.act, of all threads of the process"
    ),
}
# Of a run in which drivers answered prices instead of obeying splits.
EXPECTED = {
    "expected_splits": Quantity(
        _TURNS,
        "1",
        "splits, or with prices the drivers' answer that the controller's model expects",
    )
}
SHOWN_FACTS = 30  # in the representation of a result
SHOWN_CHARACTERS = 60  # of a fact
# These differ between two runs of the same seed.
HOST_TIMES = ("decision_time", "wall_time", "sumo_time_s", "setup_time_s", "overhead_share")


@dataclass(frozen=True, eq=False)
class Result:
    """One closed-loop run of T control intervals, as a Dataset.

    data: variables over time (T+1 states), interval (T decisions), region, next_region and
        destination; in SUMO over gateway and edge, too. Attributes: controller, plant, seed, step
        (s), estimated (0 or 1), wall_time (s), scenario, version, settings (JSON), and all scalar
        facts of the run

    `result.accumulation` is the labelled array of that variable, `result["accumulation"]` its
    values, `result.seed` the attribute of that name; `dir(result)` lists them.
    """

    data: "xarray.Dataset"

    @property
    def accumulation(self) -> "xarray.DataArray":
        """Vehicles inside (veh, (T+1, R, R))."""
        return self.data["accumulation"]

    @property
    def backlog(self) -> "xarray.DataArray":
        """Vehicles waiting to enter (veh, (T+1, R, R))."""
        return self.data["backlog"]

    @property
    def completed(self) -> "xarray.DataArray":
        """Completed trips since the start (veh, (T+1,))."""
        return self.data["completed"]

    @property
    def observed(self) -> "xarray.DataArray":
        """Vehicles inside as the controller observed them (veh, (T+1, R, R))."""
        return self.data["observed"]

    @property
    def perimeter(self) -> "xarray.DataArray":
        """Commanded shares of the transfer flows (-, (T, R, R))."""
        return self.data["perimeter"]

    @property
    def splits(self) -> "xarray.DataArray":
        """Commanded split ratios, nominal without guidance (-, (T, R, R, R))."""
        return self.data["splits"]

    @property
    def status(self) -> "xarray.DataArray":
        """Status of every decision, 0 if OK (nmfd.Status, (T,))."""
        return self.data["status"]

    @property
    def controller(self) -> str:
        """Name of the controller."""
        return self.data.attrs["controller"]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.data.attrs["seed"]

    @property
    def step(self) -> float:
        """Control interval (s)."""
        return self.data.attrs["step"]

    @property
    def sizes(self) -> Mapping[str, int]:
        """Length of every dimension."""
        return {str(name): size for name, size in self.data.sizes.items()}

    @property
    def total_time_spent(self) -> float:
        """Total time spent (veh s); see nmfd.metrics.total_time_spent."""
        if "time_spent" in self:
            return float(self["time_spent"].sum())
        vehicles = self["accumulation"][:-1].sum() + self["backlog"][:-1].sum()
        return float(self.step * (vehicles + self["removed"][:-1].sum()))

    @property
    def completed_trips(self) -> float:
        """Trips that reached their end (veh)."""
        return float(self.data.attrs.get("completed_veh", self["completed"][-1]))

    @classmethod
    def make(
        cls, attrs: Mapping[str, Any], region_names: Sequence[str] = (), **arrays: Any
    ) -> "Result":
        """Return the result of a closed loop.

        attrs: facts of the run
        arrays: those of VARIABLES
        """
        import xarray  # half a second, which few commands need

        times = attrs["step"] * np.arange(len(arrays["accumulation"]))
        coordinates: dict[str, tuple] = {
            "time": Quantity(("time",), "s", "time since the start").variable(times),
            "interval": Quantity(("interval",), "s", "beginning of the interval").variable(
                times[:-1]
            ),
        }
        for name in ("region", "next_region", "destination"):
            numbers = np.arange(arrays["accumulation"].shape[1])
            coordinates[name] = Quantity((name,), "1", "number of the region").variable(numbers)
        if len(region_names):
            names = Quantity(("region",), "", "name of the region").variable(region_names)
            coordinates["region_name"] = names
        variables = {name: about.variable(arrays[name]) for name, about in VARIABLES.items()}
        return cls(xarray.Dataset(variables, coordinates, dict(attrs)))

    @classmethod
    def read(cls, path: Path | str, only: Collection[str] | None = None) -> "Result":
        """Return the result in the netCDF file `path`.

        only: arrays to read, of those that the file has, without coordinates; all if None, which
            takes three times as long
        Raises: InputError if the file is missing, or damaged
        """
        import xarray

        try:
            with uninterrupted():
                if only is None:
                    data = xarray.load_dataset(
                        path, engine="scipy", decode_times=False, mask_and_scale=False, mmap=False
                    )
                else:
                    data = _some_arrays(path, only)
                data = _with_empty(data, only)
        except FileNotFoundError:
            raise InputError(f"{path}: no such run") from None
        except Exception as error:
            reason = str(error).partition("\n")[0]
            raise InputError(
                f"{path}: is no run of this version ({reason}); delete it and run again"
            ) from None
        for name, value in data.attrs.items():
            if isinstance(value, np.generic):
                data.attrs[name] = value.item()
        return cls(data)

    def write(self, path: Path | str) -> None:
        """Write the Dataset to the netCDF file `path`, whole or not at all."""
        data = self.data.copy()
        for name, value in data.attrs.items():
            if isinstance(value, bool):  # netCDF has no such type
                data.attrs[name] = int(value)
        empty = {}
        for name, variable in data.variables.items():
            if variable.size == 0:  # scipy cannot read it back
                empty[name] = variable.dims, variable.shape, variable.dtype.str, variable.attrs
            if variable.dtype == np.float16:  # nor this one
                data[name] = variable.astype(np.float32)
        data = data.drop_vars(empty)
        data.attrs["empty"] = json.dumps(empty)
        encoding = {name: {"_FillValue": None} for name in data.variables}
        path = Path(path)
        temporary = path.with_name(f".{path.stem}-{os.getpid()}.tmp")
        try:
            with uninterrupted():  # xarray would keep its lock for ever
                data.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT", encoding=encoding)
                os.replace(temporary, path)
        except OSError as error:  # which does not name the file
            raise InputError(f"{path}: cannot be written ({error})") from None
        finally:
            temporary.unlink(missing_ok=True)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "data":
            raise AttributeError(name)
        if name in self.data.variables:
            return self.data[name]
        if name in self.data.attrs:
            return self.data.attrs[name]
        raise AttributeError(f"result without variable or attribute {name!r}")

    def __dir__(self) -> list[str]:
        names = {*super().__dir__(), *map(str, self.data.variables), *map(str, self.data.attrs)}
        return sorted(names)

    def __repr__(self) -> str:
        lengths = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        facts = "\n".join(f"    {name}: {value}" for name, value in self._shown().items())
        return f"Result of {self.data.attrs.get('controller', '?')} over {lengths}\n{facts}"

    def _shown(self) -> dict[str, str]:
        """Return facts for a screen: total time spent, and short attributes."""
        shown = {}
        if "accumulation" in self:
            shown["total_time_spent"] = f"{self.total_time_spent:.6g} veh s"
            shown["completed_trips"] = f"{self.completed_trips:,.0f}"
        for name, value in self.data.attrs.items():
            if len(shown) < SHOWN_FACTS and len(str(value)) <= SHOWN_CHARACTERS:
                text = f"{value:g}" if isinstance(value, float) else str(value)
                shown.setdefault(str(name), text)
        return shown

    def __getitem__(self, name: str) -> np.ndarray:
        return self.data.variables[name].values

    def __contains__(self, name: str) -> bool:
        return name in self.data.variables

    def assign(self, **values: Any) -> "Result":
        """Return the result with other arrays or other attributes."""
        data = self.data.copy()
        for name, value in values.items():
            if name in data.variables:
                data[name] = (data[name].dims, np.asarray(value), data[name].attrs)
            else:
                data.attrs[name] = value
        return Result(data)

    def add(
        self, attrs: Mapping[str, Any], about: Mapping[str, Quantity] = {}, **arrays: np.ndarray
    ) -> "Result":
        """Return the result with more attributes and arrays.

        about: name of an array -> its axes, unit and meaning
        """
        variables = {}
        for name, quantity in about.items():
            if name in arrays:
                variables[name] = quantity.variable(arrays[name])
        return Result(self.data.assign(variables).assign_attrs(attrs))

    def label(self, **names: Sequence[str]) -> "Result":
        """Return the result with names of the entries of some dimensions.

        names: `gateway` or `edge` -> names
        """
        coordinates = {}
        for dimension, values in names.items():
            about = Quantity((dimension,), "", f"name of the {dimension}")
            coordinates[dimension] = about.variable(values)
        return Result(self.data.assign_coords(coordinates))

    def without_times(self) -> "xarray.Dataset":
        """Return the Dataset without wall times and key.

        It is the same for every run of the same seed.
        """
        data = self.data.drop_vars(HOST_TIMES, errors="ignore")
        for name in (*HOST_TIMES, "key"):
            data.attrs.pop(name, None)
        return data

    def _repr_html_(self) -> str:
        return self.data._repr_html_()


def _some_arrays(path: Path | str, names: Collection[str]) -> "xarray.Dataset":
    """Return arrays of numbers of a netCDF file, and its attributes."""
    from xarray import Dataset
    from xarray.backends import ScipyDataStore

    with ScipyDataStore(str(path), mmap=False) as store:
        there = store.ds.variables
        arrays = {
            name: store.open_store_variable(name, there[name]).load()
            for name in names
            if name in there
        }
        return Dataset(arrays, attrs=store.get_attrs())


def _with_empty(data: "xarray.Dataset", only: Collection[str] | None) -> "xarray.Dataset":
    """Return the Dataset with its arrays of length 0, which are kept in an attribute."""
    empty = json.loads(data.attrs.pop("empty", "{}"))
    for name, (dimensions, shape, dtype, attrs) in empty.items():
        if only is None or name in only:
            data[name] = dimensions, np.zeros(shape, dtype), attrs
    return data
