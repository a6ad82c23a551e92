"""The closed loop of any plant and any controller."""

import copy
import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from nmfd import __version__, faults
from nmfd.model.commands import admissible
from nmfd.model.scenario import Scenario
from nmfd.runs.pool import Watchdog
from nmfd.runs.progress import Show
from nmfd.types import EXPECTED, Controller, Controls, Observation, Plant, Result, State, Status

PATIENCE = 10.0  # deadlines after which a decision ends the process of a run
LEAST_PATIENCE_S = 10.0


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch compute on one thread, if controller or plant have loaded it."""
    if "torch" not in sys.modules:
        yield
        return
    from nmfd.tensors import one_thread

    with one_thread():
        yield


@_one_thread()
def run(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    seed: int,
    progress: Show = None,
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
    sensors = faults.Sensors(scenario.ordered_faults)
    random = noise_of(seed)

    def observe() -> tuple[Observation, str]:
        return sensors.see(measurement(plant, states[-1], scenario.measurement_std, random))

    states = [plant.reset(seed)]
    observed, problem = observe()
    observations = [observed]
    controls = []
    decision_time = []
    begin = time.perf_counter()
    deadline = scenario.step
    own = getattr(controller, "deadline", None)
    if isinstance(own, int | float) and own > 0:
        deadline = min(own, deadline)
    watchdog = Watchdog(max(PATIENCE * deadline, LEAST_PATIENCE_S))
    for k in range(scenario.steps):
        given = copy.deepcopy(observed)
        before = time.perf_counter()
        processor = time.process_time()
        with watchdog:
            command = controller.act(given)
        decision_time.append(time.process_time() - processor)
        late = time.perf_counter() - before > deadline
        command = admissible(command, network, f"{name}: interval {k}")
        if problem:
            command = _with_status(command, Status.SENSOR_FAULT, problem, command.note)
        if late:
            reason = f"later than its deadline of {deadline:g} s"
            command = _with_status(command, Status.LATE, command.note, reason)
        states.append(plant.step(command))
        fault = states[-1].problem
        if fault:
            command = _with_status(command, Status.PLANT_FAULT, command.note, fault)
        controls.append(command)
        observed, problem = observe()
        observations.append(observed)
        if progress:
            progress(k + 1, scenario.steps)
    about = {
        "controller": name,
        "plant": type(plant).__name__,
        "seed": seed,
        "step": scenario.step,
        "scenario": scenario.name,
        "version": __version__,
        "settings": json.dumps(scenario.settings),
        "estimated": int(plant.observe() is not None),
        "wall_time": time.perf_counter() - begin,
    }
    nothing = np.zeros((network.regions, network.regions))
    splits = _column(controls, "splits", network.nominal_splits)
    result = Result.make(
        about,
        network.region_names,
        accumulation=_column(states, "accumulation"),
        backlog=_column(states, "backlog"),
        completed=_column(states, "completed"),
        removed=_column(states, "removed", nothing),
        observed=_column(observations, "accumulation"),
        observed_backlog=_column(observations, "backlog"),
        perimeter=_column(controls, "perimeter"),
        splits=splits,
        prices=_column(controls, "prices", nothing[0]),
        status=np.array([command.status.value for command in controls]),
        note=_column(controls, "note"),
        decision_time=np.array(decision_time),
    )
    priced = np.array([command.prices is not None for command in controls])
    if not priced.any() or not getattr(plant, "guides_by_prices", False):
        return result
    nobody_obeys = priced[:, None, None, None]
    commanded = np.where(nobody_obeys, network.nominal_splits, splits)
    return result.assign(splits=commanded).add({}, EXPECTED, expected_splits=splits)


def _column(rows: Sequence[object], name: str, default: object = None) -> np.ndarray:
    """Return a field of all rows as an array.

    default: value of rows in which it is None
    """
    values = []
    for row in rows:
        value = getattr(row, name)
        values.append(default if value is None else value)
    return np.array(values)


def noise_of(seed: int) -> np.random.Generator:
    """Return the random generator of the measurement noise of a run."""
    return np.random.default_rng([seed, 0x6E6F6973])


def measurement(plant: Plant, state: State, std: float, random: np.random.Generator) -> Observation:
    """Return the estimate of the plant's own instruments, or the state.

    std: standard deviation of the noise on the state (veh), if the plant has no instruments
    """
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
