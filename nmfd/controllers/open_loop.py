"""Plans fixed in advance as controllers: what `nmfd bound` has found, knowing all demand."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nmfd.arrays import PairsOverTime, TurnsOverTime
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs.files import atomic, check_file
from nmfd.types import Controls, Observation

NAMES = {"bound-pc": False, "bound-pcrg": True}  # whether routes are guided too


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Controls of all T intervals, fixed in advance.

    perimeter: (T, R, R) [-], [k, i, h] = u_ih
    splits: (T, R, R, R) [-], [k, i, h, j] = theta_ihj; None without route guidance
    start: the name of the start that it was descended from
    totals: start -> total time spent [veh s] that its descent ended at
    iterations: Adam steps done
    """

    perimeter: PairsOverTime
    splits: TurnsOverTime | None
    start: str
    totals: Mapping[str, float]
    iterations: int


class OpenLoop:
    """A plan as a controller (nmfd.types.Controller): what is measured changes nothing."""

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
    """A fingerprint of all that a plan depends on: Scenario.hash without controllers and observation noise."""
    return replace(scenario, controller_options={}, protected=(), measurement_std=0.0).hash


def write(plan: Plan, scenario: Scenario, path: Path) -> None:
    """`plan` as an .npz file without pickles, with the fingerprint of its scenario; atomically."""
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
    """What `write` wrote; InputError if it is none, of another scenario, or of the other action set."""
    check_file(path, "compute one with 'nmfd bound'")
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:  # NumPy leaves others open
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
    """The plan in `path` as the controller "bound-pc" or "bound-pcrg"; InputError as `read`."""
    return OpenLoop(read(path, scenario, guidance=guidance))
