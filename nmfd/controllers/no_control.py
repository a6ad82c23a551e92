"""Nothing decided: no control, and route guidance towards what drivers do anyway."""

import numpy as np

from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation


class NoControl:
    """u = u_max everywhere, no route guidance."""

    name = "no-control"

    def __init__(self, planning: PlanningModel):
        network = planning.network
        self._controls = Controls(perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=None)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        return self._controls


class RouteGuidance(NoControl):
    """u = u_max everywhere; theta is the drivers' own: guidance by travel times inside the regions, and no more."""

    name = "route-guidance"

    def __init__(self, planning: PlanningModel):
        super().__init__(planning)
        self._controls = Controls(perimeter=self._controls.perimeter, splits=planning.network.nominal_splits)
