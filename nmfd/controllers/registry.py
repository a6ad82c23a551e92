"""Controllers by name. The module behind a name is imported only when that controller is made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nmfd.errors import InputError

if TYPE_CHECKING:  # `names` must answer without numpy, torch or casadi
    from nmfd.scenario import Scenario
    from nmfd.types import Controller


def _no_control(scenario: Scenario) -> Controller:
    from nmfd.controllers.fixed import NoControl

    return NoControl(scenario)


def _pi_gating(scenario: Scenario) -> Controller:
    from nmfd.controllers.gating import PiGating

    return PiGating(scenario)


def _mpc_pc(scenario: Scenario) -> Controller:
    from nmfd.controllers.mpc import EconomicMpc

    return EconomicMpc(scenario, guidance=False)


def _mpc_pcrg(scenario: Scenario) -> Controller:
    from nmfd.controllers.mpc import EconomicMpc

    return EconomicMpc(scenario, guidance=True)


_WITHOUT_POLICY: dict[str, Callable[[Scenario], Controller]] = {
    "no-control": _no_control,
    "pi-gating": _pi_gating,
    "mpc-pc": _mpc_pc,
    "mpc-pcrg": _mpc_pcrg,
}
# Whether the policy guides routes too. The same as training.NAMES, which cannot be read without importing torch.
_WITH_POLICY = {"dpc-pc": False, "dpc-pcrg": True}


def names() -> tuple[str, ...]:
    """Every controller."""
    return (*_WITHOUT_POLICY, *_WITH_POLICY)


def policy_names() -> tuple[str, ...]:
    """The controllers that need a trained policy."""
    return tuple(_WITH_POLICY)


def check(name: str) -> None:
    """InputError unless `name` is a controller."""
    if name not in names():
        raise InputError(f"controller {name!r} is unknown; choose from {', '.join(names())}")


def policy_path(name: str, scenario: Scenario, policy: Path | None = None) -> Path | None:
    """The policy file that `make` would read: `policy`, or the scenario's own; None for a controller without one.

    InputError for an unknown name, for a `policy` that the controller has no use for, and for a missing file.
    """
    check(name)
    if name not in _WITH_POLICY:
        if policy is not None:
            raise InputError(
                f"{policy}: controller {name} reads no policy; only {' and '.join(policy_names())} do: leave it out")
        return None
    if policy is None and scenario.folder is None:
        raise InputError(f"controller {name}: scenario {scenario.name} has no folder with policies; give a file")
    path = scenario.folder / f"{name}.pt" if policy is None else Path(policy)
    if not path.is_file():
        scenario_text = "SCENARIO" if scenario.folder is None else scenario.folder
        out = "" if policy is None else f" --out {path}"
        raise InputError(
            f"{path}: no such policy for {name}; train one with: nmfd train {scenario_text} --controller {name}{out}")
    return path


def make(name: str, scenario: Scenario, *, policy: Path | None = None) -> Controller:
    """The controller `name` for `scenario`; `policy` is the file of a DPC policy instead of the scenario's own.

    Raises InputError as `policy_path` does, and what the controller itself finds wrong with its options or policy.
    """
    path = policy_path(name, scenario, policy)
    if path is None:
        return _WITHOUT_POLICY[name](scenario)
    from nmfd.controllers import dpc

    return dpc.load(path, scenario, guidance=_WITH_POLICY[name])
