"""Options of DPC policies, of their training, and of rules.

Policies and torch, which takes two seconds, are imported where one is made.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import model_validator

from nmfd.controllers.base import FileKind, Options
from nmfd.controllers.dpc.numbers import (
    LEVELS_MEANING,
    MEANING,
    Levels,
    LevelsOption,
    Numbers,
    NumbersOption,
)
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.runs.config import Flow, Problem, Share, Text, Texts, got, setting, whole

if TYPE_CHECKING:
    from nmfd.controllers.dpc.policy import DpcController

POLICY = FileKind("policy", ".pt", "nmfd train {folder} --controller {name}")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Parts of a training that a preset changes together; by default ours.

    learning_rate: constant; None: that of the settings, along a cosine
    weight_decay: of Adam; batch: rollouts per Adam step; clip: largest norm of the gradient
    activation: "gelu" or "soft-exponential"; decoder_layers: hidden layers of each decoder
    loss: mean over the rollouts of the "log" of the total time spent, or of the "sum" itself
    epoch: Adam steps after which the decoders take turns
    process_std: standard deviation of the noise on each x_ij that is not empty (veh), added
        after every interval
    largest_start: initial x_ij are uniform up to it, under the demand of the scenario (veh); 0:
        random states at random times for half of the rollouts, and every flow is scaled
    """

    learning_rate: float | None = None
    weight_decay: float = 0.0
    batch: int = 16
    clip: float = 1.0
    activation: str = "gelu"
    decoder_layers: int = 0
    loss: str = "log"
    epoch: int = 1
    process_std: float = 0.0
    largest_start: float = 0.0


# Tumu et al., by section. Training: learning rate (no schedule is named), weight decay, batch,
# sizes of 128, alternation by epoch; no clipping is named. Policy Network: SoftExponential,
# decoders that are networks of hidden layers. Problem Formulation: plain sum of the accumulations,
# noise on the state. Conclusion: one scenario. Not stated: the number of steps, the length of an
# epoch (here ten batches), hidden layers (here two, one in each decoder), and initial states (here
# those of Region Scaling Results, the only ones that are named).
PUBLISHED = Recipe(
    learning_rate=1e-4,
    weight_decay=1e-6,
    batch=256,
    clip=math.inf,
    activation="soft-exponential",
    decoder_layers=1,
    loss="sum",
    epoch=10,
    process_std=0.25,
    largest_start=100.0,
)


class Dpc(Options):
    """Policy of differentiable predictive control.

    The options of its training are here, too.

    >>> nmfd.run("economic_mpc", nmfd.Dpc(policy="economic_mpc/dpc-pc.pt"), steps=1).controller
    'dpc-pc(policy="economic_mpc/dpc-pc.pt")'
    """

    guidance: bool | None = setting(
        "route guidance besides perimeter control; by default as the policy has it", None
    )
    policy: Text | Path | None = setting(
        "policy file; by default SCENARIO/NAME.pt, as `nmfd train` writes it", None
    )
    local: bool = setting(
        "one small network for every boundary, which fits other cities; perimeter control", False
    )
    compact: bool = setting(
        "gates and prices of a few readable numbers instead of a network; on the CPU", False
    )
    numbers: NumbersOption | None = setting(
        f"initial numbers of a compact policy: {MEANING}", None, unit="-"
    )
    start: Text | Path | None = setting(
        "policy file that training begins with; by default an untrained policy", None
    )
    kept: Texts = setting("numbers of a compact policy that training leaves as they are", ())
    per_region: bool = setting(
        "a compact policy finds for each region the accumulation that counts as full", False
    )
    prices: bool = setting(
        "a network chooses prices of the ways through regions instead of split ratios", False
    )
    metering: bool = setting(
        "the policy makes trips wait while regions are full; for +metering", False
    )
    steps: int = whole("Adam steps", 400, low=1, high=10**7)
    learning_rate: float = setting(
        "of Adam; falls to a tenth along a cosine", 1e-3, unit="-", gt=0.0, le=1.0
    )
    demand_low: float = setting(
        "least factor of all demand, drawn per rollout", 1.0, unit="-", gt=0.0, le=100.0
    )
    demand_high: float = setting("largest factor of all demand", 1.0, unit="-", gt=0.0, le=100.0)
    noise: Flow = setting(
        "largest standard deviation of Gaussian noise on the demand; drawn per rollout", 0.0
    )
    mfd_spread: Share = setting(
        "standard deviation of the logarithm of the MFD of every region, per rollout", 0.0
    )
    mfd_scale: float = setting(
        "factor of the MFDs' accumulation axes; below 1 for a city that may lock early",
        1.0,
        unit="-",
        ge=0.1,
        le=1.0,
    )
    holding_cost: float = setting(
        "time lost by a vehicle that a gate holds, so that gates close for a gain only",
        0.0,
        unit="s",
        ge=0.0,
        le=1e6,
    )
    detour_cost: float = setting(
        "time lost by a vehicle off the nominal splits", 0.0, unit="s", ge=0.0, le=1e6
    )
    preset: Literal["ours", "published"] = setting(
        "recipe of the training; published: that of Tumu et al.", "ours"
    )
    preset_without: Texts = setting(
        f"parts of the preset that stay ours: {', '.join(vars(PUBLISHED))}", ()
    )
    from_no_control: bool = setting("the initial policy is nearly no control", False)
    from_gating: bool = setting(
        "the initial policy is nearly a gate at the set point of pi-gating", False
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "Dpc":
        if self.demand_low > self.demand_high:
            problem = f"expected at most demand_high, {self.demand_high:g}, got {self.demand_low:g}"
            raise Problem("demand_low", f"{problem}; change one of them")
        if self.from_gating and self.from_no_control:
            raise Problem(
                "from_gating", "a policy cannot begin as a gate and as no control; omit one"
            )
        if self.compact and (self.local or self.from_gating or self.from_no_control):
            raise Problem(
                "compact", "begins with its numbers; omit local, from_gating, from_no_control"
            )
        if self.numbers and not (self.compact and min(self.numbers) >= 0.0):
            raise Problem(
                "numbers", "expected 8 to 12 numbers >= 0 of a compact policy; add compact = true"
            )
        if self.start and (self.numbers or self.from_gating or self.from_no_control):
            raise Problem(
                "start",
                "a trained policy begins as it is; omit numbers, from_gating, from_no_control",
            )
        if self.kept and not (self.compact and set(self.kept) <= set(Numbers._fields)):
            names = got(
                f"numbers of a compact policy, of {', '.join(Numbers._fields)}", list(self.kept)
            )
            raise Problem("kept", f"{names}; correct them or add compact = true")
        if self.per_region and not self.compact:
            raise Problem("per_region", "is for a compact policy; omit it or add compact = true")
        if self.local and self.metering:
            raise Problem("metering", "a local policy controls gates only; omit it")
        if self.compact and self.prices:
            raise Problem("prices", "a compact policy has prices anyway; omit it")
        if self.preset != "ours" and (
            self.compact or self.local or self.from_gating or self.from_no_control
        ):
            raise Problem(
                "preset",
                "begins with a random network; omit compact, local, from_gating, from_no_control",
            )
        if self.preset_without and (
            self.preset == "ours" or not set(self.preset_without) <= set(vars(PUBLISHED))
        ):
            problem = got(
                f"parts of the preset published, of {', '.join(vars(PUBLISHED))}",
                list(self.preset_without),
            )
            raise Problem("preset_without", f"{problem}; correct them or add preset")
        return self

    @property
    def guides(self) -> bool:
        if self.guidance is not None or self.policy is None:
            return self.guidance is not False
        from nmfd.controllers.dpc.policy_file import guided_by, read_file

        file = read_file(shipped.found(self.policy, shipped.SCENARIO))
        return guided_by(file)

    @property
    def reads(self) -> FileKind:
        return POLICY

    @property
    def file(self) -> str | Path | None:
        return self.policy

    def load(self, file: Path, planning: PlanningModel, scenario: Scenario) -> "DpcController":
        from nmfd.controllers.dpc.policy_file import load

        return load(file, planning, guidance=self.guides)

    @property
    def recipe(self) -> Recipe:
        """The preset with its exceptions."""
        ours = Recipe()
        parts = {name: getattr(ours, name) for name in self.preset_without}
        return ours if self.preset == "ours" else replace(PUBLISHED, **parts)

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return a gate without a protected region as a problem."""
        if not (self.from_gating or self.compact) or planning.protected:
            return None
        key = "compact" if self.compact else "from_gating"
        return Problem(key, "expected a scenario with protected regions; name them, or omit it")


def numbers_problem(
    numbers: tuple[float, ...], planning: PlanningModel, *, possible: bool, allowed: str
) -> Problem | None:
    """Return wrong numbers of a rule, or no protected region, as a problem."""
    if not possible:
        return Problem("numbers", got(allowed, list(numbers)))
    if not planning.protected:
        return Problem("numbers", "expected a scenario with protected regions; name them")
    return None


class GatingRule(Options):
    """Gates by numbers that were tuned in SUMO."""

    guidance: ClassVar[bool] = False
    name: ClassVar[str] = "gating-rule"

    numbers: NumbersOption = setting(MEANING, Numbers(), unit="-")
    metering: bool = setting("trips wait while regions are full; for +metering", False)

    def misfit(self, planning: PlanningModel) -> Problem | None:
        possible = min(self.numbers) >= 0.0
        allowed = "8 to 12 numbers >= 0"
        return numbers_problem(self.numbers, planning, possible=possible, allowed=allowed)

    def make(self, planning: PlanningModel) -> "DpcController":
        from nmfd.controllers.dpc.compact import CompactPolicy, rule

        return rule(CompactPolicy, planning, self)


class PricingRule(GatingRule):
    """Prices of ways through regions, and gates, with numbers tuned in SUMO."""

    guidance: ClassVar[bool] = True
    name: ClassVar[str] = "pricing-rule"


class ConstantControl(Options):
    """Gates, prices and departure rates that never change."""

    numbers: LevelsOption = setting(LEVELS_MEANING, Levels(), unit="-")
    guidance: bool = setting("prices guide drivers", True)
    metering: bool = setting("trips wait beyond a rate; for +metering", False)
    name: ClassVar[str] = "constant"

    def misfit(self, planning: PlanningModel) -> Problem | None:
        possible = min(self.numbers) >= 0.0 and Levels(*self.numbers).gate <= 1.0
        allowed = "4 numbers >= 0, the first at most 1"
        return numbers_problem(self.numbers, planning, possible=possible, allowed=allowed)

    def make(self, planning: PlanningModel) -> "DpcController":
        from nmfd.controllers.dpc.compact import rule
        from nmfd.controllers.dpc.constant import ConstantPolicy

        return rule(ConstantPolicy, planning, self)
