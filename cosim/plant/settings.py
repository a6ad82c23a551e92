"""The table [sumo] of scenario.toml: how the city is simulated, actuated and measured."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self, get_args

from pydantic import model_validator

from nmfd.runs import config
from nmfd.runs.config import Problem, Seconds, Share, Texts, setting

if TYPE_CHECKING:  # at run time it would bring numpy, and the help of an option waits for this module
    from nmfd.model.scenario import Scenario

Signals = Literal["fixed", "webster", "actuated", "max-pressure", "max-pressure-cyclic"]
Mode = Literal["hold-back", "redistribute"]
SIGNALS, MODES = get_args(Signals), get_args(Mode)
FIXED, WEBSTER, ACTUATED, MAX_PRESSURE, CYCLIC = SIGNALS
PRESSURES = (MAX_PRESSURE, CYCLIC)
HOLD_BACK, REDISTRIBUTE = MODES
EXACT, ESTIMATE = "exact", "estimate"
FILES = ("routes", "background", "additional")


class SumoTable(config.Settings):
    """How the city is simulated, actuated and measured. Files are relative to the scenario's folder."""

    step_length: float = setting("time step of SUMO, a divisor of the control interval", 1.0, unit="s", gt=0.0, le=1.0)
    time_to_teleport: float = setting(
        "standing time after which SUMO moves a vehicle on; -1 for never", -1.0, unit="s", ge=-1.0
    )
    collision_action: Literal["none", "warn", "teleport", "remove"] = setting("of SUMO", "warn")
    actuation: Mode = setting(
        "whether green that the perimeter control takes away is red for all, or goes to the other movements", HOLD_BACK
    )
    min_green: float = setting(
        "least green of a gateway movement, and of every stage under max-pressure", 5.0, unit="s", ge=1.0
    )
    max_green: float = setting(
        "under max-pressure, no stage is green for longer while others wait; 50 s is netconvert's for actuated signals",
        50.0,
        unit="s",
        ge=1.0,
    )
    queue_override: Share = setting(
        "a gateway whose edge held this share of its room in the last control interval is left open; 0 for never", 0.0
    )
    compliance: Share = setting("share of the decisions in which a driver follows the route guidance", 1.0)
    guidance_period: Seconds = setting(
        "guided drivers are asked again after this time in the same region; 0: when they depart and when they enter a "
        "region only",
        0.0,
    )
    most_detour: Seconds = setting("drivers do not follow route guidance into a next region that costs them more", 60.0)
    ways_return: bool = setting(
        "guided drivers may leave a region and come back to it where that is the fastest way of all, as on a main road "
        "along a ragged boundary",
        False,
    )
    rerouting: Share = setting("share of the drivers with SUMO's own rerouting device", 0.0)
    metering: bool = setting(
        "trips begin in a region no faster than is commanded; without a command, its accumulation is held", False
    )
    metering_level: float = setting(
        "the accumulation that metering holds a region at without a command, in critical accumulations",
        1.2,
        unit="-",
        gt=0.0,
        le=10.0,
    )
    measurement: Literal["exact", "estimate"] = setting(
        "what controllers see: the exact state, or what detectors and probes tell", EXACT
    )
    detector_share: Share = setting("share of the links with loop detectors", 0.3)
    probe_share: Share = setting("share of the vehicles that tell where they are bound for", 0.1)
    signals: Signals = setting("control of the signals", FIXED)
    routes: Texts = setting(
        "route files of the city's own vehicles; without any, trips are drawn from the scenario's demand", ()
    )
    background: Texts = setting("route files of what is no demand and is left alone: public transport, persons", ())
    additional: Texts = setting("SUMO's additional files: vehicle types, stops, signal programmes", ())
    begin: Seconds = setting("simulation time at which interval 0 begins", 0.0)
    departure_jitter: Seconds = setting(
        "departures of the city's own vehicles are moved by up to this, either way, by the seed", 10.0
    )
    leave_signals: Texts = setting("signals that perimeter control leaves alone", ())
    mesoscopic: bool = setting(
        "SUMO's queue model instead of its car-following, about ten times as fast, for quick studies: no lanes and no "
        "positions on them, queues hold the vehicles that fit on an edge, signals cap the flow by their green share",
        False,
    )

    @model_validator(mode="after")
    def _is_measured(self) -> Self:
        if self.measurement == ESTIMATE and self.detector_share == self.probe_share == 0:
            raise Problem(
                "measurement",
                '"estimate" needs detectors or probes, but sumo.detector_share and '
                "sumo.probe_share are both 0; raise one of them",
            )
        if self.max_green < self.min_green:
            raise Problem(
                "max_green",
                f"expected {self.min_green:g} s, the sumo.min_green, or more, got {self.max_green:g} instead",
            )
        return self


class Settings(SumoTable):
    """The table [sumo] with what a strategy says of it.

    gateways_fixed: whether signals with a gateway movement stay fixed-time, for perimeter control, where the others
        are actuated
    guided: whether drivers are guided by travel times where the controller does not guide routes itself
    """

    gateways_fixed: bool = True
    guided: bool = False


def scenario_file(scenario: "Scenario") -> Path:
    """The scenario.toml, to name it in errors; without a folder, of a scenario that was not loaded from one."""
    return (scenario.folder or Path()) / "scenario.toml"


def settings(scenario: "Scenario") -> Settings:
    """Read and check the table [sumo] of the scenario. Raises InputError.

    >>> settings(nmfd.load_scenario("grid7_peak")).signals
    'fixed'
    """
    if scenario.folder is None:
        return Settings()
    path = scenario_file(scenario)
    if scenario.initial is not None:
        raise config.error(path, "initial", "a city in SUMO begins empty; remove it, or use the regional model (nmfd)")
    chosen = Settings(**vars(config.checked(SumoTable, scenario.sumo, path, "sumo.")))
    for key in FILES:
        for name in getattr(chosen, key):
            if not Path(scenario.folder, name).is_file():
                raise config.error(
                    path, f"sumo.{key}", f"no such file: {scenario.folder / name}; give the path of an existing one"
                )
    if abs(scenario.step / chosen.step_length - round(scenario.step / chosen.step_length)) > 1e-9:
        raise config.error(
            path,
            "sumo.step_length",
            config.got(f"a divisor of the control interval {scenario.step:g} s", chosen.step_length),
        )
    return chosen
