"""The commands robustness and bound of `nmfd`.

Heavy modules (torch, pandas, matplotlib) are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from nmfd.cli.declared import declared
from nmfd.cli.options import (
    FILE,
    POLICIES,
    SCENARIO,
    controllers_option,
    out_option,
    policy_files,
    strategies_in,
)
from nmfd.cli.progress import progress_line, resumable
from nmfd.errors import InputError


@click.command()
@SCENARIO
@controllers_option("Which to run besides no-control; the names as in nmfd benchmark.")
@declared("nmfd.studies.settings:Robustness", "sigmas", "scenarios", "where", "plant", "workers")
@POLICIES
@out_option()
def robustness(
    scenario: Path,
    controllers: str,
    sigmas: tuple[float, ...],
    scenarios: int,
    where: str,
    plant: str,
    workers: int,
    policies: tuple[str, ...],
    out: Path | None,
) -> None:
    """Run controllers against perturbed demand; print a table and draw the improvement over no control.

    Controllers know the demand of the scenario; what comes is max(0, demand + noise) with Gaussian noise of standard
    deviation sigma, drawn for every pair of regions and control interval. The run folder holds runs.csv,
    robustness.png and manifest.json; the same command with the same --out goes on where it was interrupted, and
    controllers, sigmas or scenarios can be added.

    \b
    Example:
      nmfd robustness economic_mpc --controllers pi-gating,dpc-pcrg,dpc-pcrg-robust --out runs/robust
    """
    strategies = strategies_in(controllers, scenario)
    files = policy_files(policies, strategies)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs.files import default_folder
    from nmfd.runs.run_many import raise_failures
    from nmfd.studies import robustness as method

    loaded = load_scenario(scenario)
    out = default_folder(loaded.name) if out is None else out
    with resumable("robustness", out, "runs.csv"):
        rows = method.robustness(
            loaded,
            strategies,
            sigmas,
            scenarios,
            where=where,
            plant=plant,
            out=out,
            policies=files,
            workers=workers,
        )
    click.echo(method.improvement_table(rows))
    click.echo(f"Written to {out}")
    raise_failures(rows)


@click.command()
@SCENARIO
@click.option("--controller", required=True, metavar="NAME", help="bound-pc or bound-pcrg.")
@click.option(
    "--from",
    "starts",
    metavar="A,B,...",
    help="Controllers whose closed loops it starts from, besides open and half-closed perimeters. "
    "[default: pi-gating and the DPC policies there are]",
)
@declared("nmfd.studies.settings:Bound", "iterations")
@click.option("--out", type=FILE, metavar="FILE", help="The plan file. [default: SCENARIO/NAME.npz]")
def bound(scenario: Path, controller: str, starts: str | None, iterations: int, out: Path | None) -> None:
    """Compute the bound: the best control of the regional model that knows all demand.

    The plan is written to a file that `nmfd benchmark --controllers bound-pc,bound-pcrg` replays. Ctrl-C ends the
    search early and keeps the best plan so far.

    \b
    Examples:
      nmfd bound economic_mpc --controller bound-pcrg
      nmfd bound economic_mpc --controller bound-pc --from mpc-pc,dpc-pc
    """
    from nmfd.api import load_scenario  # heavy
    from nmfd.controllers import open_loop
    from nmfd.runs import shipped
    from nmfd.studies import bound as method

    method.check(controller)
    begin = None if starts is None else strategies_in(starts, scenario, where="--from")
    loaded = load_scenario(scenario)
    file = out or shipped.beside(
        shipped.found(scenario, shipped.SCENARIO), f"{controller}.npz", "--out FILE", scenario=True
    )
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder for the plan; make it or choose another --out")
    with progress_line(controller) as progress:
        plan = method.compute(loaded, controller, starts=begin, iterations=iterations, progress=progress)
    open_loop.write(plan, loaded, file)
    for name, total in sorted(plan.totals.items(), key=lambda item: item[1]):
        click.echo(f"from {name}: {total:.5g} veh s" + (" (kept)" if name == plan.start else ""))
    click.echo(f"{plan.iterations} Adam steps" + ("" if plan.iterations == iterations else ", interrupted"))
    click.echo(f"Written to {file}")
