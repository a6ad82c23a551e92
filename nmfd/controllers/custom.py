"""Controllers of one's own: `path/to/file.py:Class`, or an entry point of the group `nmfd.controllers`.

The class is made with the planning model (nmfd.model.planning) as its one argument and has `name`, `reset` and `act`
(nmfd.types.Controller). What it returns is checked at every step. template.py beside this file is where to begin
(`nmfd new-controller`).

It is the user's own code, and may do to its process whatever code can: exit, hang, change what all share. Commands
therefore run it in processes of its own only (nmfd.runs.workers): `verify` and `facts` ask one that does nothing else.
There, and where it runs in this process, from Python, every call has a time limit.
"""

import copy
import hashlib
import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nmfd.arrays import PerRegion
from nmfd.errors import InputError
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import workers
from nmfd.runs.files import check_file, file_hash
from nmfd.types import Controls, Observation, Status

OWN_TIME_LIMIT = 600.0  # s
GROUP = "nmfd.controllers"
FILE_AND_CLASS = re.compile(r"(?P<file>.+\.py):(?P<cls>[^\W\d]\w*)")
ROUNDING = 1e-5  # by how much bounds and sums may be missed: float32
MOST_PRICE = 100.0  # beyond which nobody would take a way through the region, whatever the others cost
MOST_RATE = 1e6  # veh/s, as good as no limit
LONGEST = 300  # characters of what the user's code says


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What a class says of itself. table: its name in [controllers.own]; files: beside its own that it depends on."""

    table: str
    files: tuple[str, ...]


_asked: dict[tuple, Facts] = {}  # of the processes of their own, so far
_asker: list[workers.Worker] = []  # the one that is there, if any


def entry_points() -> dict[str, metadata.EntryPoint]:
    """Name -> entry point, of all installed packages."""
    return {point.name: point for point in metadata.entry_points(group=GROUP)}


def is_file(name: str) -> bool:
    """Whether `name` means a class in a file, there or not."""
    return FILE_AND_CLASS.fullmatch(name) is not None


def _file_and_class(name: str) -> tuple[Path, str]:
    """The parts of a name that `is_file`."""
    match = FILE_AND_CLASS.fullmatch(name)
    assert match is not None
    return Path(match["file"]), match["cls"]


def check(name: str) -> None:
    """InputError unless there is the file of `name`, a controller that `is_file`; the file is not run."""
    path, _ = _file_and_class(name)
    check_file(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file for controller {name}; write one with: nmfd new-controller {path}")


def fingerprint(name: str) -> dict[str, object]:
    """What the runs of `name` depend on: its file, and the files that its class names in `files`, or its package."""
    if not is_file(name):
        point = entry_points()[name]
        return {"entry_point": point.value, "package": f"{point.dist.name} {point.dist.version}" if point.dist else ""}
    path, _ = _file_and_class(name)
    beside = [path.parent / file for file in facts(name).files]
    return {
        "source_hash": file_hash(path),
        **{f"{file.name}_hash": file_hash(file) if file.is_file() else None for file in beside},
    }


def table_name(name: str) -> str:
    """The `name` of the class: of its table in [controllers.own]."""
    return facts(name).table


def facts(name: str) -> Facts:
    """What the class `name` says of itself. InputError."""
    if workers.inside() or (is_file(name) and _key(_file_and_class(name)[0]) in sys.modules):
        return _facts(name)
    if _version(name) not in _asked:
        _ask(name, None)
    return _asked[_version(name)]


def verify(name: str, scenario: Scenario) -> None:
    """As `make`, in a process of its own. Raises InputError."""
    if workers.inside():
        make(name, scenario)
    else:
        _ask(name, scenario)


def _ask(name: str, scenario: Scenario | None) -> None:
    """Have `name` tried, and remember what it says of itself. Raises InputError."""
    if is_file(name):
        check(name)
    if not _asker or not _asker[0].alive:
        _asker[:] = [workers.Worker(_answer)]
    _asker[0].hand((name, scenario, os.getcwd()))
    answer = _asker[0].receive()
    if isinstance(answer, workers.Failure):
        raise InputError(answer.reason)
    _asked[_version(name)] = answer


def _answer(task: tuple[str, Scenario | None, str]) -> Facts:
    """The other side of `_ask`."""
    name, scenario, folder = task
    os.chdir(folder)
    _class(name, OWN_TIME_LIMIT)
    if scenario is not None:
        make(name, scenario)
    return _facts(name)


def _facts(name: str) -> Facts:
    cls = _class(name)
    return _guarded(
        name,
        "name and files",
        lambda: Facts(table=str(getattr(cls, "name", name)), files=tuple(map(str, getattr(cls, "files", ())))),
    )


def _version(name: str) -> tuple:
    """That of the code behind `name`."""
    return name, _key(_file_and_class(name)[0]) if is_file(name) else entry_points()[name].value


def with_tables(scenario: Scenario) -> Scenario:
    """`scenario` with the tables of [controllers.own] among its options of controllers."""
    tables = scenario.controller_options
    return replace(scenario, controller_options={**tables, **tables.get("own", {})})


def make(name: str, scenario: Scenario) -> "OwnController":
    """The controller `name`, tried once on an empty city. Raises InputError, on one line, for whatever is wrong."""
    limit = OWN_TIME_LIMIT
    cls = _class(name, limit)
    planning = planning_model(with_tables(scenario), _facts(name).table)
    try:
        inspect.signature(cls).bind(planning)
    except TypeError as error:
        raise InputError(
            f"{name}: expected a class that is made with one argument, the planning model, but {error}; write "
            "__init__(self, planning)"
        ) from None
    except ValueError:  # of a class without a signature, such as one written in C
        pass
    controller = _guarded(name, f"{name.rpartition(':')[2]}()", cls, planning, limit=limit)
    for method in ("reset", "act"):
        if not callable(_guarded(name, method, getattr, controller, method, None)):
            raise InputError(
                f"{name}: has no method {method}; a controller needs reset(self, seed=0) and act(self, observation)"
            )
    network = copy.deepcopy(scenario.network)
    own = OwnController(name, controller, network, limit)
    empty = np.zeros((network.regions,) * 2)
    own.reset(0)
    own.act(Observation(step=0, time=0.0, accumulation=empty, backlog=empty.copy()))
    own.reset(0)
    return own


class OwnController:
    """A controller of the user's (nmfd.types.Controller) whose mistakes are InputErrors with file and line."""

    def __init__(self, name: str, controller: Any, network: RegionalModel, limit: float):
        """limit: of every call [s], 0 for none"""
        self._where, self._controller, self._network, self._limit = name, controller, network, limit
        self.name, self.deadline = name, _guarded(name, "deadline", getattr, controller, "deadline", None, limit=limit)

    def reset(self, seed: int = 0) -> None:
        _guarded(self._where, "reset", self._controller.reset, seed, limit=self._limit)

    def act(self, observation: Observation) -> Controls:
        # What it returns is the user's, too: looked at, it may do anything.
        return _guarded(self._where, "act", self._checked, observation, limit=self._limit)

    def _checked(self, observation: Observation) -> Controls:
        return checked(self._controller.act(observation), self._network, f"{self._where}: act")


def checked(controls: object, network: RegionalModel, where: str) -> Controls:
    """`controls` as float64 and with rounding errors removed. InputError for another type, shape or range."""
    if not isinstance(controls, Controls):
        raise InputError(
            f"{where}: expected nmfd.Controls, got {type(controls).__name__} instead; "
            "return nmfd.Controls(perimeter=..., splits=None)"
        )
    if not isinstance(controls.status, Status):
        raise InputError(
            f"{where}: status: expected nmfd.Status, such as nmfd.Status.FALLBACK, got {controls.status!r} instead; "
            "what is to be said of it goes into note"
        )
    regions = network.regions
    perimeter = _array(controls.perimeter, (regions,) * 2, f"{where}: perimeter")
    perimeter = np.where(network.adjacency, perimeter, 0.0)
    for i, h in np.argwhere(network.adjacency):
        if not network.u_min - ROUNDING <= perimeter[i, h] <= network.u_max + ROUNDING:
            raise InputError(
                f"{where}: perimeter[{i}, {h}]: expected a number in [{network.u_min:g}, {network.u_max:g}], got "
                f"{perimeter[i, h]:g} instead; use numpy.clip"
            )
    perimeter = np.where(network.adjacency, np.clip(perimeter, network.u_min, network.u_max), 0.0)
    unguided = Controls(
        perimeter=perimeter,
        splits=None,
        status=controls.status,
        note=_text(controls.note),
        prices=_by_region(controls.prices, regions, MOST_PRICE, f"{where}: prices"),
        metering=_by_region(controls.metering, regions, MOST_RATE, f"{where}: metering"),
    )
    if controls.splits is None:
        return unguided
    splits = _array(controls.splits, (regions,) * 3, f"{where}: splits")
    allowed = network.split_mask
    if (wrong := np.argwhere((splits < -ROUNDING) | (~allowed & (splits > ROUNDING)))).size:
        i, h, j = wrong[0]
        raise InputError(
            f"{where}: splits[{i}, {h}, {j}]: expected {'a share >= 0' if allowed[i, h, j] else '0 (no way)'}, got "
            f"{splits[i, h, j]:g} instead; allowed is planning.network.split_mask"
        )
    splits = np.where(allowed, np.maximum(splits, 0.0), 0.0)
    sums = splits.sum(axis=1)
    if (wrong := np.argwhere(allowed.any(axis=1) & (abs(sums - 1.0) > 100 * ROUNDING))).size:
        i, j = wrong[0]
        raise InputError(f"{where}: splits[{i}, :, {j}]: expected shares with sum 1, got {sums[i, j]:g} instead")
    return replace(unguided, splits=splits / np.where(sums > 0, sums, 1.0)[:, None, :])


def _by_region(asked: object, regions: int, most: float, where: str) -> PerRegion | None:
    if asked is None:
        return None
    numbers = _array(asked, (regions,), where)
    if (wrong := np.flatnonzero((numbers < 0.0) | (numbers > most))).size:
        i = wrong[0]
        raise InputError(f"{where}[{i}]: expected a number from 0 to {most:g}, got {numbers[i]:g} instead")
    return numbers


def _array(values: object, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        array = np.asarray(values)
        kind = array.dtype.name if array.dtype.kind not in "biufO" else "masked" if np.ma.is_masked(values) else ""
        if array.shape == shape and not kind:  # else there may be any number of them
            array = array.astype(float)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:  # RuntimeError: a tensor with a gradient
        raise InputError(
            f"{where}: expected numbers of shape {shape}, got {type(values).__name__} instead ({_text(error)})"
        ) from None
    if kind:  # NumPy would make numbers of complex ones and of texts
        raise InputError(f"{where}: expected real numbers of shape {shape}, got {kind} ones instead")
    if array.shape != shape or not np.isfinite(array).all():
        got = f"shape {array.shape}" if array.shape != shape else "numbers that are not finite"
        raise InputError(f"{where}: expected finite numbers of shape {shape}, got {got} instead")
    return array


def _class(name: str, limit: float = 0.0) -> Any:
    """The class, or whatever makes a controller, behind `name`. limit: of its import [s], 0 for none"""
    if not is_file(name):
        return _guarded(name, "import", entry_points()[name].load, limit=limit)
    check(name)
    file, cls = _file_and_class(name)
    module = _module(file, name, limit)
    found = getattr(module, cls, None)
    if found is None:
        there = [key for key, value in vars(module).items() if isinstance(value, type) and hasattr(value, "act")]
        raise InputError(
            f"{file}: has no class {cls}; "
            + (f"choose from {', '.join(there)}" if there else "it has none with a method act: write one")
        )
    if not callable(found):
        raise InputError(f"{name}: expected a class, got {_text(found, repr)} instead")
    return found


def _key(path: Path) -> str:
    """The name of the module in `path`, as long as the file stays as it is; of no file, too."""
    path, stamp = path.resolve(), 0
    with suppress(OSError):
        stamp = path.stat().st_mtime_ns
    return "nmfd_own_" + hashlib.sha256(f"{path}{stamp}".encode(errors="replace")).hexdigest()[:16]


def _module(path: Path, name: str, limit: float = 0.0) -> ModuleType:
    """The module in `path`, run once as long as the file stays as it is."""
    key, path = _key(path), path.resolve()
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, path)
        assert spec is not None and spec.loader is not None  # of a path that ends in .py
        module = importlib.util.module_from_spec(spec)
        if str(path.parent) not in sys.path:
            sys.path.append(str(path.parent))  # for what lies beside it
        sys.modules[key] = module  # dataclasses look for their module there
        try:
            _guarded(name, "import", spec.loader.exec_module, module, limit=limit)
        except BaseException:
            del sys.modules[key]
            raise
    return sys.modules[key]


def _guarded(name: str, doing: str, function: Callable, *arguments: Any, limit: float = 0.0) -> Any:
    """`function(*arguments)`; whatever the user's code raises becomes an InputError with file and line.

    limit: [s], 0 for none
    """
    where = f"{name}: {doing}"
    try:
        with workers.limited(limit, where), _undone(where):
            return function(*arguments)
    except InputError as error:
        text = _text(error)
        raise InputError(text if name in text else f"{where}: {text}") from None
    except workers.TimeUp as error:
        raise InputError(
            f"{_place(name, error)}: {where}: took longer than {limit:g} s; make it faster, or allow more "
            "with --time-limit or own_time_limit in scenario.toml"
        ) from None
    except workers.Ended:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and not workers.inside():
            raise  # somebody's Ctrl-C; workers are not told of it
        raise InputError(f"{_place(name, error)}: {where}: {type(error).__name__}: {_text(error)}") from error


def _place(name: str, error: BaseException) -> str:
    """file:line of an error: the last line of the user's own file, if it came up deeper down."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}"
    trace = traceback.extract_tb(error.__traceback__)
    own = str(_file_and_class(name)[0].resolve()) if is_file(name) else None
    frame = next((f for f in reversed(trace) if f.filename == own), trace[-1])
    return f"{frame.filename}:{frame.lineno}"


def _text(value: object, words: Callable[[Any], str] = str) -> str:
    """`value` in words, on one line and not too long; some cannot even be printed."""
    try:
        text = " ".join(str(words(value)).split())
    except BaseException as error:
        if isinstance(error, workers.TimeUp | workers.Ended):
            raise
        return "(which cannot be printed)"
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= LONGEST else text[:LONGEST] + "..."


@contextmanager
def _undone(where: str) -> Iterator[None]:
    """What the plant computes with afterwards is as it was: numpy's and torch's modes, and the folder. InputError if
    the body left the folder, or closed what is printed to."""
    folder, torch = os.getcwd(), sys.modules.get("torch")
    modes = (torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_num_threads()) if torch else None
    try:
        with np.errstate():
            yield
    finally:
        now = ""
        with suppress(OSError):
            now = os.getcwd()
        if now != folder:
            os.chdir(folder)
        if torch and modes and modes != (torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_num_threads()):
            torch.set_default_dtype(modes[0])
            torch.set_grad_enabled(modes[1])
            torch.set_num_threads(modes[2])
    if now != folder:
        raise InputError(
            f"{where}: left the folder {folder} for {now or 'one that is gone'}; name files by their whole path instead"
        )
