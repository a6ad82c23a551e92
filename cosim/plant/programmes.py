"""Which programme a signal of the city runs: its own, Webster's, an actuated one, or what max-pressure decides."""

import hashlib
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from xml.sax.saxutils import quoteattr

import sumo

from cosim.plant.actuated import actuated_row
from cosim.plant.settings import ACTUATED, FIXED, PRESSURES, WEBSTER, Settings
from cosim.sumo.build import network_folder
from cosim.sumo.net import City
from cosim.sumo.signals import FIXED as FIXED_TIME
from cosim.sumo.signals import HELD, Signal, read_signals, write_programmes
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.runs.files import temporary_folder


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
    trips: Iterable[tuple[float, Sequence[str]]],
) -> list[Path]:
    """Additional files with which SUMO runs other programmes than those of the network file; none for fixed ones.

    folder: of this run; trips: departure [s] and edges, for Webster's plan
    """
    if chosen.signals == WEBSTER:
        return optimised_plans(network_folder(scenario.network), city, signals.others, trips)
    if chosen.signals == ACTUATED:
        path = folder / "actuated.add.xml"
        write_programmes(path, [actuated_row(signal) for signal in signals.steered])
        return [path]
    return []


def optimised_plans(
    network: Path, city: City, others: Sequence[str], trips: Iterable[tuple[float, Sequence[str]]]
) -> list[Path]:
    """Return fixed-time plans by SUMO's own tools: cycles by Webster's formula, then offsets for green waves.

    network: its folder, in whose build folder plans are kept; others: signals that keep their programme; trips:
    departure [s] and edges, sorted by departure
    Raises InputError if a tool fails.
    """
    rows = [
        f'<vehicle id="{n}" depart="{depart:.2f}"><route edges={quoteattr(" ".join(edges))}/></vehicle>'
        for n, (depart, edges) in enumerate(trips)
    ]
    routes = "\n".join(["<routes>", *rows, "</routes>\n"]).encode()
    key = hashlib.sha256(routes + city.net_file.read_bytes() + metadata.version("eclipse-sumo").encode()).hexdigest()
    folder = shipped.build_folder(network)
    cycles, offsets = (folder / f"webster-{key[:16]}-{kind}.add.xml" for kind in ("cycles", "offsets"))
    if cycles.is_file() and offsets.is_file():
        return [cycles, offsets]
    shipped.made(folder)
    unified = ("-u", "-y", "3", "-p", "webster", "--skip", ",".join(others))
    with temporary_folder() as scratch:
        (scratch / "routes.xml").write_bytes(routes)
        for tool, target, options in (
            ("tlsCycleAdaptation.py", cycles, unified),
            ("tlsCoordinator.py", offsets, ("-a", str(cycles))),
        ):
            program = Path(sumo.SUMO_HOME) / "tools" / tool
            command = [sys.executable, str(program), "-n", str(city.net_file), "-r", "routes.xml", *options]
            result = subprocess.run(
                [*command, "-o", str(target)], cwd=scratch, capture_output=True, text=True, check=False
            )
            if result.returncode:
                words = (result.stderr.strip() or "no message").splitlines()[-1]
                raise InputError(f"{city.net_file}: {tool} cannot plan its signals ({words}); choose other signals")
    return [cycles, offsets]
