"""The report: one HTML file with everything in it, from the finished runs of one or several folders."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from cosim.evaluation import explain, statistics
from cosim.evaluation.results import Finished, Level
from cosim.report import pictures as report
from cosim.report import summary_text
from cosim.report.markup import cell, fold, items, page, picture, table, tag, text, typeset
from nmfd.runs import files
from nmfd.runs.scratch import Scratch
from nmfd.studies.benchmark import REFERENCE

WORDS = (
    "Total time spent (TTS) adds up the time of all vehicles on the road and of those that wait to enter: less is "
    "better. A vehicle hour is one vehicle for one hour, 3600 veh s. Regions are the districts by which controllers "
    "steer; gateways are the places where a street crosses from one region into another. A change whose 95 % interval "
    "excludes zero is marked *: it is more than the chance of the seeds.")
PICTURES = (  # heading, its pictures with captions
    ("Vehicles and regions", (
        ("total_accumulation", "Vehicles in the network with those waiting to enter [veh] over time."),
        ("region_accumulation", "Vehicles in each region [veh] over time. Green: within 10 % of the largest outflow; "
         "red: congested."),
        ("mfd", "Macroscopic fundamental diagram of each region: vehicles inside [veh] against vehicles that leave or "
         "arrive [veh/s]. Dots: one per control interval; line: the regional model."))),
    ("Streets", (
        ("link_densities", "Density of every street [vehicles per km and lane] at four times, mean of the control "
         "interval; 133 is a standing queue. The two directions of a street are drawn apart."),)),
    ("Signals and routes", (
        ("perimeter", "Perimeter control: the commanded share u [-] of each boundary (from > to) that was closed most, "
         "the green that its signals showed and the flow, both as shares of those of the original programme."),
        ("splits", "Route guidance: the commanded shares θ [-] by which the vehicles of a region should leave by each "
         "neighbour, and the shares that did."))),
    ("Queues before gateways", (
        ("gateway_queues", "Vehicles halting on the edges before region boundaries [veh] over time, and how long these "
         "edges were full [min]: held vehicles block other traffic there."),)),
    ("Decision times", (
        ("decision_times", "Wall time of one decision [ms], median and longest over all runs, against the control "
         "interval in which it has to be taken."),)))
REGIONS = (
    "Streets in the colour of their region. Dots: gateways; black ones have a signal that perimeter control can use.")
DEMAND = "Total time spent as a share of that without control, over the demand, with 95 % intervals."


def write(
    path: Path, found: Sequence[Finished], reference: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """The page of the runs, atomically. reference: a strategy to pair with, besides no control."""
    total, done, parts = sum(len(run.levels) for run in found), 0, []
    for number, run in enumerate(found):
        body = []
        for level in run.levels:
            body.append(_level(run, level, reference))
            done += 1
            if progress:
                progress(done, total)
        parts.append(_run(run, f"run-{number}", body))
    contents = tag("nav", tag("ul", *(
        tag("li", text("a", run.name, href=f"#run-{number}")) for number, run in enumerate(found))))
    names = ", ".join(dict.fromkeys(run.scenario.name for run in found))
    header = text("h1", f"Traffic control in SUMO: {names}") + text("p", WORDS, class_="note")
    version = found[-1].levels[-1].manifest["sessions"][-1].get("versions", {}).get("perimeter-cosim", "")
    files.write_text(path, page(
        f"{names}: report", header + (contents if len(found) > 1 else ""), "\n".join(parts),
        text("p", f"Made by cosim report from {', '.join(map(str, (run.path for run in found)))}; perimeter-cosim "
             f"{version}. The page holds everything it shows.")))
    return path


def _run(run: Finished, anchor: str, levels: Sequence[str]) -> str:
    configuration, rows = run.levels[0].manifest["configuration"], run.rows
    first = summary_text.opening(
        run.scenario.name, configuration["steps"], configuration["step_s"], len(run.levels), rows)
    lead = [text("p", typeset(sentence)) for sentence in (
        first, *(_at(run, level) + summary_text.head(level.rows) for level in run.levels))]
    with Scratch("cosim-") as folder:
        if run.city is not None:
            report.region_map(folder / "regions.png", run.scenario, run.city)
        if len(run.levels) > 1:
            report.demand_levels(folder / "demand.png", rows)
        shown = [picture(folder / f"{name}.png", caption) for name, caption in (
            ("demand", DEMAND), ("regions", REGIONS)) if (folder / f"{name}.png").is_file()]
    return tag(
        "section", text("h2", run.name), tag("div", *lead, class_="story"), *shown, *levels, _configuration(run),
        id=anchor)


def _at(run: Finished, level: Level) -> str:
    return f"At demand times {level.demand:g}: " if len(run.levels) > 1 else ""


def _level(run: Finished, level: Level, reference: str | None) -> str:
    rows, names = level.rows, set(level.rows["controller"])
    if reference not in names:
        reference = None
    first, second = statistics.shown(statistics.statistics(rows, reference), reference)
    title = f"Demand times {level.demand:g}"
    parts = [
        text("h3", title), items(summary_text.details(rows)), *_why(run, level),
        _frame(f"What came of it, {title.lower()}", first),
        _frame(f"How, {title.lower()}", second), text("p", " ".join(statistics.CAPTION.split()), class_="caption"),
        fold("Every strategy against every other, paired by seed", _numbers(
            "pairs", statistics.pairs(rows).drop(columns="demand"))),
        fold("Every run", _numbers("runs", rows))]
    with Scratch("cosim-") as folder:
        report.draw(level.folder, run.scenario, run.city, rows, folder)
        report.draw_more(folder, run.scenario, level.folder, rows)
        missing = []
        for heading, pictures in PICTURES:
            there = [(name, caption) for name, caption in pictures if (folder / f"{name}.png").is_file()]
            missing += [] if there else [heading.lower()]
            if there:
                parts += [text("h4", heading), *(
                    picture(folder / f"{name}.png", f"{title}. {caption}") for name, caption in there)]
    if missing:
        why = run.changed or "there was nothing of the kind in these runs, or an older version did not record it"
        parts.append(text("p", f"Without pictures of {', '.join(missing)}: {why}.", class_="note"))
    pair = [name for name in report.ranked(rows) if name != REFERENCE][:1]
    both = f" and, where two are compared, {REFERENCE} and {pair[0]}" if len(pair) and REFERENCE in names else ""
    parts.insert(2, text("p", f"Pictures of single runs show seed {report.shown_seed(rows)}{both}.", class_="note"))
    return tag("div", *parts)


def _why(run: Finished, level: Level) -> list[str]:
    """Why strategies gain or not, where there is one to tell of."""
    city, lines = explain.at(level.demand, level.folder, run.scenario.network, level.rows)
    return [text("h4", "Why"), text("p", typeset(city)), items(lines)] if lines else []


def _frame(label: str, frame: pd.DataFrame) -> str:
    return table(label, list(frame.columns), frame.values.tolist())


def _numbers(label: str, frame: pd.DataFrame) -> str:
    """All columns of a csv file, the controller first."""
    frame = frame[["controller", *(name for name in frame.columns if name != "controller")]]
    return table(label, list(frame.columns), frame.to_dict("split")["data"])


def _configuration(run: Finished) -> str:
    """What the runs depend on, and when and with what they were made."""
    latest = run.levels[-1].manifest
    settings = {**latest["configuration"], "demand_factor": ", ".join(f"{level.demand:g}" for level in run.levels),
                "seeds": summary_text.seeds(run.rows["seed"])}
    controllers = {
        name: depends for level in run.levels for name, depends in level.manifest.get("controllers", {}).items()}
    sessions = [session for level in run.levels for session in level.manifest["sessions"]]
    versions = {package: version for session in sessions for package, version in session.get("versions", {}).items()}
    kept = {json.dumps([session.get("commit"), session.get("dirty")]): session for session in sessions}
    commits = [f"{session.get('commit') or 'unknown'}{' with changes' if session.get('dirty') else ''}"
               for session in kept.values()]
    dates = sorted(str(session.get("date", "")) for session in sessions)
    rows = [
        *((key, _plain(value)) for key, value in settings.items()),
        ("made", dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}, {len(dates)} sessions"),
        ("commit", ", ".join(commits)),
        ("versions", ", ".join(f"{package} {version}" for package, version in versions.items()))]
    return tag(
        "div", text("h3", "Configuration"), table("configuration", ("key", "value"), rows, words=True),
        fold("What each strategy depends on", table(
            "strategies", ("strategy", "depends on"),
            [(name, _plain(depends) or "nothing of its own") for name, depends in controllers.items()], words=True)))


def _plain(value: object) -> str:
    """Settings as words."""
    if isinstance(value, Mapping):
        return "; ".join(f"{key}: {_plain(part) or 'default'}" for key, part in value.items() if part is not None)
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    return cell(value)
