"""Command line `cosim`: it parses options and calls cosim.api."""

import os
from pathlib import Path
from typing import Any

import click

import cosim
import nmfd
import nmfd.cli
from nmfd.cli import (
    CONTROLLERS,
    COUNT,
    DEMAND,
    FILE,
    FOLDER,
    LEVEL,
    OVERWRITE,
    POLICIES,
    SCENARIO,
    SCHEDULER,
    SEED,
    STEPS,
    TIME_LIMIT,
    VERSION,
    Commands,
    combined,
    controller_option,
    file_option,
    listed,
    out_option,
    parsed,
    seed_option,
    seeds_option,
)
from nmfd.errors import InputError

CONTROLLER = controller_option(
    "pi-gating or dpc-pc",
    "Controller from `nmfd show` or FILE:Class, and options of the city, joined by +: "
    "actuated or max-pressure (signals), rerouting-N and compliance-N (percent of drivers), "
    "guided, guidance-period-N (s), planned, metering, estimate.",
    "NAME[+...]",
)
AGAINST = click.option(
    "--against", metavar="NAME[+...]", help="Second controller, run on the same trips."
)
ONE_DEMAND = click.option(
    "--demand", type=LEVEL, default=1.0, help="Factor that multiplies the demand."
)
WORKERS = click.option(
    "--workers",
    type=COUNT,
    default=lambda: os.cpu_count() or 1,
    show_default="one per core",
    help="Parallel runs.",
)
RUNNING = combined(WORKERS, SCHEDULER, TIME_LIMIT, OVERWRITE)
ROUTES = file_option("--routes", "File of vehicles or flows. May be repeated.", multiple=True)
COUNTS = file_option(
    "--counts",
    "edgeData of SUMO, of whose counts (entered) trips are made, for a city without demand.",
)
REGIONS = click.option(
    "--regions",
    default="auto",
    metavar="N|auto|CSV",
    help="Number of regions to find, auto, or a table edge,region.",
)
EXPLAIN = click.option("--explain", is_flag=True, help="Print what the columns mean.")


def span(text: str) -> tuple[float, float]:
    """Parse LOW:HIGH. Raises ValueError."""
    low, _, high = text.partition(":")
    return float(low), float(high)


@click.group(
    name="cosim",
    cls=Commands,
    context_settings={"show_default": True},
    sections={
        "Runs": ("demo", "run", "watch", "evaluate", "compare", "report", "tune", "plan"),
        "A city of your own": ("study", "get", "import", "identify", "mfd", "links"),
    },
    elsewhere={"list": "nmfd show"} | {name: f"nmfd {name}" for name in nmfd.cli.main.commands},
)
@VERSION
def main() -> None:
    """Perimeter control in a SUMO city. Begin with `cosim demo`."""


def _both(controller: str, against: str | None) -> list[str]:
    return [controller] if against is None else [controller, against]


@main.command()
@click.option("--out", type=FOLDER, default="runs/demo", metavar="DIR", help="Run folder.")
def demo(out: Path) -> None:
    """Run a small city with and without gating; write a page.

    Takes half a minute and opens the page in a browser, if there is a screen.

    \b
    Example:
      cosim demo
    """
    rows = cosim.api.demo(out)
    for row in rows.to_dict("records"):
        completed = f"{row['completed_veh']:,.0f} of {row['trips']:,.0f} trips completed"
        minutes = f"{row['mean_trip_time_s'] / 60:.1f} minutes per trip"
        click.echo(f"{row['controller'] + ':':12} {completed}, {minutes}")
    click.echo(
        f"Both side by side: {rows.attrs['page']}; "
        f"next: cosim watch {cosim.api.DEMO} --controller pi-gating"
    )


@main.command()
@SCENARIO
@CONTROLLER
@AGAINST
@seed_option("Seed of trips, drivers and guidance.")
@STEPS
@ONE_DEMAND
@TIME_LIMIT
@OVERWRITE
@file_option("--policy", "Policy file of --controller. [default: SCENARIO/NAME.pt]")
@EXPLAIN
@out_option("runs/SCENARIO-TIME")
def run(
    scenario: Path,
    settings: dict,
    controller: str,
    against: str | None,
    policy: Path | None,
    explain: bool,
    **options: Any,
) -> None:
    """Run one controller, or two on the same trips.

    SCENARIO is a name that `nmfd show` lists, or a folder with a scenario.toml; its network must
    name a SUMO city. Prints a table and writes results, tables and figures.

    \b
    Examples:
      cosim run grid7_peak --controller dpc-pcrg --against no-control
      cosim run grid7_peak --controller pi-gating --set controllers.pi-gating.kp=2
    """
    from cosim.evaluation.statistics import text

    loaded = nmfd.load_scenario(scenario, settings)
    policies = {} if policy is None else {controller: policy}
    rows = cosim.api.run_controllers(
        loaded, _both(controller, against), policies=policies, **options
    )
    out = rows.attrs["folder"]
    click.echo(text(rows, explain=explain))
    for row in rows.to_dict("records"):
        if row["signal_violations"]:
            table = f"{out}/signals.csv"
            times = f"{row['signal_violations']} times, see {table}"
            click.echo(f"{row['controller']}: signals break their rules {times}")
    click.echo(f"Written to {out}; a page about it: cosim report {out}")


@main.command()
@SCENARIO
@CONTROLLER
@AGAINST
@seed_option("Seed of trips, drivers and guidance.")
@ONE_DEMAND
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Port of the page; 0: any free port."
)
@click.option("--gui", is_flag=True, help="Open sumo-gui instead of a page, with one run.")
def watch(
    scenario: Path,
    settings: dict,
    controller: str,
    against: str | None,
    gui: bool,
    **options: Any,
) -> None:
    """Watch runs on a live page with map and curves.

    Buttons on the page pause the runs and set their speed. No files are written.

    \b
    Example:
      cosim watch grid7_peak --controller pi-gating --against no-control
    """
    if gui and against:
        raise InputError("--gui: shows one run; omit --against")
    loaded = nmfd.load_scenario(scenario, settings)
    rows = cosim.api.watch(loaded, _both(controller, against), gui=gui, **options)
    for name, row in rows.items():
        spent = f"total time spent {row['total_time_spent_veh_s']:.4g} veh s"
        completed = f"{row['completed_veh']:,.0f} trips completed"
        click.echo(f"{name}, seed {options['seed']}: {spent}, {completed}")
    if gui and not rows:
        click.echo("The window was closed before the end.")


@main.command()
@SCENARIO
@CONTROLLERS
@seeds_option(10, "Runs per controller and demand level, or their seeds.")
@click.option(
    "--first-seed",
    type=SEED,
    default=2000,
    help="First seed of a number of seeds; those below 2000 are for development.",
)
@DEMAND
@STEPS
@POLICIES
@RUNNING
@click.option(
    "--check", type=COUNT, metavar="N", help="Only repeat N random runs of --out, and compare."
)
@EXPLAIN
@out_option("runs/SCENARIO-evaluate")
def evaluate(
    scenario: Path,
    settings: dict,
    controllers: tuple[str, ...],
    seeds: int | tuple[int, ...],
    first_seed: int,
    check: int | None,
    explain: bool,
    **options: Any,
) -> None:
    """Compare controllers over seeds and demand levels.

    Writes tables and figures; with several demand levels, also up to which level each controller
    serves all trips. If --out is an existing run folder, only missing runs are done. SCENARIO may
    be a suite: a TOML file with seeds = [2000, 2001] and a table [scenarios] of demand levels, such
    as grid7_peak = [0.8, 1.0].

    \b
    Examples:
      cosim evaluate grid7_peak --controllers no-control,pi-gating,dpc-pc --workers 4
      cosim evaluate grid7_peak --controllers no-control,dpc-pc --demand 0.8,1,1.3 --out runs/x
    """
    from cosim.evaluation import results, statistics
    from cosim.evaluation.evaluate import check as differences

    options |= {"settings": settings, "seeds": seeds}
    if isinstance(seeds, int):
        options["seeds"] = range(first_seed, first_seed + seeds)
    if check is not None:
        running = {"workers": options.pop("workers")}
        for name in ("scheduler", "time_limit", "overwrite"):
            options.pop(name)
        runs, out = cosim.api.planned(scenario, controllers, **options)
        lines = differences(runs, out, check, **running)
        same = f"{min(check, len(runs))} runs of {out} done again: no difference"
        click.echo("\n".join(lines) or same)
        return
    rows = cosim.api.evaluate(scenario, controllers, **options)
    out = rows.attrs["folder"]
    done = results.finished_rows(rows)
    names = list(dict.fromkeys(done.get("scenario", ())))
    for name in names:
        if len(names) > 1:
            click.echo(name)
        click.echo(statistics.text(done[done["scenario"] == name], explain=explain))
    nmfd.api.raise_failures(rows)
    click.echo(f"Written to {out}: see evaluate.md and the figures; a page: cosim report {out}")


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
    from cosim.evaluation.model_validation import prediction_table

    rows = cosim.api.compare(folder)
    click.echo(prediction_table(rows))
    click.echo(
        f"Written to {folder}: see foresight.csv and the figures; large errors: "
        f"cosim identify {rows.attrs['scenario']}"
    )


@main.command()
@click.argument("folders", type=FOLDER, metavar="RUN...", nargs=-1, required=True)
@click.option(
    "--seed", type=SEED, help="Seed of the runs on the map. [default: the first that both have]"
)
@file_option("--out", "Page. [default: report.html in the first RUN]")
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
    help="Option of the controller and its range; KEY[0], KEY[1] for numbers of a list. "
    "May be repeated.",
)
@click.option(
    "--candidates",
    type=COUNT,
    default=40,
    help="Candidates; the first has the scenario's values.",
)
@seeds_option(2, "Runs per candidate and level, from seed 1000, or their seeds.")
@DEMAND
@STEPS
@WORKERS
@TIME_LIMIT
@out_option("runs/SCENARIO-tune")
def tune(scenario: Path, settings: dict, controller: str, **how: Any) -> None:
    """Search the options of a controller by CMA-ES.

    Minimises the geometric mean of the total time spent over seeds and demand levels. Writes
    tune.csv, and tune.toml with the best options. The same command continues the search, also with
    more --candidates.

    \b
    Example:
      cosim tune grid7_peak --controller pi-gating --option kp=0.1:10 --option ki=0.001:0.1
    """
    found = cosim.api.tune(nmfd.load_scenario(scenario, settings), controller, **how)
    click.echo(
        f"{found.text}Written to {found.folder}: see tune.csv; to use the options, copy tune.toml "
        "into the scenario.toml"
    )


@main.command()
@SCENARIO
@CONTROLLER
@click.option("--iterations", type=COUNT, default=9, help="Runs after the one with guidance.")
@click.option("--seed", type=SEED, default=1000, help="Seed of trips and drivers.")
@ONE_DEMAND
@file_option("--plan-file", "The plan. [default: SCENARIO/plan.csv.gz]")
@TIME_LIMIT
@OVERWRITE
@out_option("runs/SCENARIO-plan")
def plan(scenario: Path, settings: dict, controller: str, **options: Any) -> None:
    """Plan routes of drivers by iterated marginal costs.

    Begins with the routes in which guidance every minute ends. In every iteration some drivers
    change to the route that adds least time for all. The plan tells how many drivers take which
    route, by first and last edge and quarter of an hour; the word `planned` follows it, on other
    seeds, too. The same command continues.

    \b
    Examples:
      cosim plan mycity --controller max-pressure
      cosim evaluate mycity --controllers max-pressure,planned+max-pressure
    """
    rows = cosim.api.plan(nmfd.load_scenario(scenario, settings), controller, **options)
    click.echo(rows.to_string(index=False))
    click.echo(f"Written to {rows.attrs['plan']}: drivers follow it with the word planned")


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
@REGIONS
@ROUTES
@COUNTS
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
    click.echo(cosim.import_city(place, **options))


@main.command()
@click.argument("source", type=click.Path(path_type=Path), metavar="SUMOCFG|NET|SCENARIO")
@REGIONS
@ROUTES
@COUNTS
@click.option(
    "--most-seeds",
    type=click.IntRange(min=3),
    default=10,
    help="Seeds of a strategy whose verdict is open; all have three.",
)
@WORKERS
@out_option("runs/NAME-study", "Folder of import, runs and page; finished runs are not repeated.")
def study(source: Path, **options: Any) -> None:
    """Find out if gates, guidance or other signals would help.

    Imports the city, loads it until it breaks, compares strategies over seeds, and writes one page
    with a verdict on each. The same command continues after an interruption.

    \b
    Examples:
      cosim study city.sumocfg
      cosim study grid7_peak --most-seeds 5 --out runs/peak
    """
    from cosim.studying.page import text

    click.echo(text(cosim.api.study(source, **options)))


@main.command()
@SCENARIO
@click.option(
    "--demand",
    "--levels",
    "levels",
    type=listed(LEVEL),
    help="Factors that multiply the demand. [default: 0.6,0.8,1, then more in steps of "
    "0.15 until fewer trips end, at most 2]",
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
    click.echo(cosim.identify(scenario, **options))


@main.command()
@click.argument("net", type=FILE)
@click.argument("edge_data", type=FILE, nargs=-1, required=True, metavar="EDGEDATA...")
@REGIONS
@EXPLAIN
@out_option("runs/NAME-mfd", "Folder of regions, samples, fits and picture.")
def mfd(net: Path, edge_data: tuple[Path, ...], explain: bool, **options: Any) -> None:
    """Fit MFDs to SUMO's own edgeData, without any control.

    EDGEDATA is what <edgeData id="all" freq="300" file="edges.xml"/> in an additional file makes
    SUMO write, one file for each run; with withInternal="true", vehicles on junctions count, too.
    Prints critical accumulation, production, speed and hysteresis by region. For tables of
    detectors: nmfd identify.

    \b
    Example:
      cosim mfd city.net.xml edges.xml --regions 3
    """
    found = cosim.api.mfd(net, edge_data, **options)
    click.echo(found.text(explain=explain))
    click.echo(f"Written to {found.out}: see mfd.png and samples.csv")


@main.command()
@SCENARIO
@file_option("--out", "File. [default: SCENARIO/links.npz]")
@click.option("--runs", type=FOLDER, help="Finished runs to which four numbers are fitted.")
def links(scenario: Path, settings: dict, out: Path | None, runs: Path | None) -> None:
    """Write the streets of a SUMO city as a plant without SUMO.

    Reads the network, static routes and signal programmes. `nmfd benchmark SCENARIO --plant links`
    then simulates queues on every street in seconds.

    With --runs, four numbers are fitted to the runs of the first seed in SUMO, and the errors of
    all runs are printed.

    \b
    Example:
      cosim links grid7_peak --out links.npz
      cosim links scenarios/mycity --runs runs/mycity-evaluate
    """
    loaded = nmfd.load_scenario(scenario, settings)
    numbers = None
    if runs is not None:
        found = cosim.api.fit_links(runs)
        click.echo(found.text())
        numbers = found.numbers
    click.echo(f"Written to {cosim.api.links(loaded, out, numbers=numbers)}")
