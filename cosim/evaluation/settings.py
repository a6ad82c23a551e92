"""What the commands that run, watch and film a city can be told, declared; nothing here needs more than pydantic."""

from typing import Annotated

from pydantic import Field

from nmfd.runs.config import DISTINCT, Settings, setting, whole

MOST = 10**6  # runs
MOST_SEED = 2**31 - 1  # SUMO's are 32 bits long
FIRST_SEED = 2000  # these seeds are kept for evaluations: nothing was chosen, trained or identified on them
FIRST_DEVELOPMENT = 1000
Level = Annotated[float, Field(gt=0.0, le=10.0)]
Levels = Annotated[tuple[Level, ...], *DISTINCT]


class Evaluation(Settings):
    """Of controllers x seeds x demand levels."""

    seeds: int = whole(
        "runs per controller and demand level, on the same trips for all controllers", 10, low=1, high=MOST
    )
    first_seed: int = whole(
        "the seeds are S to S + N - 1; from 2000 on they were never used in development", FIRST_SEED, high=MOST_SEED
    )
    demand: Levels = setting("demand levels: multiples of the scenario's demand", (1.0,))
    workers: int | None = whole("runs at a time, each in a process of its own", None, low=1, high=MOST)


class Search(Evaluation):
    """Of the options of a controller."""

    seeds: int = whole("runs per candidate and demand level", 2, low=1, high=MOST)
    first_seed: int = whole(
        "the seeds are S to S + N - 1; those from 2000 on are for evaluations", FIRST_DEVELOPMENT, high=MOST_SEED
    )
    candidates: int = whole(
        "how many are tried, the scenario's own options first; each takes one run per seed and demand level",
        40,
        low=1,
        high=MOST,
    )
    search_seed: int = whole("of CMA-ES, and of training", 0, high=MOST_SEED)
    population: int | None = whole("candidates per generation", None, low=2, high=1000)


class Identification(Settings):
    """Of the fit of a regional model to loading runs."""

    levels: Levels = setting("the loading runs: multiples of the scenario's demand", (0.6, 0.8, 1.0))
    seeds: int = whole("loading runs per level, with seeds 1000 to 1000 + N - 1", 2, low=1, high=MOST)
    workers: int = whole("runs at a time, each in a process of its own", 2, low=1, high=MOST)
    iterations: int = whole("of the fit", 600, low=1, high=MOST)


class Window(Settings):
    """Of SUMO's window and of films."""

    demand: Level = setting("multiple of the scenario's demand", 1.0)
    delay: float = setting(
        "wall time per simulated second at least; the window has a slider for it, too", 20.0, unit="ms", ge=0.0, le=1e6
    )
    rate: int = whole("control intervals per second of the film", 8, low=1, high=60)
