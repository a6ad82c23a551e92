"""The table [sumo] of network.toml, and the recipe of a city (city.toml) that it may name, declared."""

from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from nmfd.runs.config import Numbers, Problem, Region, Settings, Text, got, setting, whole


class CityTable(Settings):
    """The city to simulate: a recipe, or SUMO's network and the region of every edge of it."""

    recipe: Text | None = setting("file from which the city is built, relative to the network's folder", None)
    net: Text | None = setting("instead: SUMO's network", None)
    regions: Text | None = setting("with net: csv with the columns edge, region", None)

    @model_validator(mode="after")
    def _one_or_the_other(self) -> Self:
        given = self.model_fields_set
        if self.recipe is not None and len(given) > 1:
            raise Problem("recipe", "a city has a recipe, or net and regions; remove one of them")
        for key in ("net", "regions"):
            if self.recipe is None and key not in given:
                raise Problem(key, f'missing; add {key} = "...", or recipe = "city.toml"')
        return self


def _apart(lines: tuple[float, ...]) -> tuple[float, ...]:
    if any(b - a < 60 for a, b in zip(lines, lines[1:], strict=False)):
        raise Problem("", got("rising numbers at least 60 m apart", list(lines)))
    return lines


Lines = Annotated[Numbers, Field(min_length=3, max_length=10), AfterValidator(_apart)]


class Streets(Settings):
    """Lines on which junctions and the streets between them are."""

    x: Lines = setting("streets that run north-south; rising, at least 60 m apart", unit="m")
    y: Lines = setting("streets that run east-west; rising, at least 60 m apart", unit="m")
    speed: float = setting("speed limit", unit="m/s", gt=0.0)


class CentreTable(Streets):
    """The fine grid in the middle: one lane in each direction."""

    region: Region = setting("region of the centre")
    pocket: float = setting("length of the second lane before a signal", unit="m", ge=10.0)


class OuterTable(Streets):
    """The lattice of arterials around it: three lanes in each direction."""

    regions: str = setting("region of every junction in lines, north at the top; a dot where the centre is")

    @property
    def picture(self) -> list[list[str]]:
        """The words of every line that is not empty."""
        return [line.split() for line in self.regions.splitlines() if line.strip()]

    @model_validator(mode="after")
    def _fits_the_lines(self) -> Self:
        if [len(row) for row in self.picture] != [len(self.x)] * len(self.y):
            raise Problem("regions", f"expected {len(self.y)} rows of {len(self.x)} regions or dots; correct it")
        return self


class SignalsTable(Settings):
    """The fixed-time signals."""

    cycle: int = whole("cycle time", low=30, unit="s")
    yellow: int = whole("yellow", low=1, unit="s")
    all_red: int = whole("between two phases", unit="s")
    left_green: int = whole("of the protected left turn after the permissive one", low=1, unit="s")


class RecipeTable(Settings):
    """A city with a fine grid in a wide lattice of arterials."""

    centre: CentreTable = setting("the fine grid")
    outer: OuterTable = setting("the lattice")
    signals: SignalsTable = setting("of all junctions")
