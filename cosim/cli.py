"""The command line `cosim`. Heavy modules are imported inside the commands, so that the help answers at once."""

from pathlib import Path

import click

from nmfd.command_line import Commands, Interrupted
from nmfd.errors import InputError
from nmfd.options import COUNT, FILE, FOLDER, LEVEL, SEED, Positive, fault_option
from nmfd.workers import RunFailed

CONTROLLER_HELP = (
    "no-control, pi-gating, mpc-pc, mpc-pcrg, dpc-pc or dpc-pcrg; what else the city does is joined by +: webster, "
    "actuated or max-pressure signals, rerouting-N (percent of the drivers), hold-back or redistribute, compliance-N. "
    "A controller of your own: file.py:Class (see nmfd new-controller).")


@click.group(name="cosim", cls=Commands)
@click.version_option(package_name="perimeter-cosim", prog_name="cosim")
def main() -> None:
    """Regional controllers in a SUMO city: run, evaluate, compare with the regional model, identify it.

    \b
    Example:
      cosim run scenarios/grid7_peak --controller dpc-pcrg --against no-control
    """


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controller", required=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
@click.option("--against", metavar="NAME", help="Run this controller too, on the same trips, in a second process.")
@click.option("--seed", type=SEED, default=0, show_default=True,
              help="Of the trips, the drivers and the guidance.")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--policy", type=FILE, metavar="FILE", help="Policy of a DPC controller, if not SCENARIO/NAME.pt.")
@click.option("--sumo-output", metavar="A,B,...",
              help="SUMO's own outputs in the run folder too: tripinfo, summary, edgedata (per control interval), "
                   "emission (of every vehicle in every step, large).")
@click.option("--parquet", is_flag=True, help="Write the tables as Parquet files too (nmfd.frames).")
@fault_option("closed:EDGE, signal:NAME, sumo-exits")
@click.option("--out", type=FOLDER, metavar="DIR", help="The run folder. [default: runs/<scenario>-<time>]")
def run(
    scenario: Path, controller: str, against: str | None, seed: int, steps: int | None, policy: Path | None,
    sumo_output: str | None, parquet: bool, faults: tuple[str, ...], out: Path | None,
) -> None:
    """Run a controller in the microsimulation; print a table and write a run folder.

    SCENARIO is a folder with a scenario.toml on a network that SUMO can simulate. The run folder holds summary.csv,
    sumo.csv, trajectories and records, manifest.json and pictures. The same --out goes on where it was interrupted,
    even by kill -9: finished runs are kept, and the one that was under way starts again from its beginning.

    \b
    Examples:
      cosim run scenarios/grid7_peak --controller dpc-pcrg --against no-control
      cosim run scenarios/grid7_peak --controller pi-gating --seed 3 --out runs/gating
      cosim run scenarios/grid7_peak --controller dpc-pc+rerouting-30 --against rerouting-30
      cosim run scenarios/grid7_peak --controller pi-gating --sumo-output tripinfo,edgedata --parquet
      cosim run scenarios/grid7_peak --controller dpc-pc --fault missing:3@20-30 --fault closed:c33-c34@10-40
    """
    from cosim import strategy
    from cosim import sumo_output as outputs

    kinds = outputs.parse(sumo_output) if sumo_output is not None else ()
    names = [controller] + ([against] if against and against != controller else [])
    for name in names:
        strategy.parse(name)

    from cosim import estimates, experiment
    from cosim.simulate import Task

    tasks = [
        Task(scenario=scenario, controller=name, seed=seed, policy=policy if name == controller else None, steps=steps,
             faults=faults)
        for name in names]
    out, rows = _experiment(tasks, out, kinds)
    click.echo(experiment.table(rows))
    if parquet:
        from nmfd import frames

        frames.write(out, experiment.trajectories(out), {"summary": rows})
    if (out / "estimation.csv").is_file():
        import pandas as pd

        click.echo(estimates.table(pd.read_csv(out / "estimation.csv")))
    click.echo(f"Written to {out}: see total_accumulation.png and region_accumulation.png")


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controllers", required=True, metavar="A,B,...", help="Separated by commas. " + CONTROLLER_HELP)
@click.option("--seeds", type=COUNT, default=10, show_default=True, metavar="N",
              help="Runs per controller and demand level, on the same trips for all controllers.")
@click.option("--first-seed", type=SEED, default=2000, show_default=True, metavar="S",
              help="The seeds are S to S + N - 1. From 2000 on they were never used in development.")
@click.option("--demand", default="1.0", show_default=True, metavar="A,B,...",
              help="Demand levels: multiples of the scenario's demand.")
@click.option("--reference", metavar="NAME", help="Pair all controllers with this one too, besides no-control.")
@click.option("--policy", "policies", multiple=True, metavar="NAME=FILE",
              help="Policy of a DPC controller, if not SCENARIO/NAME.pt. May be repeated.")
@click.option("--workers", type=COUNT, metavar="N",
              help="Runs at a time, each in a process of its own. [default: one per core]")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="The folder. [default: runs/<scenario>-evaluate]")
def evaluate(
    scenario: Path, controllers: str, seeds: int, first_seed: int, demand: str, reference: str | None,
    policies: tuple[str, ...], workers: int | None, steps: int | None, out: Path | None,
) -> None:
    """Compare controllers in the microsimulation over seeds and demand levels; print and write tables, draw figures.

    Every run is kept as soon as it is finished. The same command goes on where it was interrupted, and more seeds,
    controllers or demand levels are added to what is there; only the runs of a controller whose own options, policy
    or model changed are done again.

    \b
    Examples:
      cosim evaluate scenarios/grid7_peak --controllers no-control,pi-gating,dpc-pc --seeds 10
      cosim evaluate scenarios/grid7_peak --controllers no-control,dpc-pc --demand 0.8,1.0,1.3 --out runs/levels
    """
    from cosim.strategy import parse
    from nmfd.options import policy_files

    names = [name.strip() for name in controllers.split(",")]
    for name in names:
        parse(name)
    if repeated := [name for n, name in enumerate(names) if name in names[:n]]:
        raise InputError(f"--controllers: {repeated[0]} is there twice; name every controller once")
    files = policy_files(policies, names)

    import os

    from cosim import evaluate, tables
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    loaded = load_scenario(scenario)
    chosen = evaluate.Evaluation(
        scenario=scenario, controllers=tuple(names), seeds=range(first_seed, first_seed + seeds),
        levels=tuple(_levels("--demand", demand)), steps=steps, policies=files, reference=reference,
        out=Path("runs") / f"{runs.file_name(loaded.name)}-evaluate" if out is None else out)
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    try:
        with progress_line("evaluate") as progress:
            table, failures = evaluate.evaluate(chosen, workers=workers, progress=progress, tell=_tell)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; finished runs are in {chosen.out}: the same command goes on") from None
    if len(table):
        click.echo(tables.text(table, reference))
        click.echo(f"Written to {chosen.out}: see evaluate.md, pairs.csv and the pictures")
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controllers", required=True, metavar="A,B,...", help="Separated by commas. " + CONTROLLER_HELP)
@click.option("--seeds", type=COUNT, default=1, show_default=True, metavar="N",
              help="Runs per controller, demand level and compliance.")
@click.option("--first-seed", type=SEED, default=0, show_default=True, metavar="S",
              help="The seeds are S to S + N - 1.")
@click.option("--demand", default="1.0", show_default=True, metavar="A,B,...",
              help="Demand levels: multiples of the scenario's demand.")
@click.option("--compliance", metavar="A,B,...",
              help="Drivers who follow route guidance [%], such as 0,50,100. [default: the scenario's]")
@click.option("--policy", "policies", multiple=True, metavar="NAME=FILE",
              help="Policy of a DPC controller, if not SCENARIO/NAME.pt. May be repeated.")
@click.option("--workers", type=COUNT, metavar="N",
              help="Runs at a time, each in a process of its own. [default: one per core]")
@click.option("--scheduler", metavar="ADDRESS",
              help="Of a Dask cluster that does the runs, such as tcp://host:8786 (extra dask). Its workers need this "
                   "package, and the same files under the same paths.")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="The folder. [default: runs/<scenario>-sweep]")
def sweep(
    scenario: Path, controllers: str, seeds: int, first_seed: int, demand: str, compliance: str | None,
    policies: tuple[str, ...], workers: int | None, scheduler: str | None, steps: int | None, out: Path | None,
) -> None:
    """Run controllers x seeds x demand levels x compliance; write one table, sweep.parquet.

    A run that fails is a row with its reason, and the others go on. Every run is kept as soon as it is finished: the
    same command goes on where it was interrupted, tries failed runs again, and adds what is asked for besides.

    \b
    Examples:
      cosim sweep scenarios/grid7_peak --controllers dpc-pcrg,rerouting-30 --compliance 0,50,100 --seeds 3
      cosim sweep scenarios/grid7_peak --controllers no-control,pi-gating --demand 0.8,1.0,1.2 \\
          --scheduler tcp://localhost:8786 --out runs/cluster
    """
    from cosim.strategy import parse
    from nmfd.options import policy_files

    names = [name.strip() for name in controllers.split(",")]
    for name in names:
        parse(name)
    if repeated := [name for n, name in enumerate(names) if name in names[:n]]:
        raise InputError(f"--controllers: {repeated[0]} is there twice; name every controller once")
    if scheduler is not None and workers is not None:
        raise InputError("--workers: is for processes here, and --scheduler has workers of its own; leave one away")
    files = policy_files(policies, names)

    import os

    from cosim import sweeps
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    order = sweeps.Sweep(
        scenario=scenario, controllers=tuple(names), seeds=range(first_seed, first_seed + seeds),
        levels=tuple(_levels("--demand", demand)), compliance=_compliance(compliance), steps=steps, policies=files,
        out=Path("runs") / f"{runs.file_name(load_scenario(scenario).name)}-sweep" if out is None else out)
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    try:
        with progress_line("sweep") as progress:
            rows = sweeps.sweep(order, workers=workers, scheduler=scheduler, progress=progress, tell=_tell)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; finished runs are in {order.out}: the same command goes on") from None
    click.echo(sweeps.text(rows))
    click.echo(f"Written to {order.out / 'sweep.parquet'}")
    if failed := int((rows["status"] == sweeps.FAILED).sum()):
        _tell(f"{failed} of {len(rows)} runs failed, see the column reason; the same command tries them again")


@main.command()
@click.argument("target", type=FOLDER, metavar="SCENARIO|RUN")
@click.option("--controller", default="no-control", show_default=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
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
    from cosim import compare, experiment
    from cosim.simulate import Task, scenario_of
    from nmfd import runs

    if (target / "manifest.json").is_file():
        if out is not None:
            raise InputError(f"--out: {out}: a comparison is written into its run folder {target}; leave --out away")
        manifest = runs.read_manifest(target / "manifest.json")
        try:
            task = Task(
                scenario=Path(manifest["sessions"][-1]["scenario_folder"]), controller=controller, seed=seed,
                steps=manifest["configuration"]["steps"], demand_factor=manifest["configuration"]["demand_factor"])
        except (LookupError, TypeError):
            raise InputError(
                f"{target / 'manifest.json'}: is not that of a run in SUMO; choose another folder") from None
        out = target
    else:
        task = Task(scenario=target, controller=controller, seed=seed, steps=steps)
        out, _ = _experiment([task], out)
    result = experiment.read_run(out, controller, seed)
    rows = compare.write(out, scenario_of(task), result)
    click.echo(compare.table(rows))
    name = runs.run_name(controller, seed)
    click.echo(f"Written to {out}: see compare-{name}-accumulation.png and ...-mfd.png")


@main.command()
@click.argument("folders", type=FOLDER, metavar="RUN...", nargs=-1, required=True)
@click.option("--out", type=FILE, metavar="FILE", help="The page. [default: report.html in the first RUN]")
@click.option("--reference", metavar="NAME", help="Pair all controllers with this one too, besides no-control.")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The runs' scenario, if it is no longer where it was.")
def report(folders: tuple[Path, ...], out: Path | None, reference: str | None, scenario: Path | None) -> None:
    """Write one self-contained HTML page about finished runs: what came of them, in words, tables and pictures.

    RUN is a folder of `cosim run` or `cosim evaluate`; several come on one page. The page works without a network.

    \b
    Examples:
      cosim report runs/grid7_peak-evaluate
      cosim report runs/monday runs/tuesday --out both.html
    """
    from cosim import finished, page
    from nmfd.progress import progress_line

    found = [finished.read(folder, scenario) for folder in folders]
    known = {name for run in found for name in run.rows["controller"]}
    if reference is not None and reference not in known:
        raise InputError(f"--reference: {reference!r} is not in these runs; choose from {', '.join(sorted(known))}")
    with progress_line("report") as progress:
        path = page.write(out or folders[0] / "report.html", found, reference, progress)
    click.echo(f"Written to {path}: open it in a browser")


@main.command()
@click.argument("folder", type=FOLDER, metavar="RUN")
@click.option("--controller", metavar="NAME", help="Whose run. [default: the best one]")
@click.option("--against", metavar="NAME", help="A second run, shown beside it.")
@click.option("--seed", type=SEED, help="[default: the first one there]")
@click.option("--demand", type=float, metavar="X", help="Level of an evaluation. [default: the one nearest to 1]")
@click.option("--rate", type=click.IntRange(1, 60), default=8, show_default=True, metavar="N",
              help="Control intervals per second of the film.")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The run's scenario, if it is no longer where it was.")
@click.option("--out", type=FILE, metavar="FILE",
              help="A name that ends in .gif, or .mp4 where ffmpeg is installed. [default: a gif in RUN]")
def video(
    folder: Path, controller: str | None, against: str | None, seed: int | None, demand: float | None, rate: int,
    scenario: Path | None, out: Path | None,
) -> None:
    """Make a film of the link densities of a finished run, from its record; nothing is simulated.

    RUN is a folder of `cosim run` or `cosim evaluate`.

    \b
    Examples:
      cosim video runs/gating --controller pi-gating --against no-control
      cosim video runs/grid7_peak-evaluate --controller max-pressure --seed 2001 --out film.mp4
    """
    from cosim import finished, video
    from nmfd.progress import progress_line

    run = finished.read(folder, scenario)
    level = run.level(demand)
    names, seed = video.choose(run, level, controller, against, seed)
    path = video.default_path(level, names, seed) if out is None else out
    with progress_line("video") as progress:
        video.film(path, run, level, names, seed, rate=rate, progress=progress)
    click.echo(f"Written to {path}: {' and '.join(names)}, seed {seed}, {path.stat().st_size / 1e6:.1f} MB")


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--controller", required=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--demand", type=LEVEL, default=1.0, show_default=True, metavar="X",
              help="Multiple of the scenario's demand.")
@click.option("--policy", type=FILE, metavar="FILE", help="Policy of a DPC controller, if not SCENARIO/NAME.pt.")
@click.option("--delay", type=Positive(1e6, zero=True), default=20.0, show_default=True, metavar="MS",
              help="Wall time per simulated second at least; the window has a slider for it, too.")
def watch(
    scenario: Path, controller: str, seed: int, steps: int | None, demand: float, policy: Path | None, delay: float,
) -> None:
    """Watch a controller steer the city in SUMO's own window; nothing is written.

    Streets lie on the colour of their region. A dot at every gateway is green where its signal shows all of its
    original green, red where it shows the least, and grey where no controlled signal is. Vehicles are red where they
    stand. Without a screen, use `cosim run` and `cosim video`.

    \b
    Example:
      cosim watch scenarios/grid7_peak --controller pi-gating
    """
    from cosim import watch
    from cosim.simulate import Task
    from nmfd.metrics import summary
    from nmfd.progress import progress_line

    task = Task(
        scenario=scenario, controller=controller, seed=seed, policy=policy, steps=steps, demand_factor=demand)
    try:
        with progress_line("watch") as progress:
            row = summary(watch.watch(task, delay=delay, progress=progress))
    except watch.WindowClosed:
        click.echo("The window was closed before the end.")
        return
    click.echo(f"{controller}, seed {seed}: total time spent {row['total_time_spent_veh_s']:.4g} veh s, "
               f"{row['completed_veh']:,.0f} trips completed")


@main.command()
@click.argument("scenario", type=FOLDER)
@click.option("--levels", default="0.6,0.8,1.0", show_default=True, metavar="A,B,...",
              help="The loading runs: multiples of the scenario's demand.")
@click.option("--seeds", type=COUNT, default=2, show_default=True, metavar="N",
              help="Loading runs per level, with seeds 1000 to 1000 + N - 1.")
@click.option("--workers", type=COUNT, default=2, show_default=True, metavar="N")
@click.option("--guided", is_flag=True, help="With route guidance: the model of a city whose drivers are guided.")
@click.option("--with", "options", metavar="OPTION[+...]",
              help="Of a city with such signals or drivers: max-pressure, rerouting-30, ... as in a strategy's name.")
@click.option("--network", "target", type=FOLDER, metavar="DIR",
              help="The folder whose network.toml is written. [default: the scenario's network]")
@click.option("--iterations", type=COUNT, default=600, show_default=True, metavar="N",
              help="Of the fit.")
@click.option("--out", type=FOLDER, metavar="DIR", help="Samples and pictures. [default: runs/<scenario>-identify]")
def identify(
    scenario: Path, levels: str, seeds: int, workers: int, guided: bool, options: str | None, target: Path | None,
    iterations: int, out: Path | None,
) -> None:
    """Fit the regional model and the drivers' own split ratios of a SUMO city; writes a network.toml.

    The city is loaded with multiples of the scenario's demand, first without perimeter control, then under a controller
    that probes it. Policies that were trained on the network as it was before do not fit the new one: train them again.
    A controller plans with a model other than the scenario's if its table says so, such as
    [controllers.dpc-pcrg] with model = "../../networks/grid7_guided"; one for a strategy with options has a table of
    its own, such as [controllers."dpc-pcrg+max-pressure"].

    Of an imported city the network's folder will do.

    \b
    Examples:
      cosim identify scenarios/grid7_peak --levels 0.6,0.8,1.0 --seeds 2
      cosim identify networks/mycity
      cosim identify scenarios/grid7_peak --guided --network networks/grid7_guided
      cosim identify scenarios/grid7_peak --guided --with max-pressure --network networks/grid7_max_pressure
    """
    from cosim import identify
    from cosim.importing import find
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    factors = _levels("--levels", levels)
    scenario = find.scenario_of(scenario)
    loaded = load_scenario(scenario)
    if out is None:
        kind = f"{'-guided' if guided else ''}{f'-{options}' if options else ''}"
        out = Path("runs") / f"{runs.file_name(loaded.name)}-identify{kind}"
    loading = identify.Loading(
        levels=factors, seeds=range(1000, 1000 + seeds), guided=guided,
        options=options.split("+") if options else (), network=target, iterations=iterations)
    try:
        with progress_line("identify") as progress:
            text = identify.identify(scenario, loading, out=out, workers=workers, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; finished loading runs are in {out}: the same command goes on") from None
    click.echo(text)
    click.echo(f"Written to {(target or loaded.network.folder) / 'network.toml'}; samples and pictures to {out}")


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
@click.option("--od", type=FILE, multiple=True, metavar="FILE",
              help="OD matrix between TAZ: tazRelation XML, or VISUM's O- or V-format. May be repeated.")
@click.option("--zones", type=FILE, multiple=True, metavar="FILE", help="The TAZ of --od, if not in the sumocfg.")
@click.option("--demand", type=click.Choice(["peak"]), help="Generate a morning peak, for a city without demand.")
@click.option("--level", default="1", show_default=True, metavar="X|auto",
              help="Times the city's vehicles, or the usual peak; auto: the lowest that congests without control.")
@click.option("--mesoscopic", is_flag=True,
              help="With SUMO's queue model, now and later: ten times as fast, no lanes; for quick studies.")
@click.option("--begin", metavar="TIME", help="Instead of the sumocfg's, in seconds or as hours:minutes:seconds.")
@click.option("--end", metavar="TIME", help="Later departures are left out.")
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--no-run", is_flag=True, help="Do not simulate the city first: no densities and no flows.")
@click.option("--force", is_flag=True, help="Replace a network and scenario that are there.")
def import_(
    source: Path, regions: int | None, out: Path, scenario: Path | None, method: str, edges: Path | None,
    taz: Path | None, polygons: Path | None, od: tuple[Path, ...], zones: tuple[Path, ...], demand: str | None,
    level: str, mesoscopic: bool, begin: str | None, end: str | None, seed: int, no_run: bool, force: bool,
) -> None:
    """Turn any SUMO city into a network and a scenario: regions, gateways, demand by pair of regions, map.

    Its own vehicles stay as they are: routes, departures, types. The city is simulated without control first.

    \b
    Examples:
      cosim import city.sumocfg --regions 5 --out networks/mycity
      cosim import city.net.xml.gz --regions 6 --demand peak --out networks/mycity
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
        peak=demand is not None, level=_level(level, no_run), mesoscopic=mesoscopic,
        scenario=scenario or out.parent.parent / "scenarios" / out.name,
        begin=parse_time(begin, "--begin"), end=parse_time(end, "--end"), od=od, zones=zones)
    with progress_line("import") as progress:
        report = import_city(order, (lambda stage: progress(0, 1, stage)) if progress else lambda stage: None)
    click.echo(report)
    click.echo(f"Written to {order.out} (see map.png, quality.csv, gateways.csv) and {order.scenario}")


def _level(text: str, no_run: bool) -> float | None:
    """--level; None for auto. InputError for anything else."""
    if text == "auto":
        if no_run:
            raise InputError("--level: auto simulates the city, which --no-run forbids; leave one of them away")
        return None
    try:
        (found,) = _levels("--level", text)
    except (InputError, ValueError):
        raise InputError(f"--level: expected a number above 0 up to 10, or auto, got {text!r} instead") from None
    return found


def _levels(option: str, text: str) -> list[float]:
    """Demand levels separated by commas. InputError for anything else."""
    try:
        levels = [float(level) for level in text.split(",")]
    except ValueError:
        levels = [0.0]
    if not all(0.0 < level <= 10.0 for level in levels):
        raise InputError(f"{option}: expected numbers above 0 up to 10, such as 0.6,0.8,1.0, got {text!r} instead")
    if len(set(levels)) < len(levels):
        raise InputError(f"{option}: {text!r} names a level twice; name every level once")
    return levels


def _compliance(text: str | None) -> tuple[float, ...]:
    """Shares, of whole percentages separated by commas. InputError for anything else."""
    if text is None:
        return ()
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() and int(part) <= 100 for part in parts):
        raise InputError(f"--compliance: expected whole percentages, such as 0,50,100, got {text!r} instead")
    if len(set(map(int, parts))) < len(parts):
        raise InputError(f"--compliance: {text!r} names a percentage twice; name every one once")
    return tuple(int(part) / 100 for part in parts)


def _tell(line: str) -> None:
    click.echo(f"cosim: {line}", err=True)


def _experiment(tasks: list, out: Path | None, sumo_output: tuple[str, ...] = ()) -> tuple:
    """The run folder of the tasks, and its overview; SUMO's own outputs of these kinds are in it."""
    from dataclasses import replace

    from cosim import experiment
    from cosim.sumo_output import paths
    from nmfd import runs
    from nmfd.progress import progress_line
    from nmfd.scenario import load_scenario

    out = runs.default_folder(load_scenario(tasks[0].scenario)) if out is None else out
    tasks = [replace(task, sumo_output=paths(sumo_output, out, task.controller, task.seed)) for task in tasks]
    try:
        with progress_line("cosim") as progress:
            return out, experiment.experiment(tasks, out=out, workers=2, progress=progress, tell=_tell)
    except KeyboardInterrupt:
        if not (out / "summary.csv").exists():
            raise Interrupted("interrupted before a run was finished; nothing is kept") from None
        raise Interrupted(f"interrupted; finished runs are in {out}: the same command with --out goes on") from None


if __name__ == "__main__":
    main()
