"""What the commands of the studies can be told, declared; nothing here needs more than pydantic."""

from typing import Annotated, Literal

from pydantic import Field

from nmfd.runs.config import DISTINCT, Settings, setting, whole

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


class Bound(Settings):
    """Of the best plan for demand that is known."""

    iterations: int = whole("Adam steps", 1500, low=1, high=MOST)
