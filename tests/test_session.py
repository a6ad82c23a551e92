"""Lines that a researcher types on the first day, as they stand."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import cosim
import nmfd


class Half:
    """Open the perimeter half; an object, not a file."""

    def reset(self, seed=0):
        pass

    def act(self, observation):
        return nmfd.Controls(perimeter=np.full((7, 7), 0.5))


class Wide(Half):
    def act(self, observation):
        return nmfd.Controls(perimeter=np.full((7, 7), 7.0))


class Bare(Half):
    def act(self, observation):
        return np.full((7, 7), 0.5)


@pytest.fixture(scope="module")
def scenario():
    return nmfd.load_scenario("economic_mpc")


@pytest.fixture(scope="module")
def result(scenario):
    return nmfd.run(scenario, nmfd.PiGating(kp=2.0), seed=1)


def test_options_are_a_controller(result):
    assert result.controller == "pi-gating(kp=2.0)"
    assert result.total_time_spent == nmfd.total_time_spent(result)
    assert 31000 < result.completed_trips < 31680


def test_a_result_has_labelled_arrays_and_lists_them(result, scenario):
    mean = result.accumulation.sel(region=3).mean("time")
    assert isinstance(mean, xr.DataArray)
    assert mean.dims == ("destination",)
    names = [name for name in dir(result) if "accumulation" in name]
    assert "accumulation" in names
    assert {"total_time_spent", "seed", "observed", "decision_time"} <= set(dir(result))
    assert list(result.data["region_name"].values) == list(scenario.network.region_names)
    assert result.data.attrs["version"] == nmfd.__version__
    assert result.data.attrs["scenario"] == "economic_mpc"
    assert "measurement_std" in result.data.attrs["settings"]
    assert len(repr(result).splitlines()) <= 50


def test_a_benchmark_takes_names_options_and_objects(scenario, out):
    table = nmfd.benchmark(
        scenario, ["no-control", nmfd.PiGating(kp=2.0), Half()], seeds=1, out=out
    )
    assert isinstance(table, pd.DataFrame)
    means = table.groupby("controller")["total_time_spent_veh_s"].mean()
    assert set(means.index) == {"no-control", "pi-gating(kp=2.0)", "Half"}
    assert means["pi-gating(kp=2.0)"] < means["no-control"]
    again = nmfd.benchmark(scenario, [Half()], seeds=1, out=out)
    assert set(again["failure"]) == {""}


def test_demand_and_steps_are_arguments(scenario):
    short = nmfd.run(scenario, Half(), demand=1.2, steps=20)
    assert short.sizes["interval"] == 20
    plain = nmfd.run(scenario, Half(), steps=20)
    np.testing.assert_allclose(short["accumulation"][1].sum(), 1.2 * plain["accumulation"][1].sum())


def test_a_city_is_its_settings():
    city = cosim.Settings(signals="max-pressure", guided=True)
    run = cosim.run("demo", nmfd.PiGating(), city=city, seed=1, steps=2)
    assert run.controller == "pi-gating+guided+max-pressure"
    named = cosim.run("demo", "pi-gating()+guided+max-pressure", seed=1, steps=2)
    np.testing.assert_array_equal(named["accumulation"], run["accumulation"])


def test_an_evaluation_is_a_table_and_its_runs_are_found(tmp_path):
    controllers = ["no-control", "pi-gating+max-pressure", nmfd.PiGating(kp=0.4)]
    table = cosim.evaluate("demo", controllers, seeds=1, steps=1, out=tmp_path / "ev")
    assert isinstance(table, pd.DataFrame)
    assert len(table) == 3
    seed = table["seed"].iloc[0]
    again = cosim.read_run(str(tmp_path / "ev"), "pi-gating+max-pressure", seed=seed)
    assert again.seed == seed
    assert cosim.read_run(tmp_path / "ev", nmfd.PiGating(kp=0.4), seed).plant == "sumo"
    with pytest.raises(nmfd.InputError, match="holds no finished run of greedy"):
        cosim.read_run(tmp_path / "ev", "greedy", seed)


def test_a_scenario_is_saved(scenario, tmp_path):
    scenario.save(tmp_path / "mine")
    again = nmfd.load_scenario(tmp_path / "mine")
    assert again.hash == scenario.hash
    nmfd.run(again, "no-control", steps=10)


def test_wrong_commands_are_one_line(scenario):
    with pytest.raises(
        nmfd.InputError, match=r"^Wide: interval 0: perimeter\[0, 1\]: expected 0.1 to 0.9, got 7"
    ):
        nmfd.run(scenario, Wide())
    with pytest.raises(nmfd.InputError, match=r"^Bare: interval 0: expected nmfd.Controls, got nd"):
        nmfd.run(scenario, Bare())
