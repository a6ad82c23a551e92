"""What a run is judged by, and what RESCO and LibSignal call the same.

RESCO: github.com/Pi-Star-Lab/RESCO, resco_benchmark/utils/readXML.py and multi_signal.py; LibSignal:
github.com/DaRL-LibSignal/LibSignal, common/metrics.py. Where their definition differs, that is said.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from nmfd.metrics import COUNTED
from nmfd.model.scenario import Scenario
from nmfd.types import Trajectory

TTS = "total_time_spent_veh_s"
Metrics = dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """heading: of its column; text: what it is; resco, libsignal: their names for it, "" for none."""

    heading: str
    text: str
    resco: str = ""
    libsignal: str = ""


METRICS = {
    TTS: Metric(
        heading="TTS [veh s]",
        text="total time spent: running, waiting to enter, and as long as it could be of those "
        "removed; nmfd.metrics.total_time_spent",
    ),
    "mean_trip_time_s": Metric(
        heading="trip [s]",
        text="mean time on the road of all trips that were due, unfinished ones with what they had "
        "spent; of a regional model total time spent over trips",
        resco="duration (without trips that never departed)",
        libsignal="travel time (real_average_travel_time; of vehicles that entered)",
    ),
    "mean_delay_s": Metric(
        heading="delay [s]",
        text="mean of the time lost on the road against driving freely and of the wait to enter, "
        "of all trips that were due; of the acyclic model against open gates and no other traffic "
        "(nmfd.studies.delays), of the other one unknown",
        resco="timeLoss (theirs, too, with departDelay and trips that never departed)",
        libsignal="real delay (without the wait); their delay is 1 - speed / limit, another thing",
    ),
    "mean_departure_delay_s": Metric(
        heading="wait [s]",
        text="mean time between the wanted and the real departure, of the same trips",
        resco="departDelay (part of their timeLoss)",
    ),
    "completed_veh": Metric(
        heading="throughput [veh]", text="trips that reached their end within the horizon", libsignal="throughput"
    ),
    "trips_veh": Metric(heading="trips [veh]", text="that were due within the horizon, or under way when it began"),
    "queue_veh": Metric(
        heading="queue [veh]",
        text="halting on the edges before gateways, mean over edges and time; SUMO",
        resco="queue_lengths (theirs of all lanes of a signal)",
        libsignal="queue (theirs of all lanes, mean over intersections)",
    ),
    "backlog_veh": Metric(heading="backlog [veh]", text="waiting to enter, mean over time"),
    "co2_kg": Metric(heading="CO2 [kg]", text="of all vehicles, by SUMO's HBEFA4 petrol car; SUMO"),
    "locked": Metric(
        heading="locks",
        text="share of the runs in which not every trip was completed within the horizon, by which "
        "cosim frontier tells served from not; SUMO",
    ),
    "delay_gini": Metric(
        heading="Gini",
        text="fairness: Gini coefficient of the mean delays of the regions where trips began, weighted "
        "by trips (cosim.evaluation.run_metrics.delay_gini, nmfd.metrics.gini); SUMO and the acyclic model",
    ),
    "removed_veh": Metric(heading="removed [veh]", text="taken out before the end of their trips"),
    "teleports": Metric(heading="teleports", text="vehicles that SUMO lifted out of a jam"),
    **{name: Metric(heading=heading, text=text) for name, (heading, text) in COUNTED.items()},
    "decision_ms_median": Metric(heading="decision [ms]", text="wall time of a decision, median"),
    "decision_ms_max": Metric(heading="longest [ms]", text="wall time of the longest decision"),
}


def of_city(row: Mapping, horizon: float) -> Metrics:
    """Of a run in SUMO, by its row of summary.csv and sumo.csv; horizon: [s]."""
    return {
        **_of_every_plant(row),
        "mean_trip_time_s": _known(row["mean_trip_time_s"]),
        "mean_delay_s": _known(row["mean_time_loss_s"] + row["mean_departure_delay_s"]),
        "mean_departure_delay_s": _known(row["mean_departure_delay_s"]),
        "trips_veh": float(row["trips"]),
        "queue_veh": _known(row["gateway_queue_mean_veh"]),
        "backlog_veh": _known(row["total_backlog_veh_s"] / horizon),
        "co2_kg": _known(row["co2_kg"]),
        "locked": float(row["completed_veh"] < row["trips"]),
        "delay_gini": _known(row["delay_gini"]),
        "removed_veh": float(row["removed_veh"]),
        "teleports": float(row["teleports"]),
    }


def of_region(row: Mapping, scenario: Scenario, trajectory: Trajectory, acyclic: bool) -> Metrics:
    """Of a run on a regional model, by its row of summary.csv. scenario: what happened."""
    trips = float(scenario.step * scenario.demand.sum() + trajectory.accumulation[0].sum())
    found = {
        **_of_every_plant(row),
        "mean_trip_time_s": row[TTS] / trips if trips else None,
        "mean_departure_delay_s": 0.0,
        "trips_veh": trips,
        "backlog_veh": 0.0,
        "removed_veh": 0.0,
    }
    return {name: found.get(name) for name in METRICS}


def _of_every_plant(row: Mapping) -> Metrics:
    return {
        TTS: float(row[TTS]),
        "completed_veh": float(row["completed_veh"]),
        **{name: float(row[name]) for name in COUNTED},
        "decision_ms_median": float(row["control_step_ms_median"]),
        "decision_ms_max": float(row["control_step_ms_max"]),
    }


def _known(value: float) -> float | None:
    """JSON has no NaN."""
    return None if math.isnan(value) else float(value)
