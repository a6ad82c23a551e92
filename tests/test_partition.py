"""Partitions: connected regions of similar density with boundaries at signals, and the user's own
table."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import tiny_city
from tiny_city import pieces

from cosim.importing.baseline import INTERVAL_S, Baseline
from cosim.importing.boundaries import Turns, with_room
from cosim.importing.choice import _Search, choose, densest_region
from cosim.importing.partition import finish, make_blocks, names, own_regions, partition
from cosim.importing.quality import doubts
from cosim.importing.streets import read_streets
from nmfd.errors import InputError


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """A grid of 9 x 9 junctions, 150 m apart."""
    path = tmp_path_factory.mktemp("grid") / "grid.net.xml"
    options = "--grid --grid.number 9 --grid.length 150 --no-turnarounds true --seed 1"
    tiny_city.run("netgenerate", options, "--output-file", path)
    return read_streets(path)


def every_turn(streets):
    """Every turn as a way of its own, made once."""
    return {(int(a), int(b)): 1 for a, b in streets.links}


def baseline(streets, density):
    """A run with constant densities [veh/m of lane] in which one vehicle makes every turn."""
    presence = np.tile(density * streets.lane_metres * INTERVAL_S, (3, 1))
    ways = {(turn, turn[1]): 1 for turn in every_turn(streets)}
    return Baseline(presence=presence, ways=ways)


def test_blocks_are_streets_with_both_directions(streets):
    blocks = make_blocks(streets)
    assert len(streets.edges) == 2 * len(blocks.weight) == 288
    for n, edge in enumerate(streets.edges):
        assert blocks.of[n] == blocks.of[streets.number[edge[2:] + edge[:2]]]
    assert blocks.weight.sum() == pytest.approx(streets.lane_metres.sum())
    assert (blocks.joins != blocks.joins.T).nnz == 0


@pytest.mark.parametrize("regions", [2, 4, 7])
def test_regions_are_connected_and_as_many_as_requested(streets, regions):
    random = np.random.default_rng(0).exponential(0.03, len(streets.edges))
    found = partition(streets, baseline(streets, random), regions)
    assert set(found) == set(range(regions))
    assert all(pieces(streets, found == region) == 1 for region in range(regions))
    sizes = np.bincount(found, streets.lane_metres) / streets.lane_metres.sum() * regions
    assert sizes.min() > 0.3
    assert (partition(streets, baseline(streets, random), regions) == found).all()


def test_density_finds_the_congested_quarter(streets):
    congested = (streets.centre < 600.0).all(axis=1)
    density = np.where(congested, 0.08, 0.01) * np.random.default_rng(0).uniform(
        0.5, 1.5, len(congested)
    )
    found = partition(streets, baseline(streets, density), 2)
    region = int(np.argmax(np.bincount(found[congested], minlength=2)))
    assert (found[congested] == region).mean() > 0.8
    within = sum(density[found == part].var() * (found == part).mean() for part in range(2))
    assert within < 0.6 * density.var()


def test_boundaries_are_at_signals(streets):
    """Half of the junctions have signals: more of the boundary is there than if none of these could
    be used."""
    at = streets.junctions[streets.links[:, 0], 1]
    signalled = np.random.default_rng(1).random(streets.junctions.max() + 1) < 0.5
    signals = tuple("s" if signalled[place] else None for place in at)
    with_signals = replace(streets, link_signals=signals)
    run = baseline(streets, np.random.default_rng(0).exponential(0.03, len(streets.edges)))
    shares = []
    for uncontrollable in ([], ["s"]):
        found = partition(with_signals, run, 3, uncontrollable=uncontrollable)
        crossing = found[streets.links[:, 0]] != found[streets.links[:, 1]]
        shares.append(signalled[at[crossing]].mean())
    assert shares[0] > max(shares[1], 0.6)


def test_finish_repairs_what_is_torn(streets):
    labels = (streets.centre[:, 0] > 600.0).astype(int)
    labels[streets.number["A0B0"]] = 1  # an island, far from its region
    labels[streets.number["I8H8"]] = -1  # forgotten
    found = finish(streets, labels)
    assert all(pieces(streets, found == region) == 1 for region in range(2))
    assert found[streets.number["A0B0"]] == found[streets.number["B0A0"]]
    assert found[streets.number["I8H8"]] == found[streets.number["H8I8"]]


def test_own_regions_may_be_in_pieces(streets):
    """They stay as they are, and the import says so."""
    labels = (streets.centre[:, 0] > 600.0).astype(int)
    labels[streets.number["A0B0"]] = 1
    labels[streets.number["I8H8"]] = -1
    found = finish(streets, labels, own=True)
    assert (found != labels).nonzero()[0] == [streets.number["I8H8"]]
    assert found[streets.number["I8H8"]] == 1
    sentences = doubts(streets, found, ("west", "east"))
    assert ["region 1 east is in 2 pieces" in sentence for sentence in sentences] == [True]


def test_a_region_without_return_goes_to_its_neighbour(tmp_path):
    """A way in and a way out, both one-way, cannot be regions: no vehicle could come back."""
    places = (("in", 0, 0), ("a", 300, 0), ("b", 600, 0), ("c", 450, 200), ("out", 900, 0))
    nodes = "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, x, y in places)
    edges = "".join(
        f'<edge id="{a}-{b}" from="{a}" to="{b}" numLanes="1" speed="13.9"/>'
        for a, b in (("in", "a"), ("a", "b"), ("b", "c"), ("c", "a"), ("b", "out"))
    )
    (tmp_path / "n.xml").write_text(f"<nodes>{nodes}</nodes>")
    (tmp_path / "e.xml").write_text(f"<edges>{edges}</edges>")
    tiny_city.run(
        "netconvert", "-n", tmp_path / "n.xml", "-e", tmp_path / "e.xml", "-o", tmp_path / "net.xml"
    )
    streets = read_streets(tmp_path / "net.xml")
    assert streets.core.sum() == 3
    assert streets.main_part.all()
    labels = np.array([{"in-a": 0, "b-out": 2}.get(edge, 1) for edge in streets.edges])
    assert set(finish(streets, labels)) == {0}
    labels = np.array([{"in-a": 0, "a-b": 0}.get(edge, 1) for edge in streets.edges])
    assert len(set(finish(streets, labels))) == 2


@pytest.mark.parametrize(
    "text, expected",
    [
        ("edge,part\nA0A1,0\n", "line 1: expected edge,region"),
        ("edge,region\nA0A1,x\n", "line 2: expected an edge and a region"),
        ("edge,region\nnone,0\n", "edge none is not in"),
        ("edge,region\nA0A1,0\nA0A1,1\n", "edge A0A1 appears twice"),
        (
            "edge,region\nA0A1,0\nA1A2,2\n",
            "expected two or more regions 0, 1, ..., each with an edge",
        ),
    ],
)
def test_mistakes_in_a_table_of_regions(streets, tmp_path, text, expected):
    (tmp_path / "own.csv").write_text(text)
    with pytest.raises(InputError, match=expected):
        own_regions(streets, tmp_path / "own.csv")


def test_the_chosen_partition_is_the_one_whose_gates_hold_most(tmp_path):
    """Six junctions of a grid have signals, and every turn is made once."""
    streets = read_streets(tiny_city.network(tmp_path))
    density = np.where(streets.centre[:, 0] < 250.0, 0.08, 0.01)
    run = baseline(streets, density)
    routes = every_turn(streets)
    signals = {signal for signal in streets.link_signals if signal}

    def entered(labels, uncontrollable=()):
        turns = Turns(streets, routes, with_room(streets, uncontrollable))
        return turns.entered(labels == densest_region(streets, run, labels))

    for regions in (None, 2):
        choice = choose(streets, run, routes, regions=regions)
        held, leaked = entered(choice.labels)
        assert held - leaked > np.subtract(*entered(partition(streets, run, 2)))
        assert f"of {len(routes)} vehicles {held} first enter the densest one" in choice.reason
        assert np.bincount(choice.labels, streets.lane_metres).min() >= 3000.0
        assert entered(choice.labels, signals).held == 0
        densest = choice.labels == densest_region(streets, run, choice.labels)
        assert density[densest].mean() > density[~densest].mean()
        if regions:
            assert set(choice.labels) == {0, 1}
        assert all(pieces(streets, choice.labels == n) == 1 for n in set(choice.labels))


def test_two_regions_are_chosen_even_if_one_would_leak_less(tmp_path, monkeypatch):
    streets = read_streets(tiny_city.network(tmp_path))
    routes = every_turn(streets)
    signals = {signal for signal in streets.link_signals if signal}
    run = baseline(streets, np.full(len(streets.edges), 0.01))
    everywhere = np.zeros(len(streets.edges), dtype=int)
    monkeypatch.setattr(_Search, "results", lambda *_: [everywhere])
    assert choose(streets, run, routes, uncontrollable=signals).labels.max() == 1


def test_a_vehicle_counts_once_where_it_first_enters_from_elsewhere(streets):
    """Along a row of streets, of which every other one is inside."""
    row = [streets.number[f"{a}0{b}0"] for a, b in pairwise("ABCDEF")]
    inside = np.isin(np.arange(len(streets.edges)), row[1::2])
    links = [tuple(link) for link in streets.links]
    held = np.array([link == (row[0], row[1]) for link in links])
    routes = {tuple(row): 5, tuple(row[2:]): 3, tuple(row[1:]): 7, (row[0],): 1, (row[1],): 1}
    assert Turns(streets, routes, held).entered(inside) == (5, 3)
    assert Turns(streets, routes, ~held).entered(inside) == (3, 5)
    assert Turns(streets, {}, held).entered(inside) == (0, 0)


def test_a_region_round_the_centre_is_a_ring(streets):
    inside = (np.abs(streets.centre - 600.0) < 310.0).all(axis=1)
    assert names(streets, inside.astype(int)) == ("ring", "centre")


def test_a_gate_needs_room_before_it(streets):
    signals = ("s",) * len(streets.links)
    short = replace(streets, link_signals=signals, length=np.full(len(streets.edges), 40.0))
    assert with_room(replace(streets, link_signals=signals), ()).all()
    assert not with_room(streets, ()).any()
    assert not with_room(replace(streets, link_signals=signals), ["s"]).any()
    assert not with_room(short, ()).any()
    # Before the last one, queues reach back to streets without a signal.
    last = (None,) * (len(signals) - 1) + ("s",)
    held = with_room(replace(short, link_signals=last), ())
    assert np.flatnonzero(held).tolist() == [len(signals) - 1]
