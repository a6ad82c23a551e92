"""The command compete of `cosim`.

Heavy modules are imported inside it: help takes 0.1 s instead of 3 s.
"""

from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cosim.cli.options import chosen_scheduler, scheduler_options, tell
from nmfd.cli.declared import declared
from nmfd.cli.options import FOLDER
from nmfd.cli.progress import resumable
from nmfd.errors import InputError
from nmfd.runs.files import file_name
from nmfd.runs.workers import at_a_time

if TYPE_CHECKING:
    from cosim.evaluation.dask_cluster import Scheduler


@click.command()
@click.argument("controllers", metavar="[NAME...]", nargs=-1)
@click.option(
    "--tasks",
    default="v1",
    show_default=True,
    metavar="SET",
    help="A task set that comes with the package, or a TOML file of your own.",
)
@click.option("--only", metavar="A,B,...", help="Of its tasks these alone, for now; in quotes also patterns: 'grid7*'.")
@declared("cosim.evaluation.settings:Evaluation", "workers", instead="one per core")
@scheduler_options
@click.option(
    "--table",
    "tables",
    multiple=True,
    metavar="DIR|SET",
    help="Instead of running: the leaderboard of the entries in this folder, and, where a task set is named, "
    "of those that come with the package. May be repeated.",
)
@click.option(
    "--out",
    type=FOLDER,
    metavar="DIR",
    help="Where entries and runs go, or the leaderboard. [default: runs/compete-SET; of a table its DIR]",
)
def compete(
    controllers: tuple[str, ...],
    tasks: str,
    only: str | None,
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    tables: tuple[str, ...],
    out: Path | None,
) -> None:
    """Enter controllers in a released task set, or make the leaderboard of entries.

    Every controller gets an entry, a JSON file with all runs, their metrics, hashes, seeds and versions, and what
    failed or is missing. The same command goes on where it was interrupted. Where a controller fails, its entry says
    how, and all others stay as they are.

    NAME is a controller as in cosim run. In tasks on a regional model its options do not count, for there are no
    signals and no drivers; where max-pressure is part of the plant, it is so for everybody.

    \b
    Examples:
      cosim compete mine.py:MyController
      cosim compete no-control pi-gating --only 'economic*' --out runs/compete
      cosim compete --table runs/compete --table v1
    """
    if bool(controllers) == bool(tables):
        raise InputError("compete: expected controllers to run, or --table DIR; give one of the two")
    if tables:
        _table(tables, out)
        return
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)
    _run(controllers, tasks, only, at_a_time(workers), cluster, out)


def _run(
    controllers: tuple[str, ...],
    tasks: str,
    only: str | None,
    workers: int,
    cluster: "Scheduler | None",
    out: Path | None,
) -> None:
    from cosim.compete import run, task_set  # heavy
    from cosim.plant.strategy import parse
    from nmfd.controllers import names, registry

    loaded = task_set.read(tasks)
    order = run.Order(
        task_set=loaded,
        controllers=tuple(names.chosen(controllers, parse, registry.choice, "compete")),
        only=tuple(word.strip() for word in only.split(",") if word.strip()) if only else (),
        out=Path("runs") / f"compete-{file_name(loaded.tasks.name)}" if out is None else out,
    )
    with resumable("compete", order.out) as progress:
        entries = run.compete(order, workers=workers, scheduler=cluster, progress=progress, tell=tell)
    for made in entries:
        failed = [failure for outcome in made.tasks for failure in outcome.failed]
        done = len(made.tasks) - len(made.missing)
        click.echo(f"{made.controller}: {done} of {len(made.tasks)} tasks complete, {len(failed)} runs failed")
        for outcome in made.tasks:
            for reason, alike in groupby(outcome.failed, key=attrgetter("reason")):
                click.echo(f"  {outcome.task}, seed {', '.join(str(failure.seed) for failure in alike)}: {reason}")
    click.echo(f"Written to {order.out}: an entry per controller; cosim compete --table {order.out} compares them")


def _table(tables: tuple[str, ...], out: Path | None) -> None:
    from cosim.compete import page, table  # heavy
    from nmfd.runs.tables import text_table

    board = table.read(tables)
    folder = next((Path(place) for place in tables if Path(place).is_dir()), None) if out is None else out
    if folder is None or not folder.is_dir():
        raise InputError(f"--out: {folder or 'missing'}; give a folder that is there, for the leaderboard")
    page.write(folder / "leaderboard.html", board)
    table.write_csv(folder / "leaderboard.csv", board)
    click.echo(
        text_table(
            [
                {
                    "controller": row.name,
                    "rank": row.rank or "-",
                    "worth": page.number(row.worth, ".3f") or "-",
                    **{
                        task: page.in_task(one)
                        for task, rows in board.by_task.items()
                        for one in rows
                        if one.name == row.name
                    },
                    "failed": row.failed,
                }
                for row in board.overall
            ],
            table.RULE,
        )
    )
    click.echo(f"Written to {folder}: see leaderboard.html and leaderboard.csv")
