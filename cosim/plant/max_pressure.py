"""Max-pressure control of signals (Varaiya, "Max pressure control of a network of signalized intersections", 2013).

A movement from road l to road m has the weight w(l, m) = x(l, m) - sum_p r(m, p) x(m, p): the vehicles that want to
make it, minus those that stand in the way behind it, by turning shares r. A stage (a green phase of the original
programme) has the pressure sum c(l, m) max(w(l, m), 0) over its movements, c their saturation flows. The stage with
the highest pressure gets the green, after the original yellow and all-red. Perimeter control rations the green of the
gateway movements (cosim.plant.green_quota); one whose ration is spent exerts no pressure.

x counts vehicles per lane, as loops and cameras see them; on lanes that several movements share, and upstream of the
turn lanes, they are shared out by r, from the demand's static routes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping

import numpy as np
from scipy.sparse import csr_array

from cosim.plant.green_quota import NEVER, Ration
from cosim.plant.perimeter import yellow_time
from cosim.sumo.net import City, gateway_movements
from cosim.sumo.session import Phase, Session
from cosim.sumo.signals import GREEN, Link, Signal, is_stage
from nmfd.arrays import PerPair

EVERY = 5.0       # s between two decisions: about two vehicles per lane
PERMISSIVE = 0.3  # saturation flow of a movement that must give way (g), as a share of a protected one


class MaxPressure:
    """Max-pressure at `signals`; call `play` before every simulation step."""

    def __init__(
        self, session: Session, city: City, signals: list[Signal], flows: Mapping[tuple[str, str], float], *,
        min_green: float, show: Callable[[str, str], None],
    ):
        """flows: (edge, next edge) -> any measure of flow, for the turning shares; min_green: [s]; show(signal, state)
        puts a state on a signal."""
        self._session, self._show = session, show
        roads = Roads(city, signals, flows)
        self._lanes, self._weights, self._movements = roads.lanes, roads.weights, roads.movements
        self._gain, self._begins = roads.stages(signals)
        pairs = gateway_movements(city)
        self._junctions = [
            Junction(signal, session.time, pairs.get(signal.id), min_green=min_green) for signal in signals]
        self._rationed = [junction for junction in self._junctions if junction.rationed]
        self._next = session.time
        for junction in self._junctions:
            show(junction.signal, junction.state)

    def command(self, share: PerPair, opened: Mapping[str, Collection[int]]) -> None:
        """share: (R, R) [-], (u - u_min) / (u_max - u_min); opened: signal -> gateway links without a ration."""
        for junction in self._rationed:
            junction.command(share, opened.get(junction.signal, ()))

    def green_time(self) -> dict[str, dict[int, float]]:
        """Signal -> gateway link -> seconds of green shown so far."""
        now = self._session.time
        return {junction.signal: junction.green_time(now) for junction in self._rationed}

    def play(self, now: float) -> None:
        """Show what holds from `now` [s] on."""
        for junction in self._junctions:
            if now >= junction.next_change - 1e-6:
                self._show(junction.signal, junction.advance(now))
        if now < self._next - 1e-6:
            return
        self._next = now + EVERY
        pressure = self._pressure()
        for junction, begin in zip(self._junctions, self._begins, strict=True):
            if junction.may_switch(now):
                best = pressure[begin : begin + junction.stages]
                stage = int(np.argmax(best))
                if best[stage] > best[junction.stage]:
                    self._show(junction.signal, junction.switch(stage, now))

    def _pressure(self) -> np.ndarray:
        count = self._session.lane_vehicles
        present = np.array([count(lane) for lane in self._lanes], dtype=float)
        weight = np.maximum(self._weights @ present, 0.0)
        for junction in self._rationed:
            for movement in junction.exhausted():
                weight[self._movements[movement]] = 0.0
        return self._gain @ weight


class Junction:
    """What one signal shows, second by second: a stage, or the way from one stage to the next."""

    def __init__(
        self, signal: Signal, now: float, gateways: Mapping[int, tuple[int, int]] | None = None, *, min_green: float,
    ):
        """gateways: link index -> (i, h), of the links whose green is rationed; min_green: [s]"""
        self.signal, self._phases, self._numbers = signal.id, signal.phases, signal.stages
        self.stages, self.stage = len(signal.stages), 0
        self._base = signal.phases[signal.stages[0]].state
        self._green_since, self._min_green = now, min_green
        cycle = sum(phase.duration for phase in signal.phases)
        self._rations = {
            link: Ration(pair, cycle=cycle, min_green=min_green, yellow=yellow_time(signal.phases, link), start=now)
            for link, pair in (gateways or {}).items()}
        self._movement = {link.index: (link.from_edge, link.to_edge) for link in signal.links}
        self._coming: list[tuple[float, str]] = []
        self._between: dict[tuple[int, int], list[Phase]] = {}  # stage, next stage -> what is shown between them
        self.state = self._base
        self.next_change = now if self._rations else NEVER  # until then, commands hold from the first second on

    @property
    def rationed(self) -> bool:
        """Whether commands limit the green of a link here."""
        return bool(self._rations)

    def command(self, share: PerPair, opened: Collection[int] = ()) -> None:
        """(R, R) [-], as GatewaySignal.command in cosim.plant.perimeter."""
        for link, ration in self._rations.items():
            ration.command(1.0 if link in opened else float(share[ration.pair]))

    def exhausted(self) -> set[tuple[str, str]]:
        """(edge, next edge) of the gateway movements that get no more green for now."""
        return {self._movement[link] for link, ration in self._rations.items() if ration.exhausted}

    def green_time(self, now: float) -> dict[int, float]:
        """Seconds of green that every gateway link has shown before `now` [s]."""
        return {link: ration.green_time(now) for link, ration in self._rations.items()}

    def may_switch(self, now: float) -> bool:
        """Whether the stage that is shown may be left at `now` [s]."""
        return not self._coming and now >= self._green_since + self._min_green - 1e-6

    def switch(self, stage: int, now: float) -> str:
        """Leave the stage that is shown for another; the state from `now` on."""
        begin, self._coming, change = now, [], (self.stage, stage)
        if change not in self._between:
            self._between[change] = transition(self._phases, *(self._numbers[n] for n in change))
        for phase in self._between[change]:
            self._coming.append((begin, phase.state))
            begin += phase.duration
        self._coming.append((begin, self._phases[self._numbers[stage]].state))
        self.stage, self._green_since = stage, begin
        return self.advance(now)

    def advance(self, now: float) -> str:
        """The state from `now` [s] on; call at every `next_change`."""
        while self._coming and now >= self._coming[0][0] - 1e-6:
            self._base = self._coming.pop(0)[1]
        self.next_change = self._coming[0][0] if self._coming else NEVER
        shown = list(self._base)
        for link, ration in self._rations.items():
            lasting = all(state[link] in GREEN for _, state in self._coming)
            shown[link], again = ration.show(shown[link], now, lasting=lasting)
            self.next_change = min(self.next_change, again)
            if ration.opened(now):  # in the middle of a stage, perhaps: it gets its minimum green, too
                self._green_since = max(self._green_since, now)
        self.state = "".join(shown)
        return self.state


def transition(phases: tuple[Phase, ...], source: int, target: int) -> list[Phase]:
    """What is shown between two stages.

    The original phases where the programme goes from one to the other; else yellow, as long as in the programme, and
    red, as long as after `source` there, for the links that lose their green, or their right of way (G, then g). The
    others stay as they are, and nothing that conflicts with them is green before the target stage.
    """
    between, n = [], (source + 1) % len(phases)
    while not is_stage(phases[n].state):
        between.append(phases[n])
        n = (n + 1) % len(phases)
    if n == target:
        return between
    before, after = phases[source].state, phases[target].state
    losing = {k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a in GREEN and (
        b not in GREEN or (a, b) == ("G", "g"))}
    yellow = max((yellow_time(phases, link) for link in losing), default=0.0)
    red = sum(phase.duration for phase in between if "y" not in phase.state) if losing else 0.0
    return [
        Phase(duration=seconds, state="".join(light if k in losing else a for k, a in enumerate(before)))
        for seconds, light in ((yellow, "y"), (red, "r")) if seconds]


class Roads:
    """Vehicles by lane -> weights of the movements -> pressures of the stages, as two sparse matrices.

    lanes: (L,) names; movements: (edge, next edge) at `signals` -> their number; weights: (M, L) [-], of these; roads
    that end at none of the signals are full too
    """

    def __init__(self, city: City, signals: Iterable[Signal], flows: Mapping[tuple[str, str], float]):
        """flows: (edge, next edge) -> any measure of flow, from which turning shares follow"""
        self._city, self._flows = city, flows
        self._before: dict[str, list[str]] = {edge: [] for edge in city.edges}
        for edge, after in city.successors.items():
            for other in after:
                self._before[other].append(edge)
        self.lanes = [f"{edge}_{n}" for edge in city.edges for n in range(city.lanes[edge])]
        self._index = {lane: n for n, lane in enumerate(self.lanes)}
        self._links: dict[str, list[Link]] = {}
        for signal in signals:
            for link in signal.links:
                self._links.setdefault(link.from_edge, []).append(link)
        movements = sorted({(link.from_edge, link.to_edge) for links in self._links.values() for link in links})
        self.movements = {movement: n for n, movement in enumerate(movements)}
        rows: list[dict[int, float]] = []
        for edge, target in self.movements:
            row = self._queue(edge, target)
            end = self._chain(target)[-1]
            for onward, share in self._shares(end, self._targets(end)).items():
                for lane, part in self._queue(end, onward).items():
                    row[lane] = row.get(lane, 0.0) - share * part
            rows.append(row)
        self.weights = _sparse(rows, len(self.lanes))

    def stages(self, signals: Iterable[Signal]) -> tuple[csr_array, list[int]]:
        """(S, M) saturation flows [lanes] of the movements in the stages, and the number of each signal's first one."""
        rows: list[dict[int, float]] = []
        begins: list[int] = []
        for signal in signals:
            begins.append(len(rows))
            for number in signal.stages:
                state = signal.phases[number].state
                row: dict[int, float] = {}
                for link in {(k.from_edge, k.lane, k.to_edge): k for k in signal.links}.values():
                    if state[link.index] in GREEN:
                        share = self._lane_shares(link.from_edge, link.lane)[link.to_edge]
                        gain = share * (1.0 if state[link.index] == "G" else PERMISSIVE)
                        movement = self.movements[link.from_edge, link.to_edge]
                        row[movement] = row.get(movement, 0.0) + gain
                rows.append(row)
        return _sparse(rows, len(self.movements)), begins

    def _queue(self, edge: str, to: str) -> dict[int, float]:
        """Lane -> share of its vehicles that want to go from `edge` to `to`."""
        queue = {}
        share = self._shares(edge, self._targets(edge))[to]
        for lane in range(self._city.lanes[edge]):
            if own := self._lane_shares(edge, lane).get(to) if edge in self._links else share:
                queue[self._index[f"{edge}_{lane}"]] = own
        before = self._upstream(edge)
        while before is not None:
            queue |= {self._index[f"{before}_{lane}"]: share for lane in range(self._city.lanes[before])}
            before = self._upstream(before)
        return queue

    def _lane_shares(self, edge: str, lane: int) -> dict[str, float]:
        return self._shares(edge, sorted({link.to_edge for link in self._links[edge] if link.lane == lane}))

    def _targets(self, edge: str) -> list[str]:
        """Where vehicles may go at the end of `edge`, signal or not."""
        if edge in self._links:
            return sorted({link.to_edge for link in self._links[edge]})
        return list(self._city.successors[edge])

    def _shares(self, edge: str, targets: list[str]) -> dict[str, float]:
        """Turning shares among `targets`; equal ones where nobody was expected."""
        flows = np.array([self._flows.get((edge, target), 0.0) for target in targets])
        total = flows.sum()
        return dict(zip(targets, flows / total if total else flows + 1.0 / max(len(targets), 1), strict=True))

    def _upstream(self, edge: str) -> str | None:
        """The edge before, where a road only gets turn lanes there."""
        before = self._before[edge]
        if len(before) == 1 and len(self._city.successors[before[0]]) == 1 and before[0] not in self._links:
            return before[0]
        return None

    def _chain(self, edge: str) -> list[str]:
        """The edges of a road from `edge` to the next signal or fork."""
        chain = [edge]
        while chain[-1] not in self._links:
            after = self._city.successors[chain[-1]]
            if len(after) != 1 or self._upstream(after[0]) != chain[-1] or after[0] in chain:
                break
            chain.append(after[0])
        return chain


def _sparse(rows: list[dict[int, float]], columns: int) -> csr_array:
    entries = [(n, column, value) for n, row in enumerate(rows) for column, value in row.items()]
    n, column, value = zip(*entries, strict=True) if entries else ((), (), ())
    return csr_array((value, (n, column)), shape=(len(rows), columns))
