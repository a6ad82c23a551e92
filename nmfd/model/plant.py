"""Regional plants: the NMFD and its acyclic variant, in float64."""

import numpy as np
import torch

from nmfd import ledger
from nmfd.arrays import PerPair, PerTurn
from nmfd.model import acyclic, dynamics
from nmfd.model.integration import counted
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State

PROCESS_STREAM = 0x70726F63  # random numbers of the process noise


class NmfdPlant:
    """The regional model as a plant.

    It is deterministic but for `process_std`; without that, seeds change nothing.

    >>> scenario = nmfd.load_scenario("economic_mpc")
    >>> plant, network = nmfd.NmfdPlant(scenario), scenario.network
    >>> state = plant.reset(0)
    >>> state = plant.step(nmfd.Controls(perimeter=network.u_max * network.adjacency, splits=None))
    >>> state.step, state.time
    (1, 30.0)
    """

    def __init__(self, scenario: Scenario):
        self._scenario = scenario
        self._build()

    def reset(self, seed: int) -> State:
        self._k = 0
        self._entered = float(self._scenario.start.sum())
        self._ended = 0.0
        self._random = np.random.default_rng([seed, PROCESS_STREAM])
        self._backlog = torch.zeros(self._scenario.demand.shape[1:], dtype=torch.float64)
        self._begin(self._scenario.start)
        return self._state()

    def step(self, controls: Controls) -> State:
        """Advance by one control interval.

        Raises: LedgerError if vehicles appear or vanish
        """
        step = self._scenario.step
        due = torch.from_numpy(self._scenario.demand[self._k])
        metering = controls.metering
        if metering is not None:
            metering = torch.from_numpy(metering)
        demand, self._backlog = dynamics.admitted(self._backlog, due, metering, step)
        splits = controls.splits
        if splits is None:
            splits = self._scenario.network.nominal_splits
        ended = self._advance(demand.numpy(), controls.perimeter, splits)
        self._entered += float(demand.sum()) * step + self._disturb()
        self._ended += ended
        self._k += 1
        state = self._state()
        ledger.check(
            state.step,
            state.time,
            entered=self._entered,
            ended=self._ended,
            inside=float(self._x.sum()),
            least=float(self._x.min()),
        )
        return state

    def observe(self) -> Observation | None:
        """Return None: controllers observe the state with noise."""

    def _disturb(self) -> float:
        """Add process noise to each x_ij above 0; return the vehicles added."""
        if not self._scenario.process_std:
            return 0.0
        before = self._accumulation()
        noise = self._scenario.process_std * self._random.standard_normal(before.shape)
        after = np.where(before > 0, np.maximum(before + noise, 0.0), before)
        self._scale(after / np.where(before > 0, before, 1.0))
        return float(after.sum() - before.sum())

    def _state(self) -> State:
        return State(
            step=self._k,
            time=self._k * self._scenario.step,
            accumulation=self._accumulation(),
            backlog=self._backlog.numpy().copy(),
            completed=self._ended,
        )

    def _build(self) -> None:
        self._parameters = dynamics.parameters(self._scenario.network)

    def _begin(self, start: PerPair) -> None:
        self._x = torch.from_numpy(start)

    def _accumulation(self) -> PerPair:
        return self._x.numpy()

    def _scale(self, factor: PerPair) -> None:
        self._x = self._x * torch.from_numpy(factor)

    def _advance(self, demand: PerPair, perimeter: PerPair, splits: PerTurn) -> float:
        """Advance `_x` by one control interval; return the completed trips [veh]."""
        self._x, ended = dynamics.advance_counted(
            self._parameters,
            self._x,
            torch.from_numpy(demand),
            torch.from_numpy(perimeter),
            torch.from_numpy(splits),
            **self._scenario.scheme,
        )
        return float(ended)


class AcyclicPlant(NmfdPlant):
    """The acyclic regional model as a plant.

    forced_moves: vehicles since the reset that had no allowed next region and were sent to the
        least-bad one, counted at the rate at the beginning of each control interval (veh)
    """

    forced_moves: float

    def _build(self) -> None:
        self._model = acyclic.build(self._scenario.network)

    def _begin(self, start: PerPair) -> None:
        self.forced_moves = 0.0
        self._x = np.zeros(len(self._model.region))
        self._x[self._model.start] = start

    def _accumulation(self) -> PerPair:
        model = self._model
        regions = len(model.start)
        pair = model.region * regions + model.destination
        return np.bincount(pair, self._x, minlength=regions**2).reshape(regions, regions)

    def _scale(self, factor: PerPair) -> None:
        self._x = self._x * factor[self._model.region, self._model.destination]

    def _advance(self, demand: PerPair, perimeter: PerPair, splits: PerTurn) -> float:
        model = self._model
        theta, forced = acyclic.shares(model, splits)
        if forced.any():
            leaving = acyclic.outflow(model, self._x, theta)
            passing = acyclic.transfers(model, self._x, leaving, perimeter, theta)
            moved = float(passing[model.fallback[forced]].sum())
            self.forced_moves += self._scenario.step * moved

        def slope(x: acyclic.PerCell) -> tuple[acyclic.PerCell, float]:
            return acyclic.derivative(model, x, demand, perimeter, theta)

        self._x, ended = counted(slope, self._x, **self._scenario.scheme)
        return ended
