"""Page of one or two runs: maps, curves and numbers.

It is live, or has a slider over finished runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    Div,
    LayoutDOM,
    PlainText,
    Select,
    Slider,
    Toggle,
)

from cosim.sumo.arrays import PerEdge
from cosim.view import colours
from cosim.view.city_map import CityMap, Layer
from cosim.view.curves import HOUR, MINUTE, OF_REGION, Curves, Load
from cosim.view.picture import CityPicture, Frame

HERE = Path(__file__).parent
STYLE = (HERE / "page.css").read_text(encoding="utf-8")
PLAY_PERIOD_MS = 150  # wall time per control interval
TO_TIME = """
const step = Math.round(cb_obj.x / slider.step)
slider.value = Math.min(slider.end, Math.max(0, step * slider.step))
"""
TOP_SHARE = 0.02  # of the streets; short ones would leave all others pale
LONGEST = 30  # characters of a name beside a plot; the table of numbers has all
NARROWEST = 330  # pixels, of a plot; on a narrower screen plots stand below each other
KEY = (
    f"<span style='color:{colours.GREEN}'>◕</span> gates from region → region, closer each gate; "
    "rim: colour of the region entered; green: share of its original green time &ensp; "
    f"<span style='color:{colours.QUEUE}'>●</span> halo: queue before it &ensp; ➍ protected region"
)
HEADS = (
    "inside [veh]",
    "waiting [veh]",
    "completed [veh]",
    "time spent [veh&nbsp;h]",
    "removed [veh]",
)


class Page:
    """Maps, curves and numbers of runs side by side."""

    def __init__(
        self,
        picture: CityPicture,
        tones: Mapping[str, str],
        totals: Mapping[str, Sequence[PerEdge]] = {},
    ):
        """Draw nothing yet.

        tones: name of a run -> its colour
        totals: label -> values (E,) of every run, other layers of the maps
        """
        self.picture = picture
        self.names = list(tones)
        self.tones = tones
        titles = _titles(self.names)
        self.maps = _maps(picture, titles, totals)
        self.streets = self._layer_choice()
        self.loads = [Load(picture, f"{title}: load") for title in titles]
        self.curves = Curves(picture, dict(zip(titles, tones.values(), strict=True)))
        self.numbers = Div(
            sizing_mode="stretch_width",
            css_classes=["numbers"],
            stylesheets=[STYLE],
            disable_math=True,
        )
        self.choose(_busiest(picture))
        self.regions = self._region_choice()

    def choose(self, region: int) -> None:
        """Select the region whose curves are shown; `trace` draws them."""
        self.region = region
        for one in self.maps:
            one.choose(region)
        self.curves.choose(region)

    def show(self, frames: Sequence[Frame | None], time: float) -> None:
        """Draw maps and numbers at a time [s].

        frames: one of every run, None before its first one
        """
        for one, frame in zip(self.maps, frames, strict=True):
            if frame is not None:
                one.show(frame)
        for load in self.loads:
            load.now.location = time / MINUTE
        self.curves.mark(time)
        self.numbers.text = numbers(self.tones, frames, time)

    def trace(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """Draw the curves from the whole frames of every run.

        time: to mark [s]
        """
        for load, whole in zip(self.loads, runs, strict=True):
            load.show(whole)
        self.curves.show(runs, time)

    def layout(self, bar: Sequence[LayoutDOM]) -> LayoutDOM:
        """Return the page as one model, with `bar` above it."""
        curves = self.curves
        for n, one in enumerate(self.maps):
            one.plot.name = f"map{n}"
        curves.plane.name = "plane"
        curves.trips.name = "trips"
        self.numbers.name = "numbers"
        above = _row(bar)
        above.update(css_classes=["bar"], stylesheets=[STYLE])
        of_region = [curves.region, curves.plane]
        of_city = [curves.gates, curves.trips, curves.spent]
        maps: list[LayoutDOM] = [one.plot for one in self.maps]
        if len(maps) > 1:
            of_city = of_region + of_city
        else:  # there is room beside the only map
            maps.append(column(*of_region, sizing_mode="stretch_width"))
        return column(
            above,
            _wrapped(maps),
            Div(text=KEY, css_classes=["key"], stylesheets=[STYLE]),
            self.numbers,
            _wrapped([load.plot for load in self.loads]),
            _wrapped(of_city),
            sizing_mode="stretch_width",
        )

    def _layer_choice(self) -> Select:
        """Return the menu that chooses the layer of all maps."""
        labels = list(self.maps[0].layers)
        menu = Select(
            title="Streets by", name="streets", width=210, value=labels[0], options=labels
        )
        layers: list[list[Any]] = []
        for one in self.maps:
            layers.extend([label, parts] for label, parts in one.layers.items())
        menu.js_on_change("value", CustomJS.from_file(HERE / "layers.js", layers=layers))
        return menu

    def _region_choice(self) -> Select:
        """Return the menu of the regions."""
        options = []
        for n, name in enumerate(self.picture.region_names):
            label = name if name == str(n) else f"{n} {name}"
            options.append((str(n), label))
        return Select(
            title="Region", name="region", width=150, value=str(self.region), options=options
        )


@dataclass
class Film:
    """Recorded values of sources, a row for every choice of a widget.

    tables: [source, its rows, names of its recorded columns], for slider.js
    """

    tables: list[list[Any]] = field(default_factory=list)

    def add(self, source: ColumnDataSource, names: Sequence[str]) -> None:
        """Record these columns of a source from now on."""
        rows = ColumnDataSource({name: [] for name in names})
        self.tables.append([source, rows, list(names)])

    def record(self) -> None:
        """Add the present values of the sources as a row."""
        for source, rows, names in self.tables:
            for name in names:
                values = source.data[name]
                rows.data[name].append(values.copy())


def with_slider(
    picture: CityPicture,
    runs: Mapping[str, Sequence[Frame]],
    tones: Mapping[str, str],
    totals: Mapping[str, Any] = {},
) -> LayoutDOM:
    """Return the page of finished runs, which needs no server.

    It starts where two runs differ most while vehicles drive in both, or where one has most
    vehicles.

    runs: whole frames by name
    tones: colours of these and perhaps others
    totals: as in `Page`
    """
    page = Page(picture, {name: tones[name] for name in runs}, totals)
    whole = list(runs.values())
    longest = max(map(len, whole))
    # The last frame of shorter runs stays.
    padded = [[*frames, *[frames[-1]] * (longest - len(frames))] for frames in whole]
    begin = _begin(padded)
    over_time = Film()
    for one in page.maps:
        over_time.add(one.streets, ["density"])
        for gates in one.gates:
            over_time.add(gates.source, ["end", "green", "queue", "halo"])
    words = []
    for k in range(longest):
        page.show([frames[k] for frames in padded], k * picture.step)
        over_time.record()
        words.append(page.numbers.text)
    of_region = Film()
    for one in page.maps:
        of_region.add(one.regions, ["width", "line"])
    for line in page.curves.lines:
        of_region.add(line, OF_REGION)
    of_region.add(page.curves.critical, ["x", "y"])
    of_region.add(page.curves.mfd, ["x", "y"])
    texts: list[list[PlainText]] = [[] for _ in page.curves.titles]
    first = page.region
    for region in range(picture.regions):
        page.choose(region)
        page.trace(whole, begin * picture.step)
        of_region.record()
        for title, of_title in zip(page.curves.titles, texts, strict=True):
            of_title.append(title.text)
    page.choose(first)
    page.trace(whole, begin * picture.step)
    page.show([frames[begin] for frames in padded], begin * picture.step)

    step = picture.step / MINUTE
    slider = Slider(
        start=0.0,
        end=(longest - 1) * step,
        value=begin * step,
        step=step,
        title="time [min]",
        name="time",
        sizing_mode="stretch_width",
        styles={"flex": "1 1 200px"},
    )
    callback = CustomJS.from_file(
        HERE / "slider.js",
        slider=slider,
        region=page.regions,
        film=over_time.tables,
        choices=of_region.tables,
        titles=page.curves.titles,
        texts=texts,
        numbers=page.numbers,
        words=words,
        present=page.curves.present,
        spans=[*(load.now for load in page.loads), *page.curves.now],
    )
    slider.js_on_change("value", callback)
    page.regions.js_on_change("value", callback)
    for load in page.loads:
        load.plot.js_on_event("tap", CustomJS(args={"slider": slider}, code=TO_TIME))
    play = Toggle(label="Play", name="play", width=90, button_type="primary")
    playing = CustomJS.from_file(HERE / "play.js", slider=slider, period=PLAY_PERIOD_MS)
    play.js_on_change("active", playing)
    bar = [play, slider, page.regions]
    if totals:
        bar.append(page.streets)
    return page.layout(bar)


def numbers(tones: Mapping[str, str], frames: Sequence[Frame | None], time: float) -> str:
    """Return the totals of the runs at a time [s], as an HTML table."""
    heads = "".join(f"<td class=head>{head}</td>" for head in HEADS)
    lines = [f"<tr><th class=time>{time / MINUTE:.1f} min</th>{heads}</tr>"]
    for (name, colour), frame in zip(tones.items(), frames, strict=True):
        cells = "" if frame is None else _cells(frame)
        mark = f"<span style='color:{colour}'>■</span>"
        lines.append(f"<tr><th>{mark} {escape(name)}</th>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>"


def _cells(frame: Frame) -> str:
    """Return the cells of a run, one for each of HEADS and the warning."""
    totals = (
        frame.accumulation.sum(),
        frame.waiting,
        frame.completed,
        frame.time_spent / HOUR,
        frame.removed,
    )
    cells = "".join(f"<td>{value:,.0f}</td>" for value in totals)
    return f"{cells}<td class=note>{escape(frame.note[:200])}</td>"


def _titles(names: Sequence[str]) -> list[str]:
    """Return the names, short if they still differ then."""
    short = []
    for name in names:
        if len(name) > LONGEST:
            name = f"{name[:14]}…{name[15 - LONGEST :]}"
        short.append(name)
    return short if len(set(short)) == len(short) else list(names)


def _maps(
    picture: CityPicture, titles: Sequence[str], totals: Mapping[str, Sequence[PerEdge]]
) -> list[CityMap]:
    """Return a map of every run; all have the same scales."""
    tops = {}
    for label, values in totals.items():
        # Only TOP_SHARE of the values of all runs is above a scale; its end has two digits.
        upper = np.quantile(np.concatenate(values), 1.0 - TOP_SHARE)
        tops[label] = float(f"{upper:.2g}") or 1.0
    maps: list[CityMap] = []
    for n, title in enumerate(titles):
        layers = {label: Layer(values[n], tops[label]) for label, values in totals.items()}
        maps.append(CityMap(picture, title, layers, maps[0] if maps else None))
    return maps


def _busiest(picture: CityPicture) -> int:
    """Return the region with most gates into it or out of it."""
    ends: list[int] = []
    for gate in picture.gates:
        ends += [gate.source, gate.target]
    return int(np.bincount(ends, minlength=1).argmax())


def _begin(runs: Sequence[Sequence[Frame]]) -> int:
    """Return the number of the frames where the page starts."""
    inside = np.array([[frame.accumulation.sum() for frame in frames] for frames in runs])
    worth = inside[0]
    if len(runs) > 1:
        worth = np.ptp(inside, axis=0) * inside.min(axis=0)
    return int(np.argmax(worth))


def _wrapped(parts: Sequence[LayoutDOM]) -> LayoutDOM:
    """Return plots in a row that breaks into several on a narrow screen."""
    for part in parts:
        part.styles = {"flex": f"1 1 {NARROWEST}px", "min-width": "0", "max-width": "760px"}
    return _row(parts)


def _row(parts: Sequence[LayoutDOM]) -> LayoutDOM:
    return row(*parts, sizing_mode="stretch_width", styles={"flex-wrap": "wrap", "gap": "8px 14px"})
