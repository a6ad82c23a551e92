"""Fine-tuning between control steps: the estimate finds what changed, tuning helps, and one command compares."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from click.testing import CliRunner

from nmfd import api
from nmfd.api import load_scenario
from nmfd.cli.main import main
from nmfd.closed_loop import noisy
from nmfd.controllers import registry
from nmfd.controllers.dpc.online import ModelEstimate, OnlineDpc
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.metrics import total_time_spent
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.studies.adaptation import CASES, changed

BENCHMARK = load_scenario(Path(__file__).parents[1] / "scenarios" / "economic_mpc")
QUICK = {"dpc-pc-online": {"look_ahead": 10, "iterations": 2, "learning_rate": 0.05, "rollouts": 2}}


@pytest.fixture
def scenario(tmp_path):
    """Three regions in a row, loaded enough that control matters, with an untrained policy."""
    text = (
        tiny.SCENARIO.replace("to = 1", "to = 2")
        .replace("peak = 2.0", "peak = 3.0")
        .replace("flat = 120.0", "flat = 400.0")
    )
    loaded = load_scenario(tiny.write(tmp_path, scenario=text, network=tiny.row_network(3)))
    torch.manual_seed(0)
    policy = Policy(loaded.network, Architecture(width=8))
    torch.save(checkpoint(policy, loaded.network, {}), loaded.folder / "dpc-pc.pt")
    return replace(loaded, controller_options=QUICK)


@pytest.mark.parametrize("case, demand, outflow", [("nominal", 1.0, 1.0), ("more", 1.2, 1.0), ("rain", 1.0, 0.8)])
def test_the_estimate_finds_what_changed(case, demand, outflow):
    """From noisy measurements of the loading phase."""
    actual, random = changed(BENCHMARK, case), np.random.default_rng(0)
    plant, controller = NmfdPlant(actual), registry.make("pi-gating", BENCHMARK)
    estimate, before = ModelEstimate(planning_model(BENCHMARK)), noisy(plant.reset(0), np.zeros((7, 7)))
    for k in range(35):
        controls = controller.act(before)
        after = noisy(plant.step(controls), 0.5 * random.standard_normal((7, 7)))
        estimate.update(before.accumulation, after.accumulation, BENCHMARK.demand[k], controls)
        before = after
    active = BENCHMARK.demand[:35].sum(axis=(0, 2)) > 100.0
    np.testing.assert_allclose(estimate.demand[active], demand, atol=0.03)
    assert estimate.outflow[3] == pytest.approx(outflow, abs=0.03)  # the centre, through which all go


def test_tuning_beats_the_frozen_policy_and_follows_the_seed(scenario):
    frozen = api.run(scenario, registry.make("dpc-pc", scenario), seed=1)
    controller = registry.make("dpc-pc-online", scenario)
    assert isinstance(controller, OnlineDpc)
    online = [api.run(scenario, controller, seed=1) for _ in range(2)]  # the second begins with the frozen one again
    # In this city an open perimeter is best: most of what the untrained policy loses against it is won.
    best, tuned, untrained = (total_time_spent(run) for run in (api.run(scenario, "no-control"), online[0], frozen))
    assert best < tuned < untrained - 0.5 * (untrained - best)
    np.testing.assert_array_equal(online[0].perimeter, online[1].perimeter)
    assert (online[0].perimeter[:, scenario.network.adjacency] <= scenario.network.u_max + 1e-6).all()
    assert np.median(online[0].decision_time) < scenario.step


def test_without_iterations_it_is_the_frozen_policy(scenario):
    idle = replace(scenario, controller_options={"dpc-pc-online": {"look_ahead": 2, "iterations": 0}})
    frozen, online = (api.run(idle, registry.make(name, idle), seed=1) for name in ("dpc-pc", "dpc-pc-online"))
    np.testing.assert_array_equal(frozen.perimeter, online.perimeter)


def test_cases_change_what_they_say():
    trips = BENCHMARK.demand.sum()
    assert changed(BENCHMARK, "more").demand.sum() == pytest.approx(1.2 * trips)
    late = changed(BENCHMARK, "later").demand
    assert late[:20].sum() == 0 and late.sum() == pytest.approx(trips)
    np.testing.assert_array_equal(late[20:], BENCHMARK.demand[:-20])
    wet, dry = changed(BENCHMARK, "rain").network.mfds[0], BENCHMARK.network.mfds[0]
    x = np.linspace(0.0, 1.5 * dry.jam, 50)
    np.testing.assert_allclose(wet.outflow(x), 0.8 * dry.outflow(x))
    assert trips < changed(BENCHMARK, "one-origin").demand.sum() < 1.2 * trips


def test_the_command(scenario, tmp_path):
    out = tmp_path / "out"
    names = "no-control,dpc-pc,dpc-pc-online"
    command = ["adaptation", str(scenario.folder), "--controllers", names, "--out", str(out)]
    (scenario.folder / "scenario.toml").open("a").write(
        "\n[controllers.dpc-pc-online]\nlook_ahead = 3\niterations = 1\nrollouts = 1\n"
    )
    done = CliRunner().invoke(main, [*command, "--cases", "rain,later"])
    assert done.exit_code == 0, done.output + str(done.exception)
    assert done.stdout.count("dpc-pc-online") == 2 and all(what in done.stdout for what in CASES.values())
    before = (out / "adaptation.csv").read_bytes()
    assert CliRunner().invoke(main, [*command, "--cases", "rain"]).exit_code == 0
    assert (out / "adaptation.csv").read_bytes() == before
    wrong = CliRunner().invoke(main, [*command, "--cases", "snow"])
    assert wrong.exit_code == 2 and "--cases: 'snow' is unknown; choose from nominal, more" in wrong.stderr
