"""Identification of the regional model of a SUMO city: `cosim identify`.

First the city is loaded without perimeter control, and every region's MFD is fitted to its outflow
samples. Then it is loaded under a probing controller, whose set points come from these MFDs.

The whole model, with the split ratios, is counted from all runs (nmfd.model.counting). If a model
counted from fewer runs does not predict the ones held out, a model is also fitted by prediction
error (nmfd.model.identification), and the better of the two is written.
"""

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from cosim.evaluation.free_flow import crossing_times
from cosim.evaluation.model_validation import observed, outflow_samples
from cosim.evaluation.runs import runs_of
from cosim.plant.strategy import parse
from cosim.sumo.net import city_of, network_folder
from nmfd.api import load_scenario
from nmfd.arrays import PerPair, PerRegion
from nmfd.errors import InputError
from nmfd.metrics import largest_accumulation
from nmfd.model import authority, counting, identification, mfd
from nmfd.model.identification import Observed
from nmfd.model.planning import GUIDED
from nmfd.model.regional_model import RegionalModel, network_toml
from nmfd.model.scenario import Scenario
from nmfd.runs import config, files, shipped
from nmfd.runs.progress import Show, watched
from nmfd.runs.run_many import locked, raise_failures, run_many
from nmfd.runs.tables import NARROW, wrapped
from nmfd.studies import fit_quality, plots
from nmfd.types import Result

PATHS = ("net", "regions")  # keys of [sumo] in network.toml
UNGUIDED_STAGES = ("no-control", "probing-pc")
GUIDED_STAGES = ("route-guidance", "probing-pcrg")
# Factors on the demand of a city that is loaded until it breaks: all up to 1, then one more each.
LEVELS = (0.6, 0.8, 1.0, 1.15, 1.3, 1.45, 1.6, 1.75, 1.9, 2.0)
LEAST_FLOW = 1e-3  # veh/s, of a boundary whose signals are never green
SATURATION = 0.5  # vehicles a second and lane that pass a green signal
COUNTED, FITTED = "counted", "fitted"
# Held-out errors of a counted model that needs no fit, as shares of those of "as now".
GOOD_FLOWING = 0.5
GOOD_CONGESTED = 1.0


@dataclass(frozen=True, kw_only=True)
class Task:
    """A regional model to identify.

    guided: with route guidance, first towards the drivers' own split ratios, then probing
    options: words of the strategies, such as max-pressure
    levels: factors on the demand; () for as many as the city needs to break
    iterations: of the fit
    out: folder of the loading runs
    """

    scenario: Scenario
    guided: bool
    options: Sequence[str]
    levels: Sequence[float]
    seeds: Sequence[int]
    iterations: int
    out: Path
    workers: int
    progress: Show

    def loading_runs(self, stage: int, **setup: object) -> list[Result]:
        """Do the runs of stage 0 or 1 that are not finished; return all of them.

        setup: options of the controller
        """
        controllers = GUIDED_STAGES if self.guided else UNGUIDED_STAGES
        strategy = parse("+".join([controllers[stage], *self.options]))
        tuned = self.scenario.with_options(strategy.table(self.scenario), setup)
        runs = []
        for level in self.levels:
            folder = f"level-{level:g}"
            runs += runs_of(tuned, [strategy], self.seeds, demand=level, folder=folder)
        show = self._progress(f"loading runs {stage + 1} of 2; ")
        raise_failures(run_many(runs, self.out, workers=self.workers, progress=show))
        return [Result.read(self.out / run.file) for run in runs]

    def until_broken(self) -> tuple["Task", list[Result]]:
        """Return the task with levels up to where the city breaks; their runs."""
        for number in range(LEVELS.index(1.0), len(LEVELS)):
            task = replace(self, levels=LEVELS[: number + 1])
            runs = task.loading_runs(0)
            if breaking_level(task.levels, task.mean_arrivals(runs)) is not None:
                break
        return task, runs

    def mean_arrivals(self, runs: Sequence[Result]) -> list[float]:
        """Return the completed trips at each level, mean over the seeds."""
        trips = np.array([run.completed_trips for run in runs])
        return trips.reshape(len(self.levels), -1).mean(axis=1).tolist()

    def model(self, method: str, static: RegionalModel, runs: Sequence[Result]) -> RegionalModel:
        """Return the model of runs.

        method: COUNTED or FITTED
        static: result of `static_model`, which nearly empty regions keep
        """
        samples = outflow_samples(static, runs)
        empty = fit_quality.nearly_empty(samples)
        states = [run["accumulation"] for run in runs]
        seen = self.observed(static, runs)
        lane_km = lane_kilometres(static)
        fastest = fastest_rates(self.scenario, static)
        if method == COUNTED:
            model = counting.counted(
                static,
                seen,
                scheme=self.scenario.scheme,
                fastest=fastest,
                saturation=saturation_flows(static, runs),
                lane_km=lane_km,
            )
            above = dict(model.critical_above)
            most = largest_accumulation(states)
            for region in empty:
                above[region] = float(most[region])
            return replace(as_it_was(static, model, empty), critical_above=above)
        model = identification.fit(
            static,
            seen,
            iterations=self.iterations,
            fastest=fastest,
            progress=self._progress("fitting, "),
            **self.scenario.scheme,
        )
        model = as_it_was(static, model, empty)
        return fit_quality.with_guesses(model, samples, lane_km, states, fastest=fastest)

    def observed(self, static: RegionalModel, runs: Sequence[Result]) -> list[Observed]:
        """Return the data of runs, with split ratios as `static` has them."""
        found = []
        for run in runs:
            commanded = parse(run.controller).planning(self.scenario).network.nominal_splits
            splits = shifted(run["splits"], commanded, static.nominal_splits)
            found.append(observed(run.assign(splits=splits)))
        return found

    def held_out(self, runs: Sequence[Result]) -> list[Result]:
        """Return the runs of the last seed, or the last run, to test a model."""
        if len(self.seeds) == 1:
            return list(runs[-1:])
        return [run for run in runs if run.seed == self.seeds[-1]]

    def trial(self, method: str, static: RegionalModel, runs: Sequence[Result]) -> "Trial":
        """Return a model of all runs, and the errors of one without some."""
        model = self.model(method, static, runs)
        unseen = self.held_out(runs)
        without = self.model(method, static, [run for run in runs if run not in unseen])
        errors = fit_quality.predictions(
            without, self.observed(static, unseen), self.scenario.scheme, model.known_critical
        )
        return Trial(method=method, model=model, errors=errors)

    def best(self, static: RegionalModel, runs: Sequence[Result]) -> "Trial":
        """Return the counted model, or a fitted one if only that is good.

        If none is good, the one that is better while traffic flows is returned.
        """
        counted = self.trial(COUNTED, static, runs)
        if counted.good:
            return counted
        fitted = self.trial(FITTED, static, runs)
        if fitted.good:
            return fitted
        return min(counted, fitted, key=lambda trial: trial.error)

    def _progress(self, stage: str) -> Show:
        """Return a progress function whose notes begin with the stage."""
        show = self.progress
        if show is None:
            return None
        return lambda done, total, note="": show(done, total, stage + note)


class Trial(NamedTuple):
    """A model, and the errors of one made in the same way of fewer runs.

    method: COUNTED or FITTED
    errors: `fit_quality.predictions` of the held-out runs
    """

    method: str
    model: RegionalModel
    errors: pd.DataFrame

    @property
    def good(self) -> bool:
        """Return True if no other model is needed."""
        found = fit_quality.held_out(self.errors)
        limits = ((found.flowing, GOOD_FLOWING), (found.congested, GOOD_CONGESTED))
        for errors, share in limits:
            if errors is not None and errors.model > share * errors.as_now:
                return False
        return True

    @property
    def error(self) -> float:
        """Return the RMSE while traffic flows, else of all states (veh)."""
        found = fit_quality.held_out(self.errors)
        if found.flowing is not None:
            return found.flowing.model
        assert found.congested is not None
        return found.congested.model


@dataclass(frozen=True, kw_only=True)
class Identified:
    """A regional model of loading runs.

    runs: of both stages
    samples: of the MFD of each region
    fits: quality of the fit, a row per region, and outflow_critical_veh of a curve through the
        samples alone
    method: COUNTED or FITTED
    held_out: errors of predictions of the held-out runs by a model without them
    verdict: whether perimeter control can help
    """

    task: Task
    model: RegionalModel
    runs: Sequence[Result]
    samples: fit_quality.Samples
    fits: pd.DataFrame
    method: str
    held_out: pd.DataFrame
    verdict: authority.Verdict

    def fit_text(self) -> str:
        """Return the quality of the fit, and the errors in the held-out runs."""
        runs = [f"{run.controller} {run.seed}" for run in self.task.held_out(self.runs)]
        unseen = ", ".join(dict.fromkeys(runs))
        lines = [
            fit_quality.fit_table(self.model, self.fits),
            *wrapped(fit_quality.prediction_text(self.held_out, self.task.scenario.step)),
            fit_quality.ahead_table(self.held_out, self.model.titles),
            *wrapped(f"Rates and MFDs are {self.method}. Held out: the runs {unseen}."),
        ]
        return "\n".join(lines)

    def text(self) -> str:
        """Return the model for the terminal; fit.txt says more."""
        errors = fit_quality.held_out(self.held_out)
        drivers = "guided drivers" if self.task.guided else "drivers on their own routes"
        doubts = fit_quality.doubt_lines(self.model, self.fits)
        if errors.problem:
            doubts.append(f"WARNING: {errors.problem}")
        caption = (
            "Critical accumulation [veh], largest outflow [veh/s], fit of the MFD, and error [veh] "
            f"{errors.ahead:g} s ahead in runs that the model has not seen; in brackets that of "
            '"as now", the prediction that nothing changes.'
        )
        parts = [
            section(f"MODEL OF {drivers.upper()}", [f"{self.method} in {len(self.runs)} runs"]),
            *wrapped(caption, NARROW),
            fit_quality.short_table(self.model, self.fits, self.held_out),
            section("DOUBTS", doubts or ["none"]),
        ]
        return "\n".join(parts)

    def write(self, out: Path, target: Path) -> None:
        """Write the model, and what its fit is based on.

        out: folder of samples, figures and quality of the fit
        target: folder of the model and its verdict
        """
        files.write_text(out / "fit.txt", self.fit_text() + "\n")
        fit_quality.write_fits(out / "fit.csv", self.fits, self.held_out)
        rows = []
        for region, cloud in enumerate(self.samples):
            for branch, points in cloud.items():
                rows += [(region, branch, *point) for point in points]
        table = pd.DataFrame(
            rows, columns=["region", "branch", "accumulation_veh", "outflow_veh_s"]
        )
        files.write_table(out / "samples.csv", table, float_format="%.6g")
        plots.draw_mfds(out / "mfd.png", self.model, self.samples)
        own = network_folder(self.task.scenario.network)
        name = self.task.scenario.name
        seeds = self.task.seeds
        controllers = ", ".join(dict.fromkeys(run.controller for run in self.runs))
        times = ", ".join(f"{level:g}" for level in self.task.levels)
        write_model(
            self.model,
            own,
            target,
            f"Written by cosim identify from {len(self.runs)} runs of {name} under {controllers};\n"
            f"# rates and MFDs are {self.method}; loading runs: demand times {times}, "
            f"seeds {min(seeds)} to {max(seeds)}.",
        )
        files.write_text(target / authority.FILE, self.verdict.text())


def section(heading: str, sentences: Sequence[str]) -> str:
    """Return sentences under a heading, for the terminal."""
    return "\n".join(["", heading, *wrapped("\n".join(sentences), NARROW)])


def write_model(model: RegionalModel, own: Path, target: Path, comment: str) -> None:
    """Write a model of a city as network.toml.

    own: folder of the network of the city
    target: folder of the model
    comment: above the model
    """
    sumo = config.read(own / "network.toml").get("sumo", {})
    for key in PATHS:
        if isinstance(sumo.get(key), str):
            sumo[key] = files.relative(own / sumo[key], target)
    target.mkdir(parents=True, exist_ok=True)
    files.write_text(target / "network.toml", network_toml(model, sumo, comment))


def without_model(scenario: Scenario) -> bool:
    """Return True if no table of a guiding controller names a model."""
    for name, table in scenario.controller_options.items():
        if "model" in table and parse(name).controller_guides:
            return False
    return True


def identify(
    scenario: Path | str,
    *,
    settings: Mapping[str, Any] | None = None,
    levels: Sequence[float] | None = None,
    seeds: int = 2,
    city: str | None = None,
    network: Path | None = None,
    protect: bool = False,
    iterations: int = identification.ITERATIONS,
    workers: int = 1,
    out: Path | None = None,
) -> str:
    """Identify the regional model of a SUMO city, and write it.

    It returns a report. The same call continues after an interruption.

    scenario: a scenario, or a network with a scenario of its name beside it; name or folder
    levels: factors on the demand of the loading runs; 0.6, 0.8, 1 and, in steps of 0.15, up to
        where fewer trips end, or 2, if None
    seeds: loading runs per level, from seed 1000
    city: strategy options of the loading runs, such as "guided+max-pressure" or "own"; own, then
        guided, if None
    network: folder of the model; if None the scenario's network or, of guided drivers alone, its
        folder GUIDED
    protect: write the regions to protect into the scenario, those of the first model
    iterations: of a fit, if counting is not enough
    out: folder of samples, figures and loading runs, runs/SCENARIO-identify if None
    Raises: InputError for a network without a folder or one that must not be written, RunFailed if
        a run failed
    """
    first = load_scenario(scenario, settings)
    protected = first.protected
    strategy = parse("no-control", None if city == "own" else city)
    options = [word for word in strategy.labels if word != "guided"]
    both = city is None and network is None and without_model(first)
    main = files.folder_of(first.name, "identify", out)
    report: list[str] = []
    try:
        for guided in [False, True] if both else [strategy.guides]:
            loaded = replace(load_scenario(scenario, settings), protected=protected)
            folder = main
            if guided and out is None:
                folder = main.with_name(f"{main.name}-guided")
            elif guided and both:
                folder = main / "guided"
            with locked(folder), watched("identify", None) as show:
                target = _target(loaded, network, guided=guided, options=options)
                if protect:
                    shipped.beside(
                        loaded.folder or Path(), "scenario.toml", "a scenario of your own"
                    )
                task = Task(
                    scenario=loaded,
                    guided=guided,
                    options=options,
                    levels=sorted(levels or ()),
                    seeds=range(1000, 1000 + seeds),
                    iterations=iterations,
                    out=folder,
                    workers=workers,
                    progress=show,
                )
                found = identified(task)
                found.write(folder, target)
            regions = found.verdict.protect
            written = protect and not report
            proposed = _proposal(loaded, regions, written=written)
            if written and proposed:
                protected = regions
            model = os.path.normpath(target / "network.toml")
            report += [
                found.text(),
                section("VERDICT", [*found.verdict.sentences, *proposed]),
                section("FILES", [f"Written to {model}; fit.txt, samples and figures to {folder}"]),
            ]
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished runs are in {main}; the same command goes on") from None
    # Last, so that the same command finds the same scenario after an interruption.
    if protected != first.protected:
        write_protected(first, protected)
    report.append(f"\nNext: cosim run {scenario} --controller pi-gating --against no-control")
    return "\n".join(report)


def _target(
    scenario: Scenario, network: Path | None, *, guided: bool, options: Sequence[str]
) -> Path:
    """Return the folder of the model.

    Raises: InputError if it must not be written, before hours of loading
    """
    own = network_folder(scenario.network)
    target = own
    if network is not None:
        target = network
    elif guided and not options and without_model(scenario):
        target = own / GUIDED
    if (guided or options) and target.resolve() == own.resolve():
        raise InputError(
            f"--with: {scenario.name} runs on {target}, the model of its own drivers and signals; "
            "name another folder with --network"
        )
    if shipped.installed(target):
        shipped.beside(own, "network.toml", "another folder with --network")
    there = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InputError(f"--network: {there} is no folder that can be written to; choose another")
    return target


def identified(task: Task) -> Identified:
    """Load a city, and fit a regional model to the runs."""
    scenario = task.scenario
    if task.levels:
        first = task.loading_runs(0)
    else:
        task, first = task.until_broken()
    static = static_model(scenario, first)
    set_point = tuple(static.mfds[region].critical for region in scenario.protected)
    runs = first + task.loading_runs(1, set_point=set_point)
    samples = outflow_samples(static, runs)
    trial = task.best(static, runs)
    states = [run["accumulation"] for run in runs]
    fits = fit_quality.region_fits(
        trial.model,
        samples,
        states,
        seeds=len(task.seeds),
        lane_km=lane_kilometres(static),
    )
    fits["outflow_critical_veh"] = [fit_quality.outflow_critical(cloud) for cloud in samples]
    model = replace(
        trial.model,
        placeholder=False,
        doubts=tuple(fits["doubts"]),
        held_out=fit_quality.held_out(trial.errors),
    )
    verdict = run_verdict(scenario, model, first)
    answer, *grounds = verdict.sentences
    breaks = breaking_text(task.levels, task.mean_arrivals(first))
    verdict = replace(verdict, sentences=(answer, breaks, *grounds))
    return Identified(
        task=task,
        model=replace(model, controllable=verdict.boundaries.shares),
        runs=runs,
        samples=samples,
        fits=fits,
        method=trial.method,
        held_out=trial.errors,
        verdict=verdict,
    )


def _proposal(scenario: Scenario, regions: tuple[int, ...], *, written: bool) -> list[str]:
    """Return the proposal to protect some regions, unless the scenario does."""
    if not regions or set(regions) == set(scenario.protected):
        return []
    names = ", ".join(scenario.network.titles[region] for region in regions)
    instead = f"protected = {list(regions)} instead of {list(scenario.protected)}"
    what = "was written there" if written else "with --protect it is written there"
    return [f"Protect {names}: {instead} in {Path(scenario.where)}; {what}."]


def write_protected(scenario: Scenario, regions: tuple[int, ...]) -> None:
    """Write the regions to protect into the scenario. Raises InputError."""
    path = Path(scenario.where)
    line = f"protected = {list(regions)}"
    text = path.read_text(encoding="utf-8")
    top, bracket, tables = text.partition("\n[")
    top, count = re.subn(r"(?m)^protected\s*=\s*\[[^\]]*\].*$", line, top)
    if not count:
        top += f"\n{line}\n"
    changed = top + bracket + tables
    if tomllib.loads(changed) != tomllib.loads(text) | {"protected": list(regions)}:
        raise InputError(f"{path}: protected: cannot be changed here; write {line} yourself")
    files.write_text(path, changed)


def static_model(scenario: Scenario, results: Sequence[Result]) -> RegionalModel:
    """Return the network with fitted MFDs and observed split ratios.

    results: of runs without commands of split ratios

    Raises: InputError for empty runs
    """
    network = replace(
        scenario.network,
        exit_rates=None,
        capacity=None,
        storage=None,
        equal_ways=False,
        critical_above={},
        held_out=None,
    )
    samples = outflow_samples(network, results)
    empty = fit_quality.nearly_empty(samples)
    if len(empty) == network.regions:
        raise InputError(
            "--levels: every region was nearly empty in all loading runs; give higher levels"
        )
    fastest = scenario.substeps / scenario.step
    mfds = list(network.mfds)
    for region, cloud in enumerate(samples):
        if region not in empty:
            points = fit_quality.own_points(cloud)
            mfds[region] = mfd.fit(*points.T, max_rate=fastest)
    network = replace(network, mfds=tuple(mfds))
    crossings = sum(result["crossings"].sum(axis=0) for result in results)
    ratios = identification.observed_split_ratios(network, crossings)
    return replace(network, observed_split_ratios=ratios)


def shifted(splits: np.ndarray, reference: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return commanded split ratios for drivers with other own ways.

    Guidance shifts what drivers choose by the difference to `reference`.

    splits: (-, (T, R, R, R))
    reference, own: what is commanded for no shift, and what drivers then take (-, (R, R, R))
    """
    moved = np.clip(splits + (own - reference), 0.0, None)
    sums = moved.sum(axis=2, keepdims=True)
    return moved / np.where(sums > 0.0, sums, 1.0)


def lane_kilometres(network: RegionalModel) -> PerRegion:
    """Return the lane-kilometres of each region (km, (R,))."""
    city = city_of(network)
    return np.bincount(city.edge_region, city.lane_metres, city.regions) / 1000.0


def fastest_rates(scenario: Scenario, network: RegionalModel) -> PerRegion:
    """Return one region crossing in free flow as a rate (1/s, (R,))."""
    crossing = np.maximum(crossing_times(city_of(network)), scenario.step / scenario.substeps)
    return 1.0 / crossing


def saturation_flows(network: RegionalModel, runs: Sequence[Result]) -> PerPair:
    """Return the largest flow of boundaries (veh/s, (R, R)).

    It is that of the gateways' lanes during the mean green of the runs without gates; lanes
    without a signal are always green.
    """
    city = city_of(network)
    greens = np.concatenate([run["gateway_original_green"] / run.step for run in runs])
    flows = np.zeros((network.regions, network.regions))
    for gateway, green in zip(city.gateways, greens.T, strict=True):
        signalled = green[np.isfinite(green)]
        share = float(signalled.mean()) if signalled.size else 1.0
        lanes = max(len(gateway.lanes), 1)
        flows[gateway.source, gateway.target] += SATURATION * lanes * share
    return np.maximum(flows, LEAST_FLOW)


def as_it_was(
    network: RegionalModel, model: RegionalModel, regions: Sequence[int]
) -> RegionalModel:
    """Return `model` with some regions as in `network`.

    A fit to few vehicles does not extend to more.
    """
    alone = np.isin(np.arange(model.regions), regions)
    mfds = list(model.mfds)
    for region in regions:
        mfds[region] = network.mfds[region]
    rates = np.where(alone[:, None], 1.0, model.exit_rates)
    storage = np.where(alone, np.maximum(model.storage, [mfd.jam for mfd in mfds]), model.storage)
    return replace(model, mfds=tuple(mfds), exit_rates=rates, storage=storage)


def breaking_level(levels: Sequence[float], arrivals: Sequence[float]) -> float | None:
    """Return the demand at which a city breaks, None if it does not.

    It is the lowest one with fewer completed trips than the one before.

    levels: factors on the demand, rising
    arrivals: completed trips at each
    """
    for (_, before), (level, now) in pairwise(zip(levels, arrivals, strict=True)):
        if now < before:
            return level
    return None


def breaking_text(levels: Sequence[float], arrivals: Sequence[float]) -> str:
    """Return the demand at which a city breaks, as a sentence.

    Arguments as of `breaking_level`.
    """
    level = breaking_level(levels, arrivals)
    if level is None:
        return f"Up to {max(levels):g} times its demand the city does not break."
    at = list(levels).index(level)
    trips = f"{arrivals[at]:,.0f} trips end, {arrivals[at - 1]:,.0f} at {levels[at - 1]:g}"
    return f"The city breaks at {level:g} times its demand: {trips}."


def run_verdict(
    scenario: Scenario, network: RegionalModel, results: Sequence[Result]
) -> authority.Verdict:
    """Judge from runs with open gateways whether perimeter control can help."""
    passed = sum(result["gateway_flow"].sum(axis=0, dtype=float) for result in results)
    # NaN without a signal under control
    reached = ~np.isnan(results[0]["gateway_original_green"][0])
    gateways = []
    for gateway, vehicles, held in zip(city_of(network).gateways, passed, reached, strict=True):
        gateways.append((gateway.source, gateway.target, vehicles, held))
    boundaries = authority.Boundaries.of_gateways(network.regions, gateways)
    trip = 0.0
    lost = 0.0
    for run in results:
        trip += run.trips * run.mean_trip_time_s
        lost += run.trips * run.mean_departure_delay_s + run.departed_veh * run.mean_time_loss_s
    slowness = trip / (trip - lost) if trip > lost else np.nan
    started = np.sum([result["departures"].sum(axis=(0, 2)) for result in results], axis=0)
    plural = "s" if len(results) > 1 else ""
    return authority.verdict(
        network,
        boundaries,
        most=largest_accumulation(result["accumulation"] for result in results),
        started=started.astype(float),
        waiting=max(float(result["backlog"].sum(axis=(1, 2)).max()) for result in results),
        slowness=slowness,
        where=f"in {len(results)} loading run{plural} under {results[0].controller}",
        scenario=os.path.relpath(scenario.folder) if scenario.folder else scenario.name,
    )
