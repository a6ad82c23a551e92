"""Policy files: weights, and what they were trained for."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path

import torch

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel


def new_policy(network: RegionalModel, architecture: Architecture) -> Policy:
    """Return a policy of this architecture with initial weights."""
    if architecture.compact:
        return CompactPolicy(network, architecture)
    return Policy(network, architecture)


def checkpoint(policy: Policy, network: RegionalModel, configuration: Mapping) -> dict:
    """Return the content of a policy file."""
    weights = policy.state_dict()
    return {
        "architecture": asdict(policy.architecture),
        "network": network.name,
        "network_hash": network.hash,
        "configuration": dict(configuration),
        "weights": {name: tensor.detach().cpu().clone() for name, tensor in weights.items()},
    }


def read_file(
    path: Path,
    missing: str = "no such policy; train one with 'nmfd train'",
    wrong: str = "is no policy file; train one with 'nmfd train'",
) -> dict:
    """Return the content of a policy file, without executing code from it.

    missing, wrong: messages if there is no file, or if it holds something else
    Raises: InputError
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: {missing}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:
        raise InputError(f"{path}: {wrong}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: {wrong}")
    return content


def load_policy(path: Path, network: RegionalModel) -> tuple[Policy, dict]:
    """Return the policy in `path` and the content of the file.

    Raises: InputError for a file of another network or version
    """
    content = read_file(path)
    names = {field.name for field in fields(Architecture)}
    try:
        given = {key: value for key, value in content["architecture"].items() if key in names}
        architecture = Architecture(**given)
        trained = content["network_hash"]
        if trained != network.hash and not architecture.local:
            other = f"network {content['network']!r} ({trained})"
            problem = f"the policy was trained for {other}, not for {network.name!r}"
            raise InputError(
                f"{path}: network_hash: {problem} ({network.hash}); train one with 'nmfd train'"
            )
        policy = new_policy(network, architecture)
        policy.load_state_dict(content["weights"])
    except (AttributeError, KeyError, TypeError, RuntimeError):
        problem = "is damaged or of another version; train it again with 'nmfd train'"
        raise InputError(f"{path}: {problem}") from None
    return policy, content


def guided_by(content: object) -> bool:
    """Return True if the policy in a checkpoint guides routes."""
    architecture = content.get("architecture", {}) if isinstance(content, Mapping) else {}
    return bool(architecture.get("guidance"))


def outside_training(content: Mapping, level: float) -> str:
    """Return a warning if a policy was not trained for a demand, else "".

    content: of the policy file
    level: factor of the scenario's demand (-)
    """
    configuration = content["configuration"]
    low = configuration.get("demand_low", 1.0)
    high = configuration.get("demand_high", 1.0)
    if low - 1e-9 <= level <= high + 1e-9:
        return ""
    trained = f"{low:g} times"
    if low < high:
        trained = f"{low:g} to {high:g} times"
    outside = f"demand times {level:g} is outside of what the policy was trained on"
    return f"{outside}, {trained} that of the scenario"


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> DpcController:
    """Return the controller in `path`.

    Raises: InputError if it does not fit the network or the name
    """
    policy, _ = load_policy(path, planning.network)
    if policy.architecture.guidance != guidance:
        has, wanted = ("dpc-pc", "dpc-pcrg") if guidance else ("dpc-pcrg", "dpc-pc")
        raise InputError(
            f"{path}: is a {has} policy, not {wanted}; choose --controller {has} or another file"
        )
    return DpcController(policy)
