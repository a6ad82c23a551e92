"""The page of one or two runs: maps, curves and numbers, live or with a slider over a finished
run."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, CustomJS, Div, LayoutDOM, Select, Slider, Toggle

from cosim.sumo.arrays import PerEdge
from cosim.view import colours
from cosim.view.city_map import CityMap
from cosim.view.curves import HOUR, MINUTE, OF_REGION, Curves, Load
from cosim.view.picture import CityPicture, Frame

HERE = Path(__file__).parent
STYLE = (HERE / "page.css").read_text(encoding="utf-8")
PLAY_PERIOD_MS = 150  # wall time per control interval
TO_TIME = "slider.value = Math.min(slider.end, Math.max(0, Math.round(cb_obj.x / slider.step) * slider.step))"
TOP_SHARE = 0.02  # of the streets; short ones would leave all others pale
LONGEST = 30  # characters of a name beside a plot; the table of numbers has all
NARROWEST = 330  # pixels, of a plot; on a narrower screen plots stand below each other
KEY = (
    f"<span style='color:{colours.GREEN}'>◕</span> gates of a boundary, closer each gate; green: share of its original "
    f"green time &ensp; <span style='color:{colours.QUEUE}'>●</span> halo: queue before it &ensp; ➍ protected region"
)


class Page:
    """Maps, curves and numbers of runs side by side."""

    def __init__(
        self,
        picture: CityPicture,
        tones: Mapping[str, str],
        totals: Mapping[str, Sequence[PerEdge]] = {},
    ):
        """tones: name of a run -> its colour; totals: label -> values (E,) of every run, other
        layers of the maps"""
        self.picture, self.names, self.tones = picture, list(tones), tones
        # Above a scale is only TOP_SHARE of the values of all runs; its upper end has two digits.
        upper = {
            label: np.quantile(np.concatenate(values), 1.0 - TOP_SHARE)
            for label, values in totals.items()
        }
        tops = {label: float(f"{end:.2g}") or 1.0 for label, end in upper.items()}
        short = [
            name if len(name) <= LONGEST else f"{name[:14]}…{name[15 - LONGEST :]}"
            for name in tones
        ]
        titles = short if len(set(short)) == len(short) else self.names
        self.maps: list[CityMap] = []
        for n, name in enumerate(titles):
            layers = {label: (values[n], tops[label]) for label, values in totals.items()}
            self.maps.append(CityMap(picture, name, layers, self.maps[0] if n else None))
        parts_of = [[label, parts] for one in self.maps for label, parts in one.layers.items()]
        labels = list(self.maps[0].layers)
        self.streets = Select(
            title="Streets by", name="streets", width=210, value=labels[0], options=labels
        )
        self.streets.js_on_change("value", CustomJS.from_file(HERE / "layers.js", layers=parts_of))
        self.loads = [Load(picture, f"{name}: load") for name in titles]
        self.curves = Curves(picture, dict(zip(titles, tones.values(), strict=True)))
        self.numbers = Div(
            sizing_mode="stretch_width", css_classes=["numbers"], stylesheets=[STYLE]
        )
        ends = [region for gate in picture.gates for region in (gate.source, gate.target)]
        self.choose(max(range(picture.regions), key=ends.count))
        options = [
            (str(n), name if name == str(n) else f"{n} {name}")
            for n, name in enumerate(picture.region_names)
        ]
        self.regions = Select(
            name="region", title="Region", width=150, value=str(self.region), options=options
        )

    def choose(self, region: int) -> None:
        """Select the region whose curves are shown; `trace` draws them."""
        self.region = region
        for one in self.maps:
            one.choose(region)
        self.curves.choose(region)

    def show(self, frames: Sequence[Frame | None], time: float) -> None:
        """Draw maps and numbers at a time [s]: a frame of every run, None before its first one."""
        for one, frame in zip(self.maps, frames, strict=True):
            if frame is not None:
                one.show(frame)
        for load in self.loads:
            load.now.location = time / MINUTE
        self.curves.mark(time)
        self.numbers.text = numbers(self.tones, frames, time)

    def trace(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """Draw the curves from the whole frames of every run, with the time [s] marked."""
        for load, whole in zip(self.loads, runs, strict=True):
            load.show(whole)
        self.curves.show(runs, time)

    def layout(self, bar: Sequence[LayoutDOM]) -> LayoutDOM:
        """Return the page as one model, with `bar` above it."""
        curves = self.curves
        pair = [curves.region, curves.plane]
        beside, below = (
            ([], pair) if len(self.maps) > 1 else ([column(*pair, sizing_mode="stretch_width")], [])
        )
        for n, one in enumerate(self.maps):
            one.plot.name = f"map{n}"
        curves.plane.name, curves.trips.name = "plane", "trips"
        self.numbers.name = "numbers"
        above = _wrapped(bar, narrowest=0)
        above.update(css_classes=["bar"], stylesheets=[STYLE])
        return column(
            above,
            _wrapped([*(one.plot for one in self.maps), *beside]),
            Div(text=KEY, css_classes=["key"], stylesheets=[STYLE]),
            self.numbers,
            _wrapped([load.plot for load in self.loads]),
            _wrapped([*below, curves.gates, curves.trips, curves.spent]),
            sizing_mode="stretch_width",
        )


def with_slider(
    picture: CityPicture,
    runs: Mapping[str, Sequence[Frame]],
    tones: Mapping[str, str],
    totals: Mapping[str, Any] = {},
) -> LayoutDOM:
    """Return the page of finished runs, which needs no server.

    It starts where two runs differ most while vehicles drive in both, or where one has most
    vehicles.
    runs: whole frames by name; tones: colours of these and perhaps others; totals: as in `Page`
    """
    page, whole = Page(picture, {name: tones[name] for name in runs}, totals), list(runs.values())
    last, step = max(map(len, whole)) - 1, picture.step / MINUTE
    padded = [[*frames, *[frames[-1]] * (last + 1 - len(frames))] for frames in whole]
    inside = np.array([[frame.accumulation.sum() for frame in frames] for frames in padded])
    begin = int(
        np.argmax(np.ptp(inside, axis=0) * inside.min(axis=0) if len(inside) > 1 else inside[0])
    )
    moving = [
        *((one.streets, ["density"]) for one in page.maps),
        *((source, ["end", "green", "queue", "halo"]) for one in page.maps for source in one.gates),
    ]
    of_region = [
        *((one.regions, ["width", "line", "fill"]) for one in page.maps),
        *((line, list(OF_REGION)) for line in page.curves.lines),
        *((source, ["x", "y"]) for source in (page.curves.critical, page.curves.mfd)),
    ]
    film, choices = (
        [
            [source, ColumnDataSource({name: [] for name in names}), names]
            for source, names in sources
        ]
        for sources in (moving, of_region)
    )
    words, first = [], page.region
    texts: list[list[str]] = [[] for _ in page.curves.titles]
    for k in range(last + 1):
        page.show([frames[k] for frames in padded], k * picture.step)
        _add_row(film)
        words.append(page.numbers.text)
    for region in range(picture.regions):
        page.choose(region)
        page.trace(whole, begin * picture.step)
        _add_row(choices)
        for title, text in zip(page.curves.titles, texts, strict=True):
            text.append(title.text)
    page.choose(first)
    page.trace(whole, begin * picture.step)
    page.show([frames[begin] for frames in padded], begin * picture.step)
    wide = {"sizing_mode": "stretch_width", "styles": {"flex": "1 1 200px"}}
    slider = Slider(
        start=0.0,
        end=last * step,
        value=begin * step,
        step=step,
        title="time [min]",
        name="time",
        **wide,
    )
    play = Toggle(label="Play", name="play", width=90, button_type="primary")
    args = {"slider": slider, "region": page.regions, "film": film, "choices": choices}
    args |= {"titles": page.curves.titles, "texts": texts, "numbers": page.numbers, "words": words}
    args |= {
        "present": page.curves.present,
        "spans": [*(load.now for load in page.loads), *page.curves.now],
    }
    callback = CustomJS.from_file(HERE / "slider.js", **args)
    slider.js_on_change("value", callback)
    page.regions.js_on_change("value", callback)
    for load in page.loads:
        load.plot.js_on_event("tap", CustomJS(args={"slider": slider}, code=TO_TIME))
    playing = CustomJS.from_file(HERE / "play.js", slider=slider, period=PLAY_PERIOD_MS)
    play.js_on_change("active", playing)
    return page.layout([play, slider, page.regions, *[page.streets] * bool(totals)])


def _add_row(tables: Sequence[Sequence[Any]]) -> None:
    """Add the present values of the sources to their tables."""
    for source, table, names in tables:
        for name in names:
            values = source.data[name]
            table.data[name].append(
                values.copy() if isinstance(values, np.ndarray) else list(values)
            )


def _wrapped(parts: Sequence[LayoutDOM], narrowest: int = NARROWEST) -> LayoutDOM:
    """Return a row that breaks into several on a narrow screen."""
    for part in parts if narrowest else ():
        part.styles = {"flex": f"1 1 {narrowest}px", "min-width": "0", "max-width": "760px"}
    return row(*parts, sizing_mode="stretch_width", styles={"flex-wrap": "wrap", "gap": "8px 14px"})


def numbers(tones: Mapping[str, str], frames: Sequence[Frame | None], time: float) -> str:
    """Return the totals of the runs at a time [s], as an HTML table."""
    labels = (
        "inside [veh]",
        "waiting [veh]",
        "completed [veh]",
        "time spent [veh&nbsp;h]",
        "removed [veh]",
    )
    heads = "".join(f"<td class=head>{label}</td>" for label in labels)
    lines = []
    for (name, colour), frame in zip(tones.items(), frames, strict=True):
        cells = ""
        if frame is not None:
            totals = [
                frame.accumulation.sum(),
                frame.waiting,
                frame.completed,
                frame.time_spent / HOUR,
                frame.removed,
            ]
            cells = "".join(f"<td>{value:,.0f}</td>" for value in totals)
            cells += f"<td class=note>{escape(frame.note[:200])}</td>"
        lines.append(
            f"<tr><th><span style='color:{colour}'>■</span> {escape(name)}</th>{cells}</tr>"
        )
    return f"<table><tr><th class=time>{time / MINUTE:.1f} min</th>{heads}</tr>{''.join(lines)}</table>"
