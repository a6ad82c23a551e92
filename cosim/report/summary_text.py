"""What the runs of a demand level say, in plain words and numbers."""

import math
from collections.abc import Sequence

import pandas as pd

from cosim.evaluation import statistics
from cosim.report import pictures
from nmfd.studies.benchmark import REFERENCE

# Of decisions: column of summary.csv -> what is said of so many.
WORDS = {
    "solver_failures": "without an answer of the solver or policy",
    "fallbacks": "by a fallback",
    "late_decisions": "late",
    "sensor_faults": "on a faulty measurement",
    "plant_faults": "in a faulty city",
}


def opening(name: str, steps: int, step: float, levels: int, rows: pd.DataFrame) -> str:
    """What was run: `steps` control intervals of `step` s."""
    controllers = list(dict.fromkeys(rows["controller"]))
    at = "one demand level" if levels == 1 else f"{levels} demand levels"
    return (
        f"{_count(len(controllers), 'strategy', 'strategies')} for the signals and routes of a simulated city were run "
        f"in the microsimulation SUMO on the scenario {name}, at {at} and with {_seeds(rows)}, "
        f"for {_count(steps, 'control interval')} of {step:g} s each ({steps * step / 60:.0f} min). With the same seed "
        f"every strategy meets the same trips."
    )


def head(rows: pd.DataFrame) -> str:
    """What matters most; `rows` of one demand level, as in cosim.evaluation.statistics."""
    return " ".join(part for part in (best(rows), _unfinished(rows), _removed(rows), _teleports(rows)) if part)


def details(rows: pd.DataFrame) -> list[str]:
    """What else is to know; `rows` as in `head`."""
    return [text for text in (_beyond_chance(rows), _uneven(rows), _decisions(rows)) if text]


def best(rows: pd.DataFrame) -> str:
    """Which strategy spent the least time, by how much, whether that may be chance, and on what it was chosen."""
    level, names = rows["demand"].iloc[0], pictures.ranked(rows)
    against = statistics.compared_with(rows)
    others = [name for name in names if name != against]
    if not others:
        return f"Only {against} was run: total time spent {_time(rows, against)}."
    first = others[0]
    pair = statistics.paired(statistics.by_seed(rows, level, first), statistics.by_seed(rows, level, against))
    if not pair.seeds:
        return (
            f"The lowest total time spent was that of {first}, {_time(rows, first)}; there is no run of "
            f"{against} with the same seed to compare it with."
        )
    if math.isnan(pair.percent):
        return (
            f"The total time spent of {against} was {_time(rows, against)}, that of {first} "
            f"{_time(rows, first)}: a change in percent is not defined."
        )
    if pair.percent < 0:
        text = (
            f"The best strategy was {first}: total time spent {_time(rows, first)}, {-pair.percent:.1f} % less "
            f"than {statistics.than(against)}."
        )
    else:
        other = "no control" if against == REFERENCE else against
        text = (
            f"No strategy was better than {other}; the nearest was {first}, whose total time spent "
            f"{_time(rows, first)} is {pair.percent:.1f} % more."
        )
    text += " " + _certainty(pair)
    if len(others) > 1:
        text += (
            f" It was chosen among {len(others)} on these very runs ({_seeds(rows)}), so its lead is "
            "flattered; only other seeds would tell its true size."
        )
        second = others[1]
        lead = statistics.paired(statistics.by_seed(rows, level, first), statistics.by_seed(rows, level, second))
        if lead.seeds and not math.isnan(lead.percent):
            text += (
                f" Against the second, {second}, total time spent changes by {lead.percent:+.1f} %. {_certainty(lead)}"
            )
    return text


def _certainty(pair: statistics.Paired) -> str:
    if pair.seeds < 2:
        return "That is a single seed: there is no interval, and it may be chance."
    low, high = pair.percent - pair.percent_half, pair.percent + pair.percent_half
    verdict = "excludes zero: more than chance" if pair.excludes_zero else "includes zero: the difference may be chance"
    return (
        f"The 95 % interval of that change, paired over {pair.seeds} seeds, is {low:+.1f} to {high:+.1f} % and "
        f"{verdict}."
    )


def _beyond_chance(rows: pd.DataFrame) -> str:
    """Which strategies differ from what all are compared with by more than chance."""
    level, against = rows["demand"].iloc[0], statistics.compared_with(rows)
    better: list[str] = []
    worse: list[str] = []
    open_: list[str] = []
    for name in pictures.ranked(rows):
        pair = statistics.paired(statistics.by_seed(rows, level, name), statistics.by_seed(rows, level, against))
        if name != against and pair.seeds > 1 and not math.isnan(pair.percent):
            (open_ if not pair.excludes_zero else better if pair.percent < 0 else worse).append(name)
    parts = [
        f"{what}: {', '.join(names)}"
        for what, names in (
            (f"less time than {statistics.than(against)}", better),
            ("more", worse),
            ("not told apart from it", open_),
        )
        if names
    ]
    return f"By intervals that exclude zero or do not, {'; '.join(parts)}." if better or worse or open_ else ""


def _uneven(rows: pd.DataFrame) -> str:
    counts = rows["controller"].value_counts(sort=False)
    if counts.nunique() == 1:
        return ""
    most = counts.max()
    fewer = ", ".join(f"{name} {count}" for name, count in counts.items() if count < most)
    return (
        f"Not all strategies have all {most} seeds ({fewer}): their mean times are of different trips; only the "
        "changes, which are paired by seed, compare like with like."
    )


def _unfinished(rows: pd.DataFrame) -> str:
    """Trips that were not completed at the end."""
    left = []
    for name, part in rows.groupby("controller", sort=False):
        trips, done = part["trips"].mean(), part["completed_veh"].mean()
        if trips - done >= 0.5:
            left.append(f"{name} {trips - done:,.0f} of {trips:,.0f}")
    if not left:
        return "Every trip was completed in every run."
    others = " The others completed all." if len(left) < rows["controller"].nunique() else ""
    return f"Trips not completed at the end, mean per run: {'; '.join(left)}.{others}"


def _removed(rows: pd.DataFrame) -> str:
    """Vehicles that somebody took out; nothing where nobody did, or where an older version did not record it."""
    if "removed_veh" not in rows or not rows["removed_veh"].any():
        return ""
    counts = rows.groupby("controller", sort=False)["removed_veh"].mean()
    parts = ", ".join(f"{name} {count:,.1f}" for name, count in counts.items() if count > 0)
    return (
        f"Vehicles removed before the last edge of their route (by calibrators, collisions, teleports off the net, "
        f"waits too long or other programs), mean per run: {parts}. They are no completed trips, and total time "
        "spent has them as if they were there to the end; those whom they no longer hinder gain all the same."
    )


def _teleports(rows: pd.DataFrame) -> str:
    counts = rows.groupby("controller", sort=False)["teleports"].sum()
    if not counts.any():
        return "No vehicle was teleported."
    parts = ", ".join(f"{name} {count:.0f}" for name, count in counts.items() if count)
    return f"Vehicles teleported out of a jam, which makes a strategy look better than it is: {parts}."


def _decisions(rows: pd.DataFrame) -> str:
    parts = [
        f"{name} {count:.0f} {WORDS[column]}"
        for column in WORDS
        for name, count in rows.groupby("controller", sort=False)[column].sum().items()
        if count
    ]
    if parts:
        return f"Decisions that did not come as they should: {', '.join(parts)}; all runs together."
    return "Every decision came within its control interval, and none was a fallback."


def _time(rows: pd.DataFrame, name: str) -> str:
    mean = rows.loc[rows["controller"] == name, statistics.TTS].mean()
    return f"{mean / 3600:,.0f} vehicle hours ({mean:.3e} veh s)"


def _seeds(rows: pd.DataFrame) -> str:
    return f"seed{'s' if rows['seed'].nunique() > 1 else ''} {seeds(rows['seed'])}"


def seeds(values: Sequence[int]) -> str:
    """Like 2000 to 2004, 2007."""
    parts: list[list[int]] = []
    for seed in sorted(set(map(int, values))):
        if parts and parts[-1][-1] == seed - 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(f"{part[0]} to {part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"
