"""Flows between links: the link transmission model with a node model.

Yperman, "The link transmission model for dynamic network loading" (2007), with cumulative counts of
a link up- and downstream, N_up and N_down, of length L, n lanes, and the free-flow time tau:

    S(t) = N_up(t - tau) - N_down(t)                         vehicles that can leave (sending)
    R(t) = N_down(t - L / w) + n L / spacing - N_up(t)       vehicles that can enter (receiving)

Backward waves have the speed w. Vehicles are counted by link and destination region (entries). The
first vehicles of a link, s dt in each lane, are counted by turn and destination (cells): y_c, first
in the order of arrival; s is the saturation flow. In each step of dt seconds

    1. the room in the lanes for first vehicles is filled in the order of arrival, by the shares of
       the cells: a vehicle that cannot go on stays in front, and holds up those behind it;
    2. of the first vehicles of turn t, phi_t can go: its light, less where it gives way;
    3. they share the room of the next link in proportion: rho_h = min(1, R_h / sum_t phi_t y_t);
       of those who give way to others that enter it, all but PUSHING share what these leave;
    4. phi_t rho_h y_c leave the cell.

Where all lanes of a link lead to all turns, steps 1 to 4 are the node model of Tampere, Corthout,
Cattrysse and Immers, "A generic class of first order node models" (2011), with demand-proportional
shares, if green lasts long enough: first in, first out, and no flow could be larger. Where lanes
lead to some turns only, vehicles that all want one turn still move up in all lanes.
A movement that gives way to a flow f has exp(-gap f) of its green, which is the chance that no
vehicle comes within the critical gap; to merge with a flow of the speed v it needs v / 2a more. A
vehicle that stood at the stop line takes longer along the next link: START_S until it drives, and
v / 2a as it accelerates by a, less what each green loses of its capacity at the beginning
(`Flows.lost`). Trips begin and end where they do on average along a street; one that ends in the
queue moves up there.

Every vehicle that leaves one count enters another one: mass and its derivative are conserved.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from nmfd.model.links.chance import Chance, Choice
from nmfd.model.links.network import LinkNetwork

EPSILON = 1e-3  # veh
LEAST = 0.1  # veh: smaller counts do not divide a room, which bounds the gradient
INFLOW = 0.6  # veh/s in each lane, the most that can enter a link
# SUMO's cars leave a queue with headways of REACTION * tau + (spacing + BETWEEN_M) / limit, and at
# least TURNING * tau + spacing / v, at the speed v on the junction.
REACTION = 1.04
BETWEEN_M = 4.8
TURNING = 1.4
START_S = 1.6  # after which the first vehicle of a queue drives
ACCELERATING = 0.85  # of a vehicle's acceleration, as drivers dawdle
BRAKING = 4.5  # m/s2, of SUMO's cars that stop at yellow
PUSHING = 0.25  # of those who give way, the share that finds room as the others do, as in SUMO


class Numbers(NamedTuple):
    """Calibration of the model to a city; the defaults are not fitted.

    time_factor: of the free-flow times (-)
    spacing: of the length of lane that a standing vehicle takes (-)
    saturation: of the flow of a lane at green, which is 1 / (1.04 tau + (spacing + 4.8 m) / limit),
        and at most 1 / (1.4 tau + spacing / v) with the speed v on the junction (-)
    gap: critical gap of vehicles that cross a flow (s)
    """

    time_factor: float = 1.0
    spacing: float = 1.0
    saturation: float = 1.0
    gap: float = 4.7


History: TypeAlias = tuple[tuple[Tensor, ...], ...]


class Traffic(NamedTuple):
    """State of B rollouts between two steps (veh).

    held: trips that metering keeps outside, by entry (B, E)
    due: trips that wait outside until their link has room, by entry (B, E)
    outside: the same by link (B, L)
    queue: vehicles at the end of the street, behind the first ones, by entry (B, E)
    first: first vehicles, by cell (B, C)
    standing: the same by turn (B, T)
    stopping: vehicles in the queue whose trip ends in the link (B, L)
    inside: all vehicles, by link (B, L)
    recent: flow of each movement, smoothed over the critical gap (veh/s, (B, M))
    completed: completed trips, by link (B, L)
    entered: vehicles that entered in the last steps, by entry (Delay)
    started: the same for vehicles that had stood at the stop line before
    moved: vehicles that moved up to the stop line so far, by entry (B, E)
    ending: those that entered to end their trip there, by link (Delay)
    left: vehicles that left each link so far (B, L)
    had_left: the same at the ends of the last steps (Delay)
    """

    held: Tensor
    due: Tensor
    outside: Tensor
    queue: Tensor
    first: Tensor
    standing: Tensor
    stopping: Tensor
    inside: Tensor
    recent: Tensor
    completed: Tensor
    entered: History
    started: History
    moved: Tensor
    ending: History
    left: Tensor
    had_left: History


class Ways(NamedTuple):
    """Shares by which B rollouts divide vehicles (-).

    cells: of each cell among those of its entry (B, C)
    goes_on: of the vehicles that enter, those whose trip does not end there, by entry (B, E)
    ends: one less that, for the entries at home, where trips end (B, H)
    choice: how single vehicles draw their cells, None: they are divided
    """

    cells: Tensor
    goes_on: Tensor
    ends: Tensor
    choice: Choice | None = None


class Delay:
    """Histories of columns that are read at an age of their own.

    A history has a part for each age, with the columns of that age: their values at the ends of the
    last steps, the newest last, up to one older than the age.
    """

    def __init__(self, steps: np.ndarray, device: torch.device):
        """steps: age of each column, 1 for the newest (n,)"""
        order = np.argsort(steps, kind="stable")
        ages, sizes = np.unique(steps, return_counts=True)
        self._ages = ages.tolist()
        self._sizes = sizes.tolist()
        self._sorted = bool((np.diff(steps) >= 0).all())
        self._order = torch.as_tensor(order, device=device)
        self._back = torch.as_tensor(np.argsort(order), device=device)

    def start(self, values: Tensor) -> History:
        """Return the history of values (B, n) that never changed."""
        history = []
        for age, part in zip(self._ages, self._parts(values), strict=True):
            history.append((part,) * (age + 1))
        return tuple(history)

    def with_new(self, history: History, values: Tensor) -> History:
        """Return the history with new values (B, n), without its oldest ones."""
        pairs = zip(history, self._parts(values), strict=True)
        return tuple((*part[1:], newest) for part, newest in pairs)

    def read(self, history: History) -> Tensor:
        """Return the values that have the age of their column (B, n)."""
        return self._natural([part[1] for part in history])

    def older(self, history: History) -> Tensor:
        """Return the values that are a step older (B, n)."""
        return self._natural([part[0] for part in history])

    def younger(self, history: History) -> Tensor:
        """Return the sums of values that have not come to this age (B, n)."""
        return self._natural([torch.stack(part[1:]).sum(0) for part in history])

    def _parts(self, values: Tensor) -> tuple[Tensor, ...]:
        """Return the columns of each age."""
        if not self._sorted:
            values = values.index_select(1, self._order)
        return values.split(self._sizes, dim=1)

    def _natural(self, parts: Sequence[Tensor]) -> Tensor:
        """Return the columns of all ages in their own order."""
        values = torch.cat(list(parts), dim=1)
        if self._sorted:
            return values
        return values.index_select(1, self._back)


class Flows:
    """Equations of one city; `step` advances B rollouts by `dt` seconds.

    lost: time lost in each green that a queue has, by movement (s, (M,))
    light: of the programmes without it, as network.light
    """

    delay = Delay  # kind of the histories

    def __init__(
        self,
        network: LinkNetwork,
        numbers: Numbers,
        *,
        dt: float,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
    ):
        self.network = network
        self.numbers = numbers
        self.dt = dt
        self.dtype = dtype
        self.device = torch.device(device)
        self.links = len(network.length)
        self.movements = len(network.cycle)
        self.entries = len(network.entry_link)
        self._number()
        self._delay()
        self._limit()
        self._give_way()
        self._rank()
        self._light()

    def _give_way(self) -> None:
        """Set who gives way to which flow, and the gap needed in it."""
        network = self.network
        street = np.zeros(self.movements, dtype=network.street.dtype)
        street[network.turn_movement] = network.street[network.turn_link]
        merges = street[network.yielding] == street[network.foe]
        # A car that merges falls behind the flow while it accelerates to the same speed.
        lost = network.speed[network.foe] / (2.0 * ACCELERATING * network.acceleration)
        self._gaps = self.values(self.numbers.gap + np.where(merges, lost, 0.0))
        self._yielding = self.places(network.yielding)
        self._foe = self.places(network.foe)

    def _rank(self) -> None:
        """Set which turns are minor: others with right of way enter their link."""
        network = self.network
        foes = defaultdict[int, list[int]](list)
        for movement, foe in zip(network.yielding, network.foe, strict=True):
            foes[movement].append(foe)
        turns = list(zip(network.turn_movement, network.turn_link, strict=True))
        known = set(turns)
        minor = [any((foe, link) in known for foe in foes[movement]) for movement, link in turns]
        self._minor = self.values((1.0 - PUSHING) * np.array(minor))

    def _number(self) -> None:
        """Set which count belongs to which other one."""
        network = self.network
        self.link_of_entry = self.places(network.entry_link)
        self.region_of_entry = self.places(network.region[network.entry_link])
        self.entry_of_cell = self.places(network.cell_entry)
        self.onward = self.places(network.cell_onward)
        self._turn_of_cell = self.places(network.cell_turn)
        self._movement_of_turn = self.places(network.turn_movement)
        self._link_entered = self.places(network.turn_link)
        self._link_left = self.places(network.movement_link)
        self._link_of_turn = self.places(network.movement_link[network.turn_movement])
        self._served = self.places(network.served)
        self._server = self.places(network.server)
        self._link_of_lane = self.places(network.lane_link)
        at_home = np.flatnonzero(network.ending.max(axis=0) > 0.0)
        self._home = self.places(at_home)
        self._home_link = self.places(network.entry_link[at_home])
        self._ending = self.values(network.ending)
        self._ahead = self.values(1.0 - network.first[network.entry_link])
        # A share of a street's queue begins behind the ends of trips.
        self._met = self.values(0.5 / np.maximum(1.0 - network.last, 0.01))
        self._pace_to_end = self.values(1.0 / np.maximum(network.last, 0.1))

    def _delay(self) -> None:
        """Set the times that vehicles and holes take, in steps."""
        network = self.network
        numbers = self.numbers
        self.spacing = numbers.spacing * network.spacing
        speed = (network.length + network.behind) / network.free_time
        driven = np.maximum(speed - network.dawdling, 0.5 * speed)
        self.free_time = numbers.time_factor * network.free_time * speed / driven
        free_steps = self.free_time / self.dt
        along = np.maximum(np.floor(free_steps), 1).astype(int)
        to_end = np.maximum(np.round(network.last * free_steps), 1).astype(int)
        flow = self._saturation(speed, speed)
        self.speed = speed
        wave = flow / (1.0 / self.spacing - flow / speed)
        self.wave = wave
        # A queue discharges at its flow, although its first vehicle is late on the next link.
        late = self._starting(speed) - self._losing(speed, flow)
        late = np.minimum(late, network.length / wave)
        # Room counts at the end of a step. Between steps counts change evenly.
        wave_steps = np.maximum((network.length / wave - late) / self.dt, 1.0)
        # Vehicles and holes under way in a lane while its full flow enters (veh).
        self._flowing = flow * self.dt * (np.maximum(free_steps, 1.0) + wave_steps + 1.0)
        backwards = np.floor(wave_steps).astype(int)
        self._earlier = self.values(wave_steps - backwards)
        self._along = self.delay(along[network.entry_link], self.device)
        part = np.maximum(free_steps - along, 0.0)
        self._part = self.values(part[network.entry_link])
        started = np.maximum(np.round(free_steps + late / self.dt), 1).astype(int)
        self._started = self.delay(started[network.entry_link], self.device)
        self._to_end = self.delay(to_end, self.device)
        self._backwards = self.delay(backwards, self.device)

    def _saturation(self, speed: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """Return the flow of a lane at green (veh/s).

        speed: of cars (m/s); limit: of the street that they come from (m/s)
        """
        network = self.network
        straight = REACTION * network.headway + (network.spacing + BETWEEN_M) / limit
        turning = TURNING * network.headway + network.spacing / speed
        return self.numbers.saturation / np.maximum(straight, turning)

    def _losing(self, speed: np.ndarray, saturation: np.ndarray) -> np.ndarray:
        """Return the time lost in each green of a lane that has a queue (s).

        Vehicle k of a queue crosses the stop line START_S + v / 2a + k / s after the light changes,
        but the first one START_S after it. Those that cannot stop any more cross at yellow. The
        constants are those of SUMO at one signal (tests/test_link_capacity.py).

        speed: on the junction (m/s); saturation: s (veh/s)
        """
        yellow = speed / (2.0 * BRAKING)
        return np.maximum(self._starting(speed) - 1.0 / saturation - yellow, 0.0)

    def _starting(self, speed: np.ndarray) -> np.ndarray:
        """Return the time that a standing vehicle loses as it starts (s)."""
        return START_S + speed / (2.0 * ACCELERATING * self.network.acceleration)

    def _limit(self) -> None:
        """Set the storage of links, and the most vehicles that move in a step."""
        network = self.network
        lanes = np.bincount(network.lane_link, minlength=self.links)
        # On a short link more vehicles drive, and holes come back, than can stand there.
        storage = lanes * np.maximum(network.length / self.spacing, self._flowing)
        self.storage = self.values(storage)
        self._most_in = self.values(INFLOW * self.dt * lanes)
        limit = network.limit[network.movement_link]
        saturation = self._saturation(network.speed, limit)
        self.lost = self._losing(network.speed, saturation)
        saturation *= (1.0 - network.stopped[network.movement_link]) * self.dt
        movement = network.turn_movement[network.served]
        fastest = np.zeros(len(network.lane_link))
        np.maximum.at(fastest, network.server, saturation[movement])
        fastest[fastest == 0.0] = saturation.max()  # lanes on which trips end
        self._first_of_lane = self.values(fastest)
        of_link = np.bincount(network.lane_link, fastest, self.links)
        self._most_moved = int(np.ceil(of_link.max()))
        of_movement = np.zeros(self.movements)
        np.maximum.at(of_movement, movement, fastest[network.server])
        lanes_of_turn = np.bincount(network.served)
        self._lanes_of_turn = self.values(lanes_of_turn)
        self._lane_share = self.values(1.0 / lanes_of_turn[network.served])
        self._pace = self.values(saturation / of_movement)
        self._per_step = self.values(saturation)
        self.smoothing = min(self.dt / self.numbers.gap, 1.0)

    def _light(self) -> None:
        """Set the light of the programmes without the time lost in each green."""
        network = self.network
        self.light = network.light.copy()
        for begin, cycle, lost in zip(network.begin, network.cycle, self.lost, strict=True):
            own = slice(begin, begin + cycle)
            self.light[own] = _late(network.light[own], lost)

    def values(self, numbers: np.ndarray) -> Tensor:
        """Return an array of numbers as a tensor of this model."""
        return torch.as_tensor(np.asarray(numbers), dtype=self.dtype, device=self.device)

    def places(self, numbers: np.ndarray) -> Tensor:
        """Return an array of places as a tensor of this model."""
        return torch.as_tensor(np.asarray(numbers), dtype=torch.long, device=self.device)

    def sums(self, values: Tensor, place: Tensor, count: int) -> Tensor:
        """Return sums (B, count) of `values` (B, n) with the same `place` (n,)."""
        zeros = torch.zeros(len(values), count, dtype=self.dtype, device=self.device)
        return zeros.index_add(1, place, values)

    def by_link(self, entries: Tensor) -> Tensor:
        """Return the sums (B, L) of counts by entry (B, E)."""
        return self.sums(entries, self.link_of_entry, self.links)

    def start(self, batch: int) -> Traffic:
        """Return the empty city."""

        def empty(count: int) -> Tensor:
            return torch.zeros(batch, count, dtype=self.dtype, device=self.device)

        return Traffic(
            held=empty(self.entries),
            due=empty(self.entries),
            outside=empty(self.links),
            queue=empty(self.entries),
            first=empty(len(self.onward)),
            standing=empty(len(self._link_entered)),
            stopping=empty(self.links),
            inside=empty(self.links),
            recent=empty(self.movements),
            completed=empty(self.links),
            entered=self._along.start(empty(self.entries)),
            started=self._started.start(empty(self.entries)),
            moved=empty(self.entries),
            ending=self._to_end.start(empty(self.links)),
            left=empty(self.links),
            had_left=self._backwards.start(empty(self.links)),
        )

    def ways(self, cells: Tensor, row: Tensor, chance: Chance | None = None) -> Ways:
        """Return the ways with these cells (-, (B, C)).

        row: of the network's shares, of each rollout (B,)
        chance: with which vehicles draw their cells; they are divided if None
        """
        ending = self._ending.index_select(0, row)
        choice = None
        if chance is not None:
            choice = chance.choice(cells)
        return Ways(cells, 1.0 - ending, ending.index_select(1, self._home), choice)

    def step(
        self, traffic: Traffic, begin: Tensor, light: Tensor, yields: Tensor, ways: Ways
    ) -> Traffic:
        """Return the state a step later.

        begin: trips that may begin from now on, by entry (veh, (B, E))
        light: green of each movement in this step, with gates (-, (B, M))
        yields: share of this green in which it gives way (-, (B, M))
        ways: of the vehicles
        """
        # Vehicles arrive at the queue; trips end before it or in it.
        queue = traffic.queue + self._arriving(traffic)
        ends = self._to_end.read(traffic.ending)
        in_queue = ends * (self._met * traffic.inside / self.storage).clamp(max=1.0)
        stopping = traffic.stopping + in_queue

        # 1. The first vehicles.
        in_lane = traffic.standing.index_select(1, self._served) * self._lane_share
        in_lane = self.sums(in_lane, self._server, len(self._link_of_lane))
        room = self._first_of_lane * (1.0 - in_lane).clamp(min=0.0)
        room = self.sums(room, self._link_of_lane, self.links)
        moving_up = (room / self.by_link(queue).clamp(min=LEAST)).clamp(max=1.0)
        moved = queue * moving_up.index_select(1, self.link_of_entry)
        stopped = stopping * (self._pace_to_end * moving_up).clamp(max=1.0)
        cells = ways.cells
        if ways.choice is not None:
            cells = ways.choice.cells(traffic.moved, moved, self._most_moved)
        first = traffic.first + moved.index_select(1, self.entry_of_cell) * cells
        by_turn = self.sums(first, self._turn_of_cell, len(self._link_entered))

        # 2. Those that can go, and the trips that can begin.
        stood = traffic.standing / by_turn.clamp(min=EPSILON)
        green = self._green(traffic, by_turn, stood, light, yields)
        due = traffic.due + begin
        waiting = self.by_link(due)
        put = (self._most_in / waiting.clamp(min=LEAST)).clamp(max=1.0)

        # 3. and 4. Room on the next link, and flows.
        rho, entering = self._entering(traffic, by_turn * green, waiting * put, yields)
        going = green * entering
        leaving = first * going.index_select(1, self._turn_of_cell)
        flow = by_turn * going
        entered = self.sums(leaving, self.onward, self.entries)
        had_stood = leaving * stood.index_select(1, self._turn_of_cell)
        started = self.sums(had_stood, self.onward, self.entries)
        passed = self.sums(flow, self._movement_of_turn, self.movements)
        left = self.sums(passed, self._link_left, self.links)
        put = put * rho
        begun = due * put.index_select(1, self.link_of_entry)
        completed = ends - in_queue + stopped
        coming = self.sums(flow, self._link_entered, self.links) + waiting * put
        # Trips that drive a share of their first street begin at its two ends by this share.
        ahead = begun * self._ahead
        ending = entered.index_select(1, self._home) * ways.ends
        starting = started * ways.goes_on
        passing = entered * ways.goes_on - starting + begun - ahead
        return Traffic(
            held=traffic.held,
            due=due - begun,
            outside=waiting - waiting * put,
            queue=queue - moved + ahead,
            first=first - leaving,
            standing=by_turn - flow,
            stopping=stopping - stopped,
            inside=traffic.inside + coming - left - completed,
            recent=traffic.recent + self.smoothing * (passed / self.dt - traffic.recent),
            completed=traffic.completed + completed,
            entered=self._along.with_new(traffic.entered, passing),
            started=self._started.with_new(traffic.started, starting),
            moved=traffic.moved + moved,
            ending=self._to_end.with_new(
                traffic.ending, self.sums(ending, self._home_link, self.links)
            ),
            left=traffic.left + left,
            had_left=self._backwards.with_new(traffic.had_left, traffic.left + left),
        )

    def _arriving(self, traffic: Traffic) -> Tensor:
        """Return those who arrive at the queue in a step, by entry (veh, (B, E))."""
        soon = self._along.read(traffic.entered)
        arriving = soon + self._part * (self._along.older(traffic.entered) - soon)
        return arriving + self._started.read(traffic.started)

    def near(self, traffic: Traffic, share: Tensor) -> Tensor:
        """Return the vehicles that wait at each stop line, or soon will.

        The result has the shape (B, L).

        share: of the step that comes, in which they arrive (-, (L,))
        """
        first = self.sums(traffic.standing, self._link_of_turn, self.links)
        arriving = self.by_link(self._arriving(traffic))
        return self.by_link(traffic.queue) + first + share * arriving

    def _green(
        self, traffic: Traffic, by_turn: Tensor, stood: Tensor, light: Tensor, yields: Tensor
    ) -> Tensor:
        """Return the share phi of first vehicles that can go (-, (B, T)).

        A vehicle that stood in front goes first, at the headway of its movement; those that arrive
        go at the pace of their lane, as long as all keep that headway.

        by_turn: the first vehicles (veh, (B, T)); stood: share that stood in front (-, (B, T))
        """
        foes = self._gaps * traffic.recent.index_select(1, self._foe)
        gap = torch.exp(-self.sums(foes, self._yielding, self.movements))
        open_share = light * (1.0 - yields * (1.0 - gap))
        arriving = (self._pace * open_share).index_select(1, self._movement_of_turn)
        most = (self._per_step * open_share).index_select(1, self._movement_of_turn)
        most = most * self._lanes_of_turn
        leader = (most / traffic.standing.clamp(min=LEAST)).clamp(max=1.0)
        green = arriving + (leader - arriving) * stood
        allowed = most / by_turn.clamp(min=LEAST)
        return torch.where(green > allowed, allowed, green)

    def _entering(
        self, traffic: Traffic, able: Tensor, beginning: Tensor, yields: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the shares rho that find room on the next link.

        They are those of the trips that begin (-, (B, L)) and of the vehicles (-, (B, T)).

        able: vehicles that can go (veh, (B, T)); beginning: trips that can begin (veh, (B, L))
        """
        minor = self._minor * yields.index_select(1, self._movement_of_turn)
        last = able * minor
        wanted = self.sums(able - last, self._link_entered, self.links) + beginning
        wanted_minor = self.sums(last, self._link_entered, self.links)
        room = self._room(traffic)
        rho = (room / wanted.clamp(min=LEAST)).clamp(max=1.0)
        left = room - rho * wanted
        rho_minor = (left / wanted_minor.clamp(min=LEAST)).clamp(max=1.0)
        of_major = rho.index_select(1, self._link_entered)
        of_minor = rho_minor.index_select(1, self._link_entered)
        return rho, of_major + minor * (of_minor - of_major)

    def _room(self, traffic: Traffic) -> Tensor:
        """Return the vehicles R that each link can receive (veh, (B, L))."""
        later = self._backwards.read(traffic.had_left)
        before = self._backwards.older(traffic.had_left)
        reached = later + self._earlier * (before - later)
        free = self.storage - traffic.inside - (traffic.left - reached)
        return free.clamp(min=0.0).minimum(self._most_in)

    def under_way(self, traffic: Traffic) -> Tensor:
        """Return all vehicles by link and destination (veh, (B, L, R))."""
        regions = self.network.regions

        first = self.sums(traffic.first, self.entry_of_cell, self.entries)
        entries = traffic.queue + first + self._along.younger(traffic.entered)
        entries = entries + self._part * self._along.older(traffic.entered)
        entries = entries + self._started.younger(traffic.started)
        place = self.network.entry_link * regions + self.network.destination
        total = self.sums(entries, self.places(place), self.links * regions)
        ends = traffic.stopping + self._to_end.younger(traffic.ending)
        place = np.arange(self.links) * regions + self.network.region
        return total.index_add(1, self.places(place), ends).view(-1, self.links, regions)


def _late(light: np.ndarray, lost: float) -> np.ndarray:
    """Return the light of a movement without the time lost in each green.

    A light that always shows stays as it is.

    light: in each second of its cycle (-, (cycle,)); lost: (s)
    """
    late = light.copy()
    for opens in np.flatnonzero((light > 0.0) & (np.roll(light, 1) == 0.0)):
        left = lost
        for second in range(opens, opens + len(light)):
            place = second % len(light)
            if left <= 0.0 or light[place] == 0.0:
                break
            late[place] -= min(light[place], left)
            left -= light[place]
    return late
