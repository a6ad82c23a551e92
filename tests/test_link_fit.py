"""Numbers of the link model, fitted to finished runs in SUMO."""

from dataclasses import replace

import numpy as np
import pytest
from commands import cosim, error_line, good

import cosim.api as api
from cosim.evaluation import link_fit
from cosim.evaluation.results import read
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.links.network import read_links


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Twelve intervals of the demo, two seeds each; one strategy is not in the link model."""
    out = tmp_path_factory.mktemp("runs")
    names = ["no-control", "no-control+guided+max-pressure", "no-control+metering"]
    api.evaluate("demo", names, seeds=2, steps=12, out=out, progress=False)
    return out


@pytest.mark.slow
def test_numbers_are_fitted_to_the_first_seed(runs, monkeypatch):
    monkeypatch.setattr(link_fit, "TRIALS", 12)
    monkeypatch.setattr(link_fit, "SEEDS", (0,))
    found = link_fit.fit(read(runs), progress=False)
    rows = found.rows
    assert rows["fitted"].tolist() == [True, False, True, False]
    assert rows["difference"].abs().max() < 0.2
    assert "+metering is left out" in found.left_out[0]
    cases, _ = link_fit.cases_of(read(runs))
    fitted = [case for case in cases if case.run.seed == cases[0].run.seed]

    def error(numbers):
        return np.mean([link_fit._error(case, numbers) for case in fitted])

    assert error(found.numbers) <= error(link_fit.Numbers())
    assert max(map(len, found.text().splitlines())) <= 100


@pytest.mark.slow
def test_the_command_writes_the_numbers(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(link_fit, "TRIALS", 5)
    monkeypatch.setattr(link_fit, "SEEDS", (0,))
    text = good(cosim("links", "demo", "--runs", runs, "--out", tmp_path / "links.npz"))
    numbers = read_links(tmp_path / "links.npz").numbers
    assert f"time_factor {numbers[0]:.3g}," in text
    assert not np.array_equal(numbers, link_fit.Numbers())


@pytest.mark.slow
def test_runs_that_the_model_cannot_repeat(runs):
    found = read(runs)
    (level,) = found.levels
    rows = level.rows[level.rows["controller"].str.contains("metering")]
    alone = replace(found, levels=(replace(level, rows=rows),))
    with pytest.raises(InputError, match="no run that the link model can repeat"):
        link_fit.fit(alone, progress=False)


def test_runs_are_repeated_with_the_options_of_their_whole_name():
    """Two strategies of one controller can have options of their own."""
    name = "pricing-rule+max-pressure+guidance-period-60+metering"
    strategy = link_fit.strategy_in_links(name)
    assert strategy.options(load_scenario("grid7_peak")).metering
    guided = link_fit.strategy_in_links("route-guidance+max-pressure")
    assert guided.labels == ("guided", "max-pressure")
    assert link_fit.strategy_in_links("max-pressure").labels == ("max-pressure",)


def test_a_folder_without_runs(tmp_path):
    line = error_line(cosim("links", "demo", "--runs", tmp_path))
    assert str(tmp_path) in line
