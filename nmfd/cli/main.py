"""The command line `nmfd`. Heavy modules are imported inside the commands, so that the help answers at once."""

from pathlib import Path

import click

from nmfd.cli.about import about, overview
from nmfd.cli.declared import declared
from nmfd.cli.errors import Commands, Interrupted
from nmfd.cli.exchange import identify, new_controller
from nmfd.cli.options import (
    ADAM_STEPS,
    FILE,
    FOLDER,
    POLICIES,
    SCENARIO,
    SEED,
    controllers_option,
    out_option,
    policy_files,
    quoted,
    strategies_in,
)
from nmfd.cli.progress import progress_line, resumable
from nmfd.cli.studies import bound, robustness
from nmfd.errors import InputError


@click.group(name="nmfd", cls=Commands)
@about("nmfd")
def main() -> None:
    """Perimeter control and route guidance on the regional traffic model (NMFD).

    \b
    Example:
      nmfd benchmark economic_mpc --controllers no-control,pi-gating
    """


@main.command()
@SCENARIO
@controllers_option(
    "Which to run: no-control, route-guidance, pi-gating, greedy, mpc-pc, mpc-pcrg, "
    "mpc-pc-terminal, mpc-pcrg-terminal, probing-pc, "
    "probing-pcrg, dpc-pc, dpc-pcrg, bound-pc, bound-pcrg, or file.py:Class "
    "(see nmfd new-controller)."
)
@declared("nmfd.studies.settings:Study", "seeds", "plant", "workers")
@POLICIES
@out_option()
def benchmark(
    scenario: Path,
    controllers: str,
    seeds: int,
    plant: str,
    workers: int,
    policies: tuple[str, ...],
    out: Path | None,
) -> None:
    """Run controllers on a regional model; print a table and write a run folder.

    SCENARIO is, here and in all commands, a name of nmfd list, or a folder with a scenario.toml. The run folder holds
    runs.csv, a netCDF file per run, manifest.json and figures. Every finished run is kept: the same command with the same
    --out goes on where it was interrupted, and other controllers or more seeds are added to what is there.

    \b
    Examples:
      nmfd benchmark economic_mpc --controllers no-control,pi-gating
      nmfd benchmark economic_mpc --controllers no-control,dpc-pc \\
          --seeds 5 --plant acyclic --workers 2 --policy dpc-pc=mine.pt --out runs/mine
    """
    strategies = strategies_in(controllers, scenario)
    files = policy_files(policies, strategies)

    from nmfd.api import load_scenario  # heavy
    from nmfd.runs.files import default_folder
    from nmfd.runs.run_many import raise_failures
    from nmfd.studies import benchmark as study

    loaded = load_scenario(scenario)
    out = default_folder(loaded.name) if out is None else out
    with resumable("benchmark", out, "runs.csv"):
        rows = study.benchmark(loaded, strategies, range(seeds), plant, out=out, policies=files, workers=workers)
    click.echo(f"{loaded.name}, {plant} plant, {loaded.steps} control intervals of {loaded.step:g} s")
    click.echo(study.summary_table(rows))
    click.echo(f"Written to {out}")
    raise_failures(rows)


@main.command()
@SCENARIO
@click.option("--controller", required=True, metavar="NAME", help="dpc-pc or dpc-pcrg.")
@click.option(
    "--seed", type=SEED, default=0, show_default=True, help="Of the initial weights and the training scenarios."
)
@ADAM_STEPS
@click.option("--out", type=FILE, metavar="FILE", help="The policy file. [default: SCENARIO/NAME.pt]")
@click.option("--resume", is_flag=True, help="Go on with an interrupted training.")
@click.option("--anyway", is_flag=True, help="Even on placeholder MFDs, or where no gateway can be controlled.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="auto: a GPU where there is one. The CPU gives the same weights every time.",
)
@click.option(
    "--compile/--no-compile",
    "compiled",
    default=None,
    help="Compile the rollout: a minute or two first, then about twice as fast. [default: from 200 Adam "
    "steps up, where there is a C++ compiler]",
)
def train(
    scenario: Path,
    controller: str,
    seed: int,
    steps: int | None,
    out: Path | None,
    resume: bool,
    anyway: bool,
    device: str,
    compiled: bool | None,
) -> None:
    """Train a DPC policy on a scenario.

    Of an imported city, identify it first: on placeholder MFDs, and for a city of which no gateway can be controlled,
    nothing is trained.

    The policy that does best in validation is in the policy file at any time; Ctrl-C keeps it, and --resume goes on.

    \b
    Examples:
      nmfd train economic_mpc --controller dpc-pcrg
      nmfd train economic_mpc --controller dpc-pc --steps 200 --out mine.pt
    """
    from nmfd.api import load_scenario  # heavy
    from nmfd.controllers.dpc import rollout, training
    from nmfd.controllers.strategy import parse
    from nmfd.runs import shipped

    loaded = load_scenario(scenario)
    device = training.available(device)
    strategy = parse(controller)
    chosen = training.settings(loaded, strategy, steps)  # complains of the name before a file is named after it
    if not anyway:
        model = training.check(loaded, strategy)
        for name, doubts in zip(model.region_names, model.doubts, strict=False):
            if doubts:
                click.echo(f"nmfd: the model of region {name} is doubtful: {'; '.join(doubts)}", err=True)
    file = out or shipped.beside(
        shipped.found(scenario, shipped.SCENARIO), f"{controller}.pt", "--out FILE", scenario=True
    )
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder for the policy; make it or choose another --out")
    default = compiled is None
    if compiled is None:
        compiled = chosen.descend and chosen.steps >= training.WORTH_COMPILING
    if compiled and not rollout.can_compile(device):
        if not default:
            raise InputError(
                "--compile: does not work here, most likely for want of a C++ compiler; install g++ or omit it"
            )
        compiled = False
        click.echo(
            "nmfd: cannot compile here, most likely for want of a C++ compiler; training goes on uncompiled, "
            "about half as fast",
            err=True,
        )
    state = file.with_name(file.name + ".resume")
    before = _stamp(state)
    notes = ["no validation yet"]
    try:
        with progress_line(controller) as line:

            def progress(done: int, total: int, note: str) -> None:
                notes.append(note)
                line(done, total, note)

            training.train(
                loaded,
                strategy,
                seed=seed,
                out=file,
                steps=steps,
                resume=resume,
                device=device,
                compiled=compiled,
                anyway=anyway,
                progress=progress,
            )
    except KeyboardInterrupt:
        if not resume and _stamp(state) == before:
            raise Interrupted("interrupted before the first validation; nothing is kept") from None
        again = f"nmfd train {quoted(scenario)} --controller {controller}"
        again += f" --seed {seed}" if seed else ""
        again += f" --steps {steps}" if steps else ""
        again += f" --out {quoted(out)}" if out else ""
        again += " --anyway" if anyway else ""
        again += f" --device {device}" if device != "cpu" else ""
        again += "" if default else f" --{'' if compiled else 'no-'}compile"
        raise Interrupted(f"interrupted; the best policy so far is {file}; go on with: {again} --resume") from None
    click.echo(f"{controller}: {notes[-1]} in validation")
    click.echo(f"Written to {file}")


@main.command()
@click.argument("scenario", type=FOLDER, required=False)
@out_option("show", "Where the figures go.")
def show(scenario: Path | None, out: Path | None) -> None:
    """Draw a scenario: its demand, region map and MFDs; without SCENARIO, list what comes with the package.

    \b
    Example:
      nmfd show economic_mpc --out figures
    """
    if scenario is None:
        click.echo(overview())
        return
    from nmfd.api import load_scenario  # heavy
    from nmfd.runs.files import file_name
    from nmfd.studies.benchmark import draw_scenario

    loaded = load_scenario(scenario)
    out = Path("runs") / f"{file_name(loaded.name)}-show" if out is None else out
    out.mkdir(parents=True, exist_ok=True)
    files = draw_scenario(out, loaded)
    total = loaded.step * loaded.demand.sum()
    click.echo(
        f"{loaded.name}: {loaded.network.regions} regions, {total:,.0f} trips between "
        f"{int((loaded.demand.sum(axis=0) > 0).sum())} pairs, peak {loaded.demand.sum(axis=(1, 2)).max():.3g} veh/s, "
        f"{loaded.steps} control intervals of {loaded.step:g} s"
    )
    for file in files:
        click.echo(f"Written to {file}")


def _stamp(path: Path) -> int | None:
    """When `path` was written last [ns]; None without it."""
    return path.stat().st_mtime_ns if path.exists() else None


for command in (bound, robustness, new_controller, identify):
    main.add_command(command)
