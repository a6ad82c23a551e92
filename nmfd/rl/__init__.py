"""Environments for reinforcement learning on any plant.

    RegionalEnv     gymnasium.Env: one agent for all regions
    RegionsEnv      pettingzoo.ParallelEnv: one agent per region
    Interface       observations and actions as vectors; actions of a trained agent as controls

Importing this package registers `nmfd/Hexagon7-v0` and `nmfd/Scenario-v0` (scenario="FOLDER") with
Gymnasium. `gymnasium.make("nmfd.rl:nmfd/Hexagon7-v0")` imports it first, by the name before the
colon.

It needs the extra `rl`.
"""

from nmfd.errors import need

need("nmfd.rl", "rl", "gymnasium", "pettingzoo")

import gymnasium  # noqa: E402

from nmfd.rl.env import Interface, RegionalEnv, RegionsEnv  # noqa: E402

__all__ = ["Interface", "RegionalEnv", "RegionsEnv"]

ENTRY = "nmfd.rl:RegionalEnv"
gymnasium.register(id="nmfd/Scenario-v0", entry_point=ENTRY)
gymnasium.register(id="nmfd/Hexagon7-v0", entry_point=ENTRY, kwargs={"scenario": "economic_mpc"})
