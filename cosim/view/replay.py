"""Finished runs on the same page, with a slider over their time: one file that needs no server and no network."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from bokeh.document import Document
from bokeh.embed import file_html
from bokeh.models import ColumnDataSource, CustomJS, Select, Slider, Toggle
from bokeh.resources import INLINE

from cosim.view.curves import MINUTE, TRAIL
from cosim.view.page import HERE, Page
from cosim.view.picture import CityPicture, Frame
from nmfd.runs import files

PLAYED = 150  # ms per control interval
Sources = list[tuple[str, ColumnDataSource, list[str]]]


def write(path: Path, picture: CityPicture, runs: Mapping[str, Sequence[Frame]], subtitle: str) -> Path:
    """The page of one or two runs, atomically. runs: by name, the frames at the ends of control intervals."""
    made = document(picture, runs, subtitle)
    files.write_text(path, file_html(
        made, INLINE, title=made.title, template=made.template, template_variables=made.template_variables))
    return path


def document(picture: CityPicture, runs: Mapping[str, Sequence[Frame]], subtitle: str) -> Document:
    """The same as a document. At first it shows the end."""
    page, whole, made = Page(picture, list(runs)), list(runs.values()), Document()
    first, moving, chosen = page.region, _moving(page), _chosen(page)
    step, last = picture.step / MINUTE, max(map(len, whole)) - 1
    film: dict[str, list] = {f"{name}.{column}": [] for name, _, columns in moving for column in columns}
    film["text"] = []
    for k in range(last + 1):
        page.show([frames[min(k, len(frames) - 1)] for frames in whole], k * picture.step)
        film["text"].append(page.numbers.text)
        _keep(film, moving)
    choices: dict[str, list] = {f"{name}.{column}": [] for name, _, columns in chosen for column in columns}
    titles = [plot.title for plot in (page.curves.region, page.curves.plane, page.curves.gate)]
    choices |= {f"title{n}": [] for n in range(len(titles))}
    for region in [*range(picture.regions), first]:  # the first one at last: that is what the page shows
        page.choose(region, page.gate_of(region))
        page.trace(whole, last * picture.step)
        if len(choices["title0"]) < picture.regions:
            _keep(choices, chosen)
            for n, title in enumerate(titles):
                choices[f"title{n}"].append(title.text)
    slider = Slider(
        start=0.0, end=last * step, value=last * step, step=step, title="time [min]", name="time",
        sizing_mode="stretch_width")
    region = Select(title="Region", name="region", value=str(first), width=230, options=[
        (str(n), f"{n} {name}") for n, name in enumerate(picture.region_names)])
    play = Toggle(label="Play", name="play", width=90, button_type="primary")
    curves = page.curves
    callback = CustomJS(
        args={"slider": slider, "region": region, "film": ColumnDataSource(film), "choices": ColumnDataSource(choices),
              "moving": moving, "chosen": chosen, "titles": titles, "numbers": page.numbers, "lines": curves.lines,
              "trails": curves.trails, "points": curves.points, "trail": TRAIL,
              "spans": [*(load.now for load in page.loads), *curves.now]},
        code=(HERE / "replay.js").read_text(encoding="utf-8"))
    slider.js_on_change("value", callback)
    region.js_on_change("value", callback)
    play.js_on_change("active", CustomJS(args={"slider": slider, "wait": PLAYED}, code="""
        clearInterval(window.replaying)
        cb_obj.label = cb_obj.active ? "Pause" : "Play"
        if (cb_obj.active && slider.value > slider.end - slider.step / 2) slider.value = slider.start
        if (cb_obj.active) window.replaying = setInterval(() => {
            if (slider.value > slider.end - slider.step / 2) cb_obj.active = false
            else slider.value = Math.min(slider.value + slider.step, slider.end)
        }, wait)"""))
    page.place(made, subtitle, [play, slider], [region])
    return made


def _moving(page: Page) -> Sources:
    """What changes with the time: a name, the source, and its columns."""
    found: Sources = []
    for n, one in enumerate(page.maps):
        found += [
            (f"streets{n}", one.streets, ["value"]),
            (f"gates{n}", one.gates, ["end", "green", "queue", "halo"]),
            (f"arrows{n}", one.arrows, ["width", "head", "guided"])]
    return found


def _chosen(page: Page) -> Sources:
    """What changes with the region."""
    curves = page.curves
    return [
        *((f"regions{n}", one.regions, ["width", "line", "fill"]) for n, one in enumerate(page.maps)),
        *((f"lines{n}", line, ["accumulation", "outflow", "u", "green"]) for n, line in enumerate(curves.lines)),
        ("critical", curves.critical, ["x", "y"]), ("curve", curves.curve, ["x", "y"])]


def _keep(table: dict[str, list], sources: Sources) -> None:
    """Another row of the table: copies of what the sources have now."""
    for name, source, columns in sources:
        for column in columns:
            values = source.data[column]
            table[f"{name}.{column}"].append(values.copy() if isinstance(values, np.ndarray) else list(values))
