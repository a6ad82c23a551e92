"""The card on top of the report: the best strategy in four figures."""

import math
from statistics import mean
from typing import NamedTuple

import pandas as pd

from cosim.evaluation import statistics
from cosim.report.figures import ranked
from nmfd.studies.benchmark import REFERENCE

MINUTE, HOUR = 60.0, 3600.0  # s
QUANTITIES = {  # label -> column, its unit on the card, format of a value, sign of an improvement, meaning
    "Time per trip": ("mean_trip_time_s", MINUTE, "{:.1f} min", -1, "from wanted departure to end of trip or run"),
    "Trips served": ("completed_veh", 1.0, "{:,.0f}", 1, "completed trips, mean over seeds"),
    "CO2": ("co2_kg", 1000.0, "{:.2f} t", -1, "of all vehicles while the run lasted, by SUMO's HBEFA4 petrol car"),
    "Total time spent": (statistics.TTS, HOUR, "{:,.0f} veh h", -1, "private vehicles on the road or waiting to enter"),
}


class Figure(NamedTuple):
    """One figure of the card: of the strategy, before of the reference; better: None if the interval holds zero."""

    label: str
    value: str
    meaning: str
    before: str = ""
    change: str = ""
    better: bool | None = None


def card(rows: pd.DataFrame) -> tuple[str, list[Figure], str]:
    """Return a heading, the figures that were recorded, and the name of the best strategy of one demand level.

    It is compared with the reference on the seeds that both have.
    """
    against, level = statistics.compared_with(rows), rows["demand"].iloc[0]
    name = next((name for name in ranked(rows) if name != against), against)
    heading = name if name == against else f"{name} compared with {against.replace('-', ' ')}"
    than = "without control" if against == REFERENCE else f"under {against}"
    figures = []
    for label, (column, unit, form, good, meaning) in QUANTITIES.items():
        now, before = (statistics.by_seed(rows, level, one, column) for one in (name, against))
        common, pair = [seed for seed in now if seed in before], statistics.paired(now, before)
        value = mean(now[seed] for seed in common or now) / unit
        figure = Figure(label, form.format(value), meaning)
        if name != against and not math.isnan(pair.percent):
            single = math.isnan(pair.percent_half)
            spread = " on one seed" if single else f" ± {pair.percent_half:.0f} (95 %, {pair.seeds} seeds)"
            figure = figure._replace(
                before=f"{form.format(mean(before[seed] for seed in common) / unit)} {than}",
                change=f"{pair.percent:+.0f} %{spread}",
                better=pair.percent * good > 0 if pair.excludes_zero else None,
            )
        figures += [] if math.isnan(value) else [figure]
    return heading, figures, name
