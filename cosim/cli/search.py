"""The commands tune, improve, bound and frontier of `cosim`: what many runs are searched for.

Heavy modules are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from cosim.cli.options import (
    CONTROLLER,
    CONTROLLER_HELP,
    EARLIER,
    POLICY,
    RUNS,
    chosen_scheduler,
    scheduler_options,
    tell,
)
from nmfd.cli.declared import declared
from nmfd.cli.options import POLICIES, SCENARIO, STEPS, controller_names, controllers_option, out_option, policy_files
from nmfd.cli.progress import resumable
from nmfd.errors import RunFailed
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
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
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
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

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


@click.command()
@SCENARIO
@CONTROLLER
@declared("cosim.evaluation.settings:Improvement", "rounds", "seeds", "first_seed", "demand", "descent")
@declared("cosim.evaluation.settings:Improvement", "learning_rate", instead="that of the controller's training")
@declared("cosim.evaluation.settings:Improvement", "iterations")
@POLICY
@RUNS
@declared("cosim.evaluation.settings:Improvement", "workers", instead="one per core")
@scheduler_options
@STEPS
@out_option("improve", "The folder.")
def improve(
    scenario: Path,
    controller: str,
    rounds: int,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    descent: int,
    learning_rate: float | None,
    iterations: int,
    policy: Path | None,
    runs: tuple[Path, ...],
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    steps: int | None,
    out: Path | None,
) -> None:
    """Let a DPC policy learn from its own runs in the microsimulation.

    Every round fits the regional model to all runs so far, descends from the best policy along its own runs, with what
    the model did not foresee of them, and runs what comes of it on the same seeds. It is kept if the geometric mean
    of the total time spent falls. Writes policy.pt, model/, improve.csv and improve.png. The same command goes on where
    it was interrupted, and with more --rounds from where it ended.

    \b
    Example:
      cosim improve grid7_peak --controller dpc-pcrg+max-pressure+guidance-period-60 --demand 1.6,2 --rounds 6
    """
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

    from cosim.evaluation import improve as method  # heavy
    from cosim.report import improve as picture

    order = method.Improvement(
        scenario=scenario,
        controller=controller,
        rounds=rounds,
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        descent=descent,
        learning_rate=learning_rate,
        iterations=iterations,
        policy=policy,
        runs=runs,
        steps=steps,
        out=Path("runs") / f"{file_name(scenario.name)}-improve" if out is None else out,
    )
    with resumable("improve", order.out, "improve.csv") as progress:
        table = method.improve(order, workers=at_a_time(workers), scheduler=cluster, progress=progress, tell=tell)
        picture.draw(order.out / "improve.png", table, runs=len(order.seeds) * len(order.levels))
    click.echo(method.text(order, table))
    click.echo(f"Written to {order.out}: see policy.pt, model, improve.csv and improve.png")


@click.command()
@SCENARIO
@CONTROLLER
@click.option(
    "--against",
    metavar="NAME[+...]",
    help="A rival, which is run with the same seeds: how much of what the bound saves against it the "
    "controller saves as well.",
)
@declared("cosim.evaluation.settings:Bound", "candidates", "knots", "seeds", "first_seed", "demand", "search_seed")
@declared("cosim.evaluation.settings:Bound", "workers", instead="one per core")
@scheduler_options
@STEPS
@out_option("bound", "The folder.")
def bound(
    scenario: Path,
    controller: str,
    against: str | None,
    candidates: int,
    knots: int,
    seeds: int,
    first_seed: int,
    demand: tuple[float, ...],
    search_seed: int,
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    steps: int | None,
    out: Path | None,
) -> None:
    """See how much there is to win: the best that a controller could have done, had it known the day.

    For every seed and demand level, schedules over the horizon are added to what the controller commands, its gates,
    prices and rates of metering, and searched by CMA-ES on that very run. It is no limit, but what a short search
    found; luck is part of it. Writes bound.csv and the searches. The same command goes on where it was interrupted, and
    with more --candidates from where it ended.

    \b
    Example:
      cosim bound grid7_peak --controller dpc-pcrg+max-pressure+guidance-period-60 --demand 1.6 --candidates 60
    """
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

    from cosim.evaluation import bound as method  # heavy

    order = method.Bound(
        scenario=scenario,
        controller=controller,
        against=against,
        candidates=candidates,
        knots=knots,
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        search_seed=search_seed,
        steps=steps,
        out=Path("runs") / f"{file_name(scenario.name)}-bound" if out is None else out,
    )
    with resumable("bound", order.out, "bound.csv") as progress:
        table = method.bound(order, workers=at_a_time(workers), scheduler=cluster, progress=progress, tell=tell)
    click.echo(method.text(order, table))
    click.echo(f"Written to {order.out}: see bound.csv")


@click.command()
@SCENARIO
@controllers_option("Separated by commas. " + CONTROLLER_HELP)
@declared("cosim.evaluation.settings:Range", "demand", "seeds", "first_seed")
@click.option(
    "--everything",
    is_flag=True,
    help="Run every controller at every level, also beyond one at which it served all trips with no seed.",
)
@POLICIES
@EARLIER
@declared("cosim.evaluation.settings:Range", "workers", instead="one per core")
@scheduler_options
@STEPS
@out_option("frontier", "The folder.")
def frontier(
    scenario: Path,
    controllers: str,
    demand: tuple[float, ...],
    seeds: int,
    first_seed: int,
    everything: bool,
    policies: tuple[str, ...],
    earlier: tuple[Path, ...],
    workers: int | None,
    scheduler: str | None,
    scheduler_ca: Path | None,
    scheduler_cert: Path | None,
    scheduler_key: Path | None,
    steps: int | None,
    out: Path | None,
) -> None:
    """Find up to which demand every controller serves all trips: a picture, frontier.png, and a table.

    A controller that serves all trips with none of the seeds of a demand level is not run at higher ones. The runs lie
    as those of cosim evaluate, which finds them there; every one is kept as soon as it is finished.

    \b
    Example:
      cosim frontier grid7_peak --controllers max-pressure,pi-gating+guided+max-pressure --seeds 5
    """
    from cosim.plant.strategy import parse, ready  # heavy

    names = controller_names(controllers, scenario, policies=policies, check=parse, ready=ready)
    files = policy_files(policies, names)
    cluster = chosen_scheduler(workers, scheduler, scheduler_ca, scheduler_cert, scheduler_key)

    from cosim.evaluation import evaluate  # heavy
    from cosim.evaluation import frontier as method
    from cosim.report import frontier as picture
    from nmfd.api import load_scenario

    order = evaluate.Evaluation(
        scenario=scenario,
        controllers=tuple(names),
        seeds=range(first_seed, first_seed + seeds),
        levels=demand,
        steps=steps,
        policies=files,
        earlier=earlier,
        out=Path("runs") / f"{file_name(load_scenario(scenario).name)}-frontier" if out is None else out,
    )
    with resumable("frontier", order.out) as progress:
        table, failures = method.frontier(
            order, everything=everything, workers=at_a_time(workers), scheduler=cluster, progress=progress, tell=tell
        )
        picture.draw(order.out / "frontier.png", table)
    click.echo(method.text(table))
    click.echo(f"Written to {order.out}: see frontier.png and frontier.md")
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")
