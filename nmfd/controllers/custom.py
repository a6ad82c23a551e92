"""Controllers of the user's own: a class in a file, `path/to/file.py:Class` (template.py shows how
to write one)."""

import copy
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.files import check_name, file_hash
from nmfd.types import Controls, Observation

FILE_AND_CLASS = re.compile(r"(?P<file>.+\.py):(?P<cls>[^\W\d]\w*)")
TOLERANCE = 1e-5  # of bounds and sums: rounding errors of float32
LARGEST = {"prices": 100.0, "metering": 1e6}  # -, trips/s: as good as no limit


def load(name: str) -> Any:
    """Return the class FILE.py:CLASS; its module runs once per version of the file. Raise
    InputError."""
    path, cls = _path(name), name.rpartition(":")[2]
    check_name(path)
    if not path.is_file():
        raise InputError(
            f"{path}: no such file for controller {name}; write one with: nmfd new-controller {path}"
        )
    key = f"{path}:{path.stat().st_mtime_ns}"
    if key not in sys.modules:
        module = sys.modules[key] = ModuleType(key)  # dataclasses look up their module there
        module.__file__ = str(path)
        sys.path.append(str(path.parent))  # for modules beside it
        source = path.read_text(encoding="utf-8")
        try:
            _located(name, "import", lambda: exec(compile(source, path, "exec"), vars(module)))
        except InputError:
            del sys.modules[key]
            raise
    if not callable(getattr(sys.modules[key], cls, None)):
        raise InputError(f"{path}: has no class {cls}; write one with the methods reset and act")
    return getattr(sys.modules[key], cls)


def fingerprint(name: str) -> dict[str, object]:
    """Return hashes of the file and of those that the class names in `files`."""
    paths = [
        _path(name),
        *(_path(name).parent / str(file) for file in getattr(load(name), "files", ())),
    ]
    return {f"{path.name}_hash": file_hash(path) if path.is_file() else None for path in paths}


class OwnController:
    """Controller of the user's own with checked controls; its mistakes are InputErrors with file
    and line."""

    def __init__(self, name: str, planning: PlanningModel):
        """Make the controller and try it on an empty city. Raise InputError."""
        self.name, self._network = name, copy.deepcopy(planning.network)
        self._controller = _located(name, "__init__", load(name), planning)
        self.deadline, empty = (
            getattr(self._controller, "deadline", None),
            np.zeros((self._network.regions,) * 2),
        )
        self.reset()
        self.act(Observation(step=0, time=0.0, accumulation=empty, backlog=empty.copy()))
        self.reset()

    def reset(self, seed: int = 0) -> None:
        _located(self.name, "reset", lambda: self._controller.reset(seed))

    def act(self, observation: Observation) -> Controls:
        controls = _located(self.name, "act", lambda: self._controller.act(observation))
        return checked(controls, self._network, f"{self.name}: act: interval {observation.step}")


def checked(controls: object, network: RegionalModel, where: str) -> Controls:
    """Return `controls` as float64 without rounding errors. Raise InputError for a wrong type,
    shape or value."""
    if not isinstance(controls, Controls):
        raise InputError(f"{where}: expected nmfd.Controls, got {type(controls).__name__} instead")
    edges, allowed, zeros = network.adjacency, network.split_mask, np.zeros(network.regions)
    low, high = np.where(edges, network.u_min, -np.inf), np.where(edges, network.u_max, np.inf)
    perimeter = np.where(edges, _numbers(controls.perimeter, low, high, f"{where}: perimeter"), 0.0)
    controls = replace(controls, perimeter=perimeter)
    for key, most in LARGEST.items():
        if (values := getattr(controls, key)) is not None:
            controls = replace(
                controls, **{key: _numbers(values, zeros, zeros + most, f"{where}: {key}")}
            )
    if controls.splits is None:
        return controls
    splits = _numbers(
        controls.splits, np.zeros(allowed.shape), allowed.astype(float), f"{where}: splits"
    )
    sums = splits.sum(axis=1)
    if (wrong := np.argwhere(allowed.any(axis=1) & (abs(sums - 1.0) > 100 * TOLERANCE))).size:
        raise InputError(
            f"{where}: splits: expected a sum of 1 over h, not so for [i, j] = {wrong[0].tolist()}"
        )
    return replace(controls, splits=splits / np.where(sums > 0, sums, 1.0)[:, None, :])


def _numbers(values: object, low: np.ndarray, high: np.ndarray, where: str) -> np.ndarray:
    """Return `values` as an array clipped to `low` and `high`, which may be missed by rounding
    errors only."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: a tensor with a gradient
        raise InputError(f"{where}: expected numbers of shape {low.shape} ({error})") from None
    if array.shape != low.shape:
        raise InputError(f"{where}: expected numbers of shape {low.shape}, got shape {array.shape}")
    if (
        wrong := np.argwhere(~((array >= low - TOLERANCE) & (array <= high + TOLERANCE)))
    ).size:  # NaN too
        n = tuple(wrong[0].tolist())
        raise InputError(
            f"{where}{list(n)}: expected {low[n]:g} to {high[n]:g}, got {array[n]:g} instead"
        )
    return np.clip(array, low, high)


def _path(name: str) -> Path:
    return Path(name.rpartition(":")[0]).resolve()


def _located(name: str, doing: str, function: Callable, *arguments: Any) -> Any:
    """Return `function(*arguments)`; raise what the user's code raises as an InputError with file
    and line."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        places = [
            (frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)
        ]
        own = [place for place in places if place[0] == str(_path(name))]
        file, line = (
            (error.filename, error.lineno)
            if isinstance(error, SyntaxError)
            else (own or places)[-1]
        )
        text = " ".join(str(error).split())
        raise InputError(
            f"{file}:{line}: {name}: {doing}: {type(error).__name__}: {text}"
        ) from error
