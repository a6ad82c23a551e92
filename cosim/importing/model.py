"""Regional model and scenario.toml of an imported city."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.case import SumoInput
from cosim.importing.demand import Traffic, departure
from cosim.importing.partition import digraph, names, positions
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.arrays import PairsOverTime
from nmfd.model.identification import observed_split_ratios
from nmfd.model.mfd import JAM_DENSITY, guess
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.config import filled

SIGNAL_SPEED_SHARE = 0.5  # speed with signals over the speed limit
DEFAULT_CYCLE_S = 90.0
SHORTEST_STEP_S = 60.0  # of control intervals: shorter cycles are taken several times
LONGEST_STEP_S = 180.0
IDLE_S = 900.0  # before the first departure, at most
RECOVERY_S = 1800.0  # after the last departure, for the network to empty


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Control intervals: begin [s] of SUMO's time, length [s], number."""

    begin: float
    step: float
    steps: int

    @property
    def end(self) -> float:
        return self.begin + self.steps * self.step


def without_idle(case: SumoInput, traffic: Traffic) -> SumoInput:
    """Begin the case later if its first vehicle departs much later.

    That is more than IDLE_S after the beginning.
    """
    first = min([*traffic.depart[:1], *map(departure, traffic.background)], default=case.begin)
    if first - case.begin <= IDLE_S:
        return case
    return replace(case, begin=float(first // IDLE_S * IDLE_S))


def clock(case: SumoInput, streets: Streets, traffic: Traffic) -> Clock:
    """Return control intervals until RECOVERY_S after the last departure.

    Their length is that of the most common signal cycle.
    """
    cycles = Counter[int]()
    for logic in streets.logics.values():
        if logic.kind == "static":
            cycles[round(logic.cycle)] += 1
    del cycles[0]
    cycle = DEFAULT_CYCLE_S
    if cycles:
        cycle = float(max(sorted(cycles), key=cycles.__getitem__))
    step = cycle * np.ceil(SHORTEST_STEP_S / cycle)
    if step > LONGEST_STEP_S:
        step = DEFAULT_CYCLE_S
    last = case.begin
    if len(traffic.depart):
        last = traffic.depart[-1]
    return Clock(
        begin=case.begin,
        step=float(step),
        steps=int(np.ceil((last - case.begin + RECOVERY_S) / step)),
    )


def region_demand(traffic: Traffic, regions: EdgeNumbers, clock: Clock) -> PairsOverTime:
    """Return the departures (T, R, R) [veh/s] by interval and pair of regions."""
    count = int(regions.max()) + 1
    demand = np.zeros((clock.steps, count, count))
    k = np.minimum(((traffic.depart - clock.begin) / clock.step).astype(int), clock.steps - 1)
    np.add.at(demand, (k, regions[traffic.origin], regions[traffic.destination]), 1.0 / clock.step)
    return demand


def network_of(
    streets: Streets, regions: EdgeNumbers, name: str, baseline: Baseline
) -> RegionalModel:
    """Return the regional model.

    Adjacency follows from the streets, and split ratios from the baseline. MFDs are guesses: their
    free-flow rate is from speed limits and metres per visit, their jam accumulation from lanes.
    """
    count = int(regions.max()) + 1
    lanes = np.bincount(regions, streets.lane_metres, count)
    lane_speed = np.bincount(regions, streets.lane_metres * streets.speed, count)
    speed = lane_speed / np.maximum(lanes, 1.0)
    sizes = [np.ptp(streets.centre[regions == region], axis=0) for region in range(count)]
    across = np.array([np.sqrt(size.prod()) for size in sizes])
    measured = baseline.metres_per_visit(streets, regions)
    guessed = 0.7 * np.maximum(across, 100.0)
    visit = np.where(np.isnan(measured), guessed, np.maximum(measured, 50.0))
    rate = SIGNAL_SPEED_SHARE * speed / visit
    jam = np.maximum(JAM_DENSITY * lanes / 1000.0, 10.0)
    network = RegionalModel(
        name=name,
        region_names=names(streets, regions),
        positions=positions(streets, regions).round(1),
        adjacency=digraph(streets, regions) > 0,
        mfds=tuple(map(guess, rate, jam)),
        u_min=0.1,
        u_max=0.9,
        placeholder=True,
    )
    return replace(
        network, observed_split_ratios=observed_split_ratios(network, baseline.crossings(regions))
    )


def step_length(case: SumoInput, clock: Clock) -> float:
    """Return the step length [s]: the city's own if possible, else 1 s.

    It must divide the control interval.
    """
    own = case.step_length
    if not 0.0 < own <= 1.0:
        return 1.0
    steps = clock.step / own
    return own if abs(steps - round(steps)) < 1e-9 else 1.0


def options(case: SumoInput, clock: Clock) -> dict[str, str]:
    """Return SUMO's options for the scenario."""
    return {
        **case.options,
        "begin": f"{clock.begin:.1f}",
        "end": f"{clock.end:.1f}",
        "step-length": f"{step_length(case, clock):g}",
        "time-to-teleport": f"{case.time_to_teleport:g}",
    }


def scenario_text(
    network: RegionalModel,
    clock: Clock,
    case: SumoInput,
    *,
    files: Mapping[str, Sequence[str]],
    leave: Sequence[str],
    **values: str | float,
) -> str:
    """Return the scenario.toml.

    files: routes, background and additional -> file names beside it
    values: name, network_path, protected (region), factor of the demand, mesoscopic
    """
    return filled(
        Path(__file__).with_name("scenario.toml.j2"),
        network=network,
        clock=clock,
        case=case,
        times=options(case, clock),
        lists={**files, "leave_signals": leave},
        substeps=int(np.ceil(clock.step / min(30.0, 0.5 / network.free_rates.max()))),
        **values,
    )
