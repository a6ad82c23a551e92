"""The command line `cosim`: run, compare and identify on a few control intervals, and its error
lines."""

import re

import copies
import numpy as np
import pandas as pd
import pytest
import torch
from commands import cosim, error_line, good
from copies import ROOT

from cosim.evaluation.model_validation import predict
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.types import Result


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Return a copy of grid7_peak with its network, with the peak at the beginning."""
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
        network = parse(name).own_planning(scenario).network
        policy = Policy(network, Architecture(width=8, guidance=guidance))
        torch.save(checkpoint(policy, network, {}), scenario.folder / f"{name}.pt")
    return scenario.folder


@pytest.mark.slow
def test_controllers_with_a_model_run(small, tmp_path):
    out, names = tmp_path / "run", ("mpc-pcrg", "dpc-pcrg")
    both = f"--controller {names[0]} --against {names[1]} --steps 2 --out"
    text = good(cosim("run", small, both, out))
    for name in names:
        result = Result.read(out / f"{name}-0.nc")
        assert name in text
        assert result.controller == name
        assert result.plant == "sumo"
        assert len(result["accumulation"]) == 3
        assert result["accumulation"][-1].sum() > 0
    assert (out / "total_accumulation.png").stat().st_size > 10_000


@pytest.mark.slow
def test_compare(small, tmp_path):
    out = tmp_path / "run"
    good(cosim("run", small, "--controller pi-gating --against no-control --steps 2 --out", out))
    assert "whole run" in good(cosim("compare", out))
    rows = pd.read_csv(out / "foresight.csv")
    assert set(rows["controller"]) == {"no-control", "pi-gating"}
    assert (rows["runs"] == 1).all()
    own = rows[rows["controller"] == "pi-gating"][
        ["next_interval_rmse_share", "whole_run_rmse_share"]
    ].to_numpy()
    assert own.shape == (7, 2)
    assert (out / "compare-pi-gating-0-region_accumulation.png").stat().st_size > 10_000
    run, scenario = Result.read(out / "pi-gating-0.nc"), load_scenario(small)
    off = predict(scenario, run).accumulation.sum(axis=2) - run.accumulation.sum(axis=2)
    np.testing.assert_allclose(
        own[:, 1], np.sqrt((off**2).mean(axis=0)) / scenario.network.seen_critical, rtol=1e-3
    )


RUN = "run {small} --controller no-control --out {tmp}/out"
EVALUATE = "evaluate {small} --out {tmp}/out --controllers"
IMPORT = "import --out {tmp}/out/city"


@pytest.mark.parametrize(
    "line, expected",
    [
        (
            f"{RUN} --set sumo.complience=1",
            "sumo.complience: unknown key; did you mean compliance?",
        ),
        (
            f"{RUN} --set sumo.step_length=0.7",
            "sumo.step_length: expected a divisor of the control interval",
        ),
        (f"{RUN} --set network={ROOT / 'networks' / 'hexagon7'}", "sumo"),
        (f"{RUN} --demand nan", "Invalid value for '--demand': 'nan' is not a number"),
        ("identify grid8", "no scenario or network of that name comes with the package"),
        (f"{RUN} --policy x.pt", "reads no policy"),
        ("run {small}", "`nmfd show` lists them"),
        ("run {tmp}/none --controller no-control", "scenario.toml: no such file"),
        (f"{EVALUATE} no-control,nobody", "'nobody' is unknown"),
        (
            f"{EVALUATE} no-control --policy dpc-pc=x.pt",
            "--policy: 'dpc-pc' is not among no-control; add it",
        ),
        ("compare {tmp}", "holds no finished runs"),
        ("identify {small} --levels 0,1", "'--levels': 0.0 is not in the range 0.0<x<=10.0"),
        ("watch {small} --controller no-control --against x --gui", "omit --against"),
        ("tune {small} --controller pi-gating --option kp", "--option"),
        (f"{IMPORT} --regions 3", "expected either a file or --bbox"),
        (f"{IMPORT} {{tmp}}/none.sumocfg --regions 1", "--regions: expected 2 or more regions"),
        (f"{IMPORT} {{tmp}}/none.sumocfg --regions 3", "none.sumocfg"),
        ("drive", "No such command 'drive'"),
        ("list", "No such command 'list': it is `nmfd show`"),
    ],
    ids=lambda value: value[-60:],
)
def test_error_lines(small, tmp_path, line, expected):
    assert expected in error_line(cosim(line.format(small=small, tmp=tmp_path)))
    assert not (tmp_path / "out").exists()
