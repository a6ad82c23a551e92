"""Types that plants, controllers and the closed loop exchange."""

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Flag
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.errors import InputError

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


class Variable(NamedTuple):
    """Array of a Result, as xarray.Dataset takes it.

    attributes: long_name and, unless the values are texts, units
    """

    dimensions: tuple[str, ...]
    values: np.ndarray
    attributes: dict[str, str]


class Quantity(NamedTuple):
    """Named axes, unit ("" of texts) and meaning of a variable of a Result."""

    dimensions: tuple[str, ...]
    unit: str
    text: str

    def variable(self, values: Any) -> Variable:
        """Return an array with these axes."""
        array = np.asarray(values)
        if array.dtype.kind == "U":
            array = array.astype(object)  # as netCDF returns texts
        attributes = {"long_name": self.text}
        if self.unit:
            attributes["units"] = self.unit
        return Variable(self.dimensions, array, attributes)


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
COORDINATES = ("region_name",)  # besides those that are named like their dimension
# These differ between two runs of the same seed.
HOST_TIMES = ("decision_time", "wall_time", "sumo_time_s", "setup_time_s", "overhead_share")


@dataclass(frozen=True, eq=False)
class Result:
    """One closed-loop run of T control intervals.

    variables: arrays over time (T+1 states), interval (T decisions), region, next_region and
        destination; in SUMO over gateway and edge, too
    attrs: controller, plant, seed, step (s), estimated (0 or 1), wall_time (s), scenario, version,
        settings (JSON), and all scalar facts of the run

    `result.accumulation` is the labelled array of that variable, `result["accumulation"]` its
    values, `result.seed` the attribute of that name; `dir(result)` lists them.
    """

    variables: Mapping[str, Variable]
    attrs: Mapping[str, Any]

    @cached_property
    def data(self) -> "xarray.Dataset":
        """All variables and attributes as a Dataset with coordinates."""
        import xarray  # half a second, which few commands need

        return xarray.Dataset(self.variables, attrs=self.attrs).set_coords(
            [name for name in COORDINATES if name in self]
        )

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
        return self.attrs["controller"]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.attrs["seed"]

    @property
    def step(self) -> float:
        """Control interval (s)."""
        return self.attrs["step"]

    @property
    def sizes(self) -> Mapping[str, int]:
        """Length of every dimension."""
        sizes: dict[str, int] = {}
        for variable in self.variables.values():
            sizes |= zip(variable.dimensions, variable.values.shape, strict=True)
        return sizes

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
        return float(self.attrs.get("completed_veh", self["completed"][-1]))

    @classmethod
    def make(
        cls, attrs: Mapping[str, Any], region_names: Sequence[str] = (), **arrays: Any
    ) -> "Result":
        """Return the result of a closed loop.

        attrs: facts of the run
        arrays: those of VARIABLES
        """
        times = attrs["step"] * np.arange(len(arrays["accumulation"]))
        variables = {
            "time": Quantity(("time",), "s", "time since the start").variable(times),
            "interval": Quantity(("interval",), "s", "beginning of the interval").variable(
                times[:-1]
            ),
        }
        for name in ("region", "next_region", "destination"):
            numbers = np.arange(arrays["accumulation"].shape[1])
            variables[name] = Quantity((name,), "1", "number of the region").variable(numbers)
        if len(region_names):
            names = Quantity(("region",), "", "name of the region").variable(region_names)
            variables["region_name"] = names
        for name, about in VARIABLES.items():
            variables[name] = about.variable(arrays[name])
        return cls(variables, dict(attrs))

    @classmethod
    def read(cls, path: Path | str, only: Collection[str] | None = None) -> "Result":
        """Return the result in the netCDF file `path`.

        only: variables to read, of those that the file has; all if None
        Raises: InputError if the file is missing, or damaged
        """
        try:
            return cls(*_read(path, only))
        except FileNotFoundError:
            raise InputError(f"{path}: no such run") from None
        except Exception as error:
            reason = str(error).partition("\n")[0]
            raise InputError(
                f"{path}: is no run of this version ({reason}); delete it and run again"
            ) from None

    def write(self, path: Path | str) -> None:
        """Write a netCDF file, whole or not at all."""
        path = Path(path)
        temporary = path.with_name(f".{path.stem}-{os.getpid()}.tmp")
        try:
            _write(temporary, self.variables, self.attrs)
            os.replace(temporary, path)
        except OSError as error:  # which does not name the file
            raise InputError(f"{path}: cannot be written ({error})") from None
        finally:
            temporary.unlink(missing_ok=True)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name in ("variables", "attrs"):
            raise AttributeError(name)
        if name in self.variables:
            return self.data[name]
        if name in self.attrs:
            return self.attrs[name]
        raise AttributeError(f"result without variable or attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.variables, *self.attrs})

    def __repr__(self) -> str:
        lengths = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        facts = "\n".join(f"    {name}: {value}" for name, value in self._shown().items())
        return f"Result of {self.attrs.get('controller', '?')} over {lengths}\n{facts}"

    def _shown(self) -> dict[str, str]:
        """Return facts for a screen: total time spent, and short attributes."""
        shown = {}
        if "accumulation" in self:
            shown["total_time_spent"] = f"{self.total_time_spent:.6g} veh s"
            shown["completed_trips"] = f"{self.completed_trips:,.0f}"
        for name, value in self.attrs.items():
            if len(shown) < SHOWN_FACTS and len(str(value)) <= SHOWN_CHARACTERS:
                text = f"{value:g}" if isinstance(value, float) else str(value)
                shown.setdefault(name, text)
        return shown

    def __getitem__(self, name: str) -> np.ndarray:
        return self.variables[name].values

    def __contains__(self, name: str) -> bool:
        return name in self.variables

    def assign(self, **values: Any) -> "Result":
        """Return the result with other arrays or other attributes."""
        variables = dict(self.variables)
        attrs = dict(self.attrs)
        for name, value in values.items():
            if name in variables:
                variables[name] = variables[name]._replace(values=np.asarray(value))
            else:
                attrs[name] = value
        return Result(variables, attrs)

    def add(
        self, attrs: Mapping[str, Any], about: Mapping[str, Quantity] = {}, **arrays: np.ndarray
    ) -> "Result":
        """Return the result with more attributes and arrays.

        about: name of an array -> its axes, unit and meaning
        """
        variables = dict(self.variables)
        for name, quantity in about.items():
            if name in arrays:
                variables[name] = quantity.variable(arrays[name])
        return Result(variables, {**self.attrs, **attrs})

    def label(self, **names: Sequence[str]) -> "Result":
        """Return the result with names of the entries of some dimensions.

        names: `gateway` or `edge` -> names
        """
        about = {name: Quantity((name,), "", f"name of the {name}") for name in names}
        return self.add({}, about, **names)

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


def _write(path: Path, variables: Mapping[str, Variable], attrs: Mapping[str, Any]) -> None:
    """Write a netCDF file that xarray reads as `Result.data`.

    Arrays without entries, which scipy cannot read back, are an attribute.
    """
    from scipy.io import netcdf_file

    empty = {}
    with netcdf_file(path, "w", version=2) as file:
        for name, variable in variables.items():
            values = variable.values
            if not values.size:
                about = variable.attributes
                empty[name] = variable.dimensions, values.shape, values.dtype.str, about
                continue
            encoded = _encoded(variable)
            for dimension, size in zip(encoded.dimensions, encoded.values.shape, strict=True):
                if dimension not in file.dimensions:
                    file.createDimension(dimension, size)
            stored = file.createVariable(name, encoded.values.dtype, encoded.dimensions)
            stored[:] = encoded.values
            for key, text in encoded.attributes.items():
                setattr(stored, key, text.encode())
        coordinates = " ".join(name for name in COORDINATES if name in variables)
        of_file = {**attrs, "coordinates": coordinates, "empty": json.dumps(empty)}
        for name, value in of_file.items():
            setattr(file, name, _packed(value))


def _encoded(variable: Variable) -> Variable:
    """Return an array of types that netCDF has.

    Texts are characters along another dimension.
    """
    values = variable.values
    if values.dtype == object:
        texts = np.char.encode(values.astype(str), "utf-8")
        values = texts.view("S1").reshape(*texts.shape, -1)
        dimensions = *variable.dimensions, f"string{values.shape[-1]}"
        return Variable(dimensions, values, {**variable.attributes, "_Encoding": "utf-8"})
    if values.dtype.kind in "biu":
        values = values.astype(np.int32)
    elif values.dtype == np.float16:
        values = values.astype(np.float32)
    return variable._replace(values=values)


def _decoded(stored: Any) -> Variable:
    """Return an array that `_encoded` prepared, from a variable of a file."""
    attributes = _attributes(stored)
    values = stored.data.astype(stored.data.dtype.newbyteorder("="))
    if attributes.pop("_Encoding", None) is None:
        return Variable(stored.dimensions, values, attributes)
    texts = np.char.decode(values.view(f"S{values.shape[-1]}")[..., 0], "utf-8")
    return Variable(stored.dimensions[:-1], texts.astype(object), attributes)


def _packed(value: Any) -> Any:
    """Return an attribute as netCDF takes it."""
    if isinstance(value, str):
        return value.encode()
    whole = isinstance(value, bool | int | np.integer) and abs(value) < 2**31
    return np.int32(value) if whole else np.float64(value)


def _read(
    path: Path | str, only: Collection[str] | None
) -> tuple[dict[str, Variable], dict[str, Any]]:
    """Return variables and attributes of a netCDF file."""
    from scipy.io import netcdf_file

    with netcdf_file(path, mmap=False) as file:
        attrs = _attributes(file)
        there = dict(file.variables)
    variables = {}
    for name, stored in there.items():
        if only is None or name in only:
            variables[name] = _decoded(stored)
    for name, (dimensions, shape, dtype, about) in json.loads(attrs.pop("empty", "{}")).items():
        if only is None or name in only:
            variables[name] = Variable(tuple(dimensions), np.zeros(shape, dtype), about)
    attrs.pop("coordinates", None)
    return variables, attrs


def _attributes(owner: Any) -> dict[str, Any]:
    """Return the attributes of a netCDF file, or of a variable in it."""
    return {
        name: value.decode() if isinstance(value, bytes) else value.item()
        for name, value in owner._attributes.items()  # noqa: SLF001 - scipy has no other way
    }
