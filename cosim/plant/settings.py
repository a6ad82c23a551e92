"""The table [sumo]: simulation, actuation and measurement of a city."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, model_validator

from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.config import Problem, Seconds, Share, Text, Texts, setting

if TYPE_CHECKING:  # heavy, and the help of a command imports this module
    from nmfd.model.scenario import Scenario

FIXED = "fixed"
WEBSTER = "webster"
ACTUATED = "actuated"
MAX_PRESSURE = "max-pressure"


class SignalControl(NamedTuple):
    """Control of the signals.

    text: what it does, for help
    outside: "module:Class" that sets all signals itself, as cosim.plant.max_pressure.MaxPressure
        does; "" if SUMO runs programmes
    """

    text: str
    outside: str = ""

    def load(self) -> Any:
        """Return the class that sets all signals."""
        module, _, name = self.outside.partition(":")
        return getattr(import_module(module), name)


SIGNAL_CONTROLS = {
    FIXED: SignalControl("the programmes of the network"),
    WEBSTER: SignalControl("fixed-time signals, optimised for the scenario's demand"),
    ACTUATED: SignalControl("signals that extend green while vehicles arrive"),
    MAX_PRESSURE: SignalControl(
        "max-pressure control of all signals", "cosim.plant.max_pressure:MaxPressure"
    ),
}


def _known(name: str) -> str:
    if name not in SIGNAL_CONTROLS:
        raise ValueError(f"should be one of {', '.join(SIGNAL_CONTROLS)}")
    return name


EXACT = "exact"
ESTIMATE = "estimate"
PLAN = "plan.csv.gz"  # of routes, in the folder of a scenario
FILES = ("routes", "background", "additional", "planned")
# Options of SUMO that every run sets itself -> what to give instead.
SET_BY_RUNS = {
    "additional-files": "give sumo.additional",
    "begin": "give sumo.begin",
    "end": "give steps",
    "ignore-route-errors": "omit it",
    "mesosim": "give sumo.mesoscopic",
    "net-file": "name it in network.toml",
    "route-files": "give sumo.routes or sumo.background",
    "seed": "give the seed of a run",
    "step-length": "give sumo.step_length",
    "time-to-teleport": "give sumo.time_to_teleport",
    "tripinfo-output": "omit it; cosim.run(..., tripinfo=FILE) keeps SUMO's trips",
}


class Settings(config.Settings):
    """The city in SUMO. Files are relative to the scenario's folder."""

    step_length: float = setting(
        "time step, a divisor of the control interval", 1.0, unit="s", ge=0.01, le=1.0
    )
    time_to_teleport: float = setting(
        "waiting time before SUMO moves a vehicle on; -1: never", -1.0, unit="s", ge=-1.0
    )
    begin: Seconds = setting("simulation time at which interval 0 begins", 0.0)
    mesoscopic: bool | Literal["ltm"] = setting(
        "SUMO's queue model without lanes, about ten times as fast; ltm: its link transmission "
        "model; for quick studies",
        False,
    )
    routes: Texts = setting(
        "route files of recorded trips; without any, trips are drawn from the demand", ()
    )
    background: Texts = setting(
        "route files of traffic outside the demand: public transport, persons", ()
    )
    additional: Texts = setting("additional files: vehicle types, stops, signal programmes", ())
    options: dict[Text, Text] = setting(
        "SUMO's options that change the traffic, such as max-depart-delay; other keys of [sumo] "
        "override them",
        {},
    )
    signals: Annotated[str, AfterValidator(_known)] = setting(
        f"control of the signals: {', '.join(SIGNAL_CONTROLS)}", FIXED
    )
    lookahead: float = setting(
        "green after a change of stage over which max-pressure compares; less: fewer changes",
        1.0,
        unit="s",
        gt=0.0,
    )
    leave_signals: Texts = setting("signals that perimeter control does not change", ())
    chain_limit: Share = setting(
        "share of the room before a gateway beyond which no command holds vehicles there; 0: no "
        "limit, and the same share for all gateways of a boundary",
        0.6,
    )
    gateways_fixed: bool = setting(
        "signals with gateways stay fixed-time if the others are actuated", True
    )
    guided: bool = setting(
        "drivers are guided by travel times if the controller does not guide them", False
    )
    compliance: Share = setting("probability that a driver follows the guidance in a region", 1.0)
    guidance_period: Seconds = setting(
        "time after which a driver is guided again in the same region; 0: never", 0.0
    )
    planned: Texts = setting(
        "plans of routes (`cosim plan`), added up, that drivers take from their departure on; "
        "compliance holds for them, too, and guidance only for drivers without a plan",
        (),
    )
    ways_return: bool = setting(
        "guided drivers may leave a region and come back where that is fastest", False
    )
    rerouting: Share = setting("share of the drivers with SUMO's rerouting device", 0.0)
    metering: float = setting(
        "critical accumulations in a region above which trips wait outside; 0: never",
        0.0,
        unit="-",
        ge=0.0,
        le=10.0,
    )
    measurement: Literal["exact", "estimate"] = setting(
        "what controllers and guidance see; estimate: by detectors and probes", EXACT
    )
    detector_share: Share = setting("share of the links with loop detectors", 0.3)
    probe_share: Share = setting("share of the vehicles that are probes", 0.1)

    @property
    def signals_from_outside(self) -> bool:
        """True if a class of this package sets all signals, such as max-pressure."""
        return bool(SIGNAL_CONTROLS[self.signals].outside)

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        for option in self.options:
            stem = option.removesuffix(".write-unfinished").removesuffix(".write-undeparted")
            remedy = SET_BY_RUNS.get(stem)
            if remedy is not None:
                raise Problem("options", f"{option} is set by every run itself; {remedy}")
        if self.measurement == ESTIMATE and self.detector_share == self.probe_share == 0:
            raise Problem(
                "measurement",
                '"estimate" needs sumo.detector_share or sumo.probe_share, but both are 0; '
                "raise one of them",
            )
        return self


def settings(scenario: "Scenario") -> Settings:
    """Return the table [sumo] of the scenario. Raises InputError.

    >>> settings(nmfd.load_scenario("grid7_peak")).signals
    'fixed'
    """
    path = scenario.where
    if scenario.initial is not None:
        raise config.error(
            path,
            "initial",
            "a city in SUMO begins empty; remove it, or use the regional model (nmfd)",
        )
    result = config.checked(Settings, scenario.sumo, path, "sumo.")
    check_files(scenario, result)
    steps = scenario.step / result.step_length
    if steps < 1.0 or abs(steps - round(steps)) > 1e-9:
        expected = f"a divisor of the control interval {scenario.step:g} s"
        raise config.error(path, "sumo.step_length", config.got(expected, result.step_length))
    return result


def check_files(scenario: "Scenario", settings: Settings) -> None:
    """Check that the files of the city exist. Raise InputError."""
    for key in FILES:
        for file in own_files(scenario, getattr(settings, key)):
            if not file.is_file():
                remedy = "give the path of an existing one"
                if key == "planned":
                    remedy += ", or make it with cosim plan"
                problem = f"no such file: {file}; {remedy}"
                raise config.error(scenario.where, f"sumo.{key}", problem)


def own_files(scenario: "Scenario", names: Texts) -> list[Path]:
    """Return the paths of files that [sumo] names."""
    return [(scenario.folder or Path()) / name for name in names]


def check_lanes(scenario: "Scenario", settings: Settings) -> None:
    """Check that no setting needs lanes if the city is mesoscopic.

    Raises: InputError
    """
    if not settings.mesoscopic:
        return
    problem = ""
    if settings.signals_from_outside:
        problem = f"signals: {settings.signals} counts vehicles lane by lane"
    elif settings.measurement == ESTIMATE:
        problem = f"measurement: {ESTIMATE} needs loop detectors on lanes"
    if problem:
        problem += ", but SUMO's mesoscopic model has no lanes"
        raise InputError(
            f"{scenario.where}: sumo.{problem}; omit it, or import the city without --mesoscopic"
        )
