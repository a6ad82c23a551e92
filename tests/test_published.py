"""Published benchmarks: their curves, the greedy controller, cities that do not begin empty,
published figures."""

import runpy
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from copies import ROOT

import nmfd
from cosim.plant.settings import settings
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.errors import InputError
from nmfd.metrics import summary, total_time_spent
from nmfd.model import dynamics
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import load_network
from nmfd.model.scenario import with_demand
from nmfd.studies import bound

SCENARIOS = ROOT / "scenarios"
INITIAL = "initial = [[0.0, 100.0], [0.0, 50.0]]"


@pytest.fixture(scope="module")
def two_regions():
    return load_scenario("two_region_2013")


@pytest.fixture
def begun(tmp_path):
    """A scenario that begins with 150 vehicles inside."""
    return load_scenario(tiny.write(tmp_path, scenario=INITIAL + tiny.SCENARIO))


@pytest.mark.parametrize("plant", ["nmfd", "acyclic"])
def test_the_noise_of_the_benchmark_is_a_standard_deviation_of_the_measurement_or_of_the_state(
    plant,
):
    scenario = replace(
        with_demand(load_scenario("economic_mpc"), steps=30), initial=np.full((7, 7), 100.0)
    )
    assert (scenario.measurement_std, scenario.process_std) == (0.25, 0.0)
    moved = replace(scenario, measurement_std=0.0, process_std=0.25)
    quiet, first, again, noisy = (
        nmfd.run(s, "no-control", seed=seed, plant=plant)
        for s, seed in ((scenario, 0), (moved, 0), (moved, 0), (moved, 1))
    )
    assert (quiet.observed - quiet.accumulation).std() == pytest.approx(0.25, rel=0.05)
    assert (first.observed == first.accumulation).all()
    assert (first.accumulation == again.accumulation).all()
    assert (first.accumulation != noisy["accumulation"]).any()
    assert first.accumulation.min() >= 0.0
    assert (first.accumulation - quiet.accumulation)[1].std() == pytest.approx(0.25, rel=0.3)
    assert scenario.hash != moved.hash != replace(moved, process_std=0.0).hash


def test_the_benchmark_without_control():
    """The reconstructed demand, and the published figures, which the constant outflow beyond the
    jam decides."""
    scenario = load_scenario("economic_mpc")
    assert scenario.step * scenario.demand.sum() == pytest.approx(31_680)
    bare = tuple(replace(mfd, jam=1e9) for mfd in scenario.network.mfds)
    other = replace(scenario, network=replace(scenario.network, mfds=bare))
    row, bare_row = (summary(nmfd.run(s, "no-control")) for s in (scenario, other))
    assert row["total_time_spent_veh_s"] == pytest.approx(1.773e8, rel=0.005)
    assert row["final_accumulation_veh"] == pytest.approx(25_526, rel=0.01)
    assert bare_row["final_accumulation_veh"] < 0.9 * 25_526


def seen(inside):
    """A measurement with so many vehicles in every region."""
    return tiny.seen(np.diag(np.array(inside, dtype=float)))


def test_the_curve_of_2013():
    """As printed in section IV: the polynomial over 3600, 6.3 veh/s at 3400 vehicles."""
    for mfd in load_network("two_regions").mfds:
        n = np.array([500.0, 3400.0, 5400.0, 10000.0])
        printed = (1.4877e-7 * n**3 - 2.9815e-3 * n**2 + 15.0912 * n) / 3600.0
        np.testing.assert_allclose(mfd.outflow(n), printed, rtol=1e-6)
        assert mfd.critical == pytest.approx(3400.0, abs=10.0)
        assert mfd.capacity == pytest.approx(6.3, abs=0.05)


@pytest.mark.parametrize(
    "inside, u12, u21",
    [
        ((3000, 2000), 0.9, 0.9),
        ((3000, 4000), 0.1, 0.9),
        ((4000, 3000), 0.9, 0.1),
        ((5400, 4000), 0.9, 0.1),
        ((4000, 5400), 0.1, 0.9),
    ],
)
def test_greedy_decides_by_table_1(two_regions, inside, u12, u21):
    controls = make_controller("greedy", two_regions).act(seen(inside))
    np.testing.assert_array_equal(controls.perimeter, [[0.0, u12], [u21, 0.0]])
    assert controls.splits is None


def test_greedy_closes_the_way_into_the_fuller_of_two_by_their_own_jam():
    """Of congested neighbours it is the one nearer to its jam, which need not hold more
    vehicles."""
    scenario = load_scenario("economic_mpc")
    mfds = list(scenario.network.mfds)
    mfds[3] = replace(mfds[3], a=16 * mfds[3].a, b=4 * mfds[3].b, jam=0.25 * mfds[3].jam)
    scenario = replace(scenario, network=replace(scenario.network, mfds=tuple(mfds)))
    inside = [4000.0, 0.0, 0.0, 1500.0, 0.0, 0.0, 0.0]
    perimeter = make_controller("greedy", scenario).act(seen(inside)).perimeter
    shut = {(i, h) for i, h in np.argwhere(perimeter == 0.1).tolist()}
    assert shut == {(1, 0), (2, 0), (0, 3), (1, 3), (2, 3), (4, 3), (5, 3), (6, 3)}


def test_greedy_does_what_the_paper_has_it_do(two_regions):
    """Published: n1(590) = n2(590) = 4125, and 17.07 thousand trips completed in the hour."""
    trajectory = nmfd.run(two_regions, "greedy")
    assert trajectory["completed"][-1] == pytest.approx(17070.0, rel=0.01)
    n1, n2 = trajectory["accumulation"].sum(axis=2).T
    assert (n1[0], n2[0]) == (5400.0, 4000.0)
    met = int(np.argmax(n1 <= n2))
    assert 60.0 * met == pytest.approx(590.0, abs=90.0)
    assert 0.5 * (n1[met] + n2[met]) == pytest.approx(4125.0, rel=0.03)


def test_trips_of_2018():
    """As many as make the published least distance."""
    scenario = load_scenario("seven_region_2018")
    trips = scenario.step * scenario.demand.sum(axis=0)
    crossed = 1 + scenario.network.hops  # regions on a shortest way
    assert (trips * crossed).sum() * 3600.0 == pytest.approx(3.87e8, rel=1e-3)


@pytest.mark.parametrize(
    "name, arguments", [("seven_region_2018", (240, 35833.33)), ("economic_mpc_figure4", (30,))]
)
def test_demand_files_are_what_the_script_writes(name, arguments):
    scenario = load_scenario(name)
    written = np.zeros_like(scenario.demand)
    for k, i, j, rate in runpy.run_path(str(SCENARIOS / "seven_region_2018" / "demand.py"))[
        "table"
    ](*arguments):
        written[k, i, j] = rate
    np.testing.assert_allclose(scenario.demand, written, atol=1e-9)


def test_the_demand_of_figure_4_gives_the_published_row_without_control():
    """Tumu et al., table I: 1.7727e8 veh s; found by nobody's tuning here."""
    scenario = load_scenario("economic_mpc_figure4")
    trajectory = nmfd.run(scenario, "no-control")
    assert total_time_spent(trajectory) == pytest.approx(1.7727e8, rel=0.02)


def test_drivers_of_2018_prefer_the_fastest_way():
    """In the empty city most go straight through the centre; with that jammed hardly anybody
    does."""
    scenario = load_scenario("seven_region_2018")
    made = make_controller(f"{SCENARIOS / 'seven_region_2018' / 'logit.py'}:LogitDrivers", scenario)
    for inside, least, most in ((0.0, 0.9, 1.0), (9000.0, 0.0, 0.05)):
        controls = made.act(seen([0.0, 0.0, 0.0, inside, 0.0, 0.0, 0.0]))
        assert least <= controls.splits[0, 3, 6] <= most
        sums, network = controls.splits.sum(axis=1), scenario.network
        np.testing.assert_allclose(sums, 1.0 - np.eye(network.regions), atol=1e-12)
        assert (controls.splits[~network.split_mask] == 0.0).all()


def test_a_control_horizon_of_one_holds_the_best_constant_controls(two_regions):
    """No pair of constant gates over the horizon is better than those that the solver finds."""
    options = {"mpc-pc": {"horizon": 10, "control_horizon": 1}}
    controller = make_controller("mpc-pc", replace(two_regions, controller_options=options))
    begin = tiny.seen(two_regions.start)
    chosen = controller.act(begin).perimeter[[0, 1], [1, 0]]
    start, demand = controller.forecast(begin)
    theta = controller.admissible.open(1)[:, 2:]

    def cost(gates):
        plan = np.concatenate([np.reshape(gates, (1, 2)), theta], axis=1)
        return controller.vehicle_steps(start, demand, plan)[0]

    grid = [(u, v) for u in np.linspace(0.1, 0.9, 5) for v in np.linspace(0.1, 0.9, 5)]
    assert cost(chosen) <= min(map(cost, grid)) * (1.0 + 1e-5)


@pytest.mark.parametrize("plant", ["nmfd", "acyclic"])
def test_a_city_that_does_not_begin_empty(begun, plant):
    """Everybody who was inside at first is there, and reaches the end of the trip."""
    quiet = with_demand(begun, steps=20, factor=0.0)
    trajectory = nmfd.run(quiet, "no-control", plant=plant)
    np.testing.assert_array_equal(trajectory["accumulation"][0], [[0.0, 100.0], [0.0, 50.0]])
    assert trajectory["accumulation"][-1].sum() + trajectory["completed"][-1] == pytest.approx(
        150.0
    )
    assert trajectory["completed"][-1] > 50.0
    assert (quiet.start == begun.initial).all()
    assert quiet.hash != replace(quiet, initial=None).hash


def test_policies_are_trained_and_bounds_sought_from_the_same_start(begun):
    quiet = replace(begun, demand=0.0 * begun.demand, measurement_std=0.0)
    planning = planning_model(quiet)
    assert planning.destinations.tolist() == [
        False,
        True,
    ]  # nobody starts, but they are bound for somewhere
    x, _ = Rollout(planning).random_start(3, 0.0, 0.0, torch.Generator())
    np.testing.assert_array_equal(x[2], quiet.initial)
    gates, splits = bound.neutral_starts(quiet.network, quiet.steps, guidance=False)["open"]
    controls = (torch.tensor(values).unsqueeze(1) for values in (gates, splits))
    (total,) = bound._total_time_spent(quiet, dynamics.parameters(quiet.network), *controls)
    uncontrolled = total_time_spent(nmfd.run(quiet, "no-control"))
    assert float(total) == pytest.approx(uncontrolled, rel=1e-12)
    assert make_controller("mpc-pc", quiet).act(seen([100.0, 50.0])).note == ""


def test_sumo_begins_empty(begun):
    with pytest.raises(
        InputError, match="scenario.toml: initial: a city in SUMO begins empty; remove it"
    ):
        settings(begun)
