"""The benchmark: controllers x seeds on a regional plant, with a table and the paper's figures."""

import math
import statistics
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from scipy.special import stdtrit

from nmfd import closed_loop, faults
from nmfd.controllers import registry
from nmfd.model.demand_noise import perturbed
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.model.scenario import Scenario
from nmfd.runs import run_folder
from nmfd.runs.tally import Tally
from nmfd.runs.workers import Failure, Source, Worker, attempt, ended, outcomes
from nmfd.studies import plots
from nmfd.studies.traffic_states import OutflowOf, model_outflow, remembered
from nmfd.types import Plant, Result

PLANTS: dict[str, Callable[[Scenario], Plant]] = {"nmfd": NmfdPlant, "acyclic": AcyclicPlant}
REFERENCE = "no-control"


class Noise(NamedTuple):
    """On the demand (nmfd.model.demand_noise), drawn from the seed of a run: its standard deviation [veh/s]."""

    sigma: float
    where: str


def compared_with(controllers: Iterable[str]) -> str:
    """What controllers are compared with: no control, or the first of them where that is not among them."""
    names = list(controllers)
    return REFERENCE if REFERENCE in names else names[0]


def run_one(
    run: tuple[str, int],
    *,
    scenario: Scenario,
    plant: str,
    policies: Mapping[str, Path],
    noise: Noise | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """The closed loop of `run` = (controller, seed), on one thread; the controller knows nothing of the `noise`."""
    name, seed = run
    controller, actual = registry.make(name, scenario, policy=policies.get(name)), happening(scenario, noise, seed)
    trajectory = closed_loop.run(PLANTS[plant](actual), controller, actual, seed=seed, progress=progress)
    return run_folder.labelled(trajectory, controller=name, plant=plant)


def happening(scenario: Scenario, noise: Noise | None, seed: int) -> Scenario:
    """What happens in the run of `seed`, where controllers are made for `scenario`."""
    return scenario if noise is None else perturbed(scenario, noise.sigma, seed, where=noise.where)


def run_all(
    scenario: Scenario,
    controllers: Sequence[str],
    seeds: Sequence[int],
    plant: str,
    *,
    out: Path,
    policies: Mapping[str, Path] | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
    """Run what is not yet in the run folder `out`, add the figures, and return all rows of its summary.csv.

    As `perform` does it; RunFailed, or an InputError, at the end if runs failed, which the message names.
    """
    rows, failures = perform(
        scenario, controllers, seeds, plant, out=out, policies=policies, workers=workers, progress=progress
    )
    if rows:
        kept = [run_folder.run_path(out, row["controller"], row["seed"]) for row in rows]
        draw(out, scenario, [run_folder.read_trajectory(path) for path in kept if path.is_file()])
    if failures:
        raise ended([(f"controller {_label(run)}", failure) for run, failure in failures])
    return rows


def perform(
    scenario: Scenario,
    controllers: Sequence[str],
    seeds: Sequence[int],
    plant: str,
    *,
    out: Path,
    policies: Mapping[str, Path] | None = None,
    noise: Noise | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
    renew: Callable[[str], None] | None = None,
    source: Source | None = None,
    omit: Collection[tuple[str, int]] = (),
) -> tuple[list[dict], list[tuple[tuple[str, int], Failure]]]:
    """Run what is not yet in the run folder `out`; returns all rows of its summary.csv, and the runs that failed.

    progress: called with the control intervals done and to do, and what is running
    renew: takes one line where the runs of a controller do not count any more because it changed; None: an InputError
    source: does the runs elsewhere, instead of `workers` processes here
    omit: controllers and seeds that are not run

    Raises InputError, before anything is written, for a controller that cannot be made. Every finished run is kept,
    whatever happens to the others.
    """
    policies = policies or {}
    for name in controllers:
        registry.verify(name, scenario, policy=policies.get(name))
    common, settings = configuration(scenario, controllers, plant, policies)
    if noise is not None:
        common["demand_noise"] = noise._asdict()
    wanted = [(name, seed) for name in controllers for seed in seeds]
    session = {"scenario_folder": str(scenario.folder), "workers": workers}
    with run_folder.open_folder(
        out, configuration=common, controllers=settings, order=wanted, session=session, renew=renew
    ) as folder:
        todo = [run for run in wanted if run not in folder.finished and run not in omit]
        failures = []
        work = partial(run_one, scenario=scenario, plant=plant, policies=policies, noise=noise)
        for run, outcome in results(work, todo, workers, scenario.steps, progress, label=_label, source=source):
            if isinstance(outcome, Failure):
                failures.append((run, outcome))
            else:
                folder.add(outcome)
        return folder.rows(), failures


def configuration(
    scenario: Scenario, controllers: Sequence[str], plant: str, policies: Mapping[str, Path]
) -> tuple[dict, dict]:
    """What all runs have in common, and what each controller depends on besides. InputError for a fault that the
    regional model cannot have."""
    faults.without_city(scenario.ordered_faults, f"{scenario.name}: faults")
    settings = {}
    for name in controllers:
        policy = registry.policy_path(name, scenario, policies.get(name))
        settings[name] = registry.fingerprint(name, policy)
    common = {
        "scenario": scenario.name,
        "scenario_hash": scenario.hash,
        "network": scenario.network.name,
        "network_hash": scenario.network.hash,
        "plant": plant,
        "step_s": scenario.step,
        "steps": scenario.steps,
        "measurement_std_veh": scenario.measurement_std,
    }
    return common, settings


def _label(run: tuple[str, int]) -> str:
    return f"{run[0]}, seed {run[1]}"


def results(
    work: Callable,
    todo: Sequence[tuple],
    workers: int,
    steps: int,
    progress: Callable[[int, int, str], None] | None,
    *,
    label: Callable[..., str],
    source: Source | None = None,
) -> Iterator[tuple]:
    """(run, result or Failure) of every run, in this process if there is one worker; those of controllers of the
    user's own in processes of their own.

    work(run), or work(run, progress=...) in this process, is one closed loop of `steps` control intervals; progress
    as in `benchmark`, with the `label` of the run; source: as in `perform`.
    """
    tally = Tally(progress, todo, steps=lambda run: steps, label=label)
    if source or workers > 1:
        found = (
            source(work, todo)
            if source
            else outcomes(work, todo, min(workers, len(todo)), group=_apart, look=tally.look)
        )
        for run, outcome in found:
            tally.end(run, failed=isinstance(outcome, Failure))
            yield run, outcome
        return
    apart: dict[str, Worker] = {}
    try:
        for run in todo:

            def tick(k: int, _: int, run: tuple = run) -> None:
                tally.look([(run, k / steps)])

            if name := _apart(run):
                tick(0, steps)
                if name not in apart or not apart[name].alive:
                    apart[name] = Worker(work)
                apart[name].hand(run)
                outcome = apart[name].receive()
            else:
                outcome = attempt(partial(work, progress=tick), run)
            tally.end(run, failed=isinstance(outcome, Failure))
            yield run, outcome
    finally:
        for worker in apart.values():
            worker.terminate()
            worker.close()


def _apart(run: tuple) -> str:
    """The controller of the user's own, which has a process to itself, "" for others; run: (controller, ...), or with a
    field of that name."""
    name = getattr(run, "controller", run[0])
    return name if registry.runs_apart(name) else ""


def draw(folder: Path, scenario: Scenario, trajectories: Sequence[Result]) -> None:
    """The paper's figures of `trajectories` and of their scenario, as png files in `folder`."""
    draw_accumulations(folder, scenario, trajectories)
    draw_scenario(folder, scenario)


def draw_accumulations(
    folder: Path,
    scenario: Scenario,
    trajectories: Sequence[Result],
    *,
    seed: int | None = None,
    title: str | None = None,
    outflow: OutflowOf | None = None,
) -> None:
    """Total and regional accumulation over time, as png files in `folder`.

    seed: shown instead of the mean over seeds; title: above both pictures; outflow: what left every region of a run,
    where it was measured; else that of the regional model, of runs on it.
    """
    drawing = plots.figure(8.0, 4.6)
    ax = plots.total_accumulation(drawing.subplots(), trajectories, seed)
    drawing.suptitle(title, fontsize="medium")
    plots.legend_below(drawing, [ax], columns=6)
    plots.save(drawing, folder / "total_accumulation.png")
    network = scenario.network
    outflow = remembered(outflow or model_outflow(network))
    drawing, axes = plots.panels(network.regions)
    for region, ax in enumerate(axes):
        plots.region_accumulation(ax, network, region, trajectories, seed, outflow)
    drawing.suptitle(title, fontsize="medium")
    plots.legend_below(drawing, axes, columns=3)
    plots.save(drawing, folder / "region_accumulation.png")


def draw_scenario(folder: Path, scenario: Scenario) -> list[Path]:
    """Spawn matrix, region map and MFDs of `scenario`, as png files in `folder`."""
    network = scenario.network
    drawing = plots.figure(11.0, 4.8)
    left, right = drawing.subplots(1, 2)
    plots.spawn_matrix(left, scenario)
    plots.demand(right, scenario)
    plots.legend_below(drawing, [right])
    files = [plots.save(drawing, folder / "spawn_matrix.png")]
    drawing = plots.figure(5.5, 5.0)
    plots.region_map(drawing.subplots(), network)
    files.append(plots.save(drawing, folder / "region_map.png"))
    kinds: dict = {}
    for region, mfd in enumerate(network.mfds):
        kinds.setdefault(mfd, []).append(region)
    drawing, axes = plots.panels(len(kinds))
    for ax, (mfd, regions) in zip(axes, kinds.items(), strict=True):
        plots.mfd(ax, mfd)
        ax.set_title("region " + ", ".join(map(str, regions)) if len(kinds) > 1 else "every region", fontsize="medium")
    plots.legend_below(drawing, axes)
    files.append(plots.save(drawing, folder / "mfd.png"))
    return files


def interval(values: Sequence[float]) -> float:
    """Half of the 95 % interval of the mean of `values` (Student's t); NaN of a single one, or where one is NaN."""
    if len(values) < 2 or any(map(math.isnan, values)):
        return math.nan
    return float(stdtrit(len(values) - 1, 0.975)) * statistics.stdev(values) / math.sqrt(len(values))
