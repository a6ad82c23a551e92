"""`cosim import`: from a sumocfg to networks/NAME and scenarios/NAME."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.importing import level, model, osm, quality, verdict, written
from cosim.importing.assignment import Assigned, Effort, relative_gap
from cosim.importing.baseline import Baseline, Tell
from cosim.importing.case import SumoInput, seconds
from cosim.importing.demand import Traffic, read_traffic
from cosim.importing.given import read_given
from cosim.importing.partition import Clustered, Drawn, alternatives, partition
from cosim.importing.regions import positions
from cosim.importing.streets import Streets, read_streets
from cosim.importing.trials import Peaks, Trials, routed
from cosim.sumo.net import City, load_city
from nmfd.errors import InputError
from nmfd.model.planning import GUIDED
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.files import temporary_folder

LARGE = 5000  # edges for cars: beyond, the run before the partition is mesoscopic, so that an import takes a minute
STANDING = 2.0  # times as long as at the speed limits: the vehicles on a few streets queue there
LITTLE = 0.3  # of the flow over the boundaries passes no signal under control: worth a word


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """What the user asked for.

    source: a sumocfg, a net, a file of OpenStreetMap, or a box of it (cosim.importing.osm)
    left_hand: where it drives, which OpenStreetMap does not say of single streets
    cut: how to come by regions
    run: simulate the city without control first
    peak: generate a morning peak, instead of route files
    level: times the vehicles, or the usual peak; None for the lowest that congests (cosim.importing.level)
    mesoscopic: the scenario uses SUMO's queue model
    begin, end [s]: instead of the sumocfg's
    od: matrices between the TAZ of the sumocfg or of `zones`
    effort: of the assignment of a peak; without a run everybody stays on their way at free flow
    seeds: runs without control whose densities are averaged
    """

    source: Path | osm.Box
    left_hand: bool = False
    out: Path
    scenario: Path
    cut: Clustered | Drawn
    seed: int = 0
    run: bool = True
    peak: bool = False
    level: float | None = 1.0
    mesoscopic: bool = False
    force: bool = False
    begin: float | None = None
    end: float | None = None
    routes: tuple[Path, ...] = ()
    od: tuple[Path, ...] = ()
    zones: tuple[Path, ...] = ()
    effort: Effort = Effort()
    seeds: int = 3


def import_city(order: ImportOptions, tell: Tell = lambda stage, share=0.0: None) -> str:
    """Write the network and the scenario; returns what was found, for the terminal. Raises InputError, before anything
    is written. tell: called with what is going on, and the share of it [-] that is done."""
    _check_free(order)
    tell("reading")
    with osm.sumo_input(order.source, tell, left_hand=order.left_hand) as case:
        return _import(_windowed(case, order), order, tell)


def _import(case: SumoInput, order: ImportOptions, tell: Tell) -> str:
    case = replace(case, routes=(*case.routes, *order.routes))
    streets = read_streets(case.net, case.additional)
    if isinstance(order.cut, Drawn):  # mistakes in it are told now, not after the simulations
        read_given(streets, order.cut.file, order.cut.method)
    order = replace(order, mesoscopic=order.mesoscopic or case.mesoscopic)
    scale = 1.0 if order.peak else case.scale
    traffic = _traffic(case, streets, order)
    if order.begin is None and not order.peak:
        case = model.without_idle(case, traffic)
    mesoscopic = order.mesoscopic or streets.drivable.sum() > LARGE
    effort = order.effort if order.run else replace(order.effort, iterations=0)
    peaks = Peaks(streets, case, traffic, seed=order.seed, effort=effort, mesoscopic=mesoscopic, tell=tell)
    times, congests = order.level or 1.0, True
    if order.level is None:
        times, congests = level.congesting(
            _probe(order, case, streets, traffic, peaks, scale, tell), mesoscopic=mesoscopic, tell=tell
        )
    factor, assigned = scale * times, None
    if order.peak:
        factor, (traffic, assigned) = 1.0, peaks.at(times)
    clock = model.clock(case, streets, traffic)
    with _folders(order) as (net_folder, folder):
        files = written.write_traffic(folder, traffic)
        if assigned is not None:
            written.write_assignment(folder / "assignment.csv", assigned)
        baseline, gaps = None, []
        if order.run:

            def judge(edges: Path) -> None:
                if assigned is not None:
                    gaps.append(relative_gap(streets.path, routed(traffic), edges, begin=clock.begin, seed=order.seed))

            baseline = Trials(streets, case, clock, folder, files).averaged(
                factor, mesoscopic, order.seeds, tell, judge
            )
        left = left_alone(streets, traffic)
        tell("partition")
        regions, asked, moved = partition(streets, baseline, order.cut, seed=order.seed, left_alone=left)
        name = order.out.name
        network = model.network_of(streets, regions, name, baseline)
        written.write_net(case.net, net_folder / written.NET)
        written.write_table(net_folder / "regions.csv", ("edge", "region"), zip(streets.edges, regions, strict=True))
        city = load_city(net_folder / written.NET, net_folder / "regions.csv", network.regions)
        tell("other numbers of regions")
        others = (
            {}
            if baseline is None
            else alternatives(streets, baseline, order.cut, regions, seed=order.seed, left_alone=left)
        )
        found = quality.tables(streets, regions, network.region_names, city, baseline, left, others)
        judged = verdict.of_import(network, found.gateways, regions, baseline)
        network = replace(network, controllable=judged.boundaries.shares)
        verdict.write_verdict(net_folder, judged)
        if case.notice:
            (net_folder / "NOTICE.txt").write_text(case.notice)
        tell("writing")
        written.write_network(net_folder, streets, regions, network, found, baseline, case.source.name)
        demand = model.region_demand(traffic, regions, clock)
        written.write_demand(folder / "demand.csv", demand)
        (folder / "scenario.toml").write_text(
            model.scenario_text(
                network,
                clock,
                case,
                name=order.scenario.name,
                files=files,
                leave=traffic.switched,
                network_path=os.path.relpath(order.out, order.scenario).replace(os.sep, "/"),
                protected=_protected(streets, regions, baseline, network),
                factor=factor,
                mesoscopic=order.mesoscopic,
            ),
            encoding="utf-8",
        )
        report = _report(order, case, streets, traffic, clock, network, asked, city, found, left, baseline)
        report += _demand_lines(order, streets, assigned, baseline, gaps)
        report += "".join(f"\n{sentence}" for sentence in judged.sentences)
        report += _level_line(order, times if order.peak else factor, congests)
        if moved and isinstance(order.cut, Drawn):
            report += (
                f"\n{moved:,} streets are in other regions than {order.cut.file.name} says: theirs was in "
                "several pieces, or could not be reached from the rest"
            )
        if scale != 1.0:
            report += f"\nvehicles times {scale:g}, the scale in {case.source.name}"
        left_out = [
            *case.left_out,
            *([] if case.step_length == model.step_length(case, clock) else [f"step-length = {case.step_length:g}"]),
        ]
        if left_out:
            report += f"\nnot taken over from {case.source.name}: {', '.join(left_out)}"
        if mesoscopic and order.run:
            report += "\nsimulated by SUMO's mesoscopic model" + (
                "" if order.mesoscopic else f": the city has more than {LARGE:,} edges for cars"
            )
        (net_folder / "import.txt").write_text(report + "\n", encoding="utf-8")
    return report


def _traffic(case: SumoInput, streets: Streets, order: ImportOptions) -> Traffic:
    """The city's own vehicles, or what its files hold beside a demand that is to be generated."""
    zones = order.zones
    if order.od and not zones and isinstance(order.cut, Drawn) and order.cut.method == "taz":
        zones = (order.cut.file,)
    traffic = read_traffic(case, streets, order.seed, order.od, zones)
    if not order.peak:
        if not len(traffic.depart):
            raise InputError(
                f"{case.source}: names no vehicles for the streets of cars{_notes(traffic)}; give a sumocfg with "
                "route-files, or add --routes FILE, --od FILE or --demand peak"
            )
        return traffic
    if len(traffic.depart):
        raise InputError(
            f"--demand: {case.source} has {len(traffic.depart):,} vehicles of its own; omit --demand, or give "
            "the network alone"
        )
    return traffic


def left_alone(streets: Streets, traffic: Traffic) -> dict[str, str]:
    """Signal -> why perimeter control leaves it alone: it holds back at programmes of HELD kinds that always run."""
    return quality.left_alone(streets) | {signal: "programme follows a timetable" for signal in traffic.switched}


def _check_free(order: ImportOptions) -> None:
    for folder, file, option in ((order.out, "network.toml", "--out"), (order.scenario, "scenario.toml", "--scenario")):
        if folder.name in ("", "..") or "," in str(folder):
            raise InputError(
                f"{option}: expected a folder such as {option[2:]}/mycity, without a comma, which SUMO "
                f"cannot read, got {folder} instead"
            )
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{option}: {folder}: is not a folder; choose another name")
        if (folder / file).exists() and not order.force:
            raise InputError(f"{option}: {folder / file} exists; choose another folder, or --force to replace it")


def _windowed(case: SumoInput, order: ImportOptions) -> SumoInput:
    """The case from --begin to --end, where these are given."""
    begin = case.begin if order.begin is None else order.begin
    end = case.end if order.end is None else order.end
    if begin < 0:
        where = f"{case.source}: begin" if order.begin is None else "--begin"
        raise InputError(f"{where}: expected a time from 0 s up, got {begin:g} instead")
    if end is not None and end <= begin:
        where = f"{case.source}: end" if order.end is None else "--end"
        raise InputError(f"{where}: expected a time after the beginning at {begin:g} s, got {end:g} instead")
    return replace(case, begin=begin, end=end)


@contextmanager
def _folders(order: ImportOptions) -> Iterator[tuple[Path, Path]]:
    """Temporary folders for network and scenario, which take their places together at the end."""
    with ExitStack() as stack:
        made: list[tuple[Path, Path]] = []
        for folder in (order.out, order.scenario):
            folder.parent.mkdir(parents=True, exist_ok=True)
            made.append((stack.enter_context(temporary_folder(f".{folder.name}-", where=folder.parent)), folder))
        yield made[0][0], made[1][0]
        for temporary, folder in made:
            folder.mkdir(exist_ok=True)
            # Without its toml file a folder counts as nothing: it goes first and comes last.
            for old in folder.glob("*.toml"):
                if (temporary / old.name).exists():
                    old.unlink()
            if folder == order.out:  # the model of guided drivers in other regions
                (folder / GUIDED / "network.toml").unlink(missing_ok=True)
            for file in sorted(temporary.iterdir(), key=lambda file: (file.suffix == ".toml", file.name)):
                os.replace(file, folder / file.name)


def _probe(
    order: ImportOptions, case: SumoInput, streets: Streets, traffic: Traffic, peaks: Peaks, scale: float, tell: Tell
) -> level.Probe:
    """Runs of other levels, seen by provisional regions: the user's own, or as many of similar size."""
    if isinstance(order.cut, Drawn):
        regions = partition(streets, None, order.cut, seed=order.seed)[0]
    else:
        regions = partition(streets, None, replace(order.cut, method="geometric"), seed=order.seed)[0]

    def probe(times: float, mesoscopic: bool) -> level.Loaded:
        vehicles, factor = (peaks.at(times)[0], 1.0) if order.peak else (traffic, scale * times)
        with temporary_folder() as folder:
            files = written.write_traffic(folder, vehicles)
            trials = Trials(streets, case, model.clock(case, streets, vehicles), folder, files)
            run = trials.run(
                factor, mesoscopic, reached=lambda share: tell(f"simulating demand times {times:g}", share)
            )
            return level.loaded(run, streets, regions)

    return probe


def _demand_lines(
    order: ImportOptions, streets: Streets, assigned: Assigned | None, baseline: Baseline | None, gaps: Sequence[float]
) -> str:
    """How far a generated demand is from an equilibrium, and whether a few streets hold it, for the report. gaps: of
    the run without control, in which SUMO's model may be another one than in the assignment."""
    text = ""
    if assigned is not None:
        last = assigned.iterations[assigned.best]
        text = (
            f"\nroutes by duaIterate.py: relative gap {100 * assigned.iterations[0].gap:.1f} % at free flow, "
            f"{100 * assigned.gap:.1f} % in iteration {assigned.best + 1} of {len(assigned.iterations)}, "
            f"{'mesoscopic' if last.mesoscopic else 'car-following'} (assignment.csv)"
            + "".join(f", {100 * gap:.1f} % in the run without control" for gap in gaps)
        )
        if not assigned.reached:
            text += (
                f"\nWARNING: the relative gap of {100 * assigned.effort.gap:g} % was not reached: some of what "
                "rerouting gains here it would gain from drivers who know the city, too; more --iterations, or a "
                "lower --level"
            )
    elif order.peak:
        text = (
            "\nWARNING: everybody takes a way that is fastest at free flow: no routes were assigned; omit "
            "--no-run and --iterations 0 for a demand on which controllers can be compared"
        )
    if baseline is not None:
        half, of = baseline.concentration(streets.drivable)
        text += (
            f"\nhalf of all vehicles are on {half:,} of {of:,} edges ({100 * half / max(of, 1):.1f} %) in the "
            "busiest quarter of an hour"
        )
        if half < level.FEW * of and baseline.pace_of_crowded(streets, streets.drivable) > STANDING:
            text += (
                "\nWARNING: these are queues on a few streets rather than a congested network: what relieves them "
                "gains much, for drivers who know the city as well"
            )
    return text


def _level_line(order: ImportOptions, times: float, congests: bool) -> str:
    """What came of --level, for the report."""
    if order.level is not None:
        return ""
    if congests:
        return (
            f"\nlevel: demand times {times:g} is the lowest tried at which a region comes to its critical "
            "accumulation without control"
        )
    return f"\nlevel: not even demand times {times:g} brings a region to its critical accumulation without control"


def _protected(streets: Streets, regions: np.ndarray, baseline: Baseline | None, network: RegionalModel) -> int:
    """The densest region; without a run, the one nearest to the middle."""
    if baseline is not None:
        load = np.bincount(regions, baseline.density(streets) * streets.lane_metres, network.regions)
        return int(np.argmax(load / np.bincount(regions, streets.lane_metres, network.regions)))
    middle = np.average(streets.centre, axis=0, weights=streets.lane_metres)
    return int(((positions(streets, regions) - middle) ** 2).sum(axis=1).argmin())


def _notes(traffic: Traffic) -> str:
    return "".join(f"; {note}: {count:,}" for note, count in sorted(traffic.notes.items()))


def _report(
    order: ImportOptions,
    case: SumoInput,
    streets: Streets,
    traffic: Traffic,
    clock: model.Clock,
    network: RegionalModel,
    asked: int,
    city: City,
    found: quality.Tables,
    left: Mapping[str, str],
    baseline: Baseline | None,
) -> str:
    """What was found, what was left alone and what cannot be done, in a few lines."""
    usable, part = streets.drivable.sum(), streets.main_part.sum()
    signals = set(city.signals.values())
    lines = [
        f"{case.source.name}: {len(streets.edges):,} edges, {usable:,} for cars"
        + (f" ({usable - part:,} of them cut off from the rest)" if part < usable else "")
        + (", left-hand traffic" if streets.left_hand else "")
        + f"; {len(signals):,} signals that cars see; {len(traffic.vehicles):,} vehicles in {clock.steps} intervals of "
        f"{clock.step:g} s{_notes(traffic)}",
        f"{network.regions} regions by method {order.cut.method}, seed {order.seed}"
        + (
            f"; {asked} were asked for: the others fell apart, or could not be reached from the rest"
            if network.regions < asked
            else ""
        ),
        quality.text(found),
    ]
    at_gateways = {g["signal"] for g in found.gateways if g["signal"]}
    skipped = sorted(signal for signal in left if signal in at_gateways)
    if skipped:
        lines.append(
            f"left alone at boundaries: {len(skipped)} of {len(at_gateways)} signals, such as {skipped[0]} "
            f"({left[skipped[0]]}); see gateways.csv"
        )
    if several := sum(len(logics) > 1 for logics in streets.logics.values()):
        lines.append(f"{several} signals have several programmes: the last that is loaded runs, as in SUMO")
    if found.uncontrolled > LITTLE:
        lines.append(
            f"perimeter control reaches only {100 * (1 - found.uncontrolled):.0f} % of the flow over the "
            "boundaries: other regions (--regions, --method, your own) may have more signals between them"
        )
    if baseline is not None:
        lines.append(
            f"without control: driving takes {baseline.pace(streets):.1f} times as long as at the speed limits; "
            f"{baseline.teleports} teleports, {baseline.running} vehicles on the road and {baseline.waiting} waiting "
            "to enter at the end"
        )
        if baseline.dropped:
            lines.append(
                f"{baseline.dropped:,} vehicles never drove: SUMO found no way, or no lane to depart on, for them"
            )
    return "\n".join(lines)


def parse_time(text: str | None, option: str) -> float | None:
    """A time of the command line, in seconds or as hours:minutes:seconds."""
    return None if text is None else seconds(text, option)
