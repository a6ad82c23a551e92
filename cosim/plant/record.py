"""What a run in SUMO leaves behind, beside its trajectory."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a closed-loop trajectory does not hold, per control interval k = 0 .. T-1.

    departures: (T, R, R) [veh]; arrivals: (T, R) [veh], by the region of the destination
    crossings: (T, R, R, R) [veh], [i, h, j] = from i to h, bound for j
    production: (T, R) [veh m/s], mean of samples; mean_accumulation: (T, R) [veh], of the same samples
    edge_vehicles: (T, E) [veh], mean of the same samples, by the city's edges
    gateway_green: (T, G) [s], green shown per gateway, its links' mean; NaN without a signal
    gateway_original_green: (T, G) [s], the same in the original programme
    gateway_flow: (T, G) [veh] over the boundary there
    gateway_queue, gateway_queue_max: (T, G) [veh] halting on the edge before it, mean and largest of samples; gateways
        that share this edge share its queue
    teleports: (T,); guided: (T, R, R, R) [veh], reroutes by route guidance
    """

    departures: np.ndarray
    arrivals: np.ndarray
    crossings: np.ndarray
    production: np.ndarray
    mean_accumulation: np.ndarray
    edge_vehicles: np.ndarray
    gateway_green: np.ndarray
    gateway_original_green: np.ndarray
    gateway_flow: np.ndarray
    gateway_queue: np.ndarray
    gateway_queue_max: np.ndarray
    teleports: np.ndarray
    guided: np.ndarray
