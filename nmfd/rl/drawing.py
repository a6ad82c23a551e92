"""A picture of a city in one state, as an array of pixels: what `render` of the environments gives."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from nmfd.arrays import Adjacency, PerPair, PerRegion, Positions

SIZE, DPI = (6.4, 4.8), 100
OVER = 2.0  # critical accumulations: the dark end of the scale
JAM = 1000.0 / 7.5  # veh/km and lane
COLOURS = LinearSegmentedColormap.from_list("load", ("#c3cbd2", "#f2c14e", "#e2711d", "#a3123a", "#2d0a2e"))
ASIDE = 0.06  # of the way between two regions: how far the arrows of the two directions are apart


class CityDrawing:
    """Regions as discs, coloured by accumulation over critical; the boundaries between them as wide as they are open;
    beneath them streets, where there are any, coloured by density."""

    def __init__(
        self,
        places: Positions,
        adjacency: Adjacency,
        critical: PerRegion,
        streets: Sequence[Float[np.ndarray, "_ 2"]] = (),
    ):
        """places: (R, 2), of the regions; streets: E lines, in the same coordinates"""
        self._critical, self._pairs = critical, np.argwhere(adjacency)
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        self._canvas, self._ax = FigureCanvasAgg(figure), figure.subplots()
        ends = places[self._pairs]
        along = ends[:, 1] - ends[:, 0]
        aside = ASIDE * along[:, ::-1] * [1.0, -1.0]
        shown = np.stack([ends[:, 0] + 0.2 * along + aside, ends[:, 0] + 0.8 * along + aside], axis=1)
        self._streets = LineCollection(list(streets), cmap=COLOURS, linewidths=1.0, zorder=1)
        self._streets.set_clim(0.0, JAM)
        self._bounds = LineCollection(list(shown), colors="#30506f", alpha=0.7, zorder=2)
        for lines in (self._streets, self._bounds):
            self._ax.add_collection(lines)
        self._discs = self._ax.scatter(
            *places.T, s=420, c=np.zeros(len(places)), cmap=COLOURS, vmin=0.0, vmax=OVER, edgecolors="#22303c", zorder=3
        )
        for region, place in enumerate(places):
            self._ax.annotate(str(region), place, ha="center", va="center", fontweight="bold", zorder=4)
        figure.colorbar(self._discs, ax=self._ax, shrink=0.7, label="accumulation / critical [-]")
        self._ax.margins(0.1)
        self._ax.autoscale_view()
        self._ax.set_aspect("equal", adjustable="datalim")
        self._ax.set_axis_off()

    def draw(
        self, title: str, accumulation: PerRegion, perimeter: PerPair, density: Float[np.ndarray, " E"] | None = None
    ) -> UInt8[np.ndarray, "H W 3"]:
        """accumulation: (R,) [veh]; perimeter: u (R, R) [-]; density: (E,) [veh/km and lane]"""
        self._discs.set_array(accumulation / self._critical)
        self._bounds.set_linewidths(0.3 + 4.0 * perimeter[tuple(self._pairs.T)])
        if density is not None:
            self._streets.set_array(density)
        self._ax.set_title(title, fontsize="medium")
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
