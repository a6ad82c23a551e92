"""The SUMO city as an environment for reinforcement learning (nmfd.rl; needs the extra `rl`).

Importing this module, as gymnasium has it, registers cosim/Grid7-v0 and cosim/Scenario-v0 (scenario="FOLDER") for
gymnasium.make.

One simulation per process: close an environment before the next is reset, and use processes for several
(gymnasium.vector.AsyncVectorEnv, Stable-Baselines3's SubprocVecEnv).
"""

from pathlib import Path
from typing import TYPE_CHECKING

from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.model.scenario import Scenario, with_demand
from nmfd.rl import register

if TYPE_CHECKING:
    from nmfd.rl import RegionalEnv, RegionsEnv


def gymnasium_env(
    scenario: Scenario | Path | str,
    *,
    guidance: bool = False,
    metering: bool = False,
    steps: int | None = None,
    city: str = "",
    render_mode: str | None = None,
) -> "RegionalEnv":
    """One agent for all regions (nmfd.rl.RegionalEnv) in SUMO.

    guidance, metering: as of nmfd.rl.Interface; steps: control intervals of an episode, the scenario's if None
    city: what else the city does, such as "max-pressure+rerouting-30"; render_mode: "rgb_array" for the map. Raises
    InputError.
    """
    from nmfd.rl import RegionalEnv  # of an extra: not there for everybody

    return RegionalEnv(*_city(scenario, steps, city), guidance=guidance, metering=metering, render_mode=render_mode)


def pettingzoo_env(
    scenario: Scenario | Path | str,
    *,
    guidance: bool = False,
    cooperative: bool = True,
    steps: int | None = None,
    city: str = "",
    render_mode: str | None = None,
) -> "RegionsEnv":
    """One agent per region (nmfd.rl.RegionsEnv) in SUMO; the other arguments as of `gymnasium_env`."""
    from nmfd.rl import RegionsEnv  # of an extra: not there for everybody

    return RegionsEnv(
        *_city(scenario, steps, city), guidance=guidance, cooperative=cooperative, render_mode=render_mode
    )


def _city(scenario: Scenario | Path | str, steps: int | None, city: str) -> tuple[Scenario, SumoPlant]:
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if steps is not None:
        loaded = with_demand(loaded, steps=steps)
    overrides = {**(parse(city).overrides if city else {}), "gateways_fixed": True}
    return loaded, SumoPlant(loaded, overrides=settings(loaded).changed(**overrides))


register("cosim", "cosim.plant.env:gymnasium_env", {"Grid7": "grid7_peak"})
