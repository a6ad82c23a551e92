"""The shapes that annotations name are checked at every call while testing."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from cosim.evaluation.model_validation import held_up
from nmfd.types import State

pytestmark = pytest.mark.skipif("config.getoption('annotations') == 'off'", reason="--annotations=off")


@pytest.mark.parametrize(
    "accumulation, backlog",
    [
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.zeros((2, 2)), np.zeros((3, 3))),
        (np.zeros((2, 2), int), np.zeros((2, 2))),
    ],
    ids=["not square", "of other regions", "whole numbers"],
)
def test_a_wrong_shape_is_noticed(accumulation, backlog):
    with pytest.raises(TypeCheckError, match="Type-check error"):
        State(step=0, time=0.0, accumulation=accumulation, backlog=backlog, completed=0.0)


def test_regions_are_as_many_everywhere_in_a_call():
    x = np.ones((4, 3))
    held_up(x, x, np.ones((3, 3), dtype=bool))
    with pytest.raises(TypeCheckError, match="adjacency"):
        held_up(x, x, np.ones((2, 2), dtype=bool))
