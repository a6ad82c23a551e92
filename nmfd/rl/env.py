"""A scenario as a gymnasium environment: one agent for all regions."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float, UInt8

from nmfd.model.scenario import Scenario
from nmfd.rl.interface import Episode, Interface
from nmfd.types import Observation, Plant


class RegionalEnv(gymnasium.Env):
    """One episode is the whole scenario; it ends by truncation after its T control intervals.

        env = RegionalEnv("economic_mpc", guidance=True)
        env = gymnasium.make("nmfd/Hexagon7-v0", guidance=True)   # the same, after import nmfd.rl

    Observations and actions: nmfd.rl.Interface. The reward of an interval is minus the vehicles in and before the city
    when it begins, in `unit` (the sum of the critical accumulations): TTS = - sum of rewards * unit * scenario.step, as
    in the benchmark table. `info` holds time_s, total_time_spent_veh_s and completed_veh so far.

    scenario: or its folder; plant: what is controlled, the NMFD if None; closed with the environment. One seed gives
    the closed loop of nmfd.run with it. render_mode: "rgb_array" for the map.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        scenario: Scenario | Path | str,
        plant: Plant | None = None,
        *,
        guidance: bool = False,
        metering: bool = False,
        render_mode: str | None = None,
    ):
        self._episode, self.render_mode = Episode(scenario, plant), render_mode
        loaded = self._episode.scenario
        self.interface = Interface(loaded.network, guidance=guidance, metering=metering)
        self.unit = self._episode.unit
        self.observation_space = gymnasium.spaces.Box(*self.interface.bounds(loaded), dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.interface.action_size,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Float[np.ndarray, " O"], dict]:
        """Without a seed, the next one of the sequence that the last seed began."""
        super().reset(seed=seed)
        seen = self._episode.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        self._spent = 0.0
        return self._observed(seen), self._info(seen)

    def step(self, action: Float[np.ndarray, " A"]) -> tuple[Float[np.ndarray, " O"], float, bool, bool, dict]:
        """One control interval under `action`."""
        seen, vehicles, over = self._episode.step(self.interface.controls(action))
        self._spent += self._episode.scenario.step * float(vehicles.sum())
        return self._observed(seen), -float(vehicles.sum()) / self.unit, False, over, self._info(seen)

    def render(self) -> UInt8[np.ndarray, "H W 3"] | None:
        """The map, where rgb_array was asked for."""
        return self._episode.picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the plant."""
        self._episode.close()

    def _observed(self, seen: Observation) -> Float[np.ndarray, " O"]:
        return np.clip(self.interface.observed(seen), self.observation_space.low, self.observation_space.high)

    def _info(self, seen: Observation) -> dict:
        return {"time_s": seen.time, "total_time_spent_veh_s": self._spent, "completed_veh": self._episode.completed}
