"""The commands robustness, bound, ablation and scaling of `nmfd`.

Heavy modules (torch, pandas, matplotlib) are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from nmfd.cli.declared import declared
from nmfd.cli.options import (
    ADAM_STEPS,
    FILE,
    FOLDER,
    POLICIES,
    SCENARIO,
    controller_names,
    controllers_option,
    out_option,
    policy_files,
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
    deviation sigma, drawn for every pair of regions and control interval. The run folder holds robustness.csv,
    robustness.png and manifest.json; the same command with the same --out goes on where it was interrupted, and
    controllers, sigmas or scenarios can be added.

    \b
    Example:
      nmfd robustness economic_mpc --controllers pi-gating,dpc-pcrg,dpc-pcrg-robust --out runs/robust
    """
    names = controller_names(controllers, scenario, policies=policies)
    files = policy_files(policies, names)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs import run_folder
    from nmfd.studies import robustness as method

    loaded = load_scenario(scenario)
    out = run_folder.default_folder(loaded.name) if out is None else out
    with resumable("robustness", out, "robustness.csv") as progress:
        rows = method.robustness(
            loaded,
            names,
            sigmas,
            scenarios,
            where=where,
            plant=plant,
            out=out,
            policies=files,
            workers=workers,
            progress=progress,
        )
    click.echo(method.improvement_table(rows))
    click.echo(f"Written to {out}")


@click.command()
@SCENARIO
@controllers_option(
    "Made for the scenario as it is; those in -online are fine-tuned between control steps.",
    "no-control,dpc-pcrg,dpc-pcrg-online",
)
@declared("nmfd.studies.settings:Adaptation", "cases", "seeds", "plant", "workers")
@POLICIES
@out_option("adaptation")
def adaptation(
    scenario: Path,
    controllers: str,
    cases: tuple[str, ...],
    seeds: int,
    plant: str,
    workers: int,
    policies: tuple[str, ...],
    out: Path | None,
) -> None:
    """Compare controllers where demand or capacity is not what they were made for; print a table.

    The run folder holds adaptation.csv and manifest.json; what is there is not run again.

    \b
    Examples:
      nmfd adaptation economic_mpc
      nmfd adaptation economic_mpc --controllers dpc-pc,dpc-pc-online,pi-gating --cases rain,more
    """
    names = controller_names(controllers, scenario, policies=policies)
    files = policy_files(policies, names)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs.files import file_name
    from nmfd.studies import adaptation as method

    loaded = load_scenario(scenario)
    out = Path("runs") / f"{file_name(loaded.name)}-adaptation" if out is None else out
    with resumable("adaptation", out, "adaptation.csv") as progress:
        rows = method.adaptation(
            loaded,
            names,
            list(dict.fromkeys(cases)),
            range(seeds),
            out=out,
            plant=plant,
            policies=files,
            workers=workers,
            progress=progress,
        )
    click.echo(method.adaptation_table(rows))
    click.echo(f"Written to {out}")


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
    names = None if starts is None else controller_names(starts, scenario, where="--from")
    loaded = load_scenario(scenario)
    file = out or shipped.beside(
        shipped.found(scenario, shipped.SCENARIO), f"{controller}.npz", "--out FILE", scenario=True
    )
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder for the plan; make it or choose another --out")
    with progress_line(controller) as progress:
        plan = method.compute(loaded, controller, starts=names, iterations=iterations, progress=progress)
    open_loop.write(plan, loaded, file)
    for name, total in sorted(plan.totals.items(), key=lambda item: item[1]):
        click.echo(f"from {name}: {total:.5g} veh s" + (" (kept)" if name == plan.start else ""))
    click.echo(f"{plan.iterations} Adam steps" + ("" if plan.iterations == iterations else ", interrupted"))
    click.echo(f"Written to {file}")


@click.command()
@SCENARIO
@click.option("--controller", required=True, metavar="NAME", help="mpc-pc-terminal or mpc-pcrg-terminal.")
@declared("nmfd.studies.settings:Value", "seed", "samples", "rounds", "steps")
@click.option(
    "--policy",
    type=FILE,
    metavar="FILE",
    help="Of dpc-pc or dpc-pcrg, which take over after the horizon. [default: the scenario's own]",
)
@click.option("--out", type=FILE, metavar="FILE", help="The file. [default: SCENARIO/NAME.npz]")
def value(
    scenario: Path,
    controller: str,
    seed: int,
    samples: int,
    rounds: int,
    steps: int,
    policy: Path | None,
    out: Path | None,
) -> None:
    """Learn the terminal cost of MPC: what a DPC policy makes of the state at the end of its horizon.

    With it a horizon of eight intervals is short-sighted no more. Learned from rollouts of the policy on the regional
    model; the same seed gives the same numbers.

    \b
    Example:
      nmfd value economic_mpc --controller mpc-pcrg-terminal
    """
    from nmfd.api import load_scenario  # heavy
    from nmfd.controllers.mpc import terminal
    from nmfd.runs import shipped
    from nmfd.studies import terminal_cost as method

    method.check(controller)
    file = out or shipped.beside(
        shipped.found(scenario, shipped.SCENARIO), f"{controller}.npz", "--out FILE", scenario=True
    )
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder for the value function; make it or choose another --out")
    with progress_line(controller) as progress:
        found = method.learn(
            load_scenario(scenario),
            controller,
            seed=seed,
            samples=samples,
            rounds=rounds,
            steps=steps,
            policy=policy,
            progress=progress,
        )
    terminal.write(found, file)
    click.echo(f"Written to {file}")


@click.command()
@click.argument("what", type=click.Choice(["training", "horizon"]))
@SCENARIO
@declared("nmfd.studies.settings:Ablation", "seeds", "horizons", "plant", "workers")
@click.option("--controller", default="dpc-pcrg", show_default=True, metavar="NAME", help="Training: what is trained.")
@ADAM_STEPS
@controllers_option("Horizon: which MPC.", "mpc-pc,mpc-pcrg")
@out_option()
def ablation(
    what: str,
    scenario: Path,
    seeds: int,
    controller: str,
    steps: int | None,
    horizons: tuple[int, ...],
    controllers: str,
    plant: str,
    workers: int,
    out: Path | None,
) -> None:
    """Vary one thing and draw its effect: the training of DPC with route guidance, or the horizon of MPC.

    training: the two decoders in turn (alternating) against both at once (joint), with the same Adam steps; the
    validations on the way, and the total time spent of every trained policy on the plant.
    horizon: total time spent and time of a decision over the horizon.

    The run folder holds csv files, a figure and manifest.json. Finished runs are kept: the same command with the same
    --out goes on where it was interrupted, and seeds or horizons can be added.

    \b
    Examples:
      nmfd ablation training economic_mpc --seeds 3 --out runs/alternating
      nmfd ablation horizon economic_mpc --controllers mpc-pc --out runs/horizon
    """
    names = controller_names(controllers, scenario)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs import run_folder
    from nmfd.studies import ablation as method

    loaded = load_scenario(scenario)
    out = run_folder.default_folder(loaded.name) if out is None else out
    with resumable(f"ablation {what}", out, f"{what}.csv") as progress:
        if what == "training":
            rows = method.alternating_or_joint(
                loaded,
                range(seeds),
                plant=plant,
                out=out,
                controller=controller,
                steps=steps,
                workers=workers,
                progress=progress,
            )
        else:
            rows = method.horizons(loaded, names, horizons, plant=plant, out=out, workers=workers, progress=progress)
    click.echo(method.ablation_table(rows))
    click.echo(f"Written to {out}")


@click.command()
@declared("nmfd.studies.settings:Scaling", "regions", instead="2,4,8,... to 64, hexagonal to 256")
@controllers_option("Which to measure, out of these four and dpc-pc-local.", "dpc-pc,dpc-pcrg,mpc-pc,mpc-pcrg")
@declared("nmfd.studies.settings:Scaling", "family", "load", "workers", "memory", "time_limit")
@click.option(
    "--out", type=FOLDER, default=Path("runs/scaling"), show_default=True, metavar="DIR", help="The run folder."
)
def scaling(
    regions: tuple[int, ...] | None,
    controllers: str,
    family: str,
    load: str,
    workers: int,
    memory: float,
    time_limit: float,
    out: Path,
) -> None:
    """Measure the time of a decision and its memory against the number of regions; print a table and draw it.

    Random MFDs and initial states, ten control intervals, the median of all decisions but the first. The policies
    are untrained. The run folder holds scaling.csv, scaling.png and manifest.json; what is there is not run again, and
    other families, loads, regions and controllers are added to it.

    \b
    Examples:
      nmfd scaling
      nmfd scaling --family hexagonal --load congested --controllers dpc-pcrg,mpc-pcrg --regions 7,19,37
    """
    from nmfd.studies import scaling as method  # heavy

    names = controller_names(controllers, check=method.known, ready=lambda: method.CONTROLLERS)

    with resumable("scaling", out, "scaling.csv") as progress:
        rows = method.scaling(
            names,
            out=out,
            family=family,
            load=load,
            regions=regions or (),
            workers=workers,
            memory_gib=memory,
            time_limit=time_limit,
            progress=progress,
        )
    click.echo(method.scaling_table(rows))
    click.echo(f"Written to {out}")
