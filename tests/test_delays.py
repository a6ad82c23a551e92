"""Delays by the region where trips began, on the acyclic plant."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from nmfd.api import load_scenario, run
from nmfd.metrics import total_time_spent
from nmfd.studies import delays


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Three regions in a row; 0 and 2 send vehicles to 1, 2 less and later."""
    loaded = load_scenario(tiny.write(tmp_path_factory.mktemp("row"), network=tiny.row_network(3)))
    demand = loaded.demand.copy()
    demand[10:, 2, 1] = 0.5
    return replace(loaded, demand=demand)


def test_time_spent_by_origin_adds_up_to_all_of_it(scenario):
    done = run(scenario, "pi-gating", plant="acyclic", progress=False)
    spent, _ = delays._time_spent(scenario, done.perimeter, done.splits)
    assert spent.sum() == pytest.approx(total_time_spent(done)) and spent[1] == 0.0 and spent[0] > spent[2] > 0.0


def test_a_delay_is_beyond_a_road_of_ones_own(scenario):
    alone = replace(scenario, demand=1e-4 * scenario.demand)
    done = run(alone, "no-control", plant="acyclic", progress=False)
    found, trips = delays.delays_by_origin(alone, done)
    np.testing.assert_allclose(trips, alone.step * alone.demand.sum(axis=(0, 2)))
    assert found.max() < 0.1  # s
    crowd = replace(scenario, demand=3.0 * scenario.demand)
    crowded, _ = delays.delays_by_origin(crowd, run(crowd, "no-control", plant="acyclic", progress=False))
    assert crowded[0] > 10.0 and crowded[1] == 0.0
    held = replace(
        run(alone, "no-control", plant="acyclic", progress=False),
        perimeter=np.where(scenario.network.adjacency, 0.1, 0.0) * np.ones((scenario.steps, 1, 1)),
    )
    waiting, _ = delays.delays_by_origin(alone, held)
    assert waiting[0] > 60.0  # behind a gate that is hardly open, with nobody else there
