"""Reinforcement learning on the regional model and, through cosim.plant.env, in SUMO. Needs the extra `rl`.

    RegionalEnv         gymnasium.Env: one agent for all regions, on any plant
    RegionsEnv          pettingzoo.ParallelEnv: one agent per region, on any plant
    NmfdVectorEnv       gymnasium.vector.VectorEnv: many scenarios at once on the regional model
    Sb3VecEnv           the same as Stable-Baselines3 wants it
    Interface           observations and actions as numbers; turns the actions of a trained agent into controls

Importing this module, as gymnasium has it, registers nmfd/Hexagon7-v0 and nmfd/Scenario-v0 (scenario="FOLDER") for
gymnasium.make. Names are imported when they are first used. scenarios/economic_mpc/ppo.py is an example with PPO.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nmfd.extras import need, there

if TYPE_CHECKING:
    from nmfd.rl.agents import RegionsEnv
    from nmfd.rl.env import RegionalEnv
    from nmfd.rl.interface import Interface
    from nmfd.rl.sb3 import Sb3VecEnv
    from nmfd.rl.vector import NmfdVectorEnv

__all__ = ["Interface", "NmfdVectorEnv", "RegionalEnv", "RegionsEnv", "Sb3VecEnv"]
_SCENARIOS = {"Hexagon7": "economic_mpc"}  # of the ids: a scenario of the package; Scenario takes scenario=FOLDER
_PLACES = {  # name -> its module, and the libraries that it needs
    "Interface": ("interface",),
    "NmfdVectorEnv": ("vector", "gymnasium"),
    "RegionalEnv": ("env", "gymnasium"),
    "RegionsEnv": ("agents", "gymnasium", "pettingzoo"),
    "Sb3VecEnv": ("sb3", "gymnasium", "stable_baselines3"),
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'nmfd.rl' has no attribute {name!r}")
    module, *libraries = _PLACES[name]
    need(f"nmfd.rl.{name}", "rl", *libraries)
    return getattr(import_module(f"nmfd.rl.{module}"), name)


def register(namespace: str, entry_point: str, scenarios: dict[str, str]) -> None:
    """Ids for gymnasium.make, if that is there: NAMESPACE/NAME-v0 of scenarios that come with the package, and
    NAMESPACE/Scenario-v0 for any other."""
    if there("gymnasium"):
        import gymnasium  # of an extra: not there for everybody

        gymnasium.register(id=f"{namespace}/Scenario-v0", entry_point=entry_point)
        for name, folder in scenarios.items():
            gymnasium.register(id=f"{namespace}/{name}-v0", entry_point=entry_point, kwargs={"scenario": folder})


register("nmfd", "nmfd.rl.env:RegionalEnv", _SCENARIOS)
