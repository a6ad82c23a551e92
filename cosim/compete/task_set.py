"""Task sets: what controllers are compared on, in TOML; and which of them were released, and as what.

<set>.toml       a `TaskSet`; those that come with the package lie beside this file
released.toml    of every released set a fingerprint of what stands in its file, and one of the world of every task;
                 .ci/release.py writes it. A released set is refused if either is not the same any more
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cosim.evaluation.settings import MOST_SEED, Level
from cosim.plant.settings import FILES, FIXED, Signals, settings
from cosim.sumo.build import sources
from nmfd.api import load_scenario
from nmfd.errors import InputError, did_you_mean
from nmfd.model.scenario import Scenario, with_demand, with_time_limit
from nmfd.runs import config, shipped
from nmfd.runs.config import DISTINCT, Name, Problem, Rows, Settings, Text, setting, whole
from nmfd.runs.files import file_name
from nmfd.studies.benchmark import Noise, happening

HERE = Path(__file__).parent
RELEASED = HERE / "released.toml"
SUMO = "sumo"


def _plain_name(name: str) -> str:
    if file_name(name) != name or name.startswith("."):
        raise ValueError("not a file name")
    return name


Id = Annotated[Name, AfterValidator(_plain_name)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]


class TaskTable(Settings):
    """A scenario, how much of it, on which plant."""

    id: Id = setting("short name of letters, digits, - _ and .")
    text: Text = setting("what it asks of controllers")
    scenario: Text = setting("name of one that comes with the package, or folder")
    plant: Literal["nmfd", "acyclic", "sumo"] = setting("what is driven: a regional model, or the city in SUMO")
    demand: Level = setting("multiple of the scenario's demand", 1.0)
    noise: float = setting(
        "standard deviation of Gaussian noise on the demand, drawn from the seed, of which controllers know nothing; "
        "on regional models",
        0.0,
        unit="veh/s",
        ge=0.0,
        le=1e6,
    )
    noise_where: Literal["planned", "pairs", "all"] = setting("what the noise is on, as of nmfd robustness", "pairs")
    signals: Signals = setting(
        "control of the signals that is part of the plant: it takes the place of what a controller brings along; "
        "with fixed ones controllers may bring their own",
        FIXED,
    )
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1), *DISTINCT] = setting("of the runs")
    time_limit: float = setting(
        "of every decision; a run with a later one does not count, and of a controller of one's own it is ended, in "
        "its import, making and reset, too",
        unit="s",
        gt=0.0,
        le=3600.0,
    )
    steps: int | None = whole("control intervals; without it, the scenario's", None, low=1)

    @model_validator(mode="after")
    def _fits_the_plant(self) -> Self:
        if self.plant == SUMO and self.noise:
            raise Problem("noise", "is for regional models, but the plant is sumo; omit it")
        if self.plant != SUMO and self.signals != FIXED:
            raise Problem("signals", f"is for SUMO, but the plant is {self.plant}; omit it")
        return self


class TaskSet(Settings):
    """Tasks that every controller is given. A released set never changes: a new one gets a new number."""

    name: Id = setting("of the set")
    text: Text = setting("what it is for")
    tasks: Annotated[Rows[TaskTable], Field(min_length=1)] = setting("of the set")

    @model_validator(mode="after")
    def _tells_tasks_apart(self) -> Self:
        names = [task.id.casefold() for task in self.tasks]
        for number, name in enumerate(names):
            if name in names[:number]:
                raise Problem(f"tasks[{number}].id", f"{self.tasks[number].id} is there twice; give every task its own")
        return self


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """A task set that was read. named: as --tasks has it; file: where; hash: of what stands there; worlds: task ->
    `world` at the release, of a released one, None of another."""

    tasks: TaskSet
    named: str
    file: Path
    hash: str
    worlds: Mapping[str, str] | None

    def scenario(self, task: TaskTable) -> Scenario:
        """What controllers are made for. InputError."""
        loaded = with_time_limit(load_scenario(self.folder(task)), task.time_limit)
        return with_demand(loaded, steps=task.steps, factor=task.demand)

    def folder(self, task: TaskTable) -> Path:
        """That of its scenario: beside the file of the set, or of the package; never where somebody happens to be.
        InputError."""
        folder = shipped.found(task.scenario, shipped.SCENARIO, beside=self.file.parent)
        if not (folder / "scenario.toml").is_file():
            raise InputError(
                f"{self.file}: {task.id}: scenario: there is no {folder / 'scenario.toml'}, and no scenario "
                f"{task.scenario!r} comes with the package; `cosim list scenarios` shows those that do"
            )
        return folder

    def check_world(self, task: TaskTable, now: str) -> None:
        """InputError where the `world` of a task is not that of the release."""
        if self.worlds is not None and self.worlds.get(task.id) != now:
            raise InputError(
                f"{self.file}: {task.id}: its scenario or network has changed since {self.tasks.name} was released "
                f"({now} instead of {self.worlds.get(task.id)}); take the version of the release, or make a new set"
            )


def names() -> list[str]:
    """The task sets that come with the package."""
    return sorted(file.stem for file in HERE.glob("*.toml") if file != RELEASED)


def read(name: str) -> Loaded:
    """The task set `name`: one of `names`, or a TOML file. InputError, also for a released one that has changed."""
    ours = name in names()
    file = HERE / f"{name}.toml" if ours else Path(name)
    if not ours and not file.is_file():
        raise InputError(
            f"{name}: no such file, and no task set of that name comes with the package{did_you_mean(name, names())}; "
            f"choose from {', '.join(names())}"
        )
    content = config.read(file)
    found, now = config.checked(TaskSet, content, file), fingerprint(content)
    release = config.read(RELEASED).get(name) if ours else None
    if release is not None and release["hash"] != now:
        raise InputError(
            f"{file}: is not the task set {name} that was released ({now} instead of {release['hash']}); restore it, "
            "and give what is to be different a new number"
        )
    return Loaded(tasks=found, named=name, file=file, hash=now, worlds=None if release is None else release["worlds"])


def fingerprint(content: object) -> str:
    """Of JSON types, whatever the order of keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def world(task: TaskTable, scenario: Scenario) -> str:
    """A fingerprint of all that happens in a task, whatever controllers are given. Of a city in SUMO it holds of the
    regional model only what the plant takes of it."""
    if task.plant != SUMO:
        seeds = task.seeds if task.noise else task.seeds[:1]
        happens = [replace(happening(scenario, noise_of(task), seed), controller_options={}) for seed in seeds]
        return fingerprint([replace(one, demand=one.demand.round(9)).hash for one in happens])
    network = scenario.network
    chosen = settings(scenario).model_dump(mode="json", exclude_defaults=True)
    files = [scenario.folder / name for key in FILES for name in chosen.pop(key, ())] if scenario.folder else []
    return fingerprint(
        [
            scenario.name,
            scenario.step,
            scenario.steps,
            scenario.measurement_std,
            scenario.faults,
            network.u_min,
            network.u_max,
            network.adjacency.tolist(),
            chosen,
            [_content(file) for file in (*files, *sources(network))],
            hashlib.sha256(scenario.demand.round(9).tobytes()).hexdigest(),
        ]
    )


def noise_of(task: TaskTable) -> Noise | None:
    """On the demand."""
    return Noise(task.noise, task.noise_where) if task.noise else None


def _content(file: Path) -> str:
    """A fingerprint of a file, the same where a checkout has other ends of lines."""
    return hashlib.sha256(file.read_bytes().replace(b"\r\n", b"\n")).hexdigest()
