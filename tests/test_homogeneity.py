"""How good partitions are: NcutSilhouette and TV_n by hand, and in a city with an obvious partition."""

import numpy as np
import pandas as pd
import pytest
import tiny_city

from cosim.importing import homogeneity, quality
from cosim.importing.baseline import INTERVAL, Baseline, averaged
from cosim.importing.partition import Clustered, alternatives, partition
from cosim.importing.streets import read_streets
from cosim.sumo.net import load_city


def test_homogeneity_by_hand():
    """Three regions in a row with densities (1, 3), (2, 2) and (10, 14): variances 1, 0 and 4, means 2, 2 and 12."""
    density, regions = np.array([1.0, 3.0, 2.0, 2.0, 10.0, 14.0]), np.array([0, 0, 1, 1, 2, 2])
    row = np.array([[False, True, False], [True, False, True], [False, True, False]])
    assert homogeneity.dissimilarity(density[:2], density[4:]) == 1.0 + 4.0 + 100.0
    pairs = [(a - b) ** 2 for a in density[:2] for b in density[4:]]
    assert np.mean(pairs) == 105.0
    # NSN: within 2, 0 and 8; between 0 and 1: 1, between 1 and 2: 104; 0 and 2 do not touch
    assert homogeneity.ncut_silhouettes(density, regions, row) == pytest.approx([2.0, 0.0, 8.0 / 104.0])
    mean = 32.0 / 6.0
    total = float(((density - mean) ** 2).sum())
    assert homogeneity.variance_shares(density, regions, 3) == pytest.approx([2.0 / total, 0.0, 8.0 / total])
    alone = homogeneity.ncut_silhouettes(density, regions, np.zeros((3, 3), dtype=bool))
    assert np.isnan(alone).all()
    assert homogeneity.ncut_silhouettes(np.ones(6), regions, row) == pytest.approx([1.0, 1.0, 1.0])
    assert np.isnan(homogeneity.variance_shares(np.ones(6), regions, 3)).all()


def test_an_obvious_partition_is_the_best_of_several(tmp_path):
    """A grid whose west is dense and whose east is empty: two regions are found, and no number of them is better."""
    net = tiny_city.network(tmp_path, "--tls.set", "B1,C2", name="tiny.net.xml")
    streets = read_streets(net)
    west = streets.centre[:, 0] < np.median(streets.centre[:, 0])
    held = np.where(west, 0.08, 0.01) * streets.lane_metres * INTERVAL
    held = np.stack([held, held])
    runs = [
        Baseline(presence=(1 + share) * held, production=held, ways={}, teleports=0, waiting=0, running=0)
        for share in (-0.2, 0.0, 0.2)
    ]
    baseline = averaged(runs)
    assert baseline.presence == pytest.approx(held)
    cut = Clustered(method="density", regions=2)
    regions, *_ = partition(streets, baseline, cut, seed=0)
    others = alternatives(streets, baseline, cut, regions, seed=0)
    assert list(others) == [2, 3, 4]
    (tmp_path / "regions.csv").write_text(
        "edge,region\n" + "".join(f"{e},{r}\n" for e, r in zip(streets.edges, regions, strict=True))
    )
    found = quality.tables(
        streets, regions, ["west", "east"], load_city(net, tmp_path / "regions.csv", 2), baseline, {}, others
    )
    table = pd.DataFrame(found.partitions).set_index("asked")
    assert table.chosen.to_dict() == {2: 1, 3: 0, 4: 0}
    assert table.ncut_silhouette[2] == table.ncut_silhouette.min() < 0.2 and table.tv_n[2] < 0.2
    whole = found.quality[-1]
    assert whole["ncut_silhouette"] == table.ncut_silhouette[2] and whole["tv_n"] == table.tv_n[2]
    assert sum(row["tv_n"] for row in found.quality[:-1]) == pytest.approx(whole["tv_n"], abs=2e-4)
    wrong = quality.tables(
        streets,
        np.where(streets.centre[:, 1] > np.median(streets.centre[:, 1]), 1, 0),
        ["a", "b"],
        load_city(net, tmp_path / "regions.csv", 2),
        baseline,
        {},
    ).quality[-1]
    assert wrong["ncut_silhouette"] > 0.9 and wrong["tv_n"] > 0.9
