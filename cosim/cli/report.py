"""The commands report, video and watch of `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.options import CONTROLLER, POLICY, REFERENCE
from nmfd.cli.declared import declared
from nmfd.cli.options import FILE, FOLDER, SCENARIO, SEED, STEPS
from nmfd.cli.progress import progress_line
from nmfd.errors import InputError


@click.command()
@click.argument("folders", type=FOLDER, metavar="RUN...", nargs=-1, required=True)
@click.option("--out", type=FILE, metavar="FILE", help="The page. [default: report.html in the first RUN]")
@REFERENCE
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The runs' scenario, if it is no longer where it was.")
def report(folders: tuple[Path, ...], out: Path | None, reference: str | None, scenario: Path | None) -> None:
    """Write one self-contained HTML page about finished runs: what came of them, in words, tables and pictures.

    RUN is a folder of `cosim run` or `cosim evaluate`; several come on one page. The page works without a network.

    \b
    Examples:
      cosim report runs/grid7_peak-evaluate
      cosim report runs/monday runs/tuesday --out both.html
    """
    from cosim.evaluation import results  # heavy
    from cosim.report import html

    found = [results.read(folder, scenario) for folder in folders]
    known = {name for run in found for name in run.rows["controller"]}
    if reference is not None and reference not in known:
        raise InputError(f"--reference: {reference!r} is not in these runs; choose from {', '.join(sorted(known))}")
    with progress_line("report") as progress:
        path = html.write_page(out or folders[0] / "report.html", found, reference, progress)
    click.echo(f"Written to {path}: open it in a browser")


@click.command()
@click.argument("folder", type=FOLDER, metavar="RUN")
@click.option("--controller", metavar="NAME", help="Whose run. [default: the best one]")
@click.option("--against", metavar="NAME", help="A second run, shown beside it.")
@click.option("--seed", type=SEED, help="[default: the first one there]")
@click.option("--demand", type=float, metavar="X", help="Level of an evaluation. [default: the one nearest to 1]")
@declared("cosim.evaluation.settings:Window", "rate")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The run's scenario, if it is no longer where it was.")
@click.option("--out", type=FILE, metavar="FILE",
              help="A name that ends in .gif, or .mp4 where ffmpeg is installed. [default: a gif in RUN]")
def video(
    folder: Path, controller: str | None, against: str | None, seed: int | None, demand: float | None, rate: int,
    scenario: Path | None, out: Path | None,
) -> None:
    """Make a film of the link densities of a finished run, from its record; nothing is simulated.

    RUN is a folder of `cosim run` or `cosim evaluate`.

    \b
    Examples:
      cosim video runs/gating --controller pi-gating --against no-control
      cosim video runs/grid7_peak-evaluate --controller max-pressure --seed 2001 --out film.mp4
    """
    from cosim.evaluation import results  # heavy
    from cosim.report import video

    run = results.read(folder, scenario)
    level = run.level(demand)
    names, seed = video.choose(run, level, controller, against, seed)
    path = video.default_path(level, names, seed) if out is None else out
    with progress_line("video") as progress:
        video.film(path, run, level, names, seed, rate=rate, progress=progress)
    click.echo(f"Written to {path}: {' and '.join(names)}, seed {seed}, {path.stat().st_size / 1e6:.1f} MB")


@click.command()
@SCENARIO
@CONTROLLER
@click.option("--seed", type=SEED, default=0, show_default=True)
@STEPS
@declared("cosim.evaluation.settings:Window", "demand", "delay")
@POLICY
def watch(
    scenario: Path, controller: str, seed: int, steps: int | None, demand: float, policy: Path | None, delay: float,
) -> None:
    """Watch a controller steer the city in SUMO's own window; nothing is written.

    Streets lie on the colour of their region. A dot at every gateway is green where its signal shows all of its
    original green, red where it shows the least, and grey where no controlled signal is. Vehicles are red where they
    stand. Without a screen, use `cosim run` and `cosim video`.

    \b
    Example:
      cosim watch scenarios/grid7_peak --controller pi-gating
    """
    from cosim.evaluation.simulate import Task  # heavy
    from cosim.report import watch
    from nmfd.metrics import summary

    task = Task(
        scenario=scenario, controller=controller, seed=seed, policy=policy, steps=steps, demand_factor=demand)
    try:
        with progress_line("watch") as progress:
            trajectory = watch.watch(task, delay=delay, progress=progress)
            row = summary(trajectory)
    except watch.WindowClosed:
        click.echo("The window was closed before the end.")
        return
    click.echo(f"{controller}, seed {seed}: total time spent {row['total_time_spent_veh_s']:.4g} veh s, "
               f"{row['completed_veh']:,.0f} trips completed"
               + (f", {removed:,.0f} vehicles removed" if (removed := trajectory.removed[-1].sum()) else ""))
