"""Colours of the page.

They are distinct for colour-blind readers and in greyscale, where dark is full.
"""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex

INK = "#22303c"
FAINT = "#6b7885"
LINE = "#d5dae0"
PAPER = "#ffffff"
LAND = "#f3f5f7"
CHOSEN = "#0b5c8a"
GREEN = "#0b7a5b"
QUEUE = "#a3123a"
DASHES = ("solid", "dashed")  # of the runs side by side
STOPS = ("#c3cbd2", "#f2c14e", "#e2711d", "#a3123a", "#2d0a2e")  # from light to dark
_LOAD = LinearSegmentedColormap.from_list("load", STOPS)
SCALE = [to_hex(tone) for tone in _LOAD(np.linspace(0.0, 1.0, 256))]
