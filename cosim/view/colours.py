"""Colours of the page, distinct for colour-blind readers and in greyscale: dark is full."""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex

INK, FAINT, LINE, PAPER = "#22303c", "#6b7885", "#d5dae0", "#ffffff"
LAND, CHOSEN, CHOSEN_LAND = "#f3f5f7", "#0b5c8a", "#dcebf5"
GREEN, QUEUE = "#0b7a5b", "#a3123a"
DASHES = ("solid", "dashed")  # of the runs side by side
STOPS = ("#c3cbd2", "#f2c14e", "#e2711d", "#a3123a", "#2d0a2e")  # from light to dark
SCALE = [
    to_hex(tone)
    for tone in LinearSegmentedColormap.from_list("load", STOPS)(np.linspace(0.0, 1.0, 256))
]
