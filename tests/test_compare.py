"""Comparison and identification on records whose truth is known: made by the regional model
itself."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import trajectories

import nmfd
from cosim.evaluation import identify, model_validation
from cosim.evaluation.identify import as_it_was, static_model
from cosim.evaluation.model_validation import observed, outflow_samples, predict
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.model import mfd
from nmfd.model.mfd import held_up
from nmfd.studies.fit_quality import fit_table, nearly_empty, predictions, region_fits, with_guesses
from nmfd.types import Controls


@pytest.fixture(scope="module")
def scenario():
    return replace(load_scenario("economic_mpc"), measurement_std=0.0)


@pytest.fixture(scope="module")
def result(scenario):
    """A run of the regional model under random controls, recorded as if it were the
    microsimulation."""
    random, network = np.random.default_rng(0), scenario.network

    def gates(_):
        """One u per region, see below."""
        u = random.uniform(network.u_min, network.u_max, 7)
        return Controls(perimeter=u[:, None] * network.adjacency)

    run = nmfd.run(scenario, tiny.Acting(gates))
    completions, transfers = trajectories.flows(scenario, run)
    record = {
        "departures": scenario.step * scenario.demand,
        "crossings": scenario.step * transfers,
        "arrivals": scenario.step * completions,
    }
    return trajectories.recorded(run, record, {})


def test_a_perfect_model_has_no_error(scenario, result):
    assert np.abs(predict(scenario, result).accumulation - result["accumulation"]).max() < 1e-6
    rows = predictions(scenario.network, [observed(result)], scenario.scheme)
    assert rows[["next_interval_rmse_share", "ahead_rmse_share"]].to_numpy().max() < 1e-4


def test_a_model_that_discharges_too_slowly_holds_too_many(scenario, result):
    slow = tuple(replace(m, a=0.9 * m.a, b=0.9 * m.b, c=0.9 * m.c) for m in scenario.network.mfds)
    wrong = replace(scenario, network=replace(scenario.network, mfds=slow))
    off = predict(wrong, result).accumulation.sum(axis=2) - result["accumulation"].sum(axis=2)
    assert off.sum(axis=1).mean() > 100
    rows = predictions(wrong.network, [observed(result)], wrong.scheme)
    whole = np.sqrt((off**2).mean(axis=0)) / wrong.network.critical
    assert (rows["next_interval_rmse_share"] < rows["ahead_rmse_share"]).all()
    assert rows["next_interval_rmse_share"].mean() < whole.mean()


def test_errors_where_the_critical_accumulation_was_not_seen(scenario, result):
    """Shares are of the largest accumulation that was seen, if anybody drove there."""
    network = scenario.network
    critical = network.critical
    unseen = replace(scenario, network=replace(network, critical_above={0: 50.0, 1: 0.0}))
    late = result.assign(accumulation=result["accumulation"] + 1.0)
    errors = model_validation._errors(unseen, [result], [late])
    errors.insert(0, "demand", 1.0)
    errors.insert(1, "controller", "no-control")
    base = [50.0, np.nan, *critical[2:]]
    np.testing.assert_allclose(errors["share_of_veh"], base)
    np.testing.assert_allclose(errors["whole_run_rmse_share"], 7.0 / np.array(base))
    most = result["accumulation"].sum(axis=2).max(axis=0)
    np.testing.assert_allclose(errors["most_share"], most / np.array(base))
    assert errors["critical_veh"].isna().tolist() == [True, True, *[False] * 5]
    table = model_validation.prediction_table(errors)
    assert "nan" not in table
    assert "inf" not in table
    assert "(where it was not seen, of the largest one that was)" in " ".join(table.split())
    alone = model_validation.prediction_table(errors[errors["region"] == 1])
    assert alone.splitlines()[1].split()[:7] == ["1", "no-control", "1", "hexagon7", "-", "-", "-"]


def test_the_model_of_those_who_drive():
    """A controller's own model, or what the scenario names for a strategy; else the scenario's."""
    scenario = load_scenario("grid7_peak")
    names = {
        "no-control": "grid7",
        "pi-gating": "grid7",
        "dpc-pcrg": "grid7_guided",
        "route-guidance": "grid7_guided",
        "dpc-pcrg+max-pressure+compliance-50": "grid7_max_pressure",
        "rerouting-30": "grid7_rerouting",
        "max-pressure+rerouting-30": "grid7_rerouting",
    }
    for strategy, name in names.items():
        assert parse(strategy).planning(scenario).network.folder.resolve().name == name


def test_outflow_samples_lie_on_the_mfd(scenario, result):
    for region in (0, 3):
        cloud = outflow_samples(scenario.network, [result])[region]
        points = np.concatenate(list(cloud.values()))
        expected = scenario.network.mfds[region].outflow(points[:, 0])
        # The samples are taken at the middle of an interval, the flows at its beginning.
        assert (
            np.abs(points[:, 1] - expected).mean() < 0.03 * scenario.network.mfds[region].capacity
        )
        fitted = mfd.fit(points[:, 0], points[:, 1])
        seen = np.linspace(0.0, fitted.jam, 50)
        assert fitted.problem() is None
        assert (
            np.abs(fitted.outflow(seen) - scenario.network.mfds[region].outflow(seen)).max()
            < 0.08 * 6.3
        )


def test_held_up_is_who_collapsed_later():
    """Regions 0-1-2 in a row; 1 collapses at k = 2, 0 at k = 3, and 2 never; then 1 recovers.

    Each k is three intervals long, as outflows are means of three.
    """
    adjacency = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=bool)
    accumulation = np.array(
        [[10, 10, 10], [20, 20, 20], [30, 30, 20], [40, 30, 20], [50, 20, 20]], dtype=float
    )
    outflow = np.array([[1, 1, 1], [2, 2, 2], [2, 1, 2], [1, 1, 2], [1, 2, 2]], dtype=float)
    found = held_up(accumulation.repeat(3, axis=0), outflow.repeat(3, axis=0), adjacency)
    assert found[1::3].T.tolist() == [
        [False, False, True, True, False],
        [False, False, False, False, True],  # held up by 0 now
        [False, False, True, True, False],
    ]


def test_an_earlier_collapse_that_is_over_does_not_count():
    """Regions 0-1; 0 collapses at k = 2, and recovers; at k = 5 region 1 does, and at 6 also 0."""
    adjacency = ~np.eye(2, dtype=bool)
    accumulation = np.array([[1, 1], [2, 2], [3, 2], [1, 2], [2, 2], [2, 3], [3, 4]], dtype=float)
    outflow = np.array([[1, 1], [2, 2], [1, 2], [1, 2], [2, 2], [2, 1], [1, 1]], dtype=float)
    found = held_up(accumulation.repeat(3, axis=0), outflow.repeat(3, axis=0), adjacency)
    assert found[1::3].T.tolist() == [
        [False, False, False, False, False, True, True],
        [False, False, True, False, False, False, False],
    ]


def test_regions_that_no_loading_run_filled_are_named(scenario):
    network = scenario.network
    critical = np.array([curve.critical for curve in network.mfds])
    state = np.zeros((5, 7, 7))
    state[2] = np.diag(critical * [1.1, 0.4, 1.2, 1.3, 1.5, 1.01, 2.0])
    empty = [{"loading": np.empty((0, 2))}] * 7
    full = [{"loading": np.stack([np.linspace(1.0, 9e3, 20)] * 2, axis=1)}] * 7
    lanes = np.full(7, 20.0)
    assert with_guesses(network, full, lanes, [state, 0.5 * state]).critical_above == pytest.approx(
        {n: state[2, n, n] for n in (0, 1, 2, 5)}
    )  # at 1.3 times it has fallen by 5 %
    blank = with_guesses(network, empty, lanes, [state])
    assert set(blank.critical_above) == set(range(7))
    assert blank.mfds == network.mfds


def test_beyond_the_data_a_guess_from_lanes_is_for_control(scenario):
    """Region 1 was seen up to 900 vehicles, on 20 lane-km: its guess is above that, and as fast as
    was measured."""
    network = replace(scenario.network, exit_rates=np.ones((7, 7)), storage=np.full(7, 500.0))
    full = [{"loading": np.stack([np.linspace(1.0, 9e3, 20)] * 2, axis=1)}] * 7
    state = np.repeat(np.diag([9000.0, 900.0, *[9000.0] * 5])[None], 2, axis=0)
    model = with_guesses(network, full, np.full(7, 20.0), [state], fastest=1.0 / 30.0)
    assert model.critical_above == {1: 900.0}
    assert np.isnan(model.seen_critical).tolist() == [
        False,
        True,
        *[False] * 5,
    ]
    assert 900.0 <= model.critical[1] < 920.0
    assert model.storage[1] == model.mfds[1].jam > 2000.0
    assert model.mfds[1].outflow(900.0) == pytest.approx(network.mfds[1].outflow(900.0))
    assert model.mfds[0] == network.mfds[0]
    assert model.mfds[1].problem() is None
    slow = with_guesses(network, full, np.full(7, 20.0), [state], fastest=1.0 / 300.0)
    assert slow.mfds[1].c == pytest.approx(1.0 / 300.0)


def test_an_empty_region_keeps_its_model_in_identification(scenario, result):
    """Nobody is ever in region 0: all others are fitted, and 0 stays as it was."""
    network = scenario.network
    alone = result.assign(
        **{name: result[name].copy() for name in ("accumulation", "crossings", "arrivals")}
    )
    alone.accumulation[:, 0], alone.crossings[:, 0], alone.arrivals[:, 0] = 0.0, 0.0, 0.0
    static = static_model(scenario, [alone])
    assert static.mfds[0] == network.mfds[0]
    assert static.mfds[3] != network.mfds[3]
    samples = outflow_samples(network, [alone])
    assert 0 in nearly_empty(samples)
    assert 3 not in nearly_empty(samples)
    table = fit_table(static, region_fits(static, samples))
    assert "few samples" in table
    fitted = replace(static, exit_rates=np.full((7, 7), 2.0), storage=np.full(7, 10.0))
    kept = as_it_was(static, fitted, [0])
    assert (kept.exit_rates[0] == 1.0).all()
    assert kept.storage[0] == network.mfds[0].jam
    assert (kept.exit_rates[1:] == 2.0).all()
    assert (kept.storage[1:] == 10.0).all()


def test_the_regions_to_protect_are_proposed_and_written(three_regions):
    file = three_regions.folder / "scenario.toml"
    before = file.read_text()
    assert identify._proposal(three_regions, (), written=True) == []
    assert identify._proposal(three_regions, (1,), written=True) == []
    (line,) = identify._proposal(three_regions, (0, 2), written=False)
    assert "protected = [0, 2] instead of [1] in" in line
    assert file.read_text() == before
    identify.write_protected(three_regions, (0, 2))
    assert file.read_text() == before.replace("protected = [1]", "protected = [0, 2]")
    file.write_text(before.replace("protected = [1]\n", ""))
    identify.write_protected(three_regions, (2,))
    assert load_scenario(three_regions.folder).protected == (2,)


def test_the_same_command_goes_on_after_ctrl_c_in_the_second_model(
    tmp_path, three_regions, monkeypatch
):
    """Until its end the command changes nothing that its loading runs depend on."""
    folder = three_regions.folder
    before = (folder / "scenario.toml").read_text()
    verdict = SimpleNamespace(protect=(0, 2), sentences=("Yes.",))
    found = SimpleNamespace(verdict=verdict, write=lambda out, target: None, text=lambda: "")
    tasks, stopped = [], [True]

    def identified(task):
        tasks.append(task)
        if task.guided and stopped:
            raise KeyboardInterrupt("finished runs are in a/b; the same command with --out a/b")
        return found

    monkeypatch.setattr(identify, "identified", identified)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt) as interrupted:
        identify.identify(folder, protect=True, out=out)
    assert str(interrupted.value) == f"finished runs are in {out}; the same command goes on"
    assert (folder / "scenario.toml").read_text() == before
    stopped.clear()
    said = identify.identify(folder, protect=True, out=out)
    assert re.findall("(?m)^[A-Z]+$", said) == ["VERDICT", "FILES"] * 2
    assert said.count("protected = [0, 2] instead of [1]") == 1
    assert "was written there" in " ".join(said.split())
    assert [task.scenario.protected for task in tasks] == [(1,), (0, 2)] * 2
    assert [task.out for task in tasks] == [out, out / "guided"] * 2
    assert load_scenario(folder).protected == (0, 2)


@pytest.mark.parametrize(
    "arrivals, levels, text",
    [
        ([60, 80, 100, 90], (0.6, 0.8, 1.0, 1.15), "breaks at 1.15 .*: 90 trips end, 100 at 1"),
        ([60, 50, 80, 100], (0.6, 0.8, 1.0), "breaks at 0.8 .*: 50 trips end, 60 at 0.6"),
        (range(60, 200), identify.LEVELS, "Up to 2 times"),
    ],
)
def test_a_city_is_loaded_until_it_breaks(monkeypatch, arrivals, levels, text):
    def loading_runs(task, stage):
        return [SimpleNamespace(completed_trips=n) for n in arrivals[: len(task.levels)]]

    monkeypatch.setattr(identify.Task, "loading_runs", loading_runs)
    fields = dict.fromkeys(identify.Task.__dataclass_fields__)
    task, runs = identify.Task(**fields).until_broken()
    assert task.levels == pytest.approx(levels)
    found = identify.breaking_text(task.levels, task.mean_arrivals(runs))
    assert re.search(text, found)


def test_guidance_shifts_what_drivers_choose():
    """Commanded: 0.3 more by region 1 than without a command, where drivers take 0.9 by it."""
    own, reference, splits = np.zeros((3, 3, 3, 3))
    own[0, :, 2] = [0.0, 0.9, 0.1]
    reference[0, :, 2] = [0.0, 0.5, 0.5]
    splits[0, :, 2] = [0.0, 0.8, 0.2]
    both = identify.shifted(np.stack([splits, reference]), reference, own)
    assert both[0, 0, :, 2] == pytest.approx([0.0, 1.0, 0.0])
    np.testing.assert_allclose(both[1], own)
