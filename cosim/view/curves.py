"""The curves beside the map: load of all regions, accumulation, MFD plane and perimeter of one,
totals of the city."""

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import (
    CDSView,
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    IndexFilter,
    LinearColorMapper,
    Plot,
    Span,
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


class Load:
    """Accumulation over critical accumulation of every region of one run over time, as a raster."""

    def __init__(self, picture: CityPicture, title: str):
        self._picture = picture
        peaks = [curve[curve[:, 1].argmax(), 0] for curve in picture.curves]
        self._critical = np.where(np.isnan(picture.critical), peaks, picture.critical)
        horizon = picture.steps * picture.step / MINUTE
        self.plot = _figure(
            title, "time [min]", "region", height=130 + 18 * min(picture.regions, 12)
        )
        self.plot.y_range.start, self.plot.y_range.end = picture.regions - 0.5, -0.5
        self.plot.x_range.start, self.plot.x_range.end = 0.0, horizon
        self.plot.yaxis.ticker = FixedTicker(ticks=list(range(picture.regions)))
        self.plot.grid.visible = False
        self._source = ColumnDataSource({"image": [self._values([])]})
        mapper = LinearColorMapper(
            palette=colours.SCALE, low=0.0, high=DARKEST_LOAD, nan_color=colours.LAND
        )
        place = {"x": 0.0, "y": -0.5, "dw": horizon, "dh": picture.regions}
        self.plot.image("image", source=self._source, color_mapper=mapper, **place)
        self.plot.add_layout(
            colour_bar(mapper, "accumulation / critical of the model [-]", [0.0, 1.0, 2.0]), "below"
        )
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

    lines: one source per run, a row per whole frame; present: filters for the large point in the
        MFD plane
    """

    def __init__(self, picture: CityPicture, tones: Mapping[str, str]):
        """tones: name of a run -> its colour"""
        self._picture = picture
        self.region = _figure("", "time [min]", "accumulation [veh]")
        self.plane = _figure("", "accumulation [veh]", "outflow [veh/s]")
        self.gates = _figure("", "time [min]", "share [-]")
        self.trips = _figure("Completed trips", "time [min]", "trips [veh]")
        self.spent = _figure("Total time spent", "time [min]", "time spent [veh h]")
        over_time = (self.region, self.gates, self.trips, self.spent)
        for plot in over_time:
            plot.x_range.start, plot.x_range.end = 0.0, picture.steps * picture.step / MINUTE
        self.gates.y_range.start, self.gates.y_range.end = -0.04, 1.08
        self.critical, self.mfd = (ColumnDataSource({"x": [], "y": []}) for _ in range(2))
        self.region.line(
            "x",
            "y",
            source=self.critical,
            color=colours.INK,
            line_dash="dotted",
            legend_label="critical",
        )
        self.plane.line(
            "x",
            "y",
            source=self.mfd,
            color=colours.FAINT,
            line_width=2,
            legend_label="MFD of the model",
        )
        self.lines: list[ColumnDataSource] = []
        self.present: list[IndexFilter] = []
        for n, (name, colour) in enumerate(tones.items()):
            self._add_run(n, name, colour)
        for plot in (self.region, self.gates, self.plane):
            style = {"label_text_font_size": "11px", "border_line_alpha": 0.0}
            plot.legend[0].update(location="left", margin=0, spacing=0, padding=2, **style)
            plot.add_layout(plot.legend[0], "below")
        self.titles = [
            plot.title for plot in (self.region, self.plane, self.gates)
        ]  # they name the region
        self.now = [_now(plot) for plot in over_time]

    def choose(self, region: int) -> None:
        """Select the region of the curves; `show` draws it."""
        self._region = region
        self._gateways = [
            n for gate in self._picture.gates if gate.target == region for n in gate.gateways
        ]
        self._sources = sorted(
            {gate.source for gate in self._picture.gates if gate.target == region and gate.signal}
        )
        name = f"Region {region}, {self._picture.region_names[region]}"
        for title, text in zip(
            self.titles, ("accumulation", "MFD plane", "gates into it, mean"), strict=True
        ):
            title.text = f"{name}: {text}"
        horizon, level = (
            self._picture.steps * self._picture.step / MINUTE,
            float(self._picture.critical[region]),
        )
        self.critical.data = {"x": [0.0, horizon], "y": [level, level]}
        self.mfd.data = dict(
            zip("xy", np.asarray(self._picture.curves[region], np.float32).T, strict=True)
        )

    def show(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """Draw the whole frames of every run, and mark the time [s] in the MFD plane."""
        for n, whole in enumerate(runs):
            values = {
                "time": [frame.time / MINUTE for frame in whole],
                "accumulation": [frame.accumulation[self._region] for frame in whole],
                "outflow": [frame.outflow[self._region] for frame in whole],
                "u": [mean(frame.perimeter[self._sources, self._region]) for frame in whole],
                "green": [mean(frame.green[self._gateways]) for frame in whole],
                "completed": [frame.completed for frame in whole],
                "spent": [frame.time_spent / HOUR for frame in whole],
            }
            self.lines[n].data = {
                name: np.array(column, np.float32) for name, column in values.items()
            }
            last = sum(frame.time <= time for frame in whole) - 1
            self.present[n].indices = [last] if last > 0 else []

    def mark(self, time: float) -> None:
        """Draw a line at a time [s]."""
        for now in self.now:
            now.location = time / MINUTE

    def _add_run(self, n: int, name: str, colour: str) -> None:
        dash, marker = colours.DASHES[n], MARKERS[n]
        columns = ("time", *OF_REGION, "completed", "spent")
        source = ColumnDataSource({column: np.zeros(0, np.float32) for column in columns})
        style = {"source": source, "color": colour, "line_dash": dash, "line_width": 2}
        self.region.line("time", "accumulation", legend_label=name, **style)
        self.trips.line("time", "completed", **style)
        self.spent.line("time", "spent", **style)
        self.gates.step("time", "u", mode="before", legend_label=f"u, {name}", **style)
        present = IndexFilter(indices=[])
        points = {"source": source, "marker": marker, "line_color": colour}
        self.gates.scatter(
            "time",
            "green",
            size=5,
            fill_color=colours.PAPER,
            legend_label=f"green, {name}",
            **points,
        )
        points |= {"x": "accumulation", "y": "outflow", "fill_color": colour}
        self.plane.scatter(size=4, alpha=0.4, **points)
        self.plane.scatter(view=CDSView(filter=present), size=12, legend_label=name, **points)
        self.lines.append(source)
        self.present.append(present)


def _figure(title: str, x: str, y: str, height: int = CURVE_HEIGHT) -> Plot:
    bare = {
        "tools": "",
        "toolbar_location": None,
        "outline_line_color": None,
        "sizing_mode": "stretch_width",
    }
    plot = figure(
        title=title, height=height, x_axis_label=x, y_axis_label=y, frame_align=False, **bare
    )
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = colours.FAINT
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = plot.grid.grid_line_color = (
        colours.LINE
    )
    plot.add_tools(HoverTool(tooltips=[(x, "$x{0.0}"), (y, "$y{0.00}")]))
    return plot


def _now(plot: Plot) -> Span:
    """Add a line at a time to a plot."""
    span = Span(location=0.0, dimension="height", line_color=colours.INK, line_width=1)
    plot.add_layout(span)
    return span
