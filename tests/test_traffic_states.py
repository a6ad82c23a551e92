"""The state of a region is told by what left it: the same accumulation can flow or stand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from matplotlib.colors import to_rgb
from tiny import made

from nmfd.api import load_scenario, run
from nmfd.model.mfd import Mfd
from nmfd.studies import plots, traffic_states
from nmfd.studies.benchmark import draw_accumulations
from nmfd.studies.traffic_states import TrafficState, model_outflow, states

MFD = Mfd(a=0.98405 * 0.004 / 1000.0**2, b=-1.9719 * 0.004 / 1000.0, c=0.004, jam=1000.0)  # critical at 339
STEP, T = 90.0, 40


def of(accumulation, outflow, mfd=MFD):
    """The states of a run at the accumulations (T,) [veh] with the outflows (T,) [veh/s]."""
    x = np.broadcast_to(accumulation, (T + 1,)).astype(float)
    return [TrafficState(kind) for kind in states(mfd, STEP, [x], [np.broadcast_to(outflow, (T,)).astype(float)])[0]]


@pytest.mark.parametrize(
    "held, share, expected",
    [
        (339, 1.0, TrafficState.NEAR_CAPACITY),
        (339, 0.0, TrafficState.STANDING),
        (339, 0.05, TrafficState.STANDING),
        (380, 0.6, TrafficState.CONGESTED),
        (700, 0.4, TrafficState.CONGESTED),
        (700, 1.0, TrafficState.NEAR_CAPACITY),
        (2000, 0.0, TrafficState.STANDING),
        (100, 0.5, TrafficState.FLOWING),
        (100, 0.15, TrafficState.CONGESTED),
        (100, 0.0, TrafficState.STANDING),
        (0, 0.0, TrafficState.FLOWING),
        (2, 0.0, TrafficState.FLOWING),  # nobody, and too few to tell from chance
    ],
)
def test_the_outflow_decides_not_the_accumulation(held, share, expected):
    assert set(of(held, share * MFD.capacity)) == {expected}


def test_who_has_just_come_does_not_stand():
    """The first vehicles of a morning have had no time to leave."""
    x = np.minimum(20.0 * np.arange(T + 1), 100.0)
    found = of(x, np.where(np.arange(T) < 2, 0.0, MFD.outflow(x[:-1])))
    assert TrafficState.STANDING not in found and found[-1] == TrafficState.FLOWING


def test_a_curve_that_never_falls_hides_no_collapse():
    """Fitted to too little, its critical accumulation is its jam; the run lets out less and less all the same."""
    endless = Mfd(a=0.0, b=0.0, c=0.004, jam=5000.0)
    x = np.linspace(0.0, 1000.0, T + 1)
    out = np.where(np.arange(T) < T // 2, 0.004 * x[:-1], 0.4)
    found = of(x, out, endless)
    assert found[T // 4] == TrafficState.FLOWING and found[-1] == TrafficState.CONGESTED


def test_a_curve_with_too_little_capacity_makes_no_light_traffic_full():
    weak = replace(MFD, a=MFD.a / 4, b=MFD.b / 4, c=MFD.c / 4)
    x = 300.0 * np.sin(np.linspace(0.0, np.pi, T + 1))
    found = of(x, MFD.outflow(x[:-1]), weak)
    assert found[2] == TrafficState.FLOWING and TrafficState.STANDING not in found


@pytest.fixture(scope="module")
def scenario():
    return load_scenario(Path(__file__).parents[1] / "scenarios" / "economic_mpc")


def standing_run(scenario, share, controller="no-control"):
    """A run that holds `share` of the critical accumulation in every region all the time."""
    regions = scenario.network.regions
    state = np.repeat(np.diag([share * mfd.critical for mfd in scenario.network.mfds])[None], T + 1, axis=0)
    return made(
        controller=controller,
        plant="sumo",
        seed=0,
        step=STEP,
        accumulation=state,
        backlog=np.zeros_like(state),
        completed=np.zeros(T + 1),
        perimeter=np.zeros((T, regions, regions)),
        splits=np.zeros((T, regions, regions, regions)),
    )


def colours_in(ax):
    """What is filled in an axes, as colours."""
    faces = [tuple(face[:3]) for part in ax.collections for face in part.get_facecolor()]
    return {*faces, *(tuple(patch.get_facecolor()[:3]) for patch in ax.patches)}


def test_a_region_that_nothing_leaves_is_not_green(scenario):
    """At its critical accumulation by the curve, with vehicles leaving and without."""
    network, held = scenario.network, standing_run(scenario, 1.0)
    for out, kind in ((0.0, TrafficState.STANDING), (network.mfds[0].capacity, TrafficState.NEAR_CAPACITY)):
        ax = plots.region_accumulation(
            plots.figure(4, 3).subplots(), network, 0, [held], outflow=lambda t, out=out: np.full((T, 7), out)
        )
        green = {to_rgb(traffic_states.LOOKS[TrafficState.NEAR_CAPACITY][1])}
        assert bool(green & colours_in(ax)) == (kind == TrafficState.NEAR_CAPACITY)
        assert to_rgb(traffic_states.LOOKS[kind][1]) in colours_in(ax)


def test_strips_hide_no_curve_and_need_an_outflow(scenario):
    runs = [standing_run(scenario, 1.3, controller) for controller in ("no-control", "pi-gating", "dpc-pc")]
    ax = plots.region_accumulation(
        plots.figure(4, 3).subplots(), scenario.network, 0, runs, outflow=lambda t: np.zeros((T, 7))
    )
    below = ax.get_ylim()[1] * (1.0 - 3 * traffic_states.STRIP_HEIGHT)
    assert max(line.get_ydata().max() for line in ax.lines) < below
    bare = plots.figure(4, 3).subplots()
    assert not colours_in(plots.region_accumulation(bare, scenario.network, 0, runs, outflow=lambda t: None))


def test_a_run_on_the_regional_model_shows_the_outflow_of_its_gates(tmp_path):
    """The flow of the model with its perimeter: completions and transfers are the change of what is inside."""
    scenario = load_scenario(tiny.write(tmp_path))
    trajectory = run(scenario, "pi-gating", seed=0)
    out = model_outflow(scenario.network)(trajectory)
    inflow = scenario.demand.sum(axis=2)
    gone = scenario.step * (inflow - out).sum()
    crossed = scenario.step * out.sum() - trajectory.completed[-1]
    assert crossed > 0 and gone + crossed == pytest.approx(trajectory.accumulation[-1].sum(), abs=5.0)
    assert model_outflow(scenario.network)(trajectory.assign(plant="sumo")) is None
    draw_accumulations(tmp_path, scenario, [trajectory])
    assert (tmp_path / "region_accumulation.png").stat().st_size > 5000
