"""Rule-based controllers: no control, route guidance by travel times, PI gating and greedy control."""

import numpy as np

from nmfd.errors import InputError
from nmfd.model.planning import Options, PlanningModel, options
from nmfd.runs.config import PositiveNumbers, Problem, got, setting
from nmfd.types import Controls, Observation


class NoControl:
    """Open perimeter, u = u_max everywhere, without route guidance."""

    name = "no-control"

    def __init__(self, planning: PlanningModel):
        network = planning.network
        self._controls = Controls(perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=None)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        return self._controls


class RouteGuidance(NoControl):
    """Open perimeter with nominal split ratios: guidance by travel times within regions."""

    name = "route-guidance"

    def __init__(self, planning: PlanningModel):
        super().__init__(planning)
        self._controls = Controls(perimeter=self._controls.perimeter, splits=planning.network.nominal_splits)


class SetPoint(Options):
    """Options of controllers that hold the accumulation of protected regions; cosim identify sets it for probing."""

    set_point: PositiveNumbers | None = setting(
        "accumulation to hold in each protected region; derived from the MFD by default", None, unit="veh"
    )

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return a wrong number of set points as a problem."""
        count = len(planning.protected)
        if not count or self.set_point is None or len(self.set_point) == count:
            return None
        return Problem("set_point", got(f"a list of {count} numbers", list(self.set_point)))


class Gating(SetPoint):
    """Options of PI gating.

    The default gains are moderate ones: on the benchmark kp from 0 to 5 and ki from 0.01 to 0.1 differ by less than 2 %
    in total time spent. They are relative to the critical accumulation, so that they carry over to other cities.
    """

    outflow_share: float = setting(
        "share of the MFD's maximum that defines the set point: the smallest accumulation with this outflow; 1 is the "
        "critical accumulation, less leaves a margin",
        1.0,
        unit="-",
        ge=0.1,
        le=1.0,
    )
    kp: float = setting("proportional gain, per relative error", 1.0, unit="-", ge=0.0)
    ki: float = setting("integral gain, per relative error", 0.01, unit="1/s", gt=0.0)


class PiGating:
    """Incremental PI control of the accumulation n_p of every protected region p.

    All entries h -> p have the same opening:

        u_hp(k) = clip(u_hp(k-1) + kp (n_p(k-1) - n_p(k)) / n_cr + ki dt (n_set - n_p(k)) / n_cr,  u_min, u_max)

    n_cr is the critical accumulation of p, dt the control interval, n_set the option set_point or the accumulation of
    outflow_share. The clipped value is carried on, which prevents windup. All other entries stay at u_max.
    """

    name = "pi-gating"

    def __init__(self, planning: PlanningModel):
        """Raise InputError without a protected region or for a wrong option."""
        network, setup = planning.network, options(Gating, planning, self.name)
        if not planning.protected:
            raise InputError(
                f"{planning.where}: protected: pi-gating needs at least one protected region, got none; "
                f"add protected = [<region>, ...] with regions from 0 to {network.regions - 1}"
            )
        self.regions = np.array(planning.protected)
        self.critical = np.array([network.mfds[region].critical for region in self.regions])
        self.set_point = np.array(
            setup.set_point or [network.mfds[region].reaching(setup.outflow_share) for region in self.regions]
        )
        self._kp, self._ki = setup.kp, setup.ki * planning.step
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        self._entries = network.adjacency[:, self.regions]
        self._bounds = network.u_min, network.u_max
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._gate = np.full(len(self.regions), self._bounds[1])
        self._before = None

    def act(self, observation: Observation) -> Controls:
        now = observation.accumulation.sum(axis=1)[self.regions]
        before = now if self._before is None else self._before
        change = self._kp * (before - now) + self._ki * (self.set_point - now)
        self._gate = np.clip(self._gate + change / self.critical, *self._bounds)
        self._before = now
        perimeter = self._open.copy()
        perimeter[:, self.regions] = np.where(self._entries, self._gate, 0.0)
        return Controls(perimeter=perimeter, splits=None)


class Greedy:
    """Greedy controller of Geroliminis, Haddad and Ramezani (2013, table I), at every boundary separately.

    u_ih = u_min if h is congested, n_h > n_cr,h, and i is not, or less so, n_i / jam_i < n_h / jam_h; else u_max.
    """

    name = "greedy"

    def __init__(self, planning: PlanningModel):
        network = planning.network
        self._critical = network.critical
        self._jam = np.array([mfd.jam for mfd in network.mfds])
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        self._closed = np.where(network.adjacency, network.u_min, 0.0)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        vehicles = observation.accumulation.sum(axis=1)
        congested, fullness = vehicles > self._critical, vehicles / self._jam
        hold = congested & (~congested[:, None] | (fullness[:, None] < fullness))  # [i, h]
        return Controls(perimeter=np.where(hold, self._closed, self._open), splits=None)
