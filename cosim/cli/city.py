"""The commands identify and import of `cosim`.

What brings numpy, pandas, torch or libsumo is imported inside the commands, so that the help answers at once: in 0.1 s
instead of 3 s.
"""

import os
from pathlib import Path
from typing import Literal

import click

from cosim.cli.options import RUNS, chosen_scheduler, parsed_level, scheduler_options, tell
from nmfd.cli.declared import declared
from nmfd.cli.options import FILE, FOLDER, SCENARIO, SEED, out_option
from nmfd.cli.progress import progress_line, resumable
from nmfd.errors import InputError
from nmfd.runs import files
from nmfd.runs.workers import at_a_time


@click.command()
@SCENARIO
@declared("cosim.evaluation.settings:Identification", "levels", "seeds", "iterations")
@declared("cosim.evaluation.settings:Identification", "workers", instead="one per core")
@scheduler_options
@click.option(
    "--guided/--own",
    default=None,
    help="Only the model of guided drivers, or only that of drivers who go their own ways. [default: both]",
)
@click.option(
    "--with",
    "options",
    metavar="OPTION[+...]",
    help="Of a city with such signals or drivers: max-pressure, rerouting-30, ... as in a strategy's name.",
)
@click.option(
    "--network",
    "target",
    type=FOLDER,
    metavar="DIR",
    help="The folder whose network.toml is written, for one model. [default: the scenario's network]",
)
@RUNS
@out_option("identify", "Samples and pictures.")
def identify(
    scenario: Path,
    levels: tuple[float, ...],
    seeds: int,
    workers: int | None,
    scheduler: str | None,
    guided: bool | None,
    options: str | None,
    target: Path | None,
    iterations: int,
    runs: tuple[Path, ...],
    out: Path | None,
) -> None:
    """Fit the regional model and the drivers' own split ratios of a SUMO city; writes a network.toml.

    The city is loaded with multiples of the scenario's demand, first without perimeter control, then under a controller
    that probes it. Policies that were trained on the network as it was before do not fit the new one: train them again.

    Then the same with guided drivers, who make another model of the same city: it goes to the folder guided within the
    network's, where the controllers that guide routes find it. Where the scenario tells them of another one, as with
    [controllers.dpc-pcrg] and model = "../../networks/grid7_guided", and with --with or --network, there is one model
    only. One for a strategy with options has a table of its own, such as [controllers."dpc-pcrg+max-pressure"].

    Of an imported city the network's folder will do.

    \b
    Examples:
      cosim identify networks/mycity
      cosim identify networks/mycity --own --levels 0.6,0.8,1.0 --seeds 2
      cosim identify grid7_peak --guided --network networks/grid7_guided
      cosim identify grid7_peak --guided --with max-pressure --network networks/grid7_max_pressure
    """
    if runs and guided is None and not options:
        raise InputError("--runs: fits one model; say which, by --guided, --own or --with")
    cluster = chosen_scheduler(workers, scheduler)

    from cosim.evaluation import identify  # heavy
    from cosim.importing import find
    from nmfd.api import load_scenario

    scenario = find.scenario_of(scenario)
    loaded = load_scenario(scenario)
    both = guided is None and not options and target is None and identify.without_model(loaded)
    for guide in (False, True) if both else (bool(guided),):
        kind = f"{'-guided' if guide else ''}{f'-{options}' if options else ''}"
        folder = out or Path("runs") / f"{files.file_name(loaded.name)}-identify{kind}"
        if out and both and guide:
            folder = out / "guided"
        loading = identify.Loading(
            levels=levels,
            seeds=range(1000, 1000 + seeds),
            guided=guide,
            options=options.split("+") if options else (),
            network=target,
            iterations=iterations,
            runs=runs,
        )
        with resumable("identify", folder) as progress:
            text = identify.identify(
                scenario,
                loading,
                out=folder,
                workers=at_a_time(workers),
                scheduler=cluster,
                progress=progress,
                tell=tell,
            )
        if both:
            click.echo("Drivers who are guided:" if guide else "Drivers who go their own ways:")
        click.echo(text)
        written = os.path.normpath(loading.target(loaded) / "network.toml")
        click.echo(f"Written to {written}; samples and pictures to {folder}")


@click.command(name="import")
@click.argument("source", type=FILE, required=False, metavar="SUMOCFG|NET|OSM")
@click.option(
    "--bbox",
    metavar="W,S,E,N",
    help="A box of OpenStreetMap, in degrees, fetched from a public server, instead of a file.",
)
@click.option("--left-hand", is_flag=True, help="Of OpenStreetMap: a city that drives on the left.")
@declared("cosim.importing.settings:Import", "regions", instead="those of --edges, --taz or --polygons")
@click.option("--out", type=FOLDER, required=True, metavar="DIR", help="The network's folder, such as networks/mycity.")
@click.option("--scenario", type=FOLDER, metavar="DIR", help="[default: scenarios/<name>, beside the networks]")
@click.option(
    "--method",
    type=click.Choice(["density", "geometric"]),
    default="density",
    show_default=True,
    help="How: streets of similar density together, or k-means on the road graph.",
)
@click.option("--edges", type=FILE, metavar="CSV", help="Or your own regions: a table with the columns edge,region,")
@click.option("--taz", type=FILE, metavar="FILE", help="or a SUMO file with a TAZ per region,")
@click.option("--polygons", type=FILE, metavar="FILE", help="or one with a polygon or more (id, id.1, ...) per region.")
@click.option(
    "--routes",
    type=FILE,
    multiple=True,
    metavar="FILE",
    help="Vehicles, trips or flows, if not in the sumocfg. May be repeated.",
)
@click.option(
    "--od",
    type=FILE,
    multiple=True,
    metavar="FILE",
    help="OD matrix between TAZ: tazRelation XML, or VISUM's O- or V-format. May be repeated.",
)
@click.option("--zones", type=FILE, multiple=True, metavar="FILE", help="The TAZ of --od, if not in the sumocfg.")
@click.option("--demand", type=click.Choice(["peak"]), help="Generate a morning peak, for a city without demand.")
@declared("cosim.importing.settings:Import", "iterations", "gap")
@click.option(
    "--level",
    default="1",
    show_default=True,
    metavar="X|auto",
    help="Times the city's vehicles, or the usual peak; auto: the lowest at which without control a region "
    "comes to its critical accumulation.",
)
@declared("cosim.importing.settings:Import", "seeds")
@declared("cosim.plant.settings:SumoTable", "mesoscopic", is_flag=True)
@click.option("--begin", metavar="TIME", help="Instead of the sumocfg's, in seconds or as hours:minutes:seconds.")
@click.option("--end", metavar="TIME", help="Later departures are left out.")
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--no-run", is_flag=True, help="Do not simulate the city first: no densities and no flows.")
@click.option("--force", is_flag=True, help="Replace a network and scenario that are there.")
def import_(
    source: Path | None,
    bbox: str | None,
    left_hand: bool,
    regions: int | None,
    out: Path,
    scenario: Path | None,
    method: Literal["density", "geometric"],
    edges: Path | None,
    taz: Path | None,
    polygons: Path | None,
    routes: tuple[Path, ...],
    od: tuple[Path, ...],
    zones: tuple[Path, ...],
    demand: str | None,
    iterations: int,
    gap: float,
    level: str,
    seeds: int,
    mesoscopic: bool,
    begin: str | None,
    end: str | None,
    seed: int,
    no_run: bool,
    force: bool,
) -> None:
    """Turn any SUMO city into a network and a scenario: regions, gateways, demand by pair of regions, map.

    Its own vehicles stay as they are: routes, departures, types. The city is simulated without control first.
    A file of OpenStreetMap (.osm, .osm.xml or .osm.gz) becomes a network by SUMO's netconvert.

    \b
    Examples:
      cosim import city.sumocfg --regions 5 --out networks/mycity
      cosim import city.net.xml.gz --routes cars.rou.xml --regions 5 --out networks/mycity
      cosim import city.net.xml.gz --regions 6 --demand peak --out networks/mycity
      cosim import city.sumocfg --taz districts.taz.xml --out networks/mycity --begin 7:00:00 --end 9:00:00
      cosim import city.osm.gz --regions 5 --demand peak --out networks/mycity
      cosim import --bbox 11.32,44.48,11.36,44.50 --regions 4 --demand peak --out networks/mycity
    """
    from cosim.importing.assignment import Effort
    from cosim.importing.importer import ImportOptions, import_city, parse_time  # heavy
    from cosim.importing.osm import parse_box
    from cosim.importing.partition import Clustered, Drawn

    given = parse_box(bbox) if bbox is not None else source
    if given is None or (source is not None and bbox is not None):
        raise InputError("cosim import: give a sumocfg, a net or a file of OpenStreetMap, or else --bbox")
    cuts: list[Clustered | Drawn] = [] if regions is None else [Clustered(method=method, regions=regions)]
    cuts += [Drawn(method="edges", file=edges)] if edges else []
    cuts += [Drawn(method="taz", file=taz)] if taz else []
    cuts += [Drawn(method="polygons", file=polygons)] if polygons else []
    if len(cuts) != 1:
        raise InputError("--regions: give a number of regions, or else one of --edges, --taz and --polygons")
    if no_run and cuts[0].method == "density":
        raise InputError("--no-run: the densities come from that run; add --method geometric")
    order = ImportOptions(
        source=given,
        left_hand=left_hand,
        out=out,
        cut=cuts[0],
        seed=seed,
        run=not no_run,
        force=force,
        peak=demand is not None,
        level=parsed_level(level, no_run),
        mesoscopic=mesoscopic,
        scenario=scenario or out.parent.parent / "scenarios" / out.name,
        begin=parse_time(begin, "--begin"),
        end=parse_time(end, "--end"),
        routes=routes,
        od=od,
        zones=zones,
        effort=Effort(iterations=iterations, gap=gap),
        seeds=seeds,
    )
    with progress_line("import") as progress:
        report = import_city(order, lambda stage, share=0.0: progress(round(100 * share), 100, stage))
    click.echo(report)
    click.echo(f"Written to {order.out} (see map.png, quality.csv, gateways.csv) and {order.scenario}")
