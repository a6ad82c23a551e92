"""The closed loop of any plant and any controller."""

import copy
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nmfd import __version__, faults
from nmfd.model.commands import admissible
from nmfd.model.scenario import Scenario
from nmfd.runs.pool import Watchdog
from nmfd.tensors import one_thread
from nmfd.types import Controller, Controls, Observation, Plant, Result, State, Status

PATIENCE = 10.0  # deadlines after which a decision ends the process of a run
LEAST_PATIENCE_S = 10.0


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

    The controller gets the estimate of the plant's own instruments, or, without any, every x_ij
    with Gaussian noise of `scenario.measurement_std`, drawn from `seed`, with the faults of the
    scenario (nmfd.faults). Observations and controls are copied: a controller may write into
    either. A decision is late after the control interval or the controller's own `deadline` (s).

    progress: is called with the intervals done and `scenario.steps` after every interval
    Raises: InputError for a command of a wrong type, shape or value, before the plant sees it
    """
    network = scenario.network
    name = str(getattr(controller, "name", type(controller).__name__))
    controller.reset(seed)
    sensors, random = faults.Sensors(scenario.ordered_faults), noise_of(seed)

    def observe() -> tuple[Observation, str]:
        return sensors.see(measurement(plant, states[-1], scenario.measurement_std, random))

    states, controls, decision_time = [plant.reset(seed)], [], []
    observed, problem = observe()
    observations = [observed]
    begin, deadline = time.perf_counter(), scenario.step
    own = getattr(controller, "deadline", None)
    if isinstance(own, int | float) and own > 0:
        deadline = min(own, deadline)
    watchdog = Watchdog(max(PATIENCE * deadline, LEAST_PATIENCE_S))
    for k in range(scenario.steps):
        given = copy.deepcopy(observed)
        before, processor = time.perf_counter(), time.process_time()
        with watchdog:
            command = controller.act(given)
        decision_time.append(time.process_time() - processor)
        late = time.perf_counter() - before > deadline
        command = admissible(command, network, f"{name}: interval {k}")
        if problem:
            command = _with_status(command, Status.SENSOR_FAULT, problem, command.note)
        if late:
            command = _with_status(
                command, Status.LATE, command.note, f"later than its deadline of {deadline:g} s"
            )
        states.append(plant.step(command))
        fault = states[-1].problem
        controls.append(
            _with_status(command, Status.PLANT_FAULT, command.note, fault) if fault else command
        )
        observed, problem = observe()
        observations.append(observed)
        if progress:
            progress(k + 1, scenario.steps)
    return Result.make(
        {
            "controller": name,
            "plant": type(plant).__name__,
            "seed": seed,
            "step": scenario.step,
            "scenario": scenario.name,
            "version": __version__,
            "settings": json.dumps(scenario.settings),
            "estimated": int(plant.observe() is not None),
            "wall_time": time.perf_counter() - begin,
        },
        network.region_names,
        accumulation=np.stack([s.accumulation for s in states]),
        backlog=np.stack([s.backlog for s in states]),
        completed=np.array([s.completed for s in states]),
        observed=np.stack([o.accumulation for o in observations]),
        observed_backlog=np.stack([o.backlog for o in observations]),
        perimeter=np.stack([c.perimeter for c in controls]),
        splits=np.stack(
            [network.nominal_splits if c.splits is None else c.splits for c in controls]
        ),
        decision_time=np.array(decision_time),
        status=np.array([c.status.value for c in controls]),
        note=np.array([c.note for c in controls]),
        removed=np.stack(
            [np.zeros_like(s.backlog) if s.removed is None else s.removed for s in states]
        ),
        prices=np.stack(
            [np.zeros(network.regions) if c.prices is None else c.prices for c in controls]
        ),
    )


def noise_of(seed: int) -> np.random.Generator:
    """Return the random generator of the measurement noise of a run."""
    return np.random.default_rng([seed, 0x6E6F6973])


def measurement(plant: Plant, state: State, std: float, random: np.random.Generator) -> Observation:
    """Return the estimate of the plant's own instruments or, without any, the state with noise of
    `std` [veh]."""
    noise = std * random.standard_normal(state.accumulation.shape)
    return plant.observe() or Observation(
        step=state.step,
        time=state.time,
        accumulation=state.accumulation + noise,
        backlog=state.backlog,
        realised=state.realised,
    )


def _with_status(controls: Controls, status: Status, *notes: str) -> Controls:
    return replace(controls, status=controls.status | status, note="; ".join(filter(None, notes)))
