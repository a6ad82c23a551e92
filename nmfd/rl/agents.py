"""A scenario as a PettingZoo environment: one agent per region, all act at once."""

from pathlib import Path

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from nmfd.model.scenario import Scenario
from nmfd.rl.interface import Episode, Interface, combined
from nmfd.types import Plant


class RegionsEnv(ParallelEnv):
    """Agent region_i decides what leaves region i: u_ih, and with guidance theta_ihj. Episodes as of RegionalEnv.

    An agent sees the vehicles in and before its region by destination, and the accumulation of every region. All get
    the same reward, minus all vehicles; with `cooperative=False` each only those in and before its own region, which
    is little sense of what it does to its neighbours. `state()` is the observation of RegionalEnv.
    """

    metadata = {"name": "nmfd_regions_v0", "render_modes": ["rgb_array"], "render_fps": 10, "is_parallelizable": True}

    def __init__(
        self,
        scenario: Scenario | Path | str,
        plant: Plant | None = None,
        *,
        guidance: bool = False,
        cooperative: bool = True,
        render_mode: str | None = None,
    ):
        self._episode, self.render_mode = Episode(scenario, plant), render_mode
        loaded = self._episode.scenario
        network = loaded.network
        self._cooperative = cooperative
        self.possible_agents = [f"region_{region}" for region in range(network.regions)]
        self.agents: list[str] = []
        self.unit = self._episode.unit
        self.interfaces = {
            agent: Interface(network, guidance=guidance, regions=[region])
            for region, agent in enumerate(self.possible_agents)
        }
        self._whole, self._random = Interface(network, guidance=guidance), np.random.default_rng()
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(*interface.bounds(loaded), dtype=np.float32)
            for agent, interface in self.interfaces.items()
        }
        self.action_spaces = {
            agent: gymnasium.spaces.Box(-1.0, 1.0, (interface.action_size,), np.float32)
            for agent, interface in self.interfaces.items()
        }

    def observation_space(self, agent: str) -> gymnasium.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Without a seed, the next one of the sequence that the last seed began."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self._seen = self._episode.reset(int(self._random.integers(2**31)) if seed is None else seed)
        return self._observations(), self._infos()

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """An agent without an action leaves its region open."""
        controls = combined(
            {
                self.possible_agents.index(agent): self.interfaces[agent].controls(action)
                for agent, action in actions.items()
            },
            self._episode.scenario.network,
        )
        self._seen, vehicles, over = self._episode.step(controls)
        amounts = np.full(len(vehicles), vehicles.sum()) if self._cooperative else vehicles
        everyone, rewards = self.agents, dict(zip(self.agents, (-amounts / self.unit).tolist(), strict=True))
        result = (
            self._observations(),
            rewards,
            dict.fromkeys(everyone, False),
            dict.fromkeys(everyone, over),
            self._infos(),
        )
        if over:
            self.agents = []
        return result

    def state(self) -> np.ndarray:
        """The observation of all regions together."""
        return self._whole.observed(self._seen)

    def render(self) -> np.ndarray | None:
        """As of RegionalEnv."""
        return self._episode.picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self._episode.close()

    def _observations(self) -> dict:
        return {
            agent: np.clip(self.interfaces[agent].observed(self._seen), space.low, space.high)
            for agent, space in self.observation_spaces.items()
            if agent in self.agents
        }

    def _infos(self) -> dict:
        return {agent: {"time_s": self._seen.time} for agent in self.agents}
