"""The leaderboard as one HTML page with everything in it; every name of a controller is text that is escaped."""

from collections.abc import Sequence
from pathlib import Path

from cosim.compete.entry import Entry
from cosim.compete.metrics import METRICS, TTS
from cosim.compete.table import RULE, Leaderboard, Row
from cosim.report import html
from nmfd import __version__
from nmfd.metrics import COUNTED
from nmfd.runs.files import write_text

DIGITS = {TTS: ".4g", "delay_gini": ".2f", "locked": ".0%", "decision_ms_median": ".2g", "decision_ms_max": ".2g"}
HEADINGS = {
    "controller": "the entry",
    "rank": "1 is the best; none where a run is missing or failed",
    "worth": "total time spent over that of no control, geometric mean; less is better",
    "runs": "that count, of all",
    "failed": "runs that do not count: too late, wrong or broken",
    "late": COUNTED["late_decisions"][1],
}
MADE = {
    "controller": "the entry",
    "made": "by which command",
    "with": "versions of the sessions that made the runs",
    "commit": "of the package's checkout in these sessions",
    "when": "first and last session",
}
NAMES = {"metric": "here", "what": "it is", "RESCO": "its name for it", "LibSignal": "its name for it"}


def write(path: Path, board: Leaderboard) -> None:
    """The page, atomically."""
    scripts = [html.sorting()]
    found = [(row.name, reason) for row in board.overall for reason in row.reasons]
    write_text(
        path,
        html.environment("cosim.compete", "cosim.report")
        .get_template("leaderboard.html.j2")
        .render(
            board=board,
            rule=RULE,
            overall=_overall(board),
            tasks=[(task, about, _task(task, board.by_task[task])) for task, about in board.tasks.items()],
            failures=found
            and html.table(
                "failed runs",
                ["controller", "run"],
                found,
                {"controller": HEADINGS["controller"], "run": "and why"}.__getitem__,
                words=True,
            ),
            made=html.table(
                "how the entries were made",
                [*MADE],
                [_made(name, one) for name, one in board.entries.items()],
                MADE.__getitem__,
                words=True,
            ),
            metrics=html.table(
                "what the metrics are",
                [*NAMES],
                [
                    (metric.heading, metric.text, metric.resco or "–", metric.libsignal or "–")
                    for metric in METRICS.values()
                ],
                NAMES.__getitem__,
                words=True,
            ),
            scripts=scripts,
            allowed=html.allowed(scripts),
            version=__version__,
        ),
    )


def _overall(board: Leaderboard) -> dict:
    worths = {(row.name, task): row for task, rows in board.by_task.items() for row in rows}
    columns = ["controller", "rank", "worth", *board.tasks, "runs", "failed", "late"]
    rows = [
        (
            row.name,
            row.rank,
            number(row.worth, ".3f"),
            *(in_task(worths[row.name, task]) for task in board.tasks),
            _runs(row),
            row.failed,
            number(row.metrics["late_decisions"], ".0f"),
        )
        for row in board.overall
    ]
    return html.table("all tasks", columns, rows, lambda name: HEADINGS.get(name, "worth in this task"))


def in_task(row: Row) -> str:
    """What the overall table says of a task."""
    if row.failed:
        return f"{row.failed} failed"
    return (
        "not run"
        if row.missing and not row.runs
        else f"{row.missing} missing"
        if row.missing
        else number(row.worth, ".3f")
    )


def _task(task: str, rows: Sequence[Row]) -> dict | None:
    """None where nobody has run it."""
    if not any(row.runs or row.failed for row in rows):
        return None
    shown = [name for name in METRICS if name == TTS or any(row.metrics[name] is not None for row in rows)]
    told = {metric.heading: metric.text for metric in METRICS.values()} | HEADINGS
    columns = ["controller", "rank", "worth", "runs", "failed", *(METRICS[name].heading for name in shown)]
    lines = [
        (
            row.name,
            row.rank,
            number(row.worth, ".3f"),
            _runs(row),
            row.failed,
            *(number(row.metrics[name], DIGITS.get(name, ",.1f" if name.endswith("_s") else ",.0f")) for name in shown),
        )
        for row in rows
    ]
    return html.table(task, columns, lines, told.__getitem__)


def _runs(row: Row) -> str:
    return f"{row.runs} of {row.runs + row.failed + row.missing}"


def _made(name: str, one: Entry) -> tuple[str, ...]:
    versions, commits, dates = dict[str, str](), dict[str, None](), list[str]()
    for session in one.sessions:
        versions |= session.get("versions", {})
        commit = str(session.get("commit") or "unknown")[:12]
        commits[f"{commit} with changes" if session.get("dirty") else commit] = None
        dates.append(str(session.get("date", "")))
    return (
        name,
        one.command,
        ", ".join(f"{package} {version}" for package, version in versions.items()),
        ", ".join(commits),
        " to ".join(dict.fromkeys([min(dates), max(dates)] if dates else [])),
    )


def number(value: float | None, form: str) -> str:
    """Nothing for what is not known."""
    return "" if value is None else format(value, form)
