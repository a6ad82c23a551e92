"""How much there is to win: the best schedule that a direct search finds for a controller, knowing the seed.

    <folder>/bound.csv                       one row per demand level and seed
    <folder>/demand-<level>-seed-<n>/        a search (cosim.evaluation.tuning), its schedules in tune.csv
    <folder>/against/                        run folders of the rival, one per demand level

A schedule (nmfd.controllers.scheduled) is added to what the controller commands: to its gates, its prices, its rates of
metering, at knots over the horizon. It is searched by CMA-ES on one run of SUMO, whose trips and drivers are the same
every time: what comes of it is good for that one day, and nobody could have known. Luck is part of it: of many runs
that small changes make different the best one counts. So it says what was possible, not what a controller could reach;
and not what the best possible is, for the search is short and the schedules are few numbers.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from cosim.evaluation import dask_cluster, experiment, tuning
from cosim.evaluation.scores import SCORE
from cosim.evaluation.simulate import Task
from cosim.evaluation.statistics import TTS
from cosim.plant.strategy import configured
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.controllers.scheduled import CHANNELS, channels
from nmfd.errors import InputError
from nmfd.metrics import percent_change
from nmfd.model.planning import planning_model
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_table
from nmfd.runs.workers import ended

# The most that is added either way; of CMA-ES's first generation a tenth of the range is one standard deviation.
RANGES = dict(zip(CHANNELS, (0.5, 2.0, 1.0), strict=True))
FIRST_STEP = 0.1
FOUND, FIRST, RIVAL = "bound_veh_s", "controller_veh_s", "against_veh_s"
ROOM, USED = "room_pct", "used_pct"


@dataclass(frozen=True, kw_only=True)
class Bound:
    """scenario: its folder; controller: a strategy; against: another one, or None; candidates: schedules per search,
    the first without any; knots: numbers of every channel; seeds, levels: each pair has a search; search_seed: of
    CMA-ES; steps: control intervals, all if None; out: the folder."""

    scenario: Path
    controller: str
    seeds: Sequence[int]
    out: Path
    candidates: int
    knots: int
    against: str | None = None
    levels: tuple[float, ...] = (1.0,)
    search_seed: int = 0
    steps: int | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """What of the controller has a schedule. InputError for a controller that cannot be made."""
        scenario = load_scenario(self.scenario)
        variant = configured(self.controller, scenario.controller_options)
        if registry.is_own(registry.split(variant)[0]):
            raise InputError(
                f"--controller: {self.controller!r} is a controller of your own, and a schedule can be added to those "
                "that are built in only; choose one of these"
            )
        return channels(registry.make(variant, scenario), planning_model(scenario, variant))

    def search(self, level: float, seed: int, used: Sequence[str]) -> "Search":
        """The search of one seed and demand level, over the channels `used`."""
        return Search(
            scenario=self.scenario,
            controller=self.controller,
            candidates=self.candidates,
            seeds=(seed,),
            levels=(level,),
            search_seed=self.search_seed,
            steps=self.steps,
            first_step=FIRST_STEP,
            out=self.out / f"demand-{level:g}-seed-{seed}",
            knobs=tuple(
                tuning.Knob(option=f"{channel}[{knot}]", low=-RANGES[channel], high=RANGES[channel])
                for channel in used
                for knot in range(self.knots)
            ),
        )

    def rivals(self) -> list[tuple[Path, Task]]:
        """The runs of the rival, each with its run folder."""
        if self.against is None:
            return []
        return [
            (
                experiment.level_folder(self.out / "against", level),
                Task(scenario=self.scenario, controller=self.against, seed=seed, steps=self.steps, demand_factor=level),
            )
            for level in self.levels
            for seed in self.seeds
        ]


class Search(tuning.Tuning):
    """Of a schedule instead of options."""

    @property
    def trains(self) -> bool:
        """The controller is the same in all candidates."""
        return False

    def numbers(self, key: str) -> tuple[float, ...]:
        """A schedule has a range for every number."""
        return ()

    def plan(self, candidate: int, options: tuple[tuple[str, object], ...]) -> list[tuple[Path, Task]]:
        """The run of one candidate, whose first one is the controller itself."""
        return [
            (folder, replace(task, options=(), schedule=task.options if candidate else ()))  # type: ignore[arg-type]
            for folder, task in super().plan(candidate, options)
        ]


def check(order: Bound) -> tuple[str, ...]:
    """The channels; InputError for what has none, or too many numbers, before anything is run."""
    used = order.channels
    if not used:
        raise InputError(
            f"--controller: {order.controller!r} commands no gates, prices or rates that a schedule could be added to; "
            "choose one that does, in a scenario with protected regions"
        )
    if len(used) * order.knots > tuning.MOST:
        raise InputError(
            f"--knots: expected at most {tuning.MOST // len(used)}, for {order.controller} has {len(used)} channels "
            f"({', '.join(used)}) and a search {tuning.MOST} numbers at most, got {order.knots} instead"
        )
    if order.against is not None:
        scenario = load_scenario(order.scenario)
        registry.verify(configured(order.against, scenario.controller_options), scenario)
    return used


def bound(
    order: Bound,
    *,
    workers: int = 1,
    scheduler: dask_cluster.Scheduler | str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Search for every seed and demand level; returns the table of bound.csv.

    Every run is kept: the same call goes on where it was interrupted, and with more `candidates` from where it ended.
    Raises InputError, and RunFailed where nothing could be scored.
    """
    used, source = check(order), dask_cluster.source(scheduler, tell)
    pairs = [(level, seed) for level in order.levels for seed in order.seeds]
    file, rows = order.out / "bound.csv", list[dict[str, float]]()
    with run_folder.manifest(
        order.out,
        configuration=_configuration(order, used),
        results=file,
        session={"scenario_folder": str(order.scenario), "workers": workers},
    ):
        for number, (level, seed) in enumerate(pairs):

            def kept(table: pd.DataFrame, level: float = level, seed: int = seed) -> None:
                files.write_table(file, pd.DataFrame([*rows, _row(order, level, seed, table)]))

            table = tuning.search(
                order.search(level, seed, used),
                workers=workers,
                source=source,
                tell=tell,
                kept=kept,
                progress=_of_search(progress, number, len(pairs)),
            )
            rows.append(_row(order, level, seed, table))
        if order.against is None:
            return pd.DataFrame(rows)
        failures = experiment.perform(
            order.rivals(), workers=workers, fresh=True, progress=progress, tell=tell, source=source
        )
        if failures:
            raise ended([(experiment.label(task), failure) for task, failure in failures])
        found = pd.DataFrame([_beside(order, row) for row in rows])
        files.write_table(file, found)
    return found


def text(order: Bound, table: pd.DataFrame) -> str:
    """For the terminal: one line per search."""
    used = "used: share of what the bound saves against the rival that the controller saves as well"
    return text_table(
        [
            {
                "demand": f"{row['demand']:g}",
                "seed": row["seed"],
                f"{order.controller} [veh s]": f"{row[FIRST]:.4g}",
                "bound [veh s]": f"{row[FOUND]:.4g}",
                "room": f"{row[ROOM]:+.1f} %",
                **(
                    {}
                    if order.against is None
                    else {
                        f"{order.against} [veh s]": f"{row[RIVAL]:.4g}",
                        "used": "" if math.isnan(row[USED]) else f"{row[USED]:.0f} %",
                    }
                ),
            }
            for row in table.to_dict("records")
        ],
        f"bound: the best of {order.candidates} schedules, found knowing the seed; room: against the controller"
        + (f"; {used}" if order.against else ""),
    )


def _of_search(progress: experiment.Progress | None, number: int, searches: int) -> experiment.Progress | None:
    """`progress` of one search, among all."""
    return progress and (
        lambda done, total, note: progress(
            number * total + done, searches * total, f"search {number + 1} of {searches}; {note}"
        )
    )


def _row(order: Bound, level: float, seed: int, table: pd.DataFrame) -> dict[str, float]:
    """Of bound.csv, by the table of a search."""
    first, best = float(table[SCORE].iloc[0]), tuning.best(table)
    return {
        "demand": level,
        "seed": seed,
        "candidates": len(table),
        FIRST: first,
        FOUND: float(best[SCORE]),
        ROOM: percent_change(float(best[SCORE]), first),
        **{name: float(best[name]) for name in table.columns if "[" in name},
    }


def _beside(order: Bound, row: dict[str, float]) -> dict[str, float]:
    """The row with what the rival took, and which share of the room between it and the bound is used."""
    path = experiment.level_folder(order.out / "against", row["demand"])
    rival = float(experiment.overview(path).set_index("seed")[TTS].loc[row["seed"]])
    used = 100.0 * (rival - row[FIRST]) / (rival - row[FOUND]) if rival > row[FOUND] else math.nan
    return {**row, RIVAL: rival, USED: used}


def _configuration(order: Bound, used: Sequence[str]) -> dict[str, object]:
    """What the folder is for."""
    return {
        "bound": order.controller,
        "against": order.against,
        "scenario": load_scenario(order.scenario).name,
        "seeds": list(order.seeds),
        "levels": list(order.levels),
        "channels": list(used),
        "knots": order.knots,
        "search_seed": order.search_seed,
        "steps": order.steps,
    }
