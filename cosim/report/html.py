"""The report: one self-contained HTML page about the finished runs of one or several folders."""

import base64
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import NamedTuple

import pandas as pd
from bokeh.embed import components
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined

from cosim.evaluation import explain, statistics
from cosim.evaluation.results import Finished, Level
from cosim.report import figures
from cosim.view.page import with_slider
from cosim.view.picture import CityPicture, frames, totals
from nmfd.errors import InputError
from nmfd.runs import config, files
from nmfd.studies import plots
from nmfd.studies.benchmark import REFERENCE

CAPTIONS = config.read(Path(__file__).with_name("captions.toml"))
PICTURES, LEVEL_PICTURES = CAPTIONS["level"], CAPTIONS["levels"]  # file -> caption
QUANTITIES = CAPTIONS[
    "card"
]  # column -> label, unit on the card, format of a value, sign of an improvement, meaning


class Figure(NamedTuple):
    """Figure of the card: of the best strategy, before of the reference; better: None if not
    significant."""

    label: str
    value: str
    meaning: str
    before: str = ""
    change: str = ""
    verdict: str = ""
    better: bool | None = None


def write_page(path: Path, runs: Sequence[Finished], *, seed: int | None = None) -> Path:
    """Write the page of the runs to `path`; the first folder has its map with a slider.

    seed: of the runs on the map; the first that both have if None
    Raises: InputError if there is no run with this seed
    """
    shown, script, div = _map(runs[0], seed)
    loader = PackageLoader("cosim.report", ".")
    environment = Environment(
        loader=loader, autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    page = environment.get_template("report.html.j2").render(
        name=", ".join(dict.fromkeys(run.scenario.name for run in runs)),
        runs=[_run(run) for run in runs],
        seed=shown,
        map_div=div,
        scripts=[*Resources(mode="inline", components=["bokeh", "bokeh-widgets"]).js_raw, script],
        style=(Path(__file__).parent / "report.css").read_text(encoding="utf-8"),
        caption=statistics.CAPTION,
    )
    files.write_text(path, page)
    return path


def _map(run: Finished, seed: int | None) -> tuple[int, str, str]:
    """Return seed, script and HTML of the best run beside its reference, with a slider over their
    time."""
    level = run.level()
    names = figures.pair(level.rows)
    seeds = [set(statistics.by_seed(level.rows, level.demand, name)) for name in names]
    if not (common := sorted(set.intersection(*seeds))):
        names, common = names[:1], sorted(seeds[0])
    if seed is not None and seed not in common:
        raise InputError(
            f"--seed: {' and '.join(names)} have no run with seed {seed}; choose from {common}"
        )
    seed = common[0] if seed is None else seed
    picture = CityPicture.of(run.scenario, run.map())
    results = {name: level.read(name, seed) for name in names}
    whole = {name: frames(picture, result) for name, result in results.items()}
    picture = replace(picture, steps=max(map(len, whole.values())) - 1)
    layers, tones = totals(picture, list(results.values())), plots.colours(run.rows["controller"])
    return seed, *components(with_slider(picture, whole, tones, layers), wrap_script=False)


def _run(run: Finished) -> dict:
    """Return what the page shows of a folder."""
    level, rows = run.level(), run.rows
    seeds = ", ".join(map(str, sorted(set(rows["seed"]))))
    heading, shown, name = card(level.rows)
    manifest = json.dumps(
        {"runs": level.key, "controllers": level.controllers, "sessions": run.sessions}, indent=1
    )
    minutes = level.key["steps"] * level.key["step_s"] / 60
    pictures = (
        _pictures(partial(figures.draw_levels, rows=rows), LEVEL_PICTURES)
        if len(run.levels) > 1
        else []
    )
    return {
        "name": run.path.resolve().name,
        "heading": f"Demand times {level.demand:g}: " * (len(run.levels) > 1) + heading,
        "figures": shown,
        "why": explain.paragraph(level, run, name),
        "intro": f"Scenario {run.scenario.name}, {minutes:.0f} min in SUMO; seeds {seeds}. With the same seed every "
        "controller has the same trips.",
        "pictures": pictures,
        "levels": [_level(run, level) for level in run.levels],
        "manifest": re.sub(r"(?<![\w.])/(?:[^/\s\"']+/)+", "", manifest),  # no folders of a machine
    }


def card(rows: pd.DataFrame) -> tuple[str, list[Figure], str]:
    """Return a sentence, the figures that were recorded, and the name of the best strategy of one
    demand level.

    It is compared with the reference on the seeds that both have.
    """
    level, (against, name) = rows["demand"].iloc[0], (figures.pair(rows) * 2)[:2]
    heading = name
    than = "without control" if against == REFERENCE else f"under {against}"
    shown = []
    for column, (label, unit, form, good, meaning) in QUANTITIES.items():
        now, before = (statistics.by_seed(rows, level, one, column) for one in (name, against))
        common, pair = [seed for seed in now if seed in before], statistics.paired(now, before)
        value = mean(now[seed] for seed in common or now) / unit
        figure = Figure(label, form.format(value), meaning)
        if name != against and not math.isnan(pair.percent):
            reference = mean(before[seed] for seed in common) / unit
            change, verdict, better = _judged(pair, good)
            figure = Figure(
                label,
                figure.value,
                meaning,
                f"{form.format(reference)} {than}",
                change,
                verdict,
                better,
            )
            if column == statistics.TTS:
                heading = f"{name} compared with {against.replace('-', ' ')}: {change} time spent, {verdict}."
                figure = figure._replace(
                    label="Vehicle hours saved", value=form.format(reference - value)
                )
        shown += [] if math.isnan(value) else [figure]
    return heading, shown, name


def _judged(pair: statistics.Paired, good: int) -> tuple[str, str, bool | None]:
    """Return change, verdict and better of a figure; good: sign of an improvement."""
    seeds, half, clear = pair.seeds, pair.percent_half, pair.significant
    digits = 0 if half >= 1.0 or seeds == 1 else 1
    spread = "" if seeds == 1 else f" ± {max(half, 0.1):.{digits}f}"
    size = f"{abs(pair.percent):.{digits}f}{spread} % {'more' if pair.percent > 0 else 'less'}"
    change = size if pair.percent or half else "no change"
    few = f"no proof ({seeds} seed{'s' * (seeds > 1)})"
    verdict = (
        few if seeds < statistics.FEWEST_SEEDS else "significant" if clear else "not significant"
    )
    return change, verdict, pair.percent * good > 0 if clear else None


def _level(run: Finished, level: Level) -> dict:
    """Return what the page shows of a demand level."""
    rows = level.rows
    draw = partial(figures.draw_level, finished=run, level=level)
    regions = statistics.by_region(
        level, run.map(), run.scenario.network.region_names, figures.pair(rows)
    )
    return {
        "title": f"Demand times {level.demand:g}",
        "tables": [_html(table) for table in statistics.shown(statistics.statistics(rows))],
        "regions": None if regions is None else _html(regions),
        "pairs": _html(statistics.pairs(rows).drop(columns="demand")),
        "runs": _html(rows),
        "pictures": _pictures(draw, PICTURES),
    }


def _pictures(draw: Callable[[Path], None], captions: dict[str, str]) -> list[tuple[str, str]]:
    """Return data URI and caption of the pictures that `draw` writes into a folder."""
    pictures = []
    with files.temporary_folder() as folder:
        draw(folder)
        for name, caption in captions.items():
            if (file := folder / f"{name}.png").is_file():
                encoded = base64.b64encode(file.read_bytes()).decode()
                pictures.append((f"data:image/png;base64,{encoded}", caption))
    return pictures


def _html(frame: pd.DataFrame) -> str:
    """Return a table as HTML with escaped text."""
    return frame.to_html(index=False, border=0, na_rep="–", float_format="{:.7g}".format)
