"""Two runs of a folder side by side, as the live view shows them (cosim.view.replay): which ones."""

from dataclasses import dataclass, replace

from cosim.evaluation.experiment import read_run
from cosim.evaluation.results import Finished
from cosim.evaluation.statistics import compared_with
from cosim.report.pictures import ranked
from cosim.report.video import choose
from cosim.view import replay
from cosim.view.picture import CityPicture, frames


@dataclass(frozen=True, kw_only=True)
class Shown:
    """names: of one or two runs, the one that the other is compared with first; seed; replay: of the page."""

    names: tuple[str, ...]
    seed: int
    replay: replay.Replay


def chosen(finished: Finished, reference: str | None = None, seed: int | None = None) -> Shown:
    """The best controller beside `reference`, or what it is compared with (the second best, if it is that itself), at
    the demand nearest to the scenario's own, with this seed or the first that both have. Raises InputError."""
    level = finished.level(None)
    best, *others = ranked(level.rows)
    other: str | None = reference or compared_with(level.rows)
    if other == best:
        other = others[0] if others else None
    names, seed = choose(finished, level, best, other, seed)
    picture, runs = CityPicture.of(finished.scenario, finished.map()), {}
    for name in reversed(names):
        result = read_run(level.folder, name, seed)
        runs[name] = frames(picture, result.trajectory, result.record)
    picture = replace(picture, steps=max(map(len, runs.values())) - 1)
    return Shown(names=tuple(runs), seed=seed, replay=replay.embedded(picture, runs))
