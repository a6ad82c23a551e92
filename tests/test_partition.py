"""Partitions: known answers on made-up cities, connectedness, boundaries where the signals are."""

import numpy as np
import pytest
import tiny_city

from cosim.importing.blocks import make_blocks
from cosim.importing.clustering import agglomerate, features
from cosim.importing.geometric import k_means
from cosim.importing.quality import pieces
from cosim.importing.refine import best, cut, prices, refine
from cosim.importing.regions import finish
from cosim.importing.streets import read_streets


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """A grid of 9 x 9 junctions, 150 m apart."""
    path = tmp_path_factory.mktemp("grid") / "grid.net.xml"
    tiny_city.run(
        "netgenerate",
        "--grid",
        "--grid.number",
        9,
        "--grid.length",
        150,
        "--no-turnarounds",
        "true",
        "--seed",
        1,
        "--output-file",
        path,
    )
    return read_streets(path)


def test_blocks_are_streets_with_both_directions(streets):
    blocks = make_blocks(streets)
    assert len(streets.edges) == 2 * len(blocks.weight) == 288
    for n, edge in enumerate(streets.edges):
        assert blocks.of[n] == blocks.of[streets.number[edge[2:] + edge[:2]]]
    assert blocks.weight.sum() == pytest.approx(streets.lane_metres.sum())
    assert (blocks.near != blocks.near.T).nnz == 0


@pytest.mark.parametrize("regions", [2, 4, 7])
def test_geometric_regions_are_connected_and_alike(streets, regions):
    blocks = make_blocks(streets)
    labels = k_means(blocks, regions, seed=0)
    assert (labels == k_means(blocks, regions, seed=0)).all()
    sizes = np.bincount(labels, blocks.weight, regions) / blocks.weight.sum() * regions
    assert sizes.min() > 0.7 and sizes.max() < 1.4
    found = finish(streets, labels[blocks.of])
    assert set(found) == set(range(regions))
    assert all(pieces(streets, found == region) == 1 for region in range(regions))


def test_density_finds_the_congested_quarter(streets):
    blocks = make_blocks(streets)
    congested = (streets.centre < 600.0).all(axis=1)
    density = np.where(congested, 0.08, 0.01) * np.random.default_rng(0).uniform(0.5, 1.5, len(congested))
    feature = features(blocks, blocks.mean(density, streets.lane_metres))
    found = finish(streets, agglomerate(blocks, feature, 2)[blocks.of])
    inside = np.bincount(found[congested], minlength=2)
    region = int(np.argmax(inside))
    assert inside[region] / congested.sum() > 0.9
    within = sum(density[found == part].var() * (found == part).mean() for part in range(2))
    assert within < 0.5 * density.var()


@pytest.mark.parametrize("regions", [2, 3, 5, 8])
def test_as_many_clusters_as_were_asked_for_none_tiny(streets, regions):
    blocks = make_blocks(streets)
    for seed in range(5):
        density = np.random.default_rng(seed).exponential(0.03, len(streets.edges))
        labels = agglomerate(blocks, features(blocks, blocks.mean(density, streets.lane_metres)), regions)
        sizes = np.bincount(labels, blocks.weight) / blocks.weight.sum() * regions
        assert len(sizes) == regions and sizes.min() > 0.15


def test_refinement_moves_the_boundary_to_the_signals(streets):
    """Without densities a straight cut anywhere near the middle is as good; signals on one line decide."""
    blocks = make_blocks(streets)
    labels = (blocks.position[:, 0] > 700.0).astype(int)
    feature = features(blocks, np.zeros(len(labels)))[:, 1:]
    where = streets.junctions[streets.links[:, 0], 1]
    columns = np.array([name[0] for name in sorted(streets.places, key=streets.places.get)])
    better = refine(blocks, labels, feature, prices(streets, blocks, columns[where] == "E", None))
    crossing = better[blocks.of[streets.links]][:, 0] != better[blocks.of[streets.links]][:, 1]
    before = labels[blocks.of[streets.links]]
    before = (columns[where][before[:, 0] != before[:, 1]] == "E").mean()
    assert (columns[where][crossing] == "E").mean() > max(before, 0.95)
    found = finish(streets, better[blocks.of])
    assert all(pieces(streets, found == region) == 1 for region in range(2))


def test_the_best_of_several_starts(streets):
    """Signals on a line far from the first start: moving block by block does not get there, another start does."""
    blocks = make_blocks(streets)
    feature = features(blocks, np.zeros(len(blocks.weight)))[:, 1:]
    where = streets.junctions[streets.links[:, 0], 1]
    rows = np.array([name[1] for name in sorted(streets.places, key=streets.places.get)])
    price = prices(streets, blocks, rows[where] == "4", None)  # row 4 runs west to east, in the middle
    starts = [(blocks.position[:, axis] > 650.0).astype(int) for axis in (0, 1)]
    alone, found = refine(blocks, starts[0], feature, price), best(blocks, starts, feature, price)
    assert cut(found, price) < 0.5 * cut(alone, price)
    assert (best(blocks, starts[::-1], feature, price) == found).all()
    assert (best(blocks, starts[:1], feature, price) == alone).all()


def test_finish_repairs_what_is_torn(streets):
    labels = (streets.centre[:, 0] > 600.0).astype(int)
    labels[streets.number["A0B0"]] = 1  # an island, far from its region
    labels[streets.number["I8H8"]] = -1  # forgotten
    found = finish(streets, labels)
    assert all(pieces(streets, found == region) == 1 for region in range(2))
    assert found[streets.number["A0B0"]] == found[streets.number["B0A0"]]
    assert found[streets.number["I8H8"]] == found[streets.number["H8I8"]]


def test_a_region_without_return_goes_to_its_neighbour(tmp_path):
    """A way in and a way out, both one-way, cannot be regions: nobody could come back."""
    nodes = (
        "<nodes>"
        + "".join(
            f'<node id="{n}" x="{x}" y="{y}"/>'
            for n, x, y in (("in", 0, 0), ("a", 300, 0), ("b", 600, 0), ("c", 450, 200), ("out", 900, 0))
        )
        + "</nodes>"
    )
    edges = (
        "<edges>"
        + "".join(
            f'<edge id="{a}-{b}" from="{a}" to="{b}" numLanes="1" speed="13.9"/>'
            for a, b in (("in", "a"), ("a", "b"), ("b", "c"), ("c", "a"), ("b", "out"))
        )
        + "</edges>"
    )
    (tmp_path / "n.xml").write_text(nodes)
    (tmp_path / "e.xml").write_text(edges)
    tiny_city.run(
        "netconvert",
        "--node-files",
        tmp_path / "n.xml",
        "--edge-files",
        tmp_path / "e.xml",
        "--output-file",
        tmp_path / "net.xml",
    )
    streets = read_streets(tmp_path / "net.xml")
    assert streets.core.sum() == 3 and streets.main_part.all()
    labels = np.array([{"in-a": 0, "b-out": 2}.get(edge, 1) for edge in streets.edges])
    assert set(finish(streets, labels)) == {0}
    labels = np.array([{"in-a": 0, "a-b": 0}.get(edge, 1) for edge in streets.edges])
    assert len(set(finish(streets, labels))) == 2
