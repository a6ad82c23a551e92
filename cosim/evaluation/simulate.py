"""One closed-loop run in SUMO, and the facts in its result."""

import json
import math
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from cosim.evaluation.signal_proof import SHEET, VIOLATIONS, proof_sheet
from cosim.plant.max_pressure import FACTS as PRESSURE_FACTS
from cosim.plant.meter import COMPLETED, GIVEN_UP, REMOVED, UNDER_WAY, WAITING, Trip
from cosim.plant.plant import Observer, SumoPlant
from cosim.plant.record import RECORD, TOTALS, settled
from cosim.plant.settings import Settings, own_files
from cosim.plant.strategy import Strategy
from cosim.sumo.net import City, Gateway, gateway_room_taken
from nmfd import closed_loop, metrics
from nmfd.arrays import PerRegion
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs import config
from nmfd.runs.files import atomic
from nmfd.runs.progress import Show
from nmfd.types import Result

# Share of an edge's room: a queue that reaches its upstream end leaves gaps that move backwards.
FULL_SHARE = 0.8
# Columns of a table of trips; no outcome has more than nine characters.
TRIPS = [(name, "U9" if kind is str else kind) for name, kind in Trip.__annotations__.items()]
# Attribute of a result, column of runs.csv -> meaning.
FACTS = config.read(Path(__file__).with_name("columns.toml"))["runs"] | PRESSURE_FACTS


@dataclass(frozen=True)
class Simulation:
    """One closed loop in SUMO, a picklable job.

    seed: of trips, drivers and guidance
    demand: multiple of the scenario's demand
    policy: policy file instead of the scenario's
    trip_file: for SUMO's own tripinfo output
    """

    scenario: Scenario
    strategy: Strategy
    seed: int
    demand: float = 1.0
    policy: Path | None = None
    trip_file: Path | None = None

    def __call__(self) -> Result:
        return simulate(self)


def simulate(
    job: Simulation,
    *,
    progress: Show = None,
    observer: Observer | None = None,
    gui: bool = False,
) -> Result:
    """Do a simulation in this process, which may hold no other SUMO session.

    progress: called as progress(done, steps) after every control interval
    observer: gets the state of the run while it goes on
    gui: show it in sumo-gui, and leave out the facts, for which the window would have to close
    Raises: InputError if the strategy cannot run in this city
    """
    begin = time.perf_counter()
    strategy = job.strategy
    scenario = with_demand(job.scenario, factor=job.demand)
    controller = strategy.make(scenario, job.policy)
    with ExitStack() as stack:
        trip_file = stack.enter_context(atomic(job.trip_file)) if job.trip_file else None
        chosen = strategy.settings(scenario)
        planning = strategy.planning(scenario)
        guides: bool | None = strategy.guides or chosen.guided
        if not guides and strategy.own:
            guides = None  # a controller of the user's own may command drivers at any time
        plant = SumoPlant(
            scenario,
            settings=chosen,
            trip_file=trip_file,
            planning=planning,
            observer=observer,
            gui=gui,
            guides=guides,
        )
        stack.callback(plant.close)
        # Without a command, drivers do what the controller's model takes them to do.
        believed = replace(scenario, network=planning.network)
        result = closed_loop.run(plant, controller, believed, seed=job.seed, progress=progress)
        used = scenario.settings | {"sumo": chosen.model_dump(mode="json", exclude_defaults=True)}
        about = {"controller": strategy.name, "plant": "sumo", "settings": json.dumps(used)}
        result = result.add(about, RECORD, **plant.record())
        gateways = [f"{gate.from_edge} to {gate.to_edge}" for gate in plant.city.gateways]
        result = result.label(gateway=gateways, edge=list(plant.city.edges))
        if gui:
            return result
        result = _with_facts(result, plant, job, scenario, chosen)
    setup = time.perf_counter() - begin - result.wall_time
    return result.assign(setup_time_s=setup)


def _with_facts(
    result: Result, plant: SumoPlant, job: Simulation, scenario: Scenario, chosen: Settings
) -> Result:
    """End the simulation and return its result with all facts."""
    waits = plant.longest_waits()
    plant_facts = plant.facts()
    leaks = set(plant.actuation.leaks())
    emissions = plant.trip_facts()
    totals = plant.edge_totals()
    measures, by_origin = trip_measures(plant.meter.trips(), plant.city.regions)
    totals["trip_time_by_origin"] = by_origin
    sheet = proof_sheet(
        plant.actuation.states,
        [plant.city.net_file, *own_files(scenario, chosen.additional)],
        end=chosen.begin + scenario.steps * scenario.step,
        step=chosen.step_length,
        waits=waits,
    )
    arrays = {**plant.record(), **sheet, **totals}
    result = settled(result.add({}, {**RECORD, **SHEET, **TOTALS}, **arrays))
    facts = {
        "scenario": job.scenario.name,
        "scenario_folder": str(scenario.folder or ""),
        "demand": float(job.demand),
        **plant_facts,
        **measures,
        **emissions,
        "teleports": int(result["teleports"].sum()),
        "signal_violations": int(sum(sheet[name].sum() for name in VIOLATIONS)),
        **queue_facts(result, plant.city),
        "longest_queue_veh": int(result["queue_max"].max()),
        "notes": metrics.notes(result),
        "outside_training": job.strategy.outside_training(scenario, job.demand, job.policy),
        "model_warning": job.strategy.model_warning(scenario),
        "leaking_share": leaking_share(result, plant.city, leaks),
        **estimation_errors(result, scenario.network.critical),
        "overhead_share": 1.0 - plant_facts["sumo_time_s"] / result.wall_time,
        "setup_time_s": math.nan,
        "jumps": int(result["jumps"].sum()),
    }
    return result.add(facts)


def regional_outflow(
    record: Mapping[str, np.ndarray] | Result, step: float
) -> Float[np.ndarray, "*T R"]:
    """Return the outflow of every region (veh/s, (T, R) or (R,)).

    It counts trips that end there and vehicles that leave.

    record: arrays of cosim.plant.record.RECORD, or their rows of one interval
    step: control interval (s)
    """
    return (record["arrivals"] + record["crossings"].sum(axis=(-2, -1))) / step


def trip_measures(trips: Sequence[Trip], regions: int) -> tuple[dict[str, float], PerRegion]:
    """Return measures of the trips that were due, and times by origin.

    Measures are of private vehicles, and apart of others; the mean time (s, (R,)) of private ones
    by region of origin is NaN without any.
    """
    table = np.rec.fromrecords([tuple(trip) for trip in trips], dtype=TRIPS)
    private = table[table.private]
    other = table[~table.private]
    count = Counter(private.outcome)
    entered = table[np.isin(table.outcome, (COMPLETED, REMOVED, UNDER_WAY))]
    row = {
        "trips": len(private),
        "departed_veh": np.count_nonzero(entered.private),
        "completed_veh": count[COMPLETED],
        "final_backlog_veh": count[WAITING],
        "total_backlog_veh_s": float(private.departure_delay.sum()),
        "removed_veh": count[REMOVED] + count[GIVEN_UP],
        "removed_waiting_veh": count[GIVEN_UP],
        "mean_trip_time_s": _mean(private.time),
        "mean_finished_trip_time_s": _mean(private.time[private.outcome == COMPLETED]),
        "median_trip_time_s": _quantile(private.time, 0.5),
        "p95_trip_time_s": _quantile(private.time, 0.95),
        "mean_departure_delay_s": _mean(private.departure_delay),
        "mean_time_loss_s": _mean(entered.time_loss[entered.private]),
        "public_transport_trips": np.count_nonzero(table.public),
        "public_transport_delay_s": _mean(entered.time_loss[entered.public]),
        "other_trips": len(other),
        "other_time_spent_veh_s": float(other.time.sum()),
        "other_departure_delay_veh_s": float(other.departure_delay.sum()),
    }
    by_origin = [_mean(private.time[private.origin == region]) for region in range(regions)]
    return row, np.array(by_origin)


def _mean(values: np.ndarray) -> float:
    """Return the mean of those that are known, NaN without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def _quantile(values: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share)) if values.size else math.nan


def queue_facts(result: Result, city: City) -> dict[str, float]:
    """Return queues on the edges before gateways, every edge once."""
    edges = [gateway.from_edge for gateway in city.gateways]
    upstream = [edges.index(edge) for edge in dict.fromkeys(edges)]
    taken = gateway_room_taken(result["edge_vehicles"].astype(float), city)
    full = taken[:, upstream] >= FULL_SHARE
    return {
        "gateway_queue_mean_veh": float(result["gateway_queue"][:, upstream].mean()),
        "gateway_queue_max_veh": float(result["gateway_queue_max"][:, upstream].max()),
        "gateway_full_share": float(full.mean()),
    }


def estimation_errors(result: Result, critical: PerRegion) -> dict[str, float]:
    """Return root mean square errors of estimated states.

    They are those of the accumulation of a region, as a share of `critical` (veh, (R,)), and of its
    parts with vehicles (veh); NaN if the states were exact.
    """
    if not result.estimated:
        return {"estimate_rmse_share": math.nan, "estimate_cell_rmse_veh": math.nan}
    off = result["observed"] - result["accumulation"]
    used = (result["accumulation"] > 0).any(axis=0)
    shares = [_rms(off[:, i].sum(axis=1)) / limit for i, limit in enumerate(critical)]
    return {"estimate_rmse_share": _rms(shares), "estimate_cell_rmse_veh": _rms(off[:, used])}


def _rms(values: ArrayLike) -> float:
    if not np.size(values):
        return 0.0
    return float(np.sqrt(np.mean(np.square(values))))


def leaking_share(result: Result, city: City, leaks: Collection[Gateway]) -> float:
    """Return the share of the boundary flow without a signal under control.

    leaks: gateways that nothing controls
    """
    flow = result["gateway_flow"].sum(axis=0)
    leaking = flow[[gateway in leaks for gateway in city.gateways]]
    return float(leaking.sum() / max(flow.sum(), 1))
