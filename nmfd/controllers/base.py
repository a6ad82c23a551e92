"""Base class of the built-in controllers, which are their options."""

from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Problem, Settings, Text, setting
from nmfd.types import Controller


class FileKind(NamedTuple):
    """File that a controller reads.

    text: what it is
    suffix: end of its name
    command: command that makes it, with {folder} of the scenario and {name} of the controller
    """

    text: str
    suffix: str
    command: str


class Options(Settings):
    """Options of a controller, from which `make` makes it for a scenario.

    plans: False if the controller uses no regional model
    """

    plans: ClassVar[bool] = True

    model: Text | None = setting(
        "folder or shipped name of the regional model to plan with; by default that of the "
        "scenario's network or, for controllers that guide routes, the one in its folder guided",
        None,
    )

    @property
    def guides(self) -> bool:
        """True if the controller may guide routes.

        Its constant or option `guidance` says so.
        """
        return bool(getattr(self, "guidance", False))

    @property
    def reads(self) -> FileKind | None:
        """Kind of the file that the controller reads, None if it reads none."""
        return None

    @property
    def file(self) -> str | Path | None:
        """File that the options name; None for the one in the scenario's folder."""
        return None

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return what does not fit the planning model, or None."""
        return None

    def make(self, planning: PlanningModel) -> Controller:
        """Return the controller for a planning model."""
        raise NotImplementedError

    def load(self, file: Path, planning: PlanningModel, scenario: Scenario) -> Any:
        """Return the controller in `file`, if it reads one."""
        raise NotImplementedError

    def changed(self, **changes: object) -> Self:
        """Return checked options with other values. Raise InputError."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return config.checked(type(self), {**given, **changes}, type(self).__name__)


def check_fit(options: Options, planning: PlanningModel, where: str) -> None:
    """Raise InputError if options do not fit the planning model.

    where: begins the key in the message, such as "scenario.toml: controllers.pi-gating."
    """
    problem = options.misfit(planning)
    if problem is not None:
        raise InputError(f"{where}{problem.key}: {problem}")
