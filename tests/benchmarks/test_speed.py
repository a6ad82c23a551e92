"""Speed against plain versions of the same: pytest -n0 tests/benchmarks --benchmark-only

What is compared must agree; that part runs with the other tests.
"""

import runpy
from pathlib import Path

import numpy as np
import plain
import pytest
import tiny
import torch

from nmfd import api
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.mpc.ipopt import Ipopt
from nmfd.model.links.model import Choices, Commands, LinkModel
from nmfd.model.links.network import read_links
from nmfd.model.links.plant import links_file
from nmfd.model.planning import planning_model
from nmfd.model.scenario import Scenario
from nmfd.types import Status

SCALING = runpy.run_path(
    str(Path(__file__).parents[2] / "scenarios" / "large_grids" / "scaling.py")
)
SCENARIO = load_scenario(Path(__file__).parents[2] / "scenarios" / "economic_mpc")
KINDS = pytest.mark.parametrize("guidance", [False, True], ids=["pc", "pcrg"])
WHEN = (10, 20, 30, 40)  # control intervals: from free flow to gridlock in the centre
HORIZON = 8  # control intervals


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def seen():
    """Measurements of a run without control."""
    trajectory = api.run(SCENARIO, "no-control", steps=WHEN[-1] + 1)
    return [tiny.seen(trajectory["accumulation"][k], k) for k in WHEN]


def forecast(scenario, k):
    """(HORIZON, R, R) [veh/s]."""
    ahead = np.zeros((HORIZON, *scenario.demand.shape[1:]))
    known = scenario.demand[k : k + HORIZON]
    ahead[: len(known)] = known
    return ahead


def random_city(family, regions):
    city = SCALING["network"](family, regions)
    scenario = Scenario(
        name="city", network=city, step=30.0, steps=10, demand=np.zeros((10, regions, regions))
    )
    return scenario, tiny.seen(SCALING["initial_state"](city, "congested"))


def compare(scenario, measured, guidance):
    """Vehicles over the horizon by our MPC, by plain IPOPT, and whether that converged."""
    controller, k = api.controller("mpc-pcrg" if guidance else "mpc-pc", scenario), measured.step
    assert controller.act(measured).status == Status.OK
    ipopt = Ipopt(
        planning_model(scenario), guidance=guidance, horizon=HORIZON, limits={"max_iter": 200}
    )
    perimeter, splits, reason = ipopt.solve(
        np.maximum(measured.accumulation, 0.0), forecast(scenario, k)
    )
    rows = [
        controller.admissible.decision(u, theta) for u, theta in zip(perimeter, splits, strict=True)
    ]
    other = controller.admissible.project(np.stack(rows))
    start, demand = controller.forecast(measured)
    ours, plain = (
        controller.vehicle_steps(start, demand, plan)[0] for plan in (controller._plan, other)
    )
    return ours, plain, reason is None


@KINDS
def test_mpc_has_the_optimum_of_plain_ipopt(seen, guidance):
    ours, plain_ipopt, solved = compare(SCENARIO, seen[2], guidance)
    assert ours <= plain_ipopt * (1.0 + 1e-5)
    assert not solved or ours == pytest.approx(plain_ipopt, rel=1e-4)


@pytest.mark.parametrize(
    "family, regions, guidance",
    [
        ("complete", 5, True),
        ("complete", 8, False),
        ("hexagonal", 9, False),
        pytest.param("hexagonal", 7, True, marks=pytest.mark.slow),
    ],
)
def test_mpc_has_the_optimum_of_plain_ipopt_in_random_cities(family, regions, guidance):
    ours, plain_ipopt, solved = compare(*random_city(family, regions), guidance)
    assert ours <= plain_ipopt * (1.0 + 1e-5)
    assert not solved or ours == pytest.approx(plain_ipopt, rel=1e-4)


def test_the_plain_model_is_the_model():
    trajectory = api.run(SCENARIO, "no-control", steps=30)
    x = trajectory["accumulation"][0]
    for k in range(30):
        x = plain.euler(
            SCENARIO.network,
            x,
            SCENARIO.demand[k],
            trajectory["perimeter"][k],
            trajectory["splits"][k],
            30.0,
        )
        np.testing.assert_allclose(x, trajectory["accumulation"][k + 1], atol=1e-9)


@KINDS
def test_plain_dpc_decides_the_same(seen, guidance):
    name = "dpc-pcrg" if guidance else "dpc-pc"
    policy, _ = load_policy(SCENARIO.folder / f"{name}.pt", SCENARIO.network)
    controls = make_controller(name, SCENARIO).act(seen[2])
    perimeter, splits = plain.dpc(policy)(seen[2].accumulation)
    np.testing.assert_allclose(controls.perimeter, perimeter, atol=1e-6)
    if guidance:
        np.testing.assert_allclose(controls.splits, splits, atol=1e-6)


@KINDS
@pytest.mark.benchmark(group="MPC, four decisions from nothing, 7 regions")
class TestMpc:
    def test_plain(self, benchmark, seen, guidance):
        ipopt = Ipopt(
            planning_model(SCENARIO), guidance=guidance, horizon=HORIZON, limits={"max_iter": 200}
        )
        benchmark(lambda: [ipopt.solve(m.accumulation, forecast(SCENARIO, m.step)) for m in seen])

    def test_ours(self, benchmark, seen, guidance):
        controller = api.controller("mpc-pcrg" if guidance else "mpc-pc", SCENARIO)

        def decide():
            for measured in seen:
                controller.reset()
                controller.act(measured)

        benchmark(decide)


def streets_of(compiled):
    """Streets of grid7 under max-pressure, and the trips that are due (veh/s)."""
    grid = api.load_scenario("grid7_peak")
    choices = Choices(signals="max-pressure")
    network = read_links(links_file(grid))
    model = LinkModel(network, grid.step, choices=choices, dt=3.0, compiled=compiled)
    return model, torch.as_tensor(grid.demand, dtype=torch.float32)


@pytest.mark.benchmark(group="Streets, rollouts of grid7 over 1,920 steps")
@pytest.mark.parametrize("batch", [1, 10])
@pytest.mark.parametrize("compiled", [False, True], ids=["reference", "compiled"])
def test_rollouts_of_streets(benchmark, compiled, batch):
    model, demand = streets_of(compiled)

    def rollout():
        state = model.start(batch, range(batch), chance=True)
        with torch.inference_mode():
            for due in demand:
                state = model.advance(state, due.expand(batch, 7, 7), Commands())

    benchmark.pedantic(rollout, rounds=2, warmup_rounds=1)


@pytest.mark.benchmark(group="Streets, eight rollouts of grid7 with derivatives over 240 steps")
@pytest.mark.parametrize("compiled", [False, True], ids=["reference", "compiled"])
def test_derivatives_of_streets(benchmark, compiled):
    model, demand = streets_of(compiled)
    rate = torch.full((8, 7), 1.0, requires_grad=True)

    def derive():
        state = model.start(8, range(8), chance=True)
        for due in demand[20:28]:
            state = model.advance(state, due.expand(8, 7, 7), Commands(metering=rate))
        torch.autograd.grad(state.spent.sum(), rate)

    benchmark.pedantic(derive, rounds=2, warmup_rounds=1)
