"""The command line `cosim`. Heavy modules are imported inside the commands, so that the help answers at once."""

from pathlib import Path

import click

from cosim.cli_city import identify, import_
from cosim.cli_pictures import report, video, watch
from cosim.options import CONTROLLER_HELP, parsed_compliance, parsed_levels, tell
from nmfd.command_line import Commands, Interrupted
from nmfd.errors import InputError
from nmfd.options import COUNT, FILE, FOLDER, SEED, fault_option
from nmfd.workers import RunFailed


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
        levels=tuple(parsed_levels("--demand", demand)), steps=steps, policies=files, reference=reference,
        out=Path("runs") / f"{runs.file_name(loaded.name)}-evaluate" if out is None else out)
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    try:
        with progress_line("evaluate") as progress:
            table, failures = evaluate.evaluate(chosen, workers=workers, progress=progress, tell=tell)
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
              help="Drivers who follow route guidance [%], such as 0,50,100; of controllers that guide nobody there is "
                   "one run all the same. [default: the scenario's]")
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
        levels=tuple(parsed_levels("--demand", demand)), compliance=parsed_compliance(compliance), steps=steps,
        policies=files,
        out=Path("runs") / f"{runs.file_name(load_scenario(scenario).name)}-sweep" if out is None else out)
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    try:
        with progress_line("sweep") as progress:
            rows = sweeps.sweep(order, workers=workers, scheduler=scheduler, progress=progress, tell=tell)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; finished runs are in {order.out}: the same command goes on") from None
    click.echo(sweeps.text(rows))
    click.echo(f"Written to {order.out / 'sweep.parquet'}")
    if failed := int((rows["status"] == sweeps.FAILED).sum()):
        tell(f"{failed} of {len(rows)} runs failed, see the column reason; the same command tries them again")


@main.command()
@click.argument("target", type=FOLDER, metavar="SCENARIO|RUN")
@click.option("--controller", metavar="NAME[+...]",
              help=CONTROLLER_HELP + " [default: no-control; all runs of a RUN folder]")
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--model", type=FOLDER, metavar="DIR",
              help="A network of the same city, whose regional model predicts. [default: that with which the "
                   "controller plans]")
@click.option("--steps", type=COUNT, metavar="N", help="Control intervals. [default: the scenario's]")
@click.option("--out", type=FOLDER, metavar="DIR", help="Run folder of a SCENARIO. [default: runs/<scenario>-<time>]")
def compare(
    target: Path, controller: str | None, seed: int, model: Path | None, steps: int | None, out: Path | None,
) -> None:
    """Compare microsimulated accumulations with what the regional model predicts.

    For a scenario, the microsimulation is run first; for the run folder of `cosim run`, its record is used. Then the
    regional model is driven with the recorded departures and controls. Writes compare-NAME-SEED.csv and pictures
    beside the run. For a RUN folder without --controller, `cosim evaluate`'s too: how far ahead the models foresee all
    of its runs, as a table and foresight.csv.

    \b
    Examples:
      cosim compare scenarios/grid7_peak --controller no-control
      cosim compare runs/gating --controller pi-gating --seed 3
      cosim compare runs/grid7_peak-evaluate
    """
    from cosim import compare, experiment
    from cosim.simulate import Task, scenario_of
    from nmfd import runs

    finished = (target / "manifest.json").is_file() or any(target.glob("demand-*/manifest.json"))
    if finished and out is not None:
        raise InputError(f"--out: {out}: a comparison is written into its run folder {target}; leave --out away")
    if finished and controller is None:
        _foresight(target, model)
        return
    controller = controller or "no-control"
    if (target / "manifest.json").is_file():
        manifest = runs.read_manifest(target / "manifest.json")
        try:
            task = Task(
                scenario=Path(manifest["sessions"][-1]["scenario_folder"]), controller=controller, seed=seed,
                steps=manifest["configuration"]["steps"], demand_factor=manifest["configuration"]["demand_factor"])
        except (LookupError, TypeError):
            raise InputError(
                f"{target / 'manifest.json'}: is not that of a run in SUMO; choose another folder") from None
        out = target
    elif finished:
        raise InputError(
            f"{target}: holds runs of several demand levels; give one of its folders {target}/demand-..., or leave "
            "--controller away")
    else:
        task = Task(scenario=target, controller=controller, seed=seed, steps=steps)
        out, _ = _experiment([task], out)
    result = experiment.read_run(out, controller, seed)
    scenario = compare.modelled(scenario_of(task), controller, model)
    rows = compare.write(out, scenario, result)
    click.echo(compare.table(rows))
    name = runs.run_name(controller, seed)
    click.echo(f"Written to {out}: see compare-{name}-accumulation.png and ...-mfd.png")


def _foresight(target: Path, model: Path | None) -> None:
    """All runs of a folder against the regional models."""
    from cosim import finished, foresight

    found = foresight.foresee(finished.read(target), model)
    foresight.write(target / "foresight.csv", found)
    click.echo(foresight.table(found))
    click.echo(f"Written to {target / 'foresight.csv'}")


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
            return out, experiment.experiment(tasks, out=out, workers=2, progress=progress, tell=tell)
    except KeyboardInterrupt:
        if not (out / "summary.csv").exists():
            raise Interrupted("interrupted before a run was finished; nothing is kept") from None
        raise Interrupted(f"interrupted; finished runs are in {out}: the same command with --out goes on") from None


for command in (report, video, watch, identify, import_):
    main.add_command(command)


if __name__ == "__main__":
    main()
