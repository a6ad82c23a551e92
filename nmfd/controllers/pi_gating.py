"""PI gating: the entries of a protected region are metered so that its accumulation stays at a set point."""

import numpy as np

from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.runs import config
from nmfd.types import Controls, Observation

# The defaults are moderate ones from the flat part of a sweep on the benchmark (kp 0 to 5, ki 0.01 to 0.1 1/s differ by
# less than 2 % in total time spent). The error is a share of the critical accumulation, so that they carry over.
KP = 1.0
KI = 0.01


class PiGating:
    """Incremental PI control of the accumulation n_p of every protected region p, at all its entries h -> p alike:

        u_hp(k) = clip(u_hp(k-1) + kp (n_p(k-1) - n_p(k)) / n_cr + ki dt (n_set - n_p(k)) / n_cr,  u_min, u_max)

    n_cr is the critical accumulation of p's MFD, dt the control interval. The clipped value is carried on, so that
    the integral cannot wind up. All other entries stay at u_max, and there is no route guidance.

    Options, in [controllers.pi-gating]:
        set_point: n_set [veh], one per protected region; default from the MFD, see outflow_share
        outflow_share: the set point is where the MFD first reaches this share of its maximum [-]; default 1, the
            critical accumulation. Less of it leaves a margin where u below u_max does not hold back anybody yet
        kp [-], ki [1/s]: proportional and integral gain, per relative error; default KP and KI
    """

    name = "pi-gating"

    def __init__(self, planning: PlanningModel):
        """InputError without a protected region, or for a wrong option."""
        network = planning.network
        if not planning.protected:
            raise InputError(
                f"{planning.where}: protected: pi-gating needs at least one protected region, got none; "
                f"add protected = [<region>, ...] with regions from 0 to {network.regions - 1}")
        options = config.Table(
            planning.controller_options.get(self.name, {}), planning.where, f"controllers.{self.name}.")
        self._regions = np.array(planning.protected)
        self.critical = np.array([network.mfds[region].critical for region in self._regions])
        share = options.number("outflow_share", 1.0, low=0.1, high=1.0)
        default = tuple(network.mfds[region].reaching(share) for region in self._regions)
        set_point = options.numbers("set_point", default, length=len(self._regions))
        if min(set_point) <= 0:
            raise options.error("set_point", f"expected numbers above 0 [veh], got {list(set_point)} instead")
        self.set_point = np.array(set_point)
        self._kp = options.number("kp", KP, low=0.0)
        self._ki = options.number("ki", KI, above=0.0) * planning.step
        options.close()
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        self._entries = network.adjacency[:, self._regions]
        self._bounds = network.u_min, network.u_max
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._gate = np.full(len(self._regions), self._bounds[1])
        self._before = None

    def act(self, observation: Observation) -> Controls:
        now = observation.accumulation.sum(axis=1)[self._regions]
        before = now if self._before is None else self._before
        change = self._kp * (before - now) + self._ki * (self.set_point - now)
        self._gate = np.clip(self._gate + change / self.critical, *self._bounds)
        self._before = now
        perimeter = self._open.copy()
        perimeter[:, self._regions] = np.where(self._entries, self._gate, 0.0)
        return Controls(perimeter=perimeter, splits=None)
