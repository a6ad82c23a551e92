"""Regional model and scenario.toml of an imported city."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.case import SumoInput
from cosim.importing.demand import Traffic, departure
from cosim.importing.regions import digraph, names, positions
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.arrays import PairsOverTime
from nmfd.model.identification import observed_split_ratios
from nmfd.model.mfd import JAM_DENSITY, guess
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.config import quoted

SIGNAL_SPEED_SHARE = 0.5  # speed with signals over the speed limit
DEFAULT_CYCLE_S = 90.0
SHORTEST_STEP_S, LONGEST_STEP_S = 60.0, 180.0  # control intervals; shorter cycles are taken several times
IDLE_S = 900.0  # before the first departure, at most
RECOVERY_S = 1800.0  # after the last departure, for the network to empty
# A policy that relies on one identified model gains there and not in SUMO: it starts from no control and trains on many
# models and demand levels. With guidance a compact policy adds prices to travel times.
TRAINING = """
[controllers.dpc-pc]        # training
steps = 600
learning_rate = 2e-3
demand_low = 0.8            # every rollout has another demand level and another regional model
demand_high = 1.3
mfd_spread = 0.15
from_no_control = true      # what training finds no reason to change stays open

[controllers.dpc-pcrg]      # a gate and prices that can be read, beside guidance by travel times
compact = true
numbers = [1.5, 1.0, 0.0, 1.0, 0.6, 0.0, 0.6, 1.5]  # it begins with: the gate open
steps = 200
learning_rate = 2e-3
demand_low = 0.8
demand_high = 1.3
mfd_spread = 0.15
detour_cost = 600.0         # s per diverted vehicle
"""


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Control intervals: begin [s] of SUMO's time, length [s], number."""

    begin: float
    step: float
    steps: int

    @property
    def end(self) -> float:
        """End of the last control interval [s], in SUMO's time."""
        return self.begin + self.steps * self.step


def without_idle(case: SumoInput, traffic: Traffic) -> SumoInput:
    """Begin the case later if its first vehicle departs more than IDLE_S after the beginning."""
    first = min([*traffic.depart[:1], *(departure(element) for element in traffic.background)], default=case.begin)
    return case if first - case.begin <= IDLE_S else replace(case, begin=float(first // IDLE_S * IDLE_S))


def clock(case: SumoInput, streets: Streets, traffic: Traffic) -> Clock:
    """Return control intervals of the most common signal cycle, until RECOVERY_S after the last departure."""
    cycles = Counter(round(logic.cycle) for logic in streets.logics.values() if logic.kind == "static")
    del cycles[0]
    cycle = float(max(sorted(cycles), key=cycles.__getitem__)) if cycles else DEFAULT_CYCLE_S
    step = cycle * np.ceil(SHORTEST_STEP_S / cycle)
    if step > LONGEST_STEP_S:
        step = DEFAULT_CYCLE_S
    last = traffic.depart[-1] if len(traffic.depart) else case.begin
    return Clock(begin=case.begin, step=float(step), steps=int(np.ceil((last - case.begin + RECOVERY_S) / step)))


def region_demand(traffic: Traffic, regions: EdgeNumbers, clock: Clock) -> PairsOverTime:
    """Return the departures (T, R, R) [veh/s] by interval and pair of regions."""
    count = int(regions.max()) + 1
    demand = np.zeros((clock.steps, count, count))
    k = np.minimum(((traffic.depart - clock.begin) / clock.step).astype(int), clock.steps - 1)
    np.add.at(demand, (k, regions[traffic.origin], regions[traffic.destination]), 1.0 / clock.step)
    return demand


def network_of(streets: Streets, regions: EdgeNumbers, name: str, baseline: Baseline) -> RegionalModel:
    """Return the regional model: adjacency from streets, split ratios from the baseline, guessed MFDs.

    Their free-flow rate is from speed limits and metres per visit, their jam accumulation from lanes.
    """
    count = int(regions.max()) + 1
    lanes = np.bincount(regions, streets.lane_metres, count)
    speed = np.bincount(regions, streets.lane_metres * streets.speed, count) / np.maximum(lanes, 1.0)
    across = np.array([np.sqrt(np.ptp(streets.centre[regions == r], axis=0).prod()) for r in range(count)])
    measured = baseline.metres_per_visit(streets, regions)
    visit = np.where(np.isnan(measured), 0.7 * np.maximum(across, 100.0), np.maximum(measured, 50.0))
    rate, jam = SIGNAL_SPEED_SHARE * speed / visit, np.maximum(JAM_DENSITY * lanes / 1000.0, 10.0)
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
    return replace(network, observed_split_ratios=observed_split_ratios(network, baseline.crossings(regions)))


def options(case: SumoInput, clock: Clock) -> dict[str, str]:
    """Return SUMO's options; the city's own step length if it divides the control interval, else 1 s."""
    own = case.step_length
    fits = 0.0 < own <= 1.0 and abs(clock.step / own - round(clock.step / own)) < 1e-9
    return {
        **case.options,
        "begin": f"{clock.begin:.1f}",
        "end": f"{clock.end:.1f}",
        "step-length": f"{own if fits else 1.0:g}",
        "time-to-teleport": f"{case.time_to_teleport:g}",
    }


def scenario_text(
    network: RegionalModel,
    clock: Clock,
    case: SumoInput,
    *,
    name: str,
    network_path: str,
    protected: int,
    files: Mapping[str, Sequence[str]],
    leave: Sequence[str],
    factor: float,
    mesoscopic: bool,
) -> str:
    """Return the scenario.toml; `files` maps routes, background and additional to file names beside it."""
    times = options(case, clock)
    lists = {key: values for key, values in {**files, "leave_signals": leave}.items() if values}
    return (
        f"# Imported from {case.source.name}: its own vehicles, with their routes, departures and types.\n"
        f"name = {quoted(name)}\n"
        f"network = {quoted(network_path)}\n"
        f"step = {clock.step:.1f}                 # s, control interval = most common signal cycle\n"
        f"steps = {clock.steps}\n"
        f"substeps = {int(np.ceil(clock.step / min(30.0, 0.5 / max(mfd.c for mfd in network.mfds))))}\n"
        f"protected = [{protected}]             # the densest region; {network.region_names[protected]}\n"
        'demand_file = "demand.csv"  # veh/s by interval and pair of regions, counted from the vehicles\n'
        f"demand_factor = {factor:g}         # vehicles are left out, or drive twice\n"
        "\n[sumo]\n"
        f"begin = {times['begin']}\n"
        f"step_length = {times['step-length']}\n"
        f"time_to_teleport = {times['time-to-teleport']}      # s; every table counts the teleports\n"
        "ways_return = true          # guided drivers may leave a region and come back, as main roads here do\n"
        + "".join(f"{key} = [{', '.join(map(quoted, values))}]\n" for key, values in lists.items())
        + ("mesoscopic = true           # SUMO's queue model: fast, without lanes\n" if mesoscopic else "")
        + "\n[sumo.options]              # of SUMO, as the city has them\n"
        + "".join(f"{quoted(key)} = {quoted(value)}\n" for key, value in sorted(case.options.items()))
        + TRAINING
    )
