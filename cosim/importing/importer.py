"""`cosim import`: makes a network and a scenario of a city."""

import gzip
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from cosim.importing import maps, model, quality, report
from cosim.importing.assignment import ITERATIONS, Assigned, assign
from cosim.importing.baseline import Baseline, averaged_runs
from cosim.importing.case import Progress, SumoInput, seconds, sumo_input
from cosim.importing.choice import AUTO, CHOSEN, densest_region, labelled, number_of
from cosim.importing.comparison import Comparison, compare, plain_trips
from cosim.importing.counts import Counted, sampled
from cosim.importing.demand import Traffic, read_traffic, wrapped
from cosim.importing.generated import morning_peak
from cosim.importing.osm import Box, parse_box
from cosim.importing.partition import own_regions
from cosim.importing.streets import Streets, read_streets
from cosim.sumo.arrays import EdgeNumbers
from cosim.sumo.net import load_city
from cosim.sumo.signals import read_files, without_effect
from cosim.sumo.xml_files import check_path
from nmfd.errors import InputError
from nmfd.model import authority
from nmfd.model.authority import Verdict
from nmfd.model.regional_model import RegionalModel, network_toml
from nmfd.runs.files import temporary_folder
from nmfd.runs.progress import Show, watched
from nmfd.studies import plots

# For cars: beyond, the run without control is mesoscopic, so that it takes a minute.
LARGE_CITY_EDGES = 5000
NET = "city.net.xml.gz"
REGIONS = "regions.csv"
FILES = {
    "routes": "vehicles.rou.xml.gz",
    "background": "background.rou.xml.gz",
    "additional": "city.add.xml.gz",
}
REPORT = "import.txt"
# How its lines begin: on the comparison with plain SUMO, and on the regions.
COMPARISONS = ("same city", "not the same city", "not compared")
CHOICES = (CHOSEN,)
TYPES = ("vType", "vTypeDistribution")
COMMENT = """Imported from {}. The MFDs are PLACEHOLDERS from lane length and speed limits:
# cosim identify replaces them by measured ones."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """Arguments of `import_city`, checked.

    count: number of regions to find, None if `regions` is a table or AUTO
    begin, end: instead of the sumocfg's [s]
    """

    source: Path | Box
    out: Path
    scenario: Path
    regions: Path
    count: int | None
    routes: tuple[Path, ...]
    counts: Path | None
    demand: str | None
    level: float
    mesoscopic: bool
    begin: float | None
    end: float | None
    seed: int
    seeds: int
    iterations: int


@dataclass(frozen=True, kw_only=True)
class City:
    """Imported city, before it is written.

    case: from its beginning on; labels: (E,) region of every edge
    given: regions of the user's own table (E,), -1 where it has none; None without a table
    chosen: why these regions, "" if they are the user's own
    left: signals that perimeter control does not use -> reason
    switched: of these, signals whose programme a timetable changes
    factor: of the demand [-]; mesoscopic: the scenario's model
    files: keys of [sumo] -> names of files beside the scenario
    counted: trips made of counts, None without counts
    assigned: routes of a generated peak; same: comparison with plain SUMO, or why there is none
    """

    request: Request
    case: SumoInput
    streets: Streets
    traffic: Traffic
    clock: model.Clock
    baseline: Baseline
    labels: EdgeNumbers
    given: EdgeNumbers | None
    chosen: str
    left: Mapping[str, str]
    switched: tuple[str, ...]
    factor: float
    mesoscopic: bool
    files: Mapping[str, Sequence[str]]
    counted: Counted | None
    assigned: Assigned | None
    same: Comparison | str


def import_city(
    source: Path | str,
    out: Path,
    scenario: Path | None = None,
    *,
    regions: int | Path | str = AUTO,
    routes: Sequence[Path] = (),
    counts: Path | None = None,
    demand: str | None = None,
    level: float = 1.0,
    mesoscopic: bool = False,
    begin: str | None = None,
    end: str | None = None,
    seed: int = 0,
    seeds: int = 3,
    iterations: int = ITERATIONS,
    left_hand: bool = False,
) -> str:
    """Write the network and the scenario of a SUMO city; return a report.

    source: a sumocfg, a net.xml, a file of OpenStreetMap, or a box "W,S,E,N" of it as text
    out: new folder of the network
    scenario: new folder of the scenario; scenarios/NAME beside the folder of networks if None
    regions: number of regions to find, "auto", or the user's own table edge,region
    routes: files with vehicles beside those of the sumocfg
    counts: edgeData with vehicles that `entered` streets, of which trips are made instead
    demand: "peak" generates a morning peak instead
    level: multiplies the vehicles or the peak [-]
    mesoscopic: the scenario uses SUMO's queue model
    begin, end: time window, in seconds or as h:m:s, instead of the sumocfg's
    seeds: runs without control whose densities are averaged
    iterations: of the assignment of the peak
    left_hand: traffic keeps left in OpenStreetMap
    Raises: InputError for input that cannot be used; nothing is written then
    """
    request = Request(
        source=parse_box(source) if isinstance(source, str) else source,
        out=out,
        scenario=scenario or out.parent.parent / "scenarios" / out.name,
        regions=Path(str(regions)),
        count=number_of(str(regions)),
        routes=tuple(routes),
        counts=counts,
        demand=demand,
        level=level,
        mesoscopic=mesoscopic,
        begin=None if begin is None else seconds(begin, "--begin"),
        end=None if end is None else seconds(end, "--end"),
        seed=seed,
        seeds=seeds,
        iterations=iterations,
    )
    _check_new(request.out)
    _check_new(request.scenario)
    with ExitStack() as stack:
        progress = _progress(stack.enter_context(watched("import")))
        progress("reading")
        opened = sumo_input(request.source, progress, left_hand=left_hand)
        case = _as_requested(stack.enter_context(opened), request)
        scratch = stack.enter_context(temporary_folder())
        network_folder = scratch / "network"
        network_folder.mkdir()
        scenario_folder = scratch / "scenario"
        scenario_folder.mkdir()
        city = _imported(request, case, scratch, scenario_folder, progress)
        progress("writing")
        lines = _write(city, network_folder, scenario_folder)
        _move(network_folder, request.out)
        _move(scenario_folder, request.scenario)
    written = f"Written to {out} (see map.png, quality.csv, gateways.csv) and {request.scenario}"
    return "\n".join([*lines, written])


def _check_new(folder: Path) -> None:
    """Raise InputError for a folder that cannot be made."""
    check_path(folder)
    if folder.name in ("", "..") or "," in str(folder):
        raise InputError(
            "--out: expected a folder such as networks/mycity, without a comma, got "
            f"{folder} instead"
        )
    if folder.exists():
        raise InputError(f"--out: {folder} exists; choose another name, or remove it")


def _progress(show: Show) -> Progress:
    """Return a callback for stages from one for numbers, which may be None."""

    def progress(stage: str, share: float = 0.0) -> None:
        if show is not None:
            show(round(100 * share), 100, stage)

    return progress


def _as_requested(case: SumoInput, request: Request) -> SumoInput:
    """Return a case with the time window and vehicles of a request.

    Raises: InputError
    """
    begin = case.begin
    end = case.end
    if request.begin is not None:
        begin = request.begin
    if request.end is not None:
        end = request.end
    if begin < 0 or (end is not None and end <= begin):
        raise InputError(
            f"{case.source}: expected 0 s <= begin < end, got begin {begin:g} s, end {end} s"
        )
    return replace(case, begin=begin, end=end, routes=(*case.routes, *request.routes))


def _imported(
    request: Request, case: SumoInput, scratch: Path, folder: Path, progress: Progress
) -> City:
    """Return the city, after the runs without control.

    scratch: folder for files that are needed only now
    folder: its vehicles are written there
    """
    streets = read_streets(case.net, case.additional)
    given = None
    if request.count is None and str(request.regions) != AUTO:
        given = own_regions(streets, request.regions)
    counted = None
    if request.counts is not None:
        if case.routes or request.demand is not None:
            raise InputError(
                f"--counts: {case.source} has vehicles of its own; omit --routes and --demand, or "
                "give the network alone"
            )
        counted = sampled(request.counts, streets, scratch, request.seed, progress)
        case = replace(case, routes=(counted.routes,))
    traffic = read_traffic(case, streets, request.seed)
    mesoscopic = request.mesoscopic or case.mesoscopic
    simulated_meso = bool(mesoscopic or streets.drivable.sum() > LARGE_CITY_EDGES)
    factor = request.level
    assigned = None
    start = case
    if request.demand is not None:
        traffic, assigned = _peak(request, case, streets, traffic, simulated_meso, progress)
        factor = 1.0
    elif not len(traffic.depart):
        raise InputError(report.no_vehicles(case, traffic))
    elif request.begin is None:
        start = model.without_idle(case, traffic)
    clock = model.clock(start, streets, traffic)
    files = _write_traffic(folder, traffic)
    options = model.options(start, clock)
    baseline = averaged_runs(
        streets, folder, files, options, factor, simulated_meso, request.seeds, progress
    )
    same: Comparison | str = ""
    if request.demand is None:
        progress("simulating the city's own files")
        same = _compared(request, case, traffic, clock, baseline, simulated_meso)
    progress("partition")
    switched = sorted(read_files(case.net, case.additional).timetabled)
    everywhere = without_effect(case.options, mesoscopic)
    left = quality.left_alone(streets, switched, everywhere)
    wanted = request.count if given is None else given
    choice = labelled(streets, baseline, traffic.routes, wanted, uncontrollable=left)
    if choice.labels.max() < 1:
        raise InputError(
            f"{streets.path}: no two regions can be made that can be reached from each other; "
            "give a larger city, or your own regions with --regions FILE"
        )
    return City(
        request=request,
        case=start,
        streets=streets,
        traffic=traffic,
        clock=clock,
        baseline=baseline,
        labels=choice.labels,
        given=given,
        chosen=choice.reason,
        left=left,
        switched=tuple(switched),
        factor=factor,
        mesoscopic=mesoscopic,
        files=files,
        counted=counted,
        assigned=assigned,
        same=same,
    )


def _peak(
    request: Request,
    case: SumoInput,
    streets: Streets,
    beside: Traffic,
    mesoscopic: bool,
    progress: Progress,
) -> tuple[Traffic, Assigned]:
    """Generate a morning peak beside other traffic; assign its routes."""
    if len(beside.depart):
        raise InputError(
            f"--demand: {case.source} has {len(beside.depart):,} vehicles; omit --demand, or give "
            "the network alone"
        )
    peak = morning_peak(streets, level=request.level, begin=case.begin, seed=request.seed)
    shared = list(beside.shared)
    known = {part.get("id") for element in shared for part in element.iter("vType")}
    for kind in peak.shared:
        if kind.get("id") not in known:  # the city may define a type car
            shared.append(kind)
    traffic = replace(
        beside,
        vehicles=peak.vehicles,
        depart=peak.depart,
        origin=peak.origin,
        destination=peak.destination,
        shared=tuple(shared),
        notes={**beside.notes, **peak.notes},
    )
    clock = model.clock(case, streets, traffic)
    types = [element for element in shared if element.tag in TYPES]
    others = [element for element in shared if element.tag not in TYPES]
    with temporary_folder() as folder:
        additional = folder / "city.add.xml"
        ElementTree.ElementTree(wrapped(others, "additional")).write(additional)
        assigned = assign(
            streets.path.absolute(),
            [*types, *traffic.vehicles],
            begin=clock.begin,
            end=clock.end,
            seed=request.seed,
            iterations=request.iterations,
            additional=[additional] if others else [],
            mesoscopic=mesoscopic,
            time_to_teleport=case.time_to_teleport,
            progress=progress,
        )
    routes = Counter[tuple[int, ...]]()
    for vehicle in traffic.vehicles:
        route = vehicle.find("route")
        edges = assigned.routes.get(vehicle.get("id", ""))
        if route is not None and edges is not None:
            route.set("edges", " ".join(edges))
            routes[tuple(streets.number[edge] for edge in edges)] += 1
    return replace(traffic, routes=routes), assigned


def _write_traffic(folder: Path, traffic: Traffic) -> dict[str, list[str]]:
    """Write vehicles, background and what they refer to.

    Return the file names by key of [sumo].
    """
    contents = {
        "routes": traffic.vehicles,
        "background": traffic.background,
        "additional": traffic.shared,
    }
    names: dict[str, list[str]] = {}
    for key, elements in contents.items():
        names[key] = []
        if elements:
            root = wrapped(elements, "additional" if key == "additional" else "routes")
            ElementTree.indent(root)
            _zip(folder / FILES[key], ElementTree.tostring(root))
            names[key].append(FILES[key])
    return names


def _zip(path: Path, content: bytes) -> None:
    """Write a gzip file without a date: the same content gives the same bytes."""
    path.write_bytes(gzip.compress(content, mtime=0))


def _compared(
    request: Request,
    case: SumoInput,
    traffic: Traffic,
    clock: model.Clock,
    baseline: Baseline,
    mesoscopic: bool,
) -> Comparison | str:
    """Compare the run without control of seed 0 with plain SUMO.

    Return the reason if that cannot be.
    """
    if request.level != 1.0:
        return f"the demand is {request.level:g} times its own"
    if request.seed:
        return f"what SUMO draws for the vehicles is of seed {request.seed}"
    end = min(clock.end, traffic.end)
    try:
        plain = plain_trips(case, end, mesoscopic=mesoscopic)
    except InputError as error:
        return f"it refuses the city: {error}"
    result = compare(
        plain, baseline.trips, is_private=traffic.is_private, end=end, step=case.step_length
    )
    return replace(result, queue_model=mesoscopic and not case.mesoscopic)


def _write(city: City, network_folder: Path, scenario_folder: Path) -> list[str]:
    """Write a city into two folders; return the report."""
    case = city.case
    streets = city.streets
    labels = city.labels
    request = city.request
    baseline = city.baseline
    content = case.net.read_bytes()
    if case.net.suffix == ".gz":
        content = gzip.decompress(content)
    _zip(network_folder / NET, content)
    regions = pd.DataFrame({"edge": streets.edges, "region": labels})
    regions.to_csv(network_folder / REGIONS, index=False)
    network = model.network_of(streets, labels, request.out.name, baseline)
    loaded = load_city(network_folder / NET, network_folder / REGIONS, network.regions)
    tables = quality.tables(streets, labels, network.region_names, loaded, baseline, city.left)
    verdict = quality.import_verdict(
        network, tables.gateways, labels, baseline, request.scenario.name
    )
    network = replace(network, controllable=verdict.boundaries.shares)
    warnings = report.warnings(case, city.traffic)
    verdict = replace(verdict, sentences=(*verdict.sentences, *warnings))
    lines = _report(city, network, tables, verdict)
    comment = COMMENT.format(case.source.name)
    texts = {
        network_folder / "network.toml": network_toml(
            network, {"net": NET, "regions": REGIONS}, comment
        ),
        network_folder / REPORT: "\n".join(lines) + "\n",
        network_folder / authority.FILE: verdict.text(),
        scenario_folder / "scenario.toml": _scenario_text(city, network),
    }
    if case.notice:
        texts[network_folder / "NOTICE.txt"] = case.notice
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    pd.DataFrame(tables.quality).to_csv(network_folder / "quality.csv", index=False)
    pd.DataFrame(tables.gateways).to_csv(network_folder / "gateways.csv", index=False)
    _write_demand(scenario_folder / "demand.csv", city)
    drawing = plots.figure(6.2, 6.0)
    maps.region_map(
        drawing.subplots(), streets, labels, network.region_names, network.positions, tables
    )
    plots.save(drawing, network_folder / "map.png")
    return lines


def _report(
    city: City, network: RegionalModel, tables: quality.Tables, verdict: Verdict
) -> list[str]:
    """Return what was imported and what to expect, in lines."""
    request = city.request
    traffic = city.traffic
    clock = city.clock
    lines = [
        report.summary(city.case, city.streets, traffic, clock),
        report.table(tables),
        report.outcome(city.baseline, clock),
    ]
    if city.same:
        lines.append(report.comparison(city.same, city.case, traffic, clock))
    lines += traffic.remarks
    if city.counted is not None:
        lines.append(city.counted.text(city.streets, city.baseline))
    if city.assigned is not None:
        lines += report.assignment(city.assigned)
    lines += report.not_taken_over(city.case, clock)
    lines += quality.doubts(city.streets, city.labels, network.region_names)
    lines += quality.short_demand(traffic.depart, clock.begin, clock.step)
    if city.given is None:
        if city.chosen:
            lines.append(city.chosen)
        if network.regions < (request.count or 0):
            lines.append(
                f"{network.regions} regions instead of {request.count}: others could not be "
                "reached, or fell apart"
            )
    else:
        moved = (city.given != city.labels)[city.streets.drivable & (city.given >= 0)].sum()
        if moved:
            lines.append(
                f"{moved:,} streets are in other regions than in {request.regions}: each region "
                "must be reached from each"
            )
    return [*lines, *verdict.sentences]


def reported(network: Path, beginnings: tuple[str, ...]) -> str:
    """Return a line of the report of an import, "" without one.

    network: folder of the network
    beginnings: how it may begin, such as COMPARISONS
    """
    file = network / REPORT
    lines = []
    if file.is_file():
        lines = file.read_text(encoding="utf-8").splitlines()
    return next((line for line in lines if line.startswith(beginnings)), "")


def _scenario_text(city: City, network: RegionalModel) -> str:
    """Return the scenario.toml of a city."""
    request = city.request
    densest = densest_region(city.streets, city.baseline, city.labels)
    return model.scenario_text(
        network,
        city.clock,
        city.case,
        name=request.scenario.name,
        files=city.files,
        leave=city.switched,
        network_path=os.path.relpath(request.out, request.scenario).replace(os.sep, "/"),
        protected=densest,
        factor=city.factor,
        mesoscopic=city.mesoscopic,
    )


def _write_demand(path: Path, city: City) -> None:
    """Write the demand between regions, by interval and pair."""
    flows = model.region_demand(city.traffic, city.labels, city.clock)
    rows = [(k, i, j, f"{flows[k, i, j]:.6g}") for k, i, j in np.argwhere(flows > 0)]
    table = pd.DataFrame(rows, columns=["interval", "from", "to", "veh_s"])
    table.to_csv(path, index=False)


def _move(folder: Path, place: Path) -> None:
    """Move a finished folder to its place."""
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(folder, place)
