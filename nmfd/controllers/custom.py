"""Controllers of one's own: `path/to/file.py:Class`, or an entry point of the group `nmfd.controllers`.

The class is made with the planning model (nmfd.model.planning) as its one argument and has `name`, `reset` and `act`
(nmfd.types.Controller). What it returns is checked at every step. template.py beside this file is where to begin
(`nmfd new-controller`).
"""

import copy
import hashlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nmfd.errors import InputError
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.files import file_hash
from nmfd.types import Controls, Observation, Status

GROUP = "nmfd.controllers"
FILE_AND_CLASS = re.compile(r"(?P<file>.+\.py):(?P<cls>[^\W\d]\w*)")
ROUNDING = 1e-5  # by how much bounds and sums may be missed: float32


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
    if not path.is_file():
        raise InputError(f"{path}: no such file for controller {name}; write one with: nmfd new-controller {path}")


def fingerprint(name: str) -> dict[str, object]:
    """What the runs of `name` depend on: its file, and the files that its class names in `files`, or its package."""
    if not is_file(name):
        point = entry_points()[name]
        return {"entry_point": point.value, "package": f"{point.dist.name} {point.dist.version}" if point.dist else ""}
    path, _ = _file_and_class(name)
    beside = [path.parent / file for file in getattr(_class(name), "files", ())]
    return {"source_hash": file_hash(path), **{
        f"{file.name}_hash": file_hash(file) if file.is_file() else None for file in beside}}


def table_name(name: str) -> str:
    """The `name` of the class: of its table in [controllers.own]."""
    return str(getattr(_class(name), "name", name))


def with_tables(scenario: Scenario) -> Scenario:
    """`scenario` with the tables of [controllers.own] among its options of controllers."""
    tables = scenario.controller_options
    return replace(scenario, controller_options={**tables, **tables.get("own", {})})


def make(name: str, scenario: Scenario) -> "OwnController":
    """The controller `name`, tried once on an empty city. Raises InputError, on one line, for whatever is wrong."""
    cls, planning = _class(name), planning_model(with_tables(scenario), table_name(name))
    try:
        inspect.signature(cls).bind(planning)
    except TypeError as error:
        raise InputError(
            f"{name}: expected a class that is made with one argument, the planning model, but {error}; write "
            "__init__(self, planning)") from None
    except ValueError:  # of a class without a signature, such as one written in C
        pass
    controller = _guarded(name, f"{cls.__name__}()", cls, planning)
    for method in ("reset", "act"):
        if not callable(getattr(controller, method, None)):
            raise InputError(
                f"{name}: has no method {method}; a controller needs reset(self, seed=0) and act(self, observation)")
    network = copy.deepcopy(scenario.network)
    own = OwnController(name, controller, network)
    empty = np.zeros((network.regions,) * 2)
    own.reset(0)
    own.act(Observation(step=0, time=0.0, accumulation=empty, backlog=empty.copy()))
    own.reset(0)
    return own


class OwnController:
    """A controller of the user's (nmfd.types.Controller) whose mistakes are InputErrors with file and line."""

    def __init__(self, name: str, controller: Any, network: RegionalModel):
        self._where, self._controller, self._network = name, controller, network
        self.name = name

    def reset(self, seed: int = 0) -> None:
        _guarded(self._where, "reset", self._controller.reset, seed)

    def act(self, observation: Observation) -> Controls:
        return checked(
            _guarded(self._where, "act", self._controller.act, observation), self._network, f"{self._where}: act")


def checked(controls: object, network: RegionalModel, where: str) -> Controls:
    """`controls` as float64 and with rounding errors removed. InputError for another type, shape or range."""
    if not isinstance(controls, Controls):
        raise InputError(f"{where}: expected nmfd.Controls, got {type(controls).__name__} instead; "
                         "return nmfd.Controls(perimeter=..., splits=None)")
    if not isinstance(controls.status, Status):
        raise InputError(
            f"{where}: status: expected nmfd.Status, such as nmfd.Status.FALLBACK, got {controls.status!r} instead; "
            "what is to be said of it goes into note")
    regions = network.regions
    perimeter = _array(controls.perimeter, (regions,) * 2, f"{where}: perimeter")
    perimeter = np.where(network.adjacency, perimeter, 0.0)
    for i, h in np.argwhere(network.adjacency):
        if not network.u_min - ROUNDING <= perimeter[i, h] <= network.u_max + ROUNDING:
            raise InputError(
                f"{where}: perimeter[{i}, {h}]: expected a number in [{network.u_min:g}, {network.u_max:g}], got "
                f"{perimeter[i, h]:g} instead; use numpy.clip")
    perimeter = np.where(network.adjacency, np.clip(perimeter, network.u_min, network.u_max), 0.0)
    if controls.splits is None:
        return Controls(perimeter=perimeter, splits=None, status=controls.status, note=str(controls.note))
    splits = _array(controls.splits, (regions,) * 3, f"{where}: splits")
    allowed = network.split_mask
    if (wrong := np.argwhere((splits < -ROUNDING) | (~allowed & (splits > ROUNDING)))).size:
        i, h, j = wrong[0]
        raise InputError(
            f"{where}: splits[{i}, {h}, {j}]: expected {'a share >= 0' if allowed[i, h, j] else '0 (no way)'}, got "
            f"{splits[i, h, j]:g} instead; allowed is planning.network.split_mask")
    splits = np.where(allowed, np.maximum(splits, 0.0), 0.0)
    sums = splits.sum(axis=1)
    if (wrong := np.argwhere(allowed.any(axis=1) & (abs(sums - 1.0) > 100 * ROUNDING))).size:
        i, j = wrong[0]
        raise InputError(f"{where}: splits[{i}, :, {j}]: expected shares with sum 1, got {sums[i, j]:g} instead")
    return Controls(
        perimeter=perimeter, splits=splits / np.where(sums > 0, sums, 1.0)[:, None, :], status=controls.status,
        note=str(controls.note))


def _array(values: object, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{where}: expected numbers of shape {shape}, got {type(values).__name__} instead") from None
    if array.shape != shape or not np.isfinite(array).all():
        got = f"shape {array.shape}" if array.shape != shape else "numbers that are not finite"
        raise InputError(f"{where}: expected finite numbers of shape {shape}, got {got} instead")
    return array


def _class(name: str) -> Any:
    """The class, or whatever makes a controller, behind `name`."""
    if not is_file(name):
        return _guarded(name, "import", entry_points()[name].load)
    check(name)
    file, cls = _file_and_class(name)
    module = _module(file, name)
    found = getattr(module, cls, None)
    if found is None:
        there = [key for key, value in vars(module).items() if isinstance(value, type) and hasattr(value, "act")]
        raise InputError(f"{file}: has no class {cls}; " + (
            f"choose from {', '.join(there)}" if there else "it has none with a method act: write one"))
    if not callable(found):
        raise InputError(f"{name}: expected a class, got {found!r} instead")
    return found


def _module(path: Path, name: str) -> ModuleType:
    """The module in `path`, run once as long as the file stays as it is."""
    path = path.resolve()
    key = "nmfd_own_" + hashlib.sha256(f"{path}{path.stat().st_mtime_ns}".encode()).hexdigest()[:16]
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, path)
        assert spec is not None and spec.loader is not None  # of a path that ends in .py
        module = importlib.util.module_from_spec(spec)
        if str(path.parent) not in sys.path:
            sys.path.append(str(path.parent))  # for what lies beside it
        sys.modules[key] = module  # dataclasses look for their module there
        try:
            _guarded(name, "import", spec.loader.exec_module, module)
        except BaseException:
            del sys.modules[key]
            raise
    return sys.modules[key]


def _guarded(name: str, doing: str, function: Callable, *arguments: Any) -> Any:
    """`function(*arguments)`; whatever the user's code raises becomes an InputError with file and line."""
    try:
        return function(*arguments)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if isinstance(error, SyntaxError):
            file, line = error.filename, error.lineno
        else:
            trace = traceback.extract_tb(error.__traceback__)
            # The last line of the user's own file, if the error came up deeper down.
            own = str(_file_and_class(name)[0].resolve()) if is_file(name) else None
            frame = next((f for f in reversed(trace) if f.filename == own), trace[-1])
            file, line = frame.filename, frame.lineno
        raise InputError(f"{file}:{line}: {name}: {doing}: {type(error).__name__}: {error}") from error
