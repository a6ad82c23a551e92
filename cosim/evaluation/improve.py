"""Improvement: a DPC policy that learns from the city it drives.

    <folder>/improve.csv       one row per round: score, all runs, what the model made of the policy, whether it is kept
    <folder>/policy.pt         the best policy so far
    <folder>/model/            the regional model that it belongs to
    <folder>/round-<n>/        policy, model and run folders of a round, one per demand level

Round 0 runs the policy as it is. Every later round fits the regional model to all runs so far, descends from the best
policy along this policy's own runs (nmfd.controllers.dpc.replay), and runs what comes of it with the same seeds: it is
kept if the geometric mean of the total time spent over seeds and demand levels falls. After a round that was not kept
the next one takes half as many steps.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.evaluation import dask_cluster, experiment, scores
from cosim.evaluation.identify import finished, fitted_to, followed, samples_of
from cosim.evaluation.scores import SCORE
from cosim.evaluation.simulate import Result, Task, scenario_of
from cosim.plant.strategy import configured, parse
from nmfd.controllers import registry
from nmfd.controllers.dpc import fallback, policy_file, training
from nmfd.controllers.dpc.replay import Replays, Run, descend
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.errors import InputError
from nmfd.model import identification
from nmfd.model.model_file import network_toml
from nmfd.model.planning import PlanningModel, planning_model
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_table
from nmfd.runs.workers import ended
from nmfd.threads import one_thread

HALF, FEWEST = 0.5, 2  # of the Adam steps after a round that was not kept; in any round
REPLAYED, FORESEEN = "replayed_veh_s", "foreseen_veh_s"  # of the best policy before and of the new one, by the model


@dataclass(frozen=True, kw_only=True)
class Improvement:
    """scenario: its folder; controller: a DPC strategy; rounds: after round 0; seeds, levels: of the runs of each;
    descent: Adam steps of the first round; learning_rate: of Adam, that of the controller's training if None;
    iterations: of the fit, 0 for the model as it is; policy: what round 0 runs, the scenario's own if None; runs:
    folders of finished runs of the same city, which the model is fitted to besides; steps: control intervals, all if
    None; out: the folder."""

    scenario: Path
    controller: str
    rounds: int
    seeds: Sequence[int]
    out: Path
    levels: tuple[float, ...] = (1.0,)
    descent: int = 40
    learning_rate: float | None = None
    iterations: int = identification.ITERATIONS
    policy: Path | None = None
    runs: Sequence[Path] = ()
    steps: int | None = None

    def folder(self, number: int) -> Path:
        """Of one round."""
        return self.out / f"round-{number:02d}"

    def model(self, number: int) -> Path | None:
        """The folder of the model that is fitted in a round; None where it is the controller's own."""
        return self.folder(number) / "model" if number and self.iterations else None

    def task(self, number: int, level: float = 1.0, seed: int = 0) -> Task:
        """One run of a round."""
        model = self.model(number)
        return Task(
            scenario=self.scenario,
            controller=self.controller,
            seed=seed,
            steps=self.steps,
            demand_factor=level,
            policy=self.folder(number) / "policy.pt" if number else self.policy,
            options=() if model is None else (("model", str(model.absolute())),),
        )

    def plan(self, number: int) -> list[tuple[Path, Task]]:
        """The runs of a round, each with its run folder."""
        return [
            (experiment.level_folder(self.folder(number), level), self.task(number, level, seed))
            for seed in self.seeds
            for level in self.levels
        ]

    @property
    def variant(self) -> str:
        """The controller whose options and policy the strategy uses."""
        return configured(self.controller, scenario_of(self.task(0)).controller_options)

    def planning(self, number: int) -> PlanningModel:
        """What the policy of a round knows."""
        return planning_model(scenario_of(self.task(number)), self.variant)

    def file(self, number: int) -> Path:
        """The policy that is run in a round. InputError if there is none."""
        task = self.task(number)
        found = registry.policy_path(self.variant, scenario_of(task), task.policy)
        assert found is not None  # every DPC controller has one
        return found

    def results(self, number: int) -> list[Result]:
        """The finished runs of a round."""
        return [experiment.read_run(folder, self.controller, task.seed) for folder, task in self.plan(number)]


def check(order: Improvement) -> None:
    """InputError for what cannot be improved, before anything is run."""
    if parse(order.controller).controller not in training.NAMES:
        raise InputError(
            f"--controller: {order.controller!r} has no policy that learns; choose one of "
            f"{', '.join(training.NAMES)}, with what else the city does"
        )
    scenario = scenario_of(order.task(0))
    training.settings(scenario, order.variant)
    registry.verify(order.variant, scenario, policy=order.policy)


def improve(
    order: Improvement,
    *,
    workers: int = 1,
    scheduler: dask_cluster.Scheduler | str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Run the rounds; returns the table of improve.csv.

    Every run is kept: the same call goes on where it was interrupted, with more `rounds` from where it ended. Runs on
    `workers` processes, or on those of a Dask `scheduler`; the model is fitted and the policy descends here. Raises
    InputError, and RunFailed if a run failed: a policy is judged by all of its runs.
    """
    check(order)
    more = [run for folder in order.runs for run in finished(folder, order.scenario)]
    source, rows = dask_cluster.source(scheduler, tell), list[dict[str, object]]()
    file = order.out / "improve.csv"
    with run_folder.manifest(
        order.out,
        configuration=_configuration(order),
        results=file,
        session={"scenario_folder": str(order.scenario), "workers": workers},
    ):
        for number in range(order.rounds + 1):
            about = _prepared(order, rows, more, progress) if number else {}
            failures = experiment.perform(
                order.plan(number),
                workers=workers,
                fresh=True,
                source=source,
                tell=tell,
                progress=_of_round(order, number, progress),
            )
            if failures:
                raise ended([(experiment.label(task), failure) for task, failure in failures])
            rows.append(_row(order, rows, about))
            files.write_table(file, pd.DataFrame(rows))
            if rows[-1]["kept"]:
                _publish(order, number)
    return pd.DataFrame(rows)


def best(rows: Sequence[dict]) -> int:
    """The last round that was kept."""
    return max(int(row["round"]) for row in rows if row["kept"])


def text(order: Improvement, table: pd.DataFrame) -> str:
    """For the terminal: one line per round."""
    first = float(table[SCORE].iloc[0])
    return text_table(
        [
            {
                "round": row["round"],
                "kept": "yes" if row["kept"] else "no",
                "mean TTS [veh s]": f"{row[SCORE]:.4g}",
                "change": f"{100.0 * (row[SCORE] / first - 1.0):+.1f} %",
                "foreseen": ""
                if math.isnan(row[FORESEEN])
                else f"{100.0 * (row[FORESEEN] / row[REPLAYED] - 1.0):+.1f} %",
                **{
                    f"at {level:g}": f"{np.mean([row[scores.column(level, seed)] for seed in order.seeds]):.4g}"
                    for level in order.levels
                },
            }
            for row in table.to_dict("records")
        ],
        "mean TTS: geometric mean over all runs; change: against round 0; foreseen: by the model, against the policy "
        "that the round began with; at: arithmetic mean at that demand level",
    )


def _of_round(order: Improvement, number: int, progress: experiment.Progress | None) -> experiment.Progress | None:
    """`progress` of the runs of a round, among all rounds."""
    return progress and (
        lambda done, total, note: progress(
            number * total + done, (order.rounds + 1) * total, f"round {number} of {order.rounds}; {note}"
        )
    )


def _prepared(
    order: Improvement, rows: Sequence[dict], more: Sequence[Result], progress: experiment.Progress | None
) -> dict[str, float]:
    """Make model and policy of the next round, unless they are there; returns what the model made of the policy."""
    number, folder = len(rows), order.folder(len(rows))
    note = folder / "descent.csv"
    if not note.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        if model := order.model(number):
            _fit(order, model, [run for n in range(number) for run in order.results(n)] + list(more), progress)
        taken = sum(not row["kept"] for row in rows)
        path = _descend(order, number, best(rows), max(round(order.descent * HALF**taken), FEWEST))
        files.write_table(note, pd.DataFrame({"step": range(len(path)), "replays_veh_s": path}))
    path = pd.read_csv(note)["replays_veh_s"]
    return {REPLAYED: float(path.iloc[0]), FORESEEN: float(path.iloc[-1])}


def _fit(order: Improvement, folder: Path, runs: Sequence[Result], progress: experiment.Progress | None) -> None:
    """Write the model that predicts `runs` best, from the one that round 0 knows, to `folder`."""
    planning = order.planning(0)
    network = planning.network

    def told(done: int, total: int, note: str) -> None:
        if progress is not None:
            progress(done, total, f"fitting the model to {len(runs)} runs; {note}")

    model = fitted_to(
        network,
        [followed(network, run) for run in runs],
        samples_of(network, runs),
        planning,
        iterations=order.iterations,
        progress=told if progress else None,
    )
    folder.mkdir(exist_ok=True)
    files.write_text(
        folder / "network.toml",
        network_toml(
            model,
            {},
            f"Regional model: fitted by cosim improve to {len(runs)} runs of {planning.name} under {order.controller}.",
        ),
    )


def _descend(order: Improvement, number: int, begin: int, steps: int) -> list[float]:
    """Write the policy of a round, from that of round `begin` along its runs; TTS of the replays before every step."""
    planning = order.planning(number)
    began, content = policy_file.load_policy(order.file(begin), order.planning(begin).network)
    policy = policy_file.new_policy(planning.network, began.architecture)
    policy.load_state_dict(began.state_dict())
    chosen = training.settings(scenario_of(order.task(begin)), order.variant)
    rollout = Rollout(planning, detour_cost=chosen.detour_cost, swing_cost=chosen.swing_cost)
    results = order.results(begin)
    with one_thread():
        replays = Replays(rollout, policy, [_run(result, waits=began.architecture.metering) for result in results])
        path = descend(policy, replays, steps=steps, learning_rate=order.learning_rate or chosen.learning_rate)
    states = np.concatenate([result.trajectory.accumulation for result in results]) / policy.scale.numpy()
    low, high = (content["configuration"].get(key, 1.0) for key in ("demand_low", "demand_high"))
    configuration = {
        **content["configuration"],
        "improved": number,
        "demand_low": min(low, *order.levels),
        "demand_high": max(high, *order.levels),
    }
    training.write(
        policy_file.checkpoint(
            policy, planning.network, configuration, fallback.statistics(states.reshape(len(states), -1))
        ),
        order.folder(number) / "policy.pt",
    )
    return path


def _run(result: Result, *, waits: bool) -> Run:
    """A run as it is replayed. waits: whether the policy says who enters, of those who want to."""
    trajectory = result.trajectory
    entered = result.record["departures"] / trajectory.step
    wanted = entered + np.diff(trajectory.backlog, axis=0) / trajectory.step
    return Run(accumulation=trajectory.accumulation, demand=np.clip(wanted, 0.0, None) if waits else entered)


def _row(order: Improvement, rows: Sequence[dict], about: dict[str, float]) -> dict[str, object]:
    number = len(rows)
    found = scores.totals(order.folder(number), order.levels, order.seeds)
    score = scores.score(found.values())
    kept = not rows or score < min(row[SCORE] for row in rows)
    return {"round": number, "kept": kept, SCORE: score, REPLAYED: math.nan, FORESEEN: math.nan, **about, **found}


def _publish(order: Improvement, number: int) -> None:
    """The best policy and its model, where they are looked for."""
    with files.atomic(order.out / "policy.pt") as temporary:
        shutil.copyfile(order.file(number), temporary)
    planning = order.planning(number)
    (order.out / "model").mkdir(exist_ok=True)
    files.write_text(
        order.out / "model" / "network.toml",
        network_toml(planning.network, {}, f"Regional model of {order.controller}, round {number} of cosim improve."),
    )


def _configuration(order: Improvement) -> dict[str, object]:
    """What the folder is for."""
    return {
        "improve": order.controller,
        "scenario": scenario_of(order.task(0)).name,
        "seeds": list(order.seeds),
        "levels": list(order.levels),
        "descent": order.descent,
        "learning_rate": order.learning_rate,
        "iterations": order.iterations,
        "policy_hash": files.file_hash(order.file(0)),
        "model_hash": order.planning(0).network.hash,
        "runs": [str(folder) for folder in order.runs],
        "steps": order.steps,
    }
