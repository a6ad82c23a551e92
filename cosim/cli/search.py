"""The command tune of `cosim`.

Heavy modules are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.options import (
    CONTROLLER,
    chosen_scheduler,
    scheduler_options,
    tell,
)
from nmfd.cli.declared import declared
from nmfd.cli.options import SCENARIO, STEPS, out_option
from nmfd.cli.progress import resumable
from nmfd.runs.files import file_name
from nmfd.runs.workers import at_a_time


@click.command()
@SCENARIO
@CONTROLLER
@click.option(
    "--option",
    "knobs",
    required=True,
    multiple=True,
    metavar="KEY=LOW:HIGH",
    help="An option of the controller and the range that is searched; KEY[0], KEY[1], ... for numbers of "
    "a list. May be repeated, up to 20 numbers. One with which a policy is trained trains one for "
    "every candidate.",
)
@declared("cosim.evaluation.settings:Search", "candidates", "seeds", "first_seed", "demand", "search_seed")
@declared("cosim.evaluation.settings:Search", "population", instead="the rule of CMA-ES")
@declared("cosim.evaluation.settings:Search", "workers", instead="one per core")
@scheduler_options
@STEPS
@out_option("tune", "The folder.")
def tune(
    scenario: Path,
    controller: str,
    knobs: tuple[str, ...],
    candidates: int,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    search_seed: int,
    population: int | None,
    workers: int | None,
    scheduler: str | None,
    steps: int | None,
    out: Path | None,
) -> None:
    """Search for the options of a controller that do best in the microsimulation, by CMA-ES.

    Candidates are compared by the geometric mean of the total time spent over seeds and demand levels. Writes
    tune.csv and tune.toml, the best options as scenario.toml takes them. The same command goes on where it was
    interrupted, and with more --candidates from where it ended.

    \b
    Examples:
      cosim tune grid7_peak --controller pi-gating --option kp=0.1:10 --option ki=0.001:0.1
      cosim tune grid7_peak --controller pi-gating+guided+max-pressure --demand 1,1.6 \\
          --option set_point[0]=250:600 --option kp=0.1:10 --option ki=0.001:0.1 --candidates 60
      cosim tune grid7_peak --controller dpc-pcrg+max-pressure --option mfd_scale=0.6:1 \\
          --option mfd_spread=0:0.5
    """
    cluster = chosen_scheduler(workers, scheduler)

    from cosim.evaluation import tuning  # heavy

    order = tuning.Tuning(
        scenario=scenario,
        controller=controller,
        knobs=tuple(tuning.knob(text) for text in knobs),
        candidates=candidates,
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        search_seed=search_seed,
        population=population,
        steps=steps,
        out=Path("runs") / f"{file_name(scenario.name)}-tune" if out is None else out,
    )
    with resumable("tune", order.out, "tune.csv") as progress:
        table = tuning.tune(order, workers=at_a_time(workers), scheduler=cluster, progress=progress, tell=tell)
    click.echo(tuning.text(order, table))
    click.echo(f"Written to {order.out}: see tune.toml and tune.csv")
