"""Writes demand.csv beside it and of economic_mpc_figure4: python
scenarios/seven_region_2018/demand.py

Tumu et al. (2024) plot the demand of their benchmark, five flows, in figure 4; the public code of
its first author approximates it by the corners below (github.com/nandantumu/NMFD-traffic-env,
configs/seven_region.toml): that is the demand of economic_mpc_figure4. That of Sirmatel and
Geroliminis (2018) is a picture too, figure 3(h), of five pairs of regions of the same network:
taken for the same here but for its volume, which is scaled to the 35,833 trips that the published
least distance of 3.87e8 veh m makes, three regions of 3600 m each.
"""

import csv
from pathlib import Path

import numpy as np

DURATION = 7200  # s, of both
TRIPS = 3.87e8 / (3 * 3600.0)  # veh m over m
FLOWS = {  # (from, to): corners [s], rates there [veh/s]
    (0, 6): ([210, 300, 420, 540, 720, 900, 1080, 1200, 1230], [0, 8, 10.5, 5, 9, 5.5, 2.5, 4, 0]),
    (6, 0): ([390, 510, 630, 750, 840, 930, 1050, 1170, 1230], [0, 2, 5, 8, 15.5, 9, 12, 14, 0]),
    (4, 2): (
        [420, 600, 780, 960, 1140, 1260, 1500, 1650, 1680],
        [0, 2.5, 7, 5.5, 10, 6, 4.5, 5, 0],
    ),
    (5, 1): (
        [450, 600, 780, 960, 1140, 1320, 1560, 1800, 2100, 2400, 2550, 2580],
        [0, 2, 5.5, 4, 3, 6, 3.5, 4.5, 3, 2, 1, 0],
    ),
    (1, 5): (
        [1170, 1200, 1380, 1500, 1680, 1800, 1980, 2160, 2370, 2400],
        [0, 6, 9, 7, 9.5, 3, 6, 3, 2, 0],
    ),
}


def table(interval: int, trips: float | None = None) -> list[tuple[int, int, int, float]]:
    """Rows interval, from, to, veh/s: the mean of each control interval [s]; scaled to so many
    trips, if given."""
    seconds = np.arange(DURATION) + 0.5
    means = {
        pair: np.interp(seconds, *flow).reshape(-1, interval).mean(axis=1)
        for pair, flow in FLOWS.items()
    }
    scale = (
        1.0 if trips is None else trips / (interval * sum(mean.sum() for mean in means.values()))
    )
    return [
        (k, i, j, round(scale * rate, 4))
        for (i, j), mean in means.items()
        for k, rate in enumerate(mean)
        if rate
    ]


if __name__ == "__main__":
    here = Path(__file__).parent
    for folder, rows in (
        (here, table(240, TRIPS)),
        (here.with_name("economic_mpc_figure4"), table(30)),
    ):
        with (folder / "demand.csv").open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerows(
                [("interval", "from", "to", "veh_s"), *rows]
            )
