"""network.toml, declared: what its tables and keys mean, what they may be, and how they must fit together."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from nmfd.model.disturbance import Disturbance
from nmfd.model.mfd import Mfd
from nmfd.runs import config
from nmfd.runs.config import Problem, Regions, Rows, Settings, Share, got, setting

MOST = 1e9  # veh in a region: beyond, it is a mistake
OF_ALL = ("exit_rates", "capacity", "storage", "controllable")  # options that every region has or none


class PerimeterTable(Settings):
    """Bounds of the perimeter control at every boundary."""

    min: Share = setting("least control")
    max: Share = setting("largest control, more than min")

    @model_validator(mode="after")
    def _ordered(self) -> "PerimeterTable":
        if self.min >= self.max:
            raise Problem("", f"min must be less than max, got min = {self.min:g} and max = {self.max:g}")
        return self


class MfdTable(Settings):
    """An outflow MFD: a n^3 + b n^2 + c n [veh/s] leave a region that holds n [veh]."""

    a: float = setting("cubic coefficient", unit="veh^-2 s^-1")
    b: float = setting("quadratic coefficient", unit="veh^-1 s^-1")
    c: float = setting("linear coefficient, positive", unit="s^-1")
    jam: float = setting("accumulation beyond which the outflow stays what it is there", unit="veh", gt=0.0, le=MOST)

    @model_validator(mode="after")
    def _is_one(self) -> "MfdTable":
        if problem := self.mfd.problem():
            raise Problem("c" if self.c <= 0 else "jam", problem)
        return self

    @property
    def mfd(self) -> Mfd:
        """The curve."""
        return Mfd(**vars(self))


class RegionTable(Settings):
    """A region; regions are numbered from 0 in the order of the file."""

    name: config.Name | None = setting("of the region; without one, its number", None)
    position: Annotated[tuple[float, float], Field(strict=False)] = setting("where it is drawn on the map, in any unit")
    adjacent: Regions = setting("regions that share a boundary with it; each of them lists it, too")
    no_way_to: Regions = setting("adjacent regions into which no road leads from here", ())
    mfd: MfdTable | None = setting("its own MFD instead of that of [mfd]", None)
    exit_rates: config.PositiveNumbers | None = setting(
        "how fast vehicles leave it, relative to the mean of the MFD, per region that they are bound for; for every "
        "region or for none",
        None,
        unit="-",
    )
    capacity: config.PositiveNumbers | None = setting(
        "the most that passes under the largest control into each adjacent region while that is empty, in the order of "
        "adjacent, without those of no_way_to; together with storage, for every region or for none",
        None,
        unit="veh/s",
    )
    storage: float | None = setting(
        "accumulation that leaves no room for vehicles from other regions; together with capacity",
        None,
        unit="veh",
        gt=0.0,
        le=MOST,
    )
    controllable: Annotated[tuple[Share, ...], Field(strict=False)] | None = setting(
        "share of the flow into each adjacent region that passes signals under control, in the order of adjacent, "
        "without those of no_way_to; cosim import and identify count it; for every region or for none",
        None,
        unit="-",
    )
    doubts: config.Texts = setting("what cosim identify found doubtful about the fit of this region", ())

    @model_validator(mode="after")
    def _complete(self) -> "RegionTable":
        if unknown := sorted(set(self.no_way_to) - set(self.adjacent)):
            raise Problem("no_way_to", got(f"some of the adjacent regions {list(self.adjacent)}", unknown[0]))
        for key, other in (("storage", "capacity"), ("capacity", "storage")):
            if getattr(self, key) is not None and getattr(self, other) is None:
                raise Problem(key, f"needs {other} beside it: both limit what passes a boundary; add or remove one")
        return self

    @property
    def onward(self) -> tuple[int, ...]:
        """The regions into which roads lead from here."""
        return tuple(h for h in self.adjacent if h not in self.no_way_to)


class SplitsTable(Settings):
    """Where drivers in a region go next on their way to another, where it was measured; elsewhere they cross the
    fewest boundaries."""

    region: config.Region = setting("where they are")
    destination: config.Region = setting("where they are bound for")
    next: Regions = setting("the adjacent regions that they go to next", min_length=1)
    share: Annotated[config.Numbers, Field(min_length=1)] = setting("of the drivers, for each of next; sum 1", unit="-")


class DisturbanceTable(Settings):
    """How what the model got wrong lately says what it will get wrong next (nmfd.model.disturbance)."""

    gain: float = setting("how much of it is believed", unit="-", ge=0.0, le=2.0)
    memory: Share = setting("weight of an interval beside that of the next one")
    fade_critical: float = setting(
        "logit of how much of it is left after an interval, in a region at its critical accumulation", unit="-"
    )
    fade_slope: float = setting("how much that rises per critical accumulation", unit="-")

    @property
    def law(self) -> Disturbance:
        """The numbers."""
        return Disturbance(**vars(self))


class NetworkTable(Settings):
    """The regional model of a city."""

    name: config.Name = setting("of the model")
    placeholder: bool = setting(
        "whether the MFDs are a guess from lanes and speed limits: nothing is trained on them", False
    )
    perimeter: PerimeterTable = setting("bounds of the control")
    mfd: MfdTable | None = setting("of every region without one of its own", None)
    regions: Rows[RegionTable] = setting("one table per region", min_length=1)
    observed_split_ratios: Rows[SplitsTable] = setting("one table per region and destination", ())
    disturbance: DisturbanceTable | None = setting(
        "for predictions that are offset-free; cosim identify finds it", None
    )
    sumo: dict[str, Any] = setting("the city to simulate, for cosim", {})

    def mfd_of(self, row: RegionTable) -> Mfd:
        """The curve of a region."""
        table = row.mfd or self.mfd
        assert table is not None  # `_check_region`
        return table.mfd

    @model_validator(mode="after")
    def _fits_together(self) -> "NetworkTable":
        most = len(self.regions) - 1
        for number, row in enumerate(self.regions):
            if max(row.adjacent, default=0) > most:
                raise Problem(
                    f"regions[{number}].adjacent",
                    got(f"a list of distinct whole numbers from 0 to {most}", list(row.adjacent)),
                )
        for number, row in enumerate(self.regions):
            self._check_region(number, row)
        for number, splits in enumerate(self.observed_split_ratios):
            self._check_splits(f"observed_split_ratios[{number}]", splits)
        return self

    def _check_region(self, i: int, row: RegionTable) -> None:
        count, where = len(self.regions), f"regions[{i}]"
        if i in row.adjacent:
            raise Problem(f"{where}.adjacent", f"region {i} is listed as adjacent to itself; remove it")
        for h in row.adjacent:
            if i not in self.regions[h].adjacent:
                raise Problem(
                    f"{where}.adjacent",
                    f"not symmetric: region {i} lists {h}, but region {h} does not list {i}; add or remove one of them "
                    "(no_way_to lists the adjacent regions into which no road leads)",
                )
        if row.mfd is None and self.mfd is None:
            raise Problem(f"{where}.mfd", "missing; add a table [regions.mfd], or [mfd] for all regions")
        for key in OF_ALL:
            if getattr(row, key) is None and any(getattr(other, key) is not None for other in self.regions):
                raise Problem(f"{where}.{key}", "missing; give it for every region or for none")
        for key, length in (("exit_rates", count), ("capacity", len(row.onward)), ("controllable", len(row.onward))):
            values = getattr(row, key)
            if values is not None and len(values) != length:
                raise Problem(f"{where}.{key}", got(f"a list of {length} numbers", list(values)))

    def _check_splits(self, where: str, splits: SplitsTable) -> None:
        for key, region in (("region", splits.region), ("destination", splits.destination)):
            if region >= len(self.regions):
                raise Problem(f"{where}.{key}", got(f"a whole number from 0 to {len(self.regions) - 1}", region))
        onward, share = self.regions[splits.region].onward, splits.share
        if not set(splits.next) <= set(onward):
            raise Problem(f"{where}.next", got(f"some of the adjacent regions {list(onward)}", list(splits.next)))
        if len(share) != len(splits.next) or min(share) < 0 or abs(sum(share) - 1.0) > 1e-3:
            raise Problem(f"{where}.share", got(f"{len(splits.next)} numbers >= 0 with sum 1", list(share)))
