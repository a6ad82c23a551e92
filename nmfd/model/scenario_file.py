"""scenario.toml, declared: what its tables and keys mean and may be; and scenarios that are based on another one."""

from pathlib import Path
from typing import Any, Literal

from pydantic import model_validator

from nmfd.runs import config, files, shipped
from nmfd.runs.config import Flow, Name, Problem, Region, Regions, Rows, Seconds, Settings, Text, Texts, setting, whole

MOST_NUMBERS = 2 * 10**8  # of a demand table: more would not fit into memory
LONGEST_STEP = 86_400.0  # s
OWN_TIME_LIMIT = 600.0  # s


class NoiseTable(Settings):
    """What a controller sees of the plant's state."""

    measurement_std: float = setting(
        "standard deviation of the Gaussian noise on every accumulation that a controller sees",
        0.0,
        unit="veh",
        ge=0.0,
        le=1e6,
    )


class ForecastTable(Settings):
    """What controllers that look ahead know of the demand."""

    error: float = setting("standard deviation of the logarithm of forecast over demand", 0.0, unit="-", ge=0.0, le=2.0)
    seed: int = whole("of the error", 0)


class DemandTable(Settings):
    """One flow, a trapezoid over time; flows of the same pair of regions add up."""

    origin: Region = setting("region in which the vehicles start", alias="from")
    to: Region = setting("region that they are bound for")
    start: Seconds = setting("when the flow begins")
    peak: Flow = setting("largest flow")
    ramp_up: Seconds = setting("time in which it rises to the peak")
    flat: Seconds = setting("time that it stays there")
    ramp_down: Seconds = setting("time in which it falls to 0")
    both_ways: bool = setting("the same flow the other way, too", False)


class InitialTable(Settings):
    """Vehicles that are inside when the run begins, in the regional model; a city in SUMO begins empty."""

    region: Region = setting("region that they are in")
    to: Region = setting("region that they are bound for")
    vehicles: float = setting("how many; tables of the same pair of regions add up", unit="veh", ge=0.0, le=1e9)


class PlanningOptions(Settings):
    """Of every controller, beside its own options."""

    model: Text | None = setting(
        "folder of the regional model that it plans with, or the name of a network that comes with the package; "
        "without it, that of the scenario's network or, of controllers that guide routes, the one in the folder guided "
        "of that network",
        None,
    )


class ScenarioTable(Settings):
    """What happens: a network, its demand, the noise, for how long."""

    name: Name = setting("of the scenario")
    base: Text | None = setting(
        "folder of another scenario that says what this one does not, or the name of one that comes with the package; "
        "tables are completed key by key",
        None,
    )
    network: Text = setting("folder of the network, or the name of one that comes with the package")
    step: float = setting("control interval", unit="s", gt=0.0, le=LONGEST_STEP)
    steps: int = whole("control intervals", low=1, high=MOST_NUMBERS)
    integrator: Literal["euler", "rk4"] = setting("of the regional model", "euler")
    substeps: int = whole("integration steps of the regional model per control interval", 1, low=1, high=1000)
    protected: Regions = setting("regions that gating protects", ())
    demand_factor: float = setting("multiplies the whole demand", 1.0, unit="-", ge=0.0, le=1000.0)
    demand_file: Text | None = setting("csv with the columns interval, from, to, veh_s, added to [[demand]]", None)
    faults: Texts = setting("injected into every run: KIND[:VALUE][@FROM-TO], as of --fault", ())
    own_time_limit: float = setting(
        "of every call of a controller of your own: its import, making, reset and every act; 0: none; --time-limit "
        "goes before it",
        OWN_TIME_LIMIT,
        unit="s",
        ge=0.0,
    )
    noise: NoiseTable = setting("of the measurements", NoiseTable())
    forecast: ForecastTable = setting("of the demand", ForecastTable())
    demand: Rows[DemandTable] | None = setting("one table per flow; may be left out beside demand_file", None)
    initial: Rows[InitialTable] = setting("one table per pair of regions; without any, the city begins empty", ())
    controllers: dict[str, dict[str, Any]] = setting("options of controllers", {})
    sumo: dict[str, Any] = setting("how the city is simulated, for cosim", {})

    @model_validator(mode="after")
    def _has_demand(self) -> "ScenarioTable":
        if self.demand is None and self.demand_file is None:
            raise Problem("demand", "missing; add a list of tables [[demand]], or demand_file")
        return self


def read_tables(folder: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """`folder`/scenario.toml; what it does not say is that of the scenario in the folder `base`, if it names one.

    Tables are completed key by key, everything else is taken whole. Raises InputError.

    above: the folders of the scenarios that are based on this one
    """
    file, folders = folder / "scenario.toml", (*above, folder)
    own = config.read(file)
    base = own.pop("base", None)
    _name_from(own, folder, folders[0])
    if folder.resolve() in (other.resolve() for other in above):
        raise config.error(file, "base", "the scenarios are each other's base; remove one of the keys")
    if base is None:
        return own
    if not isinstance(base, str) or not base.isprintable():
        raise config.error(file, "base", config.got("the folder of a scenario in quotes", base))
    return _completed(own, read_tables(shipped.found(base, shipped.SCENARIO, beside=folder), folders))


def _name_from(own: dict, folder: Path, here: Path) -> None:
    """Files that a scenario.toml names are relative to it, or come with the package: rewrite them as seen from the
    folder `here`."""

    def seen(name: str, *kinds: str) -> str:
        return files.relative(shipped.found(name, *kinds, beside=folder), here)

    for key, kinds in (("network", (shipped.NETWORK,)), ("demand_file", ())):
        if isinstance(own.get(key), str):
            own[key] = seen(own[key], *kinds)
    sumo = own.get("sumo")
    if isinstance(sumo, dict):
        for key in ("routes", "background", "additional"):
            if isinstance(sumo.get(key), list) and all(isinstance(name, str) for name in sumo[key]):
                sumo[key] = [seen(name) for name in sumo[key]]
    controllers = own.get("controllers")
    for options in controllers.values() if isinstance(controllers, dict) else ():
        if isinstance(options, dict) and isinstance(options.get("model"), str):
            options["model"] = seen(options["model"], shipped.NETWORK)


def _completed(content: dict, base: dict) -> dict:
    """`content` with what only `base` has, in the tables of both too."""
    both = {
        key: _completed(content[key], base[key])
        for key in content
        if isinstance(content[key], dict) and isinstance(base.get(key), dict)
    }
    return {**base, **content, **both}
