"""Single changes of a policy: does descent leave something obvious undone?

Where a sigmoid is saturated, descent does not move it. So a training looks whether one output,
replaced as a whole, is better on its own objective: gates at the critical accumulation or open,
prices halved, doubled or off, no metering, or with a compact policy a stricter or looser one.

What an output of a compact policy gains on the model is worth less in a city, which is not quite
the model. So where it gains next to nothing, training leaves it out at the end, by the changes of
SIMPLER.
"""

import copy
from collections.abc import Callable, Collection, Iterator
from typing import Any

import torch

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.policy import Policy
from nmfd.model.planning import PlanningModel
from nmfd.tensors import PerPair, PerRegion

GATE, OPEN = "gates at the critical accumulation", "gates open"
HALVED, DOUBLED, UNPRICED = "prices halved", "prices doubled", "no prices"
UNPRICED_ELSEWHERE = "no prices elsewhere"
UNMETERED, STRICTER, LOOSER = "no metering", "stricter metering", "looser metering"
SIMPLER = (OPEN, UNPRICED_ELSEWHERE, UNMETERED, UNPRICED)
FACTORS = {HALVED: 0.5, DOUBLED: 2.0, UNPRICED: 0.0}
METERING_FACTORS = {STRICTER: 0.8, LOOSER: 1.25}  # the first leads out of a lock
STEEP = 20.0  # logit of a gate per relative accumulation
# Numbers of a compact policy, on the flowing side of its sigmoids.
GATE_NUMBERS = {"set_point": 1.0, "gain": 5.0}
OPEN_NUMBERS = {"set_point": 2.0, "gain": 2.0}
UNMETERED_NUMBERS = {"metering": 5.0, "metering_protected": 0.0}


def changed_policies(
    policy: Policy, planning: PlanningModel, kept: Collection[str] = ()
) -> Iterator[tuple[str, Policy]]:
    """Yield the name of each single change, and a policy with it.

    kept: numbers of a compact policy that stay as they are
    """
    if not isinstance(policy, CompactPolicy):
        yield from _with_outputs(policy, planning)
        return
    numbers = Numbers(*policy.numbers.tolist())
    changes = {}
    if policy.architecture.metering:
        for name, factor in METERING_FACTORS.items():
            changes[name] = {"metering": factor * numbers.metering}
        changes[UNMETERED] = UNMETERED_NUMBERS
    changes |= {GATE: GATE_NUMBERS, OPEN: OPEN_NUMBERS}
    if policy.architecture.guidance:
        for name, factor in FACTORS.items():
            prices = {"price": factor * numbers.price, "elsewhere": factor * numbers.elsewhere}
            changes[name] = prices
        changes[UNPRICED_ELSEWHERE] = {"elsewhere": 0.0}
    for name, values in changes.items():
        if not set(values) & set(kept):
            changed = copy.deepcopy(policy)
            others = torch.tensor(numbers._replace(**values))
            changed.numbers.data.copy_(others)
            yield name, changed


def _with_outputs(policy: Policy, planning: PlanningModel) -> Iterator[tuple[str, Policy]]:
    """Yield copies of a network whose outputs are replaced."""
    network = planning.network
    held = torch.zeros(network.regions, dtype=torch.bool)
    held[list(planning.protected)] = True
    open_perimeter = torch.tensor(network.open_perimeter, dtype=torch.float32)
    critical = torch.tensor(network.critical, dtype=torch.float32)

    def gates(x: PerPair, perimeter: PerPair) -> PerPair:
        full = x.sum(-1) / critical.to(x)
        closing = torch.sigmoid(STEEP * (1.0 - full)).unsqueeze(-2)
        opened = open_perimeter.to(x)
        least = opened.clamp(max=network.u_min)
        gate = least + (opened - least) * closing
        return torch.where(held.to(x.device), gate, perimeter)

    if planning.protected:
        yield GATE, _with_perimeter(policy, gates)
    yield OPEN, _with_perimeter(policy, lambda x, perimeter: open_perimeter.to(x).expand_as(x))
    if policy.architecture.prices:
        for name, factor in FACTORS.items():
            yield name, _with_method(policy, "prices", _scaled(policy, factor))
    if policy.architecture.metering:
        yield UNMETERED, _with_method(policy, "metering", lambda x: None)


def _scaled(policy: Policy, factor: float) -> Callable[[PerPair], PerRegion]:
    """Return the prices of a policy times a factor."""

    def prices(x: PerPair) -> PerRegion:
        own = policy.prices(x)
        assert own is not None
        return factor * own

    return prices


def _with_perimeter(policy: Policy, perimeter: Callable[[PerPair, PerPair], PerPair]) -> Policy:
    """Return a copy whose perimeter is a function of state and own perimeter."""

    def forward(x: PerPair, memory: Any = None) -> tuple[PerPair, Any]:
        own, splits = policy(x, memory)
        return perimeter(x, own), splits

    return _with_method(policy, "forward", forward)


def _with_method(policy: Policy, name: str, method: Callable) -> Policy:
    """Return a copy with the same weights and another method."""
    changed = copy.copy(policy)
    setattr(changed, name, method)
    return changed
