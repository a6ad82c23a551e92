"""Two runs of a folder side by side, as the live view shows them (cosim.view.replay): which ones."""

from dataclasses import dataclass, replace

from cosim.evaluation.experiment import read_run
from cosim.evaluation.results import Finished, Level
from cosim.evaluation.statistics import compared_with
from cosim.report import pictures
from cosim.report.pictures import ranked
from cosim.view import replay
from cosim.view.picture import CityPicture, frames
from nmfd.errors import InputError, did_you_mean


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
        runs[name] = frames(picture, result)
    picture = replace(picture, steps=max(map(len, runs.values())) - 1)
    return Shown(names=tuple(runs), seed=seed, replay=replay.embedded(picture, runs))


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
