"""The shapes that annotations name are checked at every call while testing."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from nmfd.types import State

pytestmark = pytest.mark.skipif("config.getoption('annotations') == 'off'", reason="--annotations=off")


@pytest.mark.parametrize("accumulation, backlog", [
    (np.zeros((2, 3)), np.zeros((2, 3))), (np.zeros((2, 2)), np.zeros((3, 3))),
    (np.zeros((2, 2), int), np.zeros((2, 2))),
], ids=["not square", "of other regions", "whole numbers"])
def test_a_wrong_shape_is_noticed(accumulation, backlog):
    with pytest.raises(TypeCheckError, match="Type-check error"):
        State(step=0, time=0.0, accumulation=accumulation, backlog=backlog, completed=0.0)
