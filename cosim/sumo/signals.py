"""Signals as the network file and additional files describe them."""

import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from cosim.sumo.net import City
from cosim.sumo.session import Phase
from cosim.sumo.xml_files import attribute, read_xml

GREEN = frozenset("Gg")
STATIC = "static"  # SUMO's type of fixed-time programmes
HELD = (
    STATIC,
    "actuated",
    "delay_based",
)  # types that always show one of their phases: green can be taken away


@dataclass(frozen=True, kw_only=True)
class Link:
    """One index of a state string: from a lane to an edge."""

    index: int
    from_edge: str
    lane: int
    to_edge: str


def lane_id(link: Link) -> str:
    """Return SUMO's name of the lane that a link comes from."""
    return f"{link.from_edge}_{link.lane}"


@dataclass(frozen=True, kw_only=True)
class Signal:
    """A signal with one programme of phases in a fixed order.

    links: from streets open to cars, several may share an index; others: from streets closed to
        them, such as bus lanes
    stages: numbers of the phases that are green for some link and yellow for none
    """

    id: str
    offset: float
    phases: tuple[Phase, ...]
    links: tuple[Link, ...]
    others: tuple[Link, ...] = ()

    @property
    def stages(self) -> tuple[int, ...]:
        return tuple(n for n, phase in enumerate(self.phases) if is_stage(phase.state))


def is_stage(state: str) -> bool:
    """Return True for a state that is green for some link and yellow for none."""
    return bool(GREEN & set(state)) and "y" not in state


def read_signals(
    city: City, additional: Iterable[Path] = (), kinds: Collection[str] = (STATIC,)
) -> tuple[list[Signal], list[str]]:
    """Return the simple signals of the city, and the names of all others, which keep their
    programmes.

    Simple ones are of these `kinds`, with two stages or more, phases in order, and red, yellow and
    green only. Of several programmes the last one counts, as in SUMO: first those of the network
    file, then of `additional` files.
    """
    root = read_xml(city.net_file)
    links, closed = defaultdict[str, list[Link]](list), defaultdict[str, list[Link]](list)
    for connection in root.iter("connection"):
        source, target = attribute(connection, "from"), attribute(connection, "to")
        signal = connection.get("tl")
        if signal is not None and not source.startswith(":"):  # those are pedestrian crossings
            index, lane = (
                int(attribute(connection, "linkIndex")),
                int(attribute(connection, "fromLane")),
            )
            link = Link(index=index, from_edge=source, lane=lane, to_edge=target)
            (links if source in city.lanes and target in city.lanes else closed)[signal].append(
                link
            )
    logics = {
        attribute(logic, "id"): logic
        for file in (root, *map(read_xml, additional))
        for logic in file.iter("tlLogic")
    }
    signals = {
        name: _simple(logic, links[name], closed[name], kinds)
        for name, logic in sorted(logics.items())
    }
    return [signal for signal in signals.values() if signal], [
        name for name, s in signals.items() if s is None
    ]


def phases_of(logic: ElementTree.Element) -> tuple[Phase, ...]:
    """Return the phases of a <tlLogic>."""
    rows = logic.iter("phase")
    return tuple(
        Phase(duration=float(attribute(row, "duration")), state=attribute(row, "state"))
        for row in rows
    )


def _simple(
    logic: ElementTree.Element,
    links: Iterable[Link],
    others: Iterable[Link],
    kinds: Collection[str],
) -> Signal | None:
    ordered = logic.get("type", STATIC) in kinds and not any(
        row.get("next") for row in logic.iter("phase")
    )
    if not ordered or not links:
        return None
    name, offset, phases = attribute(logic, "id"), float(logic.get("offset", 0.0)), phases_of(logic)
    signal = Signal(id=name, offset=offset, phases=phases, links=tuple(links), others=tuple(others))
    plain = set("".join(phase.state for phase in phases)) <= set("Ggyr")
    return signal if plain and len(signal.stages) > 1 else None
