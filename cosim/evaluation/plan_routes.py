"""Planning of routes by iterated marginal costs, a SUMO run per iteration.

The first plan has the routes in which guidance every minute ends. Then, in every iteration, a share
of the drivers, those who gain most by it, change to the route of least cost
(cosim.evaluation.move_times) at the mean travel times of the last runs, and SUMO runs with the
plan. It is always the run with the least total time spent whose routes are changed, and whose plan
is kept. After an iteration without a gain fewer drivers change.

    <out>/plan-<n>.csv.gz     plan of iteration n
    <out>/iteration-<n>/      its run
    <out>/routes-<n>.xml      routes as they were driven
    <out>/plan.csv            total time spent and gap of every iteration

The same call reads finished iterations again.
"""

import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from cosim.evaluation.move_times import (
    PERIOD_S,
    Costs,
    Driven,
    Tree,
    options,
    read_driven,
    visits,
)
from cosim.evaluation.runs import runs_of
from cosim.evaluation.statistics import TTS
from cosim.plant.launch import drawn_vehicles, vehicles_of
from cosim.plant.programmes import scenario_city
from cosim.plant.settings import Settings, own_files, settings
from cosim.plant.strategy import Strategy, parse
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City
from cosim.sumo.route_plan import Route, RoutePlan, ends_of
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs import files
from nmfd.runs.frame import Table
from nmfd.runs.progress import Progress, watched
from nmfd.runs.run_many import Run, locked, raise_failures, run_many

FIRST = "guided+guidance-period-60"  # words of the run whose routes the first plan has
CHANGED_SHARE = 0.04  # drivers who change to another route in one iteration
SMALLER = 0.7  # factor of that share after an iteration without a gain
AVERAGED_RUNS = 3  # the last ones, whose travel times are averaged
TABLE = "plan.csv"
GAP = "relative_gap"


@dataclass(frozen=True, kw_only=True)
class Planning:
    """Search for a plan of routes.

    strategy: signals and whatever else acts while the routes are planned
    demand: factor of the scenario's demand
    iterations: SUMO runs with a plan, after the one with guidance
    out: folder of the runs
    """

    scenario: Scenario
    strategy: Strategy
    out: Path
    demand: float = 1.0
    seed: int = 1000
    iterations: int = 9

    def routes(self, number: int) -> Path:
        """Return SUMO's file of the routes that were driven in an iteration."""
        return self.out / f"routes-{number}.xml"

    def plan(self, number: int) -> Path:
        """Return the file of the plan of an iteration."""
        return self.out / f"plan-{number}.csv.gz"

    def run(self, number: int) -> Run:
        """Return the run of an iteration; the first one has guidance, not a plan."""
        scenario = self.scenario
        strategy = self.strategy
        chosen = dict(scenario.sumo)
        chosen["options"] = chosen.get("options", {}) | options(self.routes(number))
        chosen["planned"] = [str(self.plan(number).resolve())]
        if not number:
            strategy = parse(strategy, FIRST)
            chosen["planned"] = []
        city = replace(scenario, sumo=chosen)
        folder = f"iteration-{number}"
        (run,) = runs_of(city, [strategy], [self.seed], demand=self.demand, folder=folder)
        return run


class Driver(NamedTuple):
    """A driver who may get another route.

    due: when the trip was to begin (s); depart: when it began (s); route: without loops
    """

    due: float
    depart: float
    route: Route


class Base(NamedTuple):
    """The best run with a plan so far, whose routes the next plan changes.

    number: iteration, 0 before the first plan; spent: total time spent (veh s)
    share: of the drivers who change
    """

    number: int = 0
    spent: float = math.inf
    drivers: Sequence[Driver] = ()
    share: float = CHANGED_SHARE

    def after(self, number: int, spent: float, drivers: Sequence[Driver]) -> "Base":
        """Return the base after another iteration.

        A run with a plan takes the place of the one with guidance in any case.
        """
        if self.number == 0 or spent < self.spent:
            return Base(number, spent, drivers, self.share)
        return self._replace(share=SMALLER * self.share)


class Change(NamedTuple):
    """Another route of a driver, and the cost that it saves (s)."""

    gain: float
    driver: int
    route: Route


class Assessment(NamedTuple):
    """Costs of the drivers' routes, compared with the least.

    gap: relative gap, the sum of costs less the sum of least costs, over the latter (Chiu et al.,
        Dynamic Traffic Assignment: A Primer, Transportation Research Circular E-C153, 2011)
    changes: those that save some, the largest gain first
    """

    gap: float
    changes: list[Change]


def plan_routes(
    order: Planning,
    file: Path,
    *,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> Table:
    """Find a plan, write it to a file, and return a row per iteration.

    Raises: InputError, and RunFailed if a run failed
    """
    scenario = with_demand(order.scenario, factor=order.demand)
    chosen = settings(scenario)
    city = scenario_city(scenario, chosen)
    due = _due(scenario, chosen, city, order.seed)
    end = chosen.begin + scenario.steps * scenario.step
    rows: list[dict] = []
    runs = []
    base = Base()
    total = order.iterations + 1
    with locked(order.out), watched("plan", progress, said=True) as show:
        for number in range(total):
            run = order.run(number)
            if not number:
                minutes = total * run.expected / 60.0
                _say(f"{total} runs take about {minutes:.0f} min", progress)
            spent = _spent(run, order.out, time_limit, overwrite)
            driven = read_driven(order.routes(number))
            drivers = drivers_of(driven, due, city)
            runs.append(visits(city, [driven[name] for name in drivers], chosen.begin, end))
            costs = Costs(city, runs[-AVERAGED_RUNS:], chosen.begin)
            base = base.after(number, spent, list(drivers.values()))
            found = assess(city, costs, base.drivers, chosen.begin)
            changes = found.changes[: round(base.share * len(base.drivers))]
            changed_plan(base.drivers, changes).write(order.plan(number + 1))
            rows.append({"iteration": number, TTS: spent, GAP: found.gap})
            files.write_table(order.out / TABLE, Table(rows))
            text = f"total time spent {spent:.4g} veh s, relative gap {found.gap:.3f}"
            _say(f"iteration {number}: {text}", progress)
            if show:
                show(number + 1, total)
    with files.atomic(file) as temporary:
        shutil.copyfile(order.plan(base.number), temporary)
    return Table(rows)


def _due(scenario: Scenario, chosen: Settings, city: City, seed: int) -> dict[str, float]:
    """Return when each vehicle is due (s) that may get another route."""
    originals = vehicles_of(scenario, chosen, city, seed)
    shared = recorded.read_routes(own_files(scenario, chosen.additional))
    due = {}
    for depart, n, name in drawn_vehicles(scenario, chosen, originals, seed):
        if ends_of(originals.elements[n], shared):
            due[name] = depart
    return due


def _spent(run: Run, out: Path, time_limit: float | None, overwrite: bool) -> float:
    """Do a run, or read it again, and return its total time spent (veh s)."""
    rows = run_many(
        [replace(run, expected=0.0)],  # the time of all runs has been said
        out,
        time_limit=time_limit or run.limit,
        overwrite=overwrite,
        progress=False,
    )
    raise_failures(rows)
    return float(rows[TTS].iloc[0])


def _say(text: str, progress: Progress) -> None:
    if progress is not False:
        print(text, file=sys.stderr)


def drivers_of(
    driven: Mapping[str, Driven], due: Mapping[str, float], city: City
) -> dict[str, Driver]:
    """Return the drivers of a run who may get other routes.

    due: when the trip of each vehicle was to begin (s)
    """
    drivers = {}
    for name, begin in due.items():
        trip = driven.get(name)
        if trip is not None and city.number.keys() >= set(trip.edges):
            drivers[name] = Driver(begin, trip.depart, without_loops(trip.edges))
    return drivers


def without_loops(edges: Route) -> Route:
    """Return a route without the parts between two visits of an edge.

    >>> without_loops(("a", "b", "c", "b", "d"))
    ('a', 'b', 'd')
    """
    route: list[str] = []
    for edge in edges:
        if edge in route:
            del route[route.index(edge) :]
        route.append(edge)
    return tuple(route)


def assess(city: City, costs: Costs, drivers: Sequence[Driver], begin: float) -> Assessment:
    """Compare the drivers' routes with those of least cost.

    begin: time of the first period (s)
    """
    trees: dict[tuple[int, int], Tree] = {}
    spent = 0.0
    least = 0.0
    changes = []
    for n, driver in enumerate(drivers):
        edges = [city.number[edge] for edge in driver.route]
        period = int((driver.depart - begin) / PERIOD_S)
        depart = begin + (period + 0.5) * PERIOD_S
        key = edges[0], period
        if key not in trees:
            trees[key] = costs.least(edges[0], depart)
        cost = costs.of(edges, depart)
        lowest = trees[key].costs[edges[-1]]
        if math.isinf(cost) or math.isinf(lowest):
            continue
        spent += cost
        least += lowest
        if cost > lowest:
            way = trees[key].way(edges[-1])
            route = tuple(city.edges[edge] for edge in way)
            changes.append(Change(cost - lowest, n, route))
    changes.sort(key=lambda change: -change.gain)
    return Assessment(spent / max(least, 1e-9) - 1.0, changes)


def changed_plan(drivers: Sequence[Driver], changes: Sequence[Change]) -> RoutePlan:
    """Return the plan in which drivers keep their routes but for some changes."""
    routes = [driver.route for driver in drivers]
    for change in changes:
        routes[change.driver] = change.route
    plan = RoutePlan()
    for driver, route in zip(drivers, routes, strict=True):
        plan.add(driver.due, route)
    return plan
