"""Tuning: the options of a controller that do best in SUMO itself, found by CMA-ES.

    <folder>/tune.csv            one row per candidate, new after every generation: its options, score, all its runs
    <folder>/tune.toml           the options of the best one, as scenario.toml takes them
    <folder>/candidate-<n>/      its run folders, one per demand level (cosim.evaluation.experiment), and its policy

The score of a candidate is the geometric mean of the total time spent [veh s] over all seeds and demand levels: the
same trips for everybody, and no level counts for more because it is heavier. CMA-ES as in Hansen, "The CMA evolution
strategy: a tutorial" (2016), by the package cma, within bounds, of the logarithm where a range spans several decades.
Options with which a policy is trained are tuned as well: every candidate trains one.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cma
import numpy as np
import pandas as pd

from cosim.evaluation import experiment, scores
from cosim.evaluation.scores import SCORE
from cosim.evaluation.simulate import Task, scenario_of
from nmfd.api import load_scenario
from nmfd.controllers.dpc import training
from nmfd.controllers.strategy import CONTROLLERS, parse
from nmfd.errors import InputError
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_table
from nmfd.runs.workers import Failure, Source, ended, outcomes

NAME = re.compile(r"[a-z_]\w*(\[[0-9]\])?")  # of an option, or of one number of a list
MOST = 20  # numbers to tune: with more, the runs that CMA-ES needs are beyond what a city allows
DECADES = 1.0  # a range that spans more is searched in the logarithm
FIRST_STEP = 0.25  # standard deviation of the first generation, as a share of every range


@dataclass(frozen=True, kw_only=True)
class Knob:
    """An option to tune, KEY or KEY[N] for one number of a list, between low and high."""

    option: str
    low: float
    high: float

    @property
    def place(self) -> tuple[str, int | None]:
        """The key, and which number of its list."""
        key, bracket, index = self.option.partition("[")
        return key, int(index.removesuffix("]")) if bracket else None

    @property
    def logarithmic(self) -> bool:
        """Whether the range spans decades."""
        return self.low > 0.0 and math.log10(self.high / self.low) > DECADES

    def value(self, share: float) -> float:
        """What lies at `share` [-] of the range."""
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share

    def share(self, value: float) -> float:
        """Where `value` lies in the range [-], within it."""
        inside = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(inside / self.low) / math.log(self.high / self.low)
        return (inside - self.low) / (self.high - self.low)


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """scenario: its folder; controller: a strategy; candidates: how many are tried, the first with the options of the
    scenario; seeds, levels: of the runs of each; search_seed: of CMA-ES, and of policies that are trained; population:
    candidates per generation, by the rule of CMA-ES if None; steps: control intervals, all if None; out: the folder;
    first_step: standard deviation of the first generation, as a share of every range."""

    scenario: Path
    controller: str
    knobs: tuple[Knob, ...]
    candidates: int
    seeds: Sequence[int]
    out: Path
    levels: tuple[float, ...] = (1.0,)
    search_seed: int = 0
    population: int | None = None
    settings: tuple[tuple[str, object], ...] = ()
    steps: int | None = None
    first_step: float = FIRST_STEP

    @property
    def trains(self) -> bool:
        """Whether every candidate is a policy of its own."""
        return parse(self.controller).controller.options is training.Training

    @property
    def configuration(self) -> dict[str, object]:
        """What the folder is for."""
        return {
            "tune": self.controller,
            "scenario": load_scenario(self.scenario).name,
            "seeds": list(self.seeds),
            "options": {knob.option: [knob.low, knob.high] for knob in self.knobs},
            "levels": list(self.levels),
            "search_seed": self.search_seed,
            "population": self.population,
            "steps": self.steps,
        }

    def folder(self, candidate: int) -> Path:
        """Of one candidate."""
        return self.out / f"candidate-{candidate:03d}"

    def policy(self, candidate: int) -> Path | None:
        """The file of its policy."""
        return self.folder(candidate) / "policy.pt" if self.trains else None

    def options(self, point: Sequence[float]) -> tuple[tuple[str, object], ...]:
        """Option and value at `point`, the shares of the ranges."""
        found: dict[str, object] = {}
        lists: dict[str, dict[int, float]] = {}
        whole = _whole_options(parse(self.controller).controller.name)
        for knob, share in zip(self.knobs, point, strict=True):
            (key, index), value = knob.place, float(f"{knob.value(float(share)):.6g}")
            if index is None:
                found[key] = round(value) if key in whole else value
            else:
                lists.setdefault(key, {})[index] = value
        for key, numbers in lists.items():
            kept = dict(enumerate(self.numbers(key)))
            found[key] = tuple((kept | numbers)[n] for n in sorted(kept | numbers))
        return tuple(found.items())

    def numbers(self, key: str) -> tuple[float, ...]:
        """The numbers of a list as the scenario has them, or its default: those without a range stay so."""
        value = _own(self).get(key, _default(parse(self.controller).controller.name, key))
        return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else ()

    def plan(self, candidate: int, options: tuple[tuple[str, object], ...]) -> list[tuple[Path, Task]]:
        """The runs of one candidate, each with its run folder."""
        return [
            (
                experiment.level_folder(self.folder(candidate), level),
                Task(
                    scenario=self.scenario,
                    settings=self.settings,
                    controller=self.controller,
                    seed=seed,
                    policy=self.policy(candidate),
                    steps=self.steps,
                    demand_factor=level,
                    options=options,
                ),
            )
            for seed in self.seeds
            for level in self.levels
        ]


def knob(text: str) -> Knob:
    """Of KEY=LOW:HIGH. InputError for anything else."""
    option, _, span = text.partition("=")
    low, _, high = span.partition(":")
    try:
        found = Knob(option=option.strip(), low=float(low), high=float(high))
    except ValueError:
        found = Knob(option="", low=0.0, high=0.0)
    if not (NAME.fullmatch(found.option) and -math.inf < found.low < found.high < math.inf):
        raise InputError(
            "--option: expected KEY=LOW:HIGH with LOW below HIGH, such as kp=0.1:10 or set_point[0]=200:600, "
            f"got {text!r} instead"
        )
    return found


def check(order: Tuning) -> None:
    """InputError for what cannot be tuned, before anything is run."""
    names = [knob.option for knob in order.knobs]
    if repeated := [name for n, name in enumerate(names) if name in names[:n]]:
        raise InputError(f"--option: {repeated[0]} is there twice; give every option once")
    if not 0 < len(names) <= MOST:
        raise InputError(f"--option: expected 1 to {MOST} numbers to tune, got {len(names)} instead; add or omit some")
    places = [knob.place for knob in order.knobs]
    for key in {key for key, index in places if index is not None}:
        known = set(range(len(order.numbers(key)))) | {n for name, n in places if name == key}
        if known != set(range(len(known))):
            raise InputError(
                f"--option: {key} needs a range for each number that the scenario's list does not have: {key}[0], "
                f"{key}[1], ...; its list has {len(order.numbers(key))}"
            )
    for point in ([0.0] * len(names), [1.0] * len(names)):
        scenario = scenario_of(order.plan(0, order.options(point))[0][1])
        if order.trains:
            training.settings(scenario, parse(order.controller))
        else:
            parse(order.controller).make(scenario)


def tune(
    order: Tuning,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Try candidates; returns the table of tune.csv.

    Every run is kept: the same call goes on where it was interrupted, asks for the same candidates again and finds
    their runs there; with more `candidates` it goes on from there. Policies are trained here. A
    candidate of which a run failed has no score, and counts as the worst. Raises InputError, and RunFailed if none of a generation could be scored.
    """
    check(order)
    return search(
        order,
        workers=workers,
        progress=progress,
        tell=tell,
        kept=lambda table: files.write_text(order.out / "tune.toml", toml(order, table)),
    )


def search(
    order: Tuning,
    *,
    workers: int,
    source: Source | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
    kept: Callable[[pd.DataFrame], object] | None = None,
) -> pd.DataFrame:
    """What `tune` does once the order was checked. kept: takes the table after every generation."""
    algorithm, rows = _search(order), list[dict[str, object]]()
    file = order.out / "tune.csv"
    with run_folder.manifest(
        order.out,
        configuration=order.configuration,
        results=file,
        session={"scenario_folder": str(order.scenario), "workers": workers},
    ):
        points = [_start(order)]
        while points:
            found = _scored(order, points, len(rows), workers, source, progress, tell)
            rows += found
            files.write_table(file, pd.DataFrame(rows))
            if kept:
                kept(pd.DataFrame(rows))
            if len(rows) > 1 and len(points) == algorithm.popsize:
                algorithm.tell(points, _costs(found))
            left = order.candidates - len(rows)
            points = algorithm.ask()[:left] if left > 0 else []
    return pd.DataFrame(rows)


def best(table: pd.DataFrame) -> pd.Series:
    """The row of the candidate with the lowest score."""
    return table.loc[table[SCORE].idxmin()]


def toml(order: Tuning, table: pd.DataFrame) -> str:
    """The options of the best candidate as a table of scenario.toml."""
    row = best(table)
    options = dict(order.options([knob.share(row[knob.option]) for knob in order.knobs]))
    lines = [f"{key} = {list(value) if isinstance(value, tuple) else value}" for key, value in options.items()]
    runs = f"seeds {min(order.seeds)} to {max(order.seeds)}, demand times {', '.join(f'{x:g}' for x in order.levels)}"
    return "\n".join(
        [
            f"# The best of {len(table)} candidates of cosim tune: {row[SCORE]:.4g} veh s ({runs}); the first: "
            f"{table[SCORE].iloc[0]:.4g} veh s",
            f'[controllers."{order.controller}"]',
            *lines,
            "",
        ]
    )


def text(order: Tuning, table: pd.DataFrame) -> str:
    """The first and the best candidate side by side."""
    shown = {"first": table.iloc[0], f"best: {best(table)['candidate']:.0f}": best(table)}
    lines = [
        {
            "candidate": name,
            **{knob.option: f"{row[knob.option]:.4g}" for knob in order.knobs},
            "mean TTS [veh s]": f"{row[SCORE]:.4g}",
            **{
                f"at {level:g}": f"{np.mean([row[scores.column(level, seed)] for seed in order.seeds]):.4g}"
                for level in order.levels
            },
        }
        for name, row in shown.items()
    ]
    return text_table(lines, "mean TTS: geometric mean over all runs; at: arithmetic mean at that demand level")


def _search(order: Tuning) -> cma.CMAEvolutionStrategy:
    """Its random numbers are its own: what else draws between two generations changes nothing."""
    random = np.random.default_rng([order.search_seed, len(order.knobs)])
    chosen = {
        "bounds": [0.0, 1.0],
        "randn": lambda *shape: random.standard_normal(shape),
        "seed": math.nan,
        "verbose": -9,
        "maxfevals": math.inf,
        "CMA_diagonal": False,
    }
    if order.population is not None:
        chosen["popsize"] = order.population
    return cma.CMAEvolutionStrategy(_start(order), order.first_step, chosen)


def _start(order: Tuning) -> list[float]:
    """The options of the scenario as shares of the ranges; the middle for those that it leaves to the controller."""
    controller, own, point = parse(order.controller).controller.name, _own(order), []
    for knob in order.knobs:
        key, index = knob.place
        value = own.get(key, _default(controller, key))
        if index is not None and isinstance(value, Sequence):
            value = value[index] if index < len(value) else None
        point.append(knob.share(value) if isinstance(value, (int, float)) else 0.5)
    return point


def _own(order: Tuning) -> dict[str, Any]:
    """The options that the scenario gives the controller."""
    scenario, strategy = load_scenario(order.scenario), parse(order.controller)
    tables = scenario.controller_options
    return {**tables.get(strategy.controller.name, {}), **tables.get(strategy.table(scenario), {})}


def _default(controller: str, key: str) -> object:
    """Of an option that is declared, else None."""
    declared = CONTROLLERS[controller].options if controller in CONTROLLERS else None
    field = declared.model_fields.get(key) if declared else None
    return None if field is None or field.is_required() else field.default


def _whole_options(controller: str) -> set[str]:
    """The options that are whole numbers."""
    declared = CONTROLLERS[controller].options if controller in CONTROLLERS else None
    return {key for key, field in declared.model_fields.items() if field.annotation is int} if declared else set()


def _scored(
    order: Tuning,
    points: Sequence[Sequence[float]],
    begin: int,
    workers: int,
    source: Source | None,
    progress: experiment.Progress | None,
    tell: Callable[[str], None] | None,
) -> list[dict[str, object]]:
    """Run the candidates `begin`, `begin` + 1, ... at `points`; their rows of tune.csv."""
    options = {begin + n: order.options(point) for n, point in enumerate(points)}
    plan = [entry for candidate, chosen in options.items() for entry in order.plan(candidate, chosen)]
    each = len(plan) // len(points) * scenario_of(plan[0][1]).steps  # intervals of a candidate

    def report(done: int, total: int, note: str) -> None:
        if progress:  # of what is kept nothing is to do: total counts the rest
            progress(
                (begin + len(points)) * each - total + done,
                order.candidates * each,
                f"candidates {begin} to {max(options)} of {order.candidates}; {note}",
            )

    if order.trains:
        _train(order, options, workers, lambda note: report(0, len(points) * each, note))
    failures = experiment.perform(plan, workers=workers, fresh=True, progress=report, tell=tell, source=source)
    rows = [_row(order, candidate, points[candidate - begin]) for candidate in options]
    if all(math.isnan(row[SCORE]) for row in rows):
        raise ended([(experiment.label(task), failure) for task, failure in failures[:1]])
    return rows


def _row(order: Tuning, candidate: int, point: Sequence[float]) -> dict[str, Any]:
    found = scores.totals(order.folder(candidate), order.levels, order.seeds)
    return {"candidate": candidate, SCORE: scores.score(found.values()), **_numbers(order, point), **found}


def _numbers(order: Tuning, point: Sequence[float]) -> dict[str, float]:
    """Option -> the number that is run at `point`."""
    options = dict(order.options(point))
    found = {}
    for knob in order.knobs:
        key, index = knob.place
        value: Any = options[key]
        found[knob.option] = float(value if index is None else value[index])
    return found


def _costs(rows: Sequence[Mapping[str, Any]]) -> list[float]:
    """What CMA-ES minimises: the logarithm of the score; one without is worse than all others."""
    costs = np.log([row[SCORE] for row in rows])
    return np.where(np.isnan(costs), np.nanmax(costs) + 1.0, costs).tolist()


def _train(
    order: Tuning, options: Mapping[int, tuple[tuple[str, object], ...]], workers: int, tell: Callable[[str], object]
) -> None:
    """The policies that are not there yet, several at a time. RunFailed if one cannot be trained."""
    todo = [
        (order, candidate, chosen)
        for candidate, chosen in options.items()
        if not (order.folder(candidate) / "trained").is_file()
    ]

    def look(running: Sequence[tuple[tuple, float]]) -> None:
        tell("training " + ", ".join(f"{task[1]}: {share:.0%}" for task, share in running))

    for (_, candidate, _), outcome in outcomes(train_policy, todo, workers, look=look):
        if isinstance(outcome, Failure):
            raise ended([(f"policy of candidate {candidate}", outcome)])


def train_policy(task: tuple[Tuning, int, tuple[tuple[str, object], ...]]) -> None:
    """That of one candidate: (order, its number, its options)."""
    order, candidate, options = task
    scenario = scenario_of(order.plan(candidate, options)[0][1])
    file = order.policy(candidate)
    assert file is not None
    file.parent.mkdir(parents=True, exist_ok=True)
    training.train(scenario, parse(order.controller), seed=order.search_seed, out=file)
    files.write_text(file.with_name("trained"), "")  # the policy is there long before its training is finished
