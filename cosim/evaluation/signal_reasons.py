"""Why max-pressure costs time where it does: what is known of the city's lanes and of the signals in its runs."""

from collections.abc import Mapping

import pandas as pd

from cosim.plant.max_pressure import FACTS
from nmfd.studies.benchmark import REFERENCE

MORE = 0.03  # of the time between two stages, beyond that of the original programmes: worth a word


def reasons(rows: pd.DataFrame) -> list[str]:
    """Of the runs of one strategy, rows of sumo.csv, or of an older version's without those columns; none without
    max-pressure."""
    if not {*FACTS, "signals_left_alone"} <= {*rows} or rows[list(FACTS)].isna().any(axis=None):
        return []
    mean: Mapping[str, float] = rows[[*FACTS, "signals_left_alone"]].astype(float).mean().to_dict()
    lanes, split, never = (round(mean[key]) for key in ("signal_lanes", "split_lanes", "never_whole_lanes"))
    found = []
    if split:
        found.append(
            f"{split} of {lanes} lanes before its signals are shared by movements that a stage serves one "
            "without the other: who is first there holds up all behind"
        )
    if never:
        found.append(f"{never} of them are shared by movements that no stage serves together")
    if mean["intergreen_share"] > mean["programmed_intergreen_share"] + MORE:
        found.append(
            f"its signals were between two stages {100 * mean['intergreen_share']:.0f} % of the time, those "
            f"of the original programmes are {100 * mean['programmed_intergreen_share']:.0f} %"
        )
    if mean["signals_left_alone"]:
        found.append(f"{mean['signals_left_alone']:.0f} signals keep their own programmes")
    return found or [
        "neither shared lanes nor the time between stages tells why: the original programmes suit this "
        "demand better, by their coordination or their longer greens"
    ]


def losses(rows: pd.DataFrame) -> list[str]:
    """A sentence for every strategy over max-pressure that took more time than no control; rows: an overview of runs."""
    mean = rows.groupby("controller", sort=False)["total_time_spent_veh_s"].mean()
    if not mean.get(REFERENCE, 0.0) > 0:
        return []
    told = []
    for name, group in rows.groupby("controller", sort=False):
        cost = 100 * (mean[name] / mean[REFERENCE] - 1)
        if cost > 0 and (why := reasons(group)):
            told.append(f"{name} costs {cost:.1f} % against {REFERENCE} here: {'; '.join(why)}.")
    return told
