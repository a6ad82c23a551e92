"""Closed-loop runs in SUMO, side by side: a run folder with table, records and pictures."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.city import ensure_built
from cosim.plant import Settings, settings
from cosim.regions import check_adjacency, load_city
from cosim.simulate import FACTS, Result, Task, scenario_of, simulate
from nmfd import runs
from nmfd.benchmarks import REFERENCE, draw_accumulations, interval
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.mfd import Mfd
from nmfd.scenario import Scenario
from nmfd.workers import Failure, RunFailed, attempt, outcomes

CAPTION = (
    "TTS: total time spent, running and waiting to be inserted, mean over seeds ± 95 % interval; backlog: not\n"
    "inserted at the end; step: median / longest decision; outside SUMO: share of the wall time not in its own step")


def experiment(
    tasks: Sequence[Task], *, out: Path, workers: int = 1, progress: Callable[[int, int, str], None] | None = None,
    model_free: bool = False,
) -> pd.DataFrame:
    """Run the tasks that are not yet in the run folder `out`; returns `overview` of all that is there.

    model_free: the runs do not depend on the regional model (no control), and stay valid when its MFDs change.
    The tasks share scenario, steps and demand. Every finished run is kept, whatever happens to the others.
    progress: called with what is done and to do, and what is running. Raises InputError, before anything is written,
    for a city or controller that cannot be made; RunFailed at the end if runs failed.
    """
    first = tasks[0]
    scenario = scenario_of(first)
    controllers = {}
    for task in tasks:
        registry.make(task.controller, scenario, policy=task.policy)
        policy = registry.policy_path(task.controller, scenario, task.policy)
        controllers[task.controller] = {} if policy is None else {"policy_hash": runs.file_hash(policy)}
    files = ensure_built(scenario.network)
    check_adjacency(load_city(files.net_file, files.regions_csv, scenario.network.regions), scenario.network)
    model = _without_model(scenario) if model_free else scenario
    configuration = {
        "scenario": scenario.name, "scenario_hash": runs.scenario_hash(model), "network": scenario.network.name,
        "network_hash": model.network.hash, "net_file_hash": runs.file_hash(files.net_file), "plant": "sumo",
        "step_s": scenario.step, "steps": scenario.steps, "demand_factor": first.demand_factor,
        "sumo": _plain(settings(scenario), scenario.folder)}
    order = [(task.controller, task.seed) for task in tasks]
    session = {"scenario_folder": str(first.scenario), "workers": workers}
    with runs.open_folder(
            out, configuration=configuration, controllers=controllers, order=order, session=session) as folder:
        finished = {run for run in folder.finished if record_path(folder.path, *run).is_file()}
        todo = [task for task in tasks if (task.controller, task.seed) not in finished]
        failures = []
        for task, outcome in _outcomes(todo, workers, scenario.steps, progress):
            if isinstance(outcome, Failure):
                failures.append(f"controller {task.controller}, seed {task.seed}: {outcome.reason}")
            else:
                write_record(record_path(folder.path, task.controller, task.seed), outcome)
                folder.add(outcome.trajectory)
                _write_facts(folder, outcome)
        if folder.finished:
            draw_accumulations(folder.path, scenario, folder.trajectories())
        if failures:
            raise RunFailed("; ".join(failures))
    return overview(out)


def _plain(chosen: Settings, folder: Path | None) -> dict:
    """The settings, of the files they name fingerprints; without those of a city's own vehicles where it has none."""
    if not chosen.routes:
        return {key: value for key, value in vars(chosen).items() if key not in ("begin", "departure_jitter") and (
            value != ())}
    return vars(chosen) | {
        key: [runs.file_hash(folder / name) for name in getattr(chosen, key)]
        for key in ("routes", "background", "additional")}


def _without_model(scenario: Scenario) -> Scenario:
    """The scenario with an arbitrary regional model and no controller options."""
    network = scenario.network
    mfds = (Mfd(a=0.0, b=0.0, c=1e-3, jam=1.0),) * network.regions
    return replace(scenario, controller_options={}, network=replace(network, mfds=mfds, own_splits={}))


def _outcomes(todo: Sequence[Task], workers: int, steps: int, progress) -> Iterator[tuple]:
    """(task, Result or Failure); in this process, which reports every control interval, if one run is all there is."""
    report = progress or (lambda done, total, note: None)
    if len(todo) == 1:
        def tick(k, _):
            report(k, steps, f"{todo[0].controller}, seed {todo[0].seed}")

        yield todo[0], attempt(lambda task: simulate(task, tick), todo[0])
        return
    report(0, len(todo), "")
    for done, (task, outcome) in enumerate(outcomes(simulate, todo, workers), start=1):
        report(done, len(todo), f"last {task.controller}, seed {task.seed}")
        yield task, outcome


def record_path(folder: Path, controller: str, seed: int) -> Path:
    return folder / f"{controller}-{seed}.record.npz"


def write_record(path: Path, result: Result) -> None:
    """The fields of cosim.plant.Record, atomically."""
    with runs.atomic(path) as temporary:
        np.savez_compressed(temporary, **result.record)


def read_run(folder: Path, controller: str, seed: int) -> Result:
    """A finished run of the run folder. Raises InputError."""
    path = record_path(folder, controller, seed)
    try:
        with np.load(path, allow_pickle=False) as file:
            record = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such run; choose a controller and seed of {folder / 'sumo.csv'}") from None
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: is no record of a run ({error}); delete it and run again") from None
    trajectory = runs.read_trajectory(folder / f"{controller}-{seed}.npz")
    return Result(trajectory=trajectory, record=record, facts={})


def _write_facts(folder: runs.RunFolder, result: Result) -> None:
    path = folder.path / "sumo.csv"
    rows = pd.read_csv(path) if path.is_file() else pd.DataFrame(columns=FACTS)
    same = (rows["controller"] == result.facts["controller"]) & (rows["seed"] == result.facts["seed"])
    rows = pd.DataFrame([*rows[~same].to_dict("records"), result.facts], columns=FACTS)
    with runs.atomic(path) as temporary:
        rows.to_csv(temporary, index=False)


def overview(folder: Path) -> pd.DataFrame:
    """summary.csv and sumo.csv joined, one row per finished run. Raises InputError."""
    return pd.DataFrame(runs.read_summary(folder / "summary.csv")).merge(
        pd.read_csv(folder / "sumo.csv"), on=["controller", "seed"])


def table(rows: pd.DataFrame) -> str:
    """The overview as text: one line per controller, means over seeds, TTS with its 95 % interval."""
    reference = rows.loc[rows["controller"] == REFERENCE, "total_time_spent_veh_s"]
    lines = []
    for name, group in rows.groupby("controller", sort=False):
        tts = group["total_time_spent_veh_s"]
        spread = f" ± {interval(list(tts)):.1e}" if len(tts) > 1 else ""
        change = f"{100 * (tts.mean() / reference.mean() - 1):+.1f} %" if len(reference) and name != REFERENCE else ""
        lines.append({
            "controller": name, "seeds": len(group), "TTS [veh s]": f"{tts.mean():.4g}{spread}", "change": change,
            "completed": f"{group['completed_veh'].mean():,.0f} of {group['trips'].mean():,.0f}",
            "left inside": f"{group['final_accumulation_veh'].mean():,.0f}",
            "backlog": f"{group['final_backlog_veh'].mean():,.0f}", "teleports": int(group["teleports"].sum()),
            "step [ms]": f"{group['control_step_ms_median'].mean():.3g} / {group['control_step_ms_max'].max():.3g}",
            "failures": int(group["solver_failures"].sum()),
            "wall [s]": f"{group['wall_time_s'].mean():.0f}",
            "outside SUMO": f"{100 * group['overhead_share'].mean():.1f} %"})
    return pd.DataFrame(lines).to_string(index=False) + "\n" + CAPTION
