"""The commands run and compare of `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

from dataclasses import replace
from pathlib import Path

import click

from cosim.cli.options import CONTROLLER, CONTROLLER_HELP, POLICY, tell
from nmfd.cli.options import FOLDER, SCENARIO, SEED, STEPS, out_option
from nmfd.cli.progress import resumable
from nmfd.errors import InputError


@click.command()
@SCENARIO
@CONTROLLER
@click.option(
    "--against",
    metavar="NAME",
    help="Run this controller too, on the same trips, in a second process, and compare with it.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Of the trips, the drivers and the guidance.")
@STEPS
@POLICY
@click.option(
    "--sumo-output",
    metavar="A,B,...",
    help="SUMO's own outputs in the run folder too: tripinfo, summary, edgedata (per control interval), "
    "emission (of every vehicle in every step, large).",
)
@out_option()
def run(
    scenario: Path,
    controller: str,
    against: str | None,
    seed: int,
    steps: int | None,
    policy: Path | None,
    sumo_output: str | None,
    out: Path | None,
) -> None:
    """Run a controller in the microsimulation; print a table and write a run folder.

    SCENARIO is, here and in all commands, a name of cosim list or a folder with a scenario.toml, on a network that SUMO
    can simulate. The run folder holds summary.csv, sumo.csv, trajectories and records, manifest.json and pictures. The
    same --out goes on where it was interrupted, even by kill -9: finished runs are kept, and the one that was under way
    starts again from its beginning.

    \b
    Examples:
      cosim run grid7_peak --controller dpc-pcrg --against no-control
      cosim run grid7_peak --controller pi-gating --seed 3 --out runs/gating
      cosim run grid7_peak --controller dpc-pc+rerouting-30 --against rerouting-30
      cosim run grid7_peak --controller pi-gating --sumo-output tripinfo,edgedata
    """
    from cosim.sumo import outputs  # heavy
    from nmfd.controllers import strategy

    kinds = outputs.parse(sumo_output) if sumo_output is not None else ()
    names = [controller] + ([against] if against and against != controller else [])
    if "no-control" not in names:
        names.reverse()  # what comes first is what the other is compared with
    for name in names:
        strategy.parse(name)

    from cosim.evaluation import estimation_errors, experiment  # heavy
    from cosim.evaluation.simulate import Task

    tasks = [
        Task(
            scenario=scenario,
            controller=name,
            seed=seed,
            policy=policy if name == controller else None,
            steps=steps,
        )
        for name in names
    ]
    out, rows = _experiment(tasks, out, kinds)
    click.echo(experiment.overview_table(rows))
    if (out / "estimation.csv").is_file():
        import pandas as pd

        click.echo(estimation_errors.error_table(pd.read_csv(out / "estimation.csv")))
    click.echo(f"Written to {out}: see total_accumulation.png and region_accumulation.png")


@click.command()
@click.argument("target", type=FOLDER, metavar="SCENARIO|RUN")
@click.option(
    "--controller", metavar="NAME[+...]", help=CONTROLLER_HELP + " [default: no-control; all runs of a RUN folder]"
)
@click.option("--seed", type=SEED, help="[default: 0]")
@click.option(
    "--model",
    type=FOLDER,
    metavar="DIR",
    help="A network of the same city, whose regional model predicts. [default: that with which the controller plans]",
)
@STEPS
@out_option(text="Run folder of a SCENARIO.")
def compare(
    target: Path, controller: str | None, seed: int | None, model: Path | None, steps: int | None, out: Path | None
) -> None:
    """Compare microsimulated accumulations with what the regional model predicts.

    For a scenario, the microsimulation is run first; for the run folder of `cosim run`, its record is used. Then the
    regional model is driven with the recorded departures and controls. Writes compare-NAME-SEED.csv and pictures
    beside the run. For a RUN folder without --controller, `cosim evaluate`'s too: how far ahead the models foresee
    all of its runs, as a table and foresight.csv.

    \b
    Examples:
      cosim compare grid7_peak --controller no-control
      cosim compare runs/gating --controller pi-gating --seed 3
      cosim compare runs/grid7_peak-evaluate
    """
    from cosim.evaluation import experiment, model_validation  # heavy
    from cosim.evaluation.simulate import Task, scenario_of
    from nmfd.controllers import strategy
    from nmfd.runs import run_folder

    manifest = run_folder.read_manifest(target / "manifest.json") if (target / "manifest.json").is_file() else None
    results = manifest is not None or any(target.glob("demand-*/manifest.json"))
    if results and out is not None:
        raise InputError(f"--out: {out}: a comparison is written into its run folder {target}; omit --out")
    if results and controller is None:
        if seed is not None or steps is not None:
            raise InputError(
                f"--{'seed' if steps is None else 'steps'}: without --controller all runs of {target} are compared, "
                "whole; name a controller, or omit it"
            )
        _foresight(target, model)
        return
    controller, seed = controller or "no-control", seed or 0
    if manifest is not None:
        try:
            task = Task(
                scenario=Path(manifest["sessions"][-1]["scenario_folder"]),
                controller=controller,
                seed=seed,
                steps=manifest["configuration"]["steps"],
                demand_factor=manifest["configuration"]["demand_factor"],
            )
        except (LookupError, TypeError):
            raise InputError(
                f"{target / 'manifest.json'}: is not that of a run in SUMO; choose another folder"
            ) from None
        out = target
    elif results:
        raise InputError(
            f"{target}: holds runs of several demand levels; give one of its folders {target}/demand-..., or leave "
            "--controller away"
        )
    else:
        task = Task(scenario=target, controller=controller, seed=seed, steps=steps)
        out, _ = _experiment([task], out)
    result = experiment.read_run(out, controller, seed)
    scenario = scenario_of(task)
    scenario = replace(scenario, network=strategy.parse(controller).planning(scenario, model).network)
    rows = model_validation.write_comparison(out, scenario, result)
    click.echo(model_validation.error_table(rows))
    name = run_folder.run_name(controller, seed)
    click.echo(f"Written to {out}: see compare-{name}-accumulation.png and ...-mfd.png")


def _foresight(target: Path, model: Path | None) -> None:
    """All runs of a folder against the regional models."""
    from cosim.evaluation import prediction_error, results  # heavy

    found = prediction_error.prediction_errors(results.read(target), model)
    prediction_error.write_foresights(target / "foresight.csv", found)
    click.echo(prediction_error.foresight_table(found))
    click.echo(f"Written to {target / 'foresight.csv'}")


def _experiment(tasks: list, out: Path | None, sumo_output: tuple[str, ...] = ()) -> tuple:
    """The run folder of the tasks, and its overview; SUMO's own outputs of these kinds are in it."""
    from cosim.evaluation import experiment  # heavy
    from cosim.sumo.outputs import paths
    from nmfd.api import load_scenario
    from nmfd.runs import run_folder

    out = run_folder.default_folder(load_scenario(tasks[0].scenario).name) if out is None else out
    tasks = [replace(task, sumo_output=paths(sumo_output, out, task.controller, task.seed)) for task in tasks]
    with resumable("cosim", out, "summary.csv") as progress:
        return out, experiment.experiment(tasks, out=out, workers=2, progress=progress, tell=tell)
