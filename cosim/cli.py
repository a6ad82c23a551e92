"""Command line `cosim`: it parses options and calls cosim.api."""

import os
from pathlib import Path
from typing import Any

import click

import cosim
import nmfd.cli
from nmfd.cli import (
    CONTROLLERS,
    COUNT,
    FILE,
    FOLDER,
    POLICIES,
    SCENARIO,
    SEED,
    VERSION,
    Commands,
    ControllerName,
    Number,
    listed,
    out_option,
    parsed,
    seed_option,
)
from nmfd.errors import InputError

LEVEL = Number(0.0, 10.0, min_open=True)
CONTROLLER = click.option(
    "--controller",
    type=ControllerName(),
    required=True,
    metavar="NAME[+...]",
    help="Controller from `nmfd show` or FILE:Class, and options of the city, joined by +: actuated or max-pressure "
    "(signals), rerouting-N and compliance-N (percent of drivers), guided, guidance-period-N (s), "
    "metering, estimate.",
)
AGAINST = click.option(
    "--against", metavar="NAME[+...]", help="Second controller, run on the same trips."
)
STEPS = click.option(
    "--steps", type=COUNT, help="Number of control intervals. [default: as in the scenario]"
)
DEMAND = click.option(
    "--demand", type=LEVEL, default=1.0, help="Factor that multiplies the demand."
)
WORKERS = click.option(
    "--workers",
    type=COUNT,
    default=lambda: os.cpu_count() or 1,
    show_default="one per core",
    help="Parallel runs.",
)
LEVELS = click.option(
    "--demand", "levels", type=listed(LEVEL), default="1", help="Factors that multiply the demand."
)


def span(text: str) -> tuple[float, float]:
    """Parse LOW:HIGH. Raises ValueError."""
    low, _, high = text.partition(":")
    return float(low), float(high)


@click.group(
    name="cosim",
    cls=Commands,
    context_settings={"show_default": True},
    sections={
        "First steps": ("demo", "run", "watch"),
        "Studies": ("evaluate", "compare", "report", "tune"),
        "A city of your own": ("get", "import", "identify"),
    },
    elsewhere={"list": "nmfd show"} | {name: f"nmfd {name}" for name in nmfd.cli.main.commands},
)
@VERSION
def main() -> None:
    """Perimeter control in a SUMO city. Begin with `cosim demo`."""


@main.command()
@click.option("--out", type=FOLDER, default="runs/demo", metavar="DIR", help="Run folder.")
def demo(out: Path) -> None:
    """Run a small city with and without gating; write a page.

    Takes half a minute and opens the page in a browser, if there is a screen.

    \b
    Example:
      cosim demo
    """
    click.echo(cosim.api.demo(out))


@main.command()
@SCENARIO
@CONTROLLER
@AGAINST
@seed_option("Seed of trips, drivers and guidance.")
@STEPS
@DEMAND
@click.option(
    "--policy",
    type=FILE,
    metavar="FILE",
    help="Policy file of --controller. [default: SCENARIO/NAME.pt]",
)
@out_option("runs/SCENARIO-TIME")
def run(scenario: Path, controller: str, against: str | None, **options: Any) -> None:
    """Run one controller, or two on the same trips.

    SCENARIO is a name that `nmfd show` lists, or a folder with a scenario.toml; its network must
    name a SUMO city. Prints a table and writes results, tables and figures.

    \b
    Examples:
      cosim run grid7_peak --controller dpc-pcrg --against no-control
      cosim run grid7_peak --controller pi-gating --set controllers.pi-gating.kp=2 --set sumo.chain_limit=0.4
    """
    click.echo(
        cosim.api.run_controllers(scenario, list(filter(None, (controller, against))), **options)
    )


@main.command()
@SCENARIO
@CONTROLLER
@AGAINST
@seed_option("Seed of trips, drivers and guidance.")
@DEMAND
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Port of the page; 0: any free port."
)
@click.option("--gui", is_flag=True, help="Open sumo-gui instead of a page, with one run.")
def watch(scenario: Path, controller: str, against: str | None, gui: bool, **options: Any) -> None:
    """Watch runs on a live page with map and curves.

    Buttons on the page pause the runs and set their speed. No files are written.

    \b
    Example:
      cosim watch grid7_peak --controller pi-gating --against no-control
    """
    if gui and against:
        raise InputError("--gui: shows one run; omit --against")
    click.echo(
        cosim.api.watch(scenario, list(filter(None, (controller, against))), gui=gui, **options)
    )


@main.command()
@SCENARIO
@CONTROLLERS
@click.option("--seeds", type=COUNT, default=10, help="Runs per controller and demand level.")
@click.option(
    "--first-seed",
    type=SEED,
    default=2000,
    help="First seed; seeds below 2000 are for development.",
)
@LEVELS
@STEPS
@POLICIES
@WORKERS
@click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler for the runs, such as tls://host:8786."
)
@click.option(
    "--check", type=COUNT, metavar="N", help="Only repeat N random runs of --out, and compare."
)
@out_option("runs/SCENARIO-evaluate")
def evaluate(
    scenario: Path, controllers: tuple[str, ...], seeds: int, first_seed: int, **options: Any
) -> None:
    """Compare controllers over seeds and demand levels.

    Writes tables and figures; with several demand levels, also up to which level each controller
    serves all trips. If --out is an existing run folder, only missing runs are done. SCENARIO may
    be a suite: a TOML file with seeds = [2000, 2001] and a table [scenarios] of demand levels, such
    as grid7_peak = [0.8, 1.0].

    \b
    Examples:
      cosim evaluate grid7_peak --controllers no-control,pi-gating,dpc-pc --workers 4
      cosim evaluate grid7_peak --controllers no-control,dpc-pc --demand 0.8,1.0,1.3 --out runs/levels
    """
    click.echo(
        cosim.api.evaluate(
            scenario, controllers, seeds=range(first_seed, first_seed + seeds), **options
        )
    )


@main.command()
@click.argument("folder", type=FOLDER, metavar="RUN")
def compare(folder: Path) -> None:
    """Compare finished runs with the regional model.

    RUN is a folder of `cosim run` or `cosim evaluate`. The regional model gets the recorded
    departures and controls. Writes a table of all runs, and a figure of the first run of every
    controller, into RUN.

    \b
    Example:
      cosim compare runs/grid7_peak-evaluate
    """
    click.echo(cosim.api.compare(folder))


@main.command()
@click.argument("folders", type=FOLDER, metavar="RUN...", nargs=-1, required=True)
@click.option(
    "--seed", type=SEED, help="Seed of the runs on the map. [default: the first that both have]"
)
@click.option(
    "--out", type=FILE, metavar="FILE", help="Page. [default: report.html in the first RUN]"
)
def report(folders: tuple[Path, ...], **options: Any) -> None:
    """Write one HTML page about finished runs.

    RUN is a folder of `cosim run` or `cosim evaluate`. The page works offline.

    \b
    Example:
      cosim report runs/monday runs/tuesday --out both.html
    """
    click.echo(f"Written to {cosim.api.report(folders, **options)}: open it in a browser")


@main.command()
@SCENARIO
@CONTROLLER
@click.option(
    "--option",
    "options",
    required=True,
    multiple=True,
    metavar="KEY=LOW:HIGH",
    callback=parsed("KEY=LOW:HIGH, such as kp=0.1:10", span),
    help="Option of the controller and its range; KEY[0], KEY[1] for numbers of a list. May be repeated.",
)
@click.option(
    "--candidates",
    "trials",
    type=COUNT,
    default=40,
    help="Candidates; the first has the scenario's values.",
)
@click.option(
    "--seeds", type=COUNT, default=2, help="Runs per candidate and level, from seed 1000."
)
@LEVELS
@WORKERS
@out_option("runs/SCENARIO-tune")
def tune(scenario: Path, controller: str, **how: Any) -> None:
    """Search the options of a controller by CMA-ES.

    Minimises the geometric mean of the total time spent over seeds and demand levels. Writes
    tune.csv, and tune.toml with the best options. The same command continues the search, also with
    more --candidates.

    \b
    Example:
      cosim tune grid7_peak --controller pi-gating --option kp=0.1:10 --option ki=0.001:0.1
    """
    click.echo(cosim.api.tune(scenario, controller, **how))


@main.command()
@click.argument("name", required=False)
def get(name: str | None) -> None:
    """Download a published SUMO city; without NAME list them.

    The city goes to cities/NAME, with its licence.

    \b
    Example:
      cosim get cologne8
    """
    click.echo(cosim.api.get(name))


@main.command(name="import")
@click.argument("source", type=FILE, required=False, metavar="SUMOCFG|NET|OSM")
@click.option(
    "--bbox",
    metavar="W,S,E,N",
    help="Box in degrees to download from OpenStreetMap, instead of a file.",
)
@click.option("--left-hand", is_flag=True, help="OpenStreetMap: traffic keeps left.")
@click.option(
    "--regions",
    required=True,
    metavar="N|CSV",
    help="Number of regions to find, or a table edge,region.",
)
@click.option(
    "--routes",
    type=FILE,
    multiple=True,
    metavar="FILE",
    help="File of vehicles or flows. May be repeated.",
)
@click.option(
    "--demand",
    type=click.Choice(["peak"]),
    help="Generate a morning peak for a city without demand.",
)
@click.option(
    "--level", type=LEVEL, default=1.0, help="Factor that multiplies the vehicles, or the peak."
)
@click.option("--mesoscopic", is_flag=True, help="Simulate with SUMO's queue model.")
@click.option("--begin", metavar="TIME", help="Start in s or h:m:s. [default: as in the sumocfg]")
@click.option(
    "--end", metavar="TIME", help="End of departures in s or h:m:s. [default: as in the sumocfg]"
)
@seed_option()
@click.option(
    "--seeds", type=COUNT, default=3, help="Runs without control, whose densities are averaged."
)
@click.option(
    "--out", type=FOLDER, required=True, metavar="DIR", help="New folder, such as networks/mycity."
)
def import_(source: Path | None, bbox: str | None, **options: Any) -> None:
    """Make a network and a scenario of any SUMO city.

    Finds regions and gateways and counts demand by pair of regions. Vehicles keep routes,
    departures and types. The scenario goes to scenarios/NAME, beside the folder networks.

    \b
    Examples:
      cosim import city.net.xml.gz --regions 6 --demand peak --out networks/mycity
      cosim import --bbox 11.32,44.48,11.36,44.50 --regions 4 --demand peak --out networks/mycity
    """
    place = bbox if source is None else source
    if place is None or (source is not None and bbox is not None):
        raise InputError("cosim import: expected either a file or --bbox; give one of them")
    click.echo(cosim.api.import_city(place, **options))


@main.command()
@SCENARIO
@click.option(
    "--levels", type=listed(LEVEL), default="0.6,0.8,1", help="Factors that multiply the demand."
)
@click.option("--seeds", type=COUNT, default=2, help="Loading runs per level, from seed 1000.")
@click.option(
    "--with",
    "city",
    metavar="A+...",
    help="Options of the city; own: none. [default: own, then guided]",
)
@click.option(
    "--network",
    type=FOLDER,
    metavar="DIR",
    help="Folder for the model. [default: the scenario's network]",
)
@click.option("--protect", is_flag=True, help="Write the regions to protect into the scenario.")
@WORKERS
@out_option("runs/SCENARIO-identify", "Folder of loading runs, samples and figures.")
def identify(scenario: Path, **options: Any) -> None:
    """Fit the regional model of a SUMO city.

    Loads the city with multiples of its demand, without control and with random gating, and writes
    network.toml. Without --with it fits two models: drivers on their own routes, then guided
    drivers. Proposes regions to protect. Policies trained on the old model do not fit the new one.
    SCENARIO may be the folder of an imported network.

    \b
    Example:
      cosim identify grid7_peak --with guided+max-pressure --network networks/grid7_max_pressure
    """
    click.echo(cosim.api.identify(scenario, **options))
