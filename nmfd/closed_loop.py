"""The closed loop of any plant and any controller."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nmfd import faults
from nmfd.arrays import PerPair
from nmfd.model.scenario import Scenario
from nmfd.tensors import one_thread
from nmfd.types import Controller, Controls, Observation, Plant, Result, State, Status


@one_thread()
def run(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Drive `plant` with `controller` for `scenario.steps` control intervals.

    The controller gets the estimate of the plant's own instruments, or, without any, every x_ij with Gaussian noise of
    `scenario.measurement_std`, drawn from `seed`; the result has both this and the exact state. Observations and
    controls are copied: a controller may write into either. The faults of the scenario are injected (nmfd.faults). The
    status of a decision tells of a faulty observation, a command that the plant could not execute, and a decision after
    the control interval or the controller's `deadline` (s).

    progress: is called with the intervals done and `scenario.steps` after every interval
    """
    network = scenario.network
    opened = np.where(network.adjacency, network.u_max, 0.0)
    controller.reset(seed)
    sensors = _Sensors(scenario, seed)
    states, controls, decision_time = [plant.reset(seed)], [], []
    observed, problem = sensors.observe(states[-1], plant.observe())
    observations = [observed]
    begin, deadline = time.perf_counter(), _deadline(controller, scenario.step)
    for k in range(scenario.steps):
        given = observed.copy()
        before = time.perf_counter()
        command = controller.act(given)
        decision_time.append(time.perf_counter() - before)
        command = faults.checked(_copied(command), opened, problem)
        if decision_time[-1] > deadline:
            command = _with_status(command, Status.LATE, f"later than its deadline of {deadline:g} s")
        states.append(plant.step(command))
        fault = states[-1].problem
        controls.append(_with_status(command, Status.PLANT_FAULT, fault) if fault else command)
        observed, problem = sensors.observe(states[-1], plant.observe())
        observations.append(observed)
        if progress:
            progress(k + 1, scenario.steps)
    return Result.make(
        {
            "controller": controller.name,
            "plant": type(plant).__name__,
            "seed": seed,
            "step": scenario.step,
            "estimated": int(sensors.estimated),
            "wall_time": time.perf_counter() - begin,
        },
        accumulation=np.stack([s.accumulation for s in states]),
        backlog=np.stack([s.backlog for s in states]),
        completed=np.array([s.completed for s in states]),
        observed=np.stack([o.accumulation for o in observations]),
        observed_backlog=np.stack([o.backlog for o in observations]),
        perimeter=np.stack([c.perimeter for c in controls]),
        splits=np.stack([network.nominal_splits if c.splits is None else c.splits for c in controls]),
        decision_time=np.array(decision_time),
        status=np.array([c.status.value for c in controls]),
        note=np.array([c.note for c in controls]),
        removed=np.stack([np.zeros_like(s.backlog) if s.removed is None else s.removed for s in states]),
        prices=np.stack([np.zeros(network.regions) if c.prices is None else c.prices for c in controls]),
    )


class _Sensors:
    """Sensors between the state and the controller: instruments or noise, and their faults."""

    def __init__(self, scenario: Scenario, seed: int):
        self._faulty = faults.Sensors(scenario.ordered_faults)
        self._std, self._random = scenario.measurement_std, noise_of(seed)
        self.estimated = False

    def observe(self, state: State, estimate: Observation | None) -> tuple[Observation, str]:
        """Return the observation and its problem, "" if none. estimate: of the plant's own instruments."""
        noise = self._std * self._random.standard_normal(state.accumulation.shape)
        self.estimated = estimate is not None
        return self._faulty.see(noisy(state, noise) if estimate is None else estimate)


def noise_of(seed: int) -> np.random.Generator:
    """Return the random generator of the measurement noise of a run."""
    return np.random.default_rng([seed, 0x6E6F6973])


def noisy(state: State, noise: PerPair) -> Observation:
    """Return the measurement of the state with `noise` (R, R) [veh] on the accumulation."""
    return Observation(step=state.step, time=state.time, accumulation=state.accumulation + noise, backlog=state.backlog)


def _deadline(controller: Controller, step: float) -> float:
    """Return the decision deadline (s): the controller's own, capped at the control interval."""
    own = getattr(controller, "deadline", None)
    return min(own, step) if isinstance(own, int | float) and own > 0 else step


def _copied(controls: Controls) -> Controls:
    """Return a copy with its own arrays: the controller may write into those that it returned."""
    splits, prices, metering = (
        None if values is None else np.array(values) for values in (controls.splits, controls.prices, controls.metering)
    )
    return replace(controls, perimeter=np.array(controls.perimeter), splits=splits, prices=prices, metering=metering)


def _with_status(controls: Controls, status: Status, note: str) -> Controls:
    """Return the controls with another status and note."""
    return replace(controls, status=controls.status | status, note="; ".join(filter(None, (controls.note, note))))
