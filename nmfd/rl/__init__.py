"""Environments for reinforcement learning on any plant: one for Gymnasium, one for PettingZoo.
Needs the extra `rl`.

    RegionalEnv     gymnasium.Env: one agent for all regions
    RegionsEnv      pettingzoo.ParallelEnv: one agent per region
    Interface       observations and actions as vectors; turns the actions of a trained agent into controls

Importing nmfd registers nmfd/Hexagon7-v0 and nmfd/Scenario-v0 (scenario="FOLDER") for
gymnasium.make.
"""

from nmfd.errors import need

need("nmfd.rl", "rl", "gymnasium", "pettingzoo")

from nmfd.rl.env import Interface, RegionalEnv, RegionsEnv

__all__ = ["Interface", "RegionalEnv", "RegionsEnv"]
