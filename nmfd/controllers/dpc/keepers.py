"""Keepers of a training: a policy file, or the memory for a module.

A keeper holds the best weights so far and returns them at the end.
"""

import copy
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nmfd.controllers.dpc.policy import Policy
from nmfd.controllers.dpc.policy_file import checkpoint, read_file
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.files import atomic

State = dict[str, Any]


class FileKeeper:
    """Policy file `out` of a training, with its state in `out`.resume."""

    def __init__(self, policy: Policy, network: RegionalModel, configuration: State, out: Path):
        self.policy = policy
        self._network = network
        self._configuration = configuration
        self._out = out
        self._state_file = out.with_name(out.name + ".resume")

    def keep(self, scores: dict[str, float]) -> None:
        """Write the policy with its validation."""
        configuration = self._configuration | scores
        write(checkpoint(self.policy, self._network, configuration), self._out)

    def save(self, state: State) -> None:
        """Write the state of the training."""
        write({"configuration": self._configuration, **state}, self._state_file)

    def resume(self, restore: Callable[[State], None]) -> None:
        """Pass the saved state to `restore`.

        Raises: InputError without a state, or for one of another training
        """
        file = self._state_file
        remedy = "train without --resume"
        wrong = f"is no state of a training; {remedy}"
        state = read_file(file, f"nothing to resume; {remedy}", wrong)
        before = state.get("configuration")
        if not isinstance(before, dict):
            raise InputError(f"{file}: {wrong}")
        for key, now in self._configuration.items():
            if before.get(key) != now:
                raise InputError(
                    f"{file}: {key}: was {before.get(key)!r}, now {now!r}; resume with the same "
                    f"settings or {remedy}"
                )
        try:
            restore(state)
        except Exception:  # whatever torch raises for tensors of another kind
            raise InputError(f"{file}: {wrong}") from None

    def finish(self) -> Path:
        """Remove the state; return the policy file."""
        self._state_file.unlink(missing_ok=True)
        return self._out


class ModuleKeeper:
    """Best weights of a module of the user's own, in memory."""

    def __init__(self, policy: nn.Module):
        self.policy = policy
        self._weights: State = {}

    def keep(self, scores: dict[str, float]) -> None:
        self._weights = copy.deepcopy(self.policy.state_dict())

    def save(self, state: State) -> None:
        pass

    def resume(self, restore: Callable[[State], None]) -> None:
        raise InputError("policy: a module has no file to resume from; omit resume")

    def finish(self) -> nn.Module:
        """Return the module with its best weights."""
        self.policy.load_state_dict(self._weights)
        return self.policy.cpu().eval()


Keeper = FileKeeper | ModuleKeeper


def write(content: dict, path: Path) -> None:
    """Write a checkpoint or the state of a training.

    The same content gives the same bytes.
    """
    buffer = io.BytesIO()  # given a path, torch would write its name into the file
    torch.save(content, buffer)
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
