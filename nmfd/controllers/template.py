"""A controller of your own.

Try it on the regional model and in SUMO, beside the others:

    nmfd benchmark economic_mpc --controllers no-control,pi-gating,FILE:MyController
    cosim run grid7_peak --controller FILE:MyController --against no-control
    cosim evaluate grid7_peak --controllers no-control,FILE:MyController+max-pressure --seeds 10

R regions are numbered from 0. This one is proportional gating: the further a protected region is
beyond its set point, the less is let into it. Replace what `act` does.
"""

import numpy as np

from nmfd import Controls, Observation, PlanningModel


class MyController:
    """Proportional gating of the protected regions.

    If the scenario protects none, every region is gated.
    """

    # The name of its table of options in scenario.toml, if it has one:
    # [controllers.own.my-controller].
    name = "my-controller"
    # Files beside this one that the results depend on, such as weights: when they change, runs are
    # done again.
    files = ()

    def __init__(self, planning: PlanningModel):
        """Called once. See help(nmfd.PlanningModel).

        It has .step (s), .forecast (veh/s, (T, R, R)), .network, ...
        """
        self.network = planning.network
        options = planning.controller_options.get(self.name, {})
        self.gain = options.get("gain", 5.0)  # [-]
        regions = np.arange(self.network.regions)
        self.gated = np.isin(regions, planning.protected or regions)
        critical = [mfd.critical for mfd in self.network.mfds]  # [veh]
        self.set_point = options.get("share", 0.9) * np.array(critical)

    def reset(self, seed: int = 0) -> None:
        """Called before every run: forget the last one.

        Random numbers must follow from `seed`.
        """

    def act(self, observation: Observation) -> Controls:
        """Called at every control interval.

        observation.accumulation: (R, R) [veh], [i, j] = in region i bound for j, as measured: with
            noise
        observation.backlog: (R, R) [veh], waiting outside to enter region i; observation.step,
            .time [s]

        perimeter: (R, R) [-], [i, h] = share of the flow from i to h that may pass, between u_min
            and u_max
        splits: (R, R, R) [-], [i, h, j] = share of the vehicles in i bound for j that go on to h,
            with sum 1 over h where network.split_mask allows any; None for no route guidance
        """
        inside = observation.accumulation.sum(axis=1)
        excess = np.maximum(inside - self.set_point, 0.0) / self.set_point
        opening = self.network.u_max - self.gain * excess
        opening = np.clip(opening, self.network.u_min, self.network.u_max)
        opening = np.where(self.gated, opening, self.network.u_max)
        perimeter = np.where(self.network.adjacency, opening, 0.0)  # [i, h]: the opening of h
        return Controls(perimeter=perimeter, splits=None)
