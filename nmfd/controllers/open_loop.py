"""Open-loop plans as controllers, and their files (`nmfd bound`)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmfd.arrays import PairsOverTime, TurnsOverTime
from nmfd.controllers.base import FileKind, Options
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario
from nmfd.runs.config import Text, setting
from nmfd.runs.files import atomic
from nmfd.types import Controls, Observation

NAMES = {"bound-pc": False, "bound-pcrg": True}  # controller -> with route guidance
PLAN = FileKind("plan", ".npz", "nmfd bound {folder} --controller {name}")


class Bound(Options):
    """Replay of the best plan for known demand, which `nmfd bound` finds."""

    plans: ClassVar[bool] = False

    guidance: bool = setting("route guidance besides perimeter control", False)
    plan: Text | Path | None = setting("plan file; by default SCENARIO/NAME.npz", None)

    @property
    def reads(self) -> FileKind:
        return PLAN

    @property
    def file(self) -> str | Path | None:
        return self.plan

    def load(self, file: Path, planning: PlanningModel, scenario: Scenario) -> "Plan":
        return read(file, scenario, guidance=self.guidance)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Open-loop controller: the controls of all T intervals.

    perimeter: shares u_ih that may pass (-, (T, R, R))
    splits: split ratios (-, (T, R, R, R)); None without route guidance
    start: initial plan of the best descent
    totals: initial plan -> total time spent after its descent (veh s)
    lower: bound that the total time spent of no plan falls below (veh s); NaN if unknown
    """

    perimeter: PairsOverTime
    splits: TurnsOverTime | None
    start: str
    totals: Mapping[str, float]
    lower: float = math.nan

    @property
    def name(self) -> str:
        return "bound-pc" if self.splits is None else "bound-pcrg"

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        k = observation.step
        controls = Controls(perimeter=self.perimeter[k])
        if self.splits is None:
            return controls
        return replace(controls, splits=self.splits[k])


def model_hash(scenario: Scenario) -> str:
    """Return the hash of all that a plan depends on.

    It is Scenario.hash without controllers and observation noise.
    """
    return replace(scenario, controller_options={}, protected=(), measurement_std=0.0).hash


def write(plan: Plan, scenario: Scenario, path: Path) -> None:
    """Write `plan` and the hash of its scenario to an .npz file."""
    content = {
        "perimeter": plan.perimeter,
        "start": plan.start,
        "scenario": scenario.name,
        "model": model_hash(scenario),
        "names": list(plan.totals),
        "totals": list(plan.totals.values()),
        "lower": plan.lower,
    }
    if plan.splits is not None:
        content["splits"] = plan.splits
    with atomic(path) as temporary:
        np.savez_compressed(temporary, **content)


def read(path: Path, scenario: Scenario, *, guidance: bool) -> Plan:
    """Read a plan.

    guidance: True if it must have route guidance, False if it must not
    Raises: InputError if it is no plan, or one of another scenario or set of controls
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            totals = zip(file["names"].tolist(), file["totals"].tolist(), strict=True)
            plan = Plan(
                perimeter=file["perimeter"],
                splits=file.get("splits"),
                start=str(file["start"]),
                totals=dict(totals),
                lower=float(file.get("lower", math.nan)),
            )
            model = str(file["model"])
    except Exception:
        raise InputError(f"{path}: is no plan; compute one with 'nmfd bound'") from None
    if model != model_hash(scenario):
        raise InputError(
            f"{path}: was computed for another demand or network than {scenario.name}'s; compute "
            "it again"
        )
    if (plan.splits is not None) != guidance:
        raise InputError(f"{path}: is a plan of {plan.name}; choose another file")
    return plan
