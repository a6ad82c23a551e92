"""Which programme a signal of the city runs: its own, Webster's, an actuated one, or what max-pressure decides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.plant import webster
from cosim.plant.actuated import actuated_row
from cosim.plant.settings import ACTUATED, FIXED, PRESSURES, WEBSTER, Settings
from cosim.sumo.build import network_folder
from cosim.sumo.net import City
from cosim.sumo.signals import FIXED as FIXED_TIME
from cosim.sumo.signals import HELD, Signal, read_signals, write_programmes
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped


@dataclass(frozen=True, kw_only=True)
class CitySignals:
    """simple: may run another programme; steered: of them, all but those that keep their own for perimeter control;
    others: names of those left alone (cosim.sumo.signals, leave_signals)."""

    simple: list[Signal]
    steered: list[Signal]
    others: list[str]


def city_signals(city: City, chosen: Settings, additional: Sequence[Path]) -> CitySignals:
    """additional: the city's own additional files. InputError where the chosen programme fits no signal."""
    pressure = chosen.signals in PRESSURES
    simple, others = read_signals(city, additional, HELD if pressure else (FIXED_TIME,))
    left = {signal.id for signal in simple} & set(chosen.leave_signals)
    simple, others = [signal for signal in simple if signal.id not in left], sorted({*others, *left})
    if chosen.signals != FIXED and not simple:
        raise InputError(
            f"{city.net_file}: sumo.signals: {chosen.signals} needs {'' if pressure else 'fixed-time '}signals "
            f"with several green phases, but none of the {len(others)} signals here is one; choose fixed"
        )
    kept = set()
    if chosen.gateways_fixed and chosen.signals == ACTUATED:
        kept = {gateway.signal for gateway in city.gateways}
    return CitySignals(simple=simple, steered=[signal for signal in simple if signal.id not in kept], others=others)


def write_signal_programmes(
    folder: Path,
    city: City,
    scenario: Scenario,
    chosen: Settings,
    signals: CitySignals,
    own_flows: Mapping[tuple[str, str], float] | None,
) -> list[Path]:
    """Additional files with which SUMO runs other programmes than those of the network file; none for fixed ones.

    folder: of this run; Webster's plan is kept with the network. own_flows: of the city's own vehicles
    """
    if chosen.signals == WEBSTER:
        return [
            webster.plan(
                city,
                signals.simple,
                scenario.demand,
                scenario.step,
                folder=shipped.build_folder(network_folder(scenario.network)),
                flows=own_flows,
            )
        ]
    if chosen.signals == ACTUATED:
        path = folder / "actuated.add.xml"
        write_programmes(path, [actuated_row(signal) for signal in signals.steered])
        return [path]
    return []
