"""Signal programmes beside those of the network: actuated, or optimised."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, ElementTree, SubElement
from xml.sax.saxutils import quoteattr

import numpy as np

from cosim.plant.gates import MIN_GREEN_S, least_times
from cosim.plant.max_pressure import MAX_GREEN_S
from cosim.plant.settings import (
    ACTUATED,
    FIXED,
    Settings,
    check_lanes,
    own_files,
)
from cosim.plant.strategy import Strategy
from cosim.sumo.net import City, city_of
from cosim.sumo.programs import last_words, run_tool
from cosim.sumo.session import Phase
from cosim.sumo.signals import (
    HELD,
    STATIC,
    TIMETABLE,
    Signal,
    held_city,
    phases_of,
    read_files,
    read_signals,
    without_effect,
)
from cosim.sumo.xml_files import attribute, read_xml
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario


class Limits(NamedTuple):
    """Shortest and longest duration of a phase (s)."""

    least: float
    most: float


def check_strategy(strategy: Strategy, scenario: Scenario, city: City) -> None:
    """Raise InputError if a strategy cannot run in this city.

    The message begins with the strategy.
    """
    try:
        chosen = strategy.settings(scenario)
        check_lanes(scenario, chosen)
        if chosen.signals != FIXED:
            city_signals(city, scenario, chosen)
    except InputError as error:
        raise InputError(f"controller {strategy.name} cannot run here: {error}") from None


def scenario_city(scenario: Scenario, settings: Settings) -> City:
    """Return the scenario's city, with signals only where commands can hold.

    Raises InputError.
    """
    city = city_of(scenario.network)
    additional = own_files(scenario, settings.additional)
    logics = read_files(city.net_file, additional).logics
    return held_city(city, logics, _left_alone(city, settings, additional, logics))


def city_signals(
    city: City, scenario: Scenario, settings: Settings
) -> tuple[list[Signal], list[str]]:
    """Return the signals to run another programme, and those that cannot.

    Signals with gateways that stay fixed-time are in neither. Raises InputError if
    `settings.signals` fits none.
    """
    outside = settings.signals_from_outside
    kinds = HELD if outside else (STATIC,)
    additional = own_files(scenario, settings.additional)
    simple, others = read_signals(city, additional, kinds)
    left = _left_alone(city, settings, additional, [signal.id for signal in simple])
    others |= left
    simple = [signal for signal in simple if signal.id not in left]
    if settings.signals != FIXED and not simple:
        kind = "" if outside else "fixed-time "
        raise InputError(
            f"{city.net_file}: sumo.signals: {settings.signals} needs {kind}signals with several "
            f"green phases, but none of the {len(others)} signals here is one"
            f"{_counted(others.values())}; choose fixed"
        )
    kept = set()
    if settings.gateways_fixed and settings.signals == ACTUATED:
        kept = {gateway.signal for gateway in city.gateways}
    return [signal for signal in simple if signal.id not in kept], sorted(others)


def _left_alone(
    city: City, settings: Settings, additional: Sequence[Path], signals: Iterable[str]
) -> dict[str, str]:
    """Return which of `signals` perimeter control does not use, and why."""
    everywhere = without_effect(settings.options, bool(settings.mesoscopic))
    if everywhere:
        return dict.fromkeys(signals, everywhere)
    reasons = dict.fromkeys(settings.leave_signals, "left alone by the scenario")
    reasons |= dict.fromkeys(read_files(city.net_file, additional).timetabled, TIMETABLE)
    return {signal: reasons[signal] for signal in signals if signal in reasons}


def _counted(reasons: Iterable[str]) -> str:
    """Return how often each reason occurs, in parentheses; "" without any."""
    counts = [f"{reason}: {count}" for reason, count in Counter(reasons).most_common()]
    return f" ({', '.join(counts)})" if counts else ""


def actuated_limits(signal: Signal) -> list[Limits]:
    """Return the limits of each phase of an actuated signal.

    A stage lasts up to 1.5 times its fixed time: in congestion, the shares of the green are those
    of the programme. Between stages, and where pedestrians walk for long, times are fixed.
    """
    limits = []
    for n, (phase, low) in enumerate(zip(signal.phases, least_times(signal.phases), strict=True)):
        high = low
        if n in signal.stages:
            high = max(min(1.5 * phase.duration, MAX_GREEN_S), MIN_GREEN_S, low)
        limits.append(Limits(low, high))
    return limits


def write_actuated(path: Path, signals: Iterable[Signal]) -> None:
    """Write an additional file that makes fixed-time signals actuated ones.

    They are SUMO's, based on gaps.
    """
    root = Element("additional")
    for signal in signals:
        about = {"type": "actuated", "programID": "plan", "offset": signal.offset}
        logic = SubElement(root, "tlLogic", {"id": signal.id} | about)
        for phase, (low, high) in zip(signal.phases, actuated_limits(signal), strict=True):
            row = SubElement(logic, "phase", duration=f"{phase.duration:g}", state=phase.state)
            if low != high:
                row.attrib |= {"minDur": f"{low:g}", "maxDur": f"{high:g}"}
    ElementTree(root).write(path)


def write_optimised(
    folder: Path, city: City, others: Sequence[str], trips: Iterable[tuple[float, Sequence[str]]]
) -> list[Path]:
    """Write fixed-time plans by SUMO's own tools.

    Cycles come from Webster's formula, then offsets for green waves.

    others: signals that keep their programme
    trips: departure [s] and edges, sorted by departure
    Raises InputError if a tool fails.
    """
    rows = ["<routes>"]
    for n, (depart, edges) in enumerate(trips):
        route = f"<route edges={quoteattr(' '.join(edges))}/>"
        rows.append(f'<vehicle id="{n}" depart="{depart:.2f}">{route}</vehicle>')
    rows.append("</routes>\n")
    (folder / "planned.xml").write_text("\n".join(rows), encoding="utf-8")
    cycles = folder / "cycles.add.xml"
    offsets = folder / "offsets.add.xml"
    webster = ("-u", "-y", "3", "-p", "webster", f"--skip={','.join(others)}")
    _plan("tlsCycleAdaptation.py", city, cycles, *webster)
    _keep_times(cycles, city.net_file)
    _plan("tlsCoordinator.py", city, offsets, "-a", cycles.name)
    # Offsets in whole seconds, as in plans of practice.
    whole = re.sub(
        r'offset="([^"]+)"',
        lambda found: f'offset="{round(float(found[1]))}"',
        offsets.read_text(encoding="utf-8"),
    )
    offsets.write_text(whole, encoding="utf-8")
    return [cycles, offsets]


def _plan(tool: str, city: City, plan: Path, *options: str) -> None:
    """Write a plan by a tool of SUMO, in the folder of the plan.

    Raises InputError if the tool fails.
    """
    files = ("-n", str(city.net_file.resolve()), "-r", "planned.xml", "-o", plan.name)
    result = run_tool(tool, *files, *options, folder=plan.parent)
    if result.returncode:
        words = last_words(result)
        raise InputError(
            f"{city.net_file}: {tool} cannot plan its signals ({words}); choose other signals"
        )


def _keep_times(plan: Path, net_file: Path) -> None:
    """Lengthen phases of a plan to their least times in the network.

    The cycle stays: the seconds come from the phases that exceed their least times most.
    """
    least_of = {}
    for logic in read_xml(net_file).iter("tlLogic"):
        phases = phases_of(logic)
        least_of[_key(logic, phases)] = np.array(least_times(phases))
    root = read_xml(plan)
    for logic in root.iter("tlLogic"):
        phases = phases_of(logic)
        planned = np.array([phase.duration for phase in phases])
        least = least_of[_key(logic, phases)]
        seconds = np.maximum(planned, least)
        while seconds.sum() > planned.sum() + 1e-6 and (seconds > least).any():
            longest = np.argmax(seconds - least)
            excess = seconds.sum() - planned.sum()
            seconds[longest] -= min(1.0, excess, seconds[longest] - least[longest])
        for row, duration in zip(logic.iter("phase"), seconds, strict=True):
            row.set("duration", f"{duration:g}")
    ElementTree(root).write(plan)


def _key(logic: Element, phases: Sequence[Phase]) -> tuple[str, ...]:
    """Return what programmes of the same signal with the same states share."""
    return attribute(logic, "id"), *(phase.state for phase in phases)
