"""The card on top of the page: what a strategy came to for the people in the city, in four figures."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cosim.evaluation import statistics
from cosim.report.pictures import ranked

HOUR = 3600.0  # s
MINUTE = 60.0  # s


@dataclass(frozen=True, kw_only=True)
class Figure:
    """label: what it is; value: of the strategy, with its unit; before: of what it is compared with; change: with its
    interval over seeds; better: whether that is beyond zero to the good (True) or bad (False); what: how it is counted.
    """

    label: str
    value: str
    before: str
    change: str
    better: bool | None
    what: str


def card(rows: pd.DataFrame) -> tuple[str, list[Figure], str]:
    """A heading, the figures of the best strategy of one demand level, and its name; over the seeds that it has in
    common with what all are compared with; of what was run, if that is alone. rows: as in
    cosim.evaluation.statistics."""
    against, level = statistics.compared_with(rows), rows["demand"].iloc[0]
    others = [name for name in ranked(rows) if name != against]
    name = others[0] if others else against
    rows = rows.assign(
        minutes=minutes_per_trip(rows), hours=rows[statistics.TTS] / HOUR, tonnes=rows["co2_kg"] / 1000.0
    )
    columns = [statistics.by_seed(rows, level, one, "minutes") for one in (name, against)]
    common = [seed for seed in columns[0] if seed in columns[1]]
    if not others or not common:
        against = name
        common = [*columns[0]]
    part = rows[rows["seed"].isin(common)]
    figures = [
        _figure(part, name, against, label, column, what, show, good)
        for label, column, what, show, good in (
            (
                "Time per trip",
                "minutes",
                "mean of all trips, from the wanted departure to the arrival, or to the end "
                "of the run for those who have not arrived",
                lambda x: f"{x:.1f} min",
                -1,
            ),
            (
                "Trips served",
                "completed_veh",
                f"of {part['trips'].mean():,.0f} that were due; mean over seeds",
                lambda x: f"{x:,.0f}",
                1,
            ),
            (
                "CO2",
                "tonnes",
                "of all vehicles while the run lasted, by SUMO's HBEFA4 petrol car; vehicles that stand "
                "in a lock to the end still have their way before them",
                lambda x: f"{x:.2f} t",
                -1,
            ),
        )
    ]
    figures.append(_saved(part, name, against))
    heading = name if name == against else f"{name} instead of {_words(against)}"
    return heading, [figure for figure in figures if "nan" not in figure.value], name


def minutes_per_trip(facts: Any) -> Any:
    """Of a row of sumo.csv [min], or of each in a table: from the wanted departure to the arrival."""
    return (facts["mean_trip_time_s"] + facts["mean_departure_delay_s"]) / MINUTE


def _figure(
    rows: pd.DataFrame,
    name: str,
    against: str,
    label: str,
    column: str,
    what: str,
    show: Callable[[float], str],
    good: int,
) -> Figure:
    now, before = (rows.loc[rows["controller"] == one, column].mean() for one in (name, against))
    if name == against:
        return Figure(label=label, value=show(now), before="", change="", better=None, what=what)
    pair = _pair(rows, name, against, column)
    change = f"{pair.percent:+.0f} %{_half(pair.percent_half, pair.seeds, '.0f')}"
    return Figure(
        label=label,
        value=show(now),
        before=f"{show(before)} {statistics.than(against)}",
        change="" if math.isnan(pair.percent) else change,
        better=_better(pair.percent, pair.percent_half, good),
        what=what,
    )


def _saved(rows: pd.DataFrame, name: str, against: str) -> Figure:
    """The hours of all drivers that are saved, of total time spent."""
    what = (
        "in the city, of all drivers together in one run, on the road and waiting to enter (total time spent), "
        "until the end of the run"
    )
    if name == against:
        spent = rows.loc[rows["controller"] == name, "hours"].mean()
        return Figure(
            label="Hours spent in traffic", value=f"{spent:,.0f} h", before="", change="", better=None, what=what
        )
    pair = _pair(rows, name, against, "hours")
    saved = -pair.difference
    before = rows.loc[rows["controller"] == against, "hours"].mean()
    return Figure(
        label=f"Hours of delay {'saved' if saved >= 0 else 'added'}",
        value=f"{abs(saved):,.0f} h",
        before=f"of {before:,.0f} h {statistics.than(against)}",
        change=f"{abs(saved):,.0f} h{_half(pair.difference_half, pair.seeds, ',.0f')}",
        better=_better(pair.difference, pair.difference_half, -1),
        what=what,
    )


def _pair(rows: pd.DataFrame, name: str, against: str, column: str) -> statistics.Paired:
    level = rows["demand"].iloc[0]
    return statistics.paired(*(statistics.by_seed(rows, level, one, column) for one in (name, against)))


def _half(half: float, seeds: int, form: str) -> str:
    return " on one seed" if math.isnan(half) else f" ± {half:{form}} (95 %, {seeds} seeds)"


def _better(change: float, half: float, good: int) -> bool | None:
    if math.isnan(half) or not abs(change) > half:
        return None
    return bool(np.sign(change) == good)


def _words(against: str) -> str:
    return against.replace("no-control", "no control")
