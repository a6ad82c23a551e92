"""The command line `cosim`. Heavy modules are imported inside the commands, so that the help answers at once."""

from pathlib import Path

import click

from nmfd.command_line import Commands, Interrupted
from nmfd.errors import InputError

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
CONTROLLER_HELP = "no-control, pi-gating, mpc-pc, mpc-pcrg, dpc-pc or dpc-pcrg."


@click.group(name="cosim", cls=Commands)
@click.version_option(package_name="perimeter-cosim", prog_name="cosim")
def main() -> None:
    """Regional controllers in a SUMO city: run it, compare it with the regional model, identify the model.

    \b
    Example:
      cosim run scenarios/grid7_peak --controller dpc-pcrg --against no-control
    """


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controller", required=True, metavar="NAME", help=CONTROLLER_HELP)
@click.option("--against", metavar="NAME", help="Run this controller too, on the same trips, in a second process.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
              help="Of the trips, the drivers and the guidance.")
@click.option("--steps", type=click.IntRange(min=1), metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--policy", type=FILE, metavar="FILE", help="Policy of a DPC controller, if not SCENARIO/NAME.pt.")
@click.option("--out", type=FOLDER, metavar="DIR", help="The run folder. [default: runs/<scenario>-<time>]")
def run(
    scenario: Path, controller: str, against: str | None, seed: int, steps: int | None, policy: Path | None,
    out: Path | None,
) -> None:
    """Run a controller in the microsimulation; print a table and write a run folder.

    SCENARIO is a folder with a scenario.toml on a network that SUMO can simulate. The run folder holds summary.csv,
    sumo.csv, trajectories and records, manifest.json and pictures. The same --out goes on where it was interrupted.

    \b
    Examples:
      cosim run scenarios/grid7_peak --controller dpc-pcrg --against no-control
      cosim run scenarios/grid7_peak --controller pi-gating --seed 3 --out runs/gating
    """
    from nmfd.controllers import registry

    names = [controller] + ([against] if against and against != controller else [])
    for name in names:
        registry.check(name)

    from cosim import experiment
    from cosim.simulate import Task

    tasks = [
        Task(scenario=scenario, controller=name, seed=seed, policy=policy if name == controller else None, steps=steps)
        for name in names]
    out, rows = _experiment(tasks, out)
    click.echo(experiment.table(rows))
    click.echo(f"Written to {out}: see total_accumulation.png and region_accumulation.png")


@main.command()
@click.argument("target", type=FOLDER, metavar="SCENARIO|RUN")
@click.option("--controller", default="no-control", show_default=True, metavar="NAME", help=CONTROLLER_HELP)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--steps", type=click.IntRange(min=1), metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="Run folder of a SCENARIO. [default: runs/<scenario>-<time>]")
def compare(target: Path, controller: str, seed: int, steps: int | None, out: Path | None) -> None:
    """Compare microsimulated accumulations with what the regional model predicts.

    For a scenario, the microsimulation is run first; for the run folder of `cosim run`, its record is used. Then the
    regional model is driven with the recorded departures and controls. Writes compare.csv and pictures beside the run.

    \b
    Examples:
      cosim compare scenarios/grid7_peak --controller no-control
      cosim compare runs/gating --controller pi-gating --seed 3
    """
    import json

    from cosim import compare, experiment
    from cosim.simulate import Task, scenario_of

    if (target / "manifest.json").is_file():
        if out is not None:
            raise InputError(f"--out: {out}: a comparison is written into its run folder {target}; leave --out away")
        manifest = json.loads((target / "manifest.json").read_text())
        task = Task(
            scenario=Path(manifest["sessions"][-1]["scenario_folder"]), controller=controller, seed=seed,
            steps=manifest["configuration"]["steps"], demand_factor=manifest["configuration"]["demand_factor"])
        out = target
    else:
        task = Task(scenario=target, controller=controller, seed=seed, steps=steps)
        out, _ = _experiment([task], out)
    result = experiment.read_run(out, controller, seed)
    rows = compare.write(out, scenario_of(task), result)
    click.echo(compare.table(rows))
    click.echo(f"Written to {out}: see compare-{controller}-{seed}-accumulation.png and ...-mfd.png")


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--levels", default="0.6,0.8,1.0", show_default=True, metavar="A,B,...",
              help="The loading runs: multiples of the scenario's demand.")
@click.option("--seeds", type=click.IntRange(min=1), default=2, show_default=True, metavar="N",
              help="Loading runs per level, with seeds 1000 to 1000 + N - 1.")
@click.option("--workers", type=click.IntRange(min=1), default=2, show_default=True, metavar="N")
@click.option("--out", type=FOLDER, metavar="DIR", help="Samples and pictures. [default: runs/<scenario>-identify]")
def identify(scenario: Path, levels: str, seeds: int, workers: int, out: Path | None) -> None:
    """Fit the MFDs and the drivers' own split ratios of a SUMO city; writes its network.toml.

    The city is loaded with multiples of the scenario's demand under no control. Policies that were trained on the
    network as it was before do not fit the new one: train them again.

    \b
    Example:
      cosim identify scenarios/grid7_peak --levels 0.6,0.8,1.0 --seeds 2
    """
    from cosim import identify
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    try:
        factors = [float(level) for level in levels.split(",")]
    except ValueError:
        factors = [0.0]
    if not all(0.0 < factor <= 10.0 for factor in factors):
        raise InputError(f"--levels: expected numbers above 0 up to 10, such as 0.6,0.8,1.0, got {levels!r} instead")
    loaded = load_scenario(scenario)
    out = Path("runs") / f"{runs.file_name(loaded.name)}-identify" if out is None else out
    try:
        with progress_line("identify") as progress:
            text = identify.identify(scenario, factors, range(1000, 1000 + seeds), out=out, workers=workers,
                                     progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; finished loading runs are in {out}: the same command goes on") from None
    click.echo(text)
    click.echo(f"Written to {loaded.network.folder / 'network.toml'}; samples and pictures to {out}")


@main.command(name="import")
@click.argument("source", type=FILE, metavar="SUMOCFG|NET")
@click.option("--regions", type=click.IntRange(min=2), metavar="N", help="How many regions to cut the city into.")
@click.option("--out", type=FOLDER, required=True, metavar="DIR", help="The network's folder, such as networks/mycity.")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="[default: scenarios/<name>, beside the networks]")
@click.option("--method", type=click.Choice(["density", "geometric"]), default="density", show_default=True,
              help="How: streets of similar density together, or k-means on the road graph.")
@click.option("--edges", type=FILE, metavar="CSV", help="Or your own regions: a table with the columns edge,region,")
@click.option("--taz", type=FILE, metavar="FILE", help="or a SUMO file with a TAZ per region,")
@click.option("--polygons", type=FILE, metavar="FILE", help="or one with a polygon or more (id, id.1, ...) per region.")
@click.option("--begin", metavar="TIME", help="Instead of the sumocfg's, in seconds or as hours:minutes:seconds.")
@click.option("--end", metavar="TIME", help="Later departures are left out.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--no-run", is_flag=True, help="Do not simulate the city first: no densities, no measured boundary flows.")
@click.option("--force", is_flag=True, help="Replace a network and scenario that are there.")
def import_(
    source: Path, regions: int | None, out: Path, scenario: Path | None, method: str, edges: Path | None,
    taz: Path | None, polygons: Path | None, begin: str | None, end: str | None, seed: int, no_run: bool, force: bool,
) -> None:
    """Turn any SUMO city into a network and a scenario: regions, gateways, demand by pair of regions, map.

    Its own vehicles stay as they are: routes, departures, types. The city is simulated without control first.

    \b
    Examples:
      cosim import city.sumocfg --regions 5 --out networks/mycity
      cosim import city.sumocfg --taz districts.taz.xml --out networks/mycity --begin 7:00:00 --end 9:00:00
    """
    from cosim.importing.importer import Order, import_city, parse_time
    from nmfd.progress import progress_line

    own = {key: file for key, file in (("edges", edges), ("taz", taz), ("polygons", polygons)) if file}
    if len(own) + (regions is not None) != 1:
        raise InputError("--regions: give a number of regions, or else one of --edges, --taz and --polygons")
    if no_run and method == "density" and not own:
        raise InputError("--no-run: the densities come from that run; add --method geometric")
    method, given = next(iter(own.items()), (method, None))
    order = Order(
        source=source, regions=regions, out=out, method=method, given=given, seed=seed, run=not no_run, force=force,
        scenario=scenario or out.parent.parent / "scenarios" / out.name, begin=parse_time(begin, "--begin"),
        end=parse_time(end, "--end"))
    with progress_line("import") as progress:
        report = import_city(order, (lambda stage: progress(0, 1, stage)) if progress else lambda stage: None)
    click.echo(report)
    click.echo(f"Written to {order.out} (see map.png, quality.csv, gateways.csv) and {order.scenario}")


def _experiment(tasks: list, out: Path | None) -> tuple:
    """The run folder of the tasks, and its overview."""
    from cosim import experiment
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    out = runs.default_folder(load_scenario(tasks[0].scenario)) if out is None else out
    try:
        with progress_line("cosim") as progress:
            return out, experiment.experiment(tasks, out=out, workers=2, progress=progress)
    except KeyboardInterrupt:
        if not (out / "summary.csv").exists():
            raise Interrupted("interrupted before a run was finished; nothing is kept") from None
        raise Interrupted(f"interrupted; finished runs are in {out}: the same command with --out goes on") from None


if __name__ == "__main__":
    main()
