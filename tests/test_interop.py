"""SUMO's own outputs and Parquet files beside ours: there, complete, and in agreement."""

import gzip
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import copies
import pandas as pd
import pytest
import tiny
from click.testing import CliRunner

import cosim.cli
import nmfd.cli
from nmfd.runs import run_folder

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def peak(tmp_path_factory):
    return copies.peak(tmp_path_factory.mktemp("city"))


def cosim_run(*arguments):
    return CliRunner().invoke(cosim.cli, ["run", *(str(a) for a in arguments)])


@pytest.mark.slow
def test_outputs_of_sumo_agree_with_ours_and_are_made_up_for(peak, tmp_path):
    out = tmp_path / "out"
    command = (peak, "--controller", "pi-gating+actuated", "--steps", "4", "--out", out)
    assert cosim_run(*command).exit_code == 0
    before = (out / "pi-gating+actuated-0.nc").read_bytes()
    done = cosim_run(*command, "--sumo-output", "tripinfo,summary,edgedata,emission", "--parquet")
    assert done.exit_code == 0, done.output + str(done.exception)
    assert (out / "pi-gating+actuated-0.nc").read_bytes() == before  # the outputs change nothing
    facts = pd.read_csv(out / "sumo.csv").iloc[0]
    name = "pi-gating+actuated-0."
    trips = ElementTree.parse(out / f"{name}tripinfo.xml").getroot()
    assert sum(float(trip.get("depart")) >= 0 for trip in trips) == facts["departed_veh"] > 0
    last = ElementTree.parse(out / f"{name}summary.xml").getroot()[-1]
    row = run_folder.read_summary(out / "summary.csv")[0]
    assert int(last.get("running")) == row["final_accumulation_veh"] and int(last.get("ended")) == row["completed_veh"]
    intervals = ElementTree.parse(out / f"{name}edgedata.xml").getroot()
    assert [float(interval.get("begin")) for interval in intervals] == [0.0, 90.0, 180.0, 270.0]
    with gzip.open(out / f"{name}emission.xml.gz", "rt") as stream:
        assert "CO2=" in stream.read()
    assert not list(out.glob(".*"))
    states = pd.read_parquet(out / "states.parquet")
    assert states.loc[states["time_s"] == 360.0, "accumulation_veh"].sum() == row["final_accumulation_veh"]
    summary = pd.read_parquet(out / "summary.parquet")
    assert summary.loc[0, "co2_kg"] == pytest.approx(facts["co2_kg"])


def test_unknown_outputs(peak, tmp_path):
    done = cosim_run(peak, "--controller", "no-control", "--sumo-output", "tripinfo,fcd", "--out", tmp_path / "out")
    assert done.exit_code == 2 and done.stderr.count("\n") == 1 and not (tmp_path / "out").exists()
    assert "--sumo-output: 'fcd' is unknown; choose from tripinfo, summary, edgedata, emission" in done.stderr


def test_outputs_from_python(peak, tmp_path):
    cosim.run(peak, "no-control", steps=1, sumo_output={"tripinfo": tmp_path / "trips.xml"})
    assert ElementTree.parse(tmp_path / "trips.xml").getroot().tag == "tripinfos"


def test_parquet_of_a_benchmark(tmp_path):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    done = CliRunner().invoke(
        nmfd.cli,
        ["benchmark", str(scenario), "--controllers", "no-control,pi-gating", "--parquet", "--out", str(out)],
    )
    assert done.exit_code == 0, done.output
    summary = pd.read_parquet(out / "summary.parquet")
    assert summary.to_dict("records") == run_folder.read_summary(out / "summary.csv")
    states, controls = pd.read_parquet(out / "states.parquet"), pd.read_parquet(out / "controls.parquet")
    assert len(states) == 2 * 21 * 4 and len(controls) == 2 * 20 * 4
    total = 30.0 * states[states["time_s"] < 600.0].groupby("controller")["accumulation_veh"].sum()
    assert total["pi-gating"] == pytest.approx(
        summary.set_index("controller").loc["pi-gating", "total_time_spent_veh_s"]
    )
