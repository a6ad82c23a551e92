"""The map of one run: streets by density, regions with their numbers, gates with their green."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    CustomJS,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    ScaleBar,
)
from bokeh.plotting import figure
from bokeh.transform import linear_cmap

from cosim.sumo.arrays import Points
from cosim.sumo.net import JAM_SPACING
from cosim.view import colours
from cosim.view.picture import CityPicture, Frame, Gate

DENSITY = "density [veh/km and lane]"
DENSEST = 1000.0 / JAM_SPACING  # veh/km and lane
LINE_OFFSET = 0.006  # of the map's width, by which the two directions of a street are drawn apart
MAP_HEIGHT = 440  # pixels
GATE_RADIUS = 6.0  # pixels
CLOSER = (
    0.7  # of the map's extent: within so much every gate is shown, and further out every boundary
)


class CityMap:
    """One run on the map; `show` sets its sources to a frame.

    layers: label -> what shows the streets by this quantity; all but the first, DENSITY, are hidden
    """

    def __init__(
        self,
        picture: CityPicture,
        title: str,
        totals: Mapping[str, tuple],
        beside: "CityMap | None" = None,
    ):
        """totals: label -> values (E,) of other layers, and the upper end of their scale; beside:
        map to move with"""
        self._picture, self._totals = picture, totals
        self.layers: dict[str, list[Any]] = {}
        size = {
            "height": MAP_HEIGHT,
            "sizing_mode": "stretch_width",
            "match_aspect": True,
            "lod_threshold": None,
        }
        bare = {
            "tools": "pan,wheel_zoom,reset",
            "toolbar_location": None,
            "outline_line_color": None,
        }
        common = (
            {axis: getattr(beside.plot, axis) for axis in ("x_range", "y_range")} if beside else {}
        )
        self.plot: Any = figure(title=title, active_scroll="wheel_zoom", **size, **bare, **common)
        self.plot.axis.visible = self.plot.grid.visible = False
        self.regions = self._add_regions()
        self.streets = self._add_streets()
        both = picture.boundaries, picture.gates  # the former from afar, the latter closer
        self._members = [[list(gate.gateways) for gate in gates] for gates in both]
        (far, far_parts), (near, near_parts) = (self._add_gates(gates) for gates in both)
        self.gates = far, near
        self._add_numbers()
        for part in near_parts:
            part.visible = False
        limit = CLOSER * float(np.ptp(np.concatenate(picture.shapes), axis=0).max())
        code = CustomJS.from_file(
            Path(__file__).with_name("gates.js"), far=far_parts, near=near_parts, limit=limit
        )
        self.plot.x_range.js_on_change("end", code)

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        patch(self.streets, density=frame.density)
        for source, members in zip(self.gates, self._members, strict=True):
            share, queue = (
                np.array([mean(x[n]) for n in members]) for x in (frame.green, frame.queue)
            )
            patch(
                source,
                end=_wedge_end(np.nan_to_num(np.clip(share, 0.0, 1.0), nan=1.0)),
                green=["not controlled" if np.isnan(one) else f"{one:.0%}" for one in share],
                queue=queue,
                halo=np.where(queue >= 0.5, 2.0 * GATE_RADIUS + 4.0 * np.sqrt(queue), 0.0),
            )

    def choose(self, region: int) -> None:
        """Highlight a region."""
        marked = [r == region for r in self.regions.data["region"]]
        patch(
            self.regions,
            width=np.where(marked, 2.5, 1.0),
            line=[colours.CHOSEN if one else colours.FAINT for one in marked],
            fill=[colours.CHOSEN_LAND if one else colours.LAND for one in marked],
        )

    def _add_regions(self) -> ColumnDataSource:
        rings = [(r, ring) for r, outline in enumerate(self._picture.outlines) for ring in outline]
        source = _source(
            **_lines([ring for _, ring in rings]),
            region=[r for r, _ in rings],
            width=np.ones(len(rings)),
            line=[colours.FAINT] * len(rings),
            fill=[colours.LAND] * len(rings),
        )
        self.plot.patches(
            "xs", "ys", source=source, fill_color="fill", line_color="line", line_width="width"
        )
        return source

    def _add_streets(self) -> ColumnDataSource:
        picture = self._picture
        thin, per_lane = (0.8, 0.4) if len(picture.edges) > 2000 else (1.6, 0.9)  # pixels
        offset = LINE_OFFSET * float(np.ptp(np.concatenate(picture.shapes)[:, 0]))
        source = _source(
            **_lines([_to_the_right(shape, offset) for shape in picture.shapes]),
            edge=list(picture.edges),
            density=np.zeros(len(picture.edges)),
            width=thin + per_lane * picture.lanes,
            **{label: values for label, (values, _) in self._totals.items()},
        )
        self._add_layer(source, "density", DENSITY, DENSEST, [0.0, 50.0, 100.0])
        for label, (_, top) in self._totals.items():
            self._add_layer(source, label, label, top, [0.0, top / 2.0, top])
        return source

    def _add_layer(
        self, source: ColumnDataSource, column: str, label: str, top: float, ticks: list[float]
    ) -> None:
        shown, colour = not self.layers, linear_cmap(column, colours.SCALE, 0.0, top)
        bar = colour_bar(colour.transform, label, ticks)
        bar.visible = shown
        self.plot.add_layout(bar, "below")
        style = {"line_width": "width", "line_cap": "round", "line_color": colour, "visible": shown}
        drawn = self.plot.multi_line("xs", "ys", source=source, **style)
        self._hover(drawn, ("street", "@edge"), (label, f"@{{{column}}}{{0.0}}"))
        self.layers[label] = [drawn, bar]

    def _add_gates(self, gates: Sequence[Gate]) -> tuple[ColumnDataSource, list[Any]]:
        """Return the source of gates, and what draws them."""
        places = np.array([gate.place for gate in gates]).reshape(-1, 2)
        signal = np.array([gate.signal for gate in gates], dtype=bool)
        source = _source(
            x=places[:, 0],
            y=places[:, 1],
            way=[f"{gate.source} → {gate.target}" for gate in gates],
            end=np.full(len(gates), _wedge_end(1.0)),
            green=["100%"] * len(gates),
            queue=np.zeros(len(gates)),
            halo=np.zeros(len(gates)),
            size=np.where(signal, 2.0 * GATE_RADIUS + 2.0, GATE_RADIUS),
            radius=np.where(signal, GATE_RADIUS, 0.0),
            rim=[colours.INK if one else colours.FAINT for one in signal],
        )
        halo = self.plot.scatter(
            "x", "y", size="halo", source=source, color=colours.QUEUE, alpha=0.3, line_color=None
        )
        discs = self.plot.scatter(
            "x", "y", size="size", source=source, fill_color=colours.PAPER, line_color="rim"
        )
        share = {
            "start_angle": np.pi / 2,
            "end_angle": "end",
            "direction": "clock",
            "radius_units": "screen",
        }
        wedges = self.plot.wedge(
            "x", "y", "radius", source=source, color=colours.GREEN, line_color=None, **share
        )
        self._hover(
            discs,
            ("gate", "@way"),
            ("green / original green", "@green"),
            ("mean queue [veh]", "@queue{0.0}"),
        )
        return source, [halo, discs, wedges]

    def _add_numbers(self) -> None:
        x, y = self._picture.places.astype(np.float32).T
        labels = [str(r) for r in range(self._picture.regions)]
        marked = [r in self._picture.protected for r in range(self._picture.regions)]
        pair = colours.INK, colours.PAPER
        fill, ink = [pair[not one] for one in marked], [pair[one] for one in marked]
        self.plot.scatter(x, y, size=24, fill_color=fill, fill_alpha=0.9, line_color=colours.INK)
        middle = {"text_align": "center", "text_baseline": "middle", "text_font_size": "12px"}
        self.plot.text(x, y, text=labels, text_color=ink, **middle)
        clear = {
            "background_fill_alpha": 0.0,
            "border_line_alpha": 0.0,
            "label_text_font_size": "11px",
        }
        scale = ScaleBar(
            range=self.plot.x_range, unit="m", location="bottom_left", bar_length=0.15, **clear
        )
        self.plot.add_layout(scale)

    def _hover(self, renderer: Any, *tooltips: tuple[str, str]) -> None:
        self.plot.add_tools(HoverTool(renderers=[renderer], tooltips=list(tooltips)))


def patch(source: ColumnDataSource, **columns: Any) -> None:
    """Replace whole columns, numbers as float32, without sending the others again."""
    if len(next(iter(columns.values()))):
        source.patch(
            {name: [(slice(len(values)), values)] for name, values in _floats(columns).items()}
        )


def mean(values: np.ndarray) -> float:
    """Return the mean without NaN, NaN if nothing is left."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def colour_bar(mapper: LinearColorMapper, title: str, ticks: list[float]) -> ColorBar:
    """Return a small horizontal scale to stand below a plot."""
    size = {
        "height": 8,
        "width": 220,
        "location": (0, 0),
        "padding": 4,
        "orientation": "horizontal",
    }
    text = {
        "title_text_font_size": "11px",
        "title_text_color": colours.FAINT,
        "major_label_text_font_size": "11px",
    }
    return ColorBar(
        color_mapper=mapper, title=title, ticker=FixedTicker(ticks=ticks), **size, **text
    )


def _wedge_end(share: np.ndarray | float) -> np.ndarray:
    """Return the end angle of a wedge of a share [-] that starts at the top and runs clockwise."""
    return np.asarray(np.pi / 2 - 2.0 * np.pi * np.minimum(share, 0.9999))


def _floats(columns: dict[str, Any]) -> dict[str, Any]:
    """Return columns with arrays as float32."""
    return {
        name: x.astype(np.float32) if isinstance(x, np.ndarray) else x
        for name, x in columns.items()
    }


def _source(**columns: Any) -> ColumnDataSource:
    return ColumnDataSource(_floats(columns))


def _lines(shapes: Sequence[Points]) -> dict[str, Any]:
    return {
        name: [shape[:, n].astype(np.float32) for shape in shapes]
        for n, name in enumerate(("xs", "ys"))
    }


def _to_the_right(shape: np.ndarray, distance: float) -> np.ndarray:
    """Return a line (n, 2) moved sideways, to the right of its direction."""
    along = shape[-1] - shape[0]
    return shape + distance * np.array([along[1], -along[0]]) / max(np.hypot(*along), 1e-9)
