"""Ablations: rows of every run, figures, nothing run twice, and errors in one line."""

import pytest
import tiny
from click.testing import CliRunner

from nmfd import ablation, plots, plots_experiments, runs, training
from nmfd.cli import main


@pytest.fixture
def folder(tmp_path):
    return tiny.write(tmp_path, network=tiny.row_network(3))


def nmfd(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_training_compares_both_methods_and_goes_on(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "VALIDATE_EVERY", 1)
    out = tmp_path / "out"
    command = ["ablation", "training", folder, "--steps", 2, "--seeds", 1, "--out", out]
    result = nmfd(*command)
    assert result.exit_code == 0, result.stderr
    rows = runs.read_rows(out / "training.csv", ablation.TRAINING_COLUMNS)
    assert [(row["method"], row["adam_step"]) for row in rows] == [
        ("alternating", 1), ("alternating", 2), ("joint", 1), ("joint", 2)]
    assert rows[1]["total_time_spent_veh_s"] != rows[3]["total_time_spent_veh_s"]
    monkeypatch.setattr(training, "train", None)  # nothing is left to train
    assert nmfd(*command).stdout == result.stdout
    assert {path.name for path in out.iterdir()} == {"training.csv", "training.png", "manifest.json"}
    assert nmfd(*command[:3], "--steps", 3, "--out", out).exit_code == 2


def test_horizon_runs_every_length_and_can_be_extended(folder, tmp_path):
    out = tmp_path / "out"
    command = ["ablation", "horizon", folder, "--controllers", "mpc-pc", "--out", out, "--horizons"]
    assert nmfd(*command, "2").exit_code == 0
    result = nmfd(*command, "2,4")
    assert result.exit_code == 0, result.stderr
    rows = runs.read_rows(out / "horizon.csv", ablation.HORIZON_COLUMNS)
    assert [(row["controller"], row["horizon"]) for row in rows] == [("mpc-pc", 2), ("mpc-pc", 4)]
    assert "horizon  4" in result.stdout and (out / "horizon.png").stat().st_size > 1000


@pytest.mark.parametrize("arguments, fragment", [
    (["training", "--controller", "dpc-pc"], "dpc-pc has one decoder only"),
    (["horizon", "--controllers", "dpc-pc"], "dpc-pc has no horizon"),
    (["horizon", "--horizons", "1,8"], "--horizons: expected different whole numbers from 2 up"),
    (["horizon", "--horizons", "8,8"], "--horizons: expected different"),
    (["training", "--controller", "mpc-pc"], "'mpc-pc' cannot be trained")])
def test_wrong_arguments_are_one_line(folder, tmp_path, arguments, fragment):
    result = nmfd("ablation", arguments[0], folder, *arguments[1:], "--out", tmp_path / "out")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and fragment in result.stderr
    assert not (tmp_path / "out").exists()


def test_curves_show_the_best_so_far_of_every_seed():
    rows = [
        dict(zip(ablation.TRAINING_COLUMNS, ("joint", seed, step, total), strict=True))
        for seed, totals in enumerate(([4.0, 5.0, 2.0], [8.0, 1.0, 3.0])) for step, total in enumerate(totals)]
    ax = plots_experiments.training_curves(plots.figure(4, 3).subplots(), rows)
    assert list(ax.lines[0].get_ydata()) == [6.0, 2.5, 1.5] and "2 seeds" in ax.lines[0].get_label()
    assert "veh s" in ax.get_ylabel()
