"""Paired intervals against worked examples, and what the tables of an evaluation say."""

import math

import pytest
from made_up import rows_of

from cosim.evaluation import statistics


def test_paired_interval_of_a_worked_example():
    pair = statistics.paired({1: 90.0, 2: 160.0, 3: 210.0}, {1: 100.0, 2: 200.0, 3: 300.0})
    assert pair.percent == pytest.approx(-20.0)
    assert pair.percent_half == pytest.approx(
        4.302653 * 10.0 / math.sqrt(3)
    )  # t quantile, 2 degrees of freedom
    assert not pair.significant


def test_pairing_removes_what_a_seed_does_to_both():
    """Seeds differ by a factor of ten, the controllers by 10 to 11 %: the paired interval excludes
    zero."""
    reference = {seed: 10.0**seed for seed in range(4)}
    pair = statistics.paired(
        {seed: (0.9 - 0.003 * seed) * value for seed, value in reference.items()}, reference
    )
    assert pair.significant
    assert pair.percent == pytest.approx(-10.45)


def test_only_common_seeds_count_and_one_alone_proves_nothing():
    pair = statistics.paired({1: 50.0, 2: 1.0}, {1: 100.0, 3: 1.0})
    assert (pair.seeds, pair.percent) == (1, -50.0)
    assert math.isnan(pair.percent_half)
    assert not pair.significant
    assert statistics.paired({1: 1.0}, {2: 1.0}).seeds == 0


@pytest.fixture
def rows():
    return rows_of(
        {
            (1.0, "no-control"): {2000: 100.0, 2001: 110.0, 2002: 100.0},
            (1.0, "dpc-pc"): {2000: 50.0, 2001: 56.0, 2002: 49.0},
            (1.0, "mpc-pc"): {2000: 50.0, 2001: 55.0},
            (1.0, "pi-gating"): {2000: 60.0},
            (1.3, "no-control"): {2000: 300.0, 2001: 330.0},
            (1.3, "dpc-pc"): {2000: 330.0, 2001: 320.0},
        }
    )


def test_statistics_pair_within_a_demand_level(rows):
    table = statistics.statistics(rows).set_index(["demand", "controller"])
    assert table.loc[(1.0, "dpc-pc"), "change_percent"] == pytest.approx(-50.030303)
    assert table.loc[(1.0, "dpc-pc"), "change_significant"]
    assert not table.loc[(1.3, "dpc-pc"), "change_significant"]
    assert math.isnan(table.loc[(1.0, "no-control"), "change_percent"])
    assert (table["teleports"] == 0).all()


def test_pairs_hold_every_pair_in_both_directions(rows):
    pairs = statistics.pairs(rows).set_index(["demand", "controller", "against"])
    assert len(pairs) == 4 * 3 + 2
    there, back = pairs.loc[(1.0, "dpc-pc", "no-control")], pairs.loc[(1.0, "no-control", "dpc-pc")]
    assert there["change_percent"] < 0 < back["change_percent"]
    assert there["seeds"] == 3
    assert there["significant"]
    assert not pairs.loc[(1.0, "pi-gating", "dpc-pc"), "significant"]


def test_tables_show_a_line_per_controller_and_the_teleports(rows):
    text, page = statistics.text(rows), statistics.markdown(rows)
    assert "Demand times 1.3" in text and "%*" in text and "-50.0 % " in text, (
        "no star and no ± 0 on two seeds"
    )
    first = next(line for line in page.splitlines() if line.startswith("| dpc-pc"))
    assert first.rstrip("| ").endswith("| 0")
    assert "-50.0 ± 2.4 %*" in first
