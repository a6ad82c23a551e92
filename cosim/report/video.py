"""A film of link densities over the time of a run, from its record; of two runs side by side."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from matplotlib import animation, rc_context
from matplotlib.figure import Figure

from cosim.evaluation.experiment import read_run
from cosim.evaluation.results import Finished, Level
from cosim.evaluation.simulate import Result
from cosim.report import figures, pictures
from cosim.sumo.net import City, edge_shapes
from nmfd.errors import InputError, did_you_mean
from nmfd.runs import trail
from nmfd.runs.files import atomic, file_name
from nmfd.studies import plots

FRAMES = 120  # at most: of a longer run every second, third ... interval is shown
DPI = 80
SUFFIXES = (".gif", ".mp4")
FFMPEG_HINT = "install ffmpeg, or pip install 'perimeter-cosim[video]', or choose a name that ends in .gif"


def choose(
    finished: Finished, level: Level, controller: str | None, against: str | None, seed: int | None
) -> tuple[list[str], int]:
    """Names and seed of the runs to show: the best controller, and the first seed that all of them have.

    Raises InputError, also where there is no map to show them on.
    """
    rows, option = level.rows, "--controller"
    names = [controller or pictures.ranked(rows)[0]]
    if against is not None and against != names[0]:
        names.append(against)
    for name in names:
        if name not in set(rows["controller"]):
            raise InputError(
                f"{option}: {level.folder} has no runs of {name!r}"
                f"{did_you_mean(name, rows['controller'])}; choose from "
                f"{', '.join(dict.fromkeys(rows['controller']))}"
            )
        option = "--against"
    common = set.intersection(*(set(rows.loc[rows["controller"] == name, "seed"]) for name in names))
    if not common:
        raise InputError(
            f"--against: {' and '.join(names)} have no seed in common in {level.folder}; run one seed with both"
        )
    if seed is not None and seed not in common:
        raise InputError(
            f"--seed: {level.folder} has no run of {' and '.join(names)} with seed {seed}; choose from "
            f"{', '.join(map(str, sorted(common)))}"
        )
    finished.map()
    return names, int(min(common) if seed is None else seed)


def default_path(level: Level, names: Sequence[str], seed: int) -> Path:
    """Where a film goes that is given no place of its own."""
    return level.folder / f"video-{file_name('-against-'.join(names))}-{seed}.gif"


def film(
    path: Path,
    finished: Finished,
    level: Level,
    names: Sequence[str],
    seed: int,
    *,
    rate: int = 8,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the film, atomically; the suffix of `path` chooses the format. rate: frames per second.

    Raises InputError for another suffix, a missing ffmpeg, and runs that cannot be read.
    """
    with _writer(path, rate) as writer:
        results = {name: read_run(level.folder, name, seed) for name in names}
        drawing, update = scene(finished.map(), results, f"{finished.scenario.name}, demand times {level.demand:g}")
        steps = min(len(result.record["edge_vehicles"]) for result in results.values())
        shown = range(0, steps, -(-steps // FRAMES))
        with atomic(path) as temporary:
            with writer.saving(drawing, str(temporary), DPI):
                for n, k in enumerate(shown):
                    update(k)
                    writer.grab_frame()
                    if progress:
                        progress(n + 1, len(shown))
            if path.suffix == ".gif":
                trail.into_gif(temporary, trail.text(trail.of(path)))
    return path


def scene(city: City, results: dict[str, Result], title: str) -> tuple[Figure, Callable[[int], None]]:
    """A figure of a map per run over the total accumulation, and a function that sets it to control interval k."""
    shapes, lanes = edge_shapes(city), np.array([city.lanes[edge] for edge in city.edges])
    km = np.array([city.length[edge] for edge in city.edges]) / 1000.0
    region = np.array([city.region_of[edge] for edge in city.edges])
    width, height = np.ptp(np.concatenate(shapes), axis=0)
    tall = float(np.clip(5.0 * height / width, 3.0, 7.0))
    drawing = plots.figure(5.0 * len(results) + 1.0, tall + 2.7)
    grid = drawing.add_gridspec(2, len(results), height_ratios=[tall, 1.7])
    maps = [drawing.add_subplot(grid[0, n]) for n in range(len(results))]
    below = drawing.add_subplot(grid[1, :])
    for ax in maps:
        figures.link_densities(ax, shapes, np.zeros(len(km)), lanes, region)
        ax.set_title("\n", fontsize="medium")
    bar = drawing.colorbar(figures.DENSITIES, ax=maps, shrink=0.8, aspect=30)
    bar.set_label("vehicles per km and lane")
    plots.total_accumulation(below, [result.trajectory for result in results.values()])
    below.legend(frameon=False, fontsize="small", loc="upper left")
    hand = below.axvline(0.0, color=plots.RED, linewidth=1.2)
    step = next(iter(results.values())).trajectory.step
    ends = step * max(len(result.trajectory.perimeter) for result in results.values())
    minute = 60.0 if ends <= 4 * 3600 else 3600.0  # as plots.time_axis
    drawing.suptitle(title, fontsize="medium")
    drawing.canvas.draw()
    drawing.set_layout_engine("none")  # nothing may move from frame to frame

    def update(k: int) -> None:
        for ax, (name, result) in zip(maps, results.items(), strict=True):
            trajectory = result.trajectory
            ax.collections[0].set_color(
                figures.DENSITIES.to_rgba(result.record["edge_vehicles"][k].astype(float) / km / lanes)
            )
            ax.set_title(
                f"{name}, seed {trajectory.seed}, {(k + 1) * step / 60:.0f} min\n"
                f"{trajectory.accumulation[k + 1].sum():,.0f} inside, {trajectory.backlog[k + 1].sum():,.0f} waiting, "
                f"{trajectory.completed[k + 1]:,.0f} trips completed",
                fontsize="medium",
            )
        hand.set_xdata([(k + 1) * step / minute] * 2)

    return drawing, update


@contextmanager
def _writer(path: Path, rate: int) -> Iterator[animation.AbstractMovieWriter]:
    """matplotlib's writer for the suffix of `path`. Raises InputError."""
    if path.suffix == ".gif":
        yield animation.PillowWriter(fps=rate)
    elif path.suffix == ".mp4":
        program = ffmpeg()
        if program is None:
            raise InputError(f"--out: {path}: there is no ffmpeg for mp4; {FFMPEG_HINT}")
        with rc_context({"animation.ffmpeg_path": program}):
            yield animation.FFMpegWriter(
                fps=rate, codec="h264", bitrate=1500, metadata={"comment": trail.text(trail.of(path))}
            )
    else:
        raise InputError(f"--out: {path}: expected a name that ends in {' or '.join(SUFFIXES)}; choose another")


def ffmpeg() -> str | None:
    """The program: on PATH, or that of the package imageio-ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is None:
        with suppress(ImportError, RuntimeError):
            import imageio_ffmpeg  # of an extra: not there for everybody

            program = imageio_ffmpeg.get_ffmpeg_exe()
    return program
