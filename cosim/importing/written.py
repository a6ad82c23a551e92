"""The files that an import writes beside scenario.toml: the same content gives the same bytes."""

import csv
import gzip
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from cosim.importing import atlas, layers, model, quality
from cosim.importing.assignment import Assigned
from cosim.importing.baseline import Baseline
from cosim.importing.demand import Traffic, wrapped
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.arrays import PairsOverTime
from nmfd.model.regional_model import RegionalModel

NET = "city.net.xml.gz"
FILES = {"routes": "vehicles.rou.xml.gz", "background": "background.rou.xml.gz", "additional": "city.add.xml.gz"}


def write_traffic(folder: Path, traffic: Traffic) -> dict[str, list[str]]:
    """The vehicles, what is left alone and what both refer to; returns the file names by key of [sumo]."""
    contents = {
        "routes": (traffic.vehicles, "routes"),
        "background": (traffic.background, "routes"),
        "additional": (traffic.shared, "additional"),
    }
    files: dict[str, list[str]] = {}
    for key, (elements, tag) in contents.items():
        files[key] = [FILES[key]] if len(elements) else []
        if len(elements):
            root = wrapped(elements, tag)
            ElementTree.indent(root)
            _zip(folder / FILES[key], ElementTree.tostring(root))
    return files


def write_net(net: Path, target: Path) -> None:
    """A gzipped copy."""
    _zip(target, gzip.decompress(net.read_bytes()) if net.suffix == ".gz" else net.read_bytes())


def _zip(path: Path, content: bytes) -> None:
    """Without a date, so that the same content gives the same bytes."""
    with path.open("wb") as stream, gzip.GzipFile(fileobj=stream, mode="wb", filename="", mtime=0) as packed:
        packed.write(content)


def write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence]) -> None:
    """A csv file."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    path.write_text(out.getvalue(), encoding="utf-8")


def write_demand(path: Path, demand: PairsOverTime) -> None:
    """demand: (T, R, R) [veh/s]"""
    write_table(
        path,
        ("interval", "from", "to", "veh_s"),
        ((k, i, j, f"{demand[k, i, j]:.6g}") for k, i, j in np.argwhere(demand > 0)),
    )


def write_assignment(path: Path, assigned: Assigned) -> None:
    """A row per iteration; the routes of the chosen one are those of the vehicles."""
    write_table(
        path,
        ("iteration", "mesoscopic", "relative_gap", "mean_trip_s", "arrived_veh", "chosen"),
        (
            (n + 1, int(one.mesoscopic), f"{one.gap:.5f}", f"{one.trip_time:.1f}", one.arrived, int(n == assigned.best))
            for n, one in enumerate(assigned.iterations)
        ),
    )


def write_network(
    folder: Path,
    streets: Streets,
    regions: EdgeNumbers,
    network: RegionalModel,
    found: quality.Tables,
    baseline: Baseline | None,
    source: str,
) -> None:
    """network.toml, its tables, layers and map; source: the name of what the user gave."""
    (folder / "network.toml").write_text(
        model.network_text(network, {"net": NET, "regions": "regions.csv"}, source), encoding="utf-8"
    )
    for name, columns, rows in (
        ("quality.csv", quality.QUALITY, found.quality),
        ("gateways.csv", quality.GATEWAYS, found.gateways),
    ):
        write_table(folder / name, columns, ([row[column] for column in columns] for row in rows))
    if found.partitions:
        write_table(
            folder / "partitions.csv",
            quality.PARTITIONS,
            ([row[column] for column in quality.PARTITIONS] for row in found.partitions),
        )
    names = network.region_names
    (folder / "regions.taz.xml").write_text(layers.taz_xml(streets, regions, names), encoding="utf-8")
    (folder / "regions.poly.xml").write_text(layers.polygons_xml(streets, regions, names), encoding="utf-8")
    density = None if baseline is None else 1000.0 * baseline.density(streets)
    atlas.draw_map(folder / "map.png", streets, regions, names, network.positions, found, density)
