"""Signals as the network file and additional files describe them.

A perimeter command takes green away from the links of a gateway. It holds vehicles back only if
these links show green, yellow and red alone in the programme that runs (`free_light`). A link with
a green arrow, or one whose signal blinks or is off, lets vehicles pass at any time.
"""

import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from cosim.sumo.net import City, Gateway
from cosim.sumo.session import Phase, Programme
from cosim.sumo.xml_files import attribute, is_true, last_change, read_xml, seconds_of
from nmfd.errors import InputError

GREEN = frozenset("Gg")
CLOSED = frozenset("ryu")  # lights at which vehicles stop
SIMPLE = frozenset("Ggyrs")  # lights that other programmes and max-pressure can show
SWITCHED_OFF = "switched off"
TIMETABLE = "programme follows a timetable"
FREE = {"s": "turn on red", "o": "blinking", "O": SWITCHED_OFF}  # lights at which they may go
# SUMO's types of programmes.
STATIC = "static"
ACTUATED = "actuated"
# Those that always show one of their phases: green can be taken away.
HELD = (STATIC, ACTUATED, "delay_based")
OFF = "off"  # SUMO's name of the programme of a signal without lights
CONTROLLED = "controlled"  # gateway that perimeter control can hold


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

    offset: as in the file, seconds or "begin"
    links: from streets open to cars, several may share an index; others: from streets closed to
        them, such as bus lanes
    stages: numbers of the phases that are green for some link and yellow for none
    """

    id: str
    offset: str
    phases: tuple[Phase, ...]
    links: tuple[Link, ...]
    others: tuple[Link, ...] = ()

    @property
    def stages(self) -> tuple[int, ...]:
        return tuple(n for n, phase in enumerate(self.phases) if is_stage(phase.state))


@dataclass(frozen=True, kw_only=True)
class Logic:
    """A signal programme.

    programme: its id; kind: SUMO's type, or "branching"; states: of its phases
    """

    programme: str
    kind: str
    states: tuple[str, ...]


class Cycle(NamedTuple):
    """Phases of a signal in order.

    offset: as in the file, seconds or "begin"
    """

    offset: str
    phases: tuple[Phase, ...]


class SignalFile(NamedTuple):
    """The signals of one file, or of several.

    links: signal -> its links, without those of crossings
    programmes: signal -> the last <tlLogic>, which is the one that SUMO runs
    timetabled: signals whose programme a timetable (WAUT) changes
    """

    links: Mapping[str, Sequence[Link]]
    programmes: Mapping[str, ElementTree.Element]
    timetabled: frozenset[str]

    @property
    def logics(self) -> dict[str, Logic]:
        """Signal -> the programme that runs."""
        return {name: logic_of(element) for name, element in self.programmes.items()}


def is_stage(state: str) -> bool:
    """Return True for a state that is green for some link and yellow for none."""
    return bool(GREEN & set(state)) and "y" not in state


def free_light(states: Iterable[str], links: Collection[int]) -> str:
    """Return why no command can hold links under a programme, "" if one can.

    states: of the phases of the programme that runs; links: indices of a gateway's lights in them
    """
    lights = set[str]()
    for state in states:
        lights.update(state[link] for link in links if link < len(state))
    for light in sorted(lights - GREEN - CLOSED):
        return FREE.get(light, f"light {light}")
    if not lights & GREEN:
        return "never green"
    return ""


def unfit(logic: Logic) -> str:
    """Return why commands reach no signal with this programme, "" if they do."""
    if logic.programme == OFF:
        return SWITCHED_OFF
    if logic.kind not in HELD:
        return f"{logic.kind} signal"
    return ""


def control(gateway: Gateway, logics: Mapping[str, Logic], left: Mapping[str, str]) -> str:
    """Return CONTROLLED if a command can hold a gateway, else why none can.

    logics: signal -> the programme that runs; left: signal -> reason why it gets no command
    """
    if gateway.signal is None:
        return "no signal on some lanes" if gateway.links else "no signal"
    if gateway.signal in left:
        return left[gateway.signal]
    logic = logics.get(gateway.signal)
    if logic is None:
        return "no programme"
    return unfit(logic) or free_light(logic.states, gateway.links) or CONTROLLED


def held_city(city: City, logics: Mapping[str, Logic], left: Iterable[str] = ()) -> City:
    """Return the city with signals only where a command can hold (`control`)."""
    reasons = dict.fromkeys(left, "left alone")
    gateways = []
    for gateway in city.gateways:
        if control(gateway, logics, reasons) == CONTROLLED:
            gateways.append(gateway)
        else:
            gateways.append(replace(gateway, signal=None))
    return replace(city, gateways=tuple(gateways))


def without_effect(options: Mapping[str, str], mesoscopic: bool) -> str:
    """Return why SUMO's options leave all signals without effect, or "".

    mesoscopic: SUMO's queue model, in which signals belong to the junction control
    """
    if is_true(options.get("tls.all-off", "false")):
        return SWITCHED_OFF
    if mesoscopic and not is_true(options.get("meso-junction-control", "true")):
        return "mesoscopic model without junction control"
    return ""


def read_cycles(net: Path, additional: Iterable[Path]) -> dict[str, Cycle]:
    """Return signal -> cycle of the programme that runs. Raises InputError."""
    cycles = {}
    for name, logic in read_files(net, additional).programmes.items():
        cycles[name] = Cycle(logic.get("offset", "0"), phases_of(logic))
    return cycles


def running_logic(programme: Programme) -> Logic:
    """Return a programme that runs in a session."""
    kind = "other"
    if programme.static:
        kind = STATIC
    elif programme.actuated:
        kind = ACTUATED
    states = tuple(phase.state for phase in programme.phases)
    return Logic(programme=programme.id, kind=kind, states=states)


def read_signals(
    city: City, additional: Iterable[Path] = (), kinds: Collection[str] = (STATIC,)
) -> tuple[list[Signal], dict[str, str]]:
    """Return the simple signals, and why others keep their programme.

    Simple ones are of these `kinds`, with two stages or more, phases in order, and green, yellow,
    red and turns on red only. Of several programmes the last one counts, as in SUMO: first those
    of the network file, then those of `additional` files.
    """
    signals = []
    others = {}
    known = read_files(city.net_file, additional)
    for name, element in sorted(known.programmes.items()):
        cars: list[Link] = []
        closed: list[Link] = []
        for link in known.links.get(name, ()):
            is_for_cars = link.from_edge in city.lanes and link.to_edge in city.lanes
            (cars if is_for_cars else closed).append(link)
        reason = _not_simple(element, kinds)
        if not cars:
            reason = "no link for cars"
        if reason:
            others[name] = reason
            continue
        signal = Signal(
            id=name,
            offset=element.get("offset", "0"),
            phases=phases_of(element),
            links=tuple(cars),
            others=tuple(closed),
        )
        if len(signal.stages) > 1:
            signals.append(signal)
        else:
            others[name] = "fewer than two green phases"
    return signals, others


def phases_of(logic: ElementTree.Element) -> tuple[Phase, ...]:
    """Return the phases of a <tlLogic>. Raises InputError."""
    phases = []
    for row in logic.iter("phase"):
        try:
            duration = seconds_of(attribute(row, "duration"))
            state = attribute(row, "state")
        except ValueError as error:
            raise InputError(f"tlLogic {logic.get('id')}: phase: {error}; correct it") from None
        phases.append(Phase(duration=duration, state=state))
    return tuple(phases)


def read_files(net: Path, additional: Iterable[Path] = ()) -> SignalFile:
    """Return the signals of a network, with those of additional files.

    Raises: InputError
    """
    network = _network(net, last_change(net))
    programmes = dict(network.programmes)
    switched = set(network.timetabled)
    for path in additional:
        more = _file(read_xml(path))
        programmes |= more.programmes
        switched |= more.timetabled
    return network._replace(programmes=programmes, timetabled=frozenset(switched))


@lru_cache(maxsize=2)  # a large city takes seconds, and a run asks several times
def _network(net: Path, _: int) -> SignalFile:
    """Return the signals of a network.

    The last argument is the time of its last change, for the cache.
    """
    return _file(read_xml(net))


def _file(root: ElementTree.Element) -> SignalFile:
    links = defaultdict[str, list[Link]](list)
    for connection in root.iter("connection"):
        source = attribute(connection, "from")
        signal = connection.get("tl")
        if signal is None or source.startswith(":"):  # those are pedestrian crossings
            continue
        link = Link(
            index=int(attribute(connection, "linkIndex")),
            from_edge=source,
            lane=int(attribute(connection, "fromLane")),
            to_edge=attribute(connection, "to"),
        )
        links[signal].append(link)
    programmes = {attribute(logic, "id"): logic for logic in root.iter("tlLogic")}
    switched = {attribute(switch, "junctionID") for switch in root.iter("wautJunction")}
    return SignalFile(dict(links), programmes, frozenset(switched))


def logic_of(element: ElementTree.Element) -> Logic:
    """Return the programme of a <tlLogic>."""
    rows = list(element.iter("phase"))
    kind = element.get("type", STATIC)
    if kind == STATIC and any(row.get("next") for row in rows):
        kind = "branching"
    states = tuple(row.get("state", "") for row in rows)
    return Logic(programme=element.get("programID", "0"), kind=kind, states=states)


def _not_simple(element: ElementTree.Element, kinds: Collection[str]) -> str:
    """Return why a <tlLogic> cannot give way to another, "" if it can."""
    logic = logic_of(element)
    if logic.programme == OFF:
        return SWITCHED_OFF
    if any(row.get("next") for row in element.iter("phase")):
        return "branching signal"
    if logic.kind not in kinds:
        return f"{logic.kind} signal"
    for light in sorted(set("".join(logic.states)) - SIMPLE):
        return FREE.get(light, f"light {light}")
    return ""
