"""Trips from counts on streets, by SUMO's routeSampler.py."""

from collections import Counter

import numpy as np
import pytest
import tiny_city
from commands import cosim, error_line, good

from cosim.importing.baseline import Baseline
from cosim.importing.counts import geh, sampled
from cosim.importing.streets import read_streets
from cosim.sumo.xml_files import attribute, child, read_xml

COUNTS = {"A1B1": 120, "B1C1": 90, "C2B2": 60}
WINDOW = 600.0, 1200.0


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A network and a file of counts."""
    folder = tmp_path_factory.mktemp("counts")
    net = tiny_city.network(folder)
    (folder / "counts.xml").write_text(meandata(COUNTS))
    return net


def meandata(counts):
    begin, end = WINDOW
    counts = {":A0_0": 7} | counts  # a junction does not count
    edges = [f'<edge id="{edge}" entered="{count}"/>' for edge, count in counts.items()]
    interval = f'<interval begin="{begin}" end="{end}">{"".join(edges)}</interval>'
    return f"<meandata>{interval}</meandata>"


def test_the_trips_give_the_counts(city, tmp_path):
    streets = read_streets(city)
    found = sampled(city.parent / "counts.xml", streets, tmp_path, 1, lambda stage, share=0.0: None)
    passed = Counter()
    ways = Counter()
    for vehicle in read_xml(found.routes).iter("vehicle"):
        assert WINDOW[0] <= float(attribute(vehicle, "depart")) <= WINDOW[1]
        edges = attribute(child(vehicle, "route"), "edges").split()
        passed.update(edges)
        numbers = tuple(streets.number[edge] for edge in edges)
        ways[numbers, numbers[-1]] += 1
    assert {edge: passed[edge] for edge in COUNTS} == pytest.approx(COUNTS, abs=3)
    baseline = Baseline(presence=np.zeros((1, 1)), ways=ways)
    expected = "counts: 100% of 3 streets have a GEH below 5 by the sampled routes, 100% in the run"
    assert found.text(streets, baseline).startswith(expected)
    stuck = {((), 0): 9}  # on their first street
    nobody = Baseline(presence=np.zeros((1, 1)), ways=stuck)
    assert "0% in the run without control; WARNING" in found.text(streets, nobody)


def test_geh():
    """100 and 121 vehicles an hour differ by 2, two thousand and the same difference by less."""
    flows = geh(np.array([100.0, 2000.0, 0.0]), np.array([121.0, 2021.0, 0.0]))
    assert flows == pytest.approx([1.998, 0.468, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    "content, options, expected",
    [
        ("<net/>", "", "expected <meandata>, got a file of <net>"),
        (meandata({"none": 3}), "", "edge none is not in"),
        (meandata({"A1B1": 0}), "", "all counts (entered) are 0"),
        (meandata(COUNTS).replace("entered", "flow"), "", "edge A1B1: entered: missing"),
        (meandata(COUNTS), "--demand peak", "has vehicles of its own; omit --routes"),
    ],
)
def test_one_clear_line(city, tmp_path, out, content, options, expected):
    (tmp_path / "counts.xml").write_text(content)
    given = ("--counts", tmp_path / "counts.xml", "--regions 2 --out", out)
    assert expected in error_line(cosim("import", city, *given, options))
    assert not out.exists()


@pytest.mark.slow
def test_a_city_from_counts(city, tmp_path):
    given = ("--counts", city.parent / "counts.xml", "--regions 2 --seeds 1")
    text = good(cosim("import", city, *given, "--out", tmp_path / "networks" / "city"))
    assert "counts: 100% of 3 streets have a GEH below 5" in text
    assert (tmp_path / "scenarios" / "city" / "vehicles.rou.xml.gz").is_file()
