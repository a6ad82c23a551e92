"""A generated peak: its routes are assigned, and its level is one of a congested network, not of a few full streets."""

import re
import subprocess
from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np
import pandas as pd
import pytest
import sumo
import tiny_city
from commands import cosim, error_line, good

from cosim.importing import level
from cosim.importing.assignment import Effort, assign
from cosim.importing.baseline import Baseline, holding_half
from cosim.importing.streets import read_streets
from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd.api import load_scenario
from nmfd.errors import InputError

NODES = "".join(
    f'<node id="{name}" x="{x}" y="{y}"/>'
    for name, x, y in (("a", 0, 0), ("b", 200, 0), ("c", 700, 200), ("m", 700, 0), ("d", 1200, 0), ("e", 1400, 0))
)
# From b to d: straight on, where two lanes become one at m, or 1.08 times as long over c.
EDGES = "".join(
    f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="{lanes}" speed="{speed}"/>'
    for name, lanes, speed in (("ab", 3, 20), ("bm", 2, 13), ("md", 1, 13), ("bc", 2, 13), ("cd", 2, 13), ("de", 3, 20))
)


@pytest.fixture(scope="module")
def fork(tmp_path_factory):
    """(network, 600 vehicles in ten minutes that all go straight on)"""
    folder = tmp_path_factory.mktemp("fork")
    (folder / "n.nod.xml").write_text(f"<nodes>{NODES}</nodes>")
    (folder / "e.edg.xml").write_text(f"<edges>{EDGES}</edges>")
    net = folder / "fork.net.xml"
    subprocess.run(
        [
            Path(sumo.SUMO_HOME) / "bin" / "netconvert",
            "-n",
            folder / "n.nod.xml",
            "-e",
            folder / "e.edg.xml",
            "-o",
            net,
            "--no-turnarounds",
        ],
        check=True,
        capture_output=True,
    )
    vehicles = [
        fromstring(
            f'<vehicle id="v{n}" type="car" depart="{n}.00" departLane="best"><route edges="ab bm md de"/></vehicle>'
        )
        for n in range(600)
    ]
    return net, [fromstring('<vType id="car"/>'), *vehicles]


def test_routes_spread_until_nobody_gains(fork):
    """The fork: the gap falls to what was asked for, in both of SUMO's models; the seed tells all."""
    net, vehicles = fork
    told = []
    effort = Effort(iterations=2, gap=0.05)
    found = assign(
        net,
        vehicles,
        begin=0.0,
        end=1800.0,
        seed=3,
        effort=effort,
        mesoscopic=False,
        tell=lambda stage, share=0.0: told.append(stage),
    )
    ways = {tuple(route) for route in found.routes.values()}
    assert ways == {("ab", "bm", "md", "de"), ("ab", "bc", "cd", "de")} and len(found.routes) == 600
    queue, followed = ([one.gap for one in found.iterations if one.mesoscopic == kind] for kind in (True, False))
    assert queue[0] > 0.5 and queue[-1] < 0.05 and len(followed) == 1
    assert found.gap == min(followed) and found.reached == (min(followed) <= 0.05)
    assert len(told) == len(found.iterations) and told[0] == "assignment, at most 2 iterations"
    assert "car-following" in told[-1]
    again = assign(net, vehicles, begin=0.0, end=1800.0, seed=3, effort=effort)
    assert again.iterations == found.iterations[: len(queue)]


def test_an_assignment_that_sumo_refuses(fork):
    net, vehicles = fork
    broken = [vehicles[0], fromstring('<vehicle id="v" type="none" depart="0"><route edges="ab bm md de"/></vehicle>')]
    with pytest.raises(InputError, match="duaIterate.py cannot assign routes: Error: .*none"):
        assign(net, broken, begin=0.0, end=600.0, seed=0, effort=Effort(iterations=1))


def test_an_interrupted_assignment_leaves_nothing(fork, monkeypatch, tmp_path):
    """Ctrl-C while duaIterate.py runs: it ends, and so do its children; its folder goes."""
    import psutil

    from cosim.importing import assignment

    class Stopped(subprocess.Popen):
        def wait(self, timeout=None):
            if self.returncode is None and timeout is None and not hasattr(self, "asked"):
                self.asked = True
                raise KeyboardInterrupt
            return super().wait(timeout)

    before = set(psutil.Process().children(recursive=True))
    monkeypatch.setattr(assignment.subprocess, "Popen", Stopped)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    net, vehicles = fork
    with pytest.raises(KeyboardInterrupt):
        assign(net, vehicles, begin=0.0, end=600.0, seed=0, effort=Effort(iterations=1))
    assert not set(psutil.Process().children(recursive=True)) - before and not list(tmp_path.iterdir())


def test_an_import_assigns_its_peak(tmp_path):
    """The gap is in the report and a table, the routes in the scenario; a gap that is not reached is a warning."""
    net = tiny_city.network(tmp_path, "--tls.set", "B1,C2", name="tiny.net.xml")
    text = good(
        cosim(
            "import",
            net,
            "--regions",
            2,
            "--demand",
            "peak",
            "--mesoscopic",
            "--method",
            "geometric",
            "--iterations",
            1,
            "--gap",
            0,
            "--seeds",
            2,
            "--out",
            tmp_path / "networks" / "tiny",
        )
    )
    scenario = load_scenario(tmp_path / "scenarios" / "tiny")
    table = pd.read_csv(scenario.folder / "assignment.csv")
    assert len(table) == 1 and table.chosen.sum() == 1
    assert table.relative_gap[table.chosen == 1].item() == table.relative_gap.min()
    assert scenario.demand_factor == 1.0
    gap = float(re.search(r"([\d.]+) % in iteration", text)[1])
    assert gap == pytest.approx(100 * table.relative_gap.min(), abs=0.06)
    assert "WARNING: the relative gap of 0 % was not reached" in text
    assert re.search(r"half of all vehicles are on \d+ of \d+ edges", text)
    streets = read_streets(net)
    links = set(map(tuple, streets.links))
    for vehicle in read_recorded_trips([scenario.folder / "vehicles.rou.xml.gz"]).elements:
        route = [streets.number[edge] for edge in vehicle.find("route").get("edges").split()]
        assert links.issuperset(zip(route, route[1:], strict=False))
    partitions = pd.read_csv(tmp_path / "networks" / "tiny" / "partitions.csv")
    assert partitions.regions.min() == 2 and partitions.chosen.sum() == 1 and len(partitions) >= 2
    for gap in ("2", "nan"):
        line = error_line(cosim("import", net, "--regions", 2, "--demand", "peak", "--gap", gap, "--out", "x/y"))
        assert f"'--gap': expected a number in [0, 1], got '{gap}' instead" in line


def test_without_a_run_the_report_says_that_nobody_avoids_queues(tmp_path):
    net = tiny_city.network(tmp_path, name="tiny.net.xml")
    text = good(
        cosim(
            "import",
            net,
            "--regions",
            2,
            "--demand",
            "peak",
            "--level",
            0.5,
            "--method",
            "geometric",
            "--no-run",
            "--out",
            tmp_path / "networks" / "tiny",
        )
    )
    assert "WARNING: everybody takes a way that is fastest at free flow" in text
    assert not (tmp_path / "scenarios" / "tiny" / "assignment.csv").exists()


def made(production, *, times, spread=0.4):
    """A run at a level in which one region fills and empties; production(accumulation) [veh m/s]."""
    held = 1000.0 * times * np.minimum(np.arange(1, 17), np.arange(16, 0, -1)) / 8
    return level.Loaded(
        accumulation=np.stack([held, 0.1 * held], axis=1),
        production=np.stack([production(held), 0.5 * held], axis=1),
        spread=np.array([spread, spread]),
    )


def parabola(held):
    return 10.0 * held * np.maximum(1 - held / 2000.0, 0.1)  # critical at 1000 veh


def bottleneck(held):
    return np.minimum(10.0 * held, 5000.0)  # a queue before it grows, the rest flows as before


@pytest.mark.parametrize("mesoscopic", [True, False])
def test_the_level_is_one_at_which_a_region_comes_to_its_critical_accumulation(mesoscopic):
    def probe(times, meso):
        return made(parabola, times=times if meso else 0.9 * times)

    found, congests = level.congesting(probe, mesoscopic=mesoscopic, tell=lambda line: None)
    assert congests and found == 1.2  # three intervals beyond 0.9 times it: from 1.03 on, or from 1.14 on
    assert level.critical(
        *(getattr(probe(2.0, True), name)[:, 0] for name in ("accumulation", "production"))
    ) == pytest.approx(1000.0, rel=0.15)


@pytest.mark.parametrize(
    "probe",
    [
        lambda times, meso: made(bottleneck, times=times),
        lambda times, meso: made(parabola, times=times, spread=0.01),
        lambda times, meso: made(lambda held: 8.0 * held, times=times),
    ],
    ids=["a bottleneck", "a few streets", "free flow"],
)
def test_what_is_no_congested_network(probe):
    assert level.congesting(probe, mesoscopic=True, tell=lambda line: None) == (level.level(level.MOST), False)


def test_concentration():
    assert holding_half(np.array([1.0, 1.0, 1.0, 1.0])) == 2
    assert holding_half(np.array([9.0, 1.0, 1.0, 1.0])) == 1
    assert holding_half(np.zeros(3)) == 0
    presence = np.zeros((6, 4))
    presence[2:5] = [600.0, 100.0, 100.0, 100.0]
    baseline = Baseline(presence=presence, production=presence, ways={}, teleports=0, waiting=0, running=0)
    assert baseline.concentration(np.ones(4, dtype=bool)) == (1, 4)
    assert baseline.concentration(np.array([False, True, True, True])) == (2, 3)


def test_whether_crowded_streets_stand(tmp_path):
    """Half of all vehicles are on one street: they queue there, or they pass."""
    streets = read_streets(tiny_city.network(tmp_path, name="tiny.net.xml"))
    presence = np.full((6, len(streets.edges)), 10.0)
    presence[2:5, 7] = 1e4
    for slower in (1.0, 5.0):
        baseline = Baseline(
            presence=presence, production=presence * streets.speed / slower, ways={}, teleports=0, waiting=0, running=0
        )
        assert baseline.concentration(streets.drivable)[0] == 1
        assert baseline.pace_of_crowded(streets, streets.drivable) == pytest.approx(slower)


@pytest.mark.slow
def test_a_peak_at_the_level_at_which_a_region_congests(tmp_path):
    """--level auto with --demand peak: every level tried is assigned, and the one found is driven as it was."""
    net = tiny_city.network(tmp_path, "--tls.set", "B1,C2", name="tiny.net.xml")
    text = good(
        cosim(
            "import",
            net,
            "--regions",
            2,
            "--demand",
            "peak",
            "--mesoscopic",
            "--method",
            "geometric",
            "--iterations",
            1,
            "--level",
            "auto",
            "--seeds",
            1,
            "--out",
            tmp_path / "networks" / "tiny",
        )
    )
    scenario = load_scenario(tmp_path / "scenarios" / "tiny")
    times = float(re.search(r"demand times ([\d.]+) ", text)[1])
    trips = len(read_recorded_trips([scenario.folder / "vehicles.rou.xml.gz"]).depart)
    usual = good(
        cosim(
            "import",
            net,
            "--regions",
            2,
            "--demand",
            "peak",
            "--method",
            "geometric",
            "--no-run",
            "--out",
            tmp_path / "networks" / "usual",
        )
    )
    assert scenario.demand_factor == 1.0
    assert trips == pytest.approx(times * int(re.search(r"peak: ([\d,]+)", usual)[1].replace(",", "")), rel=0.02)
