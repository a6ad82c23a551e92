"""A controller cannot reach the plant: what it writes into, whatever it is given, changes nobody's result."""

from pathlib import Path

import numpy as np
import pytest
import tiny
import torch

import nmfd
from nmfd.controllers import registry
from nmfd.model.planning import planning_model
from nmfd.studies import benchmark

VANDAL = """
import dataclasses
import numpy as np
from nmfd import Controls

def ruin(value):
    for name in list(value) if isinstance(value, dict) else [n for n in dir(value) if not n.startswith("__")]:
        part = value[name] if isinstance(value, dict) else getattr(value, name, None)
        if isinstance(part, np.ndarray):
            part.fill(0)
        elif isinstance(part, dict):
            ruin(part)
            part.clear()
        elif dataclasses.is_dataclass(part) and not isinstance(part, type):
            ruin(part)

class Vandal:
    name = "vandal"

    def __init__(self, planning):
        adjacency, u_max = planning.network.adjacency.copy(), planning.network.u_max
        self._given = [planning]
        self._perimeter = np.where(adjacency, u_max, 0.0)
        if RUINS:
            ruin(planning)

    def reset(self, seed=0):
        pass

    def act(self, observation):
        controls = Controls(perimeter=self._perimeter.copy(), splits=None)
        if RUINS:
            for given in self._given:
                ruin(given)
            self._given.append(observation)
            self._given.append(controls)   # after it was returned, too
        return controls
"""


def written(folder: Path, ruins: bool) -> str:
    path = folder / f"vandal{ruins}.py"
    path.write_text(f"RUINS = {ruins}\n{VANDAL}")
    return f"{path}:Vandal"


@pytest.mark.parametrize("plant", ["nmfd", pytest.param("acyclic", marks=pytest.mark.slow)])
def test_a_controller_that_writes_into_everything_changes_nobodys_result(tmp_path, plant):
    scenario = nmfd.load_scenario(tiny.write(tmp_path))
    alone = {name: nmfd.run(scenario, name, plant=plant) for name in ("no-control", "pi-gating")}
    names = [written(tmp_path, False), written(tmp_path, True), *alone]
    rows = benchmark.run_all(scenario, names, [0], plant, out=tmp_path / "out")
    spent = {row["controller"]: row["total_time_spent_veh_s"] for row in rows}
    assert spent[names[0]] == spent[names[1]] > 0.0
    for name, trajectory in alone.items():
        assert spent[name] == nmfd.total_time_spent(trajectory) > 0.0


def test_an_object_of_ones_own_cannot_reach_the_plant_either(tmp_path):
    scenario = nmfd.load_scenario(tiny.write(tmp_path))
    honest, vandal = (nmfd.run(scenario, registry.make(written(tmp_path, ruins), scenario)) for ruins in (False, True))
    for name in ("accumulation", "backlog", "completed", "perimeter", "splits", "observed"):
        np.testing.assert_array_equal(getattr(vandal, name), getattr(honest, name))


def test_a_planning_model_shares_no_array_with_the_scenario(tmp_path):
    scenario = nmfd.load_scenario(tiny.write(tmp_path))
    _ = scenario.network.nominal_splits, scenario.network.split_mask
    planning = planning_model(scenario, "pi-gating")
    for name in ("positions", "adjacency", "nominal_splits", "split_mask", "hops"):
        assert not np.shares_memory(getattr(planning.network, name), getattr(scenario.network, name)), name
    assert not np.shares_memory(planning.forecast, scenario.demand)


def test_threads_of_who_imports_stay_as_they_are(tmp_path):
    scenario, before = nmfd.load_scenario(tiny.write(tmp_path)), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        nmfd.run(scenario, "no-control")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_delayed_measurements_are_no_solver_failures(tmp_path):
    folder = tiny.write(tmp_path)
    trajectory = nmfd.run(nmfd.load_scenario(folder), "no-control")
    assert not trajectory.status.any()
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text('faults = ["delayed:2"]\n' + text)
    row = nmfd.summary(nmfd.run(nmfd.load_scenario(folder), "no-control"))
    assert row["solver_failures"] == row["fallbacks"] == row["plant_faults"] == 0 < row["sensor_faults"]
