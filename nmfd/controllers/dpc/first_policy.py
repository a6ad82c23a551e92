"""First policies of a training: random, or like something known."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Generator
from torch.optim import Adam

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import load_policy, new_policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.controllers.rules import scenario_gate
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import shipped

# Like a gate.
GATE_STEPS = 1000  # Adam steps
GATE_BATCH = 256  # states in each
GATE_RATE = 2e-3  # learning rate
GATE_WIDTH = 0.05  # of the gate, in set points
GATE_FULLEST = 2.5  # largest accumulation of a protected region, in set points
GATE_OPEN = 0.95  # opening of the boundaries without a gate
# Like no control.
NO_CONTROL_WEIGHT = 0.1  # factor of the weights
NO_CONTROL_LOGIT = 3.0  # of u
NO_CONTROL_SPLIT = 1e-3  # least theta


def first_policy(setup: Dpc, planning: PlanningModel, *, guidance: bool) -> Policy:
    """Return the policy with which the settings begin a training.

    Raises: InputError if that of a file is of another kind
    """
    architecture = Architecture(
        guidance=guidance,
        local=setup.local,
        compact=planning.protected if setup.compact else (),
        per_region=setup.per_region,
        metering=setup.metering,
        prices=setup.prices,
        soft_exponential=setup.recipe.activation != "gelu",
        decoder_layers=setup.recipe.decoder_layers,
    )
    if setup.start:
        return _trained(shipped.found(setup.start, shipped.SCENARIO), planning, architecture)
    policy = new_policy(planning.network, architecture)
    if setup.numbers and isinstance(policy, CompactPolicy):
        policy.numbers.data.copy_(torch.tensor(Numbers(*setup.numbers)))
    if setup.from_no_control:
        begin_as_no_control(policy, planning.network)
    return policy


def _trained(file: Path, planning: PlanningModel, wanted: Architecture) -> Policy:
    """Return the policy in a file. Raises: InputError if it is of another kind"""
    policy, _ = load_policy(file, planning.network)
    own = asdict(policy.architecture)
    for name, value in asdict(wanted).items():
        if own[name] != value:
            raise InputError(
                f"{file}: {name}: is {own[name]!r}, but the settings train a policy with "
                f"{value!r}; set the options of its training, or start from another file"
            )
    return policy


def begin_as_no_control(
    policy: Policy,
    network: RegionalModel,
    weight: float = NO_CONTROL_WEIGHT,
    logit: float = NO_CONTROL_LOGIT,
) -> None:
    """Open the gateways of a policy, nearly whatever the state.

    Its split ratios become the nominal ones. Prices are small anyway.

    weight: factor of the decoders' weights (-)
    logit: logit of every u (-)
    """
    architecture = policy.architecture
    with torch.no_grad():
        for decoder in policy.decoders:
            decoder.weight.mul_(weight)
        policy.perimeter_decoder.bias.fill_(logit)
        if architecture.guidance and not architecture.prices:
            here = np.arange(network.regions)[:, None]
            nominal = torch.tensor(network.nominal_splits[here, policy.onward.numpy()])
            logits = nominal.clamp(min=NO_CONTROL_SPLIT).log()
            policy.splits_decoder.bias.copy_(logits.flatten())


def begin_as_gate(policy: Policy, rollout: Rollout, generator: Generator) -> None:
    """Fit a policy to gates that close as their protected region fills.

    A gate is half closed at the set point of PI gating. The other boundaries stay open.
    """
    network = rollout.planning.network
    gate = scenario_gate(rollout.planning)
    protected = gate.regions.tolist()
    set_point = torch.tensor(gate.set_point, dtype=rollout.dtype, device=rollout.device)
    boundaries = rollout.parameters.adjacency.expand(GATE_BATCH, -1, -1)
    optimizer = Adam(policy.parameters(), lr=GATE_RATE)
    for _ in range(GATE_STEPS):
        x, _ = rollout.random_start(GATE_BATCH, 0.0, 1.0, generator)
        drawn = torch.rand(GATE_BATCH, len(protected), generator=generator, dtype=torch.float32).to(
            x
        )
        vehicles = drawn * GATE_FULLEST * set_point
        factor = vehicles / x[:, protected].sum(-1).clamp(min=1.0)
        x[:, protected] *= factor.unsqueeze(-1)
        opening = torch.sigmoid((set_point - vehicles) / (GATE_WIDTH * set_point))
        wanted = torch.full_like(x, GATE_OPEN)
        wanted[:, :, protected] = opening.unsqueeze(1)
        perimeter, _ = policy(x)
        share = (perimeter - network.u_min) / (network.u_max - network.u_min)
        loss = torch.nn.functional.binary_cross_entropy(
            share.clamp(0.0, 1.0), wanted, weight=boundaries
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
