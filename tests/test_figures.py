"""Figures of an evaluation: data that arrives in them, and distinct colours."""

import numpy as np
import pandas as pd
from trajectories import trajectory

from cosim.reporting import figures
from nmfd.studies import plots


def test_one_seed_is_shown_and_all_are_shaded():
    ax = plots.figure(5, 4).subplots()
    runs = [trajectory("dpc-pc", seed) for seed in (0, 1, 2)]
    plots.total_accumulation(ax, runs, seed=1)
    shown = runs[1].accumulation.sum(axis=(1, 2)) + runs[1].backlog.sum(axis=(1, 2))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), shown)
    assert len(ax.collections) == 1


def test_the_frontier_has_the_share_of_due_trips_over_demand(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        plots, "save", lambda drawing, path: drawn.append((path.name, drawing.axes[0]))
    )
    rows = pd.DataFrame(
        [
            (level, name, 1, 5.0, served, 100, 0)
            for name, level, served in (
                ("a", 1.0, 100),
                ("a", 2.0, 80),
                ("b", 1.0, 90),
                ("b", 2.0, 30),
            )
        ],
        columns=[
            "demand",
            "controller",
            "seed",
            "total_time_spent_veh_s",
            "completed_veh",
            "trips",
            "teleports",
        ],
    )
    figures.draw_levels(tmp_path, rows)
    assert [name for name, _ in drawn] == ["frontier.png", "demand.png"]
    shares = {one.get_label(): one.lines[0].get_ydata() for one in drawn[0][1].containers}
    np.testing.assert_allclose(shares["a"], [1.0, 0.8])
    np.testing.assert_allclose(shares["b"], [0.9, 0.3])
