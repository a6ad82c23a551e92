"""The shapes that annotations name are checked at every call while testing."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from nmfd.model.mfd import held_up
from nmfd.types import State

pytestmark = pytest.mark.skipif(
    "config.getoption('annotations') == 'off'", reason="--annotations=off"
)


def test_a_wrong_shape_is_noticed():
    for backlog in (np.zeros((3, 3)), np.zeros((2, 3)), np.zeros((2, 2), int)):
        with pytest.raises(TypeCheckError, match="Type-check error"):
            State(step=0, time=0.0, accumulation=np.zeros((2, 2)), backlog=backlog, completed=0.0)
    with pytest.raises(TypeCheckError, match="adjacency"):
        held_up(np.ones((4, 3)), np.ones((4, 3)), np.ones((2, 2), dtype=bool))
