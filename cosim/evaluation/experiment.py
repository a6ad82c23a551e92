"""Closed-loop runs in SUMO, side by side: a run folder with table, records and pictures."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.evaluation import estimation_errors, run_metrics, signal_reasons
from cosim.evaluation.simulate import FACTS, Task, scenario_of, simulate
from cosim.plant import incidents
from cosim.plant.feasible import check_strategy
from cosim.plant.launch import own_files, own_vehicles
from cosim.plant.settings import FILES, PRESSURES, Settings, settings
from cosim.sumo import outputs
from cosim.sumo.build import ensure_built
from cosim.sumo.net import check_adjacency, load_city
from cosim.sumo.signals import HELD, read_signals
from cosim.sumo.xml_files import read_xml
from nmfd.controllers.strategy import parse
from nmfd.metrics import COUNTED, percent_change
from nmfd.model.scenario import Scenario
from nmfd.runs import run_folder
from nmfd.runs.files import file_hash, read_table, write_table
from nmfd.runs.tables import text_table
from nmfd.runs.tally import Progress, Tally
from nmfd.runs.workers import Failure, Source, attempt, ended, outcomes
from nmfd.studies.benchmark import REFERENCE, compared_with, draw_accumulations, interval
from nmfd.studies.traffic_states import OutflowOf, RegionalOutflow
from nmfd.types import Result

Outcomes = Iterator[tuple[Task, Result | Failure]]
MINUTE = 60.0
# Of loading runs: whether they guide routes, and so depend on the drivers' own split ratios.
CAPTION = (
    "TTS: total time spent, running and waiting to be inserted, mean over seeds ± 95 % interval; change: of the mean "
    "TTS against {against}; removed: taken out before the last edge of their route, in TTS as if they were there to "
    "the end; backlog: not inserted at the end; step: median / longest decision; outside SUMO: share of the wall time "
    "not in its own step"
)


def experiment(
    tasks: Sequence[Task],
    *,
    out: Path,
    workers: int = 1,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Run the tasks that are not yet in the run folder `out`; returns `overview` of all that is there.

    As `perform` does it; RunFailed at the end if runs failed.
    """
    zipped = any(kind == outputs.ZIPPED for task in tasks for kind, _ in task.sumo_output)
    failures = perform([(out, task) for task in tasks], workers=workers, fresh=zipped, progress=progress, tell=tell)
    if (out / "summary.csv").is_file() and (kept := run_folder.trajectories(out)):
        scenario = scenario_of(tasks[0])
        measured = measured_outflow(out)
        draw_accumulations(out, scenario, kept, outflow=measured)
        estimation_errors.write_errors(out, scenario.network, kept, measured)
    if failures:
        raise ended([(label(task), failure) for task, failure in failures])
    return overview(out)


def perform(
    plan: Sequence[tuple[Path, Task]],
    *,
    workers: int = 1,
    fresh: bool = False,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
    kept: Callable[[], object] | None = None,
    failed: Callable[[Task, str], None] | None = None,
    source: Source | None = None,
) -> list[tuple[Task, Failure]]:
    """Run every task, in this order, that is not yet in its run folder; returns those that failed, and why.

    The tasks of one folder share scenario, steps and demand. Every finished run is kept at once, whatever happens to
    the others. A kept run stays valid as long as the city, its demand and what its own controller depends on
    (`dependencies`) stay as they are.

    A run that was interrupted starts again from its beginning. SUMO's saved states are no way round that: they hold
    neither the vehicles that are not loaded yet, nor what perimeter control shows at the signals, nor what is known
    here of every vehicle (ledger, guidance, detectors) and in the controller; a run that was put together from all
    these would have to be proven the same to the byte, to save the minute or two that it takes.

    fresh: every run in a process of its own
    tell: takes one line where the runs of a controller do not count any more because it changed; None: an InputError
    kept: called after every run that was kept; failed: with every one that failed, and why
    source: runs the tasks elsewhere and gives their outcomes as they finish, instead of `workers` processes here

    Raises InputError, before anything is written, for a city or controller that cannot be made, and for a folder that
    holds runs of another city or demand.
    """
    where = {task: path for path, task in plan}
    settings_of = {
        path: shared_configuration([t for t in where if where[t] == path]) for path in dict.fromkeys(where.values())
    }
    failures = []
    with ExitStack() as stack:
        folders = {}
        for path, (configuration, controllers) in settings_of.items():
            tasks = [task for task in where if where[task] == path]
            folders[path] = stack.enter_context(
                run_folder.open_folder(
                    path,
                    configuration=configuration,
                    controllers=controllers,
                    order=[(task.controller, task.seed) for task in tasks],
                    renew=tell,
                    session={"scenario_folder": str(tasks[0].scenario), "workers": workers},
                )
            )
        there = {path: folder.finished for path, folder in folders.items()}
        todo = [
            task
            for task in where
            if (task.controller, task.seed) not in there[where[task]]
            or not all(file.is_file() for _, file in task.sumo_output)
        ]
        tally = _tally(todo, progress)
        found = _outcomes(todo, workers, fresh, tally) if source is None else source(simulate, todo)
        for task, outcome in found:
            tally.end(task, failed=isinstance(outcome, Failure))
            if isinstance(outcome, Failure):
                failures.append((task, outcome))
                if failed:
                    failed(task, outcome.reason)
                continue
            folder = folders[where[task]]
            _write_facts(folder, outcome)
            folder.add(outcome)
            if kept:
                kept()
    return failures


def level_folder(folder: Path, level: float) -> Path:
    """The run folder of a demand level, in the folder of a study."""
    return folder / f"demand-{level:g}"


def label(task: Task) -> str:
    """A task in words, for messages and progress."""
    demand = "" if task.demand_factor == 1.0 else f", demand times {task.demand_factor:g}"
    return f"controller {task.controller}, seed {task.seed}{demand}"


def dependencies(name: str, scenario: Scenario, policy: Path | None = None) -> dict:
    """Return what the runs of a strategy depend on besides the city and the demand. Raise InputError."""
    strategy = parse(name)
    strategy.make(scenario, policy)  # a mistake is reported before anything runs
    result = strategy.fingerprint(scenario, policy)
    return result | {"torch": metadata.version("torch")} if "model_hash" in result else result


def shared_configuration(tasks: Sequence[Task]) -> tuple[dict, dict]:
    """The configuration that the tasks of one folder share, and what each of their controllers depends on. Raises
    InputError for a city or controller that cannot be made."""
    first = tasks[0]
    scenario = scenario_of(first)
    controllers = {
        task.controller: dependencies(task.controller, scenario_of(task), task.policy)
        for task in {task.controller: task for task in tasks}.values()
    }
    chosen = settings(scenario)
    files = ensure_built(scenario.network)
    city = load_city(files.net_file, files.regions_csv, scenario.network.regions)
    check_adjacency(city, scenario.network)
    own_vehicles(scenario, chosen, city)
    used = {parse(name).city.get("signals", chosen.signals) for name in controllers}
    everywhere = not used.isdisjoint(PRESSURES)
    simple, _ = read_signals(city, own_files(scenario, chosen.additional), HELD)
    incidents.check(scenario.ordered_faults, city, "faults", [signal.id for signal in simple] if everywhere else ())
    for path in own_files(scenario, (*chosen.background, *chosen.additional)):
        read_xml(path)
    for name in controllers:
        check_strategy(name, scenario, city)
    configuration = {
        "scenario": scenario.name,
        "network": scenario.network.name,
        "plant": "sumo",
        "step_s": scenario.step,
        "steps": scenario.steps,
        "demand_factor": first.demand_factor,
        "demand_hash": hashlib.sha256(np.ascontiguousarray(scenario.demand).tobytes()).hexdigest()[:16],
        "net_file_hash": file_hash(files.net_file),
        "regions_hash": file_hash(files.regions_csv),
        "measurement_std_veh": scenario.measurement_std,
        "sumo": _plain(chosen, scenario),
        "libsumo": metadata.version("libsumo"),
        **({"faults": list(scenario.faults)} if scenario.faults else {}),
    }
    return configuration, controllers


def _plain(chosen: Settings, scenario: Scenario) -> dict:
    """The settings that are not the default ones; of the files that they name, fingerprints.

    Only these, so that a new kind of setting does not make old runs another city's.
    """
    found = chosen.model_dump(mode="json", exclude_defaults=True)
    hashes = {key: [file_hash(path) for path in own_files(scenario, found[key])] for key in FILES if key in found}
    return {**found, **hashes}


def _tally(todo: Sequence[Task], progress: Progress | None) -> Tally:
    """What tells of the tasks, in control intervals."""
    runs = todo if progress else ()
    scenarios = {
        key: scenario_of(Task(scenario=key[0], controller=REFERENCE, seed=0, steps=key[1]))
        for key in {(task.scenario, task.steps) for task in runs}
    }

    def of(task: Task) -> Scenario:
        return scenarios[task.scenario, task.steps]

    def at(task: Task, share: float) -> str:
        length = of(task).steps * of(task).step / MINUTE
        return f": {share * length:.0f} of {length:.0f} min"

    return Tally(
        progress,
        runs,
        steps=lambda task: of(task).steps,
        at=at,
        label=lambda task: label(task).removeprefix("controller "),
    )


def _outcomes(todo: Sequence[Task], workers: int, fresh: bool, tally: Tally) -> Outcomes:
    """(task, Result or Failure); in this process if one run is all there is, and not of a controller of the user's
    own."""
    if len(todo) != 1 or fresh or _apart(todo[0]):
        yield from outcomes(simulate, todo, workers, fresh=fresh, group=_apart, look=tally.look)
        return
    task = todo[0]
    yield task, attempt(lambda task: simulate(task, lambda k, steps: tally.look([(task, k / steps)])), task)


def _apart(task: Task) -> str:
    """The controller of the user's own, which has a process to itself, "" for others."""
    return task.controller if parse(task.controller).controller.own else ""


def read_run(folder: Path, controller: str, seed: int) -> Result:
    """Return a finished run of the run folder. Raises InputError."""
    return Result.read(run_folder.run_path(folder, controller, seed))


def measured_outflow(folder: Path) -> OutflowOf:
    """Return the outflow of every region in a run of the folder, as SUMO counted it (T, R) [veh/s]."""

    def outflow(result: Result) -> RegionalOutflow | None:
        return run_metrics.regional_outflow(read_run(folder, result.controller, result.seed), result.step)

    return outflow


def _write_facts(folder: run_folder.RunFolder, result: Result) -> None:
    path = folder.path / "sumo.csv"
    rows = read_facts(path) if path.is_file() else pd.DataFrame(columns=[*FACTS])
    same = (rows["controller"] == result.controller) & (rows["seed"] == result.seed)
    found = sorted(
        [
            *rows[~same].to_dict("records"),
            {name: result.data.attrs[name] for name in FACTS},
        ],  # not as they ended, which is chance
        key=lambda row: folder.position(row["controller"], row["seed"]),
    )
    rows = pd.DataFrame(found, columns=[*FACTS])
    write_table(path, rows)


def overview(folder: Path) -> pd.DataFrame:
    """summary.csv and sumo.csv joined, one row per finished run. Raises InputError."""
    return pd.DataFrame(run_folder.read_summary(folder / "summary.csv")).merge(
        read_facts(folder / "sumo.csv"), on=["controller", "seed"]
    )


def read_facts(path: Path) -> pd.DataFrame:
    """The rows of sumo.csv, with NaN for what an older version did not record. Raises InputError."""
    return read_table(path, {"controller": str, "seed": int}, "delete the folder and run again", columns=FACTS)


def overview_table(rows: pd.DataFrame) -> str:
    """The overview as text: one line per controller, means over seeds, TTS with its 95 % interval."""
    against = compared_with(rows["controller"]) if len(rows) else REFERENCE
    reference = rows.loc[rows["controller"] == against, "total_time_spent_veh_s"]
    lines = []
    for name, group in rows.groupby("controller", sort=False):
        tts = group["total_time_spent_veh_s"]
        spread = f" ± {interval(list(tts)):.1e}" if len(tts) > 1 else ""
        percent = percent_change(tts.mean(), reference.mean())
        change = "" if name == against else "-" if math.isnan(percent) else f"{percent:+.1f} %"
        lines.append(
            {
                "controller": name,
                "seeds": len(group),
                "TTS [veh s]": f"{tts.mean():.4g}{spread}",
                "change": change,
                "completed": f"{group['completed_veh'].mean():,.0f} of {group['trips'].mean():,.0f}",
                "removed": f"{group['removed_veh'].mean():,.0f}",
                "left inside": f"{group['final_accumulation_veh'].mean():,.0f}",
                "backlog": f"{group['final_backlog_veh'].mean():,.0f}",
                "teleports": int(group["teleports"].sum()),
                "step [ms]": f"{group['control_step_ms_median'].mean():.3g} / {group['control_step_ms_max'].max():.3g}",
                **{heading: int(group[column].sum()) for column, (heading, _) in COUNTED.items()},
                "wall [s]": f"{group['wall_time_s'].mean():.0f}",
                "outside SUMO": f"{100 * group['overhead_share'].mean():.1f} %",
            }
        )
    return "\n".join([text_table(lines, CAPTION.format(against=against)), *signal_reasons.losses(rows), *remarks(rows)])


def remarks(rows: pd.DataFrame) -> list[str]:
    """A line for every controller whose policy was run outside of what it was trained on."""
    if "outside_training" not in rows:  # of an older version
        return []
    said = rows[rows["outside_training"].astype(object).fillna("") != ""]
    return [
        f"{name}: {text}"
        for name, text in dict.fromkeys(zip(said["controller"], said["outside_training"], strict=True))
    ]
