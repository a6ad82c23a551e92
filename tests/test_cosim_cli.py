"""The command line `cosim`: run, compare and identify on a few control intervals, and its error lines."""

import json
import re
import shutil
from pathlib import Path

import copies
import numpy as np
import pandas as pd
import pytest
import torch
from commands import cosim, error_line, good

from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import load_network
from nmfd.runs.run_folder import COLUMNS

ROOT = Path(__file__).parents[1]
STEPS = "3"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A copy of grid7_peak and its network, so that tests may change them, with the peak at the beginning."""
    folder = tmp_path_factory.mktemp("small")
    copies.grid7(folder)
    source = ROOT / "scenarios" / "grid7_peak" / "scenario.toml"
    text = re.sub(r"ramp_up = [\d.]+", "ramp_up = 90.0", source.read_text())
    text = text.replace("steps = 64", "steps = 80")
    (folder / "scenarios" / "small").mkdir(parents=True)
    (folder / "scenarios" / "small" / "scenario.toml").write_text(text)
    scenario = load_scenario(folder / "scenarios" / "small")
    for name, guidance in (("dpc-pc", False), ("dpc-pcrg", True)):
        torch.manual_seed(0)
        network = planning_model(scenario, name).network
        policy = Policy(network, Architecture(width=8, guidance=guidance))
        torch.save(checkpoint(policy, network, {}), scenario.folder / f"{name}.pt")
    return scenario.folder


@pytest.mark.parametrize("controller", ["no-control", "pi-gating", "mpc-pc", "mpc-pcrg", "dpc-pc", "dpc-pcrg"])
def test_every_controller_runs(small, tmp_path, controller):
    out = tmp_path / "run"
    text = good(cosim("run", small, "--controller", controller, "--steps", STEPS, "--out", out))
    summary, facts = pd.read_csv(out / "summary.csv"), pd.read_csv(out / "sumo.csv")
    assert list(summary.columns) == [*COLUMNS] and len(summary) == len(facts) == 1
    assert summary.loc[0, "plant"] == "sumo" and summary.loc[0, "solver_failures"] == 0
    assert 0 < facts.loc[0, "overhead_share"] < 1 and "outside SUMO" in text and controller in text
    assert facts.loc[0, "departed_veh"] - summary.loc[0, "completed_veh"] == summary.loc[0, "final_accumulation_veh"]
    assert (out / "total_accumulation.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize(
    "strategy, against",
    [("pi-gating+max-pressure+rerouting-30", "actuated"), ("dpc-pcrg+webster+redistribute+compliance-50", None)],
)
def test_strategies_run_and_are_filed_under_their_names(small, tmp_path, strategy, against):
    out, names = tmp_path / "run", {strategy, against} - {None}
    other = ("--against", against) if against else ()
    text = good(cosim("run", small, "--controller", strategy, *other, "--steps", STEPS, "--out", out))
    facts = pd.read_csv(out / "sumo.csv")
    assert set(pd.read_csv(out / "summary.csv")["controller"]) == set(facts["controller"]) == names
    assert all(name in text and (out / f"{name}-0.nc").is_file() for name in names)
    assert (facts["signals_left_alone"] == 0).all()
    good(cosim("compare", out, "--controller", strategy))


@pytest.mark.slow
def test_run_against_and_compare(small, tmp_path):
    out = tmp_path / "run"
    arguments = ("run", small, "--controller", "pi-gating", "--against", "no-control", "--steps", STEPS, "--out", out)
    text = good(cosim(*arguments))
    assert "no-control" in text and "pi-gating" in text and "change" in text
    before = (out / "summary.csv").read_bytes()
    good(cosim(*arguments))  # everything is there already
    assert (out / "summary.csv").read_bytes() == before
    assert json.loads((out / "manifest.json").read_text())["configuration"]["plant"] == "sumo"
    text = good(cosim("compare", out, "--controller", "pi-gating"))
    rows = pd.read_csv(out / "compare-pi-gating-0.csv")
    assert list(rows["region"]) == ["0", "1", "2", "3", "4", "5", "6", "all"] and "RMSE" in text
    assert (rows["rmse_veh"] >= rows["bias_veh"].abs() - 1e-9).all()
    for picture in ("accumulation", "mfd"):
        assert (out / f"compare-pi-gating-0-{picture}.png").stat().st_size > 10_000

    def foreseen(*options):
        good(cosim("compare", out, *options))
        rows = pd.read_csv(out / "foresight.csv")
        assert set(rows["controller"]) == {"no-control", "pi-gating"} and (rows["runs"] == 1).all()
        return rows[rows["controller"] == "pi-gating"]["next_interval_rmse_share"].to_numpy()

    own = rows["next_interval_rmse_share"][:-1].to_numpy()  # of the one run of this strategy
    np.testing.assert_allclose(foreseen(), own, rtol=1e-3)
    assert np.abs(foreseen("--model", ROOT / "networks" / "grid7_guided") - own).max() > 1e-3
    assert "none/network.toml: no such file" in error_line(cosim("compare", out, "--model", tmp_path / "none"))
    assert "--seed: without --controller all runs" in error_line(cosim("compare", out, "--seed", "0"))
    (tmp_path / "several").mkdir()
    out.rename(tmp_path / "several" / "demand-1")
    good(cosim("compare", tmp_path / "several"))
    assert "several demand levels" in error_line(cosim("compare", tmp_path / "several", "--controller", "pi-gating"))


@pytest.mark.slow
def test_compare_runs_a_scenario_itself(small, tmp_path):
    good(cosim("compare", small, "--steps", STEPS, "--out", tmp_path / "run"))
    assert (tmp_path / "run" / "compare-no-control-0.csv").is_file()


@pytest.mark.slow
def test_identify_writes_a_network_that_loads(small, tmp_path):
    folder = small.parent.parent
    shutil.copytree(folder, tmp_path / "city")
    scenario, network = tmp_path / "city" / "scenarios" / "small", tmp_path / "city" / "networks" / "grid7"
    text = (scenario / "scenario.toml").read_text()
    (scenario / "scenario.toml").write_text(text.replace("steps = 80", "steps = 7"))
    before = load_network(network)
    out = tmp_path / "identify"
    good(cosim("identify", scenario, "--levels", "1.0", "--seeds", "2", "--iterations", "5", "--out", out))
    after = load_network(network)
    assert after.hash != before.hash and (after.adjacency == before.adjacency).all()
    assert after.observed_split_ratios and all(mfd.problem() is None for mfd in after.mfds)
    assert len(pd.read_csv(out / "samples.csv")) > 40 and (out / "mfd.png").is_file()
    own = next(out.glob("level-*"))
    more = ("identify", scenario, "--own", "--levels", "1.0", "--seeds", "2", "--iterations", "2", "--out", out)
    good(cosim(*more, "--runs", own, "--network", tmp_path / "city" / "networks" / "more"))
    text = (tmp_path / "city" / "networks" / "more" / "network.toml").read_text()
    assert "from 4 loading runs of" in text
    assert "and from 4 runs under no-control, probing-pc, seeds 1000 to 1001." in text


@pytest.mark.parametrize(
    "old, new, expected",
    [
        ("compliance = 1.0", "complience = 1.0", "sumo.complience: unknown key"),
        ("compliance = 1.0", "compliance = 2.0", "sumo.compliance: expected a number in [0, 1], got 2.0 instead"),
        ("guidance_period = 0.0", "guidance_period = -1", "sumo.guidance_period: expected a number"),
        ('actuation = "hold-back"', 'actuation = "hold"', "sumo.actuation: expected one of hold-back, redistribute"),
        (
            'actuation = "hold-back"',
            'signals = "green"',
            "sumo.signals: expected one of fixed, webster, actuated, max-pr",
        ),
        ("step_length = 1.0", "step_length = 0.7", "sumo.step_length: expected a divisor of the control interval"),
        ("steps = 80", 'steps = "80"', "scenario.toml: steps: "),
        ("from = 2", "from = 9", "region 9 is unknown"),
        ("../../networks/grid7", "../../networks/none", "network.toml: no such file"),
        ("../../networks/grid7", str(ROOT / "networks" / "hexagon7"), "sumo"),
    ],
)
def test_scenario_errors(small, tmp_path, old, new, expected):
    shutil.copytree(small.parent.parent, tmp_path / "city")
    file = tmp_path / "city" / "scenarios" / "small" / "scenario.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))
    out = tmp_path / "out"
    assert expected in error_line(cosim("run", file.parent, "--controller", "no-control", "--out", out))
    assert not out.exists()


def test_policy_for_another_network(small, tmp_path):
    network = load_network(ROOT / "networks" / "hexagon7")
    torch.save(checkpoint(Policy(network, Architecture(width=8)), network, {}), tmp_path / "other.pt")
    result = cosim("run", small, "--controller", "dpc-pc", "--policy", tmp_path / "other.pt", "--out", tmp_path / "out")
    assert "other.pt: network_hash: the policy was trained for network 'hexagon7'" in error_line(result)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("run", "{small}", "--controller", "nobody"), "controller 'nobody' is unknown; choose from no-control"),
        (("run", "{small}"), "--controller"),
        (("identify", "{small}", "--runs", "{tmp}"), "--runs: fits one model; say which, by --guided, --own or --with"),
        (("identify", "{small}", "--own", "--network", "{tmp}/more", "--runs", "{tmp}"), "holds no finished runs"),
        (("run", "{tmp}/none", "--controller", "no-control"), "scenario.toml: no such file"),
        (("run", "{small}", "--controller", "no-control", "--steps", "0"), "--steps"),
        (("run", "{small}", "--controller", "no-control", "--policy", "x.pt"), "reads no policy"),
        (
            ("identify", "{small}", "--levels", "a,b"),
            "'--levels': expected a list of distinct numbers above 0 up to 10",
        ),
        (("compare", "{tmp}"), "scenario.toml: no such file"),
        (("drive",), "drive"),
    ],
)
def test_command_line_errors(small, tmp_path, arguments, expected):
    filled = [argument.format(small=small, tmp=tmp_path) for argument in arguments]
    assert expected in error_line(cosim(*filled))
