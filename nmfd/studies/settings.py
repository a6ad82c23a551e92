"""What the commands of the studies can be told, declared; nothing here needs more than pydantic."""

from typing import Annotated, Literal

from pydantic import Field

from nmfd.runs.config import DISTINCT, Settings, Text, setting, whole

MOST = 10**6  # runs


class Study(Settings):
    """Of many closed loops."""

    seeds: int = whole("run seeds 0 to N - 1 of the measurement noise", 1, low=1, high=MOST)
    plant: Literal["nmfd", "acyclic"] = setting("the model that the controllers act on", "nmfd")
    workers: int = whole("runs at a time, each on one core; timings are cleanest with 1", 1, low=1, high=MOST)


class Robustness(Study):
    """Of controllers against perturbed demand."""

    sigmas: Annotated[tuple[Annotated[float, Field(ge=0.0)], ...], *DISTINCT] = setting(
        "standard deviations of the noise", (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0), unit="veh/s"
    )
    scenarios: int = whole("draws of the noise for every sigma", 20, low=1, high=MOST)
    where: Literal["planned", "pairs", "all"] = setting(
        "what is perturbed: planned demand while it lasts, its pairs of regions all the time, or all pairs; clipping "
        "at zero makes the last two add many trips",
        "pairs",
    )
    plant: Literal["nmfd", "acyclic"] = setting("the model that the controllers act on", "acyclic")


class Adaptation(Study):
    """Of controllers where demand or capacity is not what they were made for."""

    cases: Annotated[tuple[Text, ...], Field(strict=False)] = setting(
        "what comes differently: more demand, more from one origin, all of it later, capacity minus 20 %",
        ("nominal", "more", "one-origin", "later", "rain"),
    )


class Ablation(Study):
    """Of one thing varied."""

    seeds: int = whole("training: seeds 0 to N - 1 with each method", 3, low=1, high=MOST)
    horizons: Annotated[tuple[Annotated[int, Field(ge=2, le=MOST)], ...], *DISTINCT] = setting(
        "horizon: control intervals that MPC looks ahead", (2, 3, 4, 6, 8, 10, 12, 16, 20, 25, 30)
    )
    plant: Literal["nmfd", "acyclic"] = setting("the model that MPC and the trained policies act on", "acyclic")


class Scaling(Study):
    """Of the time of a decision against the number of regions."""

    regions: Annotated[tuple[Annotated[int, Field(ge=2, le=MOST)], ...], *DISTINCT] = setting("numbers of regions", ())
    family: Literal["complete", "hexagonal"] = setting(
        "every region adjacent to every other, as published, or a plane city", "complete"
    )
    load: Literal["published", "congested"] = setting(
        "initial states: 0 to 100 vehicles bound for every region, or regions up to beyond their jam", "published"
    )
    workers: int = whole(
        "cases at a time, each in a process on one core; timings are cleanest with 1", 1, low=1, high=MOST
    )
    memory: float = setting("that a case may take", 16.0, unit="GiB", gt=0.0, le=1e6)
    time_limit: float = setting("that a case may take", 600.0, unit="s", gt=0.0, le=1e6)


class Measured(Settings):
    """Of MFDs from real detectors."""

    vehicle_length: float = setting(
        "of a vehicle and a loop together: the density is the occupancy over it", 6.5, unit="m", gt=1.0, le=50.0
    )
    trip_length: float | None = setting(
        "mean length of trips within a region: the outflow is the production over it", None, unit="m", ge=10.0, le=1e5
    )
    least_share: float = setting(
        "of a region's detectors, by lane-kilometres, that must report for an interval to count",
        0.5,
        unit="-",
        ge=0.0,
        le=1.0,
    )


class Value(Settings):
    """Of MPC's terminal cost."""

    seed: int = whole("of what is drawn", 0, high=2**31 - 1)
    samples: int = whole("states per round, from each of which the policy is rolled out", 12_000, low=1, high=MOST)
    rounds: int = whole("from the second on MPC has driven with what was learned before", 2, low=1, high=100)
    steps: int = whole("Adam steps per round", 4000, low=1, high=MOST)


class Bound(Settings):
    """Of the best plan for demand that is known."""

    iterations: int = whole("Adam steps", 1500, low=1, high=MOST)
