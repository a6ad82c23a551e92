"""Tables of an evaluation: means over seeds, changes paired by seed with 95 % intervals, measures
by region."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from cosim.evaluation.results import Level
from cosim.sumo.net import City
from nmfd.arrays import PerRegion
from nmfd.metrics import COUNTED, decision_ms, percent_change
from nmfd.runs import config
from nmfd.runs.tables import markdown_table, text_table, wrapped
from nmfd.studies import benchmark
from nmfd.studies.benchmark import REFERENCE, interval
from nmfd.types import Result

TTS = "total_time_spent_veh_s"
COLUMNS = config.read(Path(__file__).with_name("columns.toml"))[
    "evaluation"
]  # heading without unit -> meaning
COLUMNS |= dict(COUNTED.values()) | {"outside SUMO": "share of the wall time outside SUMO"}
FEWEST_SEEDS = 3  # from which a difference may be called significant
CAPTION = "; ".join(f"{heading}: {text}" for heading, text in COLUMNS.items())


class Paired(NamedTuple):
    """Change from b to a on the seeds that both have: mean and half of the 95 % interval, NaN for
    one seed."""

    seeds: int
    percent: float
    percent_half: float

    @property
    def significant(self) -> bool:
        return self.seeds >= FEWEST_SEEDS and abs(self.percent) > self.percent_half


def paired(a: Mapping[int, float], b: Mapping[int, float]) -> Paired:
    """Compare values by seed; NaN without a common seed, and percentages NaN if a value of b is
    0."""
    seeds = sorted(set(a) & set(b))
    percent = [percent_change(a[seed], b[seed]) for seed in seeds]
    mean = float(np.mean(percent)) if seeds else math.nan
    return Paired(len(seeds), mean, interval(percent))


def by_seed(
    rows: pd.DataFrame, level: float, controller: str, column: str = TTS
) -> dict[int, float]:
    """Return seed -> value of a column."""
    part = rows[(rows["demand"] == level) & (rows["controller"] == controller)]
    return dict(zip(part["seed"], part[column], strict=True))


def groups(rows: pd.DataFrame) -> dict[float, list[str]]:
    """Return demand level -> controllers, in the order of the rows."""
    return {
        level: list(dict.fromkeys(part["controller"]))
        for level, part in rows.groupby("demand", sort=True)
    }


def compared_with(rows: pd.DataFrame) -> str:
    """Return the reference controller: no-control, or the first one, that every level and enough
    seeds have."""
    levels, seeds = groups(rows).values(), rows.groupby("controller", sort=False)["seed"].nunique()
    names = list(seeds.index[seeds >= min(FEWEST_SEEDS, seeds.max())])
    return benchmark.compared_with(
        [name for name in names if all(name in level for level in levels)] or names
    )


def statistics(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per demand level and controller; rows: of one scenario, one per run."""
    out = []
    for level, names in groups(rows).items():
        against = compared_with(rows[rows["demand"] == level])
        for name in names:
            part = rows[(rows["demand"] == level) & (rows["controller"] == name)]
            pair = paired(
                by_seed(rows, level, name), by_seed(rows, level, against) if name != against else {}
            )
            out.append(
                {
                    **part.mean(numeric_only=True),
                    "demand": level,
                    "controller": name,
                    "against": against,
                    "seeds": len(part),
                    f"half_interval_{TTS}": interval(list(part[TTS])),
                    "change_percent": pair.percent,
                    "change_half_interval_percent": pair.percent_half,
                    "change_significant": pair.significant if pair.seeds else None,
                    "change_seeds": pair.seeds,
                    "teleports": int(part["teleports"].sum()),
                    "gateway_queue_max_veh": part["gateway_queue_max_veh"].max(),
                    "control_step_ms_max": part["control_step_ms_max"].max(),
                    **{column: int(part[column].sum()) for column in COUNTED},
                }
            )
    return pd.DataFrame(out)


def pairs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return TTS of every controller against every other at every demand level, paired by seed."""
    out = []
    for level, names in groups(rows).items():
        for name, other in ((name, other) for name in names for other in names if other != name):
            pair = paired(by_seed(rows, level, name), by_seed(rows, level, other))
            out.append((level, name, other, *pair, pair.significant))
    columns = [
        "demand",
        "controller",
        "against",
        "seeds",
        "change_percent",
        "half_interval_percent",
        "significant",
    ]
    return pd.DataFrame(out, columns=columns)


def shown(table: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return `statistics` of one demand level as two tables of text: outcomes, and costs and
    decisions."""
    lines = []
    against = table["against"].iloc[0]
    change = "change" if against == REFERENCE or len(table) == 1 else f"against {against}"
    for row in table.to_dict("records"):
        half = row[f"half_interval_{TTS}"]
        lines.append(
            {
                "controller": row["controller"],
                "seeds": row["seeds"],
                "TTS [veh s]": f"{row[TTS]:.3e}" + ("" if math.isnan(half) else f" ± {half:.1e}"),
                change: _change(row),
                "completed": f"{row['completed_veh']:,.0f} of {row['trips']:,.0f}",
                "removed [veh]": f"{row['removed_veh']:,.0f}",
                "backlog [veh]": f"{row['final_backlog_veh']:,.0f}",
                "backlog [veh s]": f"{row['total_backlog_veh_s']:.2e}",
                "teleports": f"{row['teleports']:.0f}",
                "trip [s]": " / ".join(
                    _seconds(row[f"{kind}_trip_time_s"]) for kind in ("mean", "median", "p95")
                ),
                "finished [s]": _seconds(row["mean_finished_trip_time_s"]),
                "departure delay [s]": _seconds(row["mean_departure_delay_s"]),
                "delay [s]": _seconds(row["mean_time_loss_s"]),
                "public transport [s]": _seconds(row.get("public_transport_delay_s", math.nan)),
                "other [veh s]": f"{row['other_time_spent_veh_s']:.2e}",
                "CO2 [kg]": f"{row['co2_kg']:,.0f}",
                "queue [veh]": f"{row['gateway_queue_mean_veh']:.1f} / {row['gateway_queue_max_veh']:.0f}",
                "longest [veh]": _seconds(row.get("longest_queue_veh", math.nan)),
                "full": f"{100 * row['gateway_full_share']:.1f} %",
                "decision [ms]": decision_ms(row),
                **{heading: row[column] for column, (heading, _) in COUNTED.items()},
                "outside SUMO": f"{100 * row['overhead_share']:.1f} %",
            }
        )
    whole = pd.DataFrame(lines).set_index("controller")
    parts = whole.loc[:, :"teleports"], whole.loc[:, "trip [s]":]
    return parts[0].reset_index(), parts[1].reset_index()


def _seconds(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:,.0f}"


def _change(row: Mapping) -> str:
    percent, half = row["change_percent"], row["change_half_interval_percent"]
    if math.isnan(percent):
        return "-" * bool(row["change_seeds"])
    spread = f" ± {max(half, 0.1):.1f}" if half > 0 else ""  # NaN for one seed
    return f"{percent:+.1f}{spread} %{'*' * row['change_significant']}"


def text(rows: pd.DataFrame) -> str:
    """Return the tables of one scenario for the terminal."""
    tables = _tables(
        rows, "Demand times {:g}", lambda each: text_table(each.to_dict("records")) + "\n"
    )
    return "\n".join([*tables, *wrapped(CAPTION)])


def markdown(rows: pd.DataFrame) -> str:
    """Return the tables of one scenario as markdown."""
    tables = _tables(
        rows,
        "## Demand times {:g}",
        lambda each: markdown_table(list(each), each.to_numpy().tolist()),
    )
    return "\n\n".join([*tables, CAPTION]) + "\n"


def _tables(rows: pd.DataFrame, heading: str, form: Callable[[pd.DataFrame], str]) -> Iterator[str]:
    for level, part in statistics(rows).groupby("demand", sort=True):
        yield from (heading.format(level), *map(form, shown(part)))


def common_runs(level: Level, names: Sequence[str]) -> list[list[Result]]:
    """Return the runs of each controller on the seeds that all have, without those that lack these
    measures."""
    runs = [
        {run.seed: run for run in level.results(name) if "trip_time_by_origin" in run}
        for name in names
    ]
    seeds = sorted(set.intersection(*map(set, runs)))
    return [[of[seed] for seed in seeds] for of in runs]


def longer_trips(level: Level, name: str, against: str) -> PerRegion:
    """Return the change of the mean trip time [%] by origin, (R,), or (0,) without a common seed;
    NaN without trips."""
    own, before = (
        np.array([run.trip_time_by_origin for run in runs])
        for runs in common_runs(level, (name, against))
    )
    return 100.0 * (own.mean(axis=0) / before.mean(axis=0) - 1.0) if len(own) else np.zeros(0)


def by_region(
    level: Level, city: City, region_names: Sequence[str], names: Sequence[str]
) -> pd.DataFrame | None:
    """Return a row of text per region and one of all; None without a common seed.

    names: controllers, the reference first; means over their common seeds, but the longest queue of
        all
    """
    runs = common_runs(level, names)
    if not runs[0]:
        return None
    region = city.edge_region
    means = [
        np.mean([_numbers(run, region, len(region_names)) for run in of], axis=0) for of in runs
    ]
    columns: dict[tuple[str, str], list[str]] = {("", "region"): [*region_names, "all"]}
    for n, heading in enumerate(("trip from here [s]", "CO2 [kg]")):
        for name, values in zip(names, means, strict=True):
            columns[heading, name] = [f"{value:,.0f}" for value in values[n]]
        if len(names) > 1:
            changes = 100.0 * (means[-1][n] / means[0][n] - 1.0)
            columns[heading, "change"] = [f"{change:+.1f} %" for change in changes]
    for name, of in zip(names, runs, strict=True):
        queue = np.max([run.queue_max for run in of], axis=0)
        inside = [np.flatnonzero(region == r) for r in range(len(region_names))] + [
            np.arange(len(region))
        ]
        longest = [edges[np.argmax(queue[edges])] for edges in inside]
        columns["longest queue [veh], on street", name] = [
            f"{queue[edge]}, {city.edges[edge]}" for edge in longest
        ]
    return pd.DataFrame(columns)


def _numbers(run: Result, region: np.ndarray, regions: int) -> np.ndarray:
    """Return trip times [s] by origin and CO2 [kg], (2, R + 1), by region and at last of all."""
    co2 = np.bincount(region, run.co2, regions)
    return np.array([[*run.trip_time_by_origin, run.mean_trip_time_s], [*co2, co2.sum()]])
