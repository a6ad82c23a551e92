"""Curves beside the map.

They are the load of all regions; accumulation, MFD plane and gates of one; totals of the city.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import (
    CDSView,
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    IndexFilter,
    LinearColorMapper,
    PlainText,
    Plot,
    Span,
    Title,
)
from bokeh.plotting import figure

from cosim.view import colours
from cosim.view.city_map import colour_bar, mean
from cosim.view.picture import CityPicture, Frame

CURVE_HEIGHT = 230  # pixels
DARKEST_LOAD = 2.0  # critical accumulations
HOUR = 3600.0  # s
MINUTE = 60.0  # s
MARKERS = ("circle", "square")  # of the runs side by side
OF_REGION = ("accumulation", "outflow", "u", "green")  # columns that depend on the region shown
COLUMNS = ("time", *OF_REGION, "completed", "spent")  # of a run, a row per whole frame


class Load:
    """Load of every region of one run over time, as a raster.

    Load is accumulation over critical accumulation.
    """

    def __init__(self, picture: CityPicture, title: str):
        self._picture = picture
        # A critical accumulation that was not seen is replaced by that of the model.
        peaks = [curve[curve[:, 1].argmax(), 0] for curve in picture.curves]
        self._critical = np.where(np.isnan(picture.critical), peaks, picture.critical)
        horizon = picture.steps * picture.step / MINUTE
        height = 130 + 18 * min(picture.regions, 12)
        self.plot = _figure(title, "time [min]", "region", height)
        self.plot.y_range.start = picture.regions - 0.5
        self.plot.y_range.end = -0.5
        self.plot.x_range.start = 0.0
        self.plot.x_range.end = horizon
        self.plot.yaxis.ticker = FixedTicker(ticks=list(range(picture.regions)))
        self.plot.grid.visible = False
        self._source = ColumnDataSource({"image": [self._values([])]})
        mapper = LinearColorMapper(
            palette=colours.SCALE, low=0.0, high=DARKEST_LOAD, nan_color=colours.LAND
        )
        place = {"x": 0.0, "y": -0.5, "dw": horizon, "dh": picture.regions}
        self.plot.image("image", source=self._source, color_mapper=mapper, **place)
        scale = colour_bar(mapper, "accumulation / critical of the model [-]", [0.0, 1.0, 2.0])
        self.plot.add_layout(scale, "below")
        self.now = _now(self.plot)

    def show(self, whole: Sequence[Frame]) -> None:
        """Draw the frames at the ends of the control intervals so far."""
        self._source.data = {"image": [self._values(whole)]}

    def _values(self, whole: Sequence[Frame]) -> np.ndarray:
        values = np.full((self._picture.regions, self._picture.steps), np.nan, np.float32)
        for frame in whole[1:]:
            values[:, frame.intervals - 1] = frame.accumulation / self._critical
        return values


class Curves:
    """All runs in one set of axes, for one region and for the whole city.

    lines: one source per run, with COLUMNS
    present: filters for the large point in the MFD plane
    titles: of the plots that name the region
    """

    def __init__(self, picture: CityPicture, tones: Mapping[str, str]):
        """tones: name of a run -> its colour"""
        self._picture = picture
        self._horizon = picture.steps * picture.step / MINUTE
        self.region = _figure("", "time [min]", "accumulation [veh]")
        self.plane = _figure("", "accumulation [veh]", "outflow [veh/s]")
        self.gates = _figure("", "time [min]", "share [-]")
        self.trips = _figure("Completed trips", "time [min]", "trips [veh]")
        self.spent = _figure("Total time spent", "time [min]", "time spent [veh h]")
        over_time = (self.region, self.gates, self.trips, self.spent)
        for plot in over_time:
            plot.x_range.start = 0.0
            plot.x_range.end = self._horizon
        self.gates.y_range.start = -0.04
        self.gates.y_range.end = 1.08
        self.critical = ColumnDataSource({"x": [], "y": []})
        self.mfd = ColumnDataSource({"x": [], "y": []})
        dotted = {"color": colours.INK, "line_dash": "dotted", "legend_label": "critical"}
        self.region.line("x", "y", source=self.critical, **dotted)
        thick = {"color": colours.FAINT, "line_width": 2, "legend_label": "MFD of the model"}
        self.plane.line("x", "y", source=self.mfd, **thick)
        self.lines: list[ColumnDataSource] = []
        self.present: list[IndexFilter] = []
        for n, (name, colour) in enumerate(tones.items()):
            self._add_run(n, name, colour)
        for plot in (self.region, self.gates, self.plane):
            legend = plot.legend[0]
            legend.update(
                location="left",
                margin=0,
                spacing=0,
                padding=2,
                label_text_font_size="11px",
                border_line_alpha=0.0,
            )
            plot.add_layout(legend, "below")
        self.titles = [self.region.title, self.plane.title, self.gates.title]
        self.now = [_now(plot) for plot in over_time]

    def choose(self, region: int) -> None:
        """Select the region of the curves; `show` draws it."""
        picture = self._picture
        self._region = region
        self._gateways: list[int] = []
        sources = set()
        for gate in picture.gates:
            if gate.target == region:
                self._gateways.extend(gate.gateways)
                if gate.signal:
                    sources.add(gate.source)
        self._sources = sorted(sources)
        subjects = ("accumulation", "MFD plane", "gates into it, mean")
        name = f"Region {region}, {picture.region_names[region]}"
        for title, subject in zip(self.titles, subjects, strict=True):
            title.text = PlainText(f"{name}: {subject}")
        level = float(picture.critical[region])
        self.critical.data = {"x": [0.0, self._horizon], "y": [level, level]}
        accumulation, outflow = np.asarray(picture.curves[region], np.float32).T
        self.mfd.data = {"x": accumulation, "y": outflow}

    def show(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """Draw the whole frames of every run.

        time: to mark in the MFD plane [s]
        """
        for n, whole in enumerate(runs):
            self.lines[n].data = self._columns(whole)
            past = [frame for frame in whole if frame.time <= time]
            last = len(past) - 1
            self.present[n].indices = [last] if last > 0 else []

    def mark(self, time: float) -> None:
        """Draw a line at a time [s]."""
        for now in self.now:
            now.location = time / MINUTE

    def _columns(self, whole: Sequence[Frame]) -> dict[str, np.ndarray]:
        """Return COLUMNS of a run, a row per frame."""
        region = self._region
        rows = np.zeros((len(whole), len(COLUMNS)), np.float32)
        for row, frame in zip(rows, whole, strict=True):
            row[:] = (
                frame.time / MINUTE,
                frame.accumulation[region],
                frame.outflow[region],
                mean(frame.perimeter[self._sources, region]),
                mean(frame.green[self._gateways]),
                frame.completed,
                frame.time_spent / HOUR,
            )
        return dict(zip(COLUMNS, rows.T.copy(), strict=True))

    def _add_run(self, n: int, name: str, colour: str) -> None:
        source = ColumnDataSource(dict.fromkeys(COLUMNS, np.zeros(0, np.float32)))
        line = {"source": source, "color": colour, "line_dash": colours.DASHES[n], "line_width": 2}
        self.region.line("time", "accumulation", legend_label=name, **line)
        self.trips.line("time", "completed", **line)
        self.spent.line("time", "spent", **line)
        self.gates.step("time", "u", mode="before", legend_label=f"u, {name}", **line)
        point = {"source": source, "marker": MARKERS[n], "line_color": colour}
        hollow = {"size": 5, "fill_color": colours.PAPER}
        self.gates.scatter("time", "green", legend_label=f"green, {name}", **hollow, **point)
        present = IndexFilter(indices=[])
        large = {"view": CDSView(filter=present), "size": 12, "legend_label": name}
        point |= {"x": "accumulation", "y": "outflow", "fill_color": colour}
        self.plane.scatter(size=4, alpha=0.4, **point)
        self.plane.scatter(**large, **point)
        self.lines.append(source)
        self.present.append(present)


def _figure(title: str, x: str, y: str, height: int = CURVE_HEIGHT) -> Plot:
    """Return an empty plot; x, y: labels of its axes."""
    plot = figure(
        title=Title(text=PlainText(title)),
        height=height,
        x_axis_label=x,
        y_axis_label=y,
        frame_align=False,
        tools="",
        toolbar_location=None,
        outline_line_color=None,
        sizing_mode="stretch_width",
    )
    plot.axis.axis_label_text_color = colours.FAINT
    plot.axis.major_label_text_color = colours.FAINT
    plot.axis.axis_line_color = colours.LINE
    plot.axis.major_tick_line_color = colours.LINE
    plot.grid.grid_line_color = colours.LINE
    plot.add_tools(HoverTool(tooltips=[(x, "$x{0.0}"), (y, "$y{0.00}")]))
    return plot


def _now(plot: Plot) -> Span:
    """Add a line at a time to a plot."""
    span = Span(location=0.0, dimension="height", line_color=colours.INK, line_width=1)
    plot.add_layout(span)
    return span
