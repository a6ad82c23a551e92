"""The page of the live view for finished runs (cosim.view.replay): which runs, and where."""

from pathlib import Path

from cosim.evaluation.experiment import read_run
from cosim.evaluation.results import Finished
from cosim.evaluation.statistics import compared_with
from cosim.report.pictures import ranked
from cosim.report.video import choose
from cosim.view import replay
from cosim.view.picture import CityPicture, frames


def write_replay(path: Path, finished: Finished, reference: str | None = None) -> Path:
    """The best controller beside `reference`, or what it is compared with (the second best, if it is that itself), at
    the demand nearest to the scenario's own, with the first seed that both have. Raises InputError."""
    level = finished.level(None)
    best, *others = ranked(level.rows)
    other: str | None = reference or compared_with(level.rows)
    if other == best:
        other = others[0] if others else None
    names, seed = choose(finished, level, best, other, None)
    picture, runs = CityPicture.of(finished.scenario, finished.map()), {}
    for name in names:
        result = read_run(level.folder, name, seed)
        runs[name] = frames(picture, result.trajectory, result.record)
    return replay.write(path, picture, runs, f"{finished.name}: demand times {level.demand:g}, seed {seed}")
