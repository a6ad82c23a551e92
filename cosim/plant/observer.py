"""What looks at a run while it goes on."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City
from nmfd.types import Controls, State


class Observer(Protocol):
    """Is called by the plant in the middle of its run: it may take its time, which holds up the run, and an exception
    of it ends the run. What it is given is not its own: it only reads."""

    def began(self, city: City, state: State) -> None:
        """The run begins now, in this state."""

    def sampled(self, time: float, vehicles: PerEdge, speed: PerEdge) -> None:
        """Every few seconds: SUMO's time [s], and vehicles (E,) [veh] and mean speed (E,) [m/s] by edge."""

    def recorded(self, controls: Controls, state: State, row: Mapping[str, np.ndarray]) -> None:
        """At the end of a control interval under `controls`: the state now, and a row of cosim.plant.record.Record."""
