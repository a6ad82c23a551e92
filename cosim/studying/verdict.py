"""Verdict on a strategy from changes of the time spent, paired by seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from statistics import fmean, stdev
from typing import NamedTuple

from scipy.special import stdtr, stdtrit

from nmfd.studies.benchmark import interval

NOTHING_PERCENT = 2.0  # a change up to this, either way, is nothing
FEWEST_SEEDS = 3
MOST_NEEDED = 200  # seeds; more are not counted
# Quantile of a two-sided 95 % interval, for every look after three to ten seeds. A verdict is clear
# only beyond 2 %. So what changes nothing is called a gain in about 5 % of studies at most
# (simulated, spread of a seed up to 10 %). A level of 1.2 % for each of eight looks halves that. It
# takes a fifth more runs, and changed none of 16 recorded verdicts.
CERTAIN = 0.975


class Answer(Enum):
    """Answer of a verdict."""

    GAINS = "gains"
    NOTHING = "changes nothing"
    HARMS = "harms"
    UNKNOWN = "cannot say"


class Odds(NamedTuple):
    """Probabilities of gain, nothing and harm; NaN for one seed."""

    gains: float
    nothing: float
    harms: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict on a strategy.

    percent: mean change of the time spent (%), NaN without a seed
    half: half of its 95 % interval (%), NaN for one seed
    decided: the interval contains neither -2 nor 2 %, so that more seeds are not needed
    needed: seeds that would be enough for an answer if their spread stays; None if unknown or more
        than MOST_NEEDED
    """

    answer: Answer
    percent: float
    half: float
    seeds: int
    odds: Odds
    decided: bool
    needed: int | None

    @property
    def change(self) -> str:
        """The change with its interval, such as "-14.0 ± 2.1 %"."""
        if math.isnan(self.percent):
            return "-"
        digits = 0 if self.half >= 10.0 else 1
        spread = "" if math.isnan(self.half) else f" ± {self.half:.{digits}f}"
        mean = round(self.percent, digits) + 0.0  # no -0.0
        return f"{mean:+.{digits}f}{spread} %"

    @property
    def chance(self) -> str:
        """Probability of the answer, such as "95 %"; "" if it is UNKNOWN."""
        if self.answer is Answer.UNKNOWN:
            return ""
        share = max(self.odds)  # no answer is less likely than another one
        return ">99 %" if share > 0.99 else f"{100.0 * share:.0f} %"


def judge(changes: Sequence[float]) -> Verdict:
    """Return the verdict on changes of the time spent, one per seed (%).

    A strategy gains (harms) if the interval excludes zero and the mean is beyond the 2 % that
    count as nothing. It changes nothing if the interval lies within them.
    """
    seeds = len(changes)
    mean = fmean(changes) if seeds else math.nan
    half = interval(changes)
    answer = Answer.UNKNOWN
    decided = False
    needed: int | None = FEWEST_SEEDS
    if seeds >= FEWEST_SEEDS and not math.isnan(half):
        decided = half < abs(abs(mean) - NOTHING_PERCENT) or half == 0.0
        if abs(mean) + half <= NOTHING_PERCENT:
            answer = Answer.NOTHING
        elif mean < -NOTHING_PERCENT and half < abs(mean):
            answer = Answer.GAINS
        elif mean > NOTHING_PERCENT and half < abs(mean):
            answer = Answer.HARMS
        needed = seeds_needed(mean, stdev(changes))
    return Verdict(
        answer=answer,
        percent=mean,
        half=half,
        seeds=seeds,
        odds=odds(mean, half, seeds),
        decided=decided,
        needed=needed,
    )


def odds(mean: float, half: float, seeds: int) -> Odds:
    """Return the probabilities of gain, nothing and harm by Student's t.

    mean, half: of the change, and half of its 95 % interval (%)
    """
    if seeds < 2 or math.isnan(half):
        return Odds(math.nan, math.nan, math.nan)
    if half == 0.0:
        return Odds(
            gains=float(mean < -NOTHING_PERCENT),
            nothing=float(abs(mean) <= NOTHING_PERCENT),
            harms=float(mean > NOTHING_PERCENT),
        )
    freedom = seeds - 1
    error = half / stdtrit(freedom, CERTAIN)
    gains = float(stdtr(freedom, (-NOTHING_PERCENT - mean) / error))
    harms = float(stdtr(freedom, (mean - NOTHING_PERCENT) / error))
    return Odds(gains=gains, nothing=1.0 - gains - harms, harms=harms)


def seeds_needed(mean: float, deviation: float) -> int | None:
    """Return the fewest seeds whose interval gives an answer.

    None if they are more than MOST_NEEDED.

    mean, deviation: of the changes (%)
    """
    margin = abs(mean)
    if margin <= NOTHING_PERCENT:
        margin = NOTHING_PERCENT - margin
    for seeds in range(FEWEST_SEEDS, MOST_NEEDED + 1):
        half = stdtrit(seeds - 1, CERTAIN) * deviation / math.sqrt(seeds)
        if half <= margin:
            return seeds
    return None
