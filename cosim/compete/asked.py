"""What a command of a trail (nmfd.runs.trail) asked for: the runs of cosim evaluate."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Self

from cosim.evaluation import results
from cosim.evaluation.settings import Evaluation
from cosim.evaluation.simulate import Task
from nmfd import __version__
from nmfd.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Asked:
    """By a command, cosim evaluate: of these controllers, or patterns, seeds and demand levels; scenario: its folder;
    policies: controller -> file; session: what is known of when the command was called."""

    scenario: Path
    controllers: tuple[str, ...]
    seeds: range
    levels: tuple[float, ...]
    steps: int | None
    time_limit: float | None
    policies: Mapping[str, Path]
    session: Mapping

    @classmethod
    def by(cls, command: str, session: Mapping, file: Path, scenario: Path | None = None) -> Self | None:
        """None for another command. scenario: where it is now, if not where the command says. InputError for one that
        is not there."""
        words = [
            part for word in shlex.split(command) for part in (word.split("=", 1) if word.startswith("--") else [word])
        ]
        if words[:2] != ["cosim", "evaluate"]:
            return None
        at = next((n for n in range(2, len(words), 2) if not words[n].startswith("--")), 2)  # options may come first
        rest = [*words[2:at], *words[at + 1 :]]
        given = list(zip(rest[::2], rest[1::2], strict=False))
        options, usual, where = dict(given), Evaluation(), f"{file.name}: {command}"
        if scenario is None:
            scenario = results.found_again(Path(words[at]), file.parent, where) if at < len(words) else Path()
        try:
            first = int(options.get("--first-seed", usual.first_seed))
            return cls(
                scenario=scenario,
                controllers=tuple(options["--controllers"].split(",")),
                seeds=range(first, first + int(options.get("--seeds", usual.seeds))),
                levels=tuple(map(float, options["--demand"].split(","))) if "--demand" in options else usual.demand,
                steps=int(options["--steps"]) if "--steps" in options else None,
                time_limit=float(options["--time-limit"]) if "--time-limit" in options else None,
                policies={
                    value.partition("=")[0]: Path(value.partition("=")[2])
                    for option, value in given
                    if option == "--policy"
                },
                session=session,
            )
        except (ValueError, LookupError):
            raise InputError(
                f"{file}: {command}: is no command of version {__version__}; verify it with the version that made it"
            ) from None

    def covers(self, row: Mapping) -> bool:
        """Whether it asked for a row of runs.csv."""
        return (
            row["seed"] in self.seeds
            and row["demand"] in self.levels
            and any(fnmatchcase(row["controller"], pattern) for pattern in self.controllers)
        )

    def task(self, controller: str, seed: int, demand: float) -> Task:
        """To be run again."""
        return Task(
            scenario=self.scenario,
            controller=controller,
            seed=seed,
            policy=self.policies.get(controller),
            steps=self.steps,
            demand_factor=demand,
            time_limit=self.time_limit,
        )
