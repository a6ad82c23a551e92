"""Map of one run: streets by density, regions, and gates with their green."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    CustomJS,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    PlainText,
    ScaleBar,
    Title,
)
from bokeh.plotting import figure
from bokeh.transform import linear_cmap

from cosim.importing import maps
from cosim.sumo.arrays import PerEdge, Points
from cosim.sumo.net import JAM_SPACING
from cosim.view import colours
from cosim.view.picture import CityPicture, Frame, Gate, extent

DENSITY = "density [veh/km and lane]"
DENSEST = 1000.0 / JAM_SPACING  # veh/km and lane
LINE_OFFSET = 0.006  # of the map's width, by which the two directions of a street are drawn apart
MANY_EDGES = 2000  # thinner lines for more
MAP_HEIGHT = 440  # pixels
GATE_RADIUS = 6.0  # pixels
SHORTEST_QUEUE = 0.5  # veh, that has a halo
CLOSER = 0.7  # of the map's extent: a closer view shows gates, any other boundaries


class Layer(NamedTuple):
    """Values (E,) to colour the streets by, and the upper end of their scale."""

    values: PerEdge
    top: float


class Gates(NamedTuple):
    """Gates on a map.

    members: numbers of the gateways of each gate; parts: what draws the gates
    """

    members: list[list[int]]
    source: ColumnDataSource
    parts: list[Any]


class CityMap:
    """One run on the map; `show` sets its sources to a frame.

    gates: of boundaries, seen from afar, and single ones, seen closer
    layers: label -> what shows the streets by this quantity; all but the first, DENSITY, are hidden
    """

    def __init__(
        self,
        picture: CityPicture,
        title: str,
        layers: Mapping[str, Layer],
        beside: "CityMap | None" = None,
    ):
        """layers: label -> other layers than density; beside: map to move with"""
        self._picture = picture
        self._others = layers
        self.layers: dict[str, list[Any]] = {}
        common = {}
        if beside is not None:
            common = {"x_range": beside.plot.x_range, "y_range": beside.plot.y_range}
        self.plot: Any = figure(
            title=Title(text=PlainText(title)),
            height=MAP_HEIGHT,
            sizing_mode="stretch_width",
            match_aspect=True,
            lod_threshold=None,
            tools="pan,wheel_zoom,reset",
            active_scroll="wheel_zoom",
            toolbar_location=None,
            outline_line_color=None,
            **common,
        )
        self.plot.axis.visible = self.plot.grid.visible = False
        self.regions = self._add_regions()
        self.streets = self._add_streets()
        far = self._add_gates(picture.boundaries)
        style = {"text_font_size": "11px", "text_color": colours.INK, "text_baseline": "middle"}
        # From which region into which a gate leads, beside it.
        ways = self.plot.text("x", "y", text="way", source=far.source, x_offset=9, **style)
        far.parts.append(ways)
        near = self._add_gates(picture.gates)
        self.gates = (far, near)
        self._add_numbers()
        for part in near.parts:
            part.visible = False
        code = CustomJS.from_file(
            Path(__file__).with_name("gates.js"),
            far=far.parts,
            near=near.parts,
            limit=CLOSER * extent(picture.shapes),
        )
        self.plot.x_range.js_on_change("end", code)

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        patch(self.streets, density=frame.density)
        for gates in self.gates:
            share = np.array([mean(frame.green[numbers]) for numbers in gates.members])
            queue = np.array([mean(frame.queue[numbers]) for numbers in gates.members])
            drawn = np.nan_to_num(np.clip(share, 0.0, 1.0), nan=1.0)
            halo = 2.0 * GATE_RADIUS + 4.0 * np.sqrt(queue)
            patch(
                gates.source,
                end=_wedge_end(drawn),
                green=[_percent(one) for one in share],
                queue=queue,
                halo=np.where(queue >= SHORTEST_QUEUE, halo, 0.0),
            )

    def choose(self, region: int) -> None:
        """Highlight a region."""
        chosen = np.array(self.regions.data["region"]) == region
        line = np.where(chosen, colours.CHOSEN, colours.FAINT).tolist()
        patch(self.regions, width=np.where(chosen, 2.5, 1.0), line=line)

    def _add_regions(self) -> ColumnDataSource:
        outlines = maps.largest_first(self._picture.outlines)
        regions = [region for region, _ in outlines]
        rings = [ring for _, ring in outlines]
        source = _source(
            **_lines(rings),
            region=regions,
            width=np.ones(len(rings)),
            line=[colours.FAINT] * len(rings),
            fill=[maps.pale(region) for region in regions],
        )
        style = {"fill_color": "fill", "line_color": "line", "line_width": "width"}
        self.plot.patches("xs", "ys", source=source, **style)
        return source

    def _add_streets(self) -> ColumnDataSource:
        picture = self._picture
        width = 1.6 + 0.9 * picture.lanes  # pixels
        if len(picture.edges) > MANY_EDGES:
            width = 0.8 + 0.4 * picture.lanes
        offset = LINE_OFFSET * float(np.ptp(np.concatenate(picture.shapes)[:, 0]))
        source = _source(
            **_lines([_to_the_right(shape, offset) for shape in picture.shapes]),
            edge=list(picture.edges),
            density=np.zeros(len(picture.edges)),
            width=width,
            **{label: layer.values for label, layer in self._others.items()},
        )
        self._add_layer(source, "density", DENSITY, DENSEST, [0.0, 50.0, 100.0])
        for label, layer in self._others.items():
            self._add_layer(source, label, label, layer.top, [0.0, layer.top / 2.0, layer.top])
        return source

    def _add_layer(
        self, source: ColumnDataSource, column: str, label: str, top: float, ticks: list[float]
    ) -> None:
        shown = not self.layers
        colour = linear_cmap(column, colours.SCALE, 0.0, top)
        bar = colour_bar(colour.transform, label, ticks)
        bar.visible = shown
        self.plot.add_layout(bar, "below")
        style = {"line_width": "width", "line_cap": "round", "line_color": colour, "visible": shown}
        drawn = self.plot.multi_line("xs", "ys", source=source, **style)
        self._hover(drawn, ("street", "@edge"), (label, f"@{{{column}}}{{0.0}}"))
        self.layers[label] = [drawn, bar]

    def _add_gates(self, gates: Sequence[Gate]) -> Gates:
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
            rim=[maps.colour(gate.target) for gate in gates],
        )
        plot = self.plot
        glow = {"size": "halo", "color": colours.QUEUE, "alpha": 0.3, "line_color": None}
        halo = plot.scatter("x", "y", source=source, **glow)
        disc = {"size": "size", "fill_color": colours.PAPER, "line_color": "rim", "line_width": 2}
        discs = plot.scatter("x", "y", source=source, **disc)
        wedges = plot.wedge(
            "x",
            "y",
            "radius",
            source=source,
            color=colours.GREEN,
            line_color=None,
            start_angle=np.pi / 2,
            end_angle="end",
            direction="clock",
            radius_units="screen",
        )
        self._hover(
            discs,
            ("gate", "@way"),
            ("green / original green", "@green"),
            ("mean queue [veh]", "@queue{0.0}"),
        )
        members = [list(gate.gateways) for gate in gates]
        return Gates(members, source, [halo, discs, wedges])

    def _add_numbers(self) -> None:
        x, y = self._picture.places.astype(np.float32).T
        labels = [str(region) for region in range(self._picture.regions)]
        fill = [colours.PAPER] * len(labels)
        ink = [colours.INK] * len(labels)
        for region in self._picture.protected:
            fill[region] = colours.INK
            ink[region] = colours.PAPER
        self.plot.scatter(x, y, size=24, fill_color=fill, fill_alpha=0.9, line_color=colours.INK)
        middle = {"text_align": "center", "text_baseline": "middle", "text_font_size": "12px"}
        self.plot.text(x, y, text=labels, text_color=ink, **middle)
        scale = ScaleBar(
            range=self.plot.x_range,
            unit="m",
            location="bottom_left",
            bar_length=0.15,
            background_fill_alpha=0.0,
            border_line_alpha=0.0,
            label_text_font_size="11px",
        )
        self.plot.add_layout(scale)

    def _hover(self, renderer: Any, *tooltips: tuple[str, str]) -> None:
        self.plot.add_tools(HoverTool(renderers=[renderer], tooltips=list(tooltips)))


def patch(source: ColumnDataSource, **columns: Any) -> None:
    """Replace whole columns without sending the others again.

    Numbers are sent as float32.
    """
    patches = {}
    for name, values in _floats(columns).items():
        if not len(values):
            return
        patches[name] = [(slice(len(values)), values)]
    source.patch(patches)


def mean(values: np.ndarray) -> float:
    """Return the mean without NaN, NaN if nothing is left."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def colour_bar(mapper: LinearColorMapper, title: str, ticks: list[float]) -> ColorBar:
    """Return a small horizontal scale to stand below a plot."""
    return ColorBar(
        color_mapper=mapper,
        title=title,
        ticker=FixedTicker(ticks=ticks),
        height=8,
        width=220,
        location=(0, 0),
        padding=4,
        orientation="horizontal",
        title_text_font_size="11px",
        title_text_color=colours.FAINT,
        major_label_text_font_size="11px",
    )


def _percent(share: float) -> str:
    return "not controlled" if np.isnan(share) else f"{share:.0%}"


def _wedge_end(share: np.ndarray | float) -> np.ndarray:
    """Return the end angle of a wedge of a share [-].

    The wedge starts at the top and runs clockwise.
    """
    return np.asarray(np.pi / 2 - 2.0 * np.pi * np.minimum(share, 0.9999))


def _floats(columns: dict[str, Any]) -> dict[str, Any]:
    """Return columns with arrays as float32."""
    converted = {}
    for name, values in columns.items():
        if isinstance(values, np.ndarray):
            values = values.astype(np.float32)
        converted[name] = values
    return converted


def _source(**columns: Any) -> ColumnDataSource:
    return ColumnDataSource(_floats(columns))


def _lines(shapes: Sequence[Points]) -> dict[str, Any]:
    return {
        "xs": [shape[:, 0].astype(np.float32) for shape in shapes],
        "ys": [shape[:, 1].astype(np.float32) for shape in shapes],
    }


def _to_the_right(shape: np.ndarray, distance: float) -> np.ndarray:
    """Return a line (n, 2) moved sideways, to the right of its direction."""
    along = shape[-1] - shape[0]
    right = np.array([along[1], -along[0]])
    return shape + distance * right / max(np.hypot(*along), 1e-9)
