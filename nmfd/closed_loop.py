"""The one closed loop: every plant and every controller meet here."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nmfd import faults
from nmfd.model.scenario import Scenario
from nmfd.types import Controller, Controls, Measurement, Plant, Trajectory


def run(
    plant: Plant, controller: Controller, scenario: Scenario, *, seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Drive `plant` with `controller` for `scenario.steps` control intervals.

    The controller sees every x_ij with Gaussian noise of `scenario.measurement_std`, drawn from `seed`, or the plant's
    estimate as it is; the trajectory holds the exact state. `progress(done, steps)` is called after every interval.
    The faults that the scenario orders are injected (nmfd.faults). What was wrong with a measurement, or what the plant
    could not do in an interval, is in the status of that decision.
    """
    random = np.random.default_rng([seed, 0x6E6F6973])
    ordered, network = faults.of(scenario), scenario.network
    sensors = faults.Sensors(ordered, seed)
    watched = faults.Supervised(controller, ordered, np.where(network.adjacency, network.u_max, 0.0))
    watched.reset(seed)
    states, controls, decision_time = [plant.reset(seed)], [], []
    completed = [plant.completed()]
    begin = time.perf_counter()
    for k in range(scenario.steps):
        noise = scenario.measurement_std * random.standard_normal(states[-1].accumulation.shape)
        seen, problem = sensors.see(
            what_is_seen(states[-1], noise), estimated=states[-1].estimate is not None)
        before = time.perf_counter()
        controls.append(watched.act(seen, problem))
        decision_time.append(time.perf_counter() - before)
        states.append(plant.step(controls[-1]))
        if states[-1].problem:
            controls[-1] = _noted(controls[-1], states[-1].problem)
        completed.append(plant.completed())
        if progress:
            progress(k + 1, scenario.steps)
    return Trajectory(
        controller=controller.name, plant=type(plant).__name__, seed=seed, step=scenario.step,
        accumulation=np.stack([s.accumulation for s in states]), backlog=np.stack([s.backlog for s in states]),
        completed=np.array(completed), perimeter=np.stack([c.perimeter for c in controls]),
        splits=np.stack([scenario.network.nominal_splits if c.splits is None else c.splits for c in controls]),
        decision_time=np.array(decision_time),
        status=tuple(c.status for c in controls), wall_time=time.perf_counter() - begin,
        estimate=None if states[0].estimate is None else np.stack([s.estimate for s in states]))


def _noted(controls: Controls, problem: str) -> Controls:
    status = problem if controls.status == "ok" else f"{controls.status}; {problem}"
    return replace(controls, status=status)


def what_is_seen(state: Measurement, noise: np.ndarray) -> Measurement:
    """The plant's estimate where it makes one, else the exact state with `noise` (R, R) [veh]."""
    if state.estimate is None:
        return replace(state, accumulation=state.accumulation + noise)
    return Measurement(
        step=state.step, time=state.time, accumulation=state.estimate, backlog=state.estimated_backlog)
