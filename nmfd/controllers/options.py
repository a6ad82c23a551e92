"""What the options of all controllers, the tables [controllers.NAME] of scenario.toml, have in common."""

from typing import TYPE_CHECKING, TypeVar

from nmfd.runs import config
from nmfd.runs.config import Problem, Settings

if TYPE_CHECKING:  # at run time it would bring numpy, and the help of an option waits for this module
    from nmfd.model.planning import PlanningModel


class Options(Settings):
    """The declaration of a controller's options; this one, of a controller without any."""

    def misfit(self, planning: "PlanningModel") -> Problem | None:
        """What does not fit the planning model, if anything."""
        return None


Chosen = TypeVar("Chosen", bound=Options)


def options(declaration: type[Chosen], planning: "PlanningModel", name: str, table: str | None = None) -> Chosen:
    """The options of controller `name`; InputError for an unknown key or a wrong value.

    table: that the message names, if not that of `name`
    """
    prefix = f"controllers.{table or name}."
    chosen = config.checked(declaration, planning.controller_options.get(name, {}), planning.where, prefix)
    if problem := chosen.misfit(planning):
        raise config.error(planning.where, prefix + problem.key, str(problem))
    return chosen
