"""What a run in SUMO leaves behind, beside its trajectory."""

from dataclasses import dataclass

import numpy as np

from nmfd.quantities import quantity


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a closed-loop trajectory does not hold, per control interval k = 0 .. T-1.

    Gateways that share the edge before them share its queue.
    """

    departures: np.ndarray = quantity("interval", "region", "destination", unit="veh", text="trips begun")
    arrivals: np.ndarray = quantity("interval", "destination", unit="veh", text="trips ended")
    crossings: np.ndarray = quantity(
        "interval", "region", "next_region", "destination", unit="veh", text="vehicles that crossed a boundary")
    production: np.ndarray = quantity("interval", "region", unit="veh m/s", text="travel production, mean of samples")
    mean_accumulation: np.ndarray = quantity(
        "interval", "region", unit="veh", text="vehicles inside, mean of the same samples")
    edge_vehicles: np.ndarray = quantity(
        "interval", "edge", unit="veh", text="vehicles on the edge to 0.1 %, mean of the same samples")
    gateway_green: np.ndarray = quantity(
        "interval", "gateway", unit="s", text="green shown, mean of the gateway's links; NaN without a signal")
    gateway_original_green: np.ndarray = quantity(
        "interval", "gateway", unit="s", text="green in the original programme, mean of the gateway's links")
    gateway_flow: np.ndarray = quantity("interval", "gateway", unit="veh", text="vehicles that crossed the boundary")
    gateway_queue: np.ndarray = quantity(
        "interval", "gateway", unit="veh", text="vehicles halting on the edge before it, mean of samples")
    gateway_queue_max: np.ndarray = quantity(
        "interval", "gateway", unit="veh", text="vehicles halting on the edge before it, largest of samples")
    teleports: np.ndarray = quantity("interval", unit="1", text="vehicles that SUMO took out of a jam")
    guided: np.ndarray = quantity(
        "interval", "region", "next_region", "destination", unit="veh", text="reroutes by route guidance")
