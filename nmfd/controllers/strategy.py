"""Strategies: a controller, and labels that name what else a city does.

pi-gating                    a built-in controller with the options of the scenario
pi-gating(kp=2.0)            the same with these options alone, as the object nmfd.PiGating(kp=2.0)
mine.py:Gate                 a class in a file (nmfd.controllers.custom)
dpc-pc+max-pressure+guided   with labels, which mean something to a city in SUMO (cosim)

Labels are opaque here: they choose tables of options, policy files and the model of guided drivers.
"""

import hashlib
import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from nmfd.controllers import custom
from nmfd.controllers.base import Options, check_fit
from nmfd.controllers.dpc.options import ConstantControl, Dpc, GatingRule, PricingRule
from nmfd.controllers.mpc.controller import EconomicMpc
from nmfd.controllers.open_loop import Bound
from nmfd.controllers.rules import Greedy, NoControl, PiGating, Probing, RouteGuidance
from nmfd.errors import InputError, did_you_mean
from nmfd.model.planning import (
    GUIDED,
    PlanningModel,
    guided_model,
    other_model,
    planning_model,
)
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import config, shipped
from nmfd.runs.files import file_hash, parts_of
from nmfd.types import Controller

ALONE = "no-control"  # the controller of a name that consists of labels
OWN = "own"  # table in [controllers] with the tables of the user's own controllers
NAME_AND_OPTIONS = re.compile(r"(?P<name>[\w-]+)\((?P<options>.*)\)")


@dataclass(frozen=True, kw_only=True)
class BuiltIn:
    """A built-in controller.

    name: as in scenario.toml, such as "mpc-pcrg"
    text: one line for help
    options: their class
    fixed: options that the name fixes
    given: all options, instead of those of the scenario
    """

    name: str
    text: str
    options: type[Options]
    fixed: Mapping[str, Any] = field(default_factory=dict, compare=False)
    given: Options | None = None

    def of_table(self, table: Mapping[str, Any], where: str, prefix: str) -> Options:
        """Return the options of a table of scenario.toml. Raise InputError."""
        for key, value in self.fixed.items():
            if table.get(key, value) != value:
                problem = (
                    f"is {json.dumps(value)} for {self.name}; remove it, or choose another name"
                )
                raise config.error(where, prefix + key, problem)
        return config.checked(self.options, {**table, **self.fixed}, where, prefix)

    @property
    def default(self) -> Options:
        """Options without a scenario: those given, or the defaults."""
        if self.given is not None:
            return self.given
        return self.options(**self.fixed)


def _named(name: str, text: str, options: type[Options], **fixed: Any) -> BuiltIn:
    return BuiltIn(name=name, text=text, options=options, fixed=fixed)


def _pair(name: str, text: str, options: type[Options], **fixed: Any) -> list[BuiltIn]:
    """Return a controller without ("pc") and with route guidance ("pcrg")."""
    alone = f"{text}, perimeter control"
    both = f"{alone} and route guidance"
    return [
        _named(name.format("pc"), alone, options, guidance=False, **fixed),
        _named(name.format("pcrg"), both, options, guidance=True, **fixed),
    ]


CONTROLLERS: Mapping[str, BuiltIn] = {
    kind.name: kind
    for kind in [
        _named("no-control", "open perimeter, no guidance: the reference", NoControl),
        _named("route-guidance", "guidance by travel times alone", RouteGuidance),
        _named("pi-gating", "PI control of the protected regions", PiGating),
        _named("greedy", "bang-bang control by the more congested of two regions", Greedy),
        *_pair("mpc-{}", "economic MPC", EconomicMpc, terminal=False),
        *_pair("mpc-{}-terminal", "economic MPC with terminal cost", EconomicMpc, terminal=True),
        *_pair("probing-{}", "random excitation for cosim identify", Probing),
        _named("gating-rule", "gates by numbers tuned in SUMO", GatingRule),
        _named(
            "pricing-rule",
            "prices of ways through regions, and gates, by numbers tuned in SUMO",
            PricingRule,
        ),
        _named("constant", "gates, prices and departure rates that never change", ConstantControl),
        *_pair("dpc-{}", "trained policy", Dpc),
        *_pair("bound-{}", "best plan with all demand known (nmfd bound)", Bound),
    ]
}


@dataclass(frozen=True, kw_only=True)
class FromFile:
    """A controller of the user's own: the class FILE.py:CLASS of that name."""

    name: str


@dataclass(frozen=True, kw_only=True)
class Given:
    """A controller that the user has made: an object with `reset` and `act`."""

    name: str
    controller: Controller = field(compare=False)


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """A controller and the labels that go with it.

    name: as the user wrote it
    labels: words behind the controller; only cities in SUMO know what they mean
    """

    name: str
    controller: BuiltIn | FromFile | Given
    labels: tuple[str, ...] = ()

    @property
    def own(self) -> bool:
        """True for code of the user's own, which may crash or never answer."""
        return not isinstance(self.controller, BuiltIn)

    @property
    def guides(self) -> bool:
        """True if routes may be guided, by the controller or by travel times."""
        return GUIDED in self.labels or self.controller_guides

    @property
    def controller_guides(self) -> bool:
        """True if the controller may guide routes."""
        if isinstance(self.controller, BuiltIn):
            return self.controller.default.guides
        return isinstance(self.controller, FromFile)

    def regional(self) -> "Strategy":
        """Return the strategy itself.

        Raises: InputError if it has labels, which only a city in SUMO understands
        """
        if self.labels:
            labels = "+".join(self.labels)
            raise InputError(
                f"strategy {self.name!r}: +{labels} needs a city in SUMO (cosim); on the regional "
                f"model use {self.controller.name}"
            )
        return self

    def table(self, scenario: Scenario) -> str:
        """Return its table in [controllers], the one with most of its labels.

        Raises: InputError if several tables fit
        """
        name = self.controller.name
        if isinstance(self.controller, FromFile):
            return str(getattr(custom.load(name), "name", name))
        if not isinstance(self.controller, BuiltIn) or self.controller.given is not None:
            return name
        fitting = {}
        for table in scenario.controller_options:
            first, labels = split(table)
            if first == name and labels and set(labels) <= set(self.labels):
                fitting[table] = len(labels)
        best = [table for table, count in fitting.items() if count == max(fitting.values())]
        if len(best) > 1:
            tables = " and ".join(f'[controllers."{table}"]' for table in best)
            raise InputError(
                f"scenario.toml: strategy {self.name!r}: the tables {tables} fit it equally well; "
                f'add a table [controllers."{self.name}"]'
            )
        return best[0] if best else name

    def options(self, scenario: Scenario) -> Options | None:
        """Return the options for `scenario`; None for the user's own code.

        Raises: InputError
        """
        kind = self.controller
        if not isinstance(kind, BuiltIn):
            return None
        if kind.given is not None:
            return kind.given
        prefix = f"controllers.{self.table(scenario)}."
        return kind.of_table(self._own_table(scenario), scenario.where, prefix)

    def make(self, scenario: Scenario, policy: Path | None = None) -> Controller:
        """Return a controller for `scenario`, which shares no array with it.

        policy: file of a policy, plan or value function instead of the scenario's
        Raises: InputError
        """
        kind = self.controller
        file = self.file(scenario, policy)
        if isinstance(kind, Given):
            return kind.controller
        planning = self.own_planning(scenario)
        options = self.options(scenario)
        if not isinstance(kind, BuiltIn) or options is None:
            return custom.OwnController(kind.name, planning)
        where = f"{kind.name}: "
        if kind.given is None:
            where = f"{planning.where}: controllers.{self.table(scenario)}."
        check_fit(options, planning, where)
        if file is None:
            return options.make(planning)
        return options.load(file, planning, scenario)

    def planning(self, scenario: Scenario) -> PlanningModel:
        """Return the planning model that predicts the runs of the strategy.

        It is that of the controller, or the city's model with guided drivers if nothing else guides
        routes.
        Raises: InputError
        """
        planned = self.own_planning(scenario)
        guided = guided_model(scenario.network)
        of_city = planned.network.folder == scenario.network.folder
        if of_city and self.guides and guided is not None:
            return replace(planned, network=other_model(scenario, guided))
        return planned

    def own_planning(self, scenario: Scenario) -> PlanningModel:
        """Return the planning model of the controller, with its options.

        Raises: InputError
        """
        table = self.table(scenario)
        own = self._own_table(scenario)
        network = self._network(scenario, own.pop("model", None), table)
        tables = {**scenario.controller_options}
        if isinstance(self.controller, FromFile):
            tables |= tables.get(OWN, {})
            tables[table] = own
        else:
            tables[self.controller.name] = own
        return planning_model(replace(scenario, controller_options=tables), network)

    def _own_table(self, scenario: Scenario) -> dict[str, Any]:
        """Return the options as they were given or written.

        Those of the strategy's table replace those of the controller's; what `cosim tune` tries
        replaces those in the tables of the user's own controllers.
        """
        kind = self.controller
        if isinstance(kind, BuiltIn) and kind.given is not None:
            return kind.given.model_dump(exclude_unset=True, exclude=set(kind.fixed))
        names = (kind.name, self.table(scenario))
        places = [scenario.controller_options]
        if isinstance(kind, FromFile):
            places.insert(0, scenario.controller_options.get(OWN, {}))
        found: dict[str, Any] = {}
        for tables in places:
            for name in names:
                found |= tables.get(name, {})
        return found

    def _network(self, scenario: Scenario, model: Any, table: str) -> RegionalModel | None:
        """Return the regional model to plan with; None for the scenario's.

        model: the option of that name. Without it, controllers that guide routes by a model plan
            with that of guided drivers, if the city has one
        Raises: InputError
        """
        kind = self.controller
        if isinstance(kind, BuiltIn) and kind.given is not None and model is not None:
            return other_model(scenario, shipped.found(model, shipped.NETWORK), f"{table}: model")
        if model is not None and scenario.folder is not None:
            prefix = f"controllers.{table}."
            text = config.checked(Options, {"model": model}, scenario.where, prefix).model
            where = f"{scenario.where}: {prefix}model"
            return other_model(scenario, scenario.folder / str(text), where)
        if isinstance(kind, BuiltIn) and kind.default.plans and kind.default.guides:
            folder = guided_model(scenario.network)
            if folder is not None:
                return other_model(scenario, folder)
        return None

    def file(self, scenario: Scenario, policy: Path | None = None) -> Path | None:
        """Return the file that `make` reads; None if it reads none.

        policy: the file, instead of the one that the options name or the scenario's
        Raises: InputError if it is missing
        """
        kind = self.controller
        reads = kind.default.reads if isinstance(kind, BuiltIn) else None
        if not isinstance(kind, BuiltIn) or reads is None:
            if policy is not None:
                raise InputError(f"{policy}: controller {kind.name} reads no policy; omit it")
            return None
        folder = scenario.folder or Path()
        table = self.table(scenario)
        options = self.options(scenario)
        named = options.file if policy is None and options is not None else policy
        if named is None:
            path = folder / (table + reads.suffix)
        elif policy is None and kind.given is None:
            path = folder / named
        else:
            path = shipped.found(named, shipped.SCENARIO)
        if not path.is_file():
            command = reads.command.format(folder=folder, name=table)
            raise InputError(
                f"{path}: no such {reads.text} for {kind.name}; make one with: {command}"
            )
        return path

    def fingerprint(self, scenario: Scenario, policy: Path | None = None) -> dict[str, Any]:
        """Return what its runs depend on besides city and demand.

        These are options, files and model.
        Raises: InputError
        """
        kind = self.controller
        if isinstance(kind, BuiltIn) and kind.options is NoControl:
            return {}
        setup = json.loads(json.dumps(self._own_table(scenario), default=str))
        setup.pop("model", None)  # its hash counts
        if isinstance(kind, BuiltIn) and not kind.default.plans and kind.default.reads is None:
            splits = scenario.network.nominal_splits if kind.default.guides else np.empty(0)
            digest = hashlib.sha256(splits.round(9).tobytes()).hexdigest()[:16]
            return {"options": setup, "splits_hash": digest}
        model = self.own_planning(scenario).network.hash
        scheme = [scenario.integrator, scenario.substeps, *scenario.protected]
        result: dict[str, Any] = {"options": setup, "model": [model, *scheme]}
        file = self.file(scenario, policy)
        if file is not None:
            result["policy_hash"] = file_hash(file)
        if isinstance(kind, FromFile):
            result |= custom.fingerprint(kind.name)
        if isinstance(kind, Given):
            result["object"] = custom.object_fingerprint(kind.controller)
        return result

    def model_warning(self, scenario: Scenario) -> str:
        """Return where the planning model is worse than "as now", else "".

        Rules of a few numbers do not predict.
        """
        kind = self.controller
        if isinstance(kind, BuiltIn) and kind.options not in (Dpc, EconomicMpc):
            return ""
        return self.own_planning(scenario).network.misleads

    def outside_training(self, scenario: Scenario, level: float, policy: Path | None = None) -> str:
        """Return a sentence if the demand is outside the training range.

        level: factor of the scenario's demand
        """
        kind = self.controller
        if not isinstance(kind, BuiltIn) or kind.options is not Dpc:
            return ""
        from nmfd.controllers.dpc import policy_file  # torch takes two seconds

        file = self.file(scenario, policy)
        assert file is not None  # Dpc reads one
        return policy_file.outside_training(policy_file.read_file(file), level)


ControllerLike: TypeAlias = str | Options | Controller | Strategy


def parse(controller: ControllerLike, words: str = "") -> Strategy:
    """Return the strategy of a controller.

    controller: a name, options, or an object with `reset` and `act`
    words: that labels may be, for the error of an unknown controller
    Raises: InputError for an unknown controller or options that are wrong

    >>> strategy = parse("pi-gating+max-pressure")
    >>> strategy.controller.name, strategy.labels
    ('pi-gating', ('max-pressure',))
    """
    if isinstance(controller, Strategy):
        return controller
    if isinstance(controller, Options):
        kind = named(controller)
        return Strategy(name=kind.name, controller=kind)
    if isinstance(controller, str):
        first, labels = split(controller)
        return Strategy(name=controller, controller=_kind(controller, first, words), labels=labels)
    methods = (getattr(controller, name, None) for name in ("reset", "act"))
    if isinstance(controller, type) or not all(map(callable, methods)):
        raise InputError(
            "controller: expected a name, options such as nmfd.PiGating(), or an object with "
            f"reset and act, got {controller!r}"
        )
    name = str(getattr(controller, "name", type(controller).__name__))
    return Strategy(name=name, controller=Given(name=name, controller=controller))


def split(name: str) -> tuple[str, tuple[str, ...]]:
    """Return the controller and the labels of a name.

    The path of a user's own controller and the options in parentheses may contain +.
    """
    head, dot, tail = name.rpartition(".py:")
    first, *labels = parts_of(tail, "+")
    return head + dot + first, tuple(labels)


def named(options: Options) -> BuiltIn:
    """Return a built-in controller with given options.

    Its name contains them.

    >>> named(PiGating(kp=2.0)).name
    'pi-gating(kp=2.0)'
    """
    for kind in CONTROLLERS.values():
        if type(options) is not kind.options:
            continue
        values = {name: getattr(options, name) for name in kind.fixed}
        if "guidance" in values:
            values["guidance"] = options.guides
        if values == kind.fixed:
            break
    else:
        raise InputError(f"controller: expected options of a built-in one, got {options!r}")
    given = []
    for name in type(options).model_fields:
        if name in options.model_fields_set and name not in kind.fixed:
            given.append(f"{name}={json.dumps(getattr(options, name), default=str)}")
    name = f"{kind.name}({', '.join(given)})" if given else kind.name
    return replace(kind, name=name, given=options)


def _kind(name: str, first: str, words: str = "") -> BuiltIn | FromFile:
    """Return the controller of the name `first` in `name`.

    words: as in `parse`
    Raises: InputError if it is unknown
    """
    if custom.FILE_AND_CLASS.fullmatch(first):
        return FromFile(name=first)
    if first in CONTROLLERS:
        return CONTROLLERS[first]
    match = NAME_AND_OPTIONS.fullmatch(first)
    if match and match["name"] in CONTROLLERS:
        kind = CONTROLLERS[match["name"]]
        try:
            table = tomllib.loads(f"options = {{{match['options']}}}")["options"]
        except tomllib.TOMLDecodeError:
            raise InputError(
                f"controller {first!r}: expected {match['name']}(key=value, ...), values as in "
                "scenario.toml"
            ) from None
        return named(kind.of_table(table, f"controller {first!r}", ""))
    if first.endswith(".py"):
        raise InputError(f"controller {first}: name its class, such as {first}:MyController")
    where = f"controller {first!r}" if first == name else f"strategy {name!r}: {first!r}"
    hint = did_you_mean(first, [*CONTROLLERS, *parts_of(words.partition(" (")[0])])
    allowed = f"{', '.join(CONTROLLERS)} or file.py:Class"
    if words:
        allowed += f", with words joined by +: {words}"
    raise InputError(f"{where} is unknown{hint}; choose from {allowed}")


S = TypeVar("S", bound=Strategy)


def parse_many(
    given: ControllerLike | Sequence[ControllerLike],
    scenario: Scenario,
    parse: Callable[[Any], S],
) -> list[S]:
    """Return the strategies of controllers and patterns (*, ?, [...]).

    given: a controller, a sequence, or names separated by commas. A pattern stands for all `ready`
        strategies that match and are not named besides
    parse: makes a strategy of each
    Raises: InputError for an unknown name, none, or a pattern without a match
    """
    if isinstance(given, str):
        controllers: list[Any] = list(parts_of(given))
    elif isinstance(given, Sequence):
        controllers = list(given)
    else:
        controllers = [given]
    if not any(controllers):
        raise InputError(
            "controllers: expected at least one controller, got none; name one, such as no-control"
        )
    plain: dict[str, S] = {}
    order: list[str | S] = []  # patterns, and strategies
    for controller in controllers:
        if isinstance(controller, str) and _is_pattern(controller):
            order.append(controller)
            continue
        strategy = parse(controller)
        if strategy.name in plain:
            _check_same(strategy, plain[strategy.name])
        plain[strategy.name] = strategy
        order.append(strategy)
    result: dict[str, S] = {}
    for entry in order:
        if isinstance(entry, str):
            for one in _matching(entry, scenario, parse):
                if one.name not in plain:
                    result.setdefault(one.name, one)
        else:
            result[entry.name] = entry
    return list(result.values())


def _check_same(one: Strategy, other: Strategy) -> None:
    """Raise InputError if two controller objects have the same name."""
    kinds = (one.controller, other.controller)
    objects = [kind.controller for kind in kinds if isinstance(kind, Given)]
    if len(objects) > 1 and objects[0] is not objects[1]:
        raise InputError(
            f"controllers: two have the name {one.name!r}; give each object an attribute `name` of "
            "its own"
        )


def _is_pattern(name: str) -> bool:
    plain = custom.FILE_AND_CLASS.fullmatch(name) or NAME_AND_OPTIONS.match(name)
    return not plain and any(sign in name for sign in "*?[")


def _matching(pattern: str, scenario: Scenario, parse: Callable[[Any], S]) -> list[S]:
    """Return the `ready` strategies whose names match.

    Raises: InputError if none does
    """
    known = ready(scenario, parse)
    matching = [one for one in known if fnmatchcase(one.name, pattern)]
    if not matching:
        names = ", ".join(one.name for one in known)
        raise InputError(
            f"controllers: no controller here matches {pattern!r}; choose from {names}"
        )
    return matching


def ready(scenario: Scenario, parse: Callable[[Any], S]) -> list[S]:
    """Return the strategies that can be made for `scenario`.

    These are the built-in ones, and those with tables or policies.
    """
    names = [*CONTROLLERS]
    if scenario.folder is not None:
        names += [file.stem for file in sorted(scenario.folder.glob("*+*.pt"))]
    names += [table for table in scenario.controller_options if "+" in table]
    result = []
    for name in dict.fromkeys(names):
        try:
            strategy = parse(name)
            strategy.file(scenario)
        except InputError:  # no such file, or no strategy of this version
            continue
        result.append(strategy)
    return result


def check_tables(scenario: Scenario) -> None:
    """Check the options in all tables of [controllers], used or not.

    Raises: InputError
    """
    planning = planning_model(scenario)
    for table, content in scenario.controller_options.items():
        if table == OWN:
            continue
        first, _ = split(table)
        try:
            kind = _kind(table, first)
        except InputError as error:
            raise config.error(scenario.where, f"controllers.{table}", str(error)) from None
        if isinstance(kind, BuiltIn):
            merged = {**scenario.controller_options.get(kind.name, {}), **content}
            prefix = f"controllers.{table}."
            options = kind.of_table(merged, scenario.where, prefix)
            check_fit(options, planning, f"{scenario.where}: {prefix}")
