"""Tuning of controller options in SUMO by Optuna's CMA-ES.

    <out>/optuna.journal                        Optuna's storage, from which the same call resumes
    <out>/tune.csv                              one row per candidate: options, score, and the
                                                total time spent of every run
    <out>/tune.toml                             the best options as a table of scenario.toml
    <out>/runs/candidate-<n>/demand-<level>/    runs of a candidate (nmfd.runs.run_many)
    <out>/policies/<n>.pt                       its policy, if its options train one

The score is the geometric mean of total time spent (veh s) over seeds and demand levels, so that no
level counts for more because it is heavier. Ranges over more than a decade are searched in the
logarithm.
"""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import FloatDistribution, IntDistribution
from optuna.samplers import CmaEsSampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from cosim.evaluation.results import finished_rows
from cosim.evaluation.runs import city_key, runs_of
from cosim.evaluation.statistics import TTS
from cosim.plant.strategy import Strategy
from nmfd.controllers import training
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.strategy import check_tables
from nmfd.errors import InputError, RunFailed
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.pool import in_processes
from nmfd.runs.progress import Progress
from nmfd.runs.run_many import TABLE, Run, locked, raise_failures, run_many

OPTION = re.compile(r"[a-z_]\w*(\[[0-9]\])?")  # KEY, or KEY[N] for one number of a list
INITIAL_DEVIATION = 0.25  # standard deviation of the first generation, as a share of every range
SCORE = "score_veh_s"
JOURNAL = "optuna.journal"
Range: TypeAlias = FloatDistribution | IntDistribution


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """Search for the options of a strategy.

    options: KEY or KEY[N] -> (low, high)
    trials: number of candidates, the scenario's own options first
    seeds: of the runs of every candidate
    levels: factors on the demand of these runs
    search_seed: of CMA-ES and of training
    """

    scenario: Scenario
    strategy: Strategy
    options: Mapping[str, tuple[float, float]]
    out: Path
    trials: int = 40
    seeds: Sequence[int] = (1000, 1001)
    levels: Sequence[float] = (1.0,)
    search_seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in self.options.items():
            if not (OPTION.fullmatch(name) and -math.inf < low < high < math.inf):
                raise InputError(
                    "options: expected KEY=LOW:HIGH with LOW below HIGH, such as kp=0.1:10 or "
                    f"set_point[0]=200:600, got {name}={low:g}:{high:g} instead"
                )
        check_tables(self.tuned({name: span.low for name, span in self.space.items()}))
        check_tables(self.tuned({name: span.high for name, span in self.space.items()}))

    @cached_property
    def space(self) -> dict[str, Range]:
        """Range of every option."""
        options = self.strategy.options(self.scenario)
        declared = {} if options is None else type(options).model_fields
        space = {}
        for name, (low, high) in self.options.items():
            if name in declared and declared[name].annotation is int:
                space[name] = IntDistribution(math.ceil(low), math.floor(high))
            else:
                logarithmic = low > 0.0 and high / low > 10.0
                space[name] = FloatDistribution(low, high, log=logarithmic)
        return space

    def tuned(self, values: Mapping[str, float]) -> Scenario:
        """Return the scenario with one value per option.

        Numbers of a list without a range keep their value.
        """
        table: dict[str, Any] = {}
        for name, value in values.items():
            key, index = _key_and_index(name)
            rounded = value if isinstance(value, int) else float(f"{value:.6g}")
            if index is None:
                table[key] = rounded
            else:
                numbers = table.setdefault(key, list(self.value(key) or ()))
                if index > len(numbers):
                    raise InputError(f"options: {name}: the numbers before it need a range, too")
                numbers[index : index + 1] = [rounded]
        return self.scenario.with_options(self.strategy.table(self.scenario), table)

    def value(self, key: str) -> Any:
        """Return an option of the scenario, or its default, or else None."""
        options = self.strategy.options(self.scenario)
        if options is not None:
            return getattr(options, key, None)
        tables = self.scenario.controller_options
        name = self.strategy.controller.name
        own = {**tables.get(name, {}), **tables.get(self.strategy.table(self.scenario), {})}
        return own.get(key)

    def first(self) -> dict[str, float]:
        """Return the scenario's options within the ranges.

        An option without a value has the middle of its range.
        """
        point = {}
        for name, span in self.space.items():
            key, index = _key_and_index(name)
            value = self.value(key)
            if index is not None:
                value = dict(enumerate(value or ())).get(index)
            if isinstance(value, (int, float)):
                value = min(max(value, span.low), span.high)
            elif span.log:
                value = math.sqrt(span.low * span.high)
            else:
                value = (span.low + span.high) / 2
            point[name] = round(value) if isinstance(span, IntDistribution) else float(value)
        return point

    def policy(self, number: int) -> Path:
        """Return the file of a candidate's policy."""
        return self.out / "policies" / f"{number:03d}.pt"


def tune(
    order: Tuning,
    *,
    workers: int = 1,
    time_limit: float | None = None,
    progress: Progress = None,
) -> pd.DataFrame:
    """Run the candidates and return the table of tune.csv.

    The same call resumes, and one with more trials continues. A candidate with a failed run has no
    score.

    Raises: InputError if the folder holds another search, RunFailed if no candidate of a generation
        has a score
    """
    city = city_key(order.scenario, [order.strategy])
    with locked(order.out, JOURNAL):
        study = _study(order)
        try:
            while running := _candidates(order, study):
                runs = _runs(order, running, city, workers)
                rows = run_many(
                    runs,
                    order.out / "runs",
                    workers=workers,
                    time_limit=time_limit,
                    progress=progress,
                )
                for trial in running:
                    totals = list(_totals(order, rows, trial.number).values())
                    # A city may be empty.
                    score = float(np.exp(np.log(np.maximum(totals, 1.0)).mean()))
                    if math.isnan(score):
                        study.tell(trial.number, state=TrialState.FAIL)
                    else:
                        study.tell(trial.number, score)
                table = _write(order, study)
                if table[SCORE].tail(len(running)).isna().all():
                    raise_failures(rows)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"finished runs are in {order.out}; the same command goes on"
            ) from None
        table = _write(order, study)
        if table[SCORE].isna().all():
            raise RunFailed(f"{order.out}: no candidate has a score; see runs/{TABLE} there")
        return table


def _candidates(order: Tuning, study: optuna.Study) -> list[FrozenTrial]:
    """Return the candidates to run, none if there are enough.

    They are those of an interrupted call, or else the next generation, of as many as are left at
    most. The first one is a single candidate.
    """
    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    if TrialState.RUNNING not in states:
        left = order.trials - len(states) + states.count(TrialState.WAITING)
        generation = 1
        if TrialState.COMPLETE in states:
            generation = 4 + math.floor(3 * math.log(len(order.options)))
        for _ in range(min(left, generation)):
            number = len(study.get_trials(deepcopy=False))
            study.sampler = _sampler(order, number)
            study.ask(order.space)
    return study.get_trials(deepcopy=False, states=[TrialState.RUNNING])


def _key_and_index(name: str) -> tuple[str, int | None]:
    """Return KEY, and N of KEY[N]."""
    key, _, index = name.rstrip("]").partition("[")
    return key, int(index) if index else None


def _study(order: Tuning) -> optuna.Study:
    """Open the search in the folder, or begin it with the scenario's options.

    Raises: InputError if the folder holds another search
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    about = {
        "controller": order.strategy.name,
        "scenario": order.scenario.name,
        "steps": order.scenario.steps,
        "options": {name: list(bounds) for name, bounds in order.options.items()},
        "seeds": list(order.seeds),
        "levels": list(order.levels),
        "search_seed": order.search_seed,
    }
    storage = JournalStorage(JournalFileBackend(str(order.out / JOURNAL)))
    study = optuna.create_study(storage=storage, study_name="tune", load_if_exists=True)
    kept = study.user_attrs.get("search")
    if kept is None:
        study.set_user_attr("search", about)
        study.enqueue_trial(order.first())
        return study
    changed = [key for key, value in about.items() if kept[key] != value]
    if changed:
        raise InputError(
            f"{order.out}: holds another search ({', '.join(changed)}); "
            "choose another folder with --out"
        )
    return study


def _sampler(order: Tuning, number: int) -> CmaEsSampler:
    """Return the sampler of one candidate.

    Each has a new one, so that a resumed generation is the same.
    """
    with warnings.catch_warnings():
        # x0 and sigma0 go in Optuna 6, without a successor yet.
        warnings.simplefilter("ignore", FutureWarning)
        return CmaEsSampler(
            x0=order.first(),
            sigma0=INITIAL_DEVIATION,
            seed=(1_000_003 * order.search_seed + number) % 2**32,
            warn_independent_sampling=False,
        )


def _runs(
    order: Tuning, trials: Sequence[FrozenTrial], city: Mapping[str, object], workers: int
) -> list[Run]:
    """Return the runs of some candidates.

    Train those without a policy first, if the controller is a trained one.
    """
    scenarios = {trial.number: order.tuned(trial.params) for trial in trials}
    trains = isinstance(order.strategy.options(order.scenario), Dpc)
    if trains:
        _train_missing(order, scenarios, workers)
    policies = {}
    runs = []
    for number, scenario in scenarios.items():
        if trains:
            policies = {order.strategy.name: order.policy(number)}
        for level in order.levels:
            runs += runs_of(
                scenario,
                [order.strategy],
                order.seeds,
                demand=level,
                city=city,
                policies=policies,
                folder=f"candidate-{number:03d}/demand-{level:g}",
            )
    return runs


def _train_missing(order: Tuning, scenarios: Mapping[int, Scenario], workers: int) -> None:
    """Train the policies of candidates that have none. Raise RunFailed."""
    order.policy(0).parent.mkdir(exist_ok=True)
    missing = [number for number in scenarios if not order.policy(number).is_file()]
    jobs = [partial(_train, order, number, scenarios[number]) for number in missing]
    failures = []
    for place, why in in_processes(jobs, max(workers, 1), [None] * len(jobs)):
        if why:
            failures.append(f"policy of candidate {missing[place]}: {why}")
    if failures:
        raise RunFailed("; ".join(failures))


def _train(order: Tuning, number: int, scenario: Scenario) -> str:
    """Train the policy of a candidate; return "", no failure.

    The file gets its name when the training is complete.
    """
    file = order.policy(number)
    unfinished = file.with_suffix(".partial.pt")
    training.train(scenario, order.strategy, seed=order.search_seed, out=unfinished)
    unfinished.replace(file)
    return ""


def _totals(order: Tuning, rows: pd.DataFrame, number: int) -> dict[str, float]:
    """Return column of tune.csv -> total time spent of a run (veh s).

    It is NaN if the run failed.
    """
    spent = {}
    for row in finished_rows(rows).to_dict("records"):
        spent[row["folder"], row["seed"]] = row[TTS]
    totals = {}
    for level in order.levels:
        for seed in order.seeds:
            run = (f"candidate-{number:03d}/demand-{level:g}", seed)
            totals[f"tts_{level:g}_{seed}_veh_s"] = spent.get(run, math.nan)
    return totals


def _write(order: Tuning, study: optuna.Study) -> pd.DataFrame:
    """Write tune.csv and, if there is a best candidate, tune.toml.

    Return the table.
    """
    runs = pd.read_csv(order.out / "runs" / TABLE)
    rows = []
    for trial in study.get_trials(deepcopy=False):
        if trial.state.is_finished():
            score = math.nan if trial.value is None else trial.value
            totals = _totals(order, runs, trial.number)
            rows.append({"candidate": trial.number, SCORE: score} | trial.params | totals)
    table = pd.DataFrame(rows)
    files.write_table(order.out / "tune.csv", table)
    scores = table[SCORE]
    if scores.isna().all():
        return table
    tuned = best_of(order, table).controller_options[order.strategy.table(order.scenario)]
    first = "failed" if math.isnan(scores[0]) else f"{scores[0]:.4g} veh s"
    lines = [f"# Best of {len(table)} candidates: {scores.min():.4g} veh s; the first: {first}"]
    lines.append(f'[controllers."{order.strategy.name}"]')
    for key in dict.fromkeys(_key_and_index(name)[0] for name in order.options):
        lines.append(f"{key} = {tuned[key]}")
    files.write_text(order.out / "tune.toml", "\n".join([*lines, ""]))
    return table


def best_of(order: Tuning, table: pd.DataFrame) -> Scenario:
    """Return the scenario with the best options of the table of `tune`."""
    row = table.loc[table[SCORE].idxmin()]
    space = order.space.items()
    return order.tuned({name: span.to_external_repr(row[name]) for name, span in space})
