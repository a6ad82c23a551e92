"""Tables of an evaluation.

They hold means over seeds, changes paired by seed with 95 % intervals, and measures by region.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from cosim.evaluation.results import Level
from cosim.sumo.net import City
from nmfd.arrays import PerRegion
from nmfd.metrics import COUNTED, decision_ms, percent_change
from nmfd.runs import config
from nmfd.runs.tables import NARROW, cell, markdown_table, text_table, wrapped
from nmfd.studies import benchmark
from nmfd.studies.benchmark import REFERENCE, interval
from nmfd.types import Result

TTS = "total_time_spent_veh_s"
# Heading without unit -> meaning.
COLUMNS = config.read(Path(__file__).with_name("columns.toml"))["evaluation"]
COLUMNS |= dict(COUNTED.values()) | {"outside SUMO": "share of the wall time outside SUMO"}
FEWEST_SEEDS = 3  # from which a difference may be called significant
MANY_TELEPORTS = 3.0  # times those of the reference, from one a run on
PAIR_COLUMNS = [
    "demand",
    "controller",
    "against",
    "seeds",
    "change_percent",
    "half_interval_percent",
    "significant",
]
WHOLE = "{:,.0f}"  # form of a number
NAME_WIDTH = 28  # characters, beyond which a name continues in the next line
# Of the table in the terminal, after controller, seeds, TTS and change.
BRIEF = ["completed", "trip [s]", "backlog [veh]", "teleports", "removed [veh]", "CO2 [kg]"]
CAPTION = "; ".join(f"{heading}: {text}" for heading, text in COLUMNS.items())


class Paired(NamedTuple):
    """Change from b to a on the seeds that both have.

    percent: mean over seeds (%), NaN without a common seed
    percent_half: half of the 95 % interval (%), NaN for one seed
    """

    seeds: int
    percent: float
    percent_half: float

    @property
    def significant(self) -> bool:
        """True if the interval excludes zero, from three seeds on."""
        return self.seeds >= FEWEST_SEEDS and abs(self.percent) > self.percent_half


def paired(a: Mapping[int, float], b: Mapping[int, float]) -> Paired:
    """Compare values by seed; percentages are NaN if a value of b is 0."""
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


def compared_with(rows: pd.DataFrame) -> str:
    """Return the reference controller: no-control, or else the first one.

    Only controllers that every level and enough seeds have are chosen from, if there are any.
    """
    everywhere = set.intersection(*rows.groupby("demand")["controller"].agg(set))
    seeds = rows.groupby("controller", sort=False)["seed"].nunique()
    names = list(seeds.index[seeds >= min(FEWEST_SEEDS, seeds.max())])
    return benchmark.compared_with([name for name in names if name in everywhere] or names)


def on_common_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one demand level that can be ranked.

    Their seeds are those that all controllers have. If there is none, it is the first one that most
    controllers have; the others have no row.
    """
    controllers = rows.groupby("seed")["controller"].nunique()
    common = controllers.index[controllers == rows["controller"].nunique()]
    return rows[rows["seed"].isin(common if len(common) else [controllers.idxmax()])]


def statistics(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per demand level and controller.

    rows: of one scenario, one per run
    """
    out = []
    for level, here in rows.groupby("demand", sort=True):
        against = compared_with(here)
        for name, part in here.groupby("controller", sort=False):
            reference = by_seed(rows, level, against) if name != against else {}
            pair = paired(by_seed(rows, level, name), reference)
            row = {
                **part.mean(numeric_only=True),
                "demand": level,
                "controller": name,
                "against": against,
                "seeds": len(part),
                "seeds_differ": len(on_common_seeds(here)) < len(here),
                f"half_interval_{TTS}": interval(list(part[TTS])),
                "change_percent": pair.percent,
                "change_half_interval_percent": pair.percent_half,
                "change_significant": pair.significant if pair.seeds else None,
                "change_seeds": pair.seeds,
                "teleports": int(part["teleports"].sum()),
                "gateway_queue_max_veh": part["gateway_queue_max_veh"].max(),
                "control_step_ms_max": part["control_step_ms_max"].max(),
            }
            for column in COUNTED:
                row[column] = int(part[column].sum())
            out.append(row)
    return pd.DataFrame(out)


def _many_teleports(table: pd.DataFrame) -> pd.Series:
    """Mark rows with many times the teleports of the reference.

    table: `statistics` of one demand level
    """
    per_run = table["teleports"] / table["seeds"]
    reference = per_run[table["controller"] == table["against"]].max()
    return per_run > MANY_TELEPORTS * max(reference, 1.0)


def warnings(table: pd.DataFrame) -> list[str]:
    """Return why rows of `statistics` of one demand level are doubtful."""
    found = []
    many = table[_many_teleports(table)]
    if len(many):
        found.append(
            f"WARNING: many times the teleports of {table['against'].iloc[0]}, so that jams are "
            f"worse than these numbers: {_listed(many, many['teleports'] / many['seeds'])} a run"
        )
    removed = table[table["removed_veh"] > 0]
    if len(removed):
        found.append(
            "WARNING: vehicles were removed, whose time counts until then: "
            f"{_listed(removed, removed['removed_veh'])} a run"
        )
    if table["seeds_differ"].any():
        found.append(
            f"WARNING: controllers have different seeds ({_listed(table, table['seeds'])}): means "
            "cannot be compared, but changes, which are paired; the best is that on common seeds"
        )
    return found


def floor(table: pd.DataFrame) -> str:
    """Return the time spent if nobody waited or slowed down, as a sentence.

    It is the least one over strategies whose trips all ended; "" without any.

    table: `statistics` of one demand level
    """
    served = table[(table["completed_veh"] >= table["trips"]) & (table["trips"] > 0)]
    if served.empty:
        return ""
    lost = served["mean_departure_delay_s"] + served["mean_time_loss_s"]
    free = served["trips"] * (served["mean_trip_time_s"] - lost)
    least = free.idxmin()
    name = served["controller"][least]
    return f"Floor: on the ways of {name}, without any delay, {free[least]:.4g} veh s."


def notes(table: pd.DataFrame) -> list[str]:
    """Return the sentences below a table: its floor, and its warnings."""
    return [note for note in (floor(table), *warnings(table)) if note]


def _listed(table: pd.DataFrame, values: pd.Series) -> str:
    """Return controllers with a number each."""
    pairs = zip(table["controller"], values, strict=True)
    return ", ".join(f"{name} {value:,.1f}".removesuffix(".0") for name, value in pairs)


def pairs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return TTS of every controller against every other, paired by seed.

    There is a row for each pair at each demand level.
    """
    out = []
    for level, here in rows.groupby("demand", sort=True):
        for name, other in permutations(here["controller"].unique(), 2):
            pair = paired(by_seed(rows, level, name), by_seed(rows, level, other))
            out.append((level, name, other, *pair, pair.significant))
    return pd.DataFrame(out, columns=PAIR_COLUMNS)


def shown(table: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return `statistics` of one demand level as two tables of text.

    The first holds outcomes, the second costs and decisions.
    """
    lines = []
    against = table["against"].iloc[0]
    change = "change"
    if against != REFERENCE and len(table) > 1:
        change = f"against {against}"
    for row, many in zip(table.to_dict("records"), _many_teleports(table), strict=True):
        half = row[f"half_interval_{TTS}"]
        spread = "" if math.isnan(half) else f" ± {half:.1e}"
        times = [cell(row[f"{kind}_trip_time_s"], WHOLE) for kind in ("mean", "median", "p95")]
        queue = f"{row['gateway_queue_mean_veh']:.1f} / {row['gateway_queue_max_veh']:.0f}"
        line = {
            "controller": row["controller"],
            "seeds": row["seeds"],
            "TTS [veh s]": f"{row[TTS]:.3e}{spread}",
            change: _change(row),
            "completed": f"{row['completed_veh']:,.0f} of {row['trips']:,.0f}",
            "removed [veh]": _marked(f"{row['removed_veh']:,.0f}", row["removed_veh"] > 0),
            "backlog [veh]": f"{row['final_backlog_veh']:,.0f}",
            "backlog [veh s]": f"{row['total_backlog_veh_s']:.2e}",
            "teleports": _marked(f"{row['teleports']:.0f}", many),
            "trip [s]": " / ".join(times),
            "finished [s]": cell(row["mean_finished_trip_time_s"], WHOLE),
            "departure delay [s]": cell(row["mean_departure_delay_s"], WHOLE),
            "delay [s]": cell(row["mean_time_loss_s"], WHOLE),
            "public transport [s]": cell(row.get("public_transport_delay_s", math.nan), WHOLE),
            "other [veh s]": f"{row['other_time_spent_veh_s']:.2e}",
            "CO2 [kg]": f"{row['co2_kg']:,.0f}",
            "queue [veh]": queue,
            "longest [veh]": cell(row.get("longest_queue_veh", math.nan), WHOLE),
            "full": f"{100 * row['gateway_full_share']:.1f} %",
            "decision [ms]": decision_ms(row),
        }
        for column, (heading, _) in COUNTED.items():
            line[heading] = row[column]
        line["outside SUMO"] = f"{100 * row['overhead_share']:.1f} %"
        lines.append(line)
    whole = pd.DataFrame(lines).set_index("controller")
    outcomes = whole.loc[:, :"teleports"]
    costs = whole.loc[:, "trip [s]":]
    return outcomes.reset_index(), costs.reset_index()


def _marked(number: str, doubtful: bool) -> str:
    """Return a number for a cell, with a mark if it makes the row doubtful."""
    return f"{number} !" if doubtful else number


def _change(row: Mapping) -> str:
    """Return the change of TTS for a cell, "-" if the reference spent no time."""
    percent = row["change_percent"]
    half = row["change_half_interval_percent"]
    if not row["change_seeds"]:
        return ""
    if math.isnan(percent):
        return "-"
    spread = f" ± {max(half, 0.1):.1f}" if half > 0 else ""  # NaN for one seed
    star = "*" if row["change_significant"] else ""
    return f"{percent:+.1f}{spread} %{star}"


def brief(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of `shown` that fit a terminal.

    They are the first four, and of BRIEF as many as there is room for.

    table: `statistics` of one demand level
    """
    outcomes, costs = shown(table)
    whole = outcomes.merge(costs, on="controller")
    whole["controller"] = whole["controller"].map(_in_lines)
    first = list(outcomes)[:4]
    columns = [*first, *BRIEF]
    while len(columns) > len(first):
        lines = text_table(whole[columns].to_dict("records")).splitlines()
        if max(map(len, lines)) <= NARROW:
            break
        columns.pop()
    return whole[columns]


def _in_lines(name: str) -> str:
    """Return the name of a strategy with line breaks before some of its words."""
    words = name.replace("+", " +")
    lines = textwrap.wrap(words, NAME_WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(line.replace(" +", "+") for line in lines)


def text(rows: pd.DataFrame, *, explain: bool = False) -> str:
    """Return the table of one scenario for the terminal.

    explain: with the meanings of its columns
    """
    lines = []
    headings: dict[str, None] = {}
    for level, table in statistics(rows).groupby("demand", sort=True):
        part = brief(table)
        lines += [f"Demand times {level:g}", text_table(part.to_dict("records")), ""]
        for note in notes(table):
            lines += [*wrapped(note, NARROW), ""]
        for heading in part:
            headings[heading.partition(" [")[0]] = None
    if explain:
        for heading in headings:
            if heading in COLUMNS:
                lines += wrapped(f"{heading}: {COLUMNS[heading]}", NARROW)
    return "\n".join(lines).rstrip()


def markdown(rows: pd.DataFrame) -> str:
    """Return the tables of one scenario as markdown."""
    parts = []
    for level, table in statistics(rows).groupby("demand", sort=True):
        parts.append(f"## Demand times {level:g}")
        for part in shown(table):
            parts.append(markdown_table(list(part), part.to_numpy().tolist()))
        parts += notes(table)
    return "\n\n".join([*parts, CAPTION]) + "\n"


def ranking(rows: pd.DataFrame) -> str:
    """Return controllers by their mean change of TTS, as markdown.

    The mean is over scenarios and demand levels. Only seeds that all controllers have count, so
    that all are judged by the same runs. A controller without runs somewhere has no rank.

    rows: of several scenarios
    """
    tables = []
    note = ""
    for _, here in rows.groupby(["scenario", "demand"], sort=False):
        common = on_common_seeds(here)
        if len(common) < len(here):
            note = "\n\nControllers have different seeds: only those that all have count."
        table = statistics(common)
        table["change"] = table["change_percent"].mask(table["controller"] == table["against"], 0.0)
        if table["change"].notna().all():  # else no vehicle spent time
            tables.append(table[["controller", "change"]])
    lines = []
    if tables:
        changes = pd.concat(tables).groupby("controller", sort=False)["change"]
        means = changes.agg(["size", "mean"]).sort_values(["size", "mean"], ascending=[False, True])
        for place, (name, places, mean) in enumerate(means.itertuples(), 1):
            rank = place if places == means["size"].max() else "-"
            lines.append([rank, name, f"{mean:+.1f} %", places])
    headings = ["rank", "controller", "mean change of TTS", "scenarios and demand levels"]
    return markdown_table(headings, lines) + note


def common_runs(level: Level, names: Sequence[str]) -> list[list[Result]]:
    """Return the runs of each controller on the seeds that all have.

    Runs that lack the measures by region are left out.
    """
    runs = []
    for name in names:
        results = level.measures(name)
        runs.append({run.seed: run for run in results if "trip_time_by_origin" in run})
    seeds = sorted(set.intersection(*map(set, runs)))
    return [[of[seed] for seed in seeds] for of in runs]


def longer_trips(level: Level, name: str, against: str) -> PerRegion:
    """Return the change of the mean trip time by origin (%, (R,)).

    It is NaN without trips, and (0,) without a common seed.
    """
    runs, reference = common_runs(level, (name, against))
    if not runs:
        return np.zeros(0)
    own = np.mean([run["trip_time_by_origin"] for run in runs], axis=0)
    before = np.mean([run["trip_time_by_origin"] for run in reference], axis=0)
    return 100.0 * (own / before - 1.0)


def by_region(
    level: Level, city: City, region_names: Sequence[str], names: Sequence[str]
) -> pd.DataFrame | None:
    """Return a row of text per region and one of all.

    It is None without a common seed. Numbers are means over the common seeds, but the longest queue
    is that of all of them.

    names: controllers, the reference first
    """
    runs = common_runs(level, names)
    if not runs[0]:
        return None
    region = city.edge_region
    regions = len(region_names)
    means = [np.mean([_numbers(run, region, regions) for run in of], axis=0) for of in runs]
    columns: dict[tuple[str, str], list[str]] = {("", "region"): [*region_names, "all"]}
    for n, heading in enumerate(("trip from here [s]", "CO2 [kg]")):
        for name, values in zip(names, means, strict=True):
            columns[heading, name] = [_or_dash(value, ",.0f") for value in values[n]]
        if len(names) > 1:
            with np.errstate(divide="ignore", invalid="ignore"):
                changes = 100.0 * (means[-1][n] / means[0][n] - 1.0)
            columns[heading, "change"] = [_or_dash(change, "+.1f", " %") for change in changes]
    inside = [np.flatnonzero(region == r) for r in range(regions)]
    inside.append(np.arange(len(region)))
    for name, of in zip(names, runs, strict=True):
        queue = np.max([run["queue_max"] for run in of], axis=0)
        longest = [edges[np.argmax(queue[edges])] for edges in inside]
        columns["longest queue [veh], on street", name] = [
            f"{queue[edge]}, {city.edges[edge]}" for edge in longest
        ]
    return pd.DataFrame(columns)


def _or_dash(value: float, form: str, unit: str = "") -> str:
    """Return a number as text; a dash where no trip begins."""
    return f"{value:{form}}{unit}" if np.isfinite(value) else "–"


def _numbers(run: Result, region: np.ndarray, regions: int) -> np.ndarray:
    """Return trip times by origin (s) and CO2 (kg) of a run, (2, R + 1)."""
    co2 = np.bincount(region, run["co2"], regions)
    return np.array([[*run["trip_time_by_origin"], run.mean_trip_time_s], [*co2, co2.sum()]])
