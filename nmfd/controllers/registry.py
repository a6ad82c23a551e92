"""Controllers by name.

Besides those here there are controllers of the user's own (nmfd.controllers.custom), by entry point or file.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from nmfd.controllers import custom, open_loop
from nmfd.controllers.dpc import policy_file, training
from nmfd.controllers.dpc.options import Training
from nmfd.controllers.excitation import Probing
from nmfd.controllers.greedy import Greedy
from nmfd.controllers.mpc import controller as mpc
from nmfd.controllers.no_control import NoControl, RouteGuidance
from nmfd.controllers.options import Options, options
from nmfd.controllers.pi_gating import Gating, PiGating, SetPoint
from nmfd.errors import InputError, did_you_mean
from nmfd.model.planning import PlanningOptions, planning_model
from nmfd.model.scenario import Scenario
from nmfd.runs import config, shipped
from nmfd.runs.files import file_hash
from nmfd.types import Controller

ALSO = " and route guidance"
OWN = "own"  # the table in [controllers] that holds those of controllers of the user's own
_OWN = re.compile(r".+\.py:\w+(?=\+|$)")


TERMINAL = {"mpc-pc-terminal": "dpc-pc", "mpc-pcrg-terminal": "dpc-pcrg"}  # whose value function they need


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A file that a controller reads: what it is, the command of `nmfd` that makes it and what that does, and the end
    of its name."""

    text: str
    command: str
    verb: str
    suffix: str


POLICY = Kind(text="policy", command="train", verb="train", suffix="pt")
PLAN = Kind(text="plan", command="bound", verb="compute", suffix="npz")
VALUE = Kind(text="value function", command="value", verb="learn", suffix="npz")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A controller that is built in.

    text: what it does, in a line
    make: of the planning model, and of the policy's file where there is one
    guides: whether it may guide routes
    policy: whose file it reads, "" for none
    reads: what that is
    declared: its options
    """

    text: str
    make: Callable[..., Controller]
    guides: bool = False
    policy: str = ""
    reads: Kind = POLICY
    declared: type[Options] = Options


_ENTRIES = {
    "no-control": Entry(text="every gateway open, no guidance: what others are compared with", make=NoControl),
    "route-guidance": Entry(
        text="drivers are guided by travel times alone, every gateway open", make=RouteGuidance, guides=True
    ),
    "pi-gating": Entry(text="a PI gate holds the protected regions at a set point", make=PiGating, declared=Gating),
    "greedy": Entry(text="bang-bang: every gate closed into the more congested region of its two", make=Greedy),
    "mpc-pc": Entry(
        text="economic MPC on the regional model, perimeter control",
        make=partial(mpc.EconomicMpc, guidance=False),
        declared=mpc.Mpc,
    ),
    "mpc-pcrg": Entry(
        text="the same with route guidance", make=partial(mpc.EconomicMpc, guidance=True), guides=True, declared=mpc.Mpc
    ),
    **{
        name: Entry(
            text=f"economic MPC, perimeter control{ALSO * training.NAMES[dpc]}, with the value of {dpc} as terminal cost",
            make=partial(mpc.load, guidance=training.NAMES[dpc]),
            guides=training.NAMES[dpc],
            policy=name,
            reads=VALUE,
            declared=mpc.Mpc,
        )
        for name, dpc in TERMINAL.items()
    },
    "probing-pc": Entry(
        text="excitation for cosim identify, perimeter control",
        make=partial(Probing, guidance=False),
        declared=SetPoint,
    ),
    "probing-pcrg": Entry(
        text="the same with route guidance", make=partial(Probing, guidance=True), guides=True, declared=SetPoint
    ),
    **{
        name: Entry(
            text=f"a policy trained by differentiable predictive control, perimeter control{ALSO * guides}",
            make=partial(policy_file.load, guidance=guides),
            guides=guides,
            policy=name,
            declared=Training,
        )
        for name, guides in training.NAMES.items()
    },
    **{
        name: Entry(
            text=f"replays the best plan found with all demand known (nmfd bound), perimeter control{ALSO * guides}",
            make=partial(open_loop.load, guidance=guides),
            guides=guides,
            policy=name,
            reads=PLAN,
        )
        for name, guides in open_loop.NAMES.items()
    },
}


def names() -> tuple[str, ...]:
    """Every controller that is built in."""
    return tuple(_ENTRIES)


def policy_names() -> tuple[str, ...]:
    """The controllers that need a trained policy."""
    return tuple(name for name, entry in _ENTRIES.items() if entry.policy and entry.reads is POLICY)


def check(name: str) -> None:
    """InputError unless `name` is a controller."""
    if not known(name):
        raise InputError(
            f"controller {name!r} is unknown{did_you_mean(name, choice())}; choose from "
            f"{', '.join(choice())}, or file.py:Class"
        )


def split(name: str) -> tuple[str, list[str]]:
    """The controller of NAME+OPTION+..., and its options; the path of a controller in a file may hold a + too."""
    own = _OWN.match(name)
    first, *rest = [own[0], *name[own.end() :].split("+")[1:]] if own else name.split("+")
    return first, rest


def known(name: str) -> bool:
    """Whether `name` is a controller. InputError for a file that is not there."""
    if custom.is_file(name) and name not in _ENTRIES:
        custom.check(name)
        return True
    return name in _ENTRIES or name in custom.entry_points()


def choice() -> tuple[str, ...]:
    """Every controller that has a name of its own, built in or installed."""
    return (*_ENTRIES, *(name for name in custom.entry_points() if name not in _ENTRIES))


def texts() -> dict[str, str]:
    """Of every controller of `choice` what it does, in a line."""
    return {
        name: _ENTRIES[name].text if name in _ENTRIES else f"installed: {custom.entry_points()[name].value}"
        for name in choice()
    }


def ready(scenario: Scenario) -> tuple[str, ...]:
    """Those of `choice` that `make` can make for `scenario`, as far as files go: what needs a policy or plan has it."""

    def has_files(name: str) -> bool:
        try:
            policy_path(name, scenario)
        except InputError:
            return False
        return True

    return tuple(filter(has_files, choice()))


def is_own(name: str) -> bool:
    """Whether `name`, which must be known, is a controller of the user's own."""
    return name not in _ENTRIES


def runs_apart(name: str) -> bool:
    """Whether NAME or NAME+... is a controller of the user's own, each run of which has a process of its own; any
    other word is none."""
    first = split(name)[0]
    return first not in _ENTRIES and (custom.is_file(first) or first in custom.entry_points())


def guides(name: str) -> bool:
    """Whether the controller `name`, which must be known, may guide routes, as one of the user's own might."""
    return is_own(name) or _ENTRIES[name].guides


def configured_own(name: str, scenario: Scenario) -> tuple[str, Scenario]:
    """Of a controller of the user's own: the name of its table, and `scenario` with the tables of all such."""
    return custom.table_name(name), custom.with_tables(scenario)


def fingerprint(name: str, file: Path | None) -> dict[str, object]:
    """What the runs of `name` depend on in files: its own source, or its `policy_path`."""
    if is_own(name):
        return custom.fingerprint(name)
    return {} if file is None else {"policy_hash": file_hash(file)}


def policy_path(name: str, scenario: Scenario, file: Path | None = None) -> Path | None:
    """The policy or plan that `make` would read: `file`, or the scenario's own; None for a controller without.

    InputError for an unknown name, for a `file` that the controller has no use for, and for a missing one.
    """
    variant, name = name, split(name)[0]
    check(name)
    if is_own(name) or not _ENTRIES[name].policy:
        if file is not None:
            readers = (other for other, entry in _ENTRIES.items() if entry.policy)
            raise InputError(f"{file}: controller {name} reads no policy; only {', '.join(readers)} do: omit it")
        return None
    owner, kind = _owner(variant), _ENTRIES[name].reads
    if file is None:
        if scenario.folder is None:
            raise InputError(f"controller {name}: scenario {scenario.name} has no folder with policies; give a file")
        path, out = scenario.folder / f"{owner}.{kind.suffix}", ""
    else:
        path, out = shipped.found(file, shipped.SCENARIO), f" --out {file}"
    if not path.is_file():
        scenario_text = "SCENARIO" if scenario.folder is None else scenario.folder
        if scenario.folder is not None and shipped.installed(scenario.folder):
            scenario_text, out = scenario.folder.name, out or f" --out {owner}.{kind.suffix}, and give it with --policy"
        command = f"nmfd {kind.command} {scenario_text} --controller {owner}{out}"
        raise InputError(f"{path}: no such {kind.text} for {name}; {kind.verb} one with: {command}")
    return path


def _owner(name: str) -> str:
    """Whose policy and options `name` uses."""
    name, rest = split(name)
    policy_of = "" if is_own(name) else _ENTRIES[name].policy
    return "+".join([policy_of or name, *rest])


def make(name: str, scenario: Scenario, *, policy: Path | None = None) -> Controller:
    """The controller `name` for `scenario`; `policy` is the file of a policy or plan instead of the scenario's own.

    It is made from a planning model of its own, and shares no array with the scenario. A name "NAME+..." stands for
    NAME with options and a policy of its own (nmfd.model.planning.planning_model). Raises InputError as `policy_path`
    does, and what the controller itself finds wrong with its options or policy.
    """
    path, first = policy_path(name, scenario, policy), split(name)[0]
    if is_own(first):
        return custom.make(first, scenario)
    if first in open_loop.NAMES:  # a plan knows what happens, and says for which scenario it was computed
        return _ENTRIES[first].make(path, scenario)
    planning = planning_model(scenario, _owner(name))
    return _ENTRIES[first].make(planning) if path is None else _ENTRIES[first].make(path, planning)


def outside_training(name: str, scenario: Scenario, level: float, *, file: Path | None = None) -> str:
    """What to say of a run of `name`, as of `make`, at `level` times the demand of the scenario that a policy was
    trained on; "" for what it has seen, and for controllers without a policy. Raises InputError as `make`."""
    path = policy_path(name, scenario, file)
    if path is None or split(name)[0] not in policy_names():
        return ""
    _, content = policy_file.load_policy(path, planning_model(scenario, _owner(name)).network)
    return policy_file.outside_training(content, level)


def verify(name: str, scenario: Scenario, *, policy: Path | None = None) -> None:
    """InputError where `make` raises one; a controller of the user's own is tried in a process of its own."""
    if is_own(split(name)[0]):
        policy_path(name, scenario, policy)
        custom.verify(split(name)[0], scenario)
    else:
        make(name, scenario, policy=policy)


def check_options(scenario: Scenario) -> None:
    """InputError for a wrong option of any controller in the scenario's [controllers], whether it is run or not.

    An option of a controller that nobody runs today would else be found wrong in the middle of tomorrow's work. The
    networks of other models are read only where they are used.
    """
    tables, planning = scenario.controller_options, planning_model(scenario)
    for variant, table in tables.items():
        if variant == OWN:  # checked by those controllers, if at all
            continue
        name = split(variant)[0]
        if name not in _ENTRIES:
            raise config.error(
                planning.where,
                f"controllers.{variant}",
                f"unknown controller{did_you_mean(name, names())}; choose "
                f"from {', '.join(names())}, or one of them with + and the options of a strategy; that of a controller "
                f"of your own is controllers.{OWN}.{variant}",
            )
        own = {**tables.get(name, {}), **table}
        model = {"model": own.pop("model")} if "model" in own else {}
        config.checked(PlanningOptions, model, planning.where, f"controllers.{variant}.")
        options(_ENTRIES[name].declared, replace(planning, controller_options={name: own}), name, variant)


def declarations() -> dict[str, type[Options]]:
    """Controller -> the declaration of its options."""
    return {name: entry.declared for name, entry in _ENTRIES.items()}
