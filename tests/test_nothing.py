"""Nobody drives: no demand, or runs too short for anybody to spend time. Percentages are then not
defined, and every table, picture and sentence says so."""

import math

import pandas as pd
import pytest
import tiny
from commands import good, nmfd
from made_up import rows_of

from cosim.evaluation import statistics
from cosim.report import figures
from nmfd.studies.benchmark import interval


@pytest.fixture
def rows() -> pd.DataFrame:
    return rows_of(
        {
            (level, name): {1: 0.0, 2: time}
            for level in (1.0, 1.3)
            for name, time in (("no-control", 0.0), ("pi-gating", 0.0), ("mpc-pc", 5.0))
        }
    )


@pytest.mark.parametrize(
    "command",
    [
        "benchmark scenario --controllers no-control,pi-gating,mpc-pcrg --seeds 2 --out out",
        "robustness scenario --controllers pi-gating --scenarios 2 --out out",
        "show scenario --out out",
        pytest.param("bound scenario --controller bound-pc --out plan.npz", marks=pytest.mark.slow),
    ],
)
def test_commands_without_demand(tmp_path, monkeypatch, command):
    tiny.write(tmp_path, scenario=tiny.SCENARIO.replace("peak = 2.0", "peak = 0.0"))
    monkeypatch.chdir(tmp_path)
    said = good(nmfd(*command.split()))
    assert "nan" not in said
    assert "inf" not in said


def test_tables(rows):
    assert math.isnan(statistics.paired({1: 0.0, 2: 3.0}, {1: 0.0, 2: 2.0}).percent)
    assert math.isnan(interval([math.nan, 1.0, 2.0]))
    table = statistics.statistics(rows)
    assert table["change_percent"].isna().all()
    assert not table["change_significant"].astype(bool).any()
    text = statistics.text(rows.assign(trips=0.0))
    assert "nan" not in text
    assert "inf" not in text
    assert text.splitlines()[3].split()[:6] == ["pi-gating", "2", "0.000e+00", "±", "0.0e+00", "-"]


def test_pictures(rows, tmp_path):
    one = rows[rows["demand"] == 1.0].assign(trips=0, completed_veh=0.0, teleports=0)
    assert figures.ranked(one)[-1] == "mpc-pc"
    figures.draw_levels(tmp_path, rows.assign(trips=0, completed_veh=0.0, teleports=0))
    assert not (tmp_path / "demand.png").exists()
