"""Identification of the regional model and split ratios of a SUMO city from loading runs: `cosim
identify`.

First the city is loaded without perimeter control, and every region's MFD is fitted to its outflow
samples. Then it is loaded under a probing controller, whose set points come from these MFDs, and
the whole model is fitted to all runs by prediction error.
"""

import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.evaluation.model_validation import observed, outflow_samples
from cosim.evaluation.runs import runs_of
from cosim.plant.strategy import parse
from cosim.sumo.net import city_of, network_folder
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.metrics import largest_accumulation
from nmfd.model import authority, identification, mfd
from nmfd.model.planning import GUIDED
from nmfd.model.regional_model import RegionalModel, network_toml
from nmfd.model.scenario import Scenario
from nmfd.runs import config, files, shipped
from nmfd.runs.progress import watched
from nmfd.runs.run_many import locked, raise_failures, run_many
from nmfd.runs.tables import wrapped
from nmfd.studies import fit_quality, plots
from nmfd.types import Result

PATHS = ("net", "regions")  # keys of [sumo] in network.toml


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
    levels: Sequence[float] = (0.6, 0.8, 1.0),
    seeds: int = 2,
    city: str | None = None,
    network: Path | None = None,
    protect: bool = False,
    iterations: int = identification.ITERATIONS,
    workers: int = 1,
    out: Path | None = None,
) -> str:
    """Fit the regional model of a SUMO city to loading runs and write its network.toml; return a
    report.

    The same call continues after an interruption.

    scenario: a scenario, or a network with a scenario of its name beside it; name or folder
    levels: factors on the demand of the loading runs
    seeds: loading runs per level, from seed 1000
    city: strategy options of the loading runs, such as "guided+max-pressure" or "own"; own, then
        guided, if None
    network: folder of the model; if None the scenario's network or, of guided drivers alone, its
        folder GUIDED
    protect: write the regions to protect into the scenario, those of the first model
    iterations: of the fit
    out: folder of samples, figures and loading runs, runs/SCENARIO-identify if None
    Raises: InputError for a network without a folder or one that must not be written, RunFailed if
    a run failed
    """
    loaded = load_scenario(scenario, settings)
    strategy = parse("no-control", None if city == "own" else city)
    options = [word for word in strategy.labels if word != "guided"]
    how: dict[str, Any] = {"levels": levels, "seeds": range(1000, 1000 + seeds), "options": options}
    how |= {"network": network, "iterations": iterations, "workers": workers}
    both = city is None and network is None and without_model(loaded)
    report: list[str] = []
    for guided in [False, True] if both else [strategy.guides]:
        loaded = load_scenario(
            scenario, settings
        )  # the second model takes the split ratios of the first
        folder = Path("runs") / f"{files.file_name(loaded.name)}-identify{'-guided' * guided}"
        if out is not None:
            folder = out / "guided" if both and guided else out
        with locked(folder), watched("identify", None) as show:
            report.append(
                _identify(
                    loaded,
                    guided=guided,
                    protect=protect and not report,
                    out=folder,
                    progress=show,
                    **how,
                )
            )
    return "\n".join(
        [*report, f"Next: cosim run {scenario} --controller pi-gating --against no-control"]
    )


def _identify(
    loaded: Scenario,
    *,
    levels: Sequence[float],
    seeds: Sequence[int],
    guided: bool,
    options: Sequence[str],
    network: Path | None,
    iterations: int,
    protect: bool,
    out: Path,
    workers: int,
    progress: Callable[..., None] | None,
) -> str:
    """Load a city, fit one regional model, and write its network.toml and verdict.txt; return the
    fit as text.

    guided: with route guidance, first towards the drivers' own split ratios, then probing
    options: words of the strategies, such as max-pressure
    """
    own = network_folder(loaded.network)
    target = network or (own / GUIDED if guided and not options and without_model(loaded) else own)
    if (guided or options) and target.resolve() == own.resolve():
        what = f"--with: {loaded.name} runs on {target}, the model of its own drivers and signals"
        raise InputError(f"{what}; name another folder with --network")
    if shipped.installed(target):
        shipped.beside(own, "network.toml", "another folder with --network")
    there = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):  # before hours of loading
        raise InputError(f"--network: {there} is no folder that can be written to; choose another")
    if protect:
        shipped.beside(loaded.folder or Path(), "scenario.toml", "a scenario of your own")
    stages = ("route-guidance", "probing-pcrg") if guided else ("no-control", "probing-pc")

    def load(stage: int, **setup: object) -> list[Result]:
        """Do the loading runs of a stage at all levels that are not finished; return all of
        them."""
        strategy, tables = parse("+".join([stages[stage], *options])), loaded.controller_options
        table = strategy.table(loaded)
        tuned = replace(
            loaded, controller_options={**tables, table: {**tables.get(table, {}), **setup}}
        )
        each = (
            runs_of(tuned, [strategy], seeds, demand=level, folder=f"level-{level:g}")
            for level in levels
        )
        runs = list(chain.from_iterable(each))
        show = _named(progress, f"loading runs {stage + 1} of 2; ")
        raise_failures(run_many(runs, out, workers=workers, progress=show))
        return [Result.read(out / run.file) for run in runs]

    first = load(0)
    static = static_model(loaded, first, guided=guided)
    second = load(1, set_point=tuple(static.mfds[region].critical for region in loaded.protected))
    runs = [*first, *second]

    def fitted(runs: Sequence[Result], samples: Sequence[dict]) -> RegionalModel:
        fitting, seen = _named(progress, "fitting, "), list(map(observed, runs))
        model = identification.fit(
            static, seen, iterations=iterations, progress=fitting, **loaded.scheme
        )
        return as_it_was(static, model, fit_quality.nearly_empty(samples))

    samples = outflow_samples(static, runs)
    model = fitted(runs, samples)
    states, city = [run.accumulation for run in runs], city_of(static)
    lane_km = np.bincount(city.edge_region, city.lane_metres, city.regions) / 1000.0
    model = fit_quality.with_guesses(
        model, samples, lane_km, states, fastest=loaded.substeps / loaded.step
    )
    fits = fit_quality.region_fits(model, samples, states, seeds=len(seeds), lane_km=lane_km)
    text, errors = fit_quality.fit_table(model, fits), None
    if len(seeds) > 1:  # the last seed is held out once
        kept = [run for run in runs if run.seed != seeds[-1]]
        without = replace(
            fitted(kept, outflow_samples(static, kept)), critical_above=model.critical_above
        )
        unseen = [observed(run) for run in runs if run.seed == seeds[-1]]
        errors = fit_quality.predictions(without, unseen, loaded.scheme)
        text += "\n".join(["", *wrapped(fit_quality.prediction_text(errors, loaded.step))])
    files.write_text(out / "fit.txt", text + "\n")
    fit_quality.write_fits(out / "fit.csv", fits, errors)
    clouds = (
        (i, branch, points) for i, cloud in enumerate(samples) for branch, points in cloud.items()
    )
    rows = [(i, branch, *point) for i, branch, points in clouds for point in points]
    table = pd.DataFrame(rows, columns=["region", "branch", "accumulation_veh", "outflow_veh_s"])
    files.write_table(out / "samples.csv", table, float_format="%.6g")
    plots.draw_mfds(out / "mfd.png", model, samples)
    model = replace(model, placeholder=False, doubts=tuple(fits["doubts"]))
    verdict = run_verdict(loaded, model, first)
    model = replace(model, controllable=verdict.boundaries.shares)
    under, times = (
        ", ".join(dict.fromkeys(run.controller for run in runs)),
        ", ".join(map("{:g}".format, levels)),
    )
    comment = f"Written by cosim identify from {len(runs)} runs of {loaded.name} under {under};\n"
    comment += f"# loading runs: demand times {times}, seeds {min(seeds)} to {max(seeds)}."
    sumo = config.read(own / "network.toml").get("sumo", {})
    sumo |= {
        key: files.relative(own / sumo[key], target)
        for key in PATHS
        if isinstance(sumo.get(key), str)
    }
    target.mkdir(parents=True, exist_ok=True)
    files.write_text(target / "network.toml", network_toml(model, sumo, comment))
    files.write_text(target / authority.FILE, verdict.text())
    proposed = _protected(loaded, verdict.protect, write=protect)
    where = f"Written to {os.path.normpath(target / 'network.toml')}; samples and figures to {out}"
    return "\n".join([text, *wrapped("\n".join([*verdict.sentences, *proposed])), where])


def _protected(scenario: Scenario, regions: tuple[int, ...], *, write: bool) -> list[str]:
    """Return the proposal to protect `regions`, unless the scenario does; if told to, write it.
    Raises InputError."""
    if not regions or set(regions) == set(scenario.protected):
        return []
    names, now = (
        ", ".join(scenario.network.titles[region] for region in regions),
        list(scenario.protected),
    )
    line, path = f"protected = {list(regions)}", Path(scenario.where)
    if write:
        text = path.read_text(encoding="utf-8")
        top, bracket, tables = text.partition("\n[")
        top, count = re.subn(r"(?m)^protected\s*=\s*\[[^\]]*\].*$", line, top)
        changed = (top if count else f"{top}\n{line}\n") + bracket + tables
        if tomllib.loads(changed) != tomllib.loads(text) | {"protected": list(regions)}:
            raise InputError(f"{path}: protected: cannot be changed here; write {line} yourself")
        files.write_text(path, changed)
    what = "was written there" if write else "with --protect it is written there"
    return [f"Protect {names}: {line} instead of {now} in {path}; {what}."]


def _named(progress: Callable[..., None] | None, stage: str) -> Callable[..., None] | None:
    """Return a progress function whose notes begin with the stage."""
    return progress and (lambda done, total, note="": progress(done, total, stage + note))


def static_model(scenario: Scenario, results: Sequence[Result], *, guided: bool) -> RegionalModel:
    """Return the network with fitted MFDs, and own split ratios unless guided. Raises InputError
    for empty runs."""
    network = replace(
        scenario.network, exit_rates=None, capacity=None, storage=None, critical_above={}
    )
    samples = outflow_samples(network, results)
    empty = fit_quality.nearly_empty(samples)
    if len(empty) == network.regions:
        raise InputError(
            "--levels: every region was nearly empty in all loading runs; give higher levels"
        )
    fastest, clouds = scenario.substeps / scenario.step, map(fit_quality.own_points, samples)
    mfds = (
        curve if n in empty else mfd.fit(*cloud.T, max_rate=fastest)
        for n, (curve, cloud) in enumerate(zip(network.mfds, clouds, strict=True))
    )
    network = replace(network, mfds=tuple(mfds))
    if guided:  # the reference of theta stays that of the plant (cosim.plant.guidance)
        return network
    crossings = sum(result["crossings"].sum(axis=0) for result in results)
    return replace(
        network, observed_split_ratios=identification.observed_split_ratios(network, crossings)
    )


def as_it_was(
    network: RegionalModel, model: RegionalModel, regions: Sequence[int]
) -> RegionalModel:
    """Return `model` with some regions as in `network`, because a fit to few vehicles does not
    extend to more."""
    alone = np.isin(np.arange(model.regions), regions)
    mfds = tuple((network if alone[n] else model).mfds[n] for n in range(model.regions))
    rates = np.where(alone[:, None], 1.0, model.exit_rates)
    storage = np.where(alone, np.maximum(model.storage, [mfd.jam for mfd in mfds]), model.storage)
    return replace(model, mfds=mfds, exit_rates=rates, storage=storage)


def run_verdict(
    scenario: Scenario, network: RegionalModel, results: Sequence[Result]
) -> authority.Verdict:
    """Judge from runs with open gateways whether perimeter control can help."""
    passed = sum(result["gateway_flow"].sum(axis=0, dtype=float) for result in results)
    reached = ~np.isnan(
        results[0]["gateway_original_green"][0]
    )  # NaN without a signal under control
    gateways = [
        (g.source, g.target, *of)
        for g, *of in zip(city_of(network).gateways, passed, reached, strict=True)
    ]
    boundaries = authority.Boundaries.of_gateways(network.regions, gateways)
    trip = sum(r.trips * r.mean_trip_time_s for r in results)
    lost = sum(
        r.trips * r.mean_departure_delay_s + r.departed_veh * r.mean_time_loss_s for r in results
    )
    started = np.sum([result["departures"].sum(axis=(0, 2)) for result in results], axis=0).astype(
        float
    )
    where = f"in {len(results)} loading run{'s' * (len(results) > 1)} under {results[0].controller}"
    return authority.verdict(
        network,
        boundaries,
        most=largest_accumulation(result.accumulation for result in results),
        started=started,
        waiting=max(float(result.backlog.sum(axis=(1, 2)).max()) for result in results),
        slowness=trip / (trip - lost) if trip > lost else np.nan,
        where=where,
        scenario=os.path.relpath(scenario.folder) if scenario.folder else scenario.name,
    )
