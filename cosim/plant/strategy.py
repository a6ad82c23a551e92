"""Strategies in a city: a controller and what else the city does.

Words or Settings say what the city does:

dpc-pc+max-pressure      max-pressure at all signals, DPC limits the green of the gateways
no-control+rerouting-30  no control, 30 % of the drivers reroute; `rerouting-30` for short
mine.py:Gate+actuated    a controller of the user's own, actuated signals elsewhere

A new word is one entry of WORDS or NUMBERS; that of a signal control is its name in
SIGNAL_CONTROLS.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from cosim.plant.settings import (
    FIXED,
    PLAN,
    SIGNAL_CONTROLS,
    Settings,
    check_files,
    own_files,
    settings,
)
from nmfd.controllers import strategy as regional
from nmfd.controllers.strategy import ALONE, ControllerLike, Given, split
from nmfd.errors import InputError, did_you_mean
from nmfd.model.planning import GUIDED
from nmfd.model.scenario import Scenario
from nmfd.runs.files import file_hash


class Word(NamedTuple):
    """Word of a strategy: a setting, its value, and a line for help."""

    key: str
    value: Any
    text: str


class Number(NamedTuple):
    """Word with a number, WORD-N with N from `least` to `largest`.

    Percent become shares.
    """

    key: str
    least: int
    largest: int
    unit: str
    text: str


WORDS: dict[str, Word] = {
    "estimate": Word(
        "measurement",
        "estimate",
        "controller and guidance see what detectors and probe vehicles tell",
    ),
    "metering": Word(
        "metering",
        1.2,
        "trips wait outside while their region is full, or as the controller commands",
    ),
    GUIDED: Word("guided", True, "drivers are guided by travel times"),
    "planned": Word("planned", (PLAN,), f"drivers take the routes of the scenario's {PLAN}"),
}
NUMBERS: dict[str, Number] = {
    "rerouting": Number(
        "rerouting", 1, 100, "percent", "N percent of the drivers reroute by themselves"
    ),
    "compliance": Number(
        "compliance", 0, 100, "percent", "N percent of the drivers follow the guidance"
    ),
    "metering": Number(
        "metering", 1, 1000, "percent", "metering at N percent of the critical accumulation"
    ),
    "guidance-period": Number(
        "guidance_period", 1, 3600, "seconds", "drivers are guided again every N seconds"
    ),
}


@dataclass(frozen=True, kw_only=True)
class Strategy(regional.Strategy):
    """A controller and changes of the city that go with it.

    city: Settings whose given fields replace those of the scenario
    """

    city: Settings = field(default_factory=Settings, compare=False)

    @property
    def changes(self) -> dict[str, Any]:
        """Settings of the city that the strategy changes."""
        changes = {name: getattr(self.city, name) for name in self.city.model_fields_set}
        # Only without control may signals with gateways be actuated.
        changes.setdefault("gateways_fixed", self.controller.name != ALONE)
        return changes

    def settings(self, scenario: Scenario) -> Settings:
        """Return the settings of the city under this strategy. Raise InputError."""
        changed = settings(scenario).changed(**self.changes)
        check_files(scenario, changed)
        return changed

    def fingerprint(self, scenario: Scenario, policy: Path | None = None) -> dict[str, Any]:
        """Return what its runs depend on besides city and demand.

        Raises: InputError
        """
        found = super().fingerprint(scenario, policy)
        plans = own_files(scenario, self.city.planned)
        if plans:
            found["planned"] = [file_hash(file) for file in plans]
        return found


def parse(controller: ControllerLike, city: Settings | str | None = None) -> Strategy:
    """Return the strategy of a controller in a city.

    controller: a name with words, such as "pi-gating+max-pressure", options such as
        nmfd.PiGating(kp=2.0), an object with `reset` and `act`, or a strategy
    city: what else the city does, as words or as Settings whose given fields replace the scenario's
    Raises: InputError for unknown or contradictory words

    >>> parse("pi-gating+max-pressure").city.signals
    'max-pressure'
    >>> parse("pi-gating", Settings(guided=True)).name
    'pi-gating+guided'
    """
    if isinstance(controller, Strategy):
        return controller if city is None else _with_city(controller, city)
    name = ""
    if isinstance(controller, str):
        name = controller
        first, labels = split(controller)
        if setting_of(first) is not None:
            controller = "+".join([ALONE, first, *labels])
    parsed = regional.parse(controller, _allowed())
    strategy = Strategy(name=name or parsed.name, controller=parsed.controller)
    strategy = _with_words(strategy, parsed.labels)
    return strategy if city is None else _with_city(strategy, city)


def of_finished(name: str) -> Strategy:
    """Return the strategy of finished runs.

    Only the name is known of the user's objects.
    """
    try:
        return parse(name)
    except InputError:
        nothing: Any = None
        return Strategy(name=name, controller=Given(name=name, controller=nothing))


def label_of(key: str, value: Any) -> str:
    """Return the word for a setting, or "key=value" if there is none."""
    for name, word in _plain_words().items():
        if (word.key, word.value) == (key, value):
            return name
    for stem, number in NUMBERS.items():
        if number.key == key:
            count = round(100 * value) if number.unit == "percent" else round(value)
            if setting_of(f"{stem}-{count}") == (key, value):
                return f"{stem}-{count}"
    return f"{key}={value}"


def setting_of(word: str) -> tuple[str, Any] | None:
    """Return key and value of the setting that a word means.

    It is None if there is no such word.
    """
    plain = _plain_words().get(word)
    if plain is not None:
        return plain.key, plain.value
    stem, _, digits = word.rpartition("-")
    if stem not in NUMBERS or not digits.isdecimal() or digits != str(int(digits)):
        return None
    number = NUMBERS[stem]
    if not number.least <= int(digits) <= number.largest:
        return None
    value = int(digits) / 100 if number.unit == "percent" else float(digits)
    return number.key, value


def vocabulary() -> dict[str, str]:
    """Return every word with its text, for help."""
    words = {f"+{name}": word.text for name, word in _plain_words().items()}
    return words | {f"+{stem}-N": number.text for stem, number in NUMBERS.items()}


def check_tables(scenario: Scenario) -> None:
    """Raise InputError if a table of [controllers] has an unknown word."""
    for table in scenario.controller_options:
        _, labels = split(table)
        for word in labels:
            if setting_of(word) is None:
                problem = _unknown(table, word)
                raise InputError(f"{scenario.where}: controllers.{table}: {problem}")


def _with_words(strategy: Strategy, words: tuple[str, ...]) -> Strategy:
    """Return a strategy with the settings of more words. Raise InputError."""
    by_key: dict[str, str] = {}
    values = {}
    for word in words:
        setting = setting_of(word)
        if setting is None:
            raise _unknown(strategy.name, word)
        key, value = setting
        first = strategy.controller.name
        if word == GUIDED and strategy.controller_guides and not strategy.own:
            problem = f"{first} guides routes itself; omit {word}"
            raise InputError(f"strategy {strategy.name!r}: {problem}")
        if key in by_key:
            problem = f"{by_key[key]} and {word} exclude each other; omit one of them"
            raise InputError(f"strategy {strategy.name!r}: {problem}")
        by_key[key] = word
        values[key] = value
    return replace(strategy, labels=words, city=Settings(**values))


def _with_city(strategy: Strategy, city: Settings | str) -> Strategy:
    """Return a strategy with more changes of the city.

    Raises: InputError if two of them exclude each other
    """
    if isinstance(city, str):
        words = tuple(word for word in city.split("+") if word)
        name = "+".join([strategy.name, *words])
        return _with_words(replace(strategy, name=name), strategy.labels + words)
    if not isinstance(city, Settings):
        raise InputError(f"city: expected cosim.Settings or words, got {city!r}")
    values = {name: getattr(strategy.city, name) for name in strategy.city.model_fields_set}
    labels = []
    for key in sorted(city.model_fields_set):
        value = getattr(city, key)
        label = label_of(key, value)
        if key not in values:
            values[key] = value
            labels.append(label)
        elif values[key] != value:
            raise InputError(
                f"strategy {strategy.name!r}: {label_of(key, values[key])} and {label} exclude "
                "each other; omit one of them"
            )
    return replace(
        strategy,
        name="+".join([strategy.name, *labels]),
        labels=(*strategy.labels, *labels),
        city=Settings(**values),
    )


def _plain_words() -> dict[str, Word]:
    """Return the words without a number, those of signal controls first."""
    words = {}
    for name, control in SIGNAL_CONTROLS.items():
        if name != FIXED:
            words[name] = Word("signals", name, control.text)
    return words | WORDS


def _words() -> list[str]:
    return [*_plain_words(), *(f"{stem}-N" for stem in NUMBERS)]


def _allowed() -> str:
    """Return the words and their ranges."""
    ranges = []
    for stem, number in NUMBERS.items():
        ranges.append(f"{stem}-N from {number.least} to {number.largest} {number.unit}")
    return f"{', '.join(_words())} (whole numbers, {', '.join(ranges)})"


def _unknown(name: str, word: str) -> InputError:
    hint = did_you_mean(word, _words())
    problem = f"{word!r} is unknown{hint}; choose from {_allowed()}"
    return InputError(f"strategy {name!r}: {problem}")
