"""Paired intervals against worked examples, and what the tables of an evaluation say."""

import math

import pandas as pd
import pytest
from made_up import rows_of

from cosim.evaluation import statistics
from cosim.reporting import figures


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
    assert "Demand times 1.3" in text
    assert "%*" in text
    assert "-50.0 % " in text  # no star and no ± 0 on two seeds
    first = next(line for line in page.splitlines() if line.startswith("| dpc-pc"))
    assert first.rstrip("| ").endswith("| 0")
    assert "-50.0 ± 2.4 %*" in first


def test_many_teleports_and_removed_vehicles_are_flagged():
    """Three times the teleports of the reference, from one a run on, are many."""
    seeds = {1: 100.0, 2: 100.0}
    names = ("no-control", "max-pressure", "pi-gating", "actuated")
    rows = rows_of({(1.0, name): seeds for name in names}).assign(removed_veh=0.0)
    counts = {"no-control": 4, "max-pressure": 12, "pi-gating": 13, "actuated": 0}
    rows["teleports"] = rows["controller"].map(counts)
    rows.loc[rows["controller"] == "actuated", "removed_veh"] = [0.0, 3.0]
    table = statistics.statistics(rows)
    teleports, removed = statistics.warnings(table)
    assert teleports.startswith("WARNING: many times the teleports of no-control, ")
    assert teleports.endswith(": pi-gating 13 a run")
    assert removed.startswith("WARNING: vehicles were removed, ")
    assert removed.endswith(": actuated 1.5 a run")
    outcomes = statistics.shown(table)[0]
    assert list(outcomes["teleports"]) == ["8", "24", "26 !", "0"]
    assert list(outcomes["removed [veh]"]) == ["0", "0", "0", "2 !"]
    for words in (teleports, removed):
        assert words in " ".join(statistics.text(rows).split())
        assert words in statistics.markdown(rows)
    quiet = rows.assign(teleports=0, removed_veh=0.0)
    assert statistics.warnings(statistics.statistics(quiet)) == []
    few = quiet.assign(teleports=rows["controller"].map({**counts, "no-control": 0}))
    assert ": max-pressure 12, pi-gating 13 a run" in statistics.markdown(few)


UNEQUAL = {
    ("a", 1.0, "no-control"): {1: 100.0, 2: 200.0},
    ("a", 1.0, "pi-gating"): {1: 90.0, 2: 180.0},
    ("a", 1.0, "mpc-pc"): {2: 190.0},
    ("b", 1.0, "no-control"): {1: 100.0, 2: 100.0},
    ("b", 1.0, "pi-gating"): {1: 70.0, 2: 110.0},
    ("b", 1.0, "mpc-pc"): {1: 50.0, 2: 104.0},
}


def suite(values):
    """Return rows of several scenarios."""
    parts = []
    for (scenario, level, name), seeds in values.items():
        parts.append(rows_of({(level, name): seeds}).assign(scenario=scenario))
    return pd.concat(parts, ignore_index=True)


def test_unequal_numbers_of_seeds_are_not_averaged_into_a_ranking():
    """In scenario a only seed 2 counts, because mpc-pc has no other one."""
    lines = statistics.ranking(suite(UNEQUAL)).splitlines()
    assert lines[2:5] == [
        "| 1 | mpc-pc | -14.0 % | 2 |",
        "| 2 | pi-gating | -10.0 % | 2 |",
        "| 3 | no-control | +0.0 % | 2 |",
    ]
    assert lines[-1].endswith("have different seeds: only those that all have count.")
    equal = {key: {2: seeds[2]} for key, seeds in UNEQUAL.items()}
    assert "| 1 | mpc-pc | -0.5 % | 2 |" in statistics.ranking(suite(equal))
    assert "different seeds" not in statistics.ranking(suite(equal))


def test_a_controller_that_lacks_a_scenario_has_no_rank():
    some = {key: seeds for key, seeds in UNEQUAL.items() if key != ("a", 1.0, "mpc-pc")}
    lines = statistics.ranking(suite(some)).splitlines()
    assert [line.split(" | ")[:2] for line in lines[2:]] == [
        ["| 1", "pi-gating"],
        ["| 2", "no-control"],
        ["| -", "mpc-pc"],
    ]


def test_the_best_is_the_best_on_the_seeds_that_all_have():
    """On its only seed mpc-pc is third, although its change is larger than that of pi-gating."""
    values = {
        (1.0, "no-control"): {1: 100.0, 2: 100.0},
        (1.0, "pi-gating"): {1: 100.0, 2: 60.0},
        (1.0, "dpc-pc"): {1: 100.0, 2: 71.0},
        (1.0, "mpc-pc"): {2: 75.0},
    }
    rows = rows_of(values)
    assert figures.ranked(rows) == ["pi-gating", "dpc-pc", "mpc-pc", "no-control"]
    table = statistics.statistics(rows)
    (warning,) = [text for text in statistics.warnings(table) if "seeds" in text]
    assert "no-control 2, pi-gating 2, dpc-pc 2, mpc-pc 1" in warning
    apart = rows_of({(1.0, "a"): {1: 1.0, 2: 1.0}, (1.0, "b"): {2: 1.0}, (1.0, "c"): {3: 1.0}})
    assert set(statistics.on_common_seeds(apart)["controller"]) == {"a", "b"}


def test_the_floor_is_the_time_of_trips_without_delay():
    table = pd.DataFrame(
        {
            "controller": ["locked", "served", "detour"],
            "trips": [100.0, 100.0, 100.0],
            "completed_veh": [90.0, 100.0, 100.0],
            "mean_trip_time_s": [900.0, 300.0, 310.0],
            "mean_departure_delay_s": [100.0, 20.0, 0.0],
            "mean_time_loss_s": [700.0, 80.0, 90.0],
        }
    )
    assert (
        statistics.floor(table) == "Floor: on the ways of served, without any delay, 2e+04 veh s."
    )
    assert statistics.floor(table[:1]) == ""


@pytest.mark.parametrize("name", ["pi-gating", "route-guidance+max-pressure+guidance-period-60"])
def test_the_table_of_the_terminal_is_narrow_and_has_a_legend_on_demand(name):
    seeds = {seed: 1.0e6 + seed for seed in range(3)}
    rows = rows_of({(1.0, "no-control"): seeds, (1.0, name): seeds})
    text = statistics.text(rows)
    explained = statistics.text(rows, explain=True)
    assert max(map(len, explained.splitlines())) <= 100
    assert len(statistics.brief(statistics.statistics(rows)).columns) <= 10
    assert explained.startswith(text)
    assert " completed " in text
    assert "\nTTS: " in explained
    assert "\nTTS: " not in text
