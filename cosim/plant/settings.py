"""The table [sumo] of scenario.toml: how the city is simulated, actuated and measured."""

from dataclasses import dataclass

from cosim.plant.strategy import FIXED, HOLD_BACK, MODES, SIGNALS
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario, read_tables
from nmfd.runs import config

EXACT, ESTIMATE = "exact", "estimate"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """[sumo] of scenario.toml.

    step_length: of SUMO [s]; time_to_teleport: [s], -1 for never; collision_action: SUMO's
    actuation: "hold-back" or "redistribute"; min_green: of a gateway movement, and of every
        stage under max-pressure [s]
    queue_override: a gateway whose edge held this share of its room in the last control interval is left open, 0 for
        never [-]
    compliance: share of the decisions in which a driver follows the route guidance [-]
    guidance_period: guided drivers are asked again after this time in the same region [s]; 0: when they depart and
        when they enter a region only
    most_detour: a driver does not follow route guidance into a next region that costs him more than this [s]
    ways_return: whether guided drivers may leave a region and come back to it where that is the fastest way of all, as
        on a main road along a ragged boundary
    rerouting: share of the drivers with SUMO's own rerouting device [-]
    measurement: "exact", or "estimate": controllers see what detectors and probes tell (cosim/plant/detectors.py)
    detector_share: of the links, with loop detectors [-]; probe_share: of the vehicles [-]
    signals: one of strategy.SIGNALS; gateways_fixed (of the strategy, no key of the table): whether signals with
        a gateway movement stay fixed-time, for perimeter control, where the others are actuated

    Of a city with vehicles of its own (cosim import), files relative to the scenario's folder:
    routes: their route files; without any, trips are drawn from the scenario's demand
    background: route files of what is no demand and is left alone: public transport, persons
    additional: SUMO's additional files: vehicle types, stops, signal programmes
    begin: simulation time at which interval 0 begins [s]
    departure_jitter: departures are moved by up to this, either way, by the seed [s]
    leave_signals: signals that perimeter control leaves alone

    mesoscopic: SUMO's queue model instead of its car-following, for quick studies: no lanes and no positions on them,
        queues hold the vehicles that fit on an edge, signals cap the flow by their green share. About ten times as fast
    """

    step_length: float = 1.0
    time_to_teleport: float = -1.0
    collision_action: str = "warn"
    actuation: str = HOLD_BACK
    min_green: float = 5.0
    queue_override: float = 0.0
    compliance: float = 1.0
    guidance_period: float = 0.0
    most_detour: float = 60.0
    ways_return: bool = False
    rerouting: float = 0.0
    measurement: str = EXACT
    detector_share: float = 0.3
    probe_share: float = 0.1
    signals: str = FIXED
    gateways_fixed: bool = True
    routes: tuple[str, ...] = ()
    background: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    begin: float = 0.0
    departure_jitter: float = 10.0
    leave_signals: tuple[str, ...] = ()
    mesoscopic: bool = False


def settings(scenario: Scenario) -> Settings:
    """Read and check the table [sumo] of the scenario. Raises InputError."""
    if scenario.folder is None:
        return Settings()
    path, default = scenario.folder / "scenario.toml", Settings()
    table = config.Table(read_tables(scenario.folder).raw_table("sumo"), path, "sumo.")
    chosen = Settings(
        step_length=table.number("step_length", default.step_length, above=0.0, high=1.0),
        time_to_teleport=table.number("time_to_teleport", default.time_to_teleport, low=-1.0),
        collision_action=table.text(
            "collision_action", default.collision_action, ("none", "warn", "teleport", "remove")),
        actuation=table.text("actuation", default.actuation, MODES),
        min_green=table.number("min_green", default.min_green, low=1.0),
        queue_override=table.number("queue_override", default.queue_override, low=0.0, high=1.0),
        compliance=table.number("compliance", default.compliance, low=0.0, high=1.0),
        guidance_period=table.number("guidance_period", default.guidance_period, low=0.0),
        most_detour=table.number("most_detour", default.most_detour, low=0.0),
        ways_return=table.flag("ways_return", default.ways_return),
        rerouting=table.number("rerouting", default.rerouting, low=0.0, high=1.0),
        signals=table.text("signals", default.signals, SIGNALS),
        measurement=table.text("measurement", default.measurement, (EXACT, ESTIMATE)),
        detector_share=table.number("detector_share", default.detector_share, low=0.0, high=1.0),
        probe_share=table.number("probe_share", default.probe_share, low=0.0, high=1.0),
        routes=table.texts("routes", ()), background=table.texts("background", ()),
        additional=table.texts("additional", ()), begin=table.number("begin", 0.0, low=0.0),
        departure_jitter=table.number("departure_jitter", default.departure_jitter, low=0.0),
        leave_signals=table.texts("leave_signals", ()), mesoscopic=table.flag("mesoscopic", False))
    for key in ("routes", "background", "additional"):
        for name in getattr(chosen, key):
            if not (scenario.folder / name).is_file():
                raise table.error(key, f"no such file: {scenario.folder / name}; give the path of an existing one")
    table.close()
    if chosen.measurement == ESTIMATE and chosen.detector_share == chosen.probe_share == 0:
        raise InputError(
            f"{path}: sumo.measurement: \"estimate\" needs detectors or probes, but sumo.detector_share and "
            "sumo.probe_share are both 0; raise one of them")
    if abs(scenario.step / chosen.step_length - round(scenario.step / chosen.step_length)) > 1e-9:
        raise InputError(
            f"{path}: sumo.step_length: expected a divisor of the control interval {scenario.step:g} s, got "
            f"{chosen.step_length:g} instead")
    return chosen
