"""Tables of an evaluation: means over seeds with intervals, and differences paired by seed.

A change is the mean over the seeds that both have of 100 (a / b - 1), with its 95 % interval by Student's t: the same
trips on both sides, so that what one seed's demand does to both is not taken for an effect.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from nmfd.metrics import COUNTED, percent_change
from nmfd.runs import files
from nmfd.runs.tables import markdown_table, text_table, wrapped
from nmfd.studies import benchmark
from nmfd.studies.benchmark import REFERENCE, interval

TTS = "total_time_spent_veh_s"
MEANS = (  # columns of summary.csv and sumo.csv of which an evaluation shows the mean over seeds
    "completed_veh",
    "removed_veh",
    "trips",
    "final_backlog_veh",
    "total_backlog_veh_s",
    "mean_trip_time_s",
    "mean_departure_delay_s",
    "co2_kg",
    "fuel_kg",
    "gateway_queue_mean_veh",
    "gateway_full_share",
    "control_step_ms_median",
    "overhead_share",
    "wall_time_s",
)
COLUMNS = {  # heading of a table, without its unit -> what it says
    "controller": "the strategy for signals and routes",
    "seeds": "how many runs, each with other trips",
    "TTS": "total time spent, running and waiting to be inserted, mean over seeds ± 95 % interval",
    "change": "of TTS against no-control, or against the controller that the heading names, paired by seed, mean of "
    "the percentages ± 95 % interval, * if that excludes zero",
    "completed": "trips that ended on the last edge of their route",
    "removed": "by whatever else takes vehicles out of SUMO, in TTS as if they were there to the end",
    "backlog": "not inserted at the end, and its time integral",
    "teleports": "all seeds",
    "trip": "mean time on the road of all trips, unfinished ones with what they had spent at the end",
    "delay": "mean time between the wanted and the real departure, of the same trips",
    "CO2": "of all vehicles, by SUMO's HBEFA4 petrol car",
    "queue": "halting on the edges before gateways, mean / longest",
    "full": "share of these edges and intervals that were full",
    "decision": "median / longest",
    **dict(COUNTED.values()),
    "outside SUMO": "share of the wall time that was not SUMO's",
}
SERVED_SHARE = 0.9  # of the seeds in which all trips are completed
PAIRS = {  # columns of pairs.csv
    "demand": "multiple of the scenario's",
    "controller": "the strategy",
    "against": "what it is paired with",
    "seeds": "that both have",
    "change_percent": "of total time spent, mean over these seeds",
    "half_interval_percent": "half of the 95 % interval of that change",
    "difference_veh_s": "of total time spent, mean over these seeds",
    "half_interval_veh_s": "half of the 95 % interval of that difference",
    "excludes_zero": "whether the interval of the change does: more than the chance of the seeds",
}
CAPTION = "; ".join(f"{heading}: {text}" for heading, text in COLUMNS.items() if heading not in ("controller", "seeds"))


def meaning(heading: str) -> str:
    """What the column says that a table of `shown` has under this heading."""
    return COLUMNS["change" if heading.startswith("against ") else heading.partition(" [")[0]]


@dataclass(frozen=True, kw_only=True)
class Paired:
    """How a differs from b on the n seeds that both have: mean and half of the 95 % interval (NaN of a single seed)."""

    seeds: int
    percent: float
    percent_half: float
    difference: float
    difference_half: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval does."""
        return abs(self.percent) > self.percent_half  # never of a single seed


def paired(a: Mapping[int, float], b: Mapping[int, float]) -> Paired:
    """a, b: seed -> value; NaN everywhere without a common seed, and the percentages where a value of b is 0."""
    seeds = sorted(set(a) & set(b))
    percent = [percent_change(a[seed], b[seed]) for seed in seeds]
    difference = [a[seed] - b[seed] for seed in seeds]
    return Paired(
        seeds=len(seeds),
        percent=_mean(percent),
        percent_half=interval(percent),
        difference=_mean(difference),
        difference_half=interval(difference),
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def by_seed(rows: pd.DataFrame, level: float, controller: str, column: str = TTS) -> dict[int, float]:
    """Seed -> value."""
    chosen = rows[(rows["demand"] == level) & (rows["controller"] == controller)]
    return dict(zip(chosen["seed"], chosen[column], strict=True))


def groups(rows: pd.DataFrame) -> dict[float, list[str]]:
    """Demand level -> controllers, as they come."""
    return {level: list(dict.fromkeys(part["controller"])) for level, part in rows.groupby("demand", sort=True)}


def compared_with(rows: pd.DataFrame) -> str:
    """What the controllers of `rows` are compared with: no control, or the first of them, where it was not run at every
    demand level."""
    levels = groups(rows).values()
    names = list(dict.fromkeys(rows["controller"]))
    return benchmark.compared_with([name for name in names if all(name in level for level in levels)] or names)


def than(reference: str) -> str:
    """Behind "less time than": what controllers are compared with, in words."""
    return "without control" if reference == REFERENCE else f"under {reference}"


def statistics(rows: pd.DataFrame, reference: str | None = None) -> pd.DataFrame:
    """One row per demand level and controller of `rows`, which are those of experiment.overview with a column
    demand. `reference`: a controller to pair with, besides that which all are compared with (column against)."""
    out = []
    for level, names in groups(rows).items():
        against = compared_with(rows[rows["demand"] == level])
        for name in names:
            part = rows[(rows["demand"] == level) & (rows["controller"] == name)]
            row = {
                "demand": level,
                "controller": name,
                "against": against,
                "seeds": len(part),
                f"mean_{TTS}": part[TTS].mean(),
                f"half_interval_{TTS}": interval(list(part[TTS])),
            }
            for label, other in (("change", against), ("change_to_reference", reference)):
                pair = paired(by_seed(rows, level, name), by_seed(rows, level, other) if other else {})
                shown = pair.seeds > 0 and name != other
                row |= {
                    f"{label}_percent": pair.percent if shown else math.nan,
                    f"{label}_half_interval_percent": pair.percent_half if shown else math.nan,
                    f"{label}_excludes_zero": pair.excludes_zero if shown else None,
                    f"{label}_seeds": pair.seeds if shown else 0,
                }
            row |= {column: part[column].mean() for column in MEANS}
            row |= {
                "teleports": int(part["teleports"].sum()),
                "gateway_queue_max_veh": part["gateway_queue_max_veh"].max(),
                "control_step_ms_max": part["control_step_ms_max"].max(),
                **{column: int(part[column].sum()) for column in COUNTED},
            }
            out.append(row)
    return pd.DataFrame(out)


def pairs(rows: pd.DataFrame) -> pd.DataFrame:
    """TTS of every controller against every other at every demand level, paired by seed."""
    out = []
    for level, names in groups(rows).items():
        for name in names:
            for other in names:
                if other == name:
                    continue
                pair = paired(by_seed(rows, level, name), by_seed(rows, level, other))
                out.append(
                    {
                        "demand": level,
                        "controller": name,
                        "against": other,
                        "seeds": pair.seeds,
                        "change_percent": pair.percent,
                        "half_interval_percent": pair.percent_half,
                        "difference_veh_s": pair.difference,
                        "half_interval_veh_s": pair.difference_half,
                        "excludes_zero": pair.excludes_zero,
                    }
                )
    return pd.DataFrame(out, columns=[*PAIRS])


def shown(table: pd.DataFrame, reference: str | None = None) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`statistics` of one demand level as two tables of text: what came of it, and how."""
    first, second = [], []
    found = list(dict.fromkeys(table["against"]))
    change = "change" if found == [REFERENCE] or len(table) == 1 else f"against {found[0]}"
    reference = None if reference in found else reference
    for row in table.to_dict("records"):
        teleports = f"{row['teleports']:.0f}"
        against = {f"against {reference}": _change(row, "change_to_reference")} if reference else {}
        first.append(
            {
                "controller": row["controller"],
                "seeds": row["seeds"],
                "TTS [veh s]": _spread(row),
                change: _change(row, "change"),
                **against,
                "completed": f"{row['completed_veh']:,.0f} of {row['trips']:,.0f}",
                "removed [veh]": f"{row['removed_veh']:,.0f}",
                "backlog [veh]": f"{row['final_backlog_veh']:,.0f}",
                "backlog [veh s]": f"{row['total_backlog_veh_s']:.2e}",
                "teleports": teleports,
            }
        )
        second.append(
            {
                "controller": row["controller"],
                "trip [s]": f"{row['mean_trip_time_s']:,.0f}",
                "delay [s]": f"{row['mean_departure_delay_s']:,.0f}",
                "CO2 [kg]": f"{row['co2_kg']:,.0f}",
                "queue [veh]": f"{row['gateway_queue_mean_veh']:.1f} / {row['gateway_queue_max_veh']:.0f}",
                "full": f"{100 * row['gateway_full_share']:.1f} %",
                "decision [ms]": f"{row['control_step_ms_median']:.3g} / {row['control_step_ms_max']:.3g}",
                **{heading: row[column] for column, (heading, _) in COUNTED.items()},
                "outside SUMO": f"{100 * row['overhead_share']:.1f} %",
                "teleports": teleports,
            }
        )
    return pd.DataFrame(first), pd.DataFrame(second)


def _spread(row: Mapping) -> str:
    half = row[f"half_interval_{TTS}"]
    return f"{row[f'mean_{TTS}']:.3e}" + ("" if math.isnan(half) else f" ± {half:.1e}")


def _change(row: Mapping, label: str) -> str:
    percent, half = row[f"{label}_percent"], row[f"{label}_half_interval_percent"]
    if math.isnan(percent):
        return "-" * bool(row[f"{label}_seeds"])
    return f"{percent:+.1f}" + (" %" if math.isnan(half) else f" ± {half:.1f} %{'*' * row[f'{label}_excludes_zero']}")


def text(table: pd.DataFrame, reference: str | None = None) -> str:
    """`statistics` for the terminal."""
    parts = []
    for level, part in table.groupby("demand", sort=True):
        parts += [
            f"Demand times {level:g}",
            *(text_table(rows.to_dict("records")) + "\n" for rows in shown(part, reference)),
        ]
    return "\n".join([*parts, *wrapped(CAPTION)])


def markdown(table: pd.DataFrame, reference: str | None = None) -> str:
    """`statistics` as markdown."""
    parts = []
    for level, part in table.groupby("demand", sort=True):
        parts += [
            f"## Demand times {level:g}",
            *(markdown_table(list(rows), rows.to_numpy().tolist()) for rows in shown(part, reference)),
        ]
    return "\n\n".join([*parts, CAPTION]) + "\n"


def write_tables(folder: Path, rows: pd.DataFrame, reference: str | None = None) -> pd.DataFrame:
    """evaluate.csv, evaluate.md, pairs.csv and runs.csv in `folder`; returns `statistics`."""
    table = statistics(rows, reference)
    for name, content in (("runs.csv", rows), ("evaluate.csv", table), ("pairs.csv", pairs(rows))):
        files.write_table(folder / name, content)
    files.write_text(folder / "evaluate.md", markdown(table, reference))
    return table


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per demand level and controller of `rows`, which are those of `evaluate.kept_runs`."""
    out = []
    for (level, name), part in rows.groupby(["demand", "controller"], sort=False):
        served = int((part["completed_veh"] >= part["trips"]).sum())
        between = binomtest(served, len(part)).proportion_ci(method="wilson")
        out.append(
            {
                "demand": level,
                "controller": name,
                "seeds": len(part),
                "served_runs": served,
                "served_share": served / len(part),
                "served_share_low": between.low,
                "served_share_high": between.high,
                "completed_share": float((part["completed_veh"] / part["trips"].clip(lower=1)).mean()),
                "mean_trips": float(part["trips"].mean()),
                f"mean_{TTS}": float(part[TTS].mean()),
                f"half_interval_{TTS}": interval(list(part[TTS])),
            }
        )
    return pd.DataFrame(out)


def highest(table: pd.DataFrame) -> dict[str, float]:
    """Controller -> the highest demand level up to which every level that was run was SERVED_SHARE; 0 for none."""
    found = {}
    for name, part in table.sort_values("demand").groupby("controller", sort=False):
        good = part["served_share"] >= SERVED_SHARE - 1e-9
        found[str(name)] = float(part["demand"][good.cummin()].max()) if good.iloc[0] else 0.0
    return found
