"""Tuning of controller options in SUMO by Optuna's CMA-ES.

    <out>/optuna.journal                        Optuna's storage, from which the same call resumes
    <out>/tune.csv                              one row per candidate: options, score, total time spent of every run
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
from dataclasses import dataclass, replace
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
from pydantic.fields import FieldInfo

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
SCORE, JOURNAL = "score_veh_s", "optuna.journal"
Range: TypeAlias = FloatDistribution | IntDistribution


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """Search for the options of a strategy.

    options: KEY or KEY[N] -> (low, high)
    trials: number of candidates, the scenario's own options first
    seeds, levels: runs of every candidate
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
                    "options: expected KEY=LOW:HIGH with LOW below HIGH, such as kp=0.1:10 or set_point[0]=200:600, "
                    f"got {name}={low:g}:{high:g} instead"
                )
        for end in ("low", "high"):
            check_tables(
                self.tuned({name: getattr(span, end) for name, span in self.space.items()})
            )

    @cached_property
    def space(self) -> dict[str, Range]:
        declared = self.declared
        return {
            name: IntDistribution(math.ceil(low), math.floor(high))
            if name in declared and declared[name].annotation is int
            else FloatDistribution(low, high, log=low > 0.0 and high / low > 10.0)
            for name, (low, high) in self.options.items()
        }

    def tuned(self, values: Mapping[str, float]) -> Scenario:
        """Return the scenario with one value per option; numbers of a list without a range keep
        their value."""
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
        name, tables = self.strategy.table(self.scenario), self.scenario.controller_options
        return replace(
            self.scenario, controller_options={**tables, name: {**tables.get(name, {}), **table}}
        )

    @property
    def declared(self) -> Mapping[str, FieldInfo]:
        """Declared options of the controller, none for the user's own code."""
        options = self.strategy.options(self.scenario)
        return {} if options is None else type(options).model_fields

    def value(self, key: str) -> Any:
        """Return an option of the scenario, or its default; None if there is neither."""
        tables = self.scenario.controller_options
        own = tables.get(self.strategy.controller.name, {})
        own = {**own, **tables.get(self.strategy.table(self.scenario), {})}
        declared = self.declared.get(key)
        if declared is None or declared.is_required():
            return own.get(key)
        return own.get(key, declared.default)

    def first(self) -> dict[str, float]:
        """Return the scenario's options within the ranges; the middle of a range without a
        value."""
        point: dict[str, float] = {}
        for name, span in self.space.items():
            key, index = _key_and_index(name)
            value = self.value(key)
            if index is not None:
                value = dict(enumerate(value or ())).get(index)
            middle = math.sqrt(span.low * span.high) if span.log else (span.low + span.high) / 2
            value = (
                min(max(value, span.low), span.high) if isinstance(value, (int, float)) else middle
            )
            point[name] = round(value) if isinstance(span, IntDistribution) else float(value)
        return point

    def policy(self, number: int) -> Path:
        return self.out / "policies" / f"{number:03d}.pt"


def tune(
    order: Tuning,
    *,
    workers: int = 1,
    time_limit: float | None = None,
    progress: Progress = None,
) -> pd.DataFrame:
    """Run the candidates and return the table of tune.csv; the same call resumes, and one with more
    trials continues.

    A candidate with a failed run has no score.
    Raises: InputError if the folder holds another search, RunFailed if no candidate of a generation
    has a score
    """
    city = city_key(order.scenario, [order.strategy])
    with locked(order.out, JOURNAL):
        study = _study(order)
        generation = 4 + math.floor(3 * math.log(len(order.options)))
        while True:
            trials = study.get_trials(deepcopy=False)
            running = [
                trial for trial in trials if trial.state == TrialState.RUNNING
            ]  # of an interrupted call
            left = order.trials - sum(trial.state != TrialState.WAITING for trial in trials)
            if not running and left <= 0:
                return _write(order, study)
            begun = any(trial.state == TrialState.COMPLETE for trial in trials)
            for _ in range(0 if running else min(left, generation if begun else 1)):
                number = len(study.get_trials(deepcopy=False))
                study.sampler = _sampler(order, number)
                study.ask(order.space)
            running = [
                trial
                for trial in study.get_trials(deepcopy=False)
                if trial.state == TrialState.RUNNING
            ]
            runs = _runs(order, running, city, workers)
            rows = run_many(
                runs,
                order.out / "runs",
                workers=workers,
                time_limit=time_limit,
                progress=progress,
            )
            for trial in running:
                totals = np.maximum(
                    list(_totals(order, rows, trial.number).values()), 1.0
                )  # a city may be empty
                score = float(np.exp(np.log(totals).mean()))
                failed = math.isnan(score)
                study.tell(
                    trial.number,
                    None if failed else score,
                    state=TrialState.FAIL if failed else None,
                )
            table = _write(order, study)
            if table[SCORE].tail(len(running)).isna().all():
                raise_failures(rows)


def _key_and_index(name: str) -> tuple[str, int | None]:
    key, _, index = name.rstrip("]").partition("[")
    return key, int(index) if index else None


def _study(order: Tuning) -> optuna.Study:
    """Open the search in the folder, or begin it with the scenario's options. Raise InputError if
    it is another."""
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
    elif changed := [key for key, value in about.items() if kept[key] != value]:
        raise InputError(
            f"{order.out}: holds another search ({', '.join(changed)}); choose another folder with --out"
        )
    return study


def _sampler(order: Tuning, number: int) -> CmaEsSampler:
    """Return the sampler of one candidate: anew for each, so that a resumed generation is the
    same."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", FutureWarning
        )  # x0 and sigma0 go in Optuna 6, without a successor yet
        return CmaEsSampler(
            x0=order.first(),
            sigma0=INITIAL_DEVIATION,
            seed=(1_000_003 * order.search_seed + number) % 2**32,
            warn_independent_sampling=False,
        )


def _runs(
    order: Tuning, trials: Sequence[FrozenTrial], city: Mapping[str, object], workers: int
) -> list[Run]:
    """Train some candidates if their options train a policy; return their runs."""
    scenarios = {trial.number: order.tuned(trial.params) for trial in trials}
    trains = isinstance(order.strategy.options(order.scenario), Dpc)
    untrained = {
        number: scenario
        for number, scenario in scenarios.items()
        if not order.policy(number).is_file()
    }
    if trains and untrained:
        order.policy(0).parent.mkdir(exist_ok=True)
        numbers = list(untrained)
        jobs = [partial(_train, order, number, one) for number, one in untrained.items()]
        failures = []
        for place, why in in_processes(jobs, max(workers, 1), [None] * len(jobs)):
            if why:
                failures.append(f"policy of candidate {numbers[place]}: {why}")
        if failures:
            raise RunFailed("; ".join(failures))
    runs = []
    for number, scenario in scenarios.items():
        for level in order.levels:
            policies = {order.strategy.name: order.policy(number)} if trains else {}
            folder = f"candidate-{number:03d}/demand-{level:g}"
            runs += runs_of(
                scenario,
                [order.strategy],
                order.seeds,
                demand=level,
                city=city,
                policies=policies,
                folder=folder,
            )
    return runs


def _train(order: Tuning, number: int, scenario: Scenario) -> str:
    """Train the policy of a candidate; it gets its name when the training is complete. Return "",
    no failure."""
    file = order.policy(number)
    unfinished = file.with_suffix(".partial.pt")
    training.train(scenario, order.strategy, seed=order.search_seed, out=unfinished)
    unfinished.replace(file)
    return ""


def _totals(order: Tuning, rows: pd.DataFrame, number: int) -> dict[str, float]:
    """Return column of tune.csv -> total time spent of a run [veh s], NaN if it failed."""
    spent = {
        (row["folder"], row["seed"]): row[TTS] for row in finished_rows(rows).to_dict("records")
    }
    return {
        f"tts_{level:g}_{seed}_veh_s": spent.get(
            (f"candidate-{number:03d}/demand-{level:g}", seed), math.nan
        )
        for level in order.levels
        for seed in order.seeds
    }


def _write(order: Tuning, study: optuna.Study) -> pd.DataFrame:
    """Write tune.csv and tune.toml, and return the table."""
    rows = pd.read_csv(order.out / "runs" / TABLE)
    done = [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]
    scores = [
        {"candidate": one.number, SCORE: math.nan if one.value is None else one.value}
        for one in done
    ]
    table = pd.DataFrame(
        score | one.params | _totals(order, rows, one.number)
        for score, one in zip(scores, done, strict=True)
    )
    files.write_table(order.out / "tune.csv", table)
    if table[SCORE].notna().any():
        row = table.loc[table[SCORE].idxmin()]
        tuned = best_of(order, table).controller_options[order.strategy.table(order.scenario)]
        keys = dict.fromkeys(_key_and_index(name)[0] for name in order.options)
        head = f"# Best of {len(table)} candidates: {row[SCORE]:.4g} veh s; the first: {table[SCORE].iloc[0]:.4g} veh s"
        lines = [
            head,
            f'[controllers."{order.strategy.name}"]',
            *(f"{key} = {tuned[key]}" for key in keys),
            "",
        ]
        files.write_text(order.out / "tune.toml", "\n".join(lines))
    return table


def best_of(order: Tuning, table: pd.DataFrame) -> Scenario:
    """Return the scenario with the best options of the table of `tune`."""
    row = table.loc[table[SCORE].idxmin()]
    values = {}
    for name, span in order.space.items():
        value = row[name]
        values[name] = int(value) if isinstance(span, IntDistribution) else float(value)
    return order.tuned(values)
