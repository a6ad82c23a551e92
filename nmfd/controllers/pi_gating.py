"""PI gating: the entries of a protected region are metered so that its accumulation stays at a set point."""

import numpy as np

from nmfd.controllers.options import Options, options
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.runs.config import PositiveNumbers, Problem, Regions, got, setting
from nmfd.types import Controls, Observation


class SetPoint(Options):
    """Of controllers that hold the accumulation of regions."""

    regions: Regions | None = setting(
        "the regions whose accumulation is held; without it, those that the scenario protects", None
    )
    set_point: PositiveNumbers | None = setting(
        "accumulation to hold, of each of these regions; without it, from the MFD", None, unit="veh"
    )

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """A region that there is not; another number of set points than of regions."""
        most = planning.network.regions - 1
        if self.regions is not None and (not self.regions or max(self.regions) > most):
            return Problem("regions", got(f"a list of regions from 0 to {most}", list(self.regions)))
        count = len(self.held(planning))  # without a region gating cannot be made, and is not made
        if not count or self.set_point is None or len(self.set_point) == count:
            return None
        return Problem("set_point", got(f"a list of {count} numbers", list(self.set_point)))

    def held(self, planning: PlanningModel) -> tuple[int, ...]:
        """The regions whose accumulation is held."""
        return planning.protected if self.regions is None else self.regions


class Gating(SetPoint):
    """Of PI gating. The default gains are moderate ones from the flat part of a sweep on the benchmark, where kp from 0
    to 5 and ki from 0.01 to 0.1 differ by less than 2 % in total time spent; relative to the critical accumulation,
    they carry over to other cities."""

    outflow_share: float = setting(
        "the set point is where the MFD first reaches this share of its maximum; 1 is the critical accumulation, and "
        "less leaves a margin where control below its largest does not hold back anybody yet",
        1.0,
        unit="-",
        ge=0.1,
        le=1.0,
    )
    kp: float = setting("proportional gain, per relative error", 1.0, unit="-", ge=0.0)
    ki: float = setting("integral gain, per relative error", 0.01, unit="1/s", gt=0.0)


class PiGating:
    """Incremental PI control of the accumulation n_p of every region p that is held, at all its entries h -> p alike:

        u_hp(k) = clip(u_hp(k-1) + kp (n_p(k-1) - n_p(k)) / n_cr + ki dt (n_set - n_p(k)) / n_cr,  u_min, u_max)

    n_cr is the critical accumulation of p's MFD, dt the control interval. The clipped value is carried on, so that
    the integral cannot wind up. All other entries stay at u_max, and there is no route guidance.

    n_set is the option set_point, or else of outflow_share. Held are the regions that the scenario protects, or those
    of the option regions; the options are in [controllers.pi-gating].
    """

    name = "pi-gating"

    def __init__(self, planning: PlanningModel):
        """InputError without a region to hold, or for a wrong option."""
        network, chosen = planning.network, options(Gating, planning, self.name)
        held = chosen.held(planning)
        if not held:
            raise InputError(
                f"{planning.where}: protected: pi-gating needs at least one protected region, got none; "
                f"add protected = [<region>, ...] with regions from 0 to {network.regions - 1}"
            )
        self.regions = np.array(held)
        self.critical = np.array([network.mfds[region].critical for region in self.regions])
        self.set_point = np.array(
            chosen.set_point or [network.mfds[region].reaching(chosen.outflow_share) for region in self.regions]
        )
        self._kp, self._ki = chosen.kp, chosen.ki * planning.step
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
