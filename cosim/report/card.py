"""The card on top of the report: the best strategy in four figures."""

import math
from dataclasses import dataclass, replace
from statistics import mean

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


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of the card: of the strategy, before of the reference; better: None if the interval holds zero."""

    label: str
    value: str
    before: str = ""
    change: str = ""
    better: bool | None = None
    meaning: str


def card(rows: pd.DataFrame) -> tuple[str, list[Figure], str]:
    """Return a heading, four figures and the name of the best strategy of one demand level.

    It is compared with the reference on the seeds that both have.
    """
    against, level = statistics.compared_with(rows), rows["demand"].iloc[0]
    name = next((name for name in ranked(rows) if name != against), against)
    figures = [_figure(rows, level, name, against, label) for label in QUANTITIES]
    heading = name if name == against else f"{name} compared with {against.replace('-', ' ')}"
    return heading, [figure for figure in figures if figure is not None], name


def _figure(rows: pd.DataFrame, level: float, name: str, against: str, label: str) -> Figure | None:
    """Return one figure, None if it was not recorded."""
    column, unit, form, good, meaning = QUANTITIES[label]
    now, before = (statistics.by_seed(rows, level, one, column) for one in (name, against))
    common = [seed for seed in now if seed in before]
    value = mean([now[seed] for seed in common or now]) / unit
    if math.isnan(value):
        return None
    pair = statistics.paired(now, before)
    figure = Figure(label=label, value=form.format(value), meaning=meaning)
    if name == against or math.isnan(pair.percent):
        return figure
    single = math.isnan(pair.percent_half)
    spread = " on one seed" if single else f" ± {pair.percent_half:.0f} (95 %, {pair.seeds} seeds)"
    than = "without control" if against == REFERENCE else f"under {against}"
    return replace(
        figure,
        before=f"{form.format(mean([before[seed] for seed in common]) / unit)} {than}",
        change=f"{pair.percent:+.0f} %{spread}",
        better=pair.percent * good > 0 if pair.excludes_zero else None,
    )
