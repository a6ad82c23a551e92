"""Numbers of the link model, fitted to finished runs in SUMO.

The numbers are fitted to the accumulations of the runs of the first seed, those in which traffic
flows if there are any. Other runs show the error that is left. The model repeats each run with the
controller of the run.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.optimize import minimize

from cosim.evaluation.links import link_network
from cosim.evaluation.results import Finished
from cosim.plant.settings import settings
from cosim.plant.strategy import parse
from nmfd import closed_loop
from nmfd.api import loaded
from nmfd.controllers.strategy import ControllerLike, Strategy
from nmfd.errors import InputError
from nmfd.model.links.flows import Numbers
from nmfd.model.links.network import LinkNetwork
from nmfd.model.planning import GUIDED
from nmfd.model.scenario import Scenario
from nmfd.runs.progress import Progress, watched
from nmfd.runs.tables import NARROW, text_table, wrapped
from nmfd.studies.benchmark import REFERENCE, check_labels, streets_of
from nmfd.types import Result

GUIDING = "route-guidance"  # by travel times, which the model calls guided
SEEDS = (0, 1)  # of the model; what it says is their mean
TRIALS = 40  # rollouts of the fitted runs, about
FIRST_CHANGE = 0.15  # of the logarithm of each number
HELD_BACK = 0.05  # cost of a number that is e times its default, as a share of the error
LOCKED = 0.05  # share of the trips that are not finished at the end

Numbering = Float[np.ndarray, "4"]


@dataclass(frozen=True, eq=False)
class Case:
    """A run in SUMO, and what repeats it in the link model.

    demand: factor
    scenario: with the demand of the run
    strategy: as streets know it
    network: streets with the routes of the run's seed
    """

    run: Result
    demand: float
    scenario: Scenario
    strategy: Strategy
    network: LinkNetwork

    def repeated(self, numbers: Numbers) -> list[Result]:
        """Return the run in the link model, once for each of SEEDS."""
        return repeated(self.scenario, self.strategy, self.network, numbers, SEEDS)


def repeated(
    scenario: Scenario,
    strategy: Strategy,
    network: LinkNetwork,
    numbers: Numbers | None,
    seeds: Iterable[int],
) -> list[Result]:
    """Return runs of a strategy in the link model.

    numbers: those of the network if None
    """
    runs = []
    for seed in seeds:
        plant = streets_of(scenario, strategy, network, numbers)
        runs.append(closed_loop.run(plant, strategy.make(scenario), scenario, seed=seed))
    return runs


def strategy_in_links(controller: ControllerLike) -> Strategy:
    """Return how streets know a strategy in SUMO. Raises InputError."""
    strategy = parse(controller)
    if strategy.controller.name == GUIDING:
        return parse("+".join([REFERENCE, GUIDED, *strategy.labels]))
    return strategy


class Fit(NamedTuple):
    """Numbers, and a row per run.

    rows: controller, demand, seed, in SUMO and in the model the time spent (1e6 veh s) and whether
        they lock, difference (-), and whether the numbers were fitted to the run
    left_out: why runs were not compared
    """

    numbers: Numbers
    rows: pd.DataFrame
    left_out: Sequence[str]

    def text(self) -> str:
        """Return the numbers and the errors for the terminal."""
        shown = []
        for row in self.rows.itertuples():
            shown.append(
                {
                    "strategy": row.controller,
                    "demand": f"{row.demand:g}",
                    "seed": row.seed,
                    "SUMO": _spent(row.sumo, locked=row.sumo_locks),
                    "links": _spent(row.links, locked=row.links_lock),
                    "difference": f"{row.difference:+.0%}",
                    "": "fitted" if row.fitted else "",
                }
            )
        unseen = self.rows[~self.rows["fitted"] & ~self.rows["sumo_locks"]]
        error = "No other run flows: the error is unknown."
        if len(unseen):
            sizes = unseen["difference"].abs()
            error = (
                f"Error in other runs that flow ({len(unseen)}): {sizes.median():.0%} in the "
                f"median, {sizes.max():.0%} at most."
            )
        numbers = [f"{name} {value:.3g}" for name, value in self.numbers._asdict().items()]
        caption = f"Total time spent [1e6 veh s]. Numbers: {', '.join(numbers)}. {error}"
        lines = [text_table(shown), *wrapped(caption, NARROW)]
        for reason in self.left_out:
            lines += wrapped(reason, NARROW)
        return "\n".join(lines)


def cases_of(found: Finished) -> tuple[list[Case], list[str]]:
    """Return the runs that the model can repeat, and why not the others."""
    cases = []
    left_out = []
    recorded = bool(settings(found.scenario).routes)
    networks: dict[tuple[float, int] | None, LinkNetwork] = {}
    for level in found.levels:
        for name in level.rows["controller"].unique():
            runs = level.results(name)
            steps = len(runs[0]["departures"])
            scenario = loaded(found.scenario, steps=steps, demand=level.demand)
            try:
                strategy = strategy_in_links(name)
                check_labels(scenario, strategy)
                strategy.make(scenario)
            except InputError as error:
                left_out.append(f"{name} is left out: {error}")
                continue
            for run in runs:
                trips = None if recorded else (level.demand, run.seed)
                if trips not in networks:
                    networks[trips] = link_network(scenario, [run.seed])
                cases.append(Case(run, level.demand, scenario, strategy, networks[trips]))
    return cases, left_out


def fit(found: Finished, progress: Progress = None) -> Fit:
    """Fit the numbers of the link model to finished runs.

    Raises: InputError if the model can repeat none of them
    """
    cases, left_out = cases_of(found)
    if not cases:
        reasons = "; ".join(left_out)
        raise InputError(f"{found.path}: holds no run that the link model can repeat: {reasons}")
    seed = min(case.run.seed for case in cases)
    first = [case for case in cases if case.run.seed == seed]
    fitted = [case for case in first if not locks(case.run)] or first
    with watched("links", progress) as show:
        trial = 0

        def cost(logarithms: Numbering) -> float:
            nonlocal trial
            trial += 1
            if show:
                show(min(trial, TRIALS), TRIALS, "fitting")
            numbers = _numbers(logarithms)
            errors = [_error(case, numbers) for case in fitted]
            return float(np.mean(errors) + HELD_BACK * np.sum(logarithms**2))

        simplex = np.vstack([np.zeros(4), FIRST_CHANGE * np.eye(4)])
        options = {"maxfev": TRIALS, "initial_simplex": simplex}
        best = minimize(cost, np.zeros(4), method="Nelder-Mead", options=options)
    numbers = _numbers(best.x)
    rows = [_row(case, numbers, fitted=case in fitted) for case in cases]
    return Fit(numbers, pd.DataFrame(rows), left_out)


def _numbers(logarithms: Numbering) -> Numbers:
    """Return numbers that are so far from their defaults."""
    values = np.array(Numbers()) * np.exp(logarithms)
    return Numbers(*values.tolist())


def _spent(total: float, *, locked: bool) -> str:
    """Return the time spent (1e6 veh s) for the table."""
    text = f"{total:.3g}"
    if locked:
        text += ", locks"
    return text


def _vehicles(run: Result) -> np.ndarray:
    """Return the vehicles in every region and before it (veh, (T + 1, R))."""
    return (run["accumulation"] + run["backlog"]).sum(axis=2)


def _error(case: Case, numbers: Numbers) -> float:
    """Return the RMSE of the vehicles, as a share of their mean in SUMO."""
    seen = _vehicles(case.run)
    repeated = case.repeated(numbers)
    mean = np.mean([_vehicles(run) for run in repeated], axis=0)
    return float(np.sqrt(np.mean((mean - seen) ** 2)) / seen.mean())


def _row(case: Case, numbers: Numbers, *, fitted: bool) -> dict[str, object]:
    """Return a row of Fit."""
    repeated = case.repeated(numbers)
    spent = float(np.mean([run.total_time_spent for run in repeated]))
    return {
        "controller": case.run.controller,
        "demand": case.demand,
        "seed": case.run.seed,
        "sumo": case.run.total_time_spent / 1e6,
        "sumo_locks": locks(case.run),
        "links": spent / 1e6,
        "links_lock": sum(map(locks, repeated)) > len(repeated) / 2,
        "difference": spent / case.run.total_time_spent - 1.0,
        "fitted": fitted,
    }


def locks(run: Result) -> bool:
    """Return True if many trips are not finished at the end."""
    return left_share(run) > LOCKED


def left_share(run: Result) -> float:
    """Return the share of the trips that are not finished at the end."""
    left = float(_vehicles(run)[-1].sum())
    return left / max(left + run.completed_trips, 1e-9)
