"""The map of a city: streets in the colour of what they do, regions with their numbers, gateways with their green."""

from functools import lru_cache

import numpy as np
from bokeh.core.serialization import AnyRep, Serializable, Serializer
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    PanTool,
    Plot,
    ResetTool,
    ScaleBar,
    TapTool,
    WheelZoomTool,
)
from bokeh.plotting import figure

from cosim.sumo.arrays import PerGateway
from cosim.view import colours
from cosim.view.picture import CityPicture, Frame

JAM_DENSITY = 1000.0 / 7.5  # veh/km and lane
DENSITY, SPEED = "density", "speed"
LABELS = {DENSITY: "density [veh/km and lane]", SPEED: "speed, share of what is allowed [-]"}
SIDE = 0.006  # of the map's width: how far the lines of the two directions of a street are drawn apart
HEIGHT = 500  # pixels
RADII = ((60, 6.0), (150, 4.5), (10**9, 3.5))  # up to so many gates, pixels of each
WIDEST = 9.0  # pixels, of an arrow
NOTHING = -1.0  # where a street has no value


class Encoded(list, Serializable):
    """A column that is the same in all documents, encoded once: else that is most of what a page costs."""

    def to_serializable(self, serializer: Serializer) -> AnyRep:
        """What Bokeh asks for."""
        if not hasattr(self, "_rep"):
            alone = Serializer(deferred=False)
            self._rep = [alone.encode(item) for item in self]
        return self._rep


@lru_cache(maxsize=4)
def street_columns(picture: CityPicture) -> dict[str, Encoded]:
    """The lines of the streets, each to the right of its middle, and their names."""
    apart = SIDE * float(np.ptp(np.concatenate(picture.shapes)[:, 0]))
    lines = [_to_the_right(shape, apart) for shape in picture.shapes]
    return {
        "xs": Encoded(_floats(line[:, 0]) for line in lines),
        "ys": Encoded(_floats(line[:, 1]) for line in lines),
        "edge": Encoded(picture.edges),
    }


class CityMap:
    """One run on the map. `show` sets it to a frame; what it needs for that are the sources, and no server."""

    def __init__(self, picture: CityPicture, title: str):
        """Streets are coloured by density at first."""
        self._picture, self._by = picture, DENSITY
        self._radius = next(radius for most, radius in RADII if len(picture.gates) <= most)
        self.plot = plot = figure(
            height=HEIGHT,
            sizing_mode="stretch_width",
            match_aspect=True,
            title=title,
            tools="",
            toolbar_location=None,
            background_fill_color=colours.PAPER,
            outline_line_color=None,
            lod_threshold=None,
        )
        plot.axis.visible = plot.grid.visible = False
        wheel, pan = WheelZoomTool(), PanTool()
        plot.add_tools(pan, wheel, ResetTool())
        plot.toolbar.active_scroll = wheel
        self.regions = self._regions(plot)
        self.streets = self._streets(plot)
        self.arrows = self._guidance(plot)
        self.gates = self._gateways(plot)
        plot.add_tools(TapTool(renderers=self._clicked))  # one for all of them: of several only one is active
        _numbers(plot, picture)
        plot.add_layout(
            ScaleBar(
                range=plot.x_range,
                unit="m",
                location="bottom_left",
                bar_length=0.15,
                background_fill_alpha=0.0,
                border_line_alpha=0.0,
                label_text_color=colours.FAINT,
                bar_line_color=colours.FAINT,
                label_text_font_size="11px",
            )
        )

    def show(self, frame: Frame, by: str = DENSITY, held: frozenset[tuple[int, int]] = frozenset()) -> None:
        """by: DENSITY or SPEED, the colour of the streets; held: gates (i, h) that were switched by hand"""
        if by != self._by:
            self._by = by
            self._drawn.glyph.line_color = {"field": "value", "transform": self._bars[by].color_mapper}
            for name, bar in self._bars.items():
                bar.visible = name == by
        value = np.nan_to_num((frame.speed if by == SPEED else frame.density).astype(np.float32), nan=NOTHING)
        self.streets.patch({"value": [(slice(len(value)), value)]})
        self._show_gates(frame, held)
        self._show_guidance(frame)

    def choose(self, region: int) -> None:
        """Mark a region."""
        of = self.regions.data["region"]
        self.regions.patch(
            {
                "width": [(slice(len(of)), np.where(np.asarray(of) == region, 2.5, 1.0).astype(np.float32))],
                "line": [(slice(len(of)), [colours.CHOSEN if r == region else colours.FAINT for r in of])],
                "fill": [(slice(len(of)), [colours.CHOSEN_LAND if r == region else colours.LAND for r in of])],
            }
        )

    def choose_street(self, street: int) -> None:
        """Mark a street."""
        columns = street_columns(self._picture)
        self.chosen.data = {name: [columns[name][street]] for name in ("xs", "ys")}

    def _regions(self, plot: Plot) -> ColumnDataSource:
        picture = self._picture
        rings = [(r, ring) for r, found in enumerate(picture.outlines) for ring in found]
        source = ColumnDataSource(
            {
                "xs": [_floats(ring[:, 0]) for _, ring in rings],
                "ys": [_floats(ring[:, 1]) for _, ring in rings],
                "region": [r for r, _ in rings],
                "name": [picture.region_names[r] for r, _ in rings],
                "width": np.ones(len(rings), np.float32),
                "line": [colours.FAINT] * len(rings),
                "fill": [colours.LAND] * len(rings),
            }
        )
        drawn = plot.patches(
            "xs",
            "ys",
            source=source,
            fill_color="fill",
            line_color="line",
            line_width="width",
            nonselection_fill_alpha=1.0,
            nonselection_line_alpha=1.0,
        )
        self._clicked = [drawn]
        return source

    def _streets(self, plot: Plot) -> ColumnDataSource:
        picture = self._picture
        many = len(picture.edges) > 2000
        source = ColumnDataSource(
            {
                **street_columns(picture),
                "value": np.zeros(len(picture.edges), np.float32),
                "width": ((0.8 if many else 1.6) + (0.4 if many else 0.9) * picture.lanes).astype(np.float32),
            }
        )
        self._bars = {by: _bar(by) for by in LABELS}
        self.chosen = ColumnDataSource({"xs": [], "ys": []})
        plot.multi_line(
            "xs", "ys", source=self.chosen, line_width=12, color=colours.CHOSEN, alpha=0.5, line_cap="round"
        )
        self._drawn = plot.multi_line(
            "xs",
            "ys",
            source=source,
            line_width="width",
            line_cap="round",
            nonselection_line_alpha=1.0,
            line_color={"field": "value", "transform": self._bars[DENSITY].color_mapper},
        )
        self._clicked.append(self._drawn)
        plot.add_tools(HoverTool(renderers=[self._drawn], tooltips=[("street", "@edge"), ("value", "@value{0.00}")]))
        for bar in self._bars.values():
            plot.add_layout(bar, "below")
        return source

    def _gateways(self, plot: Plot) -> ColumnDataSource:
        gates = self._picture.gates
        places = np.array([gate.place for gate in gates]).reshape(-1, 2)
        signal = np.array([gate.signal for gate in gates], dtype=bool)
        source = ColumnDataSource(
            {
                "x": _floats(places[:, 0]),
                "y": _floats(places[:, 1]),
                "way": [f"{gate.source} → {gate.target}" for gate in gates],
                "end": np.full(len(gates), _end(1.0), np.float32),
                "green": ["all"] * len(gates),
                "queue": np.zeros(len(gates), np.float32),
                "halo": np.zeros(len(gates), np.float32),
                "size": np.where(signal, 2.0 * self._radius + 2.0, self._radius).astype(np.float32),
                "radius": np.where(signal, self._radius, 0.0).astype(np.float32),
                "rim": [colours.INK if one else colours.FAINT for one in signal],
                "rim_width": np.ones(len(gates), np.float32),
            }
        )
        plot.scatter(
            "x",
            "y",
            size="halo",
            source=source,
            color=colours.QUEUE,
            alpha=0.3,
            line_color=None,
            nonselection_alpha=0.3,
        )
        discs = plot.scatter(
            "x",
            "y",
            size="size",
            source=source,
            fill_color=colours.GONE,
            line_color="rim",
            line_width="rim_width",
            nonselection_alpha=1.0,
        )
        plot.wedge(
            "x",
            "y",
            radius="radius",
            radius_units="screen",
            start_angle=np.pi / 2,
            end_angle="end",
            direction="clock",
            source=source,
            color=colours.GREEN,
            line_color=None,
            nonselection_alpha=1.0,
        )
        self._clicked.append(discs)
        plot.add_tools(
            HoverTool(
                renderers=[discs],
                tooltips=[
                    ("gateway", "@way"),
                    ("green, share of the original", "@green"),
                    ("halting before it [veh]", "@queue{0.0}"),
                ],
            )
        )
        return source

    def _show_gates(self, frame: Frame, held: frozenset[tuple[int, int]]) -> None:
        gates = self._picture.gates
        share, queue = mean_of_gates(self._picture, frame.green), mean_of_gates(self._picture, frame.queue)
        whole = np.nan_to_num(np.clip(share, 0.0, 1.0), nan=1.0)
        by_hand = [(gate.source, gate.target) in held for gate in gates]
        every = slice(len(gates))
        if not gates:
            return
        halo = np.where(queue >= 0.5, 2.0 * self._radius + 4.0 * np.sqrt(queue), 0.0)
        self.gates.patch(
            {
                "end": [(every, _end(whole).astype(np.float32))],
                "green": [(every, ["not controlled" if np.isnan(one) else f"{one:.0%}" for one in share])],
                "queue": [(every, queue.astype(np.float32))],
                "halo": [(every, halo.astype(np.float32))],
                "rim": [
                    (
                        every,
                        [
                            colours.HELD if by else (colours.INK if gate.signal else colours.FAINT)
                            for by, gate in zip(by_hand, gates, strict=True)
                        ],
                    )
                ],
                "rim_width": [(every, np.where(by_hand, 3.0, 1.0).astype(np.float32))],
            }
        )

    def _guidance(self, plot: Plot) -> ColumnDataSource:
        pairs = sorted({(gate.source, gate.target) for gate in self._picture.gates})
        places = self._picture.places
        columns: dict[str, list[float]] = {name: [] for name in ("x", "y", "x1", "y1", "angle")}
        for i, h in pairs:
            along = places[h] - places[i]
            aside = 0.05 * np.array([along[1], -along[0]])
            begin, end = places[i] + 0.3 * along + aside, places[i] + 0.7 * along + aside
            values = (*begin, *end, np.arctan2(along[1], along[0]) - np.pi / 2)
            for column, value in zip(columns.values(), values, strict=True):
                column.append(float(value))
        self._pairs = pairs
        zero = np.zeros(len(pairs), np.float32)
        source = ColumnDataSource({**columns, "width": zero, "head": zero, "guided": zero})
        plot.segment("x", "y", "x1", "y1", source=source, line_width="width", color=colours.GUIDED, alpha=0.55)
        heads = plot.scatter(
            "x1",
            "y1",
            marker="triangle",
            angle="angle",
            size="head",
            source=source,
            color=colours.GUIDED,
            line_color=None,
            alpha=0.8,
        )
        plot.add_tools(HoverTool(renderers=[heads], tooltips=[("guided that way [veh]", "@guided{0}")]))
        return source

    def _show_guidance(self, frame: Frame) -> None:
        if not self._pairs:
            return
        # Who was sent elsewhere when they were asked again counts there, and no more where they were sent before.
        guided = np.maximum([frame.guided[pair] for pair in self._pairs], 0.0)
        width = WIDEST * np.sqrt(guided / max(guided.max(), 1.0))
        every = slice(len(guided))
        self.arrows.patch(
            {
                "width": [(every, width.astype(np.float32))],
                "head": [(every, np.where(guided > 0, 6.0 + 1.5 * width, 0.0).astype(np.float32))],
                "guided": [(every, guided.astype(np.float32))],
            }
        )


def mean_of_gates(picture: CityPicture, values: PerGateway) -> np.ndarray:
    """Of every gate of the map the mean of its gateways' values (G,); NaN where they have none."""
    found = np.full(len(picture.gates), np.nan)
    for n, gate in enumerate(picture.gates):
        members = values[list(gate.gateways)]
        if not np.isnan(members).all():
            found[n] = np.nanmean(members)
    return found


def _numbers(plot: Plot, picture: CityPicture) -> None:
    x, y = _floats(picture.places[:, 0]), _floats(picture.places[:, 1])
    plot.scatter(x, y, size=24, fill_color=colours.PAPER, fill_alpha=0.9, line_color=colours.INK)
    plot.text(
        x,
        y,
        text=[str(r) for r in range(picture.regions)],
        text_align="center",
        text_baseline="middle",
        text_font_size="12px",
        text_font_style="bold",
        text_color=colours.INK,
    )


def _bar(by: str) -> ColorBar:
    """The scale of the streets; only that of density is there at first."""
    mapper = LinearColorMapper(
        palette=colours.scale(by == SPEED), low=0.0, high=1.0 if by == SPEED else JAM_DENSITY, low_color=colours.NOBODY
    )
    return ColorBar(
        color_mapper=mapper,
        title=LABELS[by],
        height=8,
        width=220,
        location=(0, 0),
        padding=4,
        visible=by == DENSITY,
        orientation="horizontal",
        ticker=FixedTicker(ticks=[0.0, 0.5, 1.0] if by == SPEED else [0.0, 50.0, 100.0]),
        title_text_font_style="normal",
        title_text_font_size="11px",
        title_text_color=colours.FAINT,
        major_label_text_font_size="11px",
        bar_line_color=None,
        major_tick_line_color=None,
    )


def _end(share: np.ndarray | float) -> np.ndarray:
    """The angle at which a wedge of `share` [-] ends that begins at the top and goes clockwise."""
    return np.asarray(np.pi / 2 - 2.0 * np.pi * np.minimum(share, 0.9999))


def _floats(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def _to_the_right(shape: np.ndarray, distance: float) -> np.ndarray:
    """The line moved sideways, as seen in its direction."""
    along = shape[-1] - shape[0]
    return shape + distance * np.array([along[1], -along[0]]) / max(np.hypot(*along), 1e-9)
