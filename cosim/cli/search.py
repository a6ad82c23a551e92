"""The commands tune and frontier of `cosim`: what many runs are searched for.

Heavy modules are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.options import CONTROLLER_HELP, parsed_levels, tell
from nmfd.cli.options import COUNT, FOLDER, SEED, policy_files
from nmfd.cli.progress import resumable
from nmfd.errors import InputError, RunFailed
from nmfd.runs.files import file_name
from nmfd.runs.workers import cores


@click.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controller", required=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
@click.option("--option", "knobs", required=True, multiple=True, metavar="KEY=LOW:HIGH",
              help="An option of the controller and the range that is searched; KEY[0], KEY[1], ... for the numbers of "
                   "a list. May be repeated, up to 20 numbers. One with which a policy is trained trains one for "
                   "every candidate.")
@click.option("--candidates", type=COUNT, default=40, show_default=True, metavar="N",
              help="How many are tried, the scenario's own options first; each takes one run per seed and level.")
@click.option("--seeds", type=COUNT, default=2, show_default=True, metavar="N", help="Runs per candidate and level.")
@click.option("--first-seed", type=SEED, default=1000, show_default=True, metavar="S",
              help="The seeds are S to S + N - 1. Those from 2000 on are for evaluations.")
@click.option("--demand", default="1.0", show_default=True, metavar="A,B,...",
              help="Demand levels: multiples of the scenario's demand.")
@click.option("--search-seed", type=SEED, default=0, show_default=True, help="Of CMA-ES, and of training.")
@click.option("--population", type=click.IntRange(2, 1000), metavar="N",
              help="Candidates per generation. [default: the rule of CMA-ES]")
@click.option("--workers", type=COUNT, metavar="N",
              help="Runs at a time, each in a process of its own. [default: one per core]")
@click.option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster that does the runs (as of cosim sweep).")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="The folder. [default: runs/<scenario>-tune]")
def tune(
    scenario: Path, controller: str, knobs: tuple[str, ...], candidates: int, seeds: int, first_seed: int, demand: str,
    search_seed: int, population: int | None, workers: int | None, scheduler: str | None, steps: int | None,
    out: Path | None,
) -> None:
    """Search for the options of a controller that do best in the microsimulation, by CMA-ES.

    Candidates are compared by the geometric mean of the total time spent over seeds and demand levels. Writes
    tune.csv and tune.toml, the best options as scenario.toml takes them. The same command goes on where it was
    interrupted, and with more --candidates from where it ended.

    \b
    Examples:
      cosim tune scenarios/grid7_peak --controller pi-gating --option kp=0.1:10 --option ki=0.001:0.1
      cosim tune scenarios/grid7_peak --controller pi-gating+guided+max-pressure --demand 1,1.6 \\
          --option set_point[0]=250:600 --option kp=0.1:10 --option ki=0.001:0.1 --candidates 60
      cosim tune scenarios/grid7_peak --controller dpc-pcrg+max-pressure --option mfd_scale=0.6:1 \\
          --option mfd_spread=0:0.5
    """
    from cosim.evaluation import tuning  # heavy

    if scheduler is not None and workers is not None:
        raise InputError("--workers: is for processes here, and --scheduler has workers of its own; omit one")
    order = tuning.Tuning(
        scenario=scenario, controller=controller, knobs=tuple(tuning.knob(text) for text in knobs),
        candidates=candidates, seeds=range(first_seed, first_seed + seeds),
        levels=tuple(parsed_levels("--demand", demand)), search_seed=search_seed, population=population, steps=steps,
        out=Path("runs") / f"{file_name(scenario.name)}-tune" if out is None else out)
    with resumable("tune", order.out, "tune.csv") as progress:
        table = tuning.tune(
            order, workers=cores() if workers is None else workers, scheduler=scheduler, progress=progress, tell=tell)
    click.echo(tuning.text(order, table))
    click.echo(f"Written to {order.out}: see tune.toml and tune.csv")


@click.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controllers", required=True, metavar="A,B,...", help="Separated by commas. " + CONTROLLER_HELP)
@click.option("--demand", default="0.8,1.0,1.2,1.4,1.6,1.8,2.0", show_default=True, metavar="A,B,...",
              help="Demand levels: multiples of the scenario's demand.")
@click.option("--seeds", type=COUNT, default=10, show_default=True, metavar="N",
              help="Runs per controller and demand level, on the same trips for all controllers.")
@click.option("--first-seed", type=SEED, default=1000, show_default=True, metavar="S",
              help="The seeds are S to S + N - 1. Those from 2000 on are for evaluations.")
@click.option("--everything", is_flag=True,
              help="Run every controller at every level, also beyond one at which it served all trips with no seed.")
@click.option("--policy", "policies", multiple=True, metavar="NAME=FILE",
              help="Policy of a DPC controller, if not SCENARIO/NAME.pt. May be repeated.")
@click.option("--workers", type=COUNT, metavar="N",
              help="Runs at a time, each in a process of its own. [default: one per core]")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="The folder. [default: runs/<scenario>-frontier]")
def frontier(
    scenario: Path, controllers: str, demand: str, seeds: int, first_seed: int, everything: bool,
    policies: tuple[str, ...], workers: int | None, steps: int | None, out: Path | None,
) -> None:
    """Find up to which demand every controller serves all trips: a picture, frontier.png, and a table.

    A controller that serves all trips with none of the seeds of a demand level is not run at higher ones. The runs lie
    as those of cosim evaluate, which finds them there; every one is kept as soon as it is finished.

    \b
    Example:
      cosim frontier scenarios/grid7_peak --controllers max-pressure,pi-gating+guided+max-pressure --seeds 5
    """
    from cosim.plant.strategy import parse  # heavy

    names = [name.strip() for name in controllers.split(",")]
    for name in names:
        parse(name)
    if repeated := [name for n, name in enumerate(names) if name in names[:n]]:
        raise InputError(f"--controllers: {repeated[0]} is there twice; name every controller once")
    files = policy_files(policies, names)

    from cosim.evaluation import evaluate  # heavy
    from cosim.evaluation import frontier as method
    from cosim.report import frontier as picture
    from nmfd.api import load_scenario

    order = evaluate.Evaluation(
        scenario=scenario, controllers=tuple(names), seeds=range(first_seed, first_seed + seeds),
        levels=tuple(parsed_levels("--demand", demand)), steps=steps, policies=files,
        out=Path("runs") / f"{file_name(load_scenario(scenario).name)}-frontier" if out is None else out)
    with resumable("frontier", order.out) as progress:
        table, failures = method.frontier(
            order, everything=everything, workers=cores() if workers is None else workers, progress=progress,
            tell=tell)
        picture.draw(order.out / "frontier.png", table)
    click.echo(method.text(table))
    click.echo(f"Written to {order.out}: see frontier.png and frontier.md")
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")
