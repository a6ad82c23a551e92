"""Arrays of a wrong shape are noticed while testing, at every definition whose annotations say one."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from trajectories import record

from cosim.evaluation.model_validation import held_up
from cosim.plant.record import Record


def test_a_function_is_given_the_same_intervals_and_regions_everywhere():
    x = np.ones((4, 3))
    held_up(x, x, np.ones((3, 3), dtype=bool))
    with pytest.raises(TypeCheckError, match="adjacency"):
        held_up(x, x, np.ones((2, 2), dtype=bool))


def test_a_record_has_one_number_of_intervals():
    kept = record(4, regions=2)
    with pytest.raises(TypeCheckError, match="teleports"):
        Record(**{**kept, "teleports": np.zeros(5)})
