"""The verdict of a study, as a function of paired changes alone."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.studying.verdict import NOTHING_PERCENT, Answer, judge

CHANGES = st.lists(st.floats(-60.0, 60.0).map(lambda x: round(x, 3)), min_size=2, max_size=10)


@pytest.mark.parametrize(
    "changes, answer, decided",
    [
        ((-14.0, -15.0, -13.0), Answer.GAINS, True),
        ((0.0, 0.0, 0.0), Answer.NOTHING, True),  # gates that stay open
        ((0.2, -0.3, 0.1), Answer.NOTHING, True),
        ((9.0, 10.0, 11.0), Answer.HARMS, True),
        ((-4.0, -2.0, -3.0), Answer.GAINS, False),  # above zero, but perhaps below 2 %
        ((-10.0, 8.0, -4.0), Answer.UNKNOWN, False),
        ((-14.0,), Answer.UNKNOWN, False),
        ((-14.0, -14.0), Answer.UNKNOWN, False),
        ((), Answer.UNKNOWN, False),
    ],
)
def test_answers(changes, answer, decided):
    verdict = judge(changes)
    assert (verdict.answer, verdict.decided) == (answer, decided)


def test_seeds_that_would_decide():
    undecided = judge((-10.0, 8.0, -4.0, -9.0))
    assert undecided.answer is Answer.UNKNOWN
    assert undecided.needed > 4
    enough = (-10.0, 8.0, -4.0, -9.0) * (undecided.needed // 4 + 1)
    assert judge(enough).answer is Answer.GAINS
    assert judge((-2.0, 2.0, 30.0, -30.0)).needed is None


@given(CHANGES)
def test_the_answer_follows_the_interval(changes):
    verdict = judge(changes)
    low, high = verdict.percent - verdict.half, verdict.percent + verdict.half
    if verdict.answer is Answer.GAINS:
        assert high < 0.0
        assert verdict.percent < -NOTHING_PERCENT
    if verdict.answer is Answer.NOTHING:
        assert -NOTHING_PERCENT <= low <= high <= NOTHING_PERCENT
    if verdict.decided:
        assert verdict.answer is not Answer.UNKNOWN
    if verdict.answer is not Answer.UNKNOWN:
        assert verdict.needed is not None
        assert verdict.needed <= verdict.seeds
    assert math.isclose(sum(verdict.odds), 1.0)
    assert verdict.odds.nothing > -1e-9


@given(CHANGES)
def test_gain_and_harm_are_mirror_images(changes):
    one, other = judge(changes), judge([-change for change in changes])
    mirror = {Answer.GAINS: Answer.HARMS, Answer.HARMS: Answer.GAINS}
    assert other.answer is mirror.get(one.answer, one.answer)
    assert math.isclose(one.odds.gains, other.odds.harms, abs_tol=1e-9)
    assert (one.decided, one.needed) == (other.decided, other.needed)
