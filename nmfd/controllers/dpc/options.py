"""The options of DPC policies, declared: how they are trained, and how one goes on learning while it drives."""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from nmfd.controllers.options import Options
from nmfd.runs.config import Flow, Numbers, Problem, Share, setting, whole

if TYPE_CHECKING:
    from nmfd.model.planning import PlanningModel

MOST_STEPS = 10**7
WIDEST, DEEPEST = 10_000, 100  # units per layer, layers: of a policy that fits into memory
Activation = Literal["gelu", "relu", "tanh", "soft-exponential"]


class Training(Options):
    """Of the policy, and of the training that makes it: `nmfd train SCENARIO --controller NAME`."""

    width: int = whole("units per hidden layer", 128, low=1, high=WIDEST)
    layers: int = whole("hidden layers", 2, low=1, high=DEEPEST)
    activation: Activation = setting("of the hidden units", "gelu")
    local: bool = setting(
        "the same small network decides at every boundary, by how full the regions around it are: perimeter control "
        "of very many regions, and by a policy that was trained in another city",
        False,
    )
    compact: bool = setting(
        "a policy of a few numbers that can be read instead of a network: a gate on the protected regions, and prices "
        "of the ways through crowded regions, by which drivers are guided; trained on the CPU",
        False,
    )
    numbers: Annotated[Numbers, Field(min_length=8, max_length=11)] | None = setting(
        "those that a compact policy begins with: set_point and gain of the gate, its relief for crowded regions "
        "before it, price and price_from of the protected regions, elsewhere and elsewhere_from of the others, "
        "metering; then, 0 if omitted, the integral of the gate, and metering_protected, by which trips wait for the "
        "protected regions wherever they begin; and metering_gain, 1 if omitted, how fast those begin when there is "
        "room (nmfd/controllers/dpc/compact.py)",
        None,
        unit="-",
    )
    metering: bool = setting(
        "a compact policy lets trips wait where regions are full; for cities with +metering", False
    )
    descend: bool = setting(
        "false leaves a compact policy as it begins: its numbers were chosen elsewhere, as by cosim tune", True
    )
    steps: int = whole("Adam steps", 400, low=1, high=MOST_STEPS)
    batch: int = whole("rollouts per step", 16, low=1, high=100_000)
    learning_rate: float = setting(
        "of Adam at the start; falls to a tenth along a cosine", 1e-3, unit="-", gt=0.0, le=1.0
    )
    alternating: bool = setting("with route guidance, train the two decoders in turn (the backbone always)", True)
    demand_spread: Share = setting("every flow is scaled by a factor drawn from 1 - this to 1 + this, per rollout", 0.2)
    demand_low: float = setting(
        "every flow is scaled, besides, by one factor from this to demand_high, per rollout",
        1.0,
        unit="-",
        gt=0.0,
        le=1.0,
    )
    demand_high: float = setting("the upper end of that", 1.0, unit="-", ge=1.0, le=100.0)
    initial_share: Share = setting(
        "share of the rollouts that start from a random state, at a random time of the scenario", 0.5
    )
    noise: Flow = setting(
        "largest standard deviation of the Gaussian noise on the demand of the pairs that have any, at every step; "
        "every rollout has its own, evenly from 0 to this",
        0.0,
    )
    mfd_spread: Share = setting(
        "how far the regional model that every rollout has for itself is from the scenario's", 0.0
    )
    mfd_scale: float = setting(
        "of the accumulation axes of these models besides; below 1 for a city that may lock, by chance, before its "
        "mean outflow falls",
        1.0,
        unit="-",
        ge=0.1,
        le=1.0,
    )
    detour_cost: float = setting(
        "what a vehicle loses that is guided off the drivers' own split ratios, in the objective",
        0.0,
        unit="s",
        ge=0.0,
        le=1e6,
    )
    swing_cost: float = setting(
        "what it costs in the objective to open or close the gates between two regions once, whole and within one "
        "control interval",
        0.0,
        unit="veh s",
        ge=0.0,
        le=1e9,
    )
    from_no_control: bool = setting(
        "the first policy is nearly no control, so that what training finds no reason to change stays open", False
    )
    from_gating: bool = setting(
        "the first policy is nearly a gate on the protected regions, which holds them at the set point of pi-gating: "
        "where the regional model locks whatever small changes do, descent finds no way to a gate by itself",
        False,
    )

    @model_validator(mode="after")
    def _begins_as_one(self) -> "Training":
        if self.from_gating and self.from_no_control:
            raise Problem("from_gating", "a policy cannot begin as both, a gate and no control; omit one")
        if self.compact and (self.local or self.from_gating or self.from_no_control):
            raise Problem("compact", "begins with its numbers; omit local, from_gating, from_no_control")
        if self.numbers and not (self.compact and min(self.numbers) >= 0.0):
            raise Problem(
                "numbers", "expected 8 to 11 numbers >= 0, of a compact policy; add compact = true, or omit it"
            )
        if self.metering and not self.compact:
            raise Problem("metering", "only compact policies let trips wait; add compact = true, or omit it")
        if not (self.descend or self.compact):
            raise Problem("descend", "only a compact policy may stay as it begins; add compact = true, or omit it")
        return self

    def misfit(self, planning: "PlanningModel") -> Problem | None:
        """A gate without a region to protect."""
        if not (self.from_gating or self.compact) or planning.protected:
            return None
        return Problem(
            "compact" if self.compact else "from_gating",
            "expected a scenario with protected regions; name them, or omit it",
        )

    @property
    def levels(self) -> tuple[float, float]:
        """Between which the demand is scaled."""
        return self.demand_low, self.demand_high
