"""Policy files: weights with what they were trained for, written by `training`, and the controllers in them."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.options import DEEPEST, WIDEST
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.files import check_file

FORMAT = 1


def new_policy(network: RegionalModel, architecture: Architecture) -> Policy:
    """A policy of this architecture, with the weights that it begins with."""
    return (CompactPolicy if architecture.compact else Policy)(network, architecture)


def checkpoint(policy: Policy, network: RegionalModel, configuration: Mapping) -> dict:
    """What a policy file holds: weights with the normalisation, architecture, network hash, configuration."""
    return {
        "format": FORMAT,
        "architecture": asdict(policy.architecture),
        "network": network.name,
        "network_hash": network.hash,
        "configuration": dict(configuration),
        "weights": {key: value.detach().cpu().clone() for key, value in policy.state_dict().items()},
    }


def read_file(path: Path, missing: str, damaged: str) -> Any:
    """What torch wrote to `path`, on the CPU; InputError in these words. No code of the file is executed."""
    check_file(path, "train one with 'nmfd train'")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InputError(f"{path}: {missing}") from None
    except Exception:
        raise InputError(f"{path}: {damaged}") from None


def read_policy_file(path: Path) -> Any:
    """The checkpoint in `path`, unchecked. InputError if there is none."""
    return read_file(
        path, "no such policy; train one with 'nmfd train'", "is not a policy file; train one with 'nmfd train'"
    )


def load_policy(path: Path, network: RegionalModel) -> tuple[Policy, dict]:
    """The policy in `path` and its whole checkpoint. InputError if it is none, or was trained for another network."""
    content = read_policy_file(path)
    try:
        if content["format"] != FORMAT:
            raise InputError(f"{path}: format: expected {FORMAT}, got {content['format']!r} instead; train it again")
        architecture = Architecture(**content["architecture"])
        if content["network_hash"] != network.hash and architecture.local is not True:
            raise InputError(
                f"{path}: network_hash: the policy was trained for network {content['network']!r} "
                f"({content['network_hash']}), not for {network.name!r} ({network.hash}); train one with 'nmfd train'"
            )
        flags = {
            type(flag)
            for flag in (architecture.guidance, architecture.sparse, architecture.local, architecture.metering)
        }
        if not all(type(region) is int and 0 <= region < network.regions for region in architecture.compact):
            raise KeyError("architecture")
        if not (0 < architecture.width <= WIDEST and 0 < architecture.layers <= DEEPEST and flags == {bool}):
            raise KeyError("architecture")
        policy = new_policy(network, architecture)
        policy.load_state_dict(content["weights"])
    except (LookupError, TypeError, RuntimeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is damaged or of another version; train it again with 'nmfd train'") from None
    return policy, content


def outside_training(content: Mapping, level: float) -> str:
    """What to say of a run at `level` times the demand, outside of what the policy of this checkpoint was trained on;
    "" within it."""
    low, high = (content["configuration"].get(key, 1.0) for key in ("demand_low", "demand_high"))
    if low - 1e-9 <= level <= high + 1e-9:
        return ""
    trained = f"{low:g} times" if low == high else f"{low:g} to {high:g} times"
    return f"demand times {level:g} is outside of what the policy was trained on, {trained} that of the scenario"


def check_guidance(policy: Policy, path: Path, guidance: bool) -> None:
    """InputError if the policy in `path` is of the other kind."""
    if policy.architecture.guidance != guidance:
        has, wanted = ("dpc-pc", "dpc-pcrg") if guidance else ("dpc-pcrg", "dpc-pc")
        raise InputError(f"{path}: is a {has} policy, not {wanted}; choose --controller {has} or another file")


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> DpcController:
    """The controller in the policy file `path`; InputError if it does not fit the scenario's network or the name."""
    policy, _ = load_policy(path, planning.network)
    check_guidance(policy, path, guidance)
    return DpcController(policy)
