"""The commands report and watch of `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from cosim.cli.options import CONTROLLER, POLICY, has_screen
from nmfd.cli.declared import declared
from nmfd.cli.options import FILE, FOLDER, SCENARIO, SEED, STEPS
from nmfd.cli.progress import progress_line
from nmfd.errors import InputError

if TYPE_CHECKING:
    from cosim.evaluation.simulate import Task
    from nmfd.types import Result


@click.command()
@click.argument("folders", type=FOLDER, metavar="RUN...", nargs=-1, required=True)
@click.option("--out", type=FILE, metavar="FILE", help="The page. [default: report.html in the first RUN]")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The runs' scenario, if it is no longer where it was.")
@click.option("--seed", type=SEED, help="Of the runs on the map. [default: the first that both have]")
def report(folders: tuple[Path, ...], out: Path | None, scenario: Path | None, seed: int | None) -> None:
    """Write one self-contained HTML page about finished runs: what came of them, in four figures, on a map, in pictures
    and tables.

    RUN is a folder of `cosim run` or `cosim evaluate`; several come on one page. The map has the best run of the first
    RUN beside what it is compared with, and a slider over their time. The page works without a network.

    \b
    Examples:
      cosim report runs/grid7_peak-evaluate
      cosim report runs/monday runs/tuesday --out both.html
      cosim report runs/gating --seed 3
    """
    from cosim.evaluation import results  # heavy
    from cosim.report import html

    found = [results.read(folder, scenario) for folder in folders]
    with progress_line("report") as progress:
        path = html.write_page(out or folders[0] / "report.html", found, None, progress, seed=seed)
    click.echo(f"Written to {path}: open it in a browser")


@click.command()
@SCENARIO
@CONTROLLER
@click.option("--against", metavar="NAME", help="A second run on the same trips, shown beside it.")
@click.option("--seed", type=SEED, default=0, show_default=True)
@STEPS
@declared("cosim.evaluation.settings:Window", "demand")
@declared("cosim.evaluation.settings:Window", "delay", instead="0; {} with --gui")
@POLICY
@click.option("--port", type=click.IntRange(0, 65535), help="Of the page. [default: any that is free]")
@click.option(
    "--host",
    metavar="ADDRESS",
    help="Of this machine, where others can reach the page: who has its address, with its token, can watch "
    "and command. [default: 127.0.0.1, this machine alone]",
)
@click.option(
    "--open/--no-open",
    "browse",
    default=None,
    help="Open the page in this machine's browser. [default: where there is a screen and a terminal]",
)
@click.option("--gui", is_flag=True, help="SUMO's own window instead of a page; one run, and nothing to switch.")
def watch(
    scenario: Path,
    controller: str,
    against: str | None,
    seed: int,
    steps: int | None,
    demand: float,
    delay: float | None,
    policy: Path | None,
    port: int | None,
    host: str | None,
    browse: bool | None,
    gui: bool,
) -> None:
    """Watch controllers steer the city on a live page in the browser; nothing is written.

    The map has the streets by density or speed, the regions, and every gateway with the part of its original green that
    it shows; beside it are accumulations against critical, the MFD plane, a gate, and what came of it so far. Runs can
    be paused, stepped, slowed down and looked back at, and gates switched by hand: at the end comes the --fault that
    orders the same again. The runs are those of `cosim run`, to the byte. The command ends when they have ended and
    nobody looks any more.

    \b
    Examples:
      cosim watch grid7_peak --controller pi-gating --against no-control
      cosim watch grid7_peak --controller dpc-pcrg --no-open --port 8080
      cosim watch grid7_peak --controller pi-gating --gui
    """
    from cosim.evaluation.simulate import Result, Task, scenario_of  # heavy
    from cosim.view.server import LOOPBACK
    from cosim.view.watch import watch
    from nmfd.controllers.strategy import parse

    names = [controller] + ([against] if against and against != controller else [])
    tasks = [
        Task(
            scenario=scenario,
            controller=name,
            seed=seed,
            policy=policy if name == controller else None,
            steps=steps,
            demand_factor=demand,
        )
        for name in names
    ]
    if gui:
        if len(tasks) > 1 or port is not None or host is not None or browse is not None:
            raise InputError("--gui: shows one run, without a page; omit --against, --port, --host and --open")
        _window(tasks[0], delay)
        return
    for name in names:
        parse(name)
    scenario_of(tasks[0])  # what is wrong with it is said before anything starts
    with progress_line("watch") as progress:
        runs = watch(
            tasks,
            host=host or LOOPBACK,
            port=port or 0,
            delay=(delay or 0.0) / 1000.0,
            browse=has_screen() if browse is None else browse,
            tell=lambda line: click.echo(line),
            progress=progress,
        )
    for seen in runs:
        if isinstance(seen.outcome, Result):
            _tell(seen.name, seed, seen.outcome)


def _window(task: "Task", delay: float | None) -> None:
    """Run a task in sumo-gui and print its outcome."""
    from cosim.evaluation.simulate import simulate
    from cosim.sumo.session import LOST, Window

    window = Window(
        options=("--start", "true", "--quit-on-end", "true", "--delay", f"{20.0 if delay is None else delay}")
    )
    try:
        with progress_line("watch") as progress:
            result = simulate(task, progress, window=window)
    except LOST:
        click.echo("The window was closed before the end.")
        return
    _tell(task.controller, task.seed, result)


def _tell(controller: str, seed: int, trajectory: "Result") -> None:
    from nmfd.metrics import summary

    row = summary(trajectory)
    click.echo(
        f"{controller}, seed {seed}: total time spent {row['total_time_spent_veh_s']:.4g} veh s, "
        f"{row['completed_veh']:,.0f} trips completed"
        + (f", {removed:,.0f} vehicles removed" if (removed := trajectory.removed[-1].sum()) else "")
    )
