"""`cosim import`: a SUMO city or OpenStreetMap becomes networks/NAME and scenarios/NAME."""

import gzip
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from cosim.importing import maps, model, quality
from cosim.importing.assignment import GAP, ITERATIONS, Assigned, assign, relative_gap
from cosim.importing.baseline import Baseline, averaged_runs
from cosim.importing.case import Box, Progress, SumoInput, sumo_input
from cosim.importing.demand import Traffic, read_traffic, wrapped
from cosim.importing.generated import morning_peak
from cosim.importing.partition import partition, read_regions
from cosim.importing.regions import finish
from cosim.importing.streets import Streets, read_streets
from cosim.sumo.arrays import EdgeNumbers
from cosim.sumo.net import City, load_city
from nmfd.arrays import PairsOverTime
from nmfd.errors import InputError
from nmfd.model import authority
from nmfd.model.planning import GUIDED
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.files import temporary_folder
from nmfd.studies import plots

LARGE_CITY_EDGES = 5000  # for cars: beyond, the run without control is mesoscopic, so that it takes a minute
LITTLE_CONTROL = 0.3  # share of the boundary flow without a signal that is worth a line
NET = "city.net.xml.gz"
FILES = {"routes": "vehicles.rou.xml.gz", "background": "background.rou.xml.gz", "additional": "city.add.xml.gz"}
TYPES = ("vType", "vTypeDistribution")


def import_city(
    source: Path | Box,
    out: Path,
    scenario: Path,
    *,
    regions: int | Path,
    left_hand: bool = False,
    routes: Sequence[Path] = (),
    peak: bool = False,
    level: float = 1.0,
    mesoscopic: bool = False,
    begin: float | None = None,
    end: float | None = None,
    seed: int = 0,
    seeds: int = 3,
    iterations: int = ITERATIONS,
    force: bool = False,
    progress: Progress = lambda stage, share=0.0: None,
) -> str:
    """Write the network and the scenario of a city; return a report.

    Args:
        source: a sumocfg, a net.xml, a file of OpenStreetMap, or a box of it.
        out, scenario: folders of the network and the scenario.
        regions: their number, or the user's own table edge,region.
        left_hand: side of OpenStreetMap's streets.
        routes: files with vehicles beside those of the sumocfg.
        peak: generate a morning peak instead.
        level: multiplies the vehicles or the peak [-].
        mesoscopic: the scenario uses SUMO's queue model.
        begin, end: [s], instead of the sumocfg's.
        seeds: runs without control whose densities are averaged.
        iterations: of the assignment of the peak.
        force: replace an existing network and scenario.

    Raises:
        InputError: for input that cannot be used; nothing is written then.
    """
    _check_free(out, scenario, force)
    progress("reading")
    with sumo_input(source, progress, left_hand=left_hand) as case:
        case = _window(replace(case, routes=(*case.routes, *routes)), begin, end)
        streets = read_streets(case.net, case.additional)
        own = None if isinstance(regions, int) else read_regions(streets, regions)
        traffic = read_traffic(case, streets, seed)
        mesoscopic = mesoscopic or case.mesoscopic
        meso = mesoscopic or streets.drivable.sum() > LARGE_CITY_EDGES
        factor, assigned = case.scale * level, None
        if peak:
            traffic, assigned = _peak(case, streets, traffic, level, seed, iterations, meso, progress)
            factor = 1.0
        elif not len(traffic.depart):
            raise InputError(
                f"{case.source}: names no vehicles for the streets of cars{_notes(traffic)}; give a sumocfg with "
                "route-files, or add --routes FILE or --demand peak"
            )
        elif begin is None:
            case = model.without_idle(case, traffic)
        clock, gaps = model.clock(case, streets, traffic), []

        def inspect(edges: Path) -> None:
            if assigned is not None:
                gaps.append(relative_gap(streets.path, _routed(traffic), edges, begin=clock.begin, seed=seed))

        with _folders(out, scenario) as (net_folder, folder):
            files = _write_traffic(folder, traffic)
            paths = {key: [folder / name for name in names] for key, names in files.items()}
            baseline = averaged_runs(
                streets,
                routes=paths["routes"],
                background=paths["background"],
                additional=paths["additional"],
                factor=factor,
                mesoscopic=meso,
                seeds=seeds,
                begin=clock.begin,
                end=clock.end,
                step_length=model.step_length(case, clock),
                time_to_teleport=case.time_to_teleport,
                progress=progress,
                inspect=inspect,
            )
            progress("partition")
            left = quality.left_alone(streets, traffic.switched)
            if own is None:
                labels = partition(streets, baseline, regions, uncontrollable=left)
            else:
                labels = finish(streets, own, renumber=False)
            if labels.max() < 1:
                raise InputError(
                    f"{streets.path}: no two regions can be made that can be reached from each other; give a network "
                    "with more streets, or other regions"
                )
            network = model.network_of(streets, labels, out.name, baseline)
            content = case.net.read_bytes()
            _zip(net_folder / NET, gzip.decompress(content) if case.net.suffix == ".gz" else content)
            pd.DataFrame({"edge": streets.edges, "region": labels}).to_csv(net_folder / "regions.csv", index=False)
            city = load_city(net_folder / NET, net_folder / "regions.csv", network.regions)
            tables = quality.tables(streets, labels, network.region_names, city, baseline, left)
            verdict = quality.import_verdict(network, tables.gateways, labels, baseline)
            network = replace(network, controllable=verdict.boundaries.shares)
            progress("writing")
            _write_network(net_folder, streets, labels, network, tables, case)
            (net_folder / authority.FILE).write_text(verdict.text(), encoding="utf-8")
            _write_demand(folder / "demand.csv", model.region_demand(traffic, labels, clock))
            text = model.scenario_text(
                network,
                clock,
                case,
                name=scenario.name,
                files=files,
                leave=traffic.switched,
                network_path=os.path.relpath(out, scenario).replace(os.sep, "/"),
                protected=_densest(streets, labels, baseline),
                factor=factor,
                mesoscopic=mesoscopic,
            )
            (folder / "scenario.toml").write_text(text, encoding="utf-8")
            report = _report(case, streets, traffic, clock, network, city, tables, left, baseline)
            report += _assignment_lines(assigned, gaps)
            if isinstance(regions, int) and network.regions < regions:
                report.append(
                    f"fewer regions than the requested {regions}: the others could not be reached or fell apart"
                )
            elif own is not None and (moved := _moved(own, labels, streets.drivable & (own >= 0))):
                report.append(f"{moved:,} streets are in other regions than in {regions}, which must be connected")
            if meso != mesoscopic:
                report.append(f"simulated by SUMO's mesoscopic model: more than {LARGE_CITY_EDGES:,} edges for cars")
            report += verdict.sentences
            (net_folder / "import.txt").write_text("\n".join(report) + "\n", encoding="utf-8")
    return "\n".join(report)


def _check_free(out: Path, scenario: Path, force: bool) -> None:
    for folder, file, option in ((out, "network.toml", "--out"), (scenario, "scenario.toml", "--out")):
        if folder.name in ("", "..") or "," in str(folder):
            raise InputError(
                f"{option}: expected a folder such as networks/mycity, without a comma, got {folder} instead"
            )
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{option}: {folder}: is not a folder; choose another name")
        if (folder / file).exists() and not force:
            raise InputError(f"{option}: {folder / file} exists; choose another folder, or --force to replace it")


def _window(case: SumoInput, begin: float | None, end: float | None) -> SumoInput:
    """Apply --begin and --end to a case. Raises InputError."""
    first, last = case.begin if begin is None else begin, case.end if end is None else end
    if first < 0:
        where = f"{case.source}: begin" if begin is None else "--begin"
        raise InputError(f"{where}: expected a time from 0 s up, got {first:g} instead")
    if last is not None and last <= first:
        where = f"{case.source}: end" if end is None else "--end"
        raise InputError(f"{where}: expected a time after the beginning at {first:g} s, got {last:g} instead")
    return replace(case, begin=first, end=last)


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
    """Generate a morning peak beside the city's other traffic, and assign its routes. Only cars drive in that."""
    if len(beside.depart):
        raise InputError(
            f"--demand: {case.source} has {len(beside.depart):,} vehicles of its own; omit --demand, or give the "
            "network alone"
        )
    peak = morning_peak(streets, level=level, begin=case.begin, seed=seed)
    known = {part.get("id") for element in beside.shared for part in element.iter("vType")}
    types = tuple(e for e in peak.shared if e.get("id") not in known)  # the city may define a type car
    notes = {**beside.notes, **peak.notes}
    traffic = replace(beside, vehicles=peak.vehicles, depart=peak.depart, origin=peak.origin, notes=notes)
    traffic = replace(traffic, destination=peak.destination, shared=beside.shared + types)
    clock = model.clock(case, streets, traffic)
    others = [element for element in traffic.shared if element.tag not in TYPES]
    with temporary_folder() as folder:
        additional = [folder / "city.add.xml"] if others else []
        for path in additional:
            ElementTree.ElementTree(wrapped(others, "additional")).write(path)
        assigned = assign(
            streets.path.absolute(),
            _routed(traffic),
            begin=clock.begin,
            end=clock.end,
            seed=seed,
            iterations=iterations,
            additional=additional,
            mesoscopic=mesoscopic,
            time_to_teleport=case.time_to_teleport,
            progress=progress,
        )
    for vehicle in traffic.vehicles:
        if (route := vehicle.find("route")) is not None and (name := vehicle.get("id", "")) in assigned.routes:
            route.set("edges", " ".join(assigned.routes[name]))
    return traffic, assigned


def _routed(traffic: Traffic) -> list[ElementTree.Element]:
    """Return the vehicles of a generated demand after the types that they need."""
    return [*(element for element in traffic.shared if element.tag in TYPES), *traffic.vehicles]


@contextmanager
def _folders(out: Path, scenario: Path) -> Iterator[tuple[Path, Path]]:
    """Provide temporary folders for network and scenario, which take their places together at the end."""
    with ExitStack() as stack:
        pairs = []
        for folder in (out, scenario):
            folder.parent.mkdir(parents=True, exist_ok=True)
            pairs.append((stack.enter_context(temporary_folder(f".{folder.name}-", where=folder.parent)), folder))
        yield pairs[0][0], pairs[1][0]
        for temporary, folder in pairs:
            folder.mkdir(exist_ok=True)
            # A folder without its toml file counts as empty: that file goes first and comes last.
            for old in folder.glob("*.toml"):
                if (temporary / old.name).exists():
                    old.unlink()
            if folder == out:  # the model of guided drivers in other regions
                (folder / GUIDED / "network.toml").unlink(missing_ok=True)
            for file in sorted(temporary.iterdir(), key=lambda file: (file.suffix == ".toml", file.name)):
                os.replace(file, folder / file.name)


def _write_traffic(folder: Path, traffic: Traffic) -> dict[str, list[str]]:
    """Write vehicles, background and what they refer to; return the file names by key of [sumo]."""
    contents = {
        "routes": (traffic.vehicles, "routes"),
        "background": (traffic.background, "routes"),
        "additional": (traffic.shared, "additional"),
    }
    for key, (elements, tag) in contents.items():
        if len(elements):
            root = wrapped(elements, tag)
            ElementTree.indent(root)
            _zip(folder / FILES[key], ElementTree.tostring(root))
    return {key: [FILES[key]] if len(elements) else [] for key, (elements, _) in contents.items()}


def _write_network(
    folder: Path,
    streets: Streets,
    regions: EdgeNumbers,
    network: RegionalModel,
    tables: quality.Tables,
    case: SumoInput,
) -> None:
    """Write network.toml, its tables and its map."""
    text = model.network_text(network, {"net": NET, "regions": "regions.csv"}, case.source.name)
    (folder / "network.toml").write_text(text, encoding="utf-8")
    pd.DataFrame(tables.quality).to_csv(folder / "quality.csv", index=False)
    pd.DataFrame(tables.gateways).to_csv(folder / "gateways.csv", index=False)
    if case.notice:
        (folder / "NOTICE.txt").write_text(case.notice)
    width, height = np.ptp(streets.centre, axis=0) + 1.0
    drawing = plots.figure(6.2, float(np.clip(6.2 * height / width, 3.0, 8.0)) + 0.8)
    ax = drawing.subplots()
    maps.region_map(ax, streets, regions, network.region_names, network.positions)
    maps.gateway_marks(ax, streets, tables)
    drawing.savefig(folder / "map.png", dpi=130, metadata={"Software": None})


def _write_demand(path: Path, demand: PairsOverTime) -> None:
    rows = [(k, i, j, f"{demand[k, i, j]:.6g}") for k, i, j in np.argwhere(demand > 0)]
    pd.DataFrame(rows, columns=["interval", "from", "to", "veh_s"]).to_csv(path, index=False)


def _zip(path: Path, content: bytes) -> None:
    """Write a gzip file without a date: the same content gives the same bytes."""
    with path.open("wb") as stream, gzip.GzipFile(fileobj=stream, mode="wb", filename="", mtime=0) as packed:
        packed.write(content)


def _densest(streets: Streets, regions: np.ndarray, baseline: Baseline) -> int:
    load = np.bincount(regions, baseline.density(streets) * streets.lane_metres)
    return int(np.argmax(load / np.bincount(regions, streets.lane_metres)))


def _moved(labels: np.ndarray, regions: np.ndarray, members: np.ndarray) -> int:
    """Count the edges that are not in the region of most edges with the same label."""
    votes = np.zeros((int(labels.max()) + 1, int(regions.max()) + 1), dtype=int)
    np.add.at(votes, (labels[members], regions[members]), 1)
    return int(votes.sum() - votes.max(axis=1).sum())


def _notes(traffic: Traffic) -> str:
    return "".join(f"; {note}: {count:,}" for note, count in sorted(traffic.notes.items()))


def _report(
    case: SumoInput,
    streets: Streets,
    traffic: Traffic,
    clock: model.Clock,
    network: RegionalModel,
    city: City,
    tables: quality.Tables,
    left: Mapping[str, str],
    baseline: Baseline,
) -> list[str]:
    """Return what was imported, left alone and left out, in lines."""
    usable, detached = streets.drivable.sum(), (streets.drivable & ~streets.main_part).sum()
    at_gateways = {g["signal"] for g in tables.gateways if g["signal"]}
    skipped = sorted(signal for signal in left if signal in at_gateways)
    left_out = list(case.left_out)
    if case.step_length != model.step_length(case, clock):
        left_out.append(f"step-length = {case.step_length:g}")
    lines = [
        f"{case.source.name}: {len(streets.edges):,} edges, {usable:,} for cars"
        + (f" ({detached:,} of them cut off from the rest)" if detached else "")
        + (", left-hand traffic" if streets.left_hand else "")
        + f"; {len(set(city.signals.values())):,} signals; {len(traffic.vehicles):,} vehicles in {clock.steps} "
        f"intervals of {clock.step:g} s{_notes(traffic)}",
        f"{network.regions} regions",
        quality.quality_table(tables),
        f"without control: driving takes {baseline.pace(streets):.1f} times as long as at the speed limits; "
        f"{baseline.teleports} teleports, {baseline.running} vehicles on the road and {baseline.waiting} waiting to "
        "enter at the end",
    ]
    if skipped:
        lines.append(
            f"left alone at boundaries: {len(skipped)} of {len(at_gateways)} signals, such as {skipped[0]} "
            f"({left[skipped[0]]}); see gateways.csv"
        )
    if tables.uncontrolled > LITTLE_CONTROL:
        lines.append(f"perimeter control reaches only {100 * (1 - tables.uncontrolled):.0f} % of the boundary flow")
    if baseline.dropped:
        lines.append(f"{baseline.dropped:,} vehicles never drove: SUMO found no route or no free lane for them")
    if case.scale != 1.0:
        lines.append(f"vehicles times {case.scale:g}, the scale in {case.source.name}")
    if left_out:
        lines.append(f"not taken over from {case.source.name}: {', '.join(left_out)}")
    return lines


def _assignment_lines(assigned: Assigned | None, gaps: Sequence[float]) -> list[str]:
    """Return how far a generated demand is from an equilibrium. gaps: in the run without control."""
    if assigned is None:
        return []
    line = f"routes by duaIterate.py: relative gap {100 * assigned.iterations[0].gap:.1f} % at free flow, "
    line += f"{100 * assigned.gap:.1f} % in iteration {assigned.best + 1} of {len(assigned.iterations)}"
    line += "".join(f", {100 * gap:.1f} % in the run without control" for gap in gaps)
    if assigned.gap <= GAP:
        return [line]
    return [line, f"WARNING: the relative gap is above {100 * GAP:g} %: rerouting here gains what drivers know already"]
