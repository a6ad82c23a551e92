"""The command line `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.city import identify, import_
from cosim.cli.compete import compete
from cosim.cli.demo import demo
from cosim.cli.get import get
from cosim.cli.options import CONTROLLER_HELP, EARLIER, REFERENCE, chosen_scheduler, scheduler_options, tell
from cosim.cli.reference import reference
from cosim.cli.report import report, video, watch
from cosim.cli.run import compare, run
from cosim.cli.search import bound, frontier, improve, tune
from cosim.cli.verify import verify
from nmfd.cli.about import about, listing
from nmfd.cli.declared import declared
from nmfd.cli.errors import Commands
from nmfd.cli.options import (
    POLICIES,
    SCENARIO,
    STEPS,
    TIME_LIMIT,
    controller_names,
    controllers_option,
    out_option,
    policy_files,
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
@REFERENCE
@EARLIER
@POLICIES
@declared("cosim.evaluation.settings:Evaluation", "workers", instead="one per core")
@scheduler_options
@STEPS
@TIME_LIMIT
@out_option("evaluate", "The folder.")
def evaluate(
    scenario: Path,
    controllers: str,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    reference: str | None,
    earlier: tuple[Path, ...],
    policies: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    steps: int | None,
    own_time_limit: float | None,
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
    from cosim.plant.strategy import parse, ready  # heavy

    names = controller_names(controllers, scenario, policies=policies, check=parse, ready=ready)
    files = policy_files(policies, names)
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

    from cosim.evaluation import evaluate, statistics  # heavy
    from cosim.report import pictures
    from nmfd.api import load_scenario

    loaded = load_scenario(scenario)
    chosen = evaluate.Evaluation(
        scenario=scenario,
        controllers=tuple(names),
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        steps=steps,
        policies=files,
        reference=reference,
        time_limit=own_time_limit,
        earlier=earlier,
        out=Path("runs") / f"{file_name(loaded.name)}-evaluate" if out is None else out,
    )
    workers = at_a_time(workers)
    with resumable("evaluate", chosen.out) as progress:
        table, failures = evaluate.evaluate(chosen, workers=workers, scheduler=cluster, progress=progress, tell=tell)
        if len(table):
            pictures.draw_all(chosen.out, evaluate.level_folders(chosen.out), loaded, evaluate.kept_runs(chosen))
    if len(table):
        click.echo(statistics.text(table, reference))
        click.echo(f"Written to {chosen.out}: see evaluate.md, pairs.csv and the pictures")
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")


@main.command()
@SCENARIO
@controllers_option("Separated by commas. " + CONTROLLER_HELP)
@declared("cosim.evaluation.settings:Sweep", "seeds", "first_seed", "demand")
@declared("cosim.evaluation.settings:Sweep", "compliance", instead="the scenario's")
@POLICIES
@declared("cosim.evaluation.settings:Sweep", "workers", instead="one per core")
@scheduler_options
@STEPS
@TIME_LIMIT
@out_option("sweep", "The folder.")
def sweep(
    scenario: Path,
    controllers: str,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    compliance: tuple[int, ...] | None,
    policies: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    steps: int | None,
    own_time_limit: float | None,
    out: Path | None,
) -> None:
    """Run controllers x seeds x demand levels x compliance; write one table, sweep.parquet.

    A run that fails is a row with its reason, and the others go on. Every run is kept as soon as it is finished: the
    same command goes on where it was interrupted, tries failed runs again, and adds what is asked for besides.

    \b
    Examples:
      cosim sweep grid7_peak --controllers dpc-pcrg,rerouting-30 --compliance 0,50,100 --seeds 3
      cosim sweep grid7_peak --controllers no-control,pi-gating --demand 0.8,1.0,1.2 \\
          --scheduler tcp://localhost:8786 --out runs/cluster
    """
    from cosim.plant.strategy import parse, ready  # heavy

    names = controller_names(controllers, scenario, policies=policies, check=parse, ready=ready)
    files = policy_files(policies, names)
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

    from cosim.evaluation import sweeps  # heavy
    from nmfd.api import load_scenario

    order = sweeps.Sweep(
        scenario=scenario,
        controllers=tuple(names),
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        compliance=tuple(share / 100 for share in compliance or ()),
        steps=steps,
        policies=files,
        time_limit=own_time_limit,
        out=Path("runs") / f"{file_name(load_scenario(scenario).name)}-sweep" if out is None else out,
    )
    workers = at_a_time(workers)
    with resumable("sweep", order.out) as progress:
        rows = sweeps.sweep(order, workers=workers, scheduler=cluster, progress=progress, tell=tell)
    click.echo(sweeps.text(rows))
    click.echo(f"Written to {order.out / 'sweep.parquet'}")
    if failed := int((rows["status"] == sweeps.FAILED).sum()):
        tell(f"{failed} of {len(rows)} runs failed, see the column reason; the same command tries them again")


for command in (
    demo,
    listing("cosim.plant.strategy:options"),
    run,
    compare,
    report,
    video,
    watch,
    identify,
    import_,
    get,
    reference,
    tune,
    improve,
    bound,
    frontier,
    compete,
    verify,
):
    main.add_command(command)
