"""The command demo of `cosim`; what brings numpy, torch or libsumo is imported inside, as in the other commands."""

import webbrowser
from pathlib import Path

import click

from cosim.cli.options import has_screen, tell
from nmfd.cli.options import FOLDER, SEED
from nmfd.cli.progress import resumable

SCENARIO = "demo"  # of those that come with the package, whatever folder here may have that name
NAMES = ("no-control", "pi-gating")


@click.command()
@click.option("--seed", type=SEED, default=1000, show_default=True, help="Of the trips and the drivers.")
@click.option("--out", type=FOLDER, default=Path("runs/demo"), show_default=True, metavar="DIR", help="The run folder.")
@click.option(
    "--open/--no-open",
    "browse",
    default=None,
    help="Open the page in this machine's browser. [default: where there is a screen and a terminal]",
)
def demo(seed: int, out: Path, browse: bool | None) -> None:
    """See what gates do: a small city that locks, and the same with signals that hold vehicles back around its centre.

    Both run in SUMO at the same time, on the same trips, in about half a minute. What came of it is one page: four
    figures, and both runs side by side on the map, with a slider over their time.

    \b
    Examples:
      cosim demo
      cosim demo --seed 7 --no-open
    """
    from cosim.evaluation import experiment, results  # heavy
    from cosim.evaluation.simulate import Task
    from cosim.report import card, html
    from nmfd.runs import shipped

    scenario = shipped.root() / "scenarios" / SCENARIO
    tasks = [Task(scenario=scenario, controller=name, seed=seed) for name in NAMES]
    with resumable("demo", out, "summary.csv") as progress:
        rows = experiment.experiment(tasks, out=out, workers=2, progress=progress, tell=tell)
    for name in NAMES:
        [row] = rows[(rows["controller"] == name) & (rows["seed"] == seed)].to_dict("records")
        click.echo(
            f"{name + ':':12} {row['completed_veh']:,.0f} of {row['trips']:,.0f} trips served, "
            f"{card.minutes_per_trip(row):.1f} minutes per trip"
        )
    page = html.write_page(out / "report.html", [results.read(out, scenario)], seed=seed)
    click.echo(f"Both side by side: {page.resolve()}")
    if has_screen() if browse is None else browse:
        webbrowser.open(page.resolve().as_uri())
