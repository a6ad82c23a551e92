"""Stages of a study: import, loading, gates, strategies."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from cosim.evaluation import evaluate as evaluation
from cosim.evaluation import identify, results, statistics
from cosim.evaluation.identify import LEVELS, breaking_level
from cosim.evaluation.model_validation import outflow_samples
from cosim.evaluation.runs import SECONDS_PER_TRIP
from cosim.importing.importer import CHOICES, COMPARISONS, import_city, reported
from cosim.plant.strategy import parse
from cosim.studying.verdict import FEWEST_SEEDS, Answer, Verdict, judge
from cosim.sumo.net import network_folder
from nmfd.api import load_scenario, train
from nmfd.errors import InputError
from nmfd.metrics import largest_accumulation, percent_change
from nmfd.model.identification import ITERATIONS
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.files import file_name
from nmfd.runs.run_many import TABLE, Run, finished_table, raise_failures, run_many
from nmfd.studies import fit_quality
from nmfd.studies.benchmark import REFERENCE
from nmfd.types import Result

LOADING_SEED = 1000  # it chooses the demand levels, and judges no strategy
FIRST_SEED = 1001
DPC = "dpc-pc"
NEAR_CRITICAL = 0.8  # of the critical accumulation, below which gates stay open
# More trips left than without control, as a share of all, that rule a strategy out.
UNSERVED_SHARE = 0.001
# Strategy -> its name in tables, the simplest first. Drivers are asked every minute: a full city
# can lock under guidance that asks once per region.
EVERYWHERE = {
    "actuated": "actuated signals",
    "max-pressure": "max-pressure signals",
    "route-guidance+guidance-period-60": "guidance",
    "route-guidance+max-pressure+guidance-period-60": "guidance over max-pressure",
}
AT_CRITICAL = {
    "pi-gating": "PI gates",
    DPC: "DPC gates",
    "mpc-pc": "MPC gates",
    "metering": "metering",
    "pricing-rule+max-pressure+guidance-period-60": "prices over max-pressure",
}
LABELS = {REFERENCE: "no control"} | EVERYWHERE | AT_CRITICAL
FAILED = f"a run failed, for the reason in {TABLE}"
MODEL_COMMENT = "Written by cosim study from runs of {} without control, demand times {}."


def say(text: str) -> None:
    """Tell the user what goes on."""
    print(text, file=sys.stderr)


def imported(
    source: Path, out: Path, regions: str, routes: Sequence[Path], counts: Path | None
) -> Scenario:
    """Import a city into the folder of a study, unless that is done.

    source: as `cosim import` takes it
    out: folder of the study
    regions: number, "auto", or table edge,region
    routes: files with vehicles beside those of the source
    counts: edgeData of which trips are made, or None
    Raises: InputError
    """
    name = file_name(source.name.partition(".")[0])
    network = out / "networks" / name
    scenario = out / "scenarios" / name
    if not scenario.exists():
        say(f"Import of {source}")
        import_city(source, network, scenario, regions=regions, routes=routes, counts=counts)
    for beginnings in (COMPARISONS, CHOICES):
        line = reported(network, beginnings)
        if line:
            say(line)
    return load_scenario(scenario)


@dataclass(frozen=True, kw_only=True)
class Runner:
    """Runs of a study.

    out: their folder; finished runs in it are not repeated
    workers: runs at a time
    """

    scenario: Scenario
    out: Path
    workers: int

    def planned(
        self, names: Sequence[str], levels: Sequence[float], seeds: Sequence[int]
    ) -> list[Run]:
        """Return runs of strategies at demand levels.

        The expected time of a run comes from finished ones, if there are any.

        Raises: InputError if a run is impossible
        """
        strategies = [parse(name) for name in names]
        runs = evaluation.plan([(self.scenario, levels)], strategies, seeds)
        pace = self._seconds_per_trip() / SECONDS_PER_TRIP
        return [replace(run, expected=run.expected * pace) for run in runs]

    def _seconds_per_trip(self) -> float:
        """Return the wall time per trip of finished runs."""
        rows = results.finished_rows(finished_table(self.out))
        if rows.empty:
            return SECONDS_PER_TRIP
        spent = rows["wall_time_s"] + rows["setup_time_s"]
        return float(spent.sum() / max(rows["trips"].sum(), 1))

    def done(
        self, names: Sequence[str], levels: Sequence[float], seeds: Sequence[int]
    ) -> pd.DataFrame:
        """Do the runs that are not finished; return a row for each.

        A failed run has no row.

        Raises: InputError, and RunFailed if a run without control failed
        """
        runs = self.planned(names, levels, seeds)
        rows = run_many(runs, self.out, workers=self.workers)
        raise_failures(rows[rows["controller"] == REFERENCE])
        rows = results.finished_rows(rows)
        wanted = rows["controller"].isin(names) & rows["demand"].isin(levels)
        return rows[wanted & rows["seed"].isin(seeds)]

    def result(self, level: float) -> Result:
        """Return the loading run at a demand level."""
        return results.read_run(self.out, REFERENCE, LOADING_SEED, demand=level)

    def impossible(self) -> dict[str, str]:
        """Return the strategies that cannot run in this city, with the reason."""
        reasons = {}
        for name in (*EVERYWHERE, *AT_CRITICAL):
            try:
                self.planned([name], LEVELS[:1], [FIRST_SEED])
            except InputError as error:
                reasons[name] = str(error)
        return reasons


class Loading(NamedTuple):
    """Runs without control at rising demand.

    left: demand level -> share of the trips that are left at the end
    under: highest level at which the city does not break, at least its own demand
    broken: level at which it breaks, None if it does not
    """

    left: Mapping[float, float]
    under: float
    broken: float | None


def loading(runner: Runner) -> Loading:
    """Raise the demand without control until the city breaks.

    The levels, and what breaks is, are those of cosim.evaluation.identify.
    """
    left: dict[float, float] = {}
    arrived: dict[float, float] = {}
    say(f"Loading without control, until the city breaks: demand times {_listed(LEVELS)}")
    for first in range(0, len(LEVELS), runner.workers):
        levels = LEVELS[first : first + runner.workers]
        rows = runner.done([REFERENCE], levels, [LOADING_SEED]).set_index("demand")
        for level in levels:
            row = rows.loc[level]
            left[level] = unfinished(row) / max(row["trips"], 1)
            arrived[level] = row["completed_veh"]
            say(
                f"demand times {level:g}: {row['completed_veh']:,.0f} of {row['trips']:,.0f} trips "
                "completed"
            )
            broken = breaking_level(list(arrived), list(arrived.values()))
            if broken is not None and level >= 1.0:
                say(f"The city breaks at demand times {broken:g}")
                under = [one for one in arrived if 1.0 <= one < broken]
                return Loading(left, max(under, default=1.0), broken)
    return Loading(left, max(arrived), None)


def unfinished(row: Mapping) -> float:
    """Return the trips of a run that are left at its end."""
    return row["trips"] - row["completed_veh"] - row["removed_veh"]


class Gates(NamedTuple):
    """Answer to the question if gates can help.

    scenario: with critical accumulations, if they could be measured
    reason: why gates and metering are left out, "" if they are not
    """

    scenario: Scenario
    reason: str


def gates(runner: Runner, load: Loading, *, own: bool) -> Gates:
    """Measure the critical accumulations, and find out if gates can help.

    own: the scenario is an import of the study, so that the model is written into it
    """
    scenario = runner.scenario
    runs = [runner.result(level) for level in load.left]
    if scenario.network.placeholder and not own:
        reason = "the critical accumulations of the scenario are guesses"
        return Gates(scenario, f"{reason}; measure them: cosim identify {scenario.name}")
    if scenario.network.placeholder:
        empty = fit_quality.nearly_empty(outflow_samples(scenario.network, runs))
        if len(empty) == scenario.network.regions:
            return Gates(scenario, "every region was nearly empty in all runs without control")
        network = measured(runner, load, runs)
        folder = network_folder(scenario.network)
        comment = MODEL_COMMENT.format(scenario.name, _listed(load.left))
        identify.write_model(network, folder, folder, comment)
        scenario = load_scenario(scenario.folder or Path())
    verdict = identify.run_verdict(scenario, scenario.network, runs)
    if not verdict.protect:
        return Gates(scenario, verdict.sentences[0].partition(": ")[2])
    if own:
        identify.write_protected(scenario, verdict.protect)
        scenario = load_scenario(scenario.folder or Path())
    return Gates(scenario, "")


def measured(runner: Runner, load: Loading, runs: Sequence[Result]) -> RegionalModel:
    """Return the regional model that is counted from runs without control.

    Its errors are those of a model without the last run, in that run.
    """
    task = identify.Task(
        scenario=runner.scenario,
        guided=False,
        options=(),
        levels=list(load.left),
        seeds=[LOADING_SEED],
        iterations=ITERATIONS,
        out=runner.out,
        workers=runner.workers,
        progress=None,
    )
    static = identify.static_model(runner.scenario, runs)
    trial = task.trial(identify.COUNTED, static, runs)
    errors = fit_quality.held_out(trial.errors)
    return replace(trial.model, placeholder=False, held_out=errors)


def train_gates(scenario: Scenario) -> None:
    """Train a DPC policy for the gates, unless that is done or refused.

    It is written into the scenario's folder.
    """
    assert scenario.folder is not None
    if (scenario.folder / f"{DPC}.pt").is_file():
        return
    say("DPC gates: training on the regional model, some minutes")
    try:
        train(scenario, DPC, progress=False)
    except InputError as error:
        say(f"DPC gates: not trained; {error}")


def far_from_critical(runner: Runner, level: float) -> str:
    """Return why gates stay open at a demand level, "" if they may close."""
    network = runner.scenario.network
    most = largest_accumulation([runner.result(level)["accumulation"]])
    load = np.nan_to_num(most / network.seen_critical)
    nearest = int(np.argmax(load))
    if load[nearest] >= NEAR_CRITICAL:
        return ""
    if not load[nearest]:
        return "no critical accumulation was seen"
    return (
        f"no region comes near its critical accumulation; {network.titles[nearest]} reaches "
        f"{load[nearest]:.0%} of it"
    )


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A strategy at one demand level.

    verdict: None for the reference
    means: column of runs.csv -> mean over its seeds
    more_left: trips left more than without control, paired by seed, share of all [-]
    spent: seed -> time spent [veh s]
    """

    strategy: str
    verdict: Verdict | None
    means: Mapping[str, float]
    more_left: float = 0.0
    spent: Mapping[int, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name in tables."""
        return LABELS[self.strategy]

    @property
    def answer(self) -> Answer | None:
        """Answer of the verdict, None for the reference."""
        return None if self.verdict is None else self.verdict.answer

    @property
    def saved(self) -> str:
        """Change of the time spent under a strategy that gains, without its sign."""
        return "" if self.verdict is None else self.verdict.change.removeprefix("-")

    @property
    def serves(self) -> bool:
        """True unless more trips are left than without control."""
        return self.more_left <= UNSERVED_SHARE

    @property
    def left(self) -> float:
        """Mean number of trips left at the end."""
        # Means of whole numbers may add up to a little less than 0.
        return max(0.0, unfinished(self.means))


@dataclass(frozen=True, kw_only=True)
class Level:
    """Strategies at one demand level.

    outcomes: in the order of LABELS
    skipped: strategy -> why it was not tried
    """

    demand: float
    outcomes: tuple[Outcome, ...]
    skipped: Mapping[str, str] = field(default_factory=dict)


def level_of(
    runner: Runner, level: float, names: Sequence[str], skipped: Mapping[str, str], most: int
) -> Level:
    """Judge strategies at one demand level.

    Each has three seeds first, and more only while its interval contains 2 % either way.

    most: seeds of a strategy
    """
    seeds = FEWEST_SEEDS
    say(
        f"Strategies at demand times {level:g}: no control and {len(names)} others, "
        f"{seeds} seeds first"
    )
    rows = runner.done([REFERENCE, *names], [level], first_seeds(seeds))
    outcomes = {}
    left_out = dict(skipped)
    for name in (REFERENCE, *names):
        if (rows["controller"] == name).sum() == seeds:
            outcomes[name] = outcome(rows, level, name)
        else:
            left_out[name] = FAILED
    while True:
        undecided = []
        for name, one in outcomes.items():
            if one.verdict is not None and not one.verdict.decided:
                undecided.append(name)
        if not undecided or seeds >= most:
            return Level(demand=level, outcomes=tuple(outcomes.values()), skipped=left_out)
        seeds = more_seeds(seeds, [outcomes[name].verdict for name in undecided], most)
        labels = ", ".join(LABELS[name] for name in undecided)
        say(f"Not decided: {labels}; now with {seeds} seeds")
        rows = runner.done([REFERENCE, *undecided], [level], first_seeds(seeds))
        for name in (REFERENCE, *undecided):
            outcomes[name] = outcome(rows, level, name)


def first_seeds(count: int) -> range:
    """Return the first seeds of the comparison."""
    return range(FIRST_SEED, FIRST_SEED + count)


def more_seeds(seeds: int, undecided: Sequence[Verdict | None], most: int) -> int:
    """Return the next number of seeds: as many as the first verdict needs.

    They are at most twice as many as now, as the spread of a few seeds says little.
    """
    needed = [verdict.needed for verdict in undecided if verdict and verdict.needed]
    wanted = min(needed, default=2 * seeds)
    return min(max(seeds + 1, min(wanted, 2 * seeds)), most)


def outcome(rows: pd.DataFrame, level: float, name: str) -> Outcome:
    """Return what a strategy achieved against no control on common seeds."""
    own = rows[rows["controller"] == name]
    means = own.mean(numeric_only=True).to_dict()
    spent = statistics.by_seed(rows, level, name)
    if name == REFERENCE:
        return Outcome(strategy=name, verdict=None, means=means, spent=spent)
    reference = statistics.by_seed(rows, level, REFERENCE)
    before = rows[(rows["controller"] == REFERENCE) & rows["seed"].isin(spent)]
    more = own.apply(unfinished, axis=1).mean() - before.apply(unfinished, axis=1).mean()
    share = float(more / max(before["trips"].mean(), 1))
    return Outcome(
        strategy=name,
        verdict=compared(spent, reference),
        means=means,
        more_left=share,
        spent=spent,
    )


def compared(spent: Mapping[int, float], reference: Mapping[int, float]) -> Verdict:
    """Judge the change of the time spent against a reference.

    spent, reference: seed -> time spent [veh s]; the seeds of both count
    """
    common = sorted(set(spent) & set(reference))
    return judge([percent_change(spent[seed], reference[seed]) for seed in common])


def _listed(levels: Sequence[float] | Mapping[float, float]) -> str:
    return ", ".join(f"{level:g}" for level in levels)
