"""MFDs of regions from SUMO's edgeData, without control: `cosim mfd`.

With the edges of a region and an interval of T seconds (Edie, 1963),

    accumulation   n = sum of density times length   [veh]
    production     P = sum of distance / T           [veh km/h]

P / n is the mean speed, and P over the lane-kilometres the mean flow per lane. The outflow counts
trips that ended in the region and vehicles that left it. edgeData has no turns: they are estimated
from the vehicles that left and entered the edges.

The curve of outflow is that of `cosim identify` through its samples (outflow_critical_veh in the
fit.csv of both). For the same run the two agree to 1 % if edgeData has internal edges
(withInternal) and a `freq` of one control interval. A vehicle on a junction counts where it comes
from. `nmfd identify` fits tables of detectors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.importing.baseline import INTERVAL_S, Baseline, Way
from cosim.importing.choice import AUTO, Choice, labelled, number_of
from cosim.importing.partition import digraph, names, own_regions, partition, positions
from cosim.importing.streets import Streets, numbers_of, read_streets
from cosim.sumo.arrays import EdgeNumbers
from cosim.sumo.edge_data import ON_JUNCTION, read_edge_data
from nmfd.arrays import PerRegion
from nmfd.errors import InputError
from nmfd.model import mfd
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files
from nmfd.runs.tables import NARROW, cell, text_table, wrapped
from nmfd.studies import fit_quality, plots
from nmfd.studies.measured import U_MAX, U_MIN, samples_of

BALANCING = 20  # rounds, after which turns add up
PRODUCTION = "production_veh_km_h"
OUTFLOW = "outflow_veh_s"
KEYS = ["region", "day", "begin"]  # of a sample
CAPTION = """\
critical: accumulation [veh] at the largest production, its density in veh per lane-km; "above": not
seen
production: the largest of the fitted curve [veh km/h]; speed: there [km/h]
by outflow: accumulation at the largest outflow
hysteresis: excess of production while loading over unloading at the same accumulation
R2: share of the variance that the curve explains"""


@dataclass(frozen=True, kw_only=True)
class EdgeMfds:
    """MFDs of the regions of a network.

    regions: edge and region of every edge
    chosen: why there are so many regions, "" if the user said how many
    samples: a row per region, file (day) and interval, with accumulation_veh, production_veh_km_h,
        density_veh_km and flow_veh_h (both per lane), speed_km_h, arrived_veh (trips that ended
        there) and outflow_veh_s
    network: its MFDs give the production [veh km/h]
    fits: a row per region: fit_quality.region_fits, lane_km and outflow_critical_veh (NaN: not
        seen)
    out: folder of files
    """

    regions: pd.DataFrame
    chosen: str
    samples: pd.DataFrame
    network: RegionalModel
    fits: pd.DataFrame
    out: Path

    def text(self, *, explain: bool = False) -> str:
        """Return the table of the terminal; explain: with what its columns mean."""
        lines = [text_table([_row(fit) for _, fit in self.fits.iterrows()])]
        if explain:
            lines += wrapped(CAPTION, NARROW)
        for fit in self.fits.itertuples():
            for doubt in fit.doubts:
                lines += wrapped(f"WARNING, region {fit.region} {fit.name}: {doubt}", NARROW)
        return "\n".join([*wrapped(self.chosen, NARROW), *lines])

    def write(self) -> None:
        """Write regions, samples, fits and a picture of the MFDs."""
        out = self.out
        out.mkdir(parents=True, exist_ok=True)
        files.write_table(out / "regions.csv", self.regions)
        files.write_table(out / "samples.csv", self.samples, float_format="%.6g")
        fit_quality.write_fits(out / "fit.csv", self.fits)
        clouds = samples_of(self.samples, self.network.region_names, PRODUCTION)
        plots.draw_mfds(out / "mfd.png", self.network, clouds, "production [veh km/h]")


def edge_mfds(net: Path, edge_data: Sequence[Path], regions: str, out: Path) -> EdgeMfds:
    """Fit the MFDs of a network, and write them.

    edge_data: SUMO's outputs, one for every run
    regions: their number, AUTO, or a table edge,region
    out: folder of files
    Raises: InputError
    """
    wanted: int | EdgeNumbers | None = number_of(regions, fewest=1)
    streets = read_streets(net)
    if wanted is None and regions != AUTO:
        wanted = own_regions(streets, Path(regions))
    days = []
    for day, path in enumerate(edge_data):
        rows = _placed(read_edge_data(path, junctions=True), streets, path)
        days.append(rows.assign(day=day))
    rows = pd.concat(days, ignore_index=True)
    baseline = _baseline(streets, rows, len(days))
    if isinstance(wanted, int):
        choice = Choice(partition(streets, baseline, wanted))
    else:
        pairs = {way: vehicles for (way, _), vehicles in baseline.ways.items()}
        choice = labelled(streets, baseline, pairs, wanted)
    region_names = names(streets, choice.labels)
    lane_km = np.bincount(choice.labels, streets.lane_metres) / 1000.0
    outflow = _outflow(streets, rows, choice.labels)
    samples = _samples(rows, choice.labels, region_names, lane_km, outflow)
    network = _network(streets, choice.labels, region_names, samples)
    clouds = samples_of(samples, region_names, PRODUCTION)
    fits = fit_quality.region_fits(network, clouds, lane_km=lane_km)
    # One run has few samples, so that one of either branch is enough.
    fits["hysteresis"] = [fit_quality.hysteresis(cloud, fewest=1) for cloud in clouds]
    outflows = _outflow_samples(samples, network)
    fits["outflow_critical_veh"] = [fit_quality.outflow_critical(cloud) for cloud in outflows]
    found = EdgeMfds(
        regions=pd.DataFrame({"edge": streets.edges, "region": choice.labels}),
        chosen=choice.reason,
        samples=samples,
        network=network,
        fits=fits.assign(lane_km=lane_km),
        out=out,
    )
    found.write()
    return found


def _placed(rows: pd.DataFrame, streets: Streets, path: Path) -> pd.DataFrame:
    """Return rows with number and vehicles, too.

    An internal edge gets the number of the edge before it; what it counts of those that enter and
    leave is left out. Other edges of junctions, such as pedestrian crossings, are left out.

    Raises: InputError for an unknown edge of the file at `path`
    """
    inside = rows["edge"].isin(streets.inside)
    rows = rows[inside | ~rows["edge"].str.startswith(ON_JUNCTION)].copy()
    rows.loc[inside, ["entered", "left"]] = 0.0
    before = {edge: place.before for edge, place in streets.inside.items()}
    own = rows["edge"].map(before).fillna(rows["edge"])
    rows["number"] = numbers_of(own, streets, path)
    length = pd.Series(streets.length[rows["number"]], rows.index)
    lengths = {edge: place.length for edge, place in streets.inside.items()}
    length = rows["edge"].map(lengths).fillna(length)
    return rows.assign(vehicles=rows["density"] * length / 1000.0)


def _baseline(streets: Streets, rows: pd.DataFrame, days: int) -> Baseline:
    """Return presence and turns, by which regions are found.

    rows: EdgeRow, day, number and vehicles
    """
    length = rows["end"] - rows["begin"]
    longest = length.max()
    window = longest * np.ceil(INTERVAL_S / longest)
    place = ((rows["begin"] - rows["begin"].min()) / window).astype(int)
    presence = np.zeros((place.max() + 1, len(streets.edges)))
    time = rows["vehicles"] * length * INTERVAL_S / window / days
    np.add.at(presence, (place, rows["number"]), time)
    pairs = streets.links.tolist()
    vehicles = _turns(streets, rows).round().astype(int).tolist()
    ways: dict[Way, int] = {}
    for (edge, following), passed in zip(pairs, vehicles, strict=True):
        ways[(edge, following), following] = passed
    return Baseline(presence=presence, ways=ways)


def _turns(streets: Streets, rows: pd.DataFrame) -> np.ndarray:
    """Return the vehicles of each link from edge to edge, about (veh, (L,)).

    They add up to those that entered an edge, and nearly to those that left it (Furness method).
    """
    edges = len(streets.edges)
    left = np.bincount(rows["number"], rows["left"], edges)
    entered = np.bincount(rows["number"], rows["entered"], edges)
    source, target = streets.links.T
    turns = left[source] * entered[target]
    for _ in range(BALANCING):
        leaving = np.bincount(source, turns, edges)
        turns *= (left / np.maximum(leaving, 1e-9))[source]
        entering = np.bincount(target, turns, edges)
        turns *= (entered / np.maximum(entering, 1e-9))[target]
    return turns


def _outflow(streets: Streets, rows: pd.DataFrame, labels: EdgeNumbers) -> pd.Series:
    """Return the outflow (veh/s) by KEYS. rows: EdgeRow, day and number"""
    regions = labels.max() + 1
    before, after = labels[streets.links].T
    leaves = before != after
    outflow = {}
    for (day, begin), interval in rows.groupby(["day", "begin"]):
        ended = np.bincount(labels[interval["number"]], interval["arrived"], regions)
        left = np.bincount(before[leaves], _turns(streets, interval)[leaves], regions)
        seconds = interval["end"].iloc[0] - begin
        for region, vehicles in enumerate(ended + left):
            outflow[region, day, begin] = vehicles / seconds
    series = pd.Series(outflow, name=OUTFLOW)
    series.index.names = KEYS
    return series


def _outflow_samples(samples: pd.DataFrame, network: RegionalModel) -> fit_quality.Samples:
    """Return the samples of outflow that `cosim identify` takes of a run.

    samples: of `_samples`
    """
    table = samples.pivot(index=["day", "begin_s"], columns="region").fillna(0.0)
    names = list(network.region_names)
    days = []
    for _, day in table.groupby("day"):
        inside = day["accumulation_veh"][names].to_numpy()
        outflow = day[OUTFLOW][names].to_numpy()
        held_up = mfd.held_up(inside, outflow, network.adjacency)
        days.append(fit_quality.samples_of_run(inside, outflow, held_up))
    return fit_quality.joined(days)


def _samples(
    rows: pd.DataFrame,
    labels: EdgeNumbers,
    region_names: Sequence[str],
    lane_km: PerRegion,
    outflow: pd.Series,
) -> pd.DataFrame:
    """Return EdgeMfds.samples.

    rows: EdgeRow, day, number and vehicles
    outflow: of `_outflow`
    """
    region = labels[rows["number"]]
    sums = rows.assign(region=region).groupby(KEYS)
    totals = sums[["vehicles", "distance", "arrived"]].sum().join(sums["end"].first())
    table = totals.join(outflow).reset_index()
    lanes = lane_km[table["region"]]
    accumulation = table["vehicles"]
    production = 3.6 * table["distance"] / (table["end"] - table["begin"])
    return pd.DataFrame(
        {
            "region": np.array(region_names)[table["region"]],
            "day": table["day"],
            "begin_s": table["begin"],
            "end_s": table["end"],
            "accumulation_veh": accumulation,
            PRODUCTION: production,
            "density_veh_km": accumulation / lanes,
            "flow_veh_h": production / lanes,
            "speed_km_h": production / accumulation.where(accumulation > 0),
            "arrived_veh": table["arrived"],
            OUTFLOW: table[OUTFLOW],
        }
    )


def _network(
    streets: Streets, labels: EdgeNumbers, region_names: tuple[str, ...], samples: pd.DataFrame
) -> RegionalModel:
    """Return the regional model whose MFDs fit the samples best.

    Raises: InputError for a region with too few of them
    """
    curves = []
    above = {}
    for region, cloud in enumerate(samples_of(samples, region_names, PRODUCTION)):
        points = fit_quality.own_points(cloud)
        if len(points) < fit_quality.SAMPLES:
            raise InputError(
                f"region {region} {region_names[region]}: has vehicles in {len(points)} intervals; "
                f"an MFD needs {fit_quality.SAMPLES} or more: give a smaller freq of edgeData, a "
                "longer run, or fewer regions"
            )
        curve = mfd.fit(*points.T)
        most = points[:, 0].max()
        if not fit_quality.falls(curve, most):
            above[region] = float(most)
        curves.append(curve)
    return RegionalModel(
        name=streets.path.name,
        region_names=region_names,
        positions=positions(streets, labels),
        adjacency=digraph(streets, labels) > 0,
        mfds=tuple(curves),
        u_min=U_MIN,
        u_max=U_MAX,
        critical_above=above,
    )


def _row(fit: pd.Series) -> dict[str, object]:
    """Return a row of the table. fit: of EdgeMfds.fits"""
    critical = f"{fit['critical_veh']:,.0f}"
    density = f"{fit['critical_veh'] / fit['lane_km']:.1f}"
    speed = f"{fit['max_outflow_veh_s'] / fit['critical_veh']:.1f}"
    if np.isnan(fit["critical_veh"]):
        critical = f"above {fit['critical_above_veh']:,.0f}"
        density = "-"
        speed = "-"
    return {
        "region": f"{fit['region']} {fit['name']}",
        "lane-km": f"{fit['lane_km']:.1f}",
        "samples": fit["samples"],
        "critical": critical,
        "veh/lane-km": density,
        "production": f"{fit['max_outflow_veh_s']:,.0f}",
        "speed": speed,
        "by outflow": cell(fit["outflow_critical_veh"], "{:,.0f}"),
        "hysteresis": cell(fit["hysteresis"], "{:+.0%}"),
        "R2": f"{fit['r2']:.2f}",
    }
