"""What came of a benchmark: its rows, and these as text, in a notebook, for pandas and xarray."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from nmfd.html import html_table
from nmfd.metrics import COUNTED, percent_change
from nmfd.runs.tables import text_table
from nmfd.studies.benchmark import REFERENCE, compared_with, interval

if TYPE_CHECKING:
    import pandas
    import xarray

UNITS = {"veh_s": "veh s", "veh": "veh", "s": "s", "ms_median": "ms", "ms_max": "ms"}  # by the end of a column's name
CAPTION = (
    "TTS: total time spent, mean over seeds ± 95 % interval; change: of TTS against {against}; control: time of all "
    "decisions of a run; step: median / longest decision; decisions of all seeds: "
    + "; ".join(f"{heading}: {what}" for heading, what in COUNTED.values())
)
BOUND_CAPTION = (
    "; above bound: TTS against the bound with the same controls, perimeter alone (PC) or with routes (PCRG)"
)


class Summary(list[dict]):
    """The rows of summary.csv, one per run: a list of tables column -> value, with units in the names of the columns.

    `print` shows what the command prints: a line per controller with the means over seeds.
    """

    def to_frame(self) -> "pandas.DataFrame":
        """A row per run."""
        import pandas  # half a second

        return pandas.DataFrame(list(self))

    def to_xarray(self) -> "xarray.Dataset":
        """The figures by controller and seed, with units as attributes; NaN where a controller has no such seed."""
        data = self.to_frame().set_index(["controller", "seed"]).to_xarray()
        for name, column in data.data_vars.items():
            unit = next((unit for end, unit in UNITS.items() if str(name).endswith(f"_{end}")), "")
            column.attrs |= {"units": unit} if unit else {}
        return data

    def __str__(self) -> str:
        """As the command prints them."""
        return summary_table(self)

    def _repr_html_(self) -> str:
        """The same for notebooks."""
        lines, caption = _lines(self)
        return html_table(list(lines[0]) if lines else [], [line.values() for line in lines], caption)


def summary_table(rows: Sequence[Mapping]) -> str:
    """The rows of summary.csv as text: one line per controller, means over seeds, TTS with its 95 % interval."""
    return text_table(*_lines(rows))


def _lines(rows: Sequence[Mapping]) -> tuple[list[dict], str]:
    """What a table of the rows shows, and its caption."""
    groups: dict[str, list[Mapping]] = {}
    for row in rows:
        groups.setdefault(row["controller"], []).append(row)
    tts = {name: [row["total_time_spent_veh_s"] for row in group] for name, group in groups.items()}
    against = compared_with(tts) if tts else REFERENCE
    with_bound = any(name in tts for name in ("bound-pc", "bound-pcrg"))
    lines = []
    for name, group in groups.items():

        def mean(column: str, group: Sequence[Mapping] = group) -> float:
            return statistics.fmean(row[column] for row in group)

        spread = interval(tts[name])
        change = _percent(tts[name], tts[against]) if name != against else ""
        bound = "bound-pcrg" if "-pcrg" in name else "bound-pc"
        above = _percent(tts[name], tts[bound]) if bound in tts and name != bound else ""
        lines.append(
            {
                "controller": name,
                "seeds": len(group),
                "TTS [veh s]": _scientific(statistics.fmean(tts[name]))
                + ("" if math.isnan(spread) else f" ± {_scientific(spread, 1)}"),
                "change": change,
                **({"above bound": above} if with_bound else {}),
                "final [veh]": f"{mean('final_accumulation_veh'):,.0f}",
                "max [veh]": f"{mean('max_accumulation_veh'):,.0f}",
                "completed [veh]": f"{mean('completed_veh'):,.0f}",
                "control [s]": f"{mean('evaluation_time_s'):.3g}",
                "step [ms]": f"{mean('control_step_ms_median'):.3g} / "
                f"{max(row['control_step_ms_max'] for row in group):.3g}",
                **{heading: sum(row[column] for row in group) for column, (heading, _) in COUNTED.items()},
            }
        )
    return lines, CAPTION.format(against=against) + BOUND_CAPTION * with_bound


def _percent(values: Sequence[float], reference: Sequence[float]) -> str:
    """How far the mean of `values` is above that of `reference`, like +1.7 %; - where that is 0."""
    change = percent_change(statistics.fmean(values), statistics.fmean(reference))
    return "-" if math.isnan(change) else f"{change:+.1f} %"


def _scientific(value: float, digits: int = 4) -> str:
    """Like 1.7730e8."""
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
