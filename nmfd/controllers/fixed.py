"""No control: perimeter open, nominal split ratios."""

import numpy as np

from nmfd.scenario import Scenario
from nmfd.types import Controls, Measurement


class NoControl:
    """u = u_max everywhere and the nominal (shortest-path) split ratios."""

    name = "no-control"

    def __init__(self, scenario: Scenario):
        network = scenario.network
        self._controls = Controls(
            perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=network.nominal_splits)

    def reset(self) -> None:
        pass

    def act(self, measurement: Measurement) -> Controls:
        return self._controls
