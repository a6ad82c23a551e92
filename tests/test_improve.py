"""cosim improve: policies that descend along runs of the city, which is a regional model here: SUMO is not started."""

from dataclasses import replace
from functools import cache

import copies
import numpy as np
import pandas as pd
import pytest
import torch
import trajectories
from click.testing import CliRunner

from cosim.cli.main import main
from cosim.evaluation import experiment, improve
from cosim.evaluation.identify import PRIOR, followed
from cosim.evaluation.simulate import FACTS, Result, scenario_of
from cosim.plant.strategy import configured
from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.controllers.dpc import training
from nmfd.controllers.dpc.compact import CompactPolicy, Numbers
from nmfd.controllers.dpc.policy import Architecture
from nmfd.controllers.dpc.replay import Replays, Run, descend
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.errors import InputError, RunFailed
from nmfd.model import dynamics
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.runs.workers import Failure

CONTROLLER = "dpc-pcrg+max-pressure+guidance-period-60"
CENTRE = 3


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("economic_mpc")


def believed(scenario):
    """The model of somebody who takes every region for a third larger than it is."""
    network = scenario.network
    wrong = tuple(replace(m, a=m.a / 1.33**2, b=m.b / 1.33, jam=1.33 * m.jam) for m in network.mfds)
    return replace(planning_model(scenario), network=replace(network, mfds=wrong))


def policy(network, *, waits=False, **numbers):
    made = CompactPolicy(network, Architecture(guidance=True, compact=(CENTRE,), metering=waits))
    with torch.no_grad():
        made.numbers.copy_(torch.tensor(Numbers(**numbers)))
    return made


def driven(scenario, made, level):
    """A run of the scenario itself, which `made` controls, at `level` times the demand, and its TTS [veh s]."""
    rollout = Rollout(replace(planning_model(scenario), measurement_std=0.0))
    demand = level * torch.cat([rollout.demand, torch.zeros_like(rollout.demand[:1])]).unsqueeze(1)
    nothing, start = torch.Generator().manual_seed(0), rollout.start.unsqueeze(0)
    with torch.no_grad():
        states, _, _ = rollout.states(made, start, demand, nothing)
        spent = rollout.total_time_spent(made, start, demand[:-1], nothing)
    return Run(accumulation=states[:, 0].double().numpy(), demand=demand[:-1, 0].double().numpy()), spent.item()


@pytest.mark.parametrize("metering", [False, True])
def test_replayed_under_its_own_policy_a_run_is_the_run(scenario, metering):
    made = policy(scenario.network, waits=metering, price=2.0, set_point=0.8, metering=0.7)
    runs, spent = zip(*(driven(scenario, made, level) for level in (0.8, 1.2)), strict=True)
    again = Replays(Rollout(believed(scenario)), made, runs).total_time_spent(made)
    assert again.tolist() == pytest.approx(spent, rel=1e-4)
    other = policy(scenario.network, waits=metering, price=0.0, set_point=0.3, metering=0.7)
    assert not np.allclose(Replays(Rollout(believed(scenario)), made, runs).total_time_spent(other).tolist(), spent)


@pytest.mark.slow
def test_what_descends_along_runs_of_the_city_is_better_in_the_city(scenario):
    made = policy(scenario.network, set_point=0.3, gain=3.0)  # a gate that closes much too early
    runs, spent = zip(*(driven(scenario, made, level) for level in (0.8, 1.2)), strict=True)
    replays = Replays(Rollout(believed(scenario)), made, runs)
    path = descend(made, replays, steps=20, learning_rate=0.05)
    assert len(path) == 21 and path[-1] < path[0] == pytest.approx(float(np.exp(np.log(spent).mean())), rel=1e-4)
    better = [driven(scenario, made, level)[1] for level in (0.8, 1.2)]
    assert np.log(better).mean() < np.log(spent).mean() - 0.01
    assert min(made.numbers.tolist()) >= 0.0


def test_the_splits_that_drivers_followed_are_counted(scenario):
    network, steps = scenario.network, 7
    h, g = np.flatnonzero(network.split_mask[0, :, CENTRE])[:2]
    crossings = np.zeros((steps, 7, 7, 7))
    crossings[3, 0, h, CENTRE] = 30.0
    record = trajectories.record(steps, regions=7) | {"crossings": crossings}
    splits = np.broadcast_to(network.nominal_splits, (steps, 7, 7, 7))
    result = Result(
        facts={},
        record=record,
        trajectory=trajectories.made(
            controller="x",
            plant="sumo",
            seed=0,
            step=90.0,
            accumulation=np.zeros((steps + 1, 7, 7)),
            backlog=np.zeros((steps + 1, 7, 7)),
            completed=np.zeros(steps + 1),
            perimeter=np.ones((steps, 7, 7)),
            splits=splits,
        ),
    )
    found = followed(network, result).splits
    told = splits[0, 0, [h, g], CENTRE]
    assert found[0] == pytest.approx(splits[0]) and found[6] == pytest.approx(splits[6])
    for k in range(1, 6):  # the window of five control intervals around the third
        assert found[k, 0, h, CENTRE] == pytest.approx((30.0 + PRIOR * told[0]) / (30.0 + PRIOR))
        assert found[k, 0, g, CENTRE] == pytest.approx(PRIOR * told[1] / (30.0 + PRIOR))
    assert found.sum(axis=2) == pytest.approx(splits.sum(axis=2))


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """grid7, with a policy whose gate closes much too early."""
    city = copies.peak(tmp_path_factory.mktemp("city"))
    file, ours = city / "scenario.toml", "numbers = [9.0, 1.0, 0.0, 8.0, 0.6, 0.5, 1.5, 1.2]"
    assert ours in file.read_text()
    file.write_text(file.read_text().replace(ours, "numbers = [0.3, 3.0, 0.0, 1.0, 0.6, 0.0, 1.5, 1.2]"))
    training.train(load_scenario(city), CONTROLLER, seed=0, out=city / f"{CONTROLLER}.pt")
    return city


@pytest.fixture
def runs(monkeypatch):
    """The tasks that are run, on the regional model of the city; the numbers of those that shall fail."""
    tasks, failing = [], set()

    def drive(task):
        scenario = scenario_of(task)
        variant = configured(task.controller, scenario.controller_options)
        controller = registry.make(variant, scenario, policy=task.policy)
        run = closed_loop.run(NmfdPlant(scenario), controller, scenario, seed=task.seed)
        p, step = dynamics.parameters(scenario.network), scenario.step
        crossings = [
            dynamics.flows(p, *map(torch.from_numpy, now))[1].numpy() * step
            for now in zip(run.accumulation[:-1], run.perimeter, run.splits, strict=True)
        ]
        record = trajectories.record(scenario.steps, regions=7) | {
            "crossings": np.stack(crossings),
            "departures": scenario.demand * step,
        }
        facts = {name: 0 for name in FACTS} | {
            "outside_training": "",
            "controller": task.controller,
            "seed": task.seed,
            "trips": 100,
        }
        return Result(trajectory=replace(run, controller=task.controller), record=record, facts=facts)

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
        for task in todo:
            tasks.append(task)
            yield task, Failure("SUMO fell over") if len(tasks) in failing else drive(task)

    monkeypatch.setattr(experiment, "outcomes", outcomes)
    monkeypatch.setattr(experiment, "load_city", cache(experiment.load_city))
    monkeypatch.setattr(experiment, "read_signals", lambda city, *_: ([], []))
    monkeypatch.setattr(experiment, "check_strategy", lambda *_: None)
    return tasks, failing


def order(city, out, *, rounds=3, **others):
    return improve.Improvement(
        scenario=city,
        controller=CONTROLLER,
        rounds=rounds,
        seeds=(1000,),
        out=out,
        **{"levels": (1.0, 1.6), "descent": 6, "learning_rate": 0.1, "iterations": 5, "steps": 30, **others},
    )


@pytest.mark.slow
def test_the_best_policy_is_kept_and_an_interrupted_improvement_goes_on(city, tmp_path, runs):
    tasks, failing = runs
    whole = improve.improve(order(city, tmp_path / "whole"))
    assert len(tasks) == 8 and list(whole["round"]) == [0, 1, 2, 3]
    score = whole["score_veh_s"]
    assert list(whole["kept"]) == [bool(n == 0 or score[n] < score[:n].min()) for n in range(4)]
    assert whole["kept"].sum() > 1, "nothing was learned"
    best = int(whole.loc[whole["kept"], "round"].max())
    assert (tmp_path / "whole" / "policy.pt").read_bytes() == (
        tmp_path / "whole" / f"round-{best:02d}" / "policy.pt"
    ).read_bytes()
    assert not whole[["replayed_veh_s", "foreseen_veh_s"]].loc[1:].isna().any(axis=None)
    failing.add(8 + 5)  # the first run of the third round
    with pytest.raises(RunFailed, match="SUMO fell over"):
        improve.improve(order(city, tmp_path / "parts"))
    assert len(pd.read_csv(tmp_path / "parts" / "improve.csv")) == 2
    parts = improve.improve(order(city, tmp_path / "parts"))
    pd.testing.assert_frame_equal(whole, parts)
    with pytest.raises(InputError, match="another configuration"):
        improve.improve(order(city, tmp_path / "parts", descent=7))


def test_the_policy_that_comes_out_drives_the_city_with_its_model(city, tmp_path, runs):
    done = CliRunner().invoke(
        main,
        [
            "improve",
            str(city),
            "--controller",
            CONTROLLER,
            "--rounds",
            "1",
            "--seeds",
            "1",
            "--demand",
            "1.6",
            "--descent",
            "4",
            "--iterations",
            "3",
            "--steps",
            "20",
            "--out",
            str(tmp_path / "out"),
        ],
    )
    assert done.exit_code == 0, done.stderr
    assert "against round 0" in done.stdout and (tmp_path / "out" / "improve.png").stat().st_size > 10_000
    scenario = load_scenario(city)
    options = {**scenario.controller_options[CONTROLLER], "model": str(tmp_path / "out" / "model")}
    scenario = replace(scenario, controller_options={**scenario.controller_options, CONTROLLER: options})
    assert registry.make(CONTROLLER, scenario, policy=tmp_path / "out" / "policy.pt").name == "dpc-pcrg"


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["--controller", "pi-gating"], "has no policy that learns; choose one of dpc-pc"),
        (["--controller", CONTROLLER, "--policy", "none.pt"], "none.pt"),
        (["--controller", CONTROLLER, "--runs", "none"], "none"),
        (["--controller", CONTROLLER, "--rounds", "0"], "--rounds"),
    ],
)
def test_one_line_for_what_cannot_be_improved(city, tmp_path, arguments, expected):
    done = CliRunner().invoke(main, ["improve", str(city), *arguments, "--out", str(tmp_path / "out")])
    assert done.exit_code != 0 and expected in done.stderr, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "out").exists()
