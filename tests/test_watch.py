"""Watching: the same run as without a window, marks in the colour of their command, and where there is no screen.

Without a screen SUMO's program without a window stands in for sumo-gui; it is driven the same way.
"""

import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import copies
import numpy as np
import pytest
from commands import cosim, error_line

from cosim.evaluation.simulate import Task, simulate
from cosim.plant.plant import SumoPlant
from cosim.report import watch
from cosim.sumo import session
from cosim.sumo.build import ensure_built
from cosim.sumo.net import edge_shapes, load_city
from nmfd.api import load_scenario

ROOT = Path(__file__).parents[1]
XVFB = shutil.which("Xvfb")


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    """Two control intervals of grid7 with the peak at the beginning and a gate that closes early."""
    folder = tmp_path_factory.mktemp("watch")
    copies.grid7(folder)
    text = (ROOT / "scenarios" / "grid7_peak" / "scenario.toml").read_text()
    text = re.sub(r"ramp_up = [\d.]+", "ramp_up = 60.0", text)
    text, count = re.subn(r"outflow_share = [\d.]+", "set_point = [20.0]", text, count=1)
    assert count == 1
    (folder / "scenarios" / "small").mkdir(parents=True)
    (folder / "scenarios" / "small" / "scenario.toml").write_text(text)
    return Task(scenario=folder / "scenarios" / "small", controller="pi-gating", seed=3, steps=2)


def test_a_watched_run_is_the_run(task, monkeypatch):
    painted = []
    monkeypatch.setattr(session.Session, "paint", lambda self, colours: painted.append(colours))
    there, here = watch.watch(task, delay=0, program="sumo"), simulate(task).trajectory
    for name in ("accumulation", "backlog", "completed", "perimeter"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    assert there.accumulation[-1].sum() > 20 and (there.controller, there.plant) == ("pi-gating", "sumo")
    network = load_scenario(task.scenario).network
    files = ensure_built(network)
    marks = watch.marked(load_city(files.net_file, files.regions_csv, network.regions))
    assert len(painted) == 2 and set(painted[0]) == set(marks)  # every gateway of grid7 has a signal
    for k, colours in enumerate(painted):
        for mark, gateway in marks.items():
            u = there.perimeter[k, gateway.source, gateway.target]
            assert colours[mark] == watch.colour((u - network.u_min) / (network.u_max - network.u_min))


def test_marks_are_there_to_be_painted_and_every_street_lies_on_its_region(task):
    network = load_scenario(task.scenario).network
    files = ensure_built(network)
    city = load_city(files.net_file, files.regions_csv, network.regions)
    root = ElementTree.fromstring(watch.layers_xml(city, edge_shapes(city)))
    bands = {element.get("id"): element.get("color") for element in root.iter("poly")}
    assert set(bands) == {f"region-{edge}" for edge in city.edges}
    for region in range(city.regions):
        assert len({bands[f"region-{edge}"] for edge in city.edges if city.region_of[edge] == region}) == 1
    assert len(set(bands.values())) == city.regions
    marks = {element.get("id"): element for element in root.iter("poi")}
    assert set(marks) == set(watch.marked(city)) and len(marks) > 20
    ElementTree.fromstring(watch.view_xml(edge_shapes(city), 20.0))


def test_red_is_closed_and_green_is_open():
    assert watch.colour(0.0) == watch.colour(-1.0) == tuple(watch.CLOSED)
    assert watch.colour(0.5) == tuple(watch.HALF)
    assert watch.colour(1.0) == watch.colour(2.0) == tuple(watch.OPEN)


def test_a_closed_window_ends_the_run_and_another_can_begin(task, monkeypatch):
    started, popen = [], subprocess.Popen

    def start(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(session.subprocess, "Popen", start)
    with pytest.raises(watch.WindowClosed):
        watch.watch(task, delay=0, program="sumo", progress=lambda k, steps: (started[-1].kill(), started[-1].wait()))
    plant = SumoPlant(load_scenario(task.scenario))
    plant.reset(0)
    plant.close()
    assert len(started) == 1 and started[0].returncode is not None


def test_without_a_screen_one_line_points_to_the_film(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    line = error_line(cosim("watch", ROOT / "scenarios" / "grid7_peak", "--controller", "pi-gating", "--gui"))
    assert "no screen" in line and "`cosim video RUN`" in line
    monkeypatch.setenv("DISPLAY", ":9876")
    line = error_line(
        cosim("watch", ROOT / "scenarios" / "grid7_peak", "--controller", "no-control", "--steps", "1", "--gui")
    )
    assert "sumo-gui cannot show" in line and "unable to open display :9876" in line


@pytest.mark.skipif(XVFB is None, reason="no Xvfb")
def test_in_a_window(task, monkeypatch):
    server = subprocess.Popen(
        [XVFB, "-displayfd", "1", "-screen", "0", "1000x800x24"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        monkeypatch.setenv("DISPLAY", f":{server.stdout.readline().strip()}")
        result = cosim(
            "watch", task.scenario, "--controller", "pi-gating", "--seed", "3", "--steps", "1", "--delay", "1", "--gui"
        )
        assert result.exit_code == 0, result.output + str(result.exception)
        assert "pi-gating, seed 3: total time spent" in result.stdout
    finally:
        server.terminate()
        server.wait()
