"""Environments for reinforcement learning on any plant: one for Gymnasium, one for PettingZoo. Needs the extra `rl`.

    RegionalEnv     gymnasium.Env: one agent for all regions
    RegionsEnv      pettingzoo.ParallelEnv: one agent per region
    Interface       observations and actions as vectors; turns the actions of a trained agent into controls

Importing this module registers nmfd/Hexagon7-v0 and nmfd/Scenario-v0 (scenario="FOLDER") for gymnasium.make.
"""

from importlib.util import find_spec
from typing import Any

from nmfd.errors import need

__all__ = ["Interface", "RegionalEnv", "RegionsEnv"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'nmfd.rl' has no attribute {name!r}")
    need(f"nmfd.rl.{name}", "rl", "gymnasium", "pettingzoo")
    from nmfd.rl import env  # needs the extra

    return getattr(env, name)


if find_spec("gymnasium"):
    import gymnasium  # of the extra

    for name, options in (("Scenario", {}), ("Hexagon7", {"scenario": "economic_mpc"})):
        gymnasium.register(id=f"nmfd/{name}-v0", entry_point="nmfd.rl.env:RegionalEnv", kwargs=options)
