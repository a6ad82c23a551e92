"""The report: one self-contained HTML page about finished runs.

The runs may lie in several folders.
"""

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
from cosim.reporting import figures
from cosim.view.page import with_slider
from cosim.view.picture import CityPicture, frames, totals
from nmfd.errors import InputError
from nmfd.runs import config, files
from nmfd.studies import plots
from nmfd.studies.benchmark import REFERENCE

CAPTIONS = config.read(Path(__file__).with_name("captions.toml"))
PICTURES = CAPTIONS["level"]  # file -> caption
LEVEL_PICTURES = CAPTIONS["levels"]
# Column -> label, unit on the card, format of a value, sign of an improvement, meaning.
QUANTITIES = CAPTIONS["card"]


class Figure(NamedTuple):
    """Figure of the card.

    value: under the best strategy
    before: under the reference; "" without one
    better: None if the change is not significant
    """

    label: str
    value: str
    meaning: str
    before: str = ""
    change: str = ""
    verdict: str = ""
    better: bool | None = None


class Map(NamedTuple):
    """Maps with a slider over time.

    seed: of the runs
    div: HTML; scripts: for the end of the page
    """

    seed: int
    div: str
    scripts: list[str]


def write_page(path: Path, runs: Sequence[Finished], *, seed: int | None = None) -> Path:
    """Write the page of the runs, and return its path.

    The first folder has its map with a slider.

    seed: of the runs on the map; the first that both have if None
    Raises: InputError if there is no run with this seed
    """
    shown = map_of(runs[0], seed=seed)
    page = rendered(
        "cosim.reporting",
        "report.html.j2",
        name=", ".join(dict.fromkeys(run.scenario.name for run in runs)),
        runs=[_run(run) for run in runs],
        seed=shown.seed,
        map_div=shown.div,
        scripts=shown.scripts,
        style=style(),
        caption=statistics.CAPTION,
    )
    files.write_text(path, page)
    return path


def rendered(package: str, template: str, **values: object) -> str:
    """Return a page from a template in the folder of a package."""
    environment = Environment(
        loader=PackageLoader(package, "."),
        autoescape=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    return environment.get_template(template).render(**values)


def style() -> str:
    """Return the style sheet of the page."""
    return (Path(__file__).parent / "report.css").read_text(encoding="utf-8")


def map_of(
    run: Finished,
    *,
    seed: int | None = None,
    demand: float = 1.0,
    names: Sequence[str] = (),
) -> Map:
    """Return the map of one or two runs with a slider over time.

    seed: of the runs; the first that all have if None
    demand: the nearest level is shown
    names: controllers; the reference and the best one if empty
    Raises: InputError if there is no run with this seed
    """
    level = run.level(demand)
    if not names:
        names = figures.pair(level.rows)
    seeds = [set(statistics.by_seed(level.rows, level.demand, name)) for name in names]
    common = sorted(set.intersection(*seeds))
    if not common:
        names = names[:1]
        common = sorted(seeds[0])
    if seed is None:
        seed = common[0]
    elif seed not in common:
        raise InputError(
            f"--seed: {' and '.join(names)} have no run with seed {seed}; choose from {common}"
        )
    picture = CityPicture.of(run.scenario, run.map())
    results = {name: level.read(name, seed) for name in names}
    whole = {name: frames(picture, result) for name, result in results.items()}
    picture = replace(picture, steps=max(map(len, whole.values())) - 1)
    layers = totals(picture, list(results.values()))
    tones = plots.colours(run.rows["controller"])
    script, div = components(with_slider(picture, whole, tones, layers), wrap_script=False)
    bokeh = Resources(mode="inline", components=["bokeh", "bokeh-widgets"])
    return Map(seed=seed, div=div, scripts=[*bokeh.js_raw, script])


def _run(run: Finished) -> dict:
    """Return what the page shows of a folder."""
    level = run.level()
    rows = run.rows
    heading, shown, name = card(level.rows)
    pictures = []
    if len(run.levels) > 1:
        heading = f"Demand times {level.demand:g}: {heading}"
        pictures = _pictures(partial(figures.draw_levels, rows=rows), LEVEL_PICTURES)
    minutes = level.key["steps"] * level.key["step_s"] / 60
    seeds = ", ".join(map(str, sorted(set(rows["seed"]))))
    return {
        "name": run.path.resolve().name,
        "heading": heading,
        "warnings": statistics.warnings(statistics.statistics(level.rows)),
        "figures": shown,
        "why": explain.paragraph(level, run, name),
        "intro": f"Scenario {run.scenario.name}, {minutes:.0f} min in SUMO; seeds {seeds}. "
        "With the same seed every controller has the same trips.",
        "pictures": pictures,
        "levels": [_level(run, level) for level in run.levels],
        "manifest": made_by(run),
    }


def made_by(run: Finished) -> str:
    """Return what runs depend on as text, without the folders of a machine."""
    level = run.level()
    made = {"runs": level.key, "controllers": level.controllers, "sessions": run.sessions}
    return re.sub(r"(?<![\w.])/(?:[^/\s\"']+/)+", "", json.dumps(made, indent=1))


def card(rows: pd.DataFrame) -> tuple[str, list[Figure], str]:
    """Return the card of one demand level: a sentence, figures, and a name.

    The name is that of the best strategy. It is compared with the reference on the seeds that both
    have. Figures that were not recorded are left out.
    """
    against, *others = figures.pair(rows)
    name = others[0] if others else against
    level = rows["demand"].iloc[0]
    heading = name
    than = f"under {against}"
    if against == REFERENCE:
        than = "without control"
    shown = []
    for column, (label, unit, form, good, meaning) in QUANTITIES.items():
        now = statistics.by_seed(rows, level, name, column)
        before = statistics.by_seed(rows, level, against, column)
        pair = statistics.paired(now, before)
        common = [seed for seed in now if seed in before]
        value = mean(now[seed] for seed in common or now) / unit
        if math.isnan(value):
            continue
        figure = Figure(label, form.format(value), meaning)
        if name != against and not math.isnan(pair.percent):
            reference = mean(before[seed] for seed in common) / unit
            change, verdict, better = _judged(pair, good)
            figure = figure._replace(
                before=f"{form.format(reference)} {than}",
                change=change,
                verdict=verdict,
                better=better,
            )
            if column == statistics.TTS:
                comparison = f"{name} compared with {against.replace('-', ' ')}"
                heading = f"{comparison}: {change} time spent, {verdict}."
                saved = form.format(reference - value)
                figure = figure._replace(label="Vehicle hours saved", value=saved)
        shown.append(figure)
    return heading, shown, name


def _judged(pair: statistics.Paired, good: int) -> tuple[str, str, bool | None]:
    """Return change, verdict and better of a figure.

    good: sign of an improvement
    """
    one_seed = pair.seeds == 1
    half = 0.0
    scale = abs(pair.percent)
    if not one_seed:
        half = pair.percent_half
        scale = half
    digits = 0 if scale >= 1.0 else 1
    spread = "" if one_seed else f" ± {max(half, 0.1):.{digits}f}"
    direction = "more" if pair.percent > 0 else "less"
    change = f"{abs(pair.percent):.{digits}f}{spread} % {direction}"
    if not round(pair.percent, 1) and not half:
        change = "no change"
    if pair.significant:
        return change, "significant", pair.percent * good > 0
    if pair.seeds >= statistics.FEWEST_SEEDS:
        return change, "not significant", None
    plural = "" if one_seed else "s"
    return change, f"no proof ({pair.seeds} seed{plural})", None


def _level(run: Finished, level: Level) -> dict:
    """Return what the page shows of a demand level."""
    rows = level.rows
    table = statistics.statistics(rows)
    draw = partial(figures.draw_level, finished=run, level=level)
    regions = statistics.by_region(
        level, run.map(), run.scenario.network.region_names, figures.pair(rows)
    )
    return {
        "title": f"Demand times {level.demand:g}",
        "tables": [_html(part) for part in statistics.shown(table)],
        "warnings": statistics.warnings(table),
        "regions": None if regions is None else _html(regions),
        "pairs": _html(statistics.pairs(rows).drop(columns="demand")),
        "runs": _html(rows),
        "pictures": _pictures(draw, PICTURES),
    }


def _pictures(draw: Callable[[Path], None], captions: dict[str, str]) -> list[tuple[str, str]]:
    """Return data URI and caption of pictures.

    draw: writes them into a folder
    """
    pictures = []
    with files.temporary_folder() as folder:
        draw(folder)
        for name, caption in captions.items():
            file = folder / f"{name}.png"
            if file.is_file():
                encoded = base64.b64encode(file.read_bytes()).decode()
                pictures.append((f"data:image/png;base64,{encoded}", caption))
    return pictures


def _html(frame: pd.DataFrame) -> str:
    """Return a table as HTML with escaped text."""
    return frame.to_html(index=False, border=0, na_rep="–", float_format="{:.7g}".format)
