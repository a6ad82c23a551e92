"""The commands robustness, bound, ablation and scaling of `nmfd`.

Heavy modules (torch, pandas, matplotlib) are imported inside them: help takes 0.1 s instead of 3 s.
"""

from pathlib import Path

import click

from nmfd.cli.options import COUNT, FILE, FOLDER, POSITIVE, controller_names, policy_files, whole_numbers
from nmfd.cli.progress import progress_line, resumable
from nmfd.errors import InputError


@click.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controllers", required=True, metavar="A,B,...",
              help="Which to run besides no-control; the names as in nmfd benchmark.")
@click.option("--sigmas", default="0,0.25,0.5,0.75,1,1.5,2,3,5", show_default=True, metavar="S,...",
              help="Standard deviations of the noise [veh/s].")
@click.option("--scenarios", type=COUNT, default=20, show_default=True, metavar="N",
              help="Draws of the noise for every sigma.")
@click.option("--where", type=click.Choice(["planned", "pairs", "all"]), default="pairs", show_default=True,
              help="What is perturbed: planned demand while it lasts, its pairs of regions all the time, or all pairs. "
                   "Clipping at zero makes the last two add many trips.")
@click.option("--plant", type=click.Choice(["nmfd", "acyclic"]), default="acyclic", show_default=True,
              help="The model that the controllers act on.")
@click.option("--workers", type=COUNT, default=1, show_default=True, metavar="N",
              help="Runs at a time, each on one core.")
@click.option("--policy", "policies", multiple=True, metavar="NAME=FILE",
              help="The file of a policy (dpc-) or plan (bound-), if not SCENARIO/NAME.pt or .npz. May be repeated.")
@click.option("--out", type=FOLDER, metavar="DIR", help="The run folder. [default: runs/<scenario>-<time>]")
def robustness(
    scenario: Path, controllers: str, sigmas: str, scenarios: int, where: str, plant: str, workers: int,
    policies: tuple[str, ...], out: Path | None,
) -> None:
    """Run controllers against perturbed demand; print a table and draw the improvement over no control.

    Controllers know the demand of the scenario; what comes is max(0, demand + noise) with Gaussian noise of standard
    deviation sigma, drawn for every pair of regions and control interval. The run folder holds robustness.csv,
    robustness.png and manifest.json; the same command with the same --out goes on where it was interrupted, and
    controllers, sigmas or scenarios can be added.

    \b
    Example:
      nmfd robustness scenarios/economic_mpc --controllers pi-gating,dpc-pcrg,dpc-pcrg-robust --out runs/robust
    """
    names = controller_names(controllers)
    files = policy_files(policies, names)
    levels = _sigmas(sigmas)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs import run_folder
    from nmfd.studies import robustness as method

    loaded = load_scenario(scenario)
    out = run_folder.default_folder(loaded.name) if out is None else out
    with resumable("robustness", out, "robustness.csv") as progress:
        rows = method.robustness(
            loaded, names, levels, scenarios, where=where, plant=plant, out=out, policies=files, workers=workers,
            progress=progress)
    click.echo(method.improvement_table(rows))
    click.echo(f"Written to {out}")


@click.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controllers", default="no-control,dpc-pcrg,dpc-pcrg-online", show_default=True, metavar="A,B,...",
              help="Made for the scenario as it is; those in -online are fine-tuned between control steps.")
@click.option("--cases", default="nominal,more,one-origin,later,rain", show_default=True, metavar="A,B,...",
              help="What comes differently: more demand, more from one origin, all of it later, capacity minus 20 %.")
@click.option("--seeds", type=COUNT, default=1, show_default=True, metavar="N",
              help="Of the measurement noise.")
@click.option("--plant", type=click.Choice(["nmfd", "acyclic"]), default="nmfd", show_default=True)
@click.option("--workers", type=COUNT, default=1, show_default=True, metavar="N",
              help="Runs at a time, each on one core. Timings are cleanest with 1.")
@click.option("--policy", "policies", multiple=True, metavar="NAME=FILE",
              help="The file of a policy, if not SCENARIO/NAME.pt. May be repeated.")
@click.option("--out", type=FOLDER, metavar="DIR", help="The run folder. [default: runs/<scenario>-adaptation]")
def adaptation(
    scenario: Path, controllers: str, cases: str, seeds: int, plant: str, workers: int, policies: tuple[str, ...],
    out: Path | None,
) -> None:
    """Compare controllers where demand or capacity is not what they were made for; print a table.

    The run folder holds adaptation.csv and manifest.json; what is there is not run again.

    \b
    Examples:
      nmfd adaptation scenarios/economic_mpc
      nmfd adaptation scenarios/economic_mpc --controllers dpc-pc,dpc-pc-online,pi-gating --cases rain,more
    """
    names = controller_names(controllers)
    files = policy_files(policies, names)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs.files import file_name
    from nmfd.studies import adaptation as method

    loaded = load_scenario(scenario)
    out = Path("runs") / f"{file_name(loaded.name)}-adaptation" if out is None else out
    chosen = list(dict.fromkeys(case.strip() for case in cases.split(",")))
    with resumable("adaptation", out, "adaptation.csv") as progress:
        rows = method.adaptation(
            loaded, names, chosen, range(seeds), out=out, plant=plant, policies=files, workers=workers,
            progress=progress)
    click.echo(method.adaptation_table(rows))
    click.echo(f"Written to {out}")


@click.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controller", required=True, metavar="NAME", help="bound-pc or bound-pcrg.")
@click.option("--from", "starts", metavar="A,B,...",
              help="Controllers whose closed loops it starts from, besides open and half-closed perimeters. "
                   "[default: pi-gating and the DPC policies there are]")
@click.option("--iterations", type=COUNT, metavar="N", help="Adam steps. [default: 1500]")
@click.option("--out", type=FILE, metavar="FILE", help="The plan file. [default: SCENARIO/NAME.npz]")
def bound(scenario: Path, controller: str, starts: str | None, iterations: int | None, out: Path | None) -> None:
    """Compute the bound: the best control of the regional model that knows all demand.

    The plan is written to a file that `nmfd benchmark --controllers bound-pc,bound-pcrg` replays. Ctrl-C ends the
    search early and keeps the best plan so far.

    \b
    Examples:
      nmfd bound scenarios/economic_mpc --controller bound-pcrg
      nmfd bound scenarios/economic_mpc --controller bound-pc --from mpc-pc,dpc-pc
    """
    from nmfd.api import load_scenario  # heavy
    from nmfd.controllers import open_loop
    from nmfd.studies import bound as method

    method.check(controller)
    names = None if starts is None else controller_names(starts)
    loaded = load_scenario(scenario)
    file = scenario / f"{controller}.npz" if out is None else out
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder for the plan; make it or choose another --out")
    steps = iterations or method.ITERATIONS
    with progress_line(controller) as progress:
        plan = method.compute(loaded, controller, starts=names, iterations=steps, progress=progress)
    open_loop.write(plan, loaded, file)
    for name, total in sorted(plan.totals.items(), key=lambda item: item[1]):
        click.echo(f"from {name}: {total:.5g} veh s" + (" (kept)" if name == plan.start else ""))
    click.echo(f"{plan.iterations} Adam steps" + ("" if plan.iterations == steps else ", interrupted"))
    click.echo(f"Written to {file}")


def _sigmas(text: str) -> list[float]:
    """Standard deviations in a list separated by commas. InputError for anything but numbers from 0 up."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [-1.0]
    if not all(0.0 <= value < float("inf") for value in values) or len(set(values)) < len(values):
        raise InputError(f"--sigmas: expected different numbers from 0 up, such as 0,0.5,1, got {text!r} instead")
    return values


@click.command()
@click.argument("what", type=click.Choice(["training", "horizon"]))
@click.argument("scenario", type=FOLDER)
@click.option("--seeds", type=COUNT, default=3, show_default=True, metavar="N",
              help="training: seeds 0 to N-1 with each method.")
@click.option("--controller", default="dpc-pcrg", show_default=True, metavar="NAME", help="training: what is trained.")
@click.option("--steps", type=COUNT, metavar="N", help="training: Adam steps. [default: scenario.toml]")
@click.option("--horizons", default="2,3,4,6,8,10,12,16,20,25,30", show_default=True, metavar="H,...",
              help="horizon: control intervals that MPC looks ahead.")
@click.option("--controllers", default="mpc-pc,mpc-pcrg", show_default=True, metavar="A,B", help="horizon: which MPC.")
@click.option("--plant", type=click.Choice(["nmfd", "acyclic"]), default="acyclic", show_default=True,
              help="The model that MPC and the trained policies act on.")
@click.option("--workers", type=COUNT, default=1, show_default=True, metavar="N",
              help="Runs at a time, each on one core. Timings are cleanest with 1.")
@click.option("--out", type=FOLDER, metavar="DIR", help="The run folder. [default: runs/<scenario>-<time>]")
def ablation(
    what: str, scenario: Path, seeds: int, controller: str, steps: int | None, horizons: str, controllers: str,
    plant: str, workers: int, out: Path | None,
) -> None:
    """Vary one thing and draw its effect: the training of DPC with route guidance, or the horizon of MPC.

    training: the two decoders in turn (alternating) against both at once (joint), with the same Adam steps; the
    validations on the way, and the total time spent of every trained policy on the plant.
    horizon: total time spent and time of a decision over the horizon.

    The run folder holds csv files, a figure and manifest.json. Finished runs are kept: the same command with the same
    --out goes on where it was interrupted, and seeds or horizons can be added.

    \b
    Examples:
      nmfd ablation training scenarios/economic_mpc --seeds 3 --out runs/alternating
      nmfd ablation horizon scenarios/economic_mpc --controllers mpc-pc --out runs/horizon
    """
    names, lengths = controller_names(controllers), whole_numbers("--horizons", horizons, "2,8")

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs import run_folder
    from nmfd.studies import ablation as method

    loaded = load_scenario(scenario)
    out = run_folder.default_folder(loaded.name) if out is None else out
    with resumable(f"ablation {what}", out, f"{what}.csv") as progress:
        if what == "training":
            rows = method.alternating_or_joint(
                loaded, range(seeds), plant=plant, out=out, controller=controller, steps=steps, workers=workers,
                progress=progress)
        else:
            rows = method.horizons(
                loaded, names, lengths, plant=plant, out=out, workers=workers, progress=progress)
    click.echo(method.ablation_table(rows))
    click.echo(f"Written to {out}")


@click.command()
@click.option("--regions", metavar="N,...", help="Numbers of regions. [default: 2,4,8,... to 64, hexagonal to 256]")
@click.option("--controllers", default="dpc-pc,dpc-pcrg,mpc-pc,mpc-pcrg", show_default=True, metavar="A,B,...",
              help="Which to measure, out of these four.")
@click.option("--family", type=click.Choice(["complete", "hexagonal"]), default="complete", show_default=True,
              help="Every region adjacent to every other, as published, or a plane city.")
@click.option("--load", type=click.Choice(["published", "congested"]), default="published", show_default=True,
              help="Initial states: 0 to 100 vehicles bound for every region, or regions up to beyond their jam.")
@click.option("--workers", type=COUNT, default=1, show_default=True, metavar="N",
              help="Cases at a time, each in a process on one core. Timings are cleanest with 1.")
@click.option("--memory", type=POSITIVE, default=16.0, show_default=True,
              metavar="GIB", help="That a case may take.")
@click.option("--time-limit", type=POSITIVE, default=600.0, show_default=True,
              metavar="S", help="That a case may take.")
@click.option("--out", type=FOLDER, default=Path("runs/scaling"), show_default=True, metavar="DIR",
              help="The run folder.")
def scaling(
    regions: str | None, controllers: str, family: str, load: str, workers: int, memory: float, time_limit: float,
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
    names = controller_names(controllers)
    counts = () if regions is None else whole_numbers("--regions", regions, "2,4,8")

    from nmfd.studies import scaling as method  # heavy

    with resumable("scaling", out, "scaling.csv") as progress:
        rows = method.scaling(
            names, out=out, family=family, load=load, regions=counts, workers=workers, memory_gib=memory,
            time_limit=time_limit, progress=progress)
    click.echo(method.scaling_table(rows))
    click.echo(f"Written to {out}")
