"""Figures: colours, units on the axes, and the data in them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tiny import made

from nmfd.api import load_scenario
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.studies import benchmark, plots

SCENARIO = "economic_mpc"
DOLLARS = "ü <b>$x^$</b> & $$y"  # no mathematics: a syntax error


@pytest.fixture(scope="module")
def scenario():
    return load_scenario(SCENARIO)


@pytest.fixture
def ax():
    return plots.figure(5, 4).subplots()


def runs_of(scenario, *, plants=("nmfd",), controllers=("no-control",), seeds=(0,), hours=2.0):
    steps, regions = int(hours * 120), scenario.network.regions
    return [
        made(
            controller=controller,
            plant=plant,
            seed=seed,
            step=30.0,
            completed=np.zeros(steps + 1),
            accumulation=np.full((steps + 1, regions, regions), 10.0),
            backlog=np.ones((steps + 1, regions, regions)),
            perimeter=np.zeros((steps, regions, regions)),
            splits=np.zeros((steps, regions, regions, regions)),
        )
        for plant in plants
        for controller in controllers
        for seed in seeds
    ]


def test_every_controller_has_its_own_colour():
    names = [*CONTROLLERS, "max-pressure", *(f"dpc-pc+rerouting-{n}" for n in range(10, 90, 10))]
    colours = plots.colours(names)
    assert len({colours[name] for name in names}) == len(names)


def test_total_accumulation_counts_the_backlog(ax, scenario):
    plots.total_accumulation(ax, runs_of(scenario))
    assert ax.lines[0].get_ydata() == pytest.approx(49 * 11.0)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [min]", "vehicles in the network [veh]")
    assert ax.get_xlim() == (0.0, 120.0)


def test_seeds_share_one_curve_and_controllers_do_not(ax, scenario):
    plots.total_accumulation(
        ax, runs_of(scenario, controllers=("no-control", "dpc-pc"), seeds=(0, 1))
    )
    assert [line.get_label() for line in ax.lines] == ["no-control", "dpc-pc"]
    assert [line.get_color() for line in ax.lines] == [
        plots.COLOURS["no-control"],
        plots.COLOURS["dpc-pc"],
    ]


def test_plants_differ_in_line_style(ax, scenario):
    plots.region_accumulation(ax, scenario.network, 3, runs_of(scenario, plants=("sumo", "nmfd")))
    lines = ax.lines
    assert [(line.get_label(), line.get_linestyle()) for line in lines] == [
        ("SUMO", "-"),
        ("regional model", "--"),
    ]
    assert len({line.get_color() for line in lines}) == 1
    assert lines[0].get_ydata() == pytest.approx(70.0)
    assert "veh" in ax.get_ylabel()


def test_mfd_with_samples(ax, scenario):
    samples = {"loading": np.array([[1000.0, 3.0], [6000.0, 8.0]]), "unloading": np.empty((0, 2))}
    plots.mfd(ax, scenario.network.mfds[0], samples)
    assert ax.get_ylim()[1] > 8.0
    assert ax.get_xlim()[1] > 6000.0
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("accumulation [veh]", "outflow [veh/s]")


def test_spawn_matrix_shows_the_trips_of_every_pair(ax, scenario):
    plots.spawn_matrix(ax, scenario)
    assert [text.get_text() for text in ax.texts] == ["5,280"] * 6
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("destination region", "origin region")


def test_scenario_without_demand(scenario):
    left, right = plots.figure(8, 4).subplots(1, 2)
    empty = replace(scenario, demand=np.zeros_like(scenario.demand))
    plots.spawn_matrix(left, empty)
    plots.demand(right, empty)
    left.figure.canvas.draw()


@pytest.mark.parametrize("width", [4, 8, 16])
def test_the_legend_fits_the_figure(scenario, width):
    drawing = plots.figure(width, 4)
    ax = plots.region_accumulation(
        drawing.subplots(), scenario.network, 3, runs_of(scenario, controllers=CONTROLLERS)
    )
    plots.legend_below(drawing, [ax], columns=8)
    assert len(drawing.legends) == 1
    assert len(drawing.legends[0].get_texts()) == len(CONTROLLERS) + 1
    assert (
        drawing.legends[0].get_window_extent(drawing.canvas.get_renderer()).width
        <= drawing.bbox.width
    )


@pytest.mark.slow
def test_names_with_dollars_are_text_in_every_figure(scenario, tmp_path):
    network = replace(scenario.network, region_names=(DOLLARS,) * 7)
    named = replace(scenario, name=DOLLARS, network=network)
    runs = runs_of(named, plants=("nmfd", DOLLARS), controllers=(DOLLARS, "no-control"))
    benchmark.draw_accumulations(tmp_path, named, runs, title=DOLLARS)
    benchmark.draw_scenario(tmp_path, named)
    plots.draw_mfds(tmp_path / "samples.png", network, [{DOLLARS: np.ones((3, 2))}] * 7)
    drawing = plots.figure(5, 4)
    ax = plots.with_intervals(drawing.subplots(), {DOLLARS: {1.0: (2.0, 0.1)}})
    ax.set_ylabel(f"time of {DOLLARS}")
    plots.legend_below(drawing, [ax])
    plots.save(drawing, tmp_path / "intervals.png")
    assert len(list(tmp_path.glob("*.png"))) == 7


def pixels(drawing, name):
    """The picture of a logarithmic axis with a name in every place that takes one."""
    ax = drawing.subplots()
    ax.loglog([1.0, 1000.0], [1.0, 10.0], label=name)
    ax.set(title=name, xlabel=name, ylabel="veh")
    ax.text(10.0, 5.0, name)
    drawing.suptitle(name)
    ax.legend()
    canvas = FigureCanvasAgg(drawing)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_names_look_as_matplotlib_draws_escaped_ones():
    """The powers of ten at the ticks of a logarithmic axis stay mathematics."""
    usual = Figure(figsize=(5, 4), layout="constrained")
    expected = pixels(usual, DOLLARS.replace("$", r"\$"))
    np.testing.assert_array_equal(pixels(plots.figure(5, 4), DOLLARS), expected)


@pytest.mark.filterwarnings("error")
def test_a_region_without_vehicles_has_an_axis(ax, scenario):
    unseen = replace(scenario.network, critical_above={3: 0.0})
    (run,) = runs_of(scenario)
    run = run.assign(accumulation=np.zeros_like(run["accumulation"]))
    assert plots.region_accumulation(ax, unseen, 3, [run]).get_ylim()[1] > 1.0
