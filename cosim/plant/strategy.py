"""Strategies by name: CONTROLLER[+OPTION...], a regional controller and what else the city does.

dpc-pc+max-pressure      max-pressure at all signals, DPC limits the green of the gateways
no-control+rerouting-30  nobody controls, 30 % of the drivers reroute; `rerouting-30` for short
pi-gating+guided         PI gating, and drivers are guided by travel times
mine.py:Gate+actuated    a controller of one's own (nmfd.controllers.custom), actuated signals elsewhere
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.plant.settings import MODES, SIGNALS
from nmfd.controllers import registry
from nmfd.errors import InputError, did_you_mean
from nmfd.model.planning import PlanningModel, guided_model, planning_model, with_model
from nmfd.model.scenario import Scenario

ALONE = "no-control"  # the controller of a name that is only options
GUIDED = "guided"

# Option -> (field of cosim.plant.settings.Settings, its value).
_WORDS = {
    **{name: ("signals", name) for name in SIGNALS[1:]},
    **{name: ("actuation", name) for name in MODES},
    "estimate": ("measurement", "estimate"),
    "metering": ("metering", True),
    GUIDED: ("guided", True),
}
PERCENT, SECONDS = "percent", "seconds"
# Option with a whole number -> (field of cosim.plant.settings.Settings, least, most, its unit).
_NUMBERS = {
    "rerouting": ("rerouting", 1, 100, PERCENT),
    "compliance": ("compliance", 0, 100, PERCENT),
    "queue-override": ("queue_override", 1, 100, PERCENT),
    "metering": ("metering_level", 1, 1000, PERCENT),
    "guidance-period": ("guidance_period", 1, 3600, SECONDS),
}
METERING = ("metering", "metering_level")  # of these settings, those whose options make trips wait
OPTIONS = (*_WORDS, *(f"{name}-N" for name in _NUMBERS))
_TEXTS = {
    "webster": "fixed-time signals, optimised for the scenario's demand",
    "actuated": "signals that extend green while vehicles come",
    "max-pressure": "signals that serve the stage with the longest queues before, and the shortest behind it",
    "max-pressure-cyclic": "the same, with the stages in their order",
    "hold-back": "green taken from a gateway is red for all",
    "redistribute": "green taken from a gateway goes to the other movements",
    "estimate": "the controller sees what loops and probe vehicles tell, not the truth",
    "metering": "trips wait outside where their region is full, or as the controller commands",
    "metering-N": "the same, and without a command at N percent of the region's critical accumulation",
    GUIDED: "drivers are guided by travel times",
    "rerouting-N": "N percent of the drivers take another route by themselves, every minute",
    "compliance-N": "N percent of the drivers follow the guidance",
    "queue-override-N": "a gateway is left open while its road is N percent full",
    "guidance-period-N": "drivers within a region are guided anew every N seconds",
}


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """name: as the user wrote it; controller: of nmfd.controllers.registry; overrides: field of
    cosim.plant.settings.Settings -> value, instead of that of the scenario."""

    name: str
    controller: str
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def guides(self) -> bool:
        """Whether routes may be guided, by the controller or by travel times alone."""
        return bool(self.overrides.get("guided")) or registry.guides(self.controller)


def parse(name: str) -> Strategy:
    """The strategy `name`. InputError for a controller or option that there is not, and for contradictory ones.

    >>> strategy = parse("pi-gating+max-pressure")
    >>> strategy.controller, strategy.overrides["signals"]
    ('pi-gating', 'max-pressure')
    """
    first, words = registry.split(name)
    controller = first
    if _option(first) is not None:
        controller, words = ALONE, [first, *words]
    elif not registry.known(first):
        raise _unknown(name, first, controllers=True)
    overrides: dict[str, Any] = {"gateways_fixed": controller != ALONE}
    chosen: dict[str, str] = {}
    for word in words:
        option = _option(word)
        if option is None:
            raise _unknown(name, word, controllers=False)
        key, value = option
        if word == GUIDED and registry.guides(controller) and not registry.is_own(controller):
            raise InputError(f"strategy {name!r}: {controller} guides routes itself; omit {GUIDED}")
        if key in chosen:
            raise InputError(f"strategy {name!r}: {chosen[key]} and {word} exclude each other; omit one of them")
        chosen[key], overrides[key] = word, value
    if not overrides.keys().isdisjoint(METERING):
        overrides["metering"] = True
    return Strategy(name=name, controller=controller, overrides=overrides)


def options() -> list[tuple[str, str]]:
    """Of every option, which is joined to a controller by +, what it does."""
    return [(f"+{name}", _TEXTS[name]) for name in OPTIONS]


def ready(scenario: Scenario) -> tuple[str, ...]:
    """The strategies of which a pattern such as dpc-* may speak: controllers that can be made for `scenario`, those
    with options for which it has a policy or a table of their own, and signals alone."""
    files = sorted(scenario.folder.glob("*+*.pt")) if scenario.folder else []
    with_options = dict.fromkeys([*(file.stem for file in files), *scenario.controller_options])
    return (*registry.ready(scenario), *filter(_is_variant, with_options), *SIGNALS[1:])


def _is_variant(name: str) -> bool:
    try:
        return "+" in name and bool(parse(name))
    except InputError:
        return False


def model_free(name: str) -> bool:
    """Whether runs of a strategy do not depend on the regional model; its controller need not be there any more."""
    first, _ = registry.split(name)
    return first == ALONE or _option(first) is not None


def metered(name: str) -> bool:
    """Whether a strategy can make trips wait; its controller need not be there any more."""
    _, words = registry.split(name)
    return any(option[0] in METERING for word in words if (option := _option(word)) is not None)


def configured(name: str, tables: Iterable[str]) -> str:
    """The controller of the strategy `name`, with as many of its options as one of the `tables` has in its name.

    tables: names CONTROLLER+OPTION... of tables in [controllers], each with a regional model or a policy for that city
    Raises InputError where several fit equally well: their order in the file shall decide nothing.
    """
    controller = parse(name).controller
    words = {controller, *name.split("+")}
    fitting = [table for table in tables if table.startswith(f"{controller}+") and set(table.split("+")) <= words]
    best = max(fitting, key=lambda table: table.count("+"), default=controller)
    if len(rivals := [table for table in fitting if table.count("+") == best.count("+")]) > 1:
        raise InputError(
            f"scenario.toml: strategy {name!r}: the tables "
            + " and ".join(f'[controllers."{table}"]' for table in rivals)
            + f' fit it equally well; which one counts, say in a table [controllers."{name}"] of its own'
        )
    return best


def planning_of(scenario: Scenario, strategy: str, model: Path | None = None) -> PlanningModel:
    """What the runs of `strategy` are predicted with: the planning model of its controller, or, where routes are guided
    and nothing is planned, that of guided drivers, if the network has one beside it.

    model: the folder of a network, instead. Raises InputError.
    """
    parsed = parse(strategy)
    controller, variant = parsed.controller, configured(strategy, scenario.controller_options)
    if registry.is_own(controller):
        variant, scenario = registry.configured_own(controller, scenario)
    if model is not None:
        return with_model(planning_model(scenario), scenario, model)
    planned = planning_model(scenario, variant)
    if (
        planned.network.folder == scenario.network.folder
        and parsed.guides
        and (folder := guided_model(scenario.network)) is not None
    ):
        return with_model(planned, scenario, folder)
    return planned


def _option(word: str) -> tuple[str, object] | None:
    if word in _WORDS:
        return _WORDS[word]
    stem, _, digits = word.rpartition("-")
    if stem in _NUMBERS and digits.isascii() and digits.isdigit():
        key, least, most, unit = _NUMBERS[stem]
        if least <= int(digits) <= most and digits == str(int(digits)):
            return key, int(digits) / 100 if unit == PERCENT else float(digits)
    return None


def _unknown(name: str, word: str, *, controllers: bool) -> InputError:
    where = f"controller {name!r}" if word == name else f"strategy {name!r}: {word!r}"
    ranges = ", ".join(f"{stem}-N from {least} to {most} {unit}" for stem, (_, least, most, unit) in _NUMBERS.items())
    first = f"{', '.join(registry.choice())} or file.py:Class, with options joined by +: " if controllers else ""
    hint = did_you_mean(word, [*(registry.choice() if controllers else ()), *OPTIONS])
    return InputError(f"{where} is unknown{hint}; choose from {first}{', '.join(OPTIONS)} (whole numbers, {ranges})")
