"""Policy files: weights with what they were trained for, and the controllers in them."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel


def new_policy(network: RegionalModel, architecture: Architecture) -> Policy:
    """Return a policy of this architecture with initial weights."""
    return (CompactPolicy if architecture.compact else Policy)(network, architecture)


def checkpoint(policy: Policy, network: RegionalModel, configuration: Mapping) -> dict:
    """Return the content of a policy file: weights and scale, architecture, network hash,
    configuration."""
    return {
        "architecture": asdict(policy.architecture),
        "network": network.name,
        "network_hash": network.hash,
        "configuration": dict(configuration),
        "weights": {
            key: value.detach().cpu().clone() for key, value in policy.state_dict().items()
        },
    }


def read_file(path: Path, missing: str = "no such policy; train one with 'nmfd train'") -> Any:
    """Read a checkpoint or the state of a training, without executing code from it. Raise
    InputError."""
    if not Path(path).is_file():
        raise InputError(f"{path}: {missing}")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception:
        raise InputError(f"{path}: is no policy file; train one with 'nmfd train'") from None


def load_policy(path: Path, network: RegionalModel) -> tuple[Policy, dict]:
    """Return the policy in `path` and its checkpoint. Raise InputError if it was trained for
    another network."""
    content = read_file(path)
    try:
        names = {field.name for field in fields(Architecture)}
        architecture = Architecture(
            **{key: value for key, value in content["architecture"].items() if key in names}
        )
        if (trained := content["network_hash"]) != network.hash and not architecture.local:
            other = (
                f"the policy was trained for network {content['network']!r} ({trained}), not for"
            )
            remedy = "train one with 'nmfd train'"
            raise InputError(
                f"{path}: network_hash: {other} {network.name!r} ({network.hash}); {remedy}"
            )
        policy = new_policy(network, architecture)
        policy.load_state_dict(content["weights"])
    except (KeyError, TypeError, RuntimeError):
        raise InputError(
            f"{path}: is damaged or of another version; train it again with 'nmfd train'"
        ) from None
    return policy, content


def guided_by(content: Any) -> bool:
    """Return True if the policy in a checkpoint guides routes."""
    architecture = content.get("architecture", {}) if isinstance(content, Mapping) else {}
    return bool(architecture.get("guidance"))


def outside_training(content: Mapping, level: float) -> str:
    """Return a sentence if `level` times the demand is outside the training range of a checkpoint,
    else ""."""
    low, high = (content["configuration"].get(key, 1.0) for key in ("demand_low", "demand_high"))
    if low - 1e-9 <= level <= high + 1e-9:
        return ""
    trained = f"{low:g} times" if low == high else f"{low:g} to {high:g} times"
    return f"demand times {level:g} is outside of what the policy was trained on, {trained} that of the scenario"


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> DpcController:
    """Return the controller in `path`. Raise InputError if it does not fit the network or the
    name."""
    policy, _ = load_policy(path, planning.network)
    if policy.architecture.guidance != guidance:
        has, wanted = ("dpc-pc", "dpc-pcrg") if guidance else ("dpc-pcrg", "dpc-pc")
        raise InputError(
            f"{path}: is a {has} policy, not {wanted}; choose --controller {has} or another file"
        )
    return DpcController(policy)
