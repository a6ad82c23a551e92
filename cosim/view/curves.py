"""The curves beside the map: what regions hold over time, the MFD plane, a gate, and what came of it so far."""

from collections.abc import Sequence

import numpy as np
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    LinearAxis,
    LinearColorMapper,
    Plot,
    Range1d,
    Span,
)
from bokeh.plotting import figure

from cosim.view import colours
from cosim.view.picture import CityPicture, Frame

TRAIL = 30  # control intervals behind the present point in the MFD plane
HEIGHT = 230  # pixels
OVER = 2.0  # critical accumulations: the dark end of the scale of `Load`
HOUR = 3600.0
MINUTE = 60.0


class Load:
    """One run: accumulation against critical, of every region over time, as a table of colours."""

    def __init__(self, picture: CityPicture, title: str):
        """It is as wide as the whole horizon."""
        self._picture = picture
        self.plot = plot = _figure(title, "time [min]", "region", height=130 + 18 * min(picture.regions, 12))
        plot.y_range.start, plot.y_range.end = picture.regions - 0.5, -0.5
        plot.x_range.start, plot.x_range.end = 0.0, picture.steps * picture.step / MINUTE
        plot.yaxis.ticker = FixedTicker(ticks=list(range(picture.regions)))
        plot.grid.visible = False
        self._source = ColumnDataSource({"image": [self._values([])]})
        mapper = LinearColorMapper(palette=colours.scale(), low=0.0, high=OVER, nan_color=colours.LAND)
        plot.image(
            "image",
            x=0.0,
            y=-0.5,
            dw=picture.steps * picture.step / MINUTE,
            dh=picture.regions,
            source=self._source,
            color_mapper=mapper,
        )
        plot.add_layout(
            ColorBar(
                color_mapper=mapper,
                title="accumulation / critical [-]",
                orientation="horizontal",
                height=8,
                width=220,
                ticker=FixedTicker(ticks=[0.0, 1.0, 2.0]),
                title_text_font_style="normal",
                title_text_font_size="11px",
                title_text_color=colours.FAINT,
                bar_line_color=None,
                padding=4,
                location=(0, 0),
                major_tick_line_color=None,
            ),
            "below",
        )
        self.now = _now(plot)

    def show(self, whole: Sequence[Frame]) -> None:
        """whole: the frames at the ends of control intervals so far"""
        self._source.data = {"image": [self._values(whole)]}

    def _values(self, whole: Sequence[Frame]) -> np.ndarray:
        """(R, T), NaN where nothing was seen yet."""
        values = np.full((self._picture.regions, self._picture.steps), np.nan, np.float32)
        for frame in whole:
            if 0 < frame.intervals <= self._picture.steps:
                values[:, frame.intervals - 1] = frame.accumulation / self._picture.critical
        return values


class Curves:
    """All runs in one set of axes: of the chosen region and gate, and of the whole city."""

    def __init__(self, picture: CityPicture, names: Sequence[str]):
        """names: of the runs"""
        self._picture, self._names = picture, names
        horizon = picture.steps * picture.step / MINUTE
        self.region = _figure("", "time [min]", "accumulation [veh]")
        self.plane = _figure("", "accumulation [veh]", "outflow [veh/s]")
        self.gate = _figure("", "time [min]", "share [-]")
        self.trips = _figure("Completed trips", "time [min]", "trips [veh]")
        self.spent = _figure("Total time spent so far", "time [min]", "time spent [veh h]")
        self.street = _figure("", "time [min]", "density [veh/km and lane]")
        self.street.extra_y_ranges = {"speed": Range1d(0.0, 1.1)}
        self.street.add_layout(
            LinearAxis(
                y_range_name="speed",
                axis_label="speed / allowed [-]",
                axis_label_text_font_style="normal",
                axis_label_text_color=colours.FAINT,
                major_label_text_color=colours.FAINT,
                minor_tick_line_color=None,
                axis_line_color=colours.LINE,
                major_tick_line_color=colours.LINE,
            ),
            "right",
        )
        overtime = (self.region, self.gate, self.trips, self.spent, self.street)
        self.lines, self.points, self.trails = [], [], []
        for plot in overtime:
            plot.x_range.start, plot.x_range.end = 0.0, horizon
        self.gate.y_range.start, self.gate.y_range.end = -0.04, 1.08
        self.critical = ColumnDataSource({"x": [], "y": []})
        self.region.line(
            "x",
            "y",
            source=self.critical,
            color=colours.INK,
            line_dash="dotted",
            line_width=1.5,
            legend_label="critical",
        )
        self.curve = ColumnDataSource({"x": [], "y": []})
        self.plane.line("x", "y", source=self.curve, color=colours.FAINT, line_width=2, legend_label="fitted MFD")
        for n, name in enumerate(names):
            colour, dash = colours.RUNS[n]
            empty: dict[str, list[float]] = {
                key: []
                for key in ("time", "accumulation", "outflow", "u", "green", "completed", "spent", "density", "speed")
            }
            line = ColumnDataSource(empty)
            for plot, key in ((self.region, "accumulation"), (self.trips, "completed"), (self.spent, "spent")):
                plot.line("time", key, source=line, color=colour, line_dash=dash, line_width=2, legend_label=name)
            self.gate.step(
                "time",
                "u",
                source=line,
                color=colour,
                line_dash=dash,
                line_width=2,
                mode="before",
                legend_label=f"u, {name}",
            )
            self.gate.scatter(
                "time",
                "green",
                source=line,
                size=5,
                marker=("circle", "square")[n],
                line_color=colour,
                fill_color=colours.PAPER,
                legend_label=f"green, {name}",
            )
            self.street.line(
                "time",
                "density",
                source=line,
                color=colour,
                line_dash=dash,
                line_width=2,
                legend_label=f"density, {name}",
            )
            self.street.scatter(
                "time",
                "speed",
                source=line,
                y_range_name="speed",
                size=5,
                line_color=colour,
                marker=("circle", "square")[n],
                fill_color=colours.PAPER,
                legend_label=f"speed, {name}",
            )
            trail, point = ColumnDataSource({"x": [], "y": []}), ColumnDataSource({"x": [], "y": []})
            self.plane.line("x", "y", source=trail, color=colour, line_dash=dash, alpha=0.5, line_width=1.5)
            self.plane.scatter("x", "y", source=trail, color=colour, alpha=0.35, size=4)
            self.plane.scatter(
                "x",
                "y",
                source=point,
                color=colour,
                size=12,
                marker=("circle", "square")[n],
                line_color=colours.PAPER,
                legend_label=name,
            )
            self.lines.append(line)
            self.trails.append(trail)
            self.points.append(point)
        for plot in (*overtime, self.plane):
            _legend(plot)
        for plot in (self.gate, self.street):  # values are at the top and at the bottom: below them
            legend = plot.legend[0]
            legend.update(location="left", ncols=2, margin=0)
            plot.add_layout(legend, "below")
        self.choose_street(None)
        self.now = [_now(plot) for plot in overtime]

    def choose(self, region: int, gate: tuple[int, int] | None) -> None:
        """The region and the gate whose curves are shown."""
        picture = self._picture
        name, curve = picture.region_names[region], picture.curves[region]
        self._region, self._gate = region, gate
        self._members = [n for one in picture.gates if (one.source, one.target) == gate for n in one.gateways]
        self.region.title.text = f"Region {region}, {name}: accumulation"
        self.plane.title.text = f"Region {region}, {name}: MFD plane"
        self.gate.title.text = (
            "No gate with a signal" if gate is None else (f"Gate {gate[0]} → {gate[1]}: command and green")
        )
        self.critical.data = {
            "x": [0.0, picture.steps * picture.step / MINUTE],
            "y": [float(picture.critical[region])] * 2,
        }
        self.curve.data = {"x": curve[:, 0].astype(np.float32), "y": curve[:, 1].astype(np.float32)}

    def choose_street(self, street: int | None) -> None:
        """The street whose curves are shown."""
        self._street = street
        self.street.title.text = (
            "Click a street of the map"
            if street is None
            else (f"Street {self._picture.edges[street]}: density and speed")
        )

    def show(self, runs: Sequence[Sequence[Frame]], time: float) -> None:
        """runs: the whole frames of every run so far; time: [s], that is looked at"""
        for n, whole in enumerate(runs):
            later = [frame for frame in whole if frame.intervals]
            shares = [self._shares(frame) for frame in whole]
            self.lines[n].data = {
                "time": np.array([frame.time for frame in whole], np.float32) / MINUTE,
                "accumulation": np.array([frame.accumulation[self._region] for frame in whole], np.float32),
                "outflow": np.array([frame.outflow[self._region] for frame in whole], np.float32),
                "u": np.array([u for u, _ in shares], np.float32),
                "green": np.array([green for _, green in shares], np.float32),
                "completed": np.array([frame.completed for frame in whole], np.float32),
                "spent": np.array([frame.time_spent / HOUR for frame in whole], np.float32),
                # Zero where no street is chosen: of nothing at all Bokeh finds no range.
                **{
                    name: np.array(
                        [0.0 if self._street is None else getattr(frame, name)[self._street] for frame in whole],
                        np.float32,
                    )
                    for name in ("density", "speed")
                },
            }
            past = [frame for frame in later if frame.time <= time][-TRAIL:]
            x, y = (
                np.array(values, np.float32)
                for values in (
                    [frame.accumulation[self._region] for frame in past],
                    [frame.outflow[self._region] for frame in past],
                )
            )
            self.trails[n].data = {"x": x, "y": y}
            self.points[n].data = {"x": x[-1:], "y": y[-1:]}

    def mark(self, time: float) -> None:
        """A line at the time [s] that is looked at."""
        for now in self.now:
            now.location = time / MINUTE

    def _shares(self, frame: Frame) -> tuple[float, float]:
        """u, and the green of the chosen gate as a share of the original."""
        if self._gate is None or not frame.intervals:
            return float("nan"), float("nan")
        green = frame.green[self._members]
        return float(frame.perimeter[self._gate]), float(np.nanmean(green)) if not np.isnan(green).all() else (
            float("nan")
        )


def _figure(title: str, x: str, y: str, height: int = HEIGHT) -> Plot:
    plot = figure(
        title=title,
        height=height,
        sizing_mode="stretch_width",
        tools="",
        toolbar_location=None,
        x_axis_label=x,
        y_axis_label=y,
        outline_line_color=None,
        background_fill_color=colours.PAPER,
    )
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = colours.FAINT
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = colours.LINE
    plot.axis.minor_tick_line_color = None
    plot.grid.grid_line_color = colours.LINE
    plot.grid.grid_line_alpha = 0.6
    plot.title.text_font_size, plot.title.text_color = "13px", colours.INK
    plot.add_tools(HoverTool(tooltips=[(x, "$x{0.0}"), (y, "$y{0.00}")]))
    return plot


def _legend(plot: Plot) -> None:
    plot.legend.location, plot.legend.background_fill_alpha, plot.legend.border_line_alpha = "top_left", 0.75, 0.0
    plot.legend.label_text_font_size, plot.legend.spacing, plot.legend.padding = "11px", 0, 2


def _now(plot: Plot) -> Span:
    span = Span(location=0.0, dimension="height", line_color=colours.INK, line_width=1)
    plot.add_layout(span)
    return span
