"""Open-loop controllers that replay a plan, and the plan files that `nmfd bound` writes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nmfd.arrays import PairsOverTime, TurnsOverTime
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs.files import atomic
from nmfd.types import Controls, Observation

NAMES = {"bound-pc": False, "bound-pcrg": True}  # controller -> with route guidance


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Controls of all T intervals, fixed in advance.

    perimeter: u_ih (-, (T, R, R) [k, i, h])
    splits: theta_ihj (-, (T, R, R, R) [k, i, h, j]); None without route guidance
    start: name of the initial plan of the best descent
    totals: initial plan -> total time spent at the end of its descent (veh s)
    iterations: number of Adam steps
    """

    perimeter: PairsOverTime
    splits: TurnsOverTime | None
    start: str
    totals: Mapping[str, float]
    iterations: int


class OpenLoop:
    """Open-loop controller that replays a plan, whatever is measured."""

    def __init__(self, plan: Plan):
        self.name, self._plan = "bound-pc" if plan.splits is None else "bound-pcrg", plan

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        splits = self._plan.splits
        return Controls(
            perimeter=self._plan.perimeter[observation.step],
            splits=None if splits is None else splits[observation.step],
        )


def model_hash(scenario: Scenario) -> str:
    """Return the hash of all that a plan depends on: Scenario.hash without controllers and observation noise."""
    return replace(scenario, controller_options={}, protected=(), measurement_std=0.0).hash


def write(plan: Plan, scenario: Scenario, path: Path) -> None:
    """Write `plan` and the hash of its scenario to an .npz file."""
    splits = {} if plan.splits is None else {"splits": plan.splits}
    with atomic(path) as temporary:
        np.savez_compressed(
            temporary,
            scenario=np.array(scenario.name),
            model=np.array(model_hash(scenario)),
            perimeter=plan.perimeter,
            start=np.array(plan.start),
            names=np.array(list(plan.totals)),
            totals=np.array(list(plan.totals.values())),
            iterations=np.array(plan.iterations),
            **splits,
        )


def read(path: Path, scenario: Scenario, *, guidance: bool) -> Plan:
    """Read a plan. Raise InputError if it is of another scenario or of the other set of controls."""
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
        plan = Plan(
            perimeter=content["perimeter"],
            splits=content.get("splits"),
            start=str(content["start"]),
            totals=dict(zip(content["names"].tolist(), content["totals"].tolist(), strict=True)),
            iterations=int(content["iterations"]),
        )
        model = str(content["model"])
    except Exception:
        raise InputError(f"{path}: is no plan; compute one with 'nmfd bound'") from None
    if model != model_hash(scenario):
        raise InputError(
            f"{path}: was computed for another demand or network than {scenario.name}'s; compute it again "
            "with 'nmfd bound'"
        )
    if (plan.splits is not None) != guidance:
        wanted, other = ("with", "without") if guidance else ("without", "with")
        raise InputError(f"{path}: is a plan {other} route guidance, expected one {wanted}; choose another file")
    return plan


def load(path: Path, scenario: Scenario, *, guidance: bool) -> OpenLoop:
    """Return the plan in `path` as a controller. Raise InputError as `read`."""
    return OpenLoop(read(path, scenario, guidance=guidance))
