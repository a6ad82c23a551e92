"""Delays by the region where trips began, on the acyclic plant, whose state knows it: what fairness is counted from."""

from dataclasses import replace

import numpy as np

from nmfd.arrays import PairsOverTime, PerRegion, TurnsOverTime
from nmfd.model.plant import AcyclicPlant
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Trajectory

FREE = 1e-6  # of the demand: so little that nobody is in anybody's way


def delays_by_origin(scenario: Scenario, trajectory: Trajectory) -> tuple[PerRegion, PerRegion]:
    """(R,) [s], the mean delay of the trips that began in every region; (R,) [veh], how many these were.

    scenario: what happened; trajectory: of a run on the acyclic plant, which is deterministic: its controls are played
    again, and the cells are summed by origin. The delay of a trip is the time that it spends more than with every gate
    open, nominal split ratios, and nobody else there; never below 0. Trips that do not end within the horizon count
    with what they have spent.
    """
    network, many = scenario.network, (scenario.steps, 1, 1)
    spent, trips = _time_spent(scenario, trajectory.perimeter, trajectory.splits)
    free, few = _time_spent(
        replace(scenario, demand=FREE * scenario.demand, initial=FREE * scenario.start),
        np.tile(network.u_max * network.adjacency, many),
        np.tile(network.nominal_splits, (*many, 1)),
    )
    each = [
        np.divide(time, begun, out=np.zeros_like(time), where=begun > 0)
        for time, begun in ((spent, trips), (free, few))
    ]
    return np.maximum(each[0] - each[1], 0.0), trips


def _time_spent(scenario: Scenario, perimeter: PairsOverTime, splits: TurnsOverTime) -> tuple[PerRegion, PerRegion]:
    """(R,) [veh s], counted as total time spent is, and (R,) [veh], trips, both by origin."""
    plant = AcyclicPlant(scenario)
    plant.reset(0)
    spent, begun = np.zeros(scenario.network.regions), scenario.step * scenario.demand.sum(axis=(0, 2))
    trips = plant.by_origin() + begun
    for gates, shares in zip(perimeter, splits, strict=True):
        spent += scenario.step * plant.by_origin()
        plant.step(Controls(perimeter=gates, splits=shares))
    return spent, trips
