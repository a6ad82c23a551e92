"""Films of recorded runs: what is in a frame, which run is chosen, and nothing half-written."""

import made_up
import numpy as np
import pytest
from commands import cosim, error_line
from matplotlib.colors import to_rgb
from PIL import Image

from cosim.evaluation import results as finished
from cosim.evaluation.experiment import read_run
from cosim.report import figures, video
from nmfd.runs.run_folder import read_trajectory, write_trajectory


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_up.folder(tmp_path_factory.mktemp("runs") / "made-up", levels=(0.8, 1.0), seeds=(2000, 2001))


def test_a_frame_shows_the_densities_and_numbers_of_its_interval(folder):
    found = finished.read(folder)
    level = found.level(1.0)
    results = {name: read_run(level.folder, name, 2001) for name in ("no-control", "pi-gating")}
    drawing, update = video.scene(found.city, results, "x")
    update(3)
    for ax, result in zip(drawing.axes, results.values(), strict=False):
        edge = found.city.edges[17]
        vehicles = float(result.record["edge_vehicles"][3, 17])
        density = vehicles / (found.city.length[edge] / 1000) / found.city.lanes[edge]
        np.testing.assert_allclose(ax.collections[0].get_colors()[17], figures.DENSITIES.to_rgba(density))
        inside = result.trajectory.accumulation[4].sum()
        assert f"6 min\n{inside:,.0f} inside" in ax.get_title() and "400 trips completed" in ax.get_title()
    hand = next(line for line in drawing.axes[2].lines if line.get_color() == "#d62728")
    assert hand.get_xdata()[0] == 6.0


def test_a_gif_of_two_runs_has_a_frame_per_interval(folder):
    result = cosim("video", folder, "--against", "no-control", "--seed", "2001", "--demand", "0.8")
    path = folder / "demand-0.8" / "video-dpc-pcrg-against-no-control-2001.gif"
    assert result.exit_code == 0 and str(path) in result.stdout, result.output
    with Image.open(path) as film:
        assert film.n_frames == made_up.STEPS and film.info["duration"] in (120, 125, 130)
        film.seek(2)
        colours = np.asarray(film.convert("RGB")).reshape(-1, 3)
    assert path.stat().st_size < 1_000_000
    tone = 255 * np.array(to_rgb("#882255"))  # the curve of dpc-pcrg
    assert (np.abs(colours - tone).max(axis=1) < 12).any()


def test_a_long_run_is_thinned_out(folder, monkeypatch, tmp_path):
    monkeypatch.setattr(video, "FRAMES", 2)
    assert cosim("video", folder, "--out", tmp_path / "x.gif").exit_code == 0
    with Image.open(tmp_path / "x.gif") as film:
        assert film.n_frames == 2


def test_an_mp4_where_ffmpeg_is(folder, tmp_path):
    if video.ffmpeg() is None:
        pytest.skip("no ffmpeg")
    assert cosim("video", folder, "--out", tmp_path / "x.mp4").exit_code == 0
    assert (tmp_path / "x.mp4").read_bytes()[4:8] == b"ftyp"


def test_an_interruption_leaves_nothing(folder, tmp_path):
    found = finished.read(folder)

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.film(tmp_path / "x.gif", found, found.level(None), ["no-control"], 2000, progress=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("--controller", "mpc-pc"), "--controller: "),
        (("--against", "mpc-pc"), "choose from no-control, pi-gating"),
        (("--seed", "7"), "with seed 7; choose from 2000, 2001"),
        (("--demand", "2"), "choose one of 0.8, 1"),
        (("--out", "{tmp}/x.avi"), "expected a name that ends in .gif or .mp4"),
        (("--out", "{tmp}/x.mp4"), "there is no ffmpeg for mp4; install ffmpeg, or pip install"),
    ],
)
def test_error_lines(folder, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.setattr(video, "ffmpeg", lambda: None)
    assert expected in error_line(cosim("video", folder, *(a.format(tmp=tmp_path) for a in arguments)))
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_its_record_says_so(folder, tmp_path):
    """As one of the regional model is."""
    path = folder / "demand-1" / "no-control-2000.nc"
    before = path.read_bytes()
    write_trajectory(path, read_trajectory(path))
    try:
        line = error_line(cosim("video", folder, "--controller", "no-control", "--out", tmp_path / "x.gif"))
    finally:
        path.write_bytes(before)
    assert "no-control-2000.nc: is no run" in line and "departures" in line
