"""Sentences of import.txt: what was imported, changed and left out."""

from cosim.importing import model
from cosim.importing.assignment import GAP, Assigned
from cosim.importing.baseline import Baseline
from cosim.importing.case import SumoInput
from cosim.importing.comparison import Comparison
from cosim.importing.demand import EARLY, FAST, FROM_FLOWS, NO_ROUTE, NOWHERE, ON_ROAD, Traffic
from cosim.importing.quality import Tables
from cosim.importing.streets import Streets
from nmfd.runs.tables import text_table

LEFT_OUT = 0.01  # share of vehicles or distance above which a warning follows
CHANGES = (FAST, NOWHERE, NO_ROUTE, ON_ROAD)  # notes that explain another traffic
UNSORTED = "should be sorted"  # in SUMO's words about vehicles that it drops
CAPTION = (
    "density: in the busiest quarter of an hour without control, per lane; variance: over the "
    "region's streets; uncontrolled: share of the boundary flow that passes no controllable signal"
)


def no_vehicles(case: SumoInput, traffic: Traffic) -> str:
    """Return the error of a case without private vehicles."""
    remarks = "".join(f"; {remark}" for remark in traffic.remarks)
    remedy = "give a sumocfg with route-files, or add --routes FILE, --counts FILE or --demand peak"
    if EARLY in traffic.notes:
        remedy = f"it begins at {case.begin:g} s; give another --begin"
    return (
        f"{case.source}: names no vehicles for the streets of cars{_notes(traffic)}{remarks}; "
        f"{remedy}"
    )


def summary(case: SumoInput, streets: Streets, traffic: Traffic, clock: model.Clock) -> str:
    """Return the size of the city and its traffic, and notes."""
    side = "left" if streets.left_hand else "right"
    return (
        f"{case.source.name}: {len(streets.edges):,} edges, {streets.drivable.sum():,} for cars, "
        f"{side}-hand traffic; {len(streets.logics):,} signals; "
        f"{len(traffic.vehicles):,} vehicles in {clock.steps} intervals of {clock.step:g} s; "
        f"{_left_out(traffic)}{_notes(traffic)}"
    )


def table(tables: Tables) -> str:
    """Return the table of regions."""
    return text_table(tables.quality, CAPTION)


def outcome(baseline: Baseline, clock: model.Clock) -> str:
    """Return how the run without control ended, for private trips."""
    line = (
        f"without control: {baseline.teleports} teleports; at the end {baseline.running} vehicles "
        f"on the road and {baseline.waiting} waiting to enter; {baseline.dropped:,} without a "
        "route or a free lane"
    )
    if baseline.removed:
        line += f"; {baseline.removed:,} removed on their way"
    if baseline.running + baseline.waiting:
        line += (
            f"; runs end at {clock.end:g} s, {model.RECOVERY_S / 60.0:g} minutes after the last "
            f"departure: for longer ones raise steps = {clock.steps} in scenario.toml"
        )
    return line


def comparison(
    same: Comparison | str, case: SumoInput, traffic: Traffic, clock: model.Clock
) -> str:
    """Return the comparison with plain SUMO, and known reasons."""
    if isinstance(same, str):
        return f"not compared with plain SUMO: {same}"
    reasons = [f"{name} is not taken over" for name in sorted(case.left_out)]
    step = model.step_length(case, clock)
    if step != case.step_length:
        reasons.append(f"steps of {step:g} s instead of {case.step_length:g} s")
    for note in CHANGES:
        if note in traffic.notes:
            reasons.append(f"{note}: {traffic.notes[note]:,}")
    if any(element.tag == "calibrator" for element in traffic.shared):
        reasons.append("calibrators")
    for kind in ("person", "container"):
        if any(element.tag.startswith(kind) for element in traffic.background):
            reasons.append(f"{kind}s")
    if FROM_FLOWS in traffic.notes:
        reasons.append("flows, whose vehicles look for another route while they wait to enter")
    return same.text(reasons)


def assignment(assigned: Assigned) -> list[str]:
    """Return how far the routes of a generated peak are from equilibrium."""
    gap = 100 * assigned.gaps[assigned.best]
    lines = [
        f"routes by duaIterate.py: relative gap {gap:.1f} % in iteration {assigned.best + 1} of "
        f"{len(assigned.gaps)}"
    ]
    if gap > 100 * GAP:
        lines.append(
            f"WARNING: a relative gap above {100 * GAP:g} %: rerouting gains what drivers know "
            "already"
        )
    return lines


def not_taken_over(case: SumoInput, clock: model.Clock) -> list[str]:
    """Return the options of the sumocfg that the scenario does not have."""
    lines = []
    changed = [f"{name} = {value}" for name, value in sorted(case.left_out.items())]
    step = model.step_length(case, clock)
    if step != case.step_length:
        changed.append(f"step-length = {case.step_length:g}, not {step:g}")
    if changed:
        lines.append(f"not taken over from {case.source.name}: {', '.join(changed)}")
    if case.ignored:
        lines.append(
            f"options of {case.source.name} that every run sets itself, or that only write files: "
            + ", ".join(case.ignored)
        )
    return lines


def warnings(case: SumoInput, traffic: Traffic) -> list[str]:
    """Return what a verdict must not be read without."""
    lines = []
    if max(traffic.left_out) > LEFT_OUT:
        lines.append(
            f"WARNING: {_left_out(traffic)}: this is not the traffic of {case.source.name}"
        )
    lines += [f"WARNING: {remark}" for remark in traffic.remarks if UNSORTED in remark]
    return lines


def _left_out(traffic: Traffic) -> str:
    vehicles, distance = traffic.left_out
    return f"{vehicles:.1%} of the vehicles and {distance:.1%} of the distance left out"


def _notes(traffic: Traffic) -> str:
    return "".join(f"; {note}: {count:,}" for note, count in sorted(traffic.notes.items()))
