"""Rule-based controllers: open gates, PI gating, greedy, excitation."""

from typing import ClassVar

import numpy as np

from nmfd.arrays import PerPair, PerRegion
from nmfd.controllers.base import Options, check_fit
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.runs.config import PositiveNumbers, Problem, checked, got, setting
from nmfd.types import Controller, Controls, Observation

# PI gating: shares of an error that one control interval corrects, as gates fill the region.
PROPORTIONAL_SHARE = 1.0
INTEGRAL_SHARE = 0.3
LEAST_FILL = 0.05  # of the critical accumulation: larger gains would answer noise

# Excitation.
HOLD_INTERVALS = (3, 9)  # control intervals between two draws, from and to
SET_POINT_RANGE = (0.5, 1.3)  # factor of the set points
DISTURBED_SHARE = 0.35  # of the gateways whose u is drawn at random
MAX_DIVERTED_SHARE = 0.6  # of the vehicles with a random next region; more locks a city


class NoControl(Options):
    """Open perimeter, u = u_max, without route guidance: the reference."""

    plans: ClassVar[bool] = False

    def make(self, planning: PlanningModel) -> Controller:
        return Constant("no-control", Controls(perimeter=planning.network.open_perimeter))


class RouteGuidance(Options):
    """Open perimeter with nominal split ratios.

    In a city, drivers are guided by travel times within regions.
    """

    plans: ClassVar[bool] = False
    guidance: ClassVar[bool] = True

    def make(self, planning: PlanningModel) -> Controller:
        network = planning.network
        controls = Controls(perimeter=network.open_perimeter, splits=network.nominal_splits)
        return Constant("route-guidance", controls)


class Constant:
    """Controller that always gives the same controls."""

    def __init__(self, name: str, controls: Controls):
        self.name = name
        self._controls = controls

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        return self._controls


class SetPoint(Options):
    """Options of controllers that hold the accumulation of protected regions."""

    set_point: PositiveNumbers | None = setting(
        "accumulation to hold in each protected region; by default from the MFD", None, unit="veh"
    )

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return a wrong number of set points as a problem."""
        count = len(planning.protected)
        if count and self.set_point is not None and len(self.set_point) != count:
            return Problem("set_point", got(f"a list of {count} numbers", list(self.set_point)))
        return None


class PiGating(SetPoint):
    """PI control of protected regions by the gates into them.

    The equation is that of nmfd.controllers.rules.PiGate. An accumulation answers a gate by the
    vehicles that enter in one control interval, `filled` critical accumulations b. Larger gains
    than about 2 / b swing from interval to interval. The default gains follow from the city:

        kp = 1 / b,  ki = 0.3 / (b dt)

        >>> nmfd.run("economic_mpc", nmfd.PiGating(kp=2.0), steps=1).controller
        'pi-gating(kp=2.0)'
    """

    outflow_share: float = setting(
        "outflow at the set point, as a share of the MFD's maximum: less leaves a margin",
        1.0,
        unit="-",
        ge=0.1,
        le=1.0,
    )
    kp: float | None = setting(
        "proportional gain, per relative error; by default from the city", None, unit="-", ge=0.0
    )
    ki: float | None = setting(
        "integral gain, per relative error; by default from the city", None, unit="1/s", gt=0.0
    )
    max_change: float = setting(
        "largest change of a gate from one interval to the next", 1.0, unit="-", gt=0.0, le=1.0
    )

    def make(self, planning: PlanningModel) -> "PiGate":
        """Return the controller. Raise InputError without a protected region."""
        if not planning.protected:
            raise InputError(
                f"{planning.where}: protected: pi-gating needs at least one protected region, got "
                "none; add protected = [<region>, ...] with regions from 0 to "
                f"{planning.network.regions - 1}"
            )
        return PiGate(planning, self)


def scenario_gate(planning: PlanningModel) -> "PiGate":
    """Return PI gating with the scenario's options. Raise InputError."""
    prefix = "controllers.pi-gating."
    table = planning.controller_options.get("pi-gating", {})
    options = checked(PiGating, table, planning.where, prefix)
    check_fit(options, planning, f"{planning.where}: {prefix}")
    return options.make(planning)


def filled(planning: PlanningModel, region: int) -> float:
    """Return the vehicles that open gates let into a region in an interval.

    They are the largest flow into the region times the control interval (veh). The neighbours send
    what the maximum of their MFDs discharges towards the region, by the forecast on nominal routes.
    All boundaries together pass at most their capacities at u = 1. Of both, the share counts that
    passes signals under control.
    """
    network = planning.network
    passing = _passing(planning)
    # Share of time in a region, by destination.
    in_total = (passing / network.relative_rates).sum(axis=1)
    bound = (network.nominal_splits[:, region] * passing).sum(axis=1)
    largest = np.array([mfd.capacity for mfd in network.mfds])
    sent = largest * bound / np.where(in_total > 0.0, in_total, 1.0)
    obeying = network.adjacency[:, region].astype(float)
    if network.controllable is not None:
        obeying = network.controllable[:, region]
    flow = float(obeying @ sent)
    if network.open_capacity is not None:
        flow = min(flow, float(obeying @ network.open_capacity[:, region]))
    return flow * planning.step


def _passing(planning: PlanningModel) -> PerPair:
    """Return the trips of the forecast that pass region i, bound for j.

    They take nominal routes (veh/s, (R, R)).
    """
    network = planning.network
    entering = planning.forecast.sum(axis=0)
    passing = np.zeros_like(entering)
    for _ in range(network.regions):  # no route passes more of them
        passing += entering
        entering = np.einsum("ihj,ij->hj", network.nominal_splits, entering)
        if not entering.any():
            break
    return passing


class PiGate:
    """Incremental PI control of the accumulation of protected regions.

    n_p is the accumulation of the protected region p. All entries h -> p have the same opening:

        u_hp(k) = clip(u_hp(k-1) + c(k),  u_min, u_max)
        c(k) = clip(kp (n_p(k-1) - n_p(k)) / n_cr + ki dt (n_set - n_p(k)) / n_cr,
                    -max_change, max_change)

    n_cr is the critical accumulation of p, dt the control interval, n_set the option set_point or
    the accumulation of outflow_share. u_hp(k-1) is the clipped value or, if the city reports it,
    the mean u that its gates realised, so that the integral does not wind up. All other entries
    stay at u_max.

    critical: n_cr (veh, (P,)); that of the MFDs if None
    """

    name = "pi-gating"

    def __init__(
        self, planning: PlanningModel, options: PiGating, critical: PerRegion | None = None
    ):
        network = planning.network
        mfds = [network.mfds[region] for region in planning.protected]
        self.regions = np.array(planning.protected)
        if critical is None:
            critical = np.array([mfd.critical for mfd in mfds])
        self.critical = critical
        set_point = options.set_point
        if set_point is None:
            set_point = tuple(mfd.reaching(options.outflow_share) for mfd in mfds)
        self.set_point = np.array(set_point)
        vehicles = np.array([filled(planning, region) for region in planning.protected])
        fill = np.maximum(vehicles / critical, LEAST_FILL)
        # Gains of every protected region, the integral one times the control interval ((P,), -).
        self._kp = PROPORTIONAL_SHARE / fill
        if options.kp is not None:
            self._kp = np.full(len(fill), options.kp)
        self._ki = INTEGRAL_SHARE / fill
        if options.ki is not None:
            self._ki = np.full(len(fill), options.ki * planning.step)
        self._max_change = options.max_change
        self._open = network.open_perimeter
        self._entries = network.adjacency[:, self.regions]
        self._bounds = network.u_min, network.u_max
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._gate = np.full(len(self.regions), self._bounds[1])
        self._before: np.ndarray | None = None

    def act(self, observation: Observation) -> Controls:
        now = observation.accumulation.sum(axis=1)[self.regions]
        before = now if self._before is None else self._before
        if observation.realised is not None:
            realised = observation.realised[:, self.regions]
            self._gate = np.average(realised, axis=0, weights=self._entries)
        wish = self._kp * (before - now) + self._ki * (self.set_point - now)
        change = np.clip(wish / self.critical, -self._max_change, self._max_change)
        self._gate = np.clip(self._gate + change, *self._bounds)
        self._before = now
        perimeter = self._open.copy()
        perimeter[:, self.regions] = np.where(self._entries, self._gate, 0.0)
        return Controls(perimeter=perimeter)


class Greedy(Options):
    """Bang-bang control by the more congested of two regions (GreedyGate)."""

    def make(self, planning: PlanningModel) -> Controller:
        return GreedyGate(planning)


class GreedyGate:
    """Greedy controller of Geroliminis, Haddad and Ramezani (2013, table I).

    u_ih = u_min if h is congested and i is not, or less so; else u_max. A region is congested if
    n > n_cr, and less so if its n / jam is smaller.
    """

    name = "greedy"

    def __init__(self, planning: PlanningModel):
        network = planning.network
        self._critical = network.critical
        self._jam = np.array([mfd.jam for mfd in network.mfds])
        self._open = network.open_perimeter
        self._closed = np.where(network.adjacency, network.u_min, 0.0)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        vehicles = observation.accumulation.sum(axis=1)
        congested = vehicles > self._critical
        fullness = vehicles / self._jam
        hold = congested & (~congested[:, None] | (fullness[:, None] < fullness))  # [i, h]
        return Controls(perimeter=np.where(hold, self._closed, self._open))


class Probing(SetPoint):
    """Random excitation for `cosim identify` (Excitation)."""

    plans: ClassVar[bool] = False

    guidance: bool = setting("split ratios are drawn as well", False)

    def make(self, planning: PlanningModel) -> Controller:
        return Excitation(planning, self)


class Excitation:
    """Gating at random set points, with some gateways at a random u.

    Random controls alone would lock the city early; gating alone moves all gateways of a region
    together. With guidance, theta lies between the nominal split ratios and a random point of the
    simplex. The seed of the run draws all of it again every few control intervals. The set points
    vary around the option set_point, or else the critical accumulation.
    """

    def __init__(self, planning: PlanningModel, options: Probing):
        self.name = "probing-pcrg" if options.guidance else "probing-pc"
        network = planning.network
        self._network = network
        self._guidance = options.guidance
        middle = options.set_point
        if middle is None:
            middle = tuple(network.mfds[region].critical for region in planning.protected)
        self._gating: PiGate | None = None
        if middle:
            self._gating = PiGate(planning, PiGating(set_point=middle), np.array(middle))
        self._open = network.open_perimeter
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._random = np.random.default_rng([seed, 0x70726F62])
        self._left = 0
        if self._gating is not None:
            self._gating.reset()

    def act(self, observation: Observation) -> Controls:
        if self._left == 0:
            self._draw()
        self._left -= 1
        perimeter = self._open
        if self._gating is not None:
            perimeter = self._gating.act(observation).perimeter
        perimeter = np.where(self._disturbed, self._random_u, perimeter)
        return Controls(perimeter=perimeter, splits=self._splits)

    def _draw(self) -> None:
        random = self._random
        network = self._network
        self._left = int(random.integers(*HOLD_INTERVALS))
        if self._gating is not None:
            self._gating.set_point = random.uniform(*SET_POINT_RANGE) * self._gating.critical
        shape = network.adjacency.shape
        self._random_u = random.uniform(network.u_min, network.u_max, shape)
        self._disturbed = network.adjacency & (random.random(shape) < DISTURBED_SHARE)
        self._splits = None
        if self._guidance:
            point = random.exponential(size=network.split_mask.shape) ** 2 * network.split_mask
            point /= np.maximum(point.sum(axis=1, keepdims=True), 1e-12)
            share = MAX_DIVERTED_SHARE * random.random((network.regions, 1, network.regions)) ** 2
            self._splits = (1.0 - share) * network.nominal_splits + share * point
