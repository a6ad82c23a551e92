"""Controllers by name. The module behind a name is imported only when that controller is made.

Besides those here there are controllers of the user's own (nmfd.controllers.custom), by entry point or file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nmfd.errors import InputError, did_you_mean

if TYPE_CHECKING:  # `names` must answer without numpy, torch or casadi
    from nmfd.controllers.options import Options
    from nmfd.model.scenario import Scenario
    from nmfd.types import Controller


def _no_control(scenario: Scenario) -> Controller:
    from nmfd.controllers.no_control import NoControl

    return NoControl(scenario)


def _route_guidance(scenario: Scenario) -> Controller:
    from nmfd.controllers.no_control import RouteGuidance

    return RouteGuidance(scenario)


def _pi_gating(scenario: Scenario) -> Controller:
    from nmfd.controllers.pi_gating import PiGating

    return PiGating(scenario)


def _mpc_pc(scenario: Scenario) -> Controller:
    from nmfd.controllers.mpc.controller import EconomicMpc

    return EconomicMpc(scenario, guidance=False)


def _mpc_pcrg(scenario: Scenario) -> Controller:
    from nmfd.controllers.mpc.controller import EconomicMpc

    return EconomicMpc(scenario, guidance=True)


def _probing_pc(scenario: Scenario) -> Controller:
    from nmfd.controllers.excitation import Probing

    return Probing(scenario, guidance=False)


def _probing_pcrg(scenario: Scenario) -> Controller:
    from nmfd.controllers.excitation import Probing

    return Probing(scenario, guidance=True)


_WITHOUT_POLICY: dict[str, Callable[[Scenario], Controller]] = {
    "no-control": _no_control,
    "route-guidance": _route_guidance,
    "pi-gating": _pi_gating,
    "mpc-pc": _mpc_pc,
    "mpc-pcrg": _mpc_pcrg,
    "probing-pc": _probing_pc,
    "probing-pcrg": _probing_pcrg,
}
# Whether the policy guides routes too. The same as training.NAMES, which cannot be read without importing torch.
_WITH_POLICY = {"dpc-pc": False, "dpc-pcrg": True, "dpc-pc-robust": False, "dpc-pcrg-robust": True}
# The policy that is watched.
_GUARDED = {"dpc-pc-guarded": "dpc-pc", "dpc-pcrg-guarded": "dpc-pcrg"}
# The policy that goes on learning.
_ONLINE = {"dpc-pc-online": "dpc-pc", "dpc-pcrg-online": "dpc-pcrg"}
# Whether the plan guides routes too. The same as bound.NAMES.
_WITH_PLAN = {"bound-pc": False, "bound-pcrg": True}
OWN = "own"  # the table in [controllers] that holds those of controllers of the user's own
_OWN = re.compile(r".+\.py:\w+(?=\+|$)")


def names() -> tuple[str, ...]:
    """Every controller that is built in."""
    return (*_WITHOUT_POLICY, *_WITH_POLICY, *_GUARDED, *_ONLINE, *_WITH_PLAN)


def policy_names() -> tuple[str, ...]:
    """The controllers that need a trained policy."""
    return (*_WITH_POLICY, *_GUARDED, *_ONLINE)


def check(name: str) -> None:
    """InputError unless `name` is a controller."""
    if not known(name):
        raise InputError(f"controller {name!r} is unknown{did_you_mean(name, choice())}; choose from "
                         f"{', '.join(choice())}, or file.py:Class")


def split(name: str) -> tuple[str, list[str]]:
    """The controller of NAME+OPTION+..., and its options; the path of a controller in a file may hold a + too."""
    custom = _OWN.match(name)
    first, *rest = [custom[0], *name[custom.end():].split("+")[1:]] if custom else name.split("+")
    return first, rest


def known(name: str) -> bool:
    """Whether `name` is a controller. InputError for a file that is not there."""
    if name in names():
        return True
    from nmfd.controllers import custom

    if custom.is_file(name):
        custom.check(name)
        return True
    return name in custom.entry_points()


def choice() -> tuple[str, ...]:
    """Every controller that has a name of its own, built in or installed."""
    from nmfd.controllers import custom

    return (*names(), *(name for name in custom.entry_points() if name not in names()))


def is_own(name: str) -> bool:
    """Whether `name`, which must be known, is a controller of the user's own."""
    return name not in names()


def guides(name: str) -> bool:
    """Whether the controller `name`, which must be known, may guide routes, as one of the user's own might."""
    return is_own(name) or name == "route-guidance" or "-pcrg" in name


def configured_own(name: str, scenario: Scenario) -> tuple[str, Scenario]:
    """Of a controller of the user's own: the name of its table, and `scenario` with the tables of all such."""
    from nmfd.controllers import custom

    return custom.table_name(name), custom.with_tables(scenario)


def fingerprint(name: str, policy: Path | None) -> dict[str, object]:
    """What the runs of `name` depend on in files: its own source, or its `policy_path`."""
    if is_own(name):
        from nmfd.controllers import custom

        return custom.fingerprint(name)
    from nmfd.runs.files import file_hash

    return {} if policy is None else {"policy_hash": file_hash(policy)}


def policy_path(name: str, scenario: Scenario, policy: Path | None = None) -> Path | None:
    """The policy or plan file that `make` would read: `policy`, or the scenario's own; None for a controller without.

    InputError for an unknown name, for a `policy` that the controller has no use for, and for a missing file.
    """
    variant, name = name, split(name)[0]
    check(name)
    if name in _WITHOUT_POLICY or is_own(name):
        if policy is not None:
            raise InputError(
                f"{policy}: controller {name} reads no policy; only {', '.join((*policy_names(), *_WITH_PLAN))} do: "
                "leave it out")
        return None
    if policy is None and scenario.folder is None:
        raise InputError(f"controller {name}: scenario {scenario.name} has no folder with policies; give a file")
    kind, verb, suffix = ("plan", "compute", "npz") if name in _WITH_PLAN else ("policy", "train", "pt")
    owner = _owner(variant)
    path = scenario.folder / f"{owner}.{suffix}" if policy is None else Path(policy)
    if not path.is_file():
        scenario_text = "SCENARIO" if scenario.folder is None else scenario.folder
        out = "" if policy is None else f" --out {path}"
        command = f"nmfd {'bound' if kind == 'plan' else 'train'} {scenario_text} --controller {owner}{out}"
        raise InputError(f"{path}: no such {kind} for {name}; {verb} one with: {command}")
    return path


def _owner(name: str) -> str:
    """Whose policy and options `name` uses."""
    name, rest = split(name)
    return "+".join([{**_GUARDED, **_ONLINE}.get(name, name), *rest])


def make(name: str, scenario: Scenario, *, policy: Path | None = None) -> Controller:
    """The controller `name` for `scenario`; `policy` is the file of a policy or plan instead of the scenario's own.

    A name "NAME+..." stands for NAME with options and a policy of its own (nmfd.model.scenario.as_modelled). Raises
    InputError as `policy_path` does, and what the controller itself finds wrong with its options or policy.
    """
    from nmfd.model.scenario import as_modelled

    path = policy_path(name, scenario, policy)
    variant, name = name, split(name)[0]
    if is_own(name):
        from nmfd.controllers import custom

        return custom.make(name, scenario)
    scenario = as_modelled(scenario, _owner(variant))
    if path is None:
        return _WITHOUT_POLICY[name](scenario)
    if name in _WITH_PLAN:
        from nmfd.studies import bound

        return bound.load(path, scenario, guidance=_WITH_PLAN[name])
    if name in _GUARDED:
        from nmfd.controllers.dpc import fallback

        return fallback.load(path, scenario, guidance=_WITH_POLICY[_GUARDED[name]])
    if name in _ONLINE:
        from nmfd.controllers.dpc import online

        return online.load(path, scenario, guidance=_WITH_POLICY[_ONLINE[name]])
    from nmfd.controllers.dpc import policy as dpc

    return dpc.load(path, scenario, guidance=_WITH_POLICY[name])


def declarations() -> dict[str, type[Options]]:
    """Controller -> the declaration of its options."""
    from nmfd.controllers.dpc.options import TRAINED, Online
    from nmfd.controllers.mpc.controller import Mpc
    from nmfd.controllers.options import Options
    from nmfd.controllers.pi_gating import Gating, SetPoint

    return {**dict.fromkeys(names(), Options), "pi-gating": Gating, **TRAINED,
            **dict.fromkeys(("probing-pc", "probing-pcrg"), SetPoint), **dict.fromkeys(("mpc-pc", "mpc-pcrg"), Mpc),
            **dict.fromkeys(_ONLINE, Online)}


def check_options(scenario: Scenario) -> None:
    """InputError for a wrong option of any controller in the scenario's [controllers], whether it is run or not.

    An option of a controller that nobody runs today would else be found wrong in the middle of tomorrow's work. The
    networks of other models are read only where they are used.
    """
    from dataclasses import replace

    from nmfd.controllers.options import options
    from nmfd.model.scenario_file import PlanningOptions
    from nmfd.runs import config

    where = "scenario.toml" if scenario.folder is None else scenario.folder / "scenario.toml"
    tables = scenario.controller_options
    declared = declarations()
    for variant, table in tables.items():
        if variant == OWN:  # checked by those controllers, if at all
            continue
        name = split(variant)[0]
        if name not in names():
            raise config.error(
                where, f"controllers.{variant}", f"unknown controller{did_you_mean(name, names())}; choose from "
                f"{', '.join(names())}, or one of them with + and the options of a strategy; that of a controller of "
                f"your own is controllers.{OWN}.{variant}")
        own = {**tables.get(name, {}), **table}
        model = {"model": own.pop("model")} if "model" in own else {}
        config.checked(PlanningOptions, model, where, f"controllers.{variant}.")
        options(declared[name], replace(scenario, controller_options={name: own}), name, variant)
