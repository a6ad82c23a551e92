"""Nothing decided: no control, and route guidance towards what drivers do anyway."""

import numpy as np

from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Measurement


class NoControl:
    """u = u_max everywhere, no route guidance."""

    name = "no-control"

    def __init__(self, scenario: Scenario):
        network = scenario.network
        self._controls = Controls(perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=None)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, measurement: Measurement) -> Controls:
        return self._controls


class RouteGuidance(NoControl):
    """u = u_max everywhere; theta is the drivers' own: guidance by travel times inside the regions, and no more."""

    name = "route-guidance"

    def __init__(self, scenario: Scenario):
        super().__init__(scenario)
        self._controls = Controls(perimeter=self._controls.perimeter, splits=scenario.network.nominal_splits)
