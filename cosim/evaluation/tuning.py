"""Tuning of controller options in the microsimulation: CMA-ES by Optuna.

    <out>/optuna.journal                   Optuna's storage; the same call resumes from it
    <out>/tune.csv                         one row per candidate: score, options, total time spent of every run
    <out>/tune.toml                        the best options as a table of scenario.toml
    <out>/candidate-<n>/demand-<level>/    runs of a candidate; its policy beside them if its options train one

The score is the geometric mean of total time spent (veh s) over seeds and demand levels. All candidates meet the same
trips, and no demand level counts for more because it is heavier. Ranges over more than a decade are searched in the
logarithm. Candidate 0 has the options of the scenario.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.samplers import CmaEsSampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from cosim.evaluation import experiment
from cosim.evaluation.simulate import Task, scenario_of
from cosim.evaluation.statistics import TTS
from cosim.plant.strategy import configured, parse
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.controllers.dpc import training
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.tables import text_table
from nmfd.runs.workers import ended

OPTION = re.compile(r"([a-z_]\w*)(?:\[([0-9])\])?")  # KEY, or KEY[N] for one number of a list
LARGEST_DIMENSION = 20  # options: with more, CMA-ES needs more runs than a city allows
INITIAL_DEVIATION = 0.25  # standard deviation of the first generation, as a share of every range
SCORE = "score_veh_s"


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """Search for the options of a controller.

    scenario: folder; controller: strategy; options: key -> (low, high); trials: number of candidates; seeds, levels:
    runs of every candidate; search_seed: of CMA-ES and of training; steps: control intervals, all if None
    """

    scenario: Path
    controller: str
    options: Mapping[str, tuple[float, float]]
    out: Path
    trials: int = 40
    seeds: Sequence[int] = (1000, 1001)
    levels: Sequence[float] = (1.0,)
    search_seed: int = 0
    steps: int | None = None

    @property
    def trains(self) -> bool:
        """True if every candidate trains a policy."""
        return parse(self.controller).controller in training.NAMES

    @property
    def space(self) -> dict[str, BaseDistribution]:
        """Option -> range, logarithmic if it spans more than a decade."""
        whole = _whole_options(parse(self.controller).controller)
        return {
            name: IntDistribution(math.ceil(low), math.floor(high))
            if name in whole
            else FloatDistribution(low, high, log=low > 0.0 and high / low > 10.0)
            for name, (low, high) in self.options.items()
        }

    def folder(self, number: int) -> Path:
        """Return the folder of a candidate."""
        return self.out / f"candidate-{number:03d}"

    def table(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the controller options for one value per range; list numbers without a range keep their value."""
        table: dict[str, Any] = {}
        for name, value in values.items():
            key, index = _place(name)
            rounded = value if isinstance(value, int) else float(f"{value:.6g}")
            if index is None:
                table[key] = rounded
            else:
                numbers = table.setdefault(key, dict(enumerate(self.numbers(key))))
                numbers[index] = rounded
        return {
            key: tuple(value[n] for n in sorted(value)) if isinstance(value, dict) else value
            for key, value in table.items()
        }

    def numbers(self, key: str) -> tuple[float, ...]:
        """Return a list option of the scenario, or its default."""
        value = _scenario_option(self, key)
        return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else ()

    def tasks(self, number: int, values: Mapping[str, float]) -> list[tuple[Path, Task]]:
        """Return the runs of a candidate with their folders."""
        return [
            (
                self.folder(number) / f"demand-{level:g}",
                Task(
                    scenario=self.scenario,
                    controller=self.controller,
                    seed=seed,
                    policy=self.folder(number) / "policy.pt" if self.trains else None,
                    steps=self.steps,
                    demand_factor=level,
                    options=tuple(self.table(values).items()),
                ),
            )
            for seed in self.seeds
            for level in self.levels
        ]


def tune(
    order: Tuning,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Run the candidates and return the table of tune.csv.

    Finished runs and candidates are kept: the same call resumes, and a call with more `trials` continues the search. A
    candidate with a failed run has no score.

    Raises:
        InputError: unknown option, wrong range, or a folder of another search
        RunFailed: no candidate of a generation has a score
    """
    check(order)
    study = _study(order)
    generation = 4 + math.floor(3 * math.log(len(order.options)))
    while True:
        trials = study.get_trials(deepcopy=False)
        open_trials = [trial for trial in trials if trial.state == TrialState.RUNNING]  # of an interrupted call
        left = order.trials - len([trial for trial in trials if trial.state != TrialState.WAITING])
        for _ in range(0 if open_trials else min(left, generation if len(trials) > 1 else 1)):
            study.sampler = _sampler(order, len(study.get_trials(deepcopy=False)))
            study.ask(order.space)
        open_trials = [t for t in study.get_trials(deepcopy=False) if t.state == TrialState.RUNNING]
        if not open_trials:
            return _write(order, study)
        _score(order, study, open_trials, workers, progress, tell)
        _write(order, study)


def check(order: Tuning) -> None:
    """Raise InputError for options and ranges that cannot be tuned."""
    if not 0 < len(order.options) <= LARGEST_DIMENSION:
        raise InputError(f"options: expected 1 to {LARGEST_DIMENSION} ranges, got {len(order.options)} instead")
    for name, (low, high) in order.options.items():
        if not (OPTION.fullmatch(name) and -math.inf < low < high < math.inf):
            raise InputError(
                f"options: expected KEY=LOW:HIGH with LOW below HIGH, such as kp=0.1:10 or set_point[0]=200:600, got "
                f"{name}={low:g}:{high:g} instead"
            )
    for key in {_place(name)[0] for name in order.options if _place(name)[1] is not None}:
        indices = {*range(len(order.numbers(key))), *(n for k, n in map(_place, order.options) if k == key)}
        if indices != set(range(len(indices))):
            raise InputError(f"options: {key} needs a range for {key}[0], {key}[1], ...: the scenario has no such list")
    for end in (0, 1):
        scenario, variant = _configured(order, {name: bounds[end] for name, bounds in order.options.items()})
        if order.trains:
            training.settings(scenario, variant)
        else:
            registry.verify(variant, scenario)


def best(table: pd.DataFrame) -> pd.Series:
    """Return the row with the lowest score."""
    return table.loc[table[SCORE].idxmin()]


def text(order: Tuning, table: pd.DataFrame) -> str:
    """Return the first and the best candidate as a table."""
    rows = {"first": table.iloc[0], f"best: {best(table)['candidate']:.0f}": best(table)}
    return text_table(
        [
            {
                "candidate": name,
                **{option: f"{row[option]:.4g}" for option in order.options},
                "score [veh s]": f"{row[SCORE]:.4g}",
            }
            for name, row in rows.items()
        ],
        "score: geometric mean of total time spent over all seeds and demand levels",
    )


def _place(name: str) -> tuple[str, int | None]:
    """Return the key and the index of an option."""
    match = OPTION.fullmatch(name)
    assert match
    return match[1], None if match[2] is None else int(match[2])


def _scenario_option(order: Tuning, key: str) -> Any:
    """Return an option as the scenario has it, its default otherwise, None if there is neither."""
    tables, controller = load_scenario(order.scenario).controller_options, parse(order.controller).controller
    own = {**tables.get(controller, {}), **tables.get(configured(order.controller, tables), {})}
    declared = registry.declarations().get(controller)
    field = declared.model_fields.get(key) if declared else None
    return own.get(key, None if field is None or field.is_required() else field.default)


def _whole_options(controller: str) -> set[str]:
    """Return the options that are integers."""
    declared = registry.declarations().get(controller)
    return {key for key, field in declared.model_fields.items() if field.annotation is int} if declared else set()


def _first(order: Tuning) -> dict[str, float]:
    """Return the scenario's options within the ranges; the middle of a range for an option without a value."""
    point = {}
    for name, range_ in order.space.items():
        key, index = _place(name)
        value = _scenario_option(order, key)
        if index is not None:
            value = dict(enumerate(order.numbers(key))).get(index)
        low, high = range_.low, range_.high  # type: ignore[attr-defined]
        middle = math.sqrt(low * high) if range_.log else (low + high) / 2  # type: ignore[attr-defined]
        value = min(max(value, low), high) if isinstance(value, (int, float)) else middle
        point[name] = round(value) if isinstance(range_, IntDistribution) else float(value)
    return point


def _study(order: Tuning) -> optuna.Study:
    """Open the search in the folder, or begin it with the scenario's options. Raise InputError if it is another."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    about = {
        "controller": order.controller,
        "scenario": load_scenario(order.scenario).name,
        "options": {name: list(bounds) for name, bounds in order.options.items()},
        "seeds": list(order.seeds),
        "levels": list(order.levels),
        "search_seed": order.search_seed,
        "steps": order.steps,
    }
    order.out.mkdir(parents=True, exist_ok=True)
    storage = JournalStorage(JournalFileBackend(str(order.out / "optuna.journal")))
    study = optuna.create_study(storage=storage, study_name="tune", load_if_exists=True)
    if "order" not in study.user_attrs:
        study.set_user_attr("order", about)
        study.enqueue_trial(_first(order))
    elif changed := [
        key for key, value in about.items() if json.loads(json.dumps(study.user_attrs["order"]))[key] != value
    ]:
        raise InputError(f"{order.out}: holds another search ({', '.join(changed)}); choose another folder with --out")
    return study


def _sampler(order: Tuning, number: int) -> CmaEsSampler:
    """Return the sampler of one candidate; its seed makes a resumed search equal to an uninterrupted one."""
    return CmaEsSampler(
        x0=_first(order),
        sigma0=INITIAL_DEVIATION,
        seed=1_000_003 * order.search_seed + number,
        warn_independent_sampling=False,
    )


def _configured(order: Tuning, values: Mapping[str, float]) -> tuple[Scenario, str]:
    """Return the scenario with the options of a candidate, and the name of their table."""
    scenario = scenario_of(order.tasks(0, values)[0][1])
    return scenario, configured(order.controller, scenario.controller_options)


def _score(
    order: Tuning,
    study: optuna.Study,
    trials: Sequence[FrozenTrial],
    workers: int,
    progress: experiment.Progress | None,
    tell: Callable[[str], None] | None,
) -> None:
    """Run the candidates of `trials` and hand their scores to Optuna."""
    for trial in trials:
        policy = order.folder(trial.number) / "policy.pt"
        if order.trains and not (policy.parent / "trained").is_file():
            policy.parent.mkdir(parents=True, exist_ok=True)
            scenario, variant = _configured(order, trial.params)
            training.train(scenario, variant, seed=order.search_seed, out=policy)
            files.write_text(policy.with_name("trained"), "")  # training writes its best policy so far all the time
    plan = [entry for trial in trials for entry in order.tasks(trial.number, trial.params)]
    failures = experiment.perform(plan, workers=workers, fresh=True, progress=progress, tell=tell)
    scored = 0
    for trial in trials:
        totals = _totals(order, trial.number)
        score = float(np.exp(np.log(np.maximum(list(totals.values()), 1.0)).mean()))
        study.tell(
            trial.number, None if math.isnan(score) else score, state=TrialState.FAIL if math.isnan(score) else None
        )
        scored += not math.isnan(score)
    if not scored:
        raise ended([(experiment.label(task), failure) for task, failure in failures[:1]])


def _totals(order: Tuning, number: int) -> dict[str, float]:
    """Return column of tune.csv -> total time spent of a run (veh s), NaN if it failed."""
    totals = {}
    for level in order.levels:
        path = order.folder(number) / f"demand-{level:g}"
        rows = experiment.overview(path).set_index("seed")[TTS] if (path / "summary.csv").is_file() else {}
        totals |= {f"tts_{level:g}_{seed}_veh_s": float(rows.get(seed, math.nan)) for seed in order.seeds}
    return totals


def _write(order: Tuning, study: optuna.Study) -> pd.DataFrame:
    """Write tune.csv and tune.toml."""
    table = pd.DataFrame(
        [
            {
                "candidate": trial.number,
                SCORE: trial.value if trial.value is not None else math.nan,
                **trial.params,
                **_totals(order, trial.number),
            }
            for trial in study.get_trials(deepcopy=False)
            if trial.state.is_finished()
        ]
    )
    files.write_table(order.out / "tune.csv", table)
    if table[SCORE].notna().any():
        row = best(table)
        options = order.table({name: row[name] for name in order.options})
        lines = [f"{key} = {list(value) if isinstance(value, tuple) else value}" for key, value in options.items()]
        files.write_text(
            order.out / "tune.toml",
            "\n".join(
                [
                    f"# Best of {len(table)} candidates: {row[SCORE]:.4g} veh s; candidate 0: {table[SCORE].iloc[0]:.4g} veh s",
                    f'[controllers."{order.controller}"]',
                    *lines,
                    "",
                ]
            ),
        )
    return table
