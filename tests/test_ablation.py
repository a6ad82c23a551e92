"""Ablations: rows of every run, figures, nothing run twice, and errors in one line."""

import pytest
import tiny
from commands import nmfd

from nmfd.controllers.dpc import training
from nmfd.runs import files
from nmfd.studies import ablation, plots, plots_studies


@pytest.fixture
def folder(tmp_path):
    return tiny.write(tmp_path, network=tiny.row_network(3))


@pytest.fixture
def training_command(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "VALIDATE_EVERY", 1)
    return ["ablation", "training", folder, "--steps", 2, "--seeds", 1, "--out", tmp_path / "out"]


def test_training_compares_both_methods_on_the_plant(training_command, tmp_path):
    out = tmp_path / "out"
    result = nmfd(*training_command)
    assert result.exit_code == 0, result.stderr
    curve = files.read_rows(out / "validation.csv", ablation.VALIDATION_COLUMNS)
    assert [(row["method"], row["adam_step"]) for row in curve] == [
        ("alternating", 1),
        ("alternating", 2),
        ("joint", 1),
        ("joint", 2),
    ]
    assert curve[1]["total_time_spent_veh_s"] != curve[3]["total_time_spent_veh_s"]
    rows = files.read_rows(out / "training.csv", ablation.TRAINING_COLUMNS)
    assert [(row["method"], row["seed"], row["adam_steps"]) for row in rows] == [("alternating", 0, 2), ("joint", 0, 2)]
    for row in rows:
        points = [point["total_time_spent_veh_s"] for point in curve if point["method"] == row["method"]]
        assert row["best_validation_veh_s"] == min(points)
        # In a row of regions there is one way only: the acyclic plant and the regional model do not differ.
        assert row["total_time_spent_veh_s"] == pytest.approx(min(points), rel=1e-2)
    assert {path.name for path in out.iterdir()} == {"validation.csv", "training.csv", "training.png", "manifest.json"}
    assert [line.split()[:2] for line in result.stdout.splitlines()[1:5]] == [
        ["alternating", "0"],
        ["joint", "0"],
        ["alternating", "mean"],
        ["joint", "mean"],
    ]


def test_training_is_not_repeated_and_seeds_can_be_added(training_command, tmp_path, monkeypatch):
    result = nmfd(*training_command)
    trained, original = [], training.train

    def train(*args, **kwargs):
        trained.append(kwargs["seed"])
        return original(*args, **kwargs)

    monkeypatch.setattr(training, "train", train)
    assert nmfd(*training_command).stdout == result.stdout and not trained
    assert nmfd(*training_command, "--seeds", 2).exit_code == 0
    assert trained == [1, 1]
    assert len(files.read_rows(tmp_path / "out" / "validation.csv", ablation.VALIDATION_COLUMNS)) == 8
    refused = nmfd(*training_command, "--steps", 3)
    assert refused.exit_code == 2 and "adam_steps: 2 there, 3 asked for" in refused.stderr


def test_an_interrupted_training_keeps_the_finished_ones(training_command, tmp_path, monkeypatch):
    whole = nmfd(*training_command[:-1], tmp_path / "whole")
    trained, original = [], training.train

    def train(*args, **kwargs):
        trained.append(kwargs["seed"])
        if len(trained) == 2:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    monkeypatch.setattr(training, "train", train)
    result = nmfd(*training_command)
    assert result.exit_code == 130 and result.stderr.count("\n") == 1 and "goes on" in result.stderr
    assert nmfd(*training_command).stdout.splitlines()[:-1] == whole.stdout.splitlines()[:-1]
    assert len(trained) == 3
    for name in ("validation.csv", "training.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_horizon_runs_every_length_and_can_be_extended(folder, tmp_path):
    out = tmp_path / "out"
    command = ["ablation", "horizon", folder, "--controllers", "mpc-pc", "--out", out, "--horizons"]
    assert nmfd(*command, "2").exit_code == 0
    result = nmfd(*command, "2,4")
    assert result.exit_code == 0, result.stderr
    rows = files.read_rows(out / "horizon.csv", ablation.HORIZON_COLUMNS)
    assert [(row["controller"], row["horizon"]) for row in rows] == [("mpc-pc", 2), ("mpc-pc", 4)]
    assert [line.split()[:2] for line in result.stdout.splitlines()[1:3]] == [["mpc-pc", "2"], ["mpc-pc", "4"]]
    assert (out / "horizon.png").stat().st_size > 1000


@pytest.mark.parametrize(
    "arguments, fragment",
    [
        (["training", "--controller", "dpc-pc"], "dpc-pc has one decoder only"),
        (["horizon", "--controllers", "dpc-pc"], "dpc-pc has no horizon"),
        (["horizon", "--horizons", "1,8"], "'--horizons': expected a list of distinct whole numbers from 2"),
        (["horizon", "--horizons", "8,8"], "'--horizons': expected a list of distinct"),
        (["training", "--controller", "mpc-pc"], "'mpc-pc' cannot be trained"),
    ],
)
def test_wrong_arguments_are_one_line(folder, tmp_path, arguments, fragment):
    result = nmfd("ablation", arguments[0], folder, *arguments[1:], "--out", tmp_path / "out")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and fragment in result.stderr
    assert not (tmp_path / "out").exists()


def test_curves_show_the_best_so_far_of_every_seed():
    rows = [
        dict(zip(ablation.VALIDATION_COLUMNS, ("joint", seed, step, total), strict=True))
        for seed, totals in enumerate(([4.0, 5.0, 2.0], [8.0, 1.0, 3.0]))
        for step, total in enumerate(totals)
    ]
    ax = plots_studies.training_curves(plots.figure(4, 3).subplots(), rows)
    assert list(ax.lines[0].get_ydata()) == [6.0, 2.5, 1.5] and "2 seeds" in ax.lines[0].get_label()
    assert "veh s" in ax.get_ylabel()


def test_every_trained_policy_has_its_point():
    rows = [
        {"method": method, "total_time_spent_veh_s": total}
        for method, total in (("alternating", 3.0), ("alternating", 5.0), ("joint", 2.0))
    ]
    ax = plots_studies.trained(plots.figure(4, 3).subplots(), rows)
    assert [list(line.get_ydata()) for line in ax.lines] == [[3.0, 5.0], [2.0]]
    assert [text.get_text() for text in ax.get_xticklabels()] == ["alternating", "joint"]
    assert ax.collections[0].get_segments()[0][0][1] == 4.0
