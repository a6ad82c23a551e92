"""The report: one HTML file with everything in it, from the finished runs of one or several folders."""

import base64
import hashlib
import json
import math
import os
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from cosim.evaluation import explain, statistics
from cosim.evaluation.results import Finished, Level
from cosim.evaluation.simulate import FACTS
from cosim.report import card, pictures, replay, summary_text
from cosim.view.page import style
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.metrics import SUMMARY
from nmfd.model import authority
from nmfd.runs import files
from nmfd.runs.files import temporary_folder
from nmfd.studies import fit_quality

PIXELS = 150.0  # per inch, of the pictures (nmfd.studies.plots.save)
WORDS = (
    "Total time spent (TTS) adds up the time of all vehicles on the road and of those that wait to enter: less is "
    "better. A vehicle hour is one vehicle for one hour, 3600 veh s. Regions are the districts by which controllers "
    "steer; gateways are the places where a street crosses from one region into another. A change whose 95 % interval "
    "excludes zero is marked *: it is more than the chance of the seeds."
)
PICTURES = (  # heading, its pictures with captions
    (
        "Vehicles and regions",
        (
            ("total_accumulation", "Vehicles in the network with those waiting to enter [veh] over time."),
            (
                "region_accumulation",
                "Vehicles in each region [veh] over time. The strips above, one per strategy, tell the "
                "state of the region by the vehicles that left it in that run: light where it flows below the critical "
                "accumulation, green where the outflow is within 10 % of the largest, red where less leaves than so "
                "many vehicles could, because the region is congested or holds them back, dark and hatched where hardly "
                "any vehicle leaves.",
            ),
            (
                "mfd",
                "Macroscopic fundamental diagram of each region: vehicles inside [veh] against vehicles that leave or "
                "arrive [veh/s]. Dots: one per control interval; line: the regional model; hatched: beyond all dots.",
            ),
        ),
    ),
    (
        "Signals and routes",
        (
            (
                "perimeter",
                "Perimeter control: the commanded share u [-] of each boundary (from > to) that was closed most, "
                "the green that its signals showed and the flow, both as shares of those of the original programme.",
            ),
            (
                "splits",
                "Route guidance: the commanded shares θ [-] by which the vehicles of a region should leave by each "
                "neighbour, and the shares that did.",
            ),
            (
                "prices",
                "Prices: by how much longer than they take ways through a region were told to guided drivers who "
                "are bound for elsewhere [%], and the trips that waited to begin in a region [veh].",
            ),
        ),
    ),
)
RUNS = {**{name: text for name, (_, text) in SUMMARY.items()}, **FACTS, "demand": "multiple of the scenario's"}
SETTINGS = {"key": "of the configuration", "value": "as it was"}
DEPENDS = {"strategy": "for signals and routes", "depends on": "if that changes, its runs have to be made again"}
HERE = Path(__file__).parent
DEMAND = "Total time spent as a share of that {than}, over the demand, with 95 % intervals."


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture inside the page: a data URI, and the width at which it was drawn [CSS pixels]."""

    uri: str
    caption: str
    width: float


def write_page(
    path: Path,
    found: Sequence[Finished],
    reference: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    seed: int | None = None,
) -> Path:
    """The page of the runs, atomically; the first folder has its map with a slider over time. reference: a strategy to
    pair with, besides what all are compared with; seed: of the runs on the map, the first one that is there if None.
    InputError for another seed."""
    total, done, runs = sum(len(run.levels) for run in found), 0, []
    for number, run in enumerate(found):
        levels = []
        for level in run.levels:
            levels.append(_level(run, level, reference))
            done += 1
            if progress:
                progress(done, total)
        runs.append({**_run(run), "anchor": f"run-{number}", "levels": levels})
    shown, missing = _replay(found[0], reference, seed)
    scripts = [*(shown.replay.scripts if shown else ()), sorting()]
    files.write_text(
        path,
        environment("cosim.report", "cosim.view")
        .get_template("report.html.j2")
        .render(
            runs=runs,
            words=WORDS,
            caption=statistics.CAPTION,
            shown=shown,
            without_replay=missing,
            scripts=scripts,
            allowed=allowed(scripts),
            style=style("runs.css"),
            names=", ".join(dict.fromkeys(run.scenario.name for run in found)),
            paths=", ".join(str(run.path) for run in found),
            version=found[-1].levels[-1].manifest["sessions"][-1].get("versions", {}).get("perimeter-cosim", ""),
        ),
    )
    return path


def _replay(run: Finished, reference: str | None, seed: int | None) -> tuple[replay.Shown | None, str]:
    """The map with a slider, or why there is none."""
    try:
        return replay.chosen(run, reference, seed), ""
    except InputError as error:
        if seed is not None:
            raise
        return None, f"There is no map with a slider: {error}."


def environment(*packages: str) -> Environment:
    """Of the templates in these packages, which escape what is put in."""
    made = Environment(
        loader=ChoiceLoader([PackageLoader(package, ".") for package in packages]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    made.filters |= {"cell": cell, "typeset": typeset}
    return made


def sorting() -> str:
    """The script by which tables are sorted."""
    return (HERE / "sort.js").read_text(encoding="utf-8")


def allowed(scripts: Sequence[str]) -> str:
    """By which the page lets the browser run these scripts and no others, whatever a name in it may be."""
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    return " ".join(f"'sha256-{digest}'" for digest in digests)


def table(
    label: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    meaning: Callable[[str], str],
    words: bool = False,
) -> dict:
    """A table of the page. meaning: what a column says; words: of text that wraps, not of numbers"""
    told = [text[:1].upper() + text[1:] for text in map(meaning, columns)]
    return {"label": label, "columns": list(zip(columns, told, strict=True)), "rows": rows, "words": words}


def _frame(label: str, frame: pd.DataFrame, meaning: Callable[[str], str]) -> dict:
    return table(label, list(frame), frame.to_dict("split")["data"], meaning)


def _run(run: Finished) -> dict:
    """What the page shows of a folder before its levels, and its configuration."""
    configuration, rows = run.levels[0].manifest["configuration"], run.rows
    caption = DEMAND.format(than=statistics.than(statistics.compared_with(rows)))
    first = summary_text.opening(
        run.scenario.name, configuration["steps"], configuration["step_s"], len(run.levels), rows
    )
    with temporary_folder() as folder:
        if len(run.levels) > 1:
            pictures.demand_levels(folder / "demand.png", rows)
        shown = _pictures(folder, (("demand", caption),))
    level = run.level(None)
    heading, figures, name = card.card(level.rows)
    return {
        "name": run.name,
        "card": {
            "heading": heading,
            "figures": figures,
            "where": _at(run, level),
            "why": explain.at_a_glance(level.demand, level.folder, run.scenario.network, level.rows, name),
        },
        "story": [first, *(_at(run, level) + summary_text.head(level.rows) for level in run.levels)],
        "models": _models(run),
        "pictures": shown,
        "configuration": table("configuration", [*SETTINGS], _configuration(run), SETTINGS.__getitem__, words=True),
        "strategies": table(
            "strategies",
            [*DEPENDS],
            list(
                {
                    name: (name, _plain(depends) or "nothing of its own")
                    for level in run.levels
                    for name, depends in level.manifest.get("controllers", {}).items()
                }.values()
            ),
            DEPENDS.__getitem__,
            words=True,
        ),
    }


def _models(run: Finished) -> list[str]:
    """What is doubtful about the regional models that controllers plan with, and what was said of perimeter control in
    this city before anything was trained; a sentence each."""
    networks = {run.scenario.network.folder: run.scenario.network}
    for name in dict.fromkeys(run.rows["controller"]):
        with suppress(InputError):  # a model that is gone by now
            network = parse(name).planning(run.scenario).network
            networks.setdefault(network.folder, network)
    lines: list[str] = []
    kinds: list[str] = []
    for folder, network in networks.items():
        title = network.name if folder is None else os.path.normpath(folder)
        if network.placeholder:
            lines.append(f"The MFDs of {title} are placeholders from lanes and speed limits, measured in no run.")
        for region, doubts in zip(network.region_names, network.doubts, strict=False):
            if doubts:
                lines.append(f"The model {title} is doubtful in region {region}: {'; '.join(doubts)}.")
                kinds += doubts
    lines += fit_quality.meanings(kinds)
    own = run.scenario.network.folder
    if own is not None and (own / authority.FILE).is_file():
        text = (own / authority.FILE).read_text(encoding="utf-8", errors="replace")
        lines += text.partition("\n\n")[0].splitlines()
    return lines


def _at(run: Finished, level: Level) -> str:
    return f"At demand times {level.demand:g}: " if len(run.levels) > 1 else ""


def _level(run: Finished, level: Level, reference: str | None) -> dict:
    """What the page shows of a demand level."""
    rows, names = level.rows, set(level.rows["controller"])
    if reference not in names:
        reference = None
    outcome, how = statistics.shown(statistics.statistics(rows, reference), reference)
    title = f"Demand times {level.demand:g}"
    signals, reasons = explain.at(level.demand, level.folder, run.scenario.network, rows)
    with temporary_folder() as folder:
        pictures.draw(level.folder, run.scenario, run.city, rows, folder)
        pictures.draw_more(folder, run.scenario, level.folder, rows)
        drawn = [(heading, _pictures(folder, chosen, f"{title}. ")) for heading, chosen in PICTURES]
    missing = ", ".join(heading.lower() for heading, there in drawn if not there)
    why = run.changed or "there was nothing of the kind in these runs, or an older version did not record it"
    against = statistics.compared_with(rows)
    pair = [name for name in pictures.ranked(rows) if name != against][:1]
    both = f" and, where two are compared, {against} and {pair[0]}" if pair else ""
    return {
        "title": title,
        "details": summary_text.details(rows),
        "signals": signals,
        "reasons": reasons,
        "shown": f"Pictures of single runs show seed {pictures.shown_seed(rows)}{both}.",
        "tables": [
            _frame(f"What came of it, {title.lower()}", outcome, statistics.meaning),
            _frame(f"How, {title.lower()}", how, statistics.meaning),
        ],
        "pairs": _frame("pairs", statistics.pairs(rows).drop(columns="demand"), statistics.PAIRS.__getitem__),
        "runs": _frame(
            "runs",
            rows[["controller", *(name for name in rows.columns if name != "controller")]],
            lambda name: RUNS.get(name, ""),
        ),
        "pictures": [(heading, there) for heading, there in drawn if there],
        "missing": f"Without pictures of {missing}: {why}." if missing else "",
    }


def _pictures(folder: Path, wanted: Sequence[tuple[str, str]], before: str = "") -> list[Picture]:
    """Those of the wanted pictures, (name, caption), that were drawn in `folder`; `before` each caption."""
    return [
        picture(folder / f"{name}.png", before + caption)
        for name, caption in wanted
        if (folder / f"{name}.png").is_file()
    ]


def picture(path: Path, caption: str) -> Picture:
    """A png file as a picture of the page."""
    content = path.read_bytes()
    return Picture(
        uri=f"data:image/png;base64,{base64.b64encode(content).decode()}",
        caption=caption,
        width=96.0 * struct.unpack(">I", content[16:20])[0] / PIXELS,
    )


def typeset(sentence: str) -> str:
    """With true minus signs, and units that stay on the line of their number."""
    return re.sub(r"(?<![\w.])-(?=\d)", "\N{MINUS SIGN}", sentence).replace(" %", "\N{NO-BREAK SPACE}%")


def cell(value: object) -> str:
    """A value as text: seven digits, a dash where there is none."""
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.7g}"
    return "–" if value is None or value == "" or "nan" in str(value).split() else str(value)


def _configuration(run: Finished) -> list[tuple[str, str]]:
    """What the runs depend on, and when and with what they were made."""
    latest = run.levels[-1].manifest
    settings = {
        **latest["configuration"],
        "demand_factor": ", ".join(f"{level.demand:g}" for level in run.levels),
        "seeds": summary_text.seeds(run.rows["seed"]),
    }
    sessions = [session for level in run.levels for session in level.manifest["sessions"]]
    versions = {package: version for session in sessions for package, version in session.get("versions", {}).items()}
    kept = {json.dumps([session.get("commit"), session.get("dirty")]): session for session in sessions}
    commits = [
        f"{session.get('commit') or 'unknown'}{' with changes' if session.get('dirty') else ''}"
        for session in kept.values()
    ]
    dates = sorted(str(session.get("date", "")) for session in sessions)
    return [
        *((key, _plain(value)) for key, value in settings.items()),
        ("made", dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}, {len(dates)} sessions"),
        ("commit", ", ".join(commits)),
        ("versions", ", ".join(f"{package} {version}" for package, version in versions.items())),
    ]


def _plain(value: object) -> str:
    """Settings as words."""
    if isinstance(value, Mapping):
        return "; ".join(f"{key}: {_plain(part) or 'default'}" for key, part in value.items() if part is not None)
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    return cell(value)
