"""Controllers of the user's own: classes `path/to/file.py:Class`.

template.py shows how to write one.
"""

import hashlib
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np

from nmfd.errors import InputError
from nmfd.model.commands import rounded
from nmfd.model.planning import PlanningModel
from nmfd.runs.files import check_name, file_hash
from nmfd.types import Controller, Controls, Observation

FILE_AND_CLASS = re.compile(r"(?P<file>.+\.py):(?P<cls>[^\W\d]\w*)")


def load(name: str) -> Any:
    """Return the class FILE.py:CLASS.

    Its module runs once per version of the file. Raises: InputError
    """
    path = _path(name)
    cls = name.rpartition(":")[2]
    check_name(path)
    if not path.is_file():
        raise InputError(
            f"{path}: no such file for controller {name}; write one with: nmfd new-controller "
            f"{path}"
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
    found = getattr(sys.modules[key], cls, None)
    if not callable(found):
        raise InputError(f"{path}: has no class {cls}; write one with the methods reset and act")
    return found


def fingerprint(name: str) -> dict[str, object]:
    """Return hashes of the file and of those that the class names in `files`."""
    file = _path(name)
    paths = [file]
    paths += [file.parent / str(other) for other in getattr(load(name), "files", ())]
    hashes: dict[str, object] = {}
    for path in paths:
        hashes[f"{path.name}_hash"] = file_hash(path) if path.is_file() else None
    return hashes


def object_fingerprint(controller: Controller) -> str:
    """Return a hash of an object with its code and state.

    Raises: InputError if it cannot be pickled
    """
    try:
        content = cloudpickle.dumps(controller)
    except Exception as error:
        name = type(controller).__name__
        raise InputError(
            f"controller {name}: cannot be pickled ({error}); leave out files, locks and threads, "
            "or put the class into a file"
        ) from None
    return hashlib.sha256(content).hexdigest()[:16]


class OwnController:
    """Controller of a user's file.

    Its mistakes become InputErrors with file and line.
    """

    def __init__(self, name: str, planning: PlanningModel):
        """Make the controller and try it on an empty city. Raise InputError."""
        self.name = name
        self._controller = _located(name, "__init__", load(name), planning)
        self.deadline = getattr(self._controller, "deadline", None)
        self._network = planning.network
        regions = planning.network.regions
        empty = np.zeros((regions, regions))
        first = Observation(step=0, time=0.0, accumulation=empty, backlog=empty.copy())
        self.reset()
        self.act(first)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        _located(self.name, "reset", lambda: self._controller.reset(seed))

    def act(self, observation: Observation) -> Controls:
        command = _located(self.name, "act", lambda: self._controller.act(observation))
        return rounded(command, self._network, f"{self.name}: act: interval {observation.step}")


def _path(name: str) -> Path:
    return Path(name.rpartition(":")[0]).resolve()


def _located(name: str, doing: str, function: Callable, *arguments: Any) -> Any:
    """Return `function(*arguments)`, which calls the user's code.

    Raises: InputError with file and line for what that code raises
    """
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if frame.filename == str(_path(name))]
        place = (own or frames)[-1]
        where = f"{place.filename}:{place.lineno}"
        if isinstance(error, SyntaxError):
            where = f"{error.filename}:{error.lineno}"
        text = " ".join(str(error).split())
        raise InputError(f"{where}: {name}: {doing}: {type(error).__name__}: {text}") from error
