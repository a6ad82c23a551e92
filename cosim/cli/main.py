"""The command line `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.city import identify, import_
from cosim.cli.demo import demo
from cosim.cli.get import get
from cosim.cli.options import CONTROLLER_HELP, chosen_scheduler, scheduler_options, tell
from cosim.cli.report import report, watch
from cosim.cli.run import compare, run
from cosim.cli.search import tune
from nmfd.cli.about import about
from nmfd.cli.declared import declared
from nmfd.cli.errors import Commands
from nmfd.cli.options import (
    POLICIES,
    SCENARIO,
    STEPS,
    controllers_option,
    out_option,
    policy_files,
    strategies_in,
)
from nmfd.cli.progress import resumable
from nmfd.errors import RunFailed
from nmfd.runs.files import file_name
from nmfd.runs.workers import at_a_time


@click.group(name="cosim", cls=Commands)
@about("cosim")
def main() -> None:
    """Regional controllers in a SUMO city: run, evaluate, compare with the regional model, identify it.

    \b
    Example:
      cosim run grid7_peak --controller dpc-pcrg --against no-control
    """


@main.command()
@SCENARIO
@controllers_option("Separated by commas. " + CONTROLLER_HELP)
@declared("cosim.evaluation.settings:Evaluation", "seeds", "first_seed", "demand")
@POLICIES
@declared("cosim.evaluation.settings:Evaluation", "workers", instead="one per core")
@scheduler_options
@STEPS
@out_option("evaluate", "The folder.")
def evaluate(
    scenario: Path,
    controllers: str,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    policies: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    steps: int | None,
    out: Path | None,
) -> None:
    """Compare controllers in the microsimulation over seeds and demand levels; print and write tables, draw figures.

    Every run is kept as soon as it is finished. The same command goes on where it was interrupted, and more seeds,
    controllers or demand levels are added to what is there; only the runs of a controller whose own options, policy
    or model changed are done again.

    \b
    Examples:
      cosim evaluate grid7_peak --controllers no-control,pi-gating,dpc-pc --seeds 10
      cosim evaluate grid7_peak --controllers no-control,dpc-pc --demand 0.8,1.0,1.3 --out runs/levels
    """
    strategies = strategies_in(controllers, scenario, regional=False)
    files = policy_files(policies, strategies)
    cluster = chosen_scheduler(workers, scheduler)

    from cosim.evaluation import evaluate, statistics  # heavy
    from cosim.report import pictures
    from nmfd.api import load_scenario

    loaded = load_scenario(scenario)
    chosen = evaluate.Evaluation(
        scenario=scenario,
        controllers=tuple(strategy.name for strategy in strategies),
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        steps=steps,
        policies=files,
        out=Path("runs") / f"{file_name(loaded.name)}-evaluate" if out is None else out,
    )
    workers = at_a_time(workers)
    with resumable("evaluate", chosen.out) as progress:
        table, failures = evaluate.evaluate(chosen, workers=workers, scheduler=cluster, progress=progress, tell=tell)
        if len(table):
            pictures.draw_all(chosen.out, evaluate.level_folders(chosen.out), loaded, evaluate.kept_runs(chosen))
    if len(table):
        click.echo(statistics.text(table))
        click.echo(f"Written to {chosen.out}: see evaluate.md, pairs.csv and the pictures")
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")


for command in (
    demo,
    run,
    compare,
    report,
    watch,
    identify,
    import_,
    get,
    tune,
):
    main.add_command(command)
