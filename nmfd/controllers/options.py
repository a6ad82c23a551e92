"""What the options of all controllers, the tables [controllers.NAME] of scenario.toml, have in common."""

from typing import TypeVar

from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Problem, Settings


class Options(Settings):
    """The declaration of a controller's options; this one, of a controller without any."""

    def misfit(self, scenario: Scenario) -> Problem | None:
        """What does not fit the scenario, if anything."""
        return None


Chosen = TypeVar("Chosen", bound=Options)


def options(declaration: type[Chosen], scenario: Scenario, name: str, table: str | None = None) -> Chosen:
    """The options of controller `name`; InputError for an unknown key or a wrong value.

    table: that the message names, if not that of `name`
    """
    where = "scenario.toml" if scenario.folder is None else scenario.folder / "scenario.toml"
    chosen = config.checked(
        declaration, scenario.controller_options.get(name, {}), where, f"controllers.{table or name}.")
    if problem := chosen.misfit(scenario):
        raise config.error(where, f"controllers.{table or name}.{problem.key}", str(problem))
    return chosen
