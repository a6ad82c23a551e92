"""Loading runs -> the regional model of a SUMO city and its drivers' own split ratios -> network.toml.

First the city is loaded without perimeter control, and every region's MFD is fitted to its outflow samples. Then it is
loaded again under a probing controller, whose set points come from these MFDs, and the whole model is fitted to all
runs by prediction error (nmfd.model.identification). Finished runs of other controllers may be added: where the loading
runs lock, they alone show what a controlled city does under such a demand.
"""

import csv
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cosim.evaluation import experiment, results, verdict
from cosim.evaluation.model_validation import outflow_samples
from cosim.evaluation.simulate import Result, Task
from cosim.sumo.arrays import Points
from cosim.sumo.build import network_folder
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model import identification, mfd
from nmfd.model.identification import Observed, observed_split_ratios
from nmfd.model.planning import GUIDED, GUIDING, PlanningModel
from nmfd.model.regional_model import RegionalModel, network_toml
from nmfd.model.scenario import Scenario
from nmfd.runs import config, files, shipped
from nmfd.runs.tables import wrapped
from nmfd.runs.workers import Source, ended
from nmfd.studies import plots
from nmfd.studies.fit_quality import (
    fit_table,
    nearly_empty,
    own_points,
    prediction_table,
    predictions,
    region_fits,
    write_fits,
)

WINDOW = 5  # control intervals
PRIOR = 5.0  # vehicles
PATHS = ("recipe", "net", "regions")  # keys of [sumo] in network.toml


@dataclass(frozen=True, kw_only=True)
class Loading:
    """levels: multiples of the scenario's demand; seeds: of the runs at every level
    guided: with route guidance, first towards the drivers' own split ratios, then probing; else without
    options: words of the strategies (nmfd.controllers.strategy), of a city that has, say, max-pressure signals
    network: the folder whose network.toml is written; None for the scenario's own or, if guided, the one where
        controllers that guide look for their model (nmfd.model.planning.guided_model)
    iterations: of the fit
    runs: folders of finished runs of the same city, which the model is fitted to besides
    """

    levels: Sequence[float]
    seeds: Sequence[int]
    guided: bool = False
    options: Sequence[str] = ()
    network: Path | None = None
    iterations: int = identification.ITERATIONS
    runs: Sequence[Path] = ()

    @property
    def stages(self) -> tuple[str, str]:
        """The strategies of the two stages."""
        first, second = ("route-guidance", "probing-pcrg") if self.guided else ("no-control", "probing-pc")
        return "+".join([first, *self.options]), "+".join([second, *self.options])

    def target(self, scenario: Scenario) -> Path:
        """The folder whose network.toml is written. Raises InputError for a network without one."""
        if self.network is not None:
            return self.network
        own = network_folder(scenario.network)
        return own / GUIDED if self.guided and not self.options and without_model(scenario) else own


def without_model(scenario: Scenario) -> bool:
    """Whether controllers that guide routes are told of no model of their own: they need that of guided drivers."""
    return not any(
        name.startswith(GUIDING) and "model" in options for name, options in scenario.controller_options.items()
    )


def identify(
    scenario: Path,
    loading: Loading,
    *,
    out: Path,
    workers: int = 1,
    scheduler: str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> str:
    """Load the city of `scenario`, fit its regional model, and write the network.toml of `loading`.

    Samples, mfd.png, fit.csv and the loading runs go to `out`, one run folder per level. Returns the fit as a table,
    with what is doubtful about it, and whether perimeter control can help (verdict.txt beside network.toml). Raises
    InputError for a network that does not come from a folder, RunFailed if a loading run failed. Loading runs are kept:
    the same call goes on where it was interrupted, and gives the same model. tell: takes a line where
    runs do not count any more.
    """
    loaded = load_scenario(scenario)
    target, own = loading.target(loaded), network_folder(loaded.network)
    if (loading.guided or loading.options) and target.resolve() == own.resolve():
        raise InputError(
            f"{'--guided' if loading.guided else '--with'}: {loaded.name} runs on {target}, whose model must stay that "
            "of its own drivers and signals; name another folder with --network"
        )
    if shipped.installed(target):
        shipped.beside(own, "network.toml", "another folder with --network")
    there = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):  # rather than after hours of loading
        raise InputError(f"--network: {there} is no folder that can be written to; choose another")
    first, second = loading.stages
    more = [run for folder in loading.runs for run in finished(folder, scenario)]
    loads = partial(_load, scenario, loading, out=out, workers=workers)
    found = loads(first, {}, progress=_named(progress, "1 of 2"))
    network = static_model(loaded, found, guided=loading.guided)
    set_point = tuple(network.mfds[region].critical for region in loaded.protected)
    found += loads(second, {"set_point": set_point}, progress=_named(progress, "2 of 2"))
    held_out = [result for result in found if len(loading.seeds) > 1 and result.seed == loading.seeds[-1]]
    found += more
    scheme: dict = {"step": loaded.step, "substeps": loaded.substeps, "integrator": loaded.integrator}

    def fitted(results: Sequence[Result], samples: Sequence[dict], what: str) -> RegionalModel:
        def fitting(done: int, total: int, note: str) -> None:
            if progress is not None:
                progress(done, total, f"{what}, {note}")

        runs = [observed(result) for result in results]
        return fitted_to(
            network, runs, samples, loaded, iterations=loading.iterations, progress=fitting if progress else None
        )

    samples = samples_of(network, found)
    model = fitted(found, samples, "fitting")
    fits = region_fits(model, samples, [result.accumulation for result in found], seeds=len(loading.seeds))
    text, foreseen = fit_table(model, fits), None
    if held_out:
        kept = [result for result in found if not any(result is other for other in held_out)]
        without = fitted(kept, samples_of(network, kept), "fitting without the last seed")
        unseen = [observed(result) for result in held_out]
        text += "\n" + prediction_table(without, unseen, scheme)
        foreseen = predictions(without, unseen, scheme)
    files.write_text(out / "fit.txt", text + "\n")
    write_fits(out / "fit.csv", fits, foreseen)
    model = replace(model, placeholder=False, doubts=tuple(fit.doubts for fit in fits))
    judged = verdict.of_runs(model, [result for result in found if result.controller == first])
    model = replace(model, controllable=judged.boundaries.shares)
    text = "\n".join([text, *wrapped("\n".join(judged.sentences))])
    _write_samples(out / "samples.csv", samples)
    plots.draw_mfds(out / "mfd.png", model, samples)
    levels, seeds = ", ".join(f"{level:g}" for level in loading.levels), f"{min(loading.seeds)} to {max(loading.seeds)}"
    target.mkdir(parents=True, exist_ok=True)
    files.write_text(
        target / "network.toml",
        network_toml(
            model,
            _sumo_table(own, target),
            f"Regional model: written by cosim identify from {len(found) - len(more)} loading runs of {loaded.name} under "
            f"{first} and\n# {second}, demand times {levels}, seeds {seeds}{_and_runs(more)}.",
        ),
    )
    verdict.write_verdict(target, judged)
    return text


def _named(progress: experiment.Progress | None, what: str) -> experiment.Progress | None:
    """That of one part of the loading runs."""
    return progress and (lambda done, total, note: progress(done, total, f"loading runs, {what}; {note}"))


def _load(
    scenario: Path,
    loading: Loading,
    controller: str,
    options: dict,
    *,
    out: Path,
    workers: int,
    source: Source | None,
    progress: experiment.Progress | None,
) -> list[Result]:
    """The loading runs of one controller at all levels, those that are kept or new ones."""
    plan = [
        (
            out / f"level-{level:g}",
            Task(
                scenario=scenario, controller=controller, seed=seed, demand_factor=level, options=tuple(options.items())
            ),
        )
        for level in loading.levels
        for seed in loading.seeds
    ]
    failures = experiment.perform(plan, workers=workers, source=source, progress=progress, tell=lambda line: None)
    if failures:
        raise ended([(experiment.label(task), failure) for task, failure in failures])
    return [experiment.read_run(folder, controller, task.seed) for folder, task in plan]


def finished(folder: Path, scenario: Path) -> list[Result]:
    """All runs of a folder of `cosim run` or `cosim evaluate`. Raises InputError for runs of another city."""
    finished = results.read(folder, scenario)
    if finished.changed:
        raise InputError(f"--runs: {folder}: {finished.changed}; run them again, or omit them")
    return [
        experiment.read_run(level.folder, row.controller, row.seed)
        for level in finished.levels
        for row in level.rows.itertuples()
    ]


def _and_runs(runs: Sequence[Result]) -> str:
    """What the model was fitted to besides, as the first lines of network.toml say it."""
    if not runs:
        return ""
    names = ", ".join(sorted({run.controller for run in runs}))
    seeds = [run.seed for run in runs]
    return f",\n# and from {len(runs)} runs under {names}, seeds {min(seeds)} to {max(seeds)}"


def static_model(scenario: Scenario, results: Sequence[Result], *, guided: bool) -> RegionalModel:
    """The scenario's network with the published model: an MFD per region, fitted to outflow samples, and own splits,
    if drivers were not guided."""
    network = replace(scenario.network, exit_rates=None, capacity=None, storage=None)
    samples = samples_of(network, results)
    empty = nearly_empty(samples)
    if len(empty) == network.regions:
        raise InputError(
            "--levels: every region was nearly empty in all loading runs; give higher levels, or a scenario with more "
            "vehicles"
        )
    network = replace(
        network,
        mfds=tuple(
            network.mfds[region]
            if region in empty
            else mfd.fit(*own_points(cloud).T, max_rate=scenario.substeps / scenario.step)
            for region, cloud in enumerate(samples)
        ),
    )
    if guided:  # what theta is compared with stays what it is for the plant (cosim.plant.guidance)
        return network
    crossings = sum(result["crossings"].sum(axis=0) for result in results)
    return replace(network, observed_split_ratios=observed_split_ratios(network, crossings))


def samples_of(network: RegionalModel, results: Sequence[Result]) -> list[dict[str, Points]]:
    """Outflow samples of every region (cosim.evaluation.model_validation.outflow_samples)."""
    return [
        outflow_samples(results, results, network.u_max, region, network.adjacency) for region in range(network.regions)
    ]


def observed(result: Result) -> Observed:
    """A run as identification sees it; the demand is what entered the streets."""
    trajectory, record = result, result
    return Observed(
        accumulation=trajectory.accumulation,
        demand=record["departures"] / trajectory.step,
        perimeter=trajectory.perimeter,
        splits=trajectory.splits,
        crossings=record["crossings"].sum(axis=3),
    )


def followed(network: RegionalModel, result: Result) -> Observed:
    """A run as identification sees it with the split ratios that drivers followed instead of those that were commanded,
    if any: counted over WINDOW control intervals, besides PRIOR vehicles that did as they were told."""
    seen, crossings = observed(result), result["crossings"] * network.split_mask
    total = np.cumsum(np.concatenate([np.zeros_like(crossings[:1]), crossings]), axis=0)
    first = np.arange(len(crossings)) - WINDOW // 2
    last = np.clip(first + WINDOW, 0, len(crossings))
    counted = (total[last] - total[np.clip(first, 0, None)]) + PRIOR * seen.splits
    sums = counted.sum(axis=2, keepdims=True)
    return replace(seen, splits=np.where(sums > 0, counted / np.maximum(sums, 1e-9), seen.splits))


def fitted_to(
    network: RegionalModel,
    runs: Sequence[Observed],
    samples: Sequence[dict],
    scheme: Scenario | PlanningModel,
    *,
    iterations: int,
    progress: Callable[[int, int, str], None] | None = None,
) -> RegionalModel:
    """`network` with the parameters that predict `runs` best, and as it was where hardly anybody drove."""
    return as_it_was(
        network,
        identification.fit(
            network,
            runs,
            iterations=iterations,
            progress=progress,
            step=scheme.step,
            substeps=scheme.substeps,
            integrator=scheme.integrator,
        ),
        nearly_empty(samples),
    )


def as_it_was(network: RegionalModel, model: RegionalModel, regions: Sequence[int]) -> RegionalModel:
    """`model` with these regions as they are in `network`, and room for as many vehicles as their MFDs are meant for:
    what was fitted to hardly any vehicles knows nothing of more."""
    alone = np.isin(np.arange(model.regions), regions)
    mfds = tuple((network if alone[n] else model).mfds[n] for n in range(model.regions))
    return replace(
        model,
        mfds=mfds,
        exit_rates=np.where(alone[:, None], 1.0, model.exit_rates),
        storage=np.where(alone, np.maximum(model.storage, [mfd.jam for mfd in mfds]), model.storage),
    )


def _sumo_table(folder: Path, target: Path) -> dict[str, str]:
    """The table [sumo] of the network in `folder`, its paths seen from `target`."""
    table = config.read(folder / "network.toml").get("sumo", {})
    return {
        key: files.relative(folder / value, target) if key in PATHS and isinstance(value, str) else value
        for key, value in table.items()
    }


def _write_samples(path: Path, samples: Sequence[dict]) -> None:
    with files.atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["region", "branch", "accumulation_veh", "outflow_veh_s"])
        for region, cloud in enumerate(samples):
            for branch, points in cloud.items():
                writer.writerows([region, branch, f"{x:.1f}", f"{g:.5f}"] for x, g in points)
