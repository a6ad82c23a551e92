"""Finished runs as the live page shows them, with a slider over their time, for a page that needs no server."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from bokeh.embed import components
from bokeh.models import ColumnDataSource, CustomJS, Model, Select, Slider, Toggle
from bokeh.resources import Resources

from cosim.view.curves import MINUTE, TRAIL
from cosim.view.page import HERE, Page
from cosim.view.picture import CityPicture, Frame

PLAYED = 150  # ms per control interval
Sources = list[tuple[str, ColumnDataSource, list[str]]]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What a page needs to have it: scripts, JavaScript to stand at its end; roots: the HTML of every model by name;
    places: which of them is where (`body.html.j2`)."""

    scripts: tuple[str, ...]
    roots: Mapping[str, str]
    places: Mapping[str, list[str]]


def embedded(picture: CityPicture, runs: Mapping[str, Sequence[Frame]]) -> Replay:
    """Of one or two runs. runs: by name, the frames at the ends of control intervals."""
    models, places = layout(picture, runs)
    script, roots = components(models, wrap_script=False)
    library = Resources(mode="inline", components=["bokeh", "bokeh-widgets"]).js_raw
    return Replay(scripts=(*library, script), roots=roots, places=places)


def layout(picture: CityPicture, runs: Mapping[str, Sequence[Frame]]) -> tuple[dict[str, Model], dict[str, list[str]]]:
    """The models, as `Page.layout` gives them. They show at first when runs differ most, or a single one is fullest."""
    page, whole = Page(picture, list(runs)), list(runs.values())
    first, moving, chosen = page.region, _moving(page), _chosen(page)
    step, last = picture.step / MINUTE, max(map(len, whole)) - 1
    begin = _most_telling(whole, last)
    film: dict[str, list] = {f"{name}.{column}": [] for name, _, columns in moving for column in columns}
    film["text"] = []
    for k in [*range(last + 1), begin]:
        page.show([frames[min(k, len(frames) - 1)] for frames in whole], k * picture.step)
        if len(film["text"]) <= last:
            film["text"].append(page.numbers.text)
            _keep(film, moving)
    choices: dict[str, list] = {f"{name}.{column}": [] for name, _, columns in chosen for column in columns}
    titles = [plot.title for plot in (page.curves.region, page.curves.plane, page.curves.gate)]
    choices |= {f"title{n}": [] for n in range(len(titles))}
    for region in [*range(picture.regions), first]:  # the first one at last: that is what the page shows
        page.choose(region, page.gate_of(region))
        page.trace(whole, begin * picture.step)
        if len(choices["title0"]) < picture.regions:
            _keep(choices, chosen)
            for n, title in enumerate(titles):
                choices[f"title{n}"].append(title.text)
    slider = Slider(
        start=0.0,
        end=last * step,
        value=begin * step,
        step=step,
        title="time [min]",
        name="time",
        sizing_mode="stretch_width",
    )
    region = Select(
        title="Region",
        name="region",
        value=str(first),
        width=230,
        options=[(str(n), f"{n} {name}") for n, name in enumerate(picture.region_names)],
    )
    play = Toggle(label="Play", name="play", width=90, button_type="primary")
    curves = page.curves
    callback = CustomJS(
        args={
            "slider": slider,
            "region": region,
            "film": ColumnDataSource(film),
            "choices": ColumnDataSource(choices),
            "moving": moving,
            "chosen": chosen,
            "titles": titles,
            "numbers": page.numbers,
            "lines": curves.lines,
            "trails": curves.trails,
            "points": curves.points,
            "trail": TRAIL,
            "spans": [*(load.now for load in page.loads), *curves.now],
        },
        code=(HERE / "replay.js").read_text(encoding="utf-8"),
    )
    slider.js_on_change("value", callback)
    region.js_on_change("value", callback)
    play.js_on_change(
        "active",
        CustomJS(
            args={"slider": slider, "wait": PLAYED},
            code="""
        clearInterval(window.replaying)
        cb_obj.label = cb_obj.active ? "Pause" : "Play"
        if (cb_obj.active && slider.value > slider.end - slider.step / 2) slider.value = slider.start
        if (cb_obj.active) window.replaying = setInterval(() => {
            if (slider.value > slider.end - slider.step / 2) cb_obj.active = false
            else slider.value = Math.min(slider.value + slider.step, slider.end)
        }, wait)""",
        ),
    )
    return page.layout([play, slider], [region])


def _most_telling(runs: Sequence[Sequence[Frame]], last: int) -> int:
    """The interval at whose end two runs have the most different numbers of vehicles inside, or one has the most."""
    inside = [
        np.array([frames[min(k, len(frames) - 1)].accumulation.sum() for k in range(last + 1)]) for frames in runs
    ]
    return int(np.argmax(np.abs(inside[0] - inside[1]) if len(inside) > 1 else inside[0]))


def _moving(page: Page) -> Sources:
    """What changes with the time: a name, the source, and its columns."""
    found: Sources = []
    for n, one in enumerate(page.maps):
        found += [
            (f"streets{n}", one.streets, ["value"]),
            (f"gates{n}", one.gates, ["end", "green", "queue", "halo"]),
            (f"arrows{n}", one.arrows, ["width", "head", "guided"]),
        ]
    return found


def _chosen(page: Page) -> Sources:
    """What changes with the region."""
    curves = page.curves
    return [
        *((f"regions{n}", one.regions, ["width", "line", "fill"]) for n, one in enumerate(page.maps)),
        *((f"lines{n}", line, ["accumulation", "outflow", "u", "green"]) for n, line in enumerate(curves.lines)),
        ("critical", curves.critical, ["x", "y"]),
        ("curve", curves.curve, ["x", "y"]),
    ]


def _keep(table: dict[str, list], sources: Sources) -> None:
    """Another row of the table: copies of what the sources have now."""
    for name, source, columns in sources:
        for column in columns:
            values = source.data[column]
            table[f"{name}.{column}"].append(values.copy() if isinstance(values, np.ndarray) else list(values))
