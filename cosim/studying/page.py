"""Answer of a study: sentences, table of the terminal, HTML page."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.evaluation import results, statistics
from cosim.importing.importer import COMPARISONS, reported
from cosim.reporting import html
from cosim.studying.stages import LABELS, Level, Loading, Outcome, compared
from cosim.studying.verdict import FEWEST_SEEDS, NOTHING_PERCENT, Answer, Verdict
from cosim.sumo.arrays import Points
from cosim.sumo.net import City, edge_shapes, network_folder
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.run_many import TABLE
from nmfd.runs.tables import NARROW, text_table, wrapped
from nmfd.studies.benchmark import REFERENCE
from nmfd.types import Result

PAGE = "study.html"
MOST_PLACES = 10  # streets and signals in a table
# Level of service of a signal -> longest mean delay of a vehicle (s) (Highway Capacity Manual).
SERVICE = {"A": 10.0, "B": 20.0, "C": 35.0, "D": 55.0, "E": 80.0, "F": math.inf}
HALF_RANGE = 50.0  # of the drawn changes (%); larger ones end there
NO_COMPARISON = "Not compared with plain SUMO: the scenario was not imported by this study"


@dataclass(frozen=True, kw_only=True)
class Study:
    """Finished study.

    source: as the user gave it
    place: name or folder of the scenario, for commands
    out: folder of the page; the runs are in its folder runs
    """

    source: str
    place: str
    scenario: Scenario
    load: Loading
    levels: tuple[Level, ...]
    out: Path

    @property
    def runs(self) -> Path:
        """Folder of the runs."""
        return self.out / "runs"

    @property
    def page(self) -> Path:
        """The HTML page."""
        return self.out / PAGE

    @property
    def recommended(self) -> tuple[Level, Outcome] | None:
        """The strategy to recommend, and its demand.

        That is the simplest one that is not told apart from the best: on the common seeds, the best
        one is not shown to save more.
        """
        found = self.best
        if found is None:
            return None
        level, best = found
        for one in level.outcomes:  # the simplest first
            if self.sound(one) and compared(best.spent, one.spent).answer is not Answer.GAINS:
                return level, one
        return found

    @property
    def best(self) -> tuple[Level, Outcome] | None:
        """The strategy that saves most, and its demand.

        That is the lowest demand at which there is one. It gains there, and neither harms nor
        leaves more trips unserved at any demand.
        """
        for level in self.levels:
            sound = [one for one in level.outcomes if self.sound(one)]
            if sound:
                return level, min(sound, key=_percent)
        return None

    def sound(self, candidate: Outcome) -> bool:
        """Return True if a strategy gains here and does no harm anywhere."""
        if candidate.answer is not Answer.GAINS:
            return False
        for one in self.outcomes:
            if one.strategy == candidate.strategy and (harmful(one) or not one.serves):
                return False
        return True

    @property
    def outcomes(self) -> list[Outcome]:
        """Strategies at all demand levels."""
        return [one for level in self.levels for one in level.outcomes]

    @property
    def undecided(self) -> list[Outcome]:
        """Strategies whose verdict is open."""
        return [one for one in self.outcomes if one.answer is Answer.UNKNOWN]


def harmful(one: Outcome) -> bool:
    """Return True if harm is the verdict, or likelier than not."""
    return one.verdict is not None and one.verdict.odds.harms > 0.5


def _percent(one: Outcome) -> float:
    return math.nan if one.verdict is None else one.verdict.percent


def answer(study: Study) -> str:
    """Return the answer to the engineer's question in a sentence or two."""
    found = study.recommended
    today = _only_today(study)
    if found is not None:
        level, one = found
        assert one.verdict is not None
        chance = f"the odds are {one.verdict.chance} that it is more than"
        begins = "Yes:"
        if level is not study.levels[0]:
            begins = "Not today, but with more traffic:"
            if today:
                begins = f"{today} With more traffic"
        return (
            f"{begins} {one.label} would save {one.saved} of the time spent {_at(level)}; "
            f"{chance} {NOTHING_PERCENT:g} %.{_not_told_apart(study, one)}"
        )
    if today:
        return today
    if study.undecided:
        labels = dict.fromkeys(one.label for one in study.undecided)
        return f"Cannot say yet: {', '.join(labels)} may help or not; nothing else does."
    return "No: nothing that was tried saves time without leaving more trips unserved."


def _only_today(study: Study) -> str:
    """Return a sentence on what saves most only today, "" if nothing does."""
    gaining = []
    for one in study.levels[0].outcomes:
        if one.answer is Answer.GAINS and one.serves and not study.sound(one):
            gaining.append(one)
    if not gaining:
        return ""
    best = min(gaining, key=_percent)
    return (
        f"Today {best.label} would save {best.saved} of the time spent, but with more traffic "
        "harm, or leave more trips unserved."
    )


def _not_told_apart(study: Study, simpler: Outcome) -> str:
    """Return a sentence on the best strategy, "" if it is recommended."""
    assert study.best is not None
    _, best = study.best
    if best is simpler:
        return ""
    return f" With {best.saved}, {best.label} is not told apart from that, which is simpler."


def next_line(study: Study) -> str:
    """Return what to do next, from the verdict."""
    best = study.recommended
    if best is not None:
        level, one = best
        demand = "" if level.demand == 1.0 else f" --demand {level.demand:g}"
        command = f"cosim watch {study.place} --controller {one.strategy}"
        return f"Next: {command} --against {REFERENCE}{demand}"
    needed = []
    for one in study.undecided:
        if one.verdict and one.verdict.needed:
            needed.append(one.verdict.needed)
    if needed:
        return f"Next: cosim study {study.source} --most-seeds {min(needed)} --out {study.out}"
    return "Next: nothing; keep the signals as they are."


def details(level: Level) -> list[str]:
    """Return a sentence for every strategy that needs one."""
    lines = []
    for one in level.outcomes:
        if one.answer is Answer.UNKNOWN:
            lines.append(f"{one.label}: {open_verdict(one)}")
        if not one.serves:
            trips = one.means["trips"]
            more = f"{one.more_left * trips:,.0f} of {trips:,.0f} trips more unserved"
            lines.append(f"{one.label}: leaves {more}; not recommended")
    skipped: dict[str, list[str]] = {}
    for name, label in LABELS.items():
        if name in level.skipped:
            skipped.setdefault(level.skipped[name], []).append(label)
    for reason, labels in skipped.items():
        lines.append(f"{', '.join(labels)}: not judged; {reason}")
    return lines


def open_verdict(one: Outcome) -> str:
    """Return the odds of an open verdict, and how many seeds would decide it."""
    verdict = one.verdict
    assert verdict is not None
    if math.isnan(verdict.odds.gains):
        return f"cannot say; {FEWEST_SEEDS} seeds at least"
    odds = verdict.odds
    chances = (
        f"{odds.gains:.0%} that it gains, {odds.nothing:.0%} that it changes nothing, "
        f"{odds.harms:.0%} that it harms"
    )
    more = "many more seeds would be needed"
    if verdict.needed is not None:
        more = f"about {max(verdict.needed, verdict.seeds + 1)} seeds would decide"
    return f"cannot say: {chances}; {more}"


def trust(study: Study) -> list[str]:
    """Return sentences on how far the verdict can be trusted."""
    network = study.scenario.network
    lines = [sameness(study)]
    seeds = [one.verdict.seeds for one in study.outcomes if one.verdict]
    number = f"{min(seeds)}" if min(seeds) == max(seeds) else f"{min(seeds)} to {max(seeds)}"
    lines.append(
        f"{number} seeds per strategy; with the same seed all strategies have the same trips. "
        "Intervals hold for 95 % of sets of so many seeds. A strategy gets no more seeds once its "
        "verdict is clear, so that they hold in 86 % of studies or more; early gains are rather "
        "too large."
    )
    lines.append(broken(study.load))
    unseen = [network.titles[region] for region in sorted(network.critical_above)]
    if network.placeholder:
        lines.append("The critical accumulations of the regions were not measured.")
    elif unseen:
        lines.append(f"Never seen beyond their critical accumulation: {', '.join(unseen)}.")
    finished = results.read(study.runs)
    for level in study.levels:
        teleports = []
        for one in level.outcomes:
            if one.means["teleports"] > 0:
                teleports.append(f"{one.label} {one.means['teleports']:.1f}")
        said = ", ".join(teleports) if teleports else "none"
        lines.append(f"Teleports a run {_at(level)}: {said}.")
        rows = finished.level(level.demand).rows
        table = statistics.statistics(statistics.on_common_seeds(rows))
        lines += [f"{_title(level)}: {text}" for text in statistics.warnings(table)]
    return lines


def sameness(study: Study) -> str:
    """Return the comparison of the import with plain SUMO."""
    found = reported(network_folder(study.scenario.network), COMPARISONS)
    if not found:
        return f"{NO_COMPARISON}."
    return f"{found[0].upper()}{found[1:].rstrip('.')}."


def broken(load: Loading) -> str:
    """Return the demand at which the city breaks without control."""
    level = load.under if load.broken is None else load.broken
    left = f"{load.left[level]:.1%} of its trips are left at the end"
    if load.broken is None:
        return (
            "Without control more demand still completes more trips, up to demand times "
            f"{level:g}, where {left}."
        )
    return (
        f"Without control the city breaks at demand times {level:g}, where fewer trips are "
        f"completed than at the demand before: {left}."
    )


def _at(level: Level) -> str:
    return "at today's demand" if level.demand == 1.0 else f"at demand times {level.demand:g}"


def _title(level: Level) -> str:
    return "Today's demand" if level.demand == 1.0 else f"Demand times {level.demand:g}"


def row(one: Outcome) -> dict[str, str]:
    """Return a strategy as a row of text."""
    means = one.means
    verdict = one.verdict
    said = ""
    change = ""
    if verdict is not None:
        said = verdict.answer.value
        if verdict.chance:
            said += f" ({verdict.chance})"
        change = verdict.change
    return {
        "strategy": one.label,
        "verdict": said,
        "time spent": change,
        "min": f"{means['mean_trip_time_s'] / 60.0:.1f}",
        "served": f"{means['completed_veh']:,.0f}",
        "left": f"{one.left:,.0f}",
        "teleports": f"{means['teleports']:.1f}".removesuffix(".0"),
    }


def text(study: Study) -> str:
    """Return the study for the terminal."""
    lines = []
    for level in study.levels:
        lines.append(f"{_title(level)}; min: minutes per trip")
        lines.append(text_table([row(one) for one in level.outcomes]))
        for line in details(level):
            lines += wrapped(line, NARROW)
        lines.append("")
    for line in (answer(study), *trust(study)):
        lines += wrapped(line, NARROW)
    return "\n".join([*lines, f"Page: {study.page}", next_line(study)])


def write(study: Study) -> Path:
    """Write the page of a study; return its path."""
    best = study.recommended
    names = [REFERENCE]
    demand = study.levels[0].demand
    if best is not None:
        level, one = best
        names.append(one.strategy)
        demand = level.demand
    finished = results.read(study.runs)
    shown = html.map_of(finished, demand=demand, names=names)
    city = finished.map()
    shapes = edge_shapes(city)
    common = statistics.common_runs(finished.level(demand), names)
    runs = [of_strategy for of_strategy in common if of_strategy]
    text = html.rendered(
        "cosim.studying",
        "study.html.j2",
        name=study.scenario.name,
        answer=answer(study),
        next=next_line(study),
        levels=[_shown(level) for level in study.levels],
        trust=trust(study),
        map=shown,
        map_demand=f"{demand:g}",
        queues=queues(city, finished.scenario.network.titles, shapes, runs),
        delays=delays(city, shapes, runs),
        place_names=[LABELS[name] for name in names],
        map_names=" and ".join(LABELS[name] for name in names),
        manifest=html.made_by(finished),
        table=TABLE,
        style=html.style() + (Path(__file__).parent / "study.css").read_text(encoding="utf-8"),
    )
    files.write_text(study.page, text)
    return study.page


def queues(
    city: City, titles: Sequence[str], shapes: Sequence[Points], runs: Sequence[Sequence[Result]]
) -> list[dict]:
    """Return the streets with the longest queues of the first strategy.

    A row has the street, its region, the signal at its end, where it ends (x, y) [m], and the
    longest queue [veh] of every strategy, mean over its seeds.

    titles: of the regions; shapes: of the edges; runs: of every strategy
    """
    means = [np.mean([run["queue_max"] for run in of], axis=0) for of in runs]
    if not means:
        return []
    rows = []
    for edge in np.argsort(-means[0], kind="stable")[:MOST_PLACES]:
        name = city.edges[edge]
        x, y = shapes[edge][-1]
        rows.append(
            {
                "place": name,
                "region": titles[city.edge_region[edge]],
                "signal": city.signals.get(name, "–"),
                "x": round(float(x)),
                "y": round(float(y)),
                "cells": [f"{mean[edge]:.0f}" for mean in means],
            }
        )
    return rows


def delays(city: City, shapes: Sequence[Points], runs: Sequence[Sequence[Result]]) -> list[dict]:
    """Return the signals at which most time is lost under the first strategy.

    A row has the signal, where it is (x, y) [m], vehicles [veh] that passed it in a run, and the
    mean delay [s] and level of service under every strategy. The delay is the time that all
    vehicles lost on the streets before the signal, over their number.

    shapes: of the edges; runs: of every strategy
    """
    if not runs or any("time_loss" not in run for of in runs for run in of):
        return []
    before = defaultdict[str, list[int]](list)  # signal -> numbers of the edges that end there
    for edge, signal in city.signals.items():
        before[signal].append(city.number[edge])
    lost = [np.sum([run["time_loss"] for run in of], axis=0) for of in runs]
    passed = [np.sum([run["passed"] for run in of], axis=0) for of in runs]
    worst = sorted(before, key=lambda signal: -lost[0][before[signal]].sum())
    rows = []
    for signal in worst[:MOST_PLACES]:
        edges = before[signal]
        x, y = np.mean([shapes[edge][-1] for edge in edges], axis=0)
        cells = []
        for spent, count in zip(lost, passed, strict=True):
            delay = float(spent[edges].sum() / max(count[edges].sum(), 1.0))
            grade = next(name for name, longest in SERVICE.items() if delay <= longest)
            cells.append(f"{delay:.0f} s, {grade}")
        rows.append(
            {
                "place": signal,
                "vehicles": f"{passed[0][edges].sum() / len(runs[0]):,.0f}",
                "x": round(float(x)),
                "y": round(float(y)),
                "cells": cells,
            }
        )
    return rows


def _shown(level: Level) -> dict[str, object]:
    """Return what the page shows of a demand level."""
    return {
        "title": _title(level),
        "rows": [_page_row(one) for one in level.outcomes],
        "notes": details(level),
    }


def _page_row(one: Outcome) -> dict[str, object]:
    """Return a row of the page: texts, and the change as a bar."""
    means = one.means
    cells = row(one)
    hours = means[statistics.TTS] / 3600.0
    cells["time"] = f"{hours:,.0f}" if hours >= 100.0 else f"{hours:.1f}"
    delay = means.get("public_transport_delay_s", math.nan)
    cells["bus"] = "–" if math.isnan(delay) else f"{delay:,.0f}"
    cells["co2"] = f"{means['co2_kg'] / 1000.0:,.2f}"
    cells |= dict.fromkeys(("seeds", "answer", "chance"), "")
    tone = ""
    bar: Mapping[str, float] = {}
    if one.verdict is not None:
        cells["seeds"] = str(one.verdict.seeds)
        cells["answer"] = one.verdict.answer.value
        cells["chance"] = one.verdict.chance
        if one.serves:
            tone = one.verdict.answer.name.lower()
        bar = _bar(one.verdict)
    return {**cells, "tone": tone, "bar": bar}


def _bar(verdict: Verdict) -> dict[str, float]:
    """Return where the change and its interval lie on the bar.

    They are left ends and widths, in percent of its width.
    """
    half = 0.0 if math.isnan(verdict.half) else verdict.half
    mean = _place(verdict.percent)
    low = _place(verdict.percent - half)
    return {
        "start": min(mean, 50.0),
        "width": abs(mean - 50.0),
        "low": low,
        "spread": max(_place(verdict.percent + half) - low, 1.0),
    }


def _place(percent: float) -> float:
    """Return where a change lies on the bar, in percent of its width."""
    clipped = min(max(percent, -HALF_RANGE), HALF_RANGE)
    return round(50.0 + 50.0 * clipped / HALF_RANGE, 1)
