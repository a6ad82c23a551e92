"""What an agent sees and does, as vectors of numbers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from nmfd.arrays import PerRegion
from nmfd.closed_loop import noise_of, noisy
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario, read_scenario
from nmfd.rl.drawing import CityDrawing
from nmfd.types import Controls, Observation, Plant

Pairs = Float[np.ndarray, "*#B R R"]  # of some states or controls, or of one
Actions = Float[np.ndarray, "*B A"]

NOISE = 10.0  # standard deviations of the measurement noise that an observation may be off by
LOGITS = 5.0  # actions in [-1, 1] times this are the logits of the split ratios: up to e^10 between two ways


class Interface:
    """Observations and actions of an agent for some regions of a network; all regions by default.

    Observation, float32: for all regions x_ij of every pair and the backlog of every region; for some, x_ij and the
    backlog of these, and the accumulation of every region. All divided by the region's critical accumulation.

    Action, in [-1, 1]: u_ih of every boundary out of these regions, from u_min to u_max, or with `metering` one for all
    entries of a region h alike, as gating does, which is easier to explore; with guidance also a logit for every next
    region h of theta_ihj where there is a choice, of which the softmax is taken. Admissible whatever it is.

    observation_size, action_size
    """

    def __init__(
        self,
        network: RegionalModel,
        *,
        guidance: bool = False,
        metering: bool = False,
        regions: Sequence[int] | None = None,
    ):
        self._network = network
        chosen = np.arange(network.regions) if regions is None else np.array(regions)
        self._chosen, self._all = chosen, regions is None
        self._critical = network.critical
        mine = np.isin(np.arange(network.regions), chosen)
        self._boundaries = np.nonzero(network.adjacency & mine[:, None])
        choice = network.split_mask & (network.split_mask.sum(axis=1, keepdims=True) > 1) & mine[:, None, None]
        self._ways = np.nonzero(choice) if guidance else None
        entered, gate = np.unique(self._boundaries[1], return_inverse=True)
        self._gate = gate if metering else np.arange(len(gate))  # which number of an action is u of each boundary
        self._count = len(entered) if metering else len(gate)
        self.action_size = self._count + (0 if self._ways is None else len(self._ways[0]))
        self.observation_size = len(chosen) * (network.regions + 1) + (0 if self._all else network.regions)
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        # The split ratios of these regions that no action decides: where there is one way only.
        self._rest = np.where(network.split_mask & ~choice & mine[:, None, None], network.nominal_splits, 0.0)

    def observation(self, accumulation: Pairs, backlog: Pairs) -> Float[np.ndarray, "*B O"]:
        """(..., observation_size) of accumulation (..., R, R) and backlog (..., R, R) [veh]."""
        batch, chosen = accumulation.shape[:-2], self._chosen
        parts = [
            (accumulation / self._critical[:, None])[..., chosen, :].reshape(*batch, -1),
            (backlog.sum(axis=-1) / self._critical)[..., chosen],
        ]
        if not self._all:
            parts.append(accumulation.sum(axis=-1) / self._critical)
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def observed(self, observation: Observation) -> Float[np.ndarray, " O"]:
        """(observation_size,) of what a controller sees."""
        return self.observation(observation.accumulation, observation.backlog)

    def bounds(self, scenario: Scenario) -> tuple[Float[np.ndarray, " O"], Float[np.ndarray, " O"]]:
        """The lowest and the highest observation (observation_size,): of nobody, and of twice all vehicles of the
        scenario besides full regions at every place, give and take the noise."""
        trips = 2.0 * (scenario.step * scenario.demand.sum() + scenario.start.sum()) + sum(
            mfd.jam for mfd in scenario.network.mfds
        )
        off, nobody = NOISE * scenario.measurement_std, np.zeros_like(self._open)
        return self.observation(nobody - off, nobody), self.observation(nobody + trips + off, nobody + trips)

    def perimeter(self, action: Actions) -> Pairs:
        """(..., R, R) [-] of actions (..., action_size); u_max at the boundaries of other regions."""
        network = self._network
        share = 0.5 * (np.clip(np.asarray(action, dtype=float)[..., : self._count], -1.0, 1.0) + 1.0)
        perimeter = np.broadcast_to(self._open, (*share.shape[:-1], *self._open.shape)).copy()
        perimeter[..., *self._boundaries] = network.u_min + (network.u_max - network.u_min) * share[..., self._gate]
        return perimeter

    def splits(self, action: Actions) -> Float[np.ndarray, "*B R R R"] | None:
        """(..., R, R, R) [-] of actions (..., action_size), 0 in other regions; None without guidance."""
        if self._ways is None:
            return None
        action = np.clip(np.asarray(action, dtype=float)[..., self._count :], -1.0, 1.0)
        weight = np.zeros((*action.shape[:-1], *self._rest.shape))
        weight[..., *self._ways] = np.exp(LOGITS * action)
        sums = weight.sum(axis=-2, keepdims=True)
        return self._rest + weight / np.where(sums > 0, sums, 1.0)

    def controls(self, action: Float[np.ndarray, " A"]) -> Controls:
        """Of one action (action_size,)."""
        return Controls(perimeter=self.perimeter(action), splits=self.splits(action))


def combined(parts: dict[int, Controls], network: RegionalModel) -> Controls:
    """The controls of all regions: of each those of its own agent, without one an open perimeter and own ways."""
    perimeter, splits = np.where(network.adjacency, network.u_max, 0.0), network.nominal_splits.copy()
    for region, controls in parts.items():
        perimeter[region] = controls.perimeter[region]
        if controls.splits is not None:
            splits[region] = controls.splits[region]
    guided = any(controls.splits is not None for controls in parts.values())
    return Controls(perimeter=perimeter, splits=splits if guided else None)


class Episode:
    """A closed loop that is stepped from outside, with the noise and states of nmfd.closed_loop.run of one seed."""

    def __init__(self, scenario: Scenario | Path | str, plant: Plant | None):
        """scenario: or its folder; plant: the NMFD if None"""
        self.scenario = scenario if isinstance(scenario, Scenario) else read_scenario(Path(scenario))
        self._plant, self._closed = NmfdPlant(self.scenario) if plant is None else plant, False
        self._drawing: CityDrawing | None = None
        # Only cities have streets.
        self._shown, self._density = (getattr(plant, name, None) for name in ("map", "density"))
        self.unit = sum(mfd.critical for mfd in self.scenario.network.mfds)  # [veh]

    def reset(self, seed: int) -> Observation:
        """What the agent sees at the beginning."""
        self._random = noise_of(seed)
        self._state, self.steps = self._plant.reset(seed), 0
        self._perimeter = np.where(self.scenario.network.adjacency, self.scenario.network.u_max, 0.0)
        return self._seen()

    def step(self, controls: Controls) -> tuple[Observation, PerRegion, bool]:
        """What the agent sees next; vehicles (R,) [veh] in and before each region, and removed there, when the interval
        began; the end."""
        spent = self._state.unfinished.sum(axis=1)
        self._state, self._perimeter = self._plant.step(controls), controls.perimeter
        self.steps += 1
        return self._seen(), spent, self.steps >= self.scenario.steps

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """What the city is in."""
        if self._drawing is None:
            network = self.scenario.network
            critical = network.critical
            places, streets = self._shown() if self._shown else (network.positions, ())
            self._drawing = CityDrawing(places, network.adjacency, critical, streets)
        state = self._state
        return self._drawing.draw(
            f"{self.scenario.name}, {state.time / 60:.0f} min: {state.accumulation.sum():,.0f} vehicles inside, "
            f"{state.completed:,.0f} trips completed",
            state.accumulation.sum(axis=1),
            self._perimeter,
            self._density() if self._density else None,
        )

    @property
    def completed(self) -> float:
        """[veh]"""
        return self._state.completed

    def close(self) -> None:
        """Close the plant, once."""
        if not self._closed:
            self._plant.close()
            self._closed = True

    def _seen(self) -> Observation:
        noise = self.scenario.measurement_std * self._random.standard_normal(self._state.accumulation.shape)
        told = self._plant.observe()
        return noisy(self._state, noise) if told is None else told
