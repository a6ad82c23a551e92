"""The regional plants: the NMFD itself and its acyclic variant."""

import numpy as np
import torch

from nmfd import ledger, tensors
from nmfd.arrays import PerRegion
from nmfd.model import acyclic, dynamics
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State


class NmfdPlant:
    """The regional model as a plant (nmfd.types.Plant), in float64.

    >>> scenario = nmfd.load_scenario("economic_mpc")
    >>> plant, network = nmfd.NmfdPlant(scenario), scenario.network
    >>> state = plant.reset(0)
    >>> state = plant.step(nmfd.Controls(perimeter=network.u_max * network.adjacency, splits=None))
    >>> state.step, state.time
    (1, 30.0)
    """

    def __init__(self, scenario: Scenario):
        self._scenario = scenario
        self._parameters = dynamics.parameters(scenario.network)
        self._demand = torch.from_numpy(scenario.demand)

    def reset(self, seed: int) -> State:
        """As the scenario begins; the model is deterministic, `seed` changes nothing."""
        self._x = torch.from_numpy(self._scenario.start)
        self._k, self._entered, self._ended = 0, float(self._x.sum()), 0.0
        self._backlog = torch.zeros_like(self._x)
        return self._state()

    def step(self, controls: Controls) -> State:
        """One control interval. LedgerError if vehicles appear or vanish."""
        demand, self._backlog = _admitted(self._backlog, self._demand[self._k], controls, self._scenario.step)
        splits = self._scenario.network.nominal_splits if controls.splits is None else controls.splits
        self._x, ended = dynamics.advance_counted(
            self._parameters,
            self._x,
            demand,
            torch.from_numpy(controls.perimeter),
            torch.from_numpy(splits),
            self._scenario.step,
            integrator=self._scenario.integrator,
            substeps=self._scenario.substeps,
        )
        self._entered += float(demand.sum()) * self._scenario.step
        self._ended += float(ended)
        self._k += 1
        ledger.check(
            self._k,
            self._k * self._scenario.step,
            entered=self._entered,
            ended=self._ended,
            inside=float(self._x.sum()),
            least=float(self._x.min()),
        )
        return self._state()

    def observe(self) -> Observation | None:
        return None

    def close(self) -> None:
        pass

    def _state(self) -> State:
        x = self._x.numpy()
        return State(
            step=self._k,
            time=self._k * self._scenario.step,
            accumulation=x,
            backlog=self._backlog.numpy().copy(),
            completed=self._ended,
        )


class AcyclicPlant:
    """The acyclic regional model as a plant (nmfd.types.Plant), in float64."""

    def __init__(self, scenario: Scenario):
        self._scenario = scenario
        self._model = acyclic.build(scenario.network)

    def reset(self, seed: int) -> State:
        """As the scenario begins, with the trips of all who are inside beginning where they are; the model is
        deterministic, `seed` changes nothing."""
        self._x = np.zeros(len(self._model.region))
        self._x[self._model.start] = self._scenario.start
        self._k, self._entered, self._ended, self._forced = 0, float(self._x.sum()), 0.0, 0.0
        self._backlog = torch.zeros(2 * (self._scenario.network.regions,), dtype=torch.float64)
        return self._state()

    @property
    def state(self) -> acyclic.PerCell:
        """x_ogij (C,) [veh], in the cells of `nmfd.model.acyclic.build`."""
        return self._x.copy()

    def by_origin(self) -> PerRegion:
        """(R,) [veh], by the region where they began."""
        return np.bincount(self._model.origin, self._x, self._scenario.network.regions)

    @property
    def forced_moves(self) -> float:
        """Vehicles since the reset [veh] whose region theta left them no way on, sent to the least-bad next region.

        Taken at the rate of the beginning of each control interval.
        """
        return self._forced

    def step(self, controls: Controls) -> State:
        """One control interval. LedgerError if vehicles appear or vanish."""
        scenario, model = self._scenario, self._model
        entering, self._backlog = _admitted(
            self._backlog, torch.from_numpy(scenario.demand[self._k]), controls, scenario.step
        )
        demand = entering.numpy()
        splits = scenario.network.nominal_splits if controls.splits is None else controls.splits
        theta, forced = acyclic.shares(model, splits)
        if forced.any():
            leaving = model.exit_rates * acyclic.rate(model, self._x)[model.region] * self._x
            passing = acyclic.transfers(model, self._x, leaving, controls.perimeter, theta)
            self._forced += scenario.step * float(passing[model.fallback[forced]].sum())
        self._x, ended = acyclic.advance_counted(
            model,
            self._x,
            demand,
            controls.perimeter,
            theta,
            scenario.step,
            integrator=scenario.integrator,
            substeps=scenario.substeps,
        )
        self._entered += float(demand.sum()) * scenario.step
        self._ended += ended
        self._k += 1
        ledger.check(
            self._k,
            self._k * scenario.step,
            entered=self._entered,
            ended=self._ended,
            inside=float(self._x.sum()),
            least=float(self._x.min()),
        )
        return self._state()

    def observe(self) -> Observation | None:
        return None

    def close(self) -> None:
        pass

    def _state(self) -> State:
        x = acyclic.translate(self._model, self._x)
        return State(
            step=self._k,
            time=self._k * self._scenario.step,
            accumulation=x,
            backlog=self._backlog.numpy().copy(),
            completed=self._ended,
        )


def _admitted(
    backlog: tensors.PerPair, demand: tensors.PerPair, controls: Controls, step: float
) -> tuple[tensors.PerPair, tensors.PerPair]:
    """As dynamics.admitted, by what `controls` meter."""
    metering = None if controls.metering is None else torch.from_numpy(controls.metering)
    return dynamics.admitted(backlog, demand, metering, step)
