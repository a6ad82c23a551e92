"""Commands of `nmfd` for what comes from elsewhere and goes there: measured data, controllers of one's own, exported
policies."""

from importlib import resources
from pathlib import Path

import click

from nmfd.cli.declared import declared
from nmfd.cli.options import FILE, FOLDER, quoted
from nmfd.errors import InputError


@click.command(name="new-controller")
@click.argument("file", type=FILE)
def new_controller(file: Path) -> None:
    """Write a commented controller to begin with. Any command takes it as FILE:Class instead of a controller's name.

    A package may offer controllers too, by name: entry points of the group nmfd.controllers.

    \b
    Example:
      nmfd new-controller mine.py
      nmfd benchmark economic_mpc --controllers no-control,pi-gating,mine.py:MyController
    """
    if file.suffix != ".py":
        raise InputError(f"{file}: expected a name that ends in .py, such as {file.with_suffix('.py')}")
    if file.exists():
        raise InputError(f"{file}: is there already; choose another name")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it first")
    text = resources.files("nmfd.controllers").joinpath("template.py").read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", str(file)), encoding="utf-8")
    click.echo(
        f"Written to {file}; try it with: nmfd benchmark economic_mpc "
        f"--controllers no-control,pi-gating,{quoted(file)}:MyController"
    )


@click.command()
@click.argument("counts", type=FILE)
@click.option(
    "--detectors",
    type=FILE,
    metavar="CSV",
    help="detid, length [km of its link], and lanes, linkid, pos, long, lat (or x, y [m]), region if known.",
)
@click.option("--regions", type=FILE, metavar="CSV", help="detid,region, where no other table has a column region.")
@click.option(
    "--about",
    type=FILE,
    metavar="CSV",
    help="Of the regions: region, and any of lane_km, trip_length [m], x and y [m].",
)
@click.option(
    "--adjacency",
    type=FILE,
    metavar="CSV|TOML",
    help="Neighbours: region,neighbour, or the network.toml of the same regions. [default: by the detectors' "
    "positions]",
)
@declared("nmfd.studies.settings:Measured", "trip_length", instead="assumed from the region's size, with a warning")
@declared("nmfd.studies.settings:Measured", "vehicle_length", "least_share")
@click.option("--city", metavar="NAME", help="Of several in the tables.")
@click.option("--skip-bad", is_flag=True, help="Leave out rows with a missing or impossible number, and count them.")
@click.option("--name", metavar="NAME", help="Of the network. [default: that of the folder]")
@click.option("--out", type=FOLDER, required=True, metavar="DIR", help="The network's folder, such as networks/zurich.")
@click.option("--force", is_flag=True, help="Replace a network.toml that is there.")
def identify(
    counts: Path,
    detectors: Path | None,
    regions: Path | None,
    about: Path | None,
    adjacency: Path | None,
    trip_length: float | None,
    vehicle_length: float,
    least_share: float,
    city: str | None,
    skip_bad: bool,
    name: str | None,
    out: Path,
    force: bool,
) -> None:
    """Make a network of measured data: counts and occupancies of detectors become an MFD per region.

    COUNTS has the columns of UTD19 (utd19.ethz.ch): day, interval [s since midnight], detid, flow [veh/h per lane], occ
    [share of the time], and error, city, region if known. Writes network.toml, which trains and benchmarks like any
    other once a scenario has demand for it, mfd.png, samples.csv, fit.csv and identify.txt: how good the fits are, and
    what the data do not say.

    \b
    Examples:
      nmfd identify counts.csv --detectors detectors.csv --regions regions.csv --trip-length 1500 --out networks/mine
      nmfd identify utd19_u.csv --detectors detectors_public.csv --regions zones.csv --city zurich --skip-bad \\
          --about about.csv --adjacency neighbours.csv --out networks/zurich
    """
    from nmfd.studies import measured  # heavy
    from nmfd.studies.settings import Measured

    found = measured.identify(
        measured.Sources(
            counts=counts,
            detectors=detectors,
            regions=regions,
            about=about,
            adjacency=adjacency,
            city=city,
            skip_bad=skip_bad,
        ),
        Measured(vehicle_length=vehicle_length, trip_length=trip_length, least_share=least_share),
        out=out,
        name=name,
        force=force,
    )
    click.echo(found.text)
    click.echo(f"Written to {out}: see network.toml, mfd.png and identify.txt")
