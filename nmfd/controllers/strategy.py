"""Strategies: a controller and what else the city does, parsed once from a name such as
pi-gating+guided+max-pressure.

dpc-pc+max-pressure      max-pressure at all signals, DPC limits the green of the gateways
no-control+rerouting-30  no control, 30 % of the drivers reroute; `rerouting-30` for short
mine.py:Gate+actuated    a controller of the user's own (nmfd.controllers.custom), actuated signals elsewhere
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nmfd.controllers import custom, open_loop
from nmfd.controllers.dpc import compact, policy_file
from nmfd.controllers.dpc.options import Training
from nmfd.controllers.mpc import controller as mpc
from nmfd.controllers.rules import (
    Gating,
    Greedy,
    NoControl,
    PiGating,
    Probing,
    RouteGuidance,
    SetPoint,
)
from nmfd.errors import InputError, did_you_mean
from nmfd.model.planning import (
    Options,
    PlanningModel,
    guided_model,
    options,
    other_model,
    planning_model,
)
from nmfd.model.scenario import Scenario
from nmfd.runs import config, shipped
from nmfd.runs.files import file_hash
from nmfd.types import Controller

ALONE = "no-control"  # the controller of a name that consists of city words
OWN = "own"  # table in [controllers] with the tables of the user's own controllers
# Files that controllers read: kind, end of the name, command that makes them.
POLICY = ("policy", ".pt", "nmfd train {folder} --controller {name}")
PLAN = ("plan", ".npz", "nmfd bound {folder} --controller {name}")
VALUE = ("value function", ".npz", "python scenarios/economic_mpc/terminal_cost.py {name}")
MODEL_FREE = ("no-control", "route-guidance", "probing-pc", "probing-pcrg")  # use no regional model


@dataclass(frozen=True, kw_only=True)
class ControllerType:
    """A built-in controller, or a class of the user's own.

    name: "pi-gating", "mine.py:Gate"; text: one line for help
    make: (planning) or (file, planning) -> controller; for a plan (file, scenario)
    guides: may guide routes; reads: kind of the file that it needs; options: their declaration;
        own: the user's class
    """

    name: str
    text: str
    make: Callable[..., Controller] = field(compare=False)
    guides: bool = False
    reads: tuple[str, str, str] | None = None
    options: type[Options] = Options
    own: bool = False


def _pair(name: str, text: str, make: Callable, **more: Any) -> list[ControllerType]:
    """Return a controller without ("pc" in its name) and with route guidance ("pcrg")."""
    alone: dict[str, Any] = {
        "name": name.format("pc"),
        "text": f"{text}, perimeter control",
        "make": partial(make, guidance=False),
    }
    both: dict[str, Any] = {
        "name": name.format("pcrg"),
        "text": f"{alone['text']} and route guidance",
        "guides": True,
    }
    return [
        ControllerType(**alone, **more),
        ControllerType(**both, make=partial(make, guidance=True), **more),
    ]


CONTROLLERS: Mapping[str, ControllerType] = {
    kind.name: kind
    for kind in (
        ControllerType(
            name="no-control", text="open perimeter, no guidance: the reference", make=NoControl
        ),
        ControllerType(
            name="route-guidance",
            text="guidance by travel times alone",
            make=RouteGuidance,
            guides=True,
        ),
        ControllerType(
            name="pi-gating",
            text="PI control of the protected regions",
            make=PiGating,
            options=Gating,
        ),
        ControllerType(
            name="greedy",
            text="bang-bang control by the more congested of two regions",
            make=Greedy,
        ),
        *_pair("mpc-{}", "economic MPC", mpc.EconomicMpc, options=mpc.Mpc),
        *_pair(
            "mpc-{}-terminal",
            "economic MPC with terminal cost",
            mpc.load,
            reads=VALUE,
            options=mpc.Mpc,
        ),
        *_pair("probing-{}", "random excitation for cosim identify", Probing, options=SetPoint),
        ControllerType(
            name="gating-rule",
            text="gates by numbers tuned in SUMO",
            make=partial(compact.rule, guidance=False),
            options=compact.Rule,
        ),
        ControllerType(
            name="pricing-rule",
            text="prices of ways through regions, and gates, by numbers tuned in SUMO",
            make=partial(compact.rule, guidance=True),
            guides=True,
            options=compact.Rule,
        ),
        *_pair("dpc-{}", "trained policy", policy_file.load, reads=POLICY, options=Training),
        *_pair(
            "bound-{}", "best plan with all demand known (nmfd bound)", open_loop.read, reads=PLAN
        ),
    )
}

# Word of a strategy -> key of [sumo], value, text.
CITY_WORDS: Mapping[str, tuple[str, Any, str]] = {
    "webster": ("signals", "webster", "fixed-time signals, optimised for the scenario's demand"),
    "actuated": ("signals", "actuated", "signals that extend green while vehicles arrive"),
    "max-pressure": ("signals", "max-pressure", "max-pressure control of all signals"),
    "estimate": (
        "measurement",
        "estimate",
        "controller and guidance see what detectors and probe vehicles tell",
    ),
    "metering": (
        "metering",
        1.2,
        "trips wait outside while their region is full, or as the controller commands",
    ),
    "guided": ("guided", True, "drivers are guided by travel times"),
}
# Word-N -> key of [sumo], least N, largest N, unit, text.
CITY_NUMBERS: Mapping[str, tuple[str, int, int, str, str]] = {
    "rerouting": ("rerouting", 1, 100, "percent", "N percent of the drivers reroute by themselves"),
    "compliance": ("compliance", 0, 100, "percent", "N percent of the drivers follow the guidance"),
    "metering": (
        "metering",
        1,
        1000,
        "percent",
        "metering at N percent of the critical accumulation",
    ),
    "guidance-period": (
        "guidance_period",
        1,
        3600,
        "seconds",
        "drivers are guided again every N seconds",
    ),
}


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """A controller and the settings of the city that go with it.

    name: as the user wrote it
    city: key of [sumo] (cosim.plant.settings.Settings) -> value, instead of the scenario's
    words: the city's part of the name
    """

    name: str
    controller: ControllerType
    city: Mapping[str, Any] = field(default_factory=dict, compare=False)
    words: tuple[str, ...] = ()

    @property
    def guides(self) -> bool:
        """True if routes may be guided, by the controller or by travel times."""
        return bool(self.city.get("guided")) or self.controller.guides

    def regional(self) -> "Strategy":
        """Return the strategy itself. Raise InputError if it has words for a city in SUMO."""
        if self.words:
            remedy = (
                f"needs a city in SUMO (cosim); on the regional model use {self.controller.name}"
            )
            raise InputError(f"strategy {self.name!r}: +{'+'.join(self.words)} {remedy}")
        return self

    def table(self, scenario: Scenario) -> str:
        """Return its table in [controllers], the one with most of its words. Raise InputError if
        several fit."""
        name = self.controller.name
        if self.controller.own:
            return str(getattr(custom.load(name), "name", name))
        split = {table: _split(table) for table in scenario.controller_options}
        counts = {
            table: len(w)
            for table, (first, w) in split.items()
            if first == name and set(w) <= set(self.words)
        }
        best = [table for table, count in counts.items() if count and count == max(counts.values())]
        if len(best) > 1:
            tables = " and ".join(f'[controllers."{table}"]' for table in best)
            problem = (
                f'the tables {tables} fit it equally well; add a table [controllers."{self.name}"]'
            )
            raise InputError(f"scenario.toml: strategy {self.name!r}: {problem}")
        return best[0] if best else name

    def make(self, scenario: Scenario, policy: Path | None = None) -> Controller:
        """Return a controller for `scenario`, which shares no array with it. Raise InputError.

        policy: file of a policy, plan or value function instead of the scenario's
        """
        file, kind = self.file(scenario, policy), self.controller
        known = scenario if kind.reads == PLAN else self._planning(scenario)
        return kind.make(known) if file is None else kind.make(file, known)

    def planning(self, scenario: Scenario) -> PlanningModel:
        """Return the planning model that predicts the runs of the strategy. Raise InputError.

        It is that of the controller, or the city's model with guided drivers if nothing else guides
        routes.
        """
        planned, guided = self._planning(scenario), guided_model(scenario.network)
        if planned.network.folder == scenario.network.folder and self.guides and guided is not None:
            return replace(planned, network=other_model(scenario, guided))
        return planned

    def _planning(self, scenario: Scenario) -> PlanningModel:
        table = self.table(scenario)
        if self.controller.own:
            tables = scenario.controller_options
            return planning_model(
                replace(scenario, controller_options={**tables, **tables.get(OWN, {})}), table
            )
        return planning_model(scenario, self.controller.name, table)

    def file(self, scenario: Scenario, policy: Path | None = None) -> Path | None:
        """Return the file that `make` reads, None without: `policy`, or the scenario's. Raise
        InputError."""
        kind, table = self.controller, self.table(scenario)
        if kind.reads is None:
            if policy is not None:
                raise InputError(f"{policy}: controller {kind.name} reads no policy; omit it")
            return None
        text, suffix, command = kind.reads
        folder = scenario.folder or Path()
        path = (
            folder / (table + suffix) if policy is None else shipped.found(policy, shipped.SCENARIO)
        )
        if not path.is_file():
            command = command.format(folder=folder, name=table)
            raise InputError(f"{path}: no such {text} for {kind.name}; make one with: {command}")
        return path

    def fingerprint(self, scenario: Scenario, policy: Path | None = None) -> dict[str, Any]:
        """Return what its runs depend on besides city and demand: options, files and model. Raise
        InputError."""
        name = self.controller.name
        if name == ALONE:
            return {}
        tables, table, file = (
            scenario.controller_options,
            self.table(scenario),
            self.file(scenario, policy),
        )
        tables = tables.get(OWN, {}) if self.controller.own else tables
        setup = {**tables.get(name, {}), **tables.get(table, {})}
        setup.pop("model", None)  # its hash counts
        if name in MODEL_FREE:
            splits = scenario.network.nominal_splits if self.controller.guides else np.empty(0)
            return {
                "options": setup,
                "splits_hash": hashlib.sha256(splits.round(9).tobytes()).hexdigest()[:16],
            }
        model = [
            self._planning(scenario).network.hash,
            scenario.integrator,
            scenario.substeps,
            *scenario.protected,
        ]
        files = {} if file is None else {"policy_hash": file_hash(file)}
        return {
            "options": setup,
            "model": model,
            **files,
            **(custom.fingerprint(name) if self.controller.own else {}),
        }

    def outside_training(self, scenario: Scenario, level: float, policy: Path | None = None) -> str:
        """Return a sentence if `level` times the demand is outside the training range of its
        policy, else ""."""
        file = self.file(scenario, policy) if self.controller.reads == POLICY else None
        return (
            "" if file is None else policy_file.outside_training(policy_file.read_file(file), level)
        )


def parse(controller: str | Controller, city: str = "") -> Strategy:
    """Return the strategy CONTROLLER+WORD+..., or that of a controller object with the words of
    `city`.

    Raises: InputError for unknown or contradictory words

    >>> strategy = parse("pi-gating+max-pressure")
    >>> strategy.controller.name, strategy.city["signals"]
    ('pi-gating', 'max-pressure')
    """
    if isinstance(controller, str):
        name = f"{controller}+{city}" if city else controller
        first, words = _split(name)
        if _city_setting(first) is not None:
            first, words = ALONE, [first, *words]
        kind = CONTROLLERS.get(first) or _own(first)
        if kind is None:
            raise _unknown(name, first, controllers=True)
    else:
        if not (
            callable(getattr(controller, "reset", None))
            and callable(getattr(controller, "act", None))
        ):
            raise InputError(
                f"controller: expected a name or an object with reset and act, got {controller!r}"
            )
        first = getattr(controller, "name", type(controller).__name__)
        name, words = (f"{first}+{city}", _split(f"+{city}")[1]) if city else (first, [])
        kind = ControllerType(name=first, text="object", make=lambda planning: controller)
    settings: dict[str, Any] = {"gateways_fixed": first != ALONE}
    by_key: dict[str, str] = {}
    for word in words:
        setting = _city_setting(word)
        if setting is None:
            raise _unknown(name, word, controllers=False)
        key, value = setting
        if word == "guided" and kind.guides and not kind.own:
            raise InputError(f"strategy {name!r}: {first} guides routes itself; omit {word}")
        if key in by_key:
            raise InputError(
                f"strategy {name!r}: {by_key[key]} and {word} exclude each other; omit one of them"
            )
        by_key[key], settings[key] = word, value
    return Strategy(name=name, controller=kind, city=settings, words=tuple(words))


def parse_many(
    given: str | Sequence[str], scenario: Scenario, *, regional: bool = False
) -> list[Strategy]:
    """Return the strategies of names and patterns (*, ?, [...]), as a sequence or separated by
    commas.

    A pattern stands for all `ready` strategies that match and are not named besides.
    regional: without words for a city; Raises: InputError for an unknown name, none, or a pattern
        without a match
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else list(given)
    if not any(names):
        raise InputError(
            "controllers: expected at least one controller, got none; name one, such as no-control"
        )
    plain = [name for name in names if not any(sign in name for sign in "*?[") or _own(name)]
    result: dict[str, Strategy] = {}
    for name in names:
        if name in plain:
            result[name] = parse(name).regional() if regional else parse(name)
            continue
        known = {one.name: one for one in ready(scenario) if not (regional and one.words)}
        matching = [match for match in known if fnmatchcase(match, name)]
        if not matching:
            raise InputError(
                f"controllers: no controller here matches {name!r}; choose from {', '.join(known)}"
            )
        result |= {match: known[match] for match in matching if match not in (*plain, *result)}
    return list(result.values())


def ready(scenario: Scenario) -> list[Strategy]:
    """Return the strategies that can be made for `scenario`: built-in ones, and those with tables
    or policies."""
    files = sorted(scenario.folder.glob("*+*.pt")) if scenario.folder else []
    tables = [name for name in scenario.controller_options if "+" in name]
    result = []
    for name in dict.fromkeys([*CONTROLLERS, *(file.stem for file in files), *tables]):
        try:
            strategy = parse(name)
            strategy.file(scenario)
        except InputError:  # no such file, or no strategy of this version
            continue
        result.append(strategy)
    return result


def check_tables(scenario: Scenario) -> None:
    """Raise InputError for a wrong option in any table of [controllers], used or not."""
    planning = planning_model(scenario)
    for table, content in scenario.controller_options.items():
        if table == OWN:
            continue
        try:
            kind = parse(table).controller
        except InputError as error:
            raise config.error(planning.where, f"controllers.{table}", str(error)) from None
        merged = {**scenario.controller_options.get(kind.name, {}), **content}
        options(
            kind.options,
            replace(planning, controller_options={kind.name: merged}),
            kind.name,
            table,
        )


def city_words() -> list[tuple[str, str]]:
    """Return every word for the city with its text."""
    return [
        *((f"+{word}", text) for word, (_, _, text) in CITY_WORDS.items()),
        *((f"+{word}-N", text) for word, (*_, text) in CITY_NUMBERS.items()),
    ]


def _split(name: str) -> tuple[str, list[str]]:
    """Return the controller and the words of a name; the path of a user's own controller may
    contain +."""
    head, dot, tail = name.rpartition(".py:")
    cls, *words = tail.split("+")
    return head + dot + cls, words


def _city_setting(word: str) -> tuple[str, Any] | None:
    """Return key and value of [sumo] for a word, None if there is no such word."""
    if word in CITY_WORDS:
        return CITY_WORDS[word][:2]
    stem, _, digits = word.rpartition("-")
    if stem in CITY_NUMBERS and digits.isdecimal() and digits == str(int(digits)):
        key, least, largest, unit, _ = CITY_NUMBERS[stem]
        if least <= int(digits) <= largest:
            return key, int(digits) / 100 if unit == "percent" else float(digits)
    return None


def _own(name: str) -> ControllerType | None:
    """Return the controller of the user's own with the name FILE.py:CLASS, else None."""
    if custom.FILE_AND_CLASS.fullmatch(name) is None:
        return None
    make = partial(custom.OwnController, name)
    return ControllerType(
        name=name, text="controller of your own", make=make, guides=True, own=True
    )


def _unknown(name: str, word: str, *, controllers: bool) -> InputError:
    if word.endswith(".py"):
        return InputError(f"controller {word}: name its class, such as {word}:MyController")
    where = f"controller {name!r}" if word == name else f"strategy {name!r}: {word!r}"
    words = [*CITY_WORDS, *(f"{stem}-N" for stem in CITY_NUMBERS)]
    hint = did_you_mean(word, [*(CONTROLLERS if controllers else ()), *words])
    ranges = ", ".join(
        f"{stem}-N from {low} to {high} {u}" for stem, (_, low, high, u, _) in CITY_NUMBERS.items()
    )
    first = (
        f"{', '.join(CONTROLLERS)} or file.py:Class, with words joined by +: "
        if controllers
        else ""
    )
    return InputError(
        f"{where} is unknown{hint}; choose from {first}{', '.join(words)} (whole numbers, {ranges})"
    )
