"""The colours of the page: told apart by colour-blind readers and in greyscale, where dark means full or slow."""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex

INK, FAINT, LINE, PAPER = "#22303c", "#6b7885", "#d5dae0", "#ffffff"
LAND, CHOSEN, CHOSEN_LAND, NOBODY = "#f3f5f7", "#0b5c8a", "#dcebf5", "#c3cbd2"
GREEN, GONE = "#0b7a5b", "#ffffff"  # of a gateway: what it shows, and what is taken away
QUEUE, HELD, GUIDED = "#a3123a", "#b5179e", "#3a5a9b"
RUNS = (("#0b5c8a", "solid"), ("#c96a00", "dashed"))  # of the runs side by side: colour and dash
STOPS = ("#c3cbd2", "#f2c14e", "#e2711d", "#a3123a", "#2d0a2e")  # from light to dark


def scale(reverse: bool = False) -> list[str]:
    """256 colours from empty to full; reverse: from standing to free."""
    made = LinearSegmentedColormap.from_list("load", STOPS)
    found = [to_hex(made(part)) for part in np.linspace(0.0, 1.0, 256)]
    return found[::-1] if reverse else found
