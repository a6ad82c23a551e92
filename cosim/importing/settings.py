"""What the import of a city can be told in numbers, declared; nothing here needs more than pydantic."""

from nmfd.runs.config import Settings, Share, setting, whole

MOST = 10**6


class Import(Settings):
    """Of `cosim import`."""

    regions: int | None = whole("how many regions to cut the city into", None, low=2, high=MOST)
    iterations: int = whole(
        "of the assignment of a generated peak, at most; 0: everybody goes as if alone, no basis for comparisons",
        20,
        high=MOST,
    )
    gap: Share = setting("the relative gap at which the assignment ends", 0.05)
    seeds: int = whole("runs without control whose densities are averaged", 3, low=1, high=MOST)
