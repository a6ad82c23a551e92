"""The sweep: controllers x seeds x demand levels x compliance rates in SUMO, on processes or a cluster, as one table.

<folder>/sweep.parquet      one row per run, new after every run: what was asked for, how it ended, all its figures
<folder>/demand-<level>/    the run folder of a demand level (cosim.evaluation.experiment), as of an evaluation
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from cosim.evaluation import dask_cluster, experiment
from cosim.evaluation.evaluate import check_folder, level_folders
from cosim.evaluation.simulate import Task
from cosim.plant.settings import settings
from cosim.plant.strategy import parse, ready
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.controllers.names import chosen
from nmfd.errors import InputError
from nmfd.runs.frames import write_parquet
from nmfd.runs.tables import text_table
from nmfd.runs.workers import ended

OK, FAILED = "ok", "failed"
KEYS = ["strategy", "seed", "demand"]
FIRST = ["strategy", "controller", "seed", "demand", "compliance", "status", "reason"]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """scenario: its folder; controllers: a strategy, several, or patterns (nmfd.controllers.names); levels: multiples
    of the scenario's demand; compliance: shares of the drivers' decisions that follow route guidance, the scenario's
    own where there is none or nobody guides;
    steps: control intervals, all if None; policies: controller -> file instead of the scenario's own; time_limit: of
    controllers of the user's own, instead of the scenario's; out: the folder.
    """

    scenario: Path
    controllers: Sequence[str]
    seeds: Sequence[int]
    out: Path
    levels: tuple[float, ...] = (1.0,)
    compliance: tuple[float, ...] = ()
    steps: int | None = None
    policies: Mapping[str, Path] = field(default_factory=dict)
    time_limit: float | None = None

    def __post_init__(self) -> None:
        """Texts will do for folders and for one strategy. InputError."""
        for name in ("scenario", "out"):
            object.__setattr__(self, name, Path(getattr(self, name)))
        names = chosen(self.controllers, parse, lambda: ready(load_scenario(self.scenario)))
        object.__setattr__(self, "controllers", tuple(names))

    def strategies(self) -> dict[str, str]:
        """Strategy with its compliance -> strategy as asked for; those that guide nobody once only. InputError."""
        ways = [f"+compliance-{100 * share:g}" for share in self.compliance] or [""]
        found = {name + way: name for name in self.controllers for way in ways}
        guiding = {name: parse(name).guides for name in found}
        return {strategy if guiding[strategy] else name: name for strategy, name in found.items()}

    def plan(self) -> list[tuple[Path, Task]]:
        """Every run with its run folder, seed by seed, so that whatever is finished compares like with like."""
        return [
            (
                experiment.level_folder(self.out, level),
                Task(
                    scenario=self.scenario,
                    controller=strategy,
                    seed=seed,
                    policy=self.policies.get(name),
                    steps=self.steps,
                    demand_factor=level,
                    time_limit=self.time_limit,
                ),
            )
            for seed in self.seeds
            for level in self.levels
            for strategy, name in self.strategies().items()
        ]


def sweep(
    order: Sweep,
    *,
    workers: int = 1,
    scheduler: dask_cluster.Scheduler | str | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Run what is not there yet; returns the table, which is in sweep.parquet, of all runs in the folder.

    Columns: strategy, controller (without its compliance), seed, demand, compliance, status ("ok" or "failed"),
    reason, and those of summary.csv and sumo.csv, which are empty where a run failed. Failed runs are tried again at
    the next call. `scheduler`: a Dask scheduler or its address, whose workers run all of it instead of `workers`
    processes here. progress, tell: as in `experiment.perform`. Raises InputError, and
    RunFailed if no run at all went well.
    """
    check_folder(order.out)
    plan, file = order.plan(), order.out / "sweep.parquet"
    failures = _failures(file)
    own = settings(load_scenario(order.scenario)).compliance

    def write() -> pd.DataFrame:
        done = _finished(order.out)
        for key in done[KEYS].itertuples(index=False, name=None):
            failures.pop(key, None)
        failed = [
            {**dict(zip(KEYS, key, strict=True)), "status": FAILED, "reason": reason}
            for key, reason in failures.items()
        ]
        rows = _named(pd.concat([done, pd.DataFrame(failed)], ignore_index=True) if failed else done, own)
        order.out.mkdir(parents=True, exist_ok=True)
        write_parquet(file, rows)
        return rows

    def failed(task: Task, reason: str) -> None:
        failures[task.controller, task.seed, task.demand_factor] = reason
        write()

    source = dask_cluster.source(scheduler, tell)
    failed_now = experiment.perform(
        plan, workers=workers, fresh=True, progress=progress, tell=tell, kept=write, failed=failed, source=source
    )
    rows = write()
    if failed_now and (rows["status"] == FAILED).all():
        raise ended([(experiment.label(task), failure) for task, failure in failed_now[:1]])
    return rows


def _finished(out: Path) -> pd.DataFrame:
    """A row per finished run."""
    parts = []
    for level, folder in level_folders(out).items():
        rows = experiment.overview(folder).rename(columns={"controller": "strategy"})
        parts.append(rows.assign(demand=level, status=OK, reason=""))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*KEYS, "status", "reason"])


def _failures(file: Path) -> dict[tuple[str, int, float], str]:
    """Strategy, seed and demand level -> reason, of the runs that failed so far. Raises InputError."""
    if not file.is_file():
        return {}
    try:
        rows = pd.read_parquet(file)
        rows = rows[rows["status"] == FAILED]
        return {tuple(key): reason for *key, reason in rows[[*KEYS, "reason"]].itertuples(index=False, name=None)}
    except (OSError, ValueError, KeyError) as error:  # pyarrow's own errors are among them
        raise InputError(
            f"{file}: is no table of a sweep ({' '.join(str(error).split())[:200]}); delete it, the runs are kept in "
            "the folders beside it"
        ) from None


def _named(rows: pd.DataFrame, own: float) -> pd.DataFrame:
    """`rows` with what was asked for as the first columns, sorted by it; `own`: the compliance of the scenario."""
    strategies = {name: parse(name) for name in dict.fromkeys(rows["strategy"])}
    controllers = {
        name: "+".join(
            part for part in (registry.split(name)[0], *registry.split(name)[1]) if not part.startswith("compliance-")
        )
        for name in strategies
    }
    compliance = {name: float(strategy.overrides.get("compliance", own)) for name, strategy in strategies.items()}
    named = rows.assign(
        controller=rows["strategy"].map(controllers), compliance=rows["strategy"].map(compliance).astype(float)
    )
    return named[[*FIRST, *(column for column in named if column not in FIRST)]].sort_values(
        ["demand", "controller", "compliance", "seed"], ignore_index=True
    )


def text(rows: pd.DataFrame) -> str:
    """Means over the seeds, one line per demand level, controller and compliance."""
    groups = rows.groupby(["demand", "controller", "compliance"], sort=True)
    good = rows[rows["status"] == OK].groupby(["demand", "controller", "compliance"], sort=True)
    failed = groups["status"].agg(lambda status: (status == FAILED).sum())
    table = pd.DataFrame({"runs": groups.size(), "failed": failed})
    if len(good):
        table["TTS [veh s]"] = good["total_time_spent_veh_s"].mean().map("{:.4g}".format)
        table["completed [veh]"] = good["completed_veh"].mean().map("{:,.0f}".format)
        table["removed [veh]"] = good["removed_veh"].mean().map("{:,.0f}".format)
        table["trip [s]"] = good["mean_trip_time_s"].mean().map("{:,.0f}".format)
        table["CO2 [kg]"] = good["co2_kg"].mean().map("{:,.0f}".format)
    return text_table(table.reset_index().astype(object).fillna("").to_dict("records"))
