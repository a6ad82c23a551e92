"""Signals as the network file describes them, and other programmes for them as an additional file of SUMO."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cosim.sumo.net import City
from cosim.sumo.session import Phase
from cosim.sumo.xml_files import BROKEN, attribute, read_xml
from nmfd.errors import InputError
from nmfd.runs import files

GREEN = frozenset("Gg")
FIXED, ACTUATED = "static", ("actuated", "delay_based")  # SUMO's types of programmes; those with detectors of their own
HELD = (FIXED, *ACTUATED)  # what they show is always one of their phases: a part of its green can be taken away


@dataclass(frozen=True, kw_only=True)
class Link:
    """One index of a state string: from a lane to an edge. turn: SUMO's direction, s, l, r and others."""

    index: int
    from_edge: str
    lane: int
    to_edge: str
    turn: str = "s"


def lane_id(link: Link) -> str:
    """SUMO's name of the lane that a link comes from."""
    return f"{link.from_edge}_{link.lane}"


@dataclass(frozen=True, kw_only=True)
class Signal:
    """A simple signal: one programme of phases in one order, fixed-time unless others were asked for.

    links: from streets open to cars; several may have one index; others: from streets that are closed to them, such
        as bus streets
    stages: the phases that are green and have no yellow, by their number
    """

    id: str
    offset: float
    phases: tuple[Phase, ...]
    links: tuple[Link, ...]
    others: tuple[Link, ...] = ()

    @property
    def stages(self) -> tuple[int, ...]:
        """The numbers of the phases that are stages."""
        return tuple(n for n, phase in enumerate(self.phases) if is_stage(phase.state))


def is_stage(state: str) -> bool:
    """Whether a phase of this state is green for somebody and yellow for nobody."""
    return bool(GREEN & set(state)) and "y" not in state


def read_signals(
    city: City, additional: Iterable[Path] = (), kinds: Collection[str] = (FIXED,)
) -> tuple[list[Signal], list[str]]:
    """The simple signals of the city, and the names of all others, which no signal plan here touches: of other `kinds`
    (already actuated, unless these are asked for, with their nominal durations), fewer than two stages, phases out of
    order, or lights other than red, yellow and green.

    Of several programmes the one that is read last counts, as in SUMO: those of the network file come first, then those
    of the `additional` files.
    """
    try:
        return _signals(city, additional, kinds)
    except BROKEN as error:
        raise InputError(f"{city.net_file}: its signals cannot be read ({error}); build it with netconvert") from None


def _signals(city: City, additional: Iterable[Path], kinds: Collection[str]) -> tuple[list[Signal], list[str]]:
    root = read_xml(city.net_file)
    links: dict[str, list[Link]] = {}
    closed: dict[str, list[Link]] = {}
    for connection in root.iter("connection"):
        source, target = attribute(connection, "from"), attribute(connection, "to")
        signal = connection.get("tl")
        if signal is not None and not source.startswith(":"):  # those are crossings for pedestrians
            open_ = source in city.lanes and target in city.lanes
            (links if open_ else closed).setdefault(signal, []).append(
                Link(
                    index=int(attribute(connection, "linkIndex")),
                    from_edge=source,
                    lane=int(attribute(connection, "fromLane")),
                    to_edge=target,
                    turn=connection.get("dir", "s").lower(),
                )
            )
    logics = {
        attribute(logic, "id"): logic for file in (root, *map(read_xml, additional)) for logic in file.iter("tlLogic")
    }
    simple, others = [], []
    for name, logic in logics.items():
        found = _simple(logic, tuple(links.get(name, ())), tuple(closed.get(name, ())), kinds)
        if found is not None:
            simple.append(found)
        else:
            others.append(name)
    return sorted(simple, key=lambda signal: signal.id), sorted(others)


def _simple(
    logic: ElementTree.Element, links: tuple[Link, ...], others: tuple[Link, ...], kinds: Collection[str]
) -> Signal | None:
    rows = list(logic.iter("phase"))
    if logic.get("type", FIXED) not in kinds or any(row.get("next") for row in rows) or not links:
        return None
    phases = tuple(Phase(duration=float(attribute(row, "duration")), state=attribute(row, "state")) for row in rows)
    signal = Signal(
        id=attribute(logic, "id"), offset=float(logic.get("offset", 0.0)), phases=phases, links=links, others=others
    )
    plain = set("".join(phase.state for phase in phases)) <= set("Ggyr")
    return signal if plain and len(signal.stages) > 1 else None


def write_programmes(path: Path, rows: Iterable[str]) -> None:
    """An additional file of SUMO with rows from `programme_row`."""
    files.write_text(path, "".join(["<additional>\n", *rows, "</additional>\n"]))


def programme_row(signal: Signal, kind: str, *, limits: Mapping[int, tuple[float, float]] | None = None) -> str:
    """A tlLogic with the phases and the offset of `signal`; SUMO runs the programme of a signal that it reads last.

    kind: SUMO's type; limits: phase -> (minimum, maximum) [s] of an actuated one
    """
    rows = []
    for n, phase in enumerate(signal.phases):
        low, high = (limits or {}).get(n, (phase.duration, phase.duration))
        extra = "" if low == high else f' minDur="{low:g}" maxDur="{high:g}"'
        rows.append(f'    <phase duration="{phase.duration:g}"{extra} state="{phase.state}"/>\n')
    return (
        f'  <tlLogic id={quoteattr(signal.id)} type="{kind}" programID="plan" offset="{signal.offset:g}">\n'
        f"{''.join(rows)}  </tlLogic>\n"
    )
