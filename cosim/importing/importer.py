"""`cosim import`: a SUMO city or OpenStreetMap becomes networks/NAME and scenarios/NAME."""

import gzip
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from cosim.importing import maps, model, quality
from cosim.importing.assignment import GAP, ITERATIONS, Assigned, assign
from cosim.importing.baseline import Baseline, averaged_runs
from cosim.importing.case import Progress, SumoInput, parse_box, seconds, sumo_input
from cosim.importing.demand import Traffic, read_traffic, wrapped
from cosim.importing.generated import morning_peak
from cosim.importing.partition import finish, own_regions, partition
from cosim.importing.streets import Streets, read_streets
from cosim.sumo.net import load_city
from cosim.sumo.signals import timetabled, without_effect
from cosim.sumo.xml_files import check_path
from nmfd.errors import InputError
from nmfd.model import authority
from nmfd.model.regional_model import network_toml
from nmfd.runs.files import temporary_folder
from nmfd.runs.progress import watched
from nmfd.runs.tables import text_table
from nmfd.studies import plots

LARGE_CITY_EDGES = (
    5000  # for cars: beyond, the run without control is mesoscopic, so that it takes a minute
)
LEFT_OUT = 0.01  # share of vehicles or distance above which a warning follows
NET = "city.net.xml.gz"
FILES = {
    "routes": "vehicles.rou.xml.gz",
    "background": "background.rou.xml.gz",
    "additional": "city.add.xml.gz",
}
TYPES = ("vType", "vTypeDistribution")
COMMENT = """Imported from {}. The MFDs are PLACEHOLDERS from lane length and speed limits:
# cosim identify replaces them by measured ones."""
CAPTION = (
    "density: in the busiest quarter of an hour without control, per lane; variance: over the region's streets; "
    "uncontrolled: share of the boundary flow that passes no controllable signal"
)


def import_city(
    source: Path | str,
    out: Path,
    scenario: Path | None = None,
    *,
    regions: int | Path | str,
    routes: Sequence[Path] = (),
    demand: str | None = None,
    level: float = 1.0,
    mesoscopic: bool = False,
    begin: str | None = None,
    end: str | None = None,
    seed: int = 0,
    seeds: int = 3,
    iterations: int = ITERATIONS,
) -> str:
    """Write the network and the scenario of a SUMO city; return a report.

    source: a sumocfg, a net.xml, a file of OpenStreetMap, or a box "W,S,E,N" of it as text
    out: new folder of the network
    scenario: new folder of the scenario; scenarios/NAME beside the folder of networks if None
    regions: number of regions to find, or the user's own table edge,region
    routes: files with vehicles beside those of the sumocfg
    demand: "peak" generates a morning peak instead
    level: multiplies the vehicles or the peak [-]
    mesoscopic: the scenario uses SUMO's queue model
    begin, end: time window, in seconds or as h:m:s, instead of the sumocfg's
    seeds: runs without control whose densities are averaged
    iterations: of the assignment of the peak
    Raises: InputError for input that cannot be used; nothing is written then
    """
    count = int(str(regions)) if str(regions).isdecimal() else None
    if count is not None and count < 2:
        raise InputError(f"--regions: expected 2 or more regions, or a file, got {regions} instead")
    place = parse_box(source) if isinstance(source, str) else source
    scenario = scenario or out.parent.parent / "scenarios" / out.name
    first = None if begin is None else seconds(begin, "--begin")
    last = None if end is None else seconds(end, "--end")
    for folder in (out, scenario):
        check_path(folder)
        if folder.name in ("", "..") or "," in str(folder):
            raise InputError(
                f"--out: expected a folder such as networks/mycity, without a comma, got {folder} instead"
            )
        if folder.exists():
            raise InputError(f"--out: {folder} exists; choose another name, or remove it")
    with ExitStack() as stack:
        show = stack.enter_context(watched("import"))

        def progress(stage: str, share: float = 0.0) -> None:
            show and show(round(100 * share), 100, stage)

        progress("reading")
        case, scratch = (
            stack.enter_context(sumo_input(place, progress)),
            stack.enter_context(temporary_folder()),
        )
        case = replace(
            case,
            begin=case.begin if first is None else first,
            end=case.end if last is None else last,
        )
        case = replace(case, routes=(*case.routes, *routes))
        if case.begin < 0 or (case.end is not None and case.end <= case.begin):
            window = f"begin {case.begin:g} s, end {case.end} s"
            raise InputError(f"{case.source}: expected 0 s <= begin < end, got {window}")
        streets = read_streets(case.net, case.additional)
        own = own_regions(streets, Path(str(regions))) if count is None else None
        traffic = read_traffic(case, streets, seed)
        mesoscopic = mesoscopic or case.mesoscopic
        meso = mesoscopic or streets.drivable.sum() > LARGE_CITY_EDGES
        factor, assigned = level, None
        if demand is not None:
            traffic, assigned = _peak(
                case, streets, traffic, level, seed, iterations, meso, progress
            )
            factor = 1.0
        elif not len(traffic.depart):
            raise InputError(
                f"{case.source}: names no vehicles for the streets of cars{_notes(traffic)}; give a sumocfg with "
                "route-files, or add --routes FILE or --demand peak"
            )
        elif begin is None:
            case = model.without_idle(case, traffic)
        clock = model.clock(case, streets, traffic)
        net_folder, folder = scratch / "network", scratch / "scenario"
        net_folder.mkdir()
        folder.mkdir()
        files = _write_traffic(folder, traffic)
        baseline = averaged_runs(
            streets, folder, files, model.options(case, clock), factor, meso, seeds, progress
        )
        progress("partition")
        switched = sorted({*traffic.switched, *timetabled(case.net)})
        left = quality.left_alone(streets, switched, without_effect(case.options, mesoscopic))
        if count is not None:
            labels = partition(streets, baseline, count, uncontrollable=left)
        else:
            labels = finish(streets, own, renumber=False)
        if labels.max() < 1:
            raise InputError(
                f"{streets.path}: no two regions can be made that can be reached from each other"
            )
        progress("writing")
        network = model.network_of(streets, labels, out.name, baseline)
        content = case.net.read_bytes()
        _zip(net_folder / NET, gzip.decompress(content) if case.net.suffix == ".gz" else content)
        pd.DataFrame({"edge": streets.edges, "region": labels}).to_csv(
            net_folder / "regions.csv", index=False
        )
        city = load_city(net_folder / NET, net_folder / "regions.csv", network.regions)
        tables = quality.tables(streets, labels, network.region_names, city, baseline, left)
        verdict = quality.import_verdict(network, tables.gateways, labels, baseline, scenario.name)
        network = replace(network, controllable=verdict.boundaries.shares)
        if max(traffic.left_out) > LEFT_OUT:
            warning = (
                f"WARNING: {_left_out(traffic)}: this is not the traffic of {case.source.name}"
            )
            verdict = replace(verdict, sentences=(*verdict.sentences, warning))
        report = _report(case, streets, traffic, clock, tables, baseline, assigned)
        if count is not None and network.regions < count:
            report.append(
                f"{network.regions} regions instead of {count}: others could not be reached, or fell apart"
            )
        elif own is not None and (
            moved := int((own != labels)[streets.drivable & (own >= 0)].sum())
        ):
            report.append(
                f"{moved:,} streets are in other regions than in {regions}: regions must be connected"
            )
        report += verdict.sentences
        load = np.bincount(labels, baseline.density(streets) * streets.lane_metres)
        texts = {
            net_folder / "network.toml": network_toml(
                network, {"net": NET, "regions": "regions.csv"}, COMMENT.format(case.source.name)
            ),
            net_folder / "import.txt": "\n".join(report) + "\n",
            net_folder / authority.FILE: verdict.text(),
            folder / "scenario.toml": model.scenario_text(
                network,
                clock,
                case,
                name=scenario.name,
                files=files,
                leave=switched,
                network_path=os.path.relpath(out, scenario).replace(os.sep, "/"),
                protected=int(np.argmax(load / np.bincount(labels, streets.lane_metres))),
                factor=factor,
                mesoscopic=mesoscopic,
            ),
        }
        if case.notice:
            texts[net_folder / "NOTICE.txt"] = case.notice
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
        pd.DataFrame(tables.quality).to_csv(net_folder / "quality.csv", index=False)
        pd.DataFrame(tables.gateways).to_csv(net_folder / "gateways.csv", index=False)
        flows = model.region_demand(traffic, labels, clock)
        rows = [(k, i, j, f"{flows[k, i, j]:.6g}") for k, i, j in np.argwhere(flows > 0)]
        pd.DataFrame(rows, columns=["interval", "from", "to", "veh_s"]).to_csv(
            folder / "demand.csv", index=False
        )
        drawing = plots.figure(6.2, 6.0)
        maps.region_map(
            drawing.subplots(), streets, labels, network.region_names, network.positions, tables
        )
        plots.save(drawing, net_folder / "map.png")
        for temporary, place in ((net_folder, out), (folder, scenario)):
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(temporary, place)
    written = f"Written to {out} (see map.png, quality.csv, gateways.csv) and {scenario}; next: cosim identify {out}"
    return "\n".join([*report, written])


def _peak(
    case: SumoInput,
    streets: Streets,
    beside: Traffic,
    level: float,
    seed: int,
    iterations: int,
    mesoscopic: bool,
    progress: Progress,
) -> tuple[Traffic, Assigned]:
    """Generate a morning peak beside the city's other traffic, and assign its routes."""
    if count := len(beside.depart):
        raise InputError(
            f"--demand: {case.source} has {count:,} vehicles; omit --demand, or give the network alone"
        )
    peak = morning_peak(streets, level=level, begin=case.begin, seed=seed)
    known = {part.get("id") for element in beside.shared for part in element.iter("vType")}
    types = tuple(
        e for e in peak.shared if e.get("id") not in known
    )  # the city may define a type car
    traffic = replace(
        beside,
        vehicles=peak.vehicles,
        depart=peak.depart,
        origin=peak.origin,
        destination=peak.destination,
        shared=beside.shared + types,
        notes={**beside.notes, **peak.notes},
    )
    clock = model.clock(case, streets, traffic)
    others = [element for element in traffic.shared if element.tag not in TYPES]
    with temporary_folder() as folder:
        additional = folder / "city.add.xml"
        ElementTree.ElementTree(wrapped(others, "additional")).write(additional)
        assigned = assign(
            streets.path.absolute(),
            [*(element for element in traffic.shared if element.tag in TYPES), *traffic.vehicles],
            begin=clock.begin,
            end=clock.end,
            seed=seed,
            iterations=iterations,
            additional=[additional] if others else [],
            mesoscopic=mesoscopic,
            time_to_teleport=case.time_to_teleport,
            progress=progress,
        )
    for vehicle in traffic.vehicles:
        if (route := vehicle.find("route")) is not None and (
            name := vehicle.get("id", "")
        ) in assigned.routes:
            route.set("edges", " ".join(assigned.routes[name]))
    return traffic, assigned


def _write_traffic(folder: Path, traffic: Traffic) -> dict[str, list[str]]:
    """Write vehicles, background and what they refer to; return the file names by key of [sumo]."""
    contents = {
        "routes": traffic.vehicles,
        "background": traffic.background,
        "additional": traffic.shared,
    }
    for key, elements in contents.items():
        if elements:
            root = wrapped(elements, "additional" if key == "additional" else "routes")
            ElementTree.indent(root)
            _zip(folder / FILES[key], ElementTree.tostring(root))
    return {key: [FILES[key]] if elements else [] for key, elements in contents.items()}


def _zip(path: Path, content: bytes) -> None:
    """Write a gzip file without a date: the same content gives the same bytes."""
    path.write_bytes(gzip.compress(content, mtime=0))


def _left_out(traffic: Traffic) -> str:
    return "{:.1%} of the vehicles and {:.1%} of the distance left out".format(*traffic.left_out)


def _notes(traffic: Traffic) -> str:
    return "".join(f"; {note}: {count:,}" for note, count in sorted(traffic.notes.items()))


def _report(
    case: SumoInput,
    streets: Streets,
    traffic: Traffic,
    clock: model.Clock,
    tables: quality.Tables,
    baseline: Baseline,
    assigned: Assigned | None,
) -> list[str]:
    """Return what was imported, left alone and left out, in lines."""
    lines = [
        f"{case.source.name}: {len(streets.edges):,} edges, {streets.drivable.sum():,} for cars, "
        f"{'left' if streets.left_hand else 'right'}-hand traffic; {len(streets.logics):,} signals; "
        f"{len(traffic.vehicles):,} vehicles in {clock.steps} intervals of "
        f"{clock.step:g} s; {_left_out(traffic)}{_notes(traffic)}",
        text_table(tables.quality, CAPTION),
        f"without control: {baseline.teleports} teleports; at the end {baseline.running} vehicles on the road and "
        f"{baseline.waiting} waiting to enter; {baseline.dropped:,} without a route or a free lane",
    ]
    if assigned is not None:
        gap, iteration, count = assigned.gaps[assigned.best], assigned.best + 1, len(assigned.gaps)
        lines.append(
            f"routes by duaIterate.py: relative gap {100 * gap:.1f} % in iteration {iteration} of {count}"
        )
        if gap > GAP:
            lines.append(
                f"WARNING: a relative gap above {100 * GAP:g} %: rerouting gains what drivers know already"
            )
    changed = list(case.left_out)
    if case.step_length != (step := float(model.options(case, clock)["step-length"])):
        changed.append(f"step-length = {case.step_length:g}, not {step:g}")
    if changed:
        lines.append(f"not taken over from {case.source.name}: {', '.join(changed)}")
    return lines
