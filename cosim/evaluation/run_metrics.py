"""One row of sumo.csv: what a run in SUMO came to, beside the figures that every plant has (nmfd.metrics)."""

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Bool

from cosim.plant.record import Record
from cosim.sumo.arrays import EdgesOverTime, RegionCounts
from cosim.sumo.net import City, Gateway, gateway_room_taken
from cosim.sumo.tripinfo import TripFacts
from nmfd.arrays import PerRegion
from nmfd.metrics import gini
from nmfd.types import Result

FULL = 0.8  # share of an edge's room: a queue that reaches its upstream end leaves gaps that move backwards


def trip_facts(facts: TripFacts) -> dict:
    """Means over all trips that were due, finished or not [s], and emissions of the whole run [kg]."""
    trips = max(facts.trips, 1)
    return {
        "mean_trip_time_s": facts.travel_time / trips,
        "mean_departure_delay_s": facts.departure_delay / trips,
        "mean_time_loss_s": facts.time_loss / trips,
        "co2_kg": facts.co2,
        "fuel_kg": facts.fuel,
    }


def delay_gini(trajectory: Result, record: Record, time_loss: PerRegion) -> float:
    """Fairness over origins: the Gini coefficient (nmfd.metrics.gini) of the mean delays of regions of origin, each
    weighted by its trips.

    The delay of a trip is what it lost on the road against driving freely (SUMO's timeLoss) and what it waited to
    enter; trips that had not ended count with what they had lost by then. time_loss: (R,) [s], of all trips that began
    in a region; the waiting is the backlog by origin, summed over control intervals as in total time spent.
    """
    begun = record.departures.sum(axis=(0, 2)) + trajectory.backlog[-1].sum(axis=1)
    trips = begun + record.given_up.sum(axis=(0, 2))
    waiting = trajectory.step * trajectory.backlog[:-1].sum(axis=(0, 2))
    return gini((time_loss + waiting) / np.maximum(trips, 1.0), trips.astype(float))


def queue_facts(record: Record, city: City) -> dict:
    """Queues on the edges before gateways, every edge once.

    gateway_queue_mean_veh: over edges and time; gateway_queue_max_veh: the longest at any time; gateway_full_share:
    of edges and intervals, those in which the edge was full (FULL)
    """
    upstream = upstream_gateways(city)
    queue, longest = record.gateway_queue[:, upstream], record.gateway_queue_max[:, upstream]
    full = gateway_full(record.edge_vehicles, city)[:, upstream]
    return {
        "gateway_queue_mean_veh": float(queue.mean()),
        "gateway_queue_max_veh": float(longest.max()),
        "gateway_full_share": float(full.mean()),
    }


def upstream_gateways(city: City) -> list[int]:
    """Indices of gateways, one for every edge before a boundary."""
    first: dict[str, int] = {}
    for n, gateway in enumerate(city.gateways):
        first.setdefault(gateway.from_edge, n)
    return list(first.values())


def gateway_full(edge_vehicles: EdgesOverTime, city: City) -> Bool[np.ndarray, "T G"]:
    """(T, G) bool: the edge before the gateway holds at least FULL of its room, by edge_vehicles (T, E) [veh]."""
    return gateway_room_taken(edge_vehicles.astype(float), city) >= FULL


def leaking_share(record: Record, city: City, leaks: Collection[Gateway]) -> float:
    """Share of the flow over the boundaries that passes gateways without a signal under control."""
    flow = record.gateway_flow.sum(axis=0)
    leaking = sum(passed for gateway, passed in zip(city.gateways, flow, strict=True) if gateway in leaks)
    return float(leaking / max(flow.sum(), 1))


def regional_outflow(record: Mapping[str, np.ndarray] | Result, step: float) -> RegionCounts:
    """(T, R) [veh/s]: trips that ended in every region, and vehicles that went on to another one, by a record's arrays;
    step: control interval [s]"""
    return (record["arrivals"] + record["crossings"].sum(axis=(2, 3))) / step
