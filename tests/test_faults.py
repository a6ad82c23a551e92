"""Faults: injected, survived, and in the status of every decision. One test per row of the README's table of faults."""

import errno
import gzip
import itertools
import os
import re
import resource
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny
import tiny_city
import torch
from commands import call

import cosim.cli.main
import nmfd.cli.main
from cosim.plant.perimeter import YELLOW
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from cosim.sumo.build import ensure_built
from cosim.sumo.net import load_city
from nmfd import faults
from nmfd.api import load_scenario
from nmfd.closed_loop import run
from nmfd.controllers import registry
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.controllers.mpc.controller import EconomicMpc
from nmfd.controllers.no_control import NoControl
from nmfd.controllers.pi_gating import PiGating
from nmfd.errors import InputError
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.runs import run_folder
from nmfd.types import Controls, Observation

MAINS = {"nmfd": nmfd.cli.main.main, "cosim": cosim.cli.main.main}


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Two regions, the second one so busy that control matters."""
    text = tiny.SCENARIO.replace("peak = 2.0", "peak = 4.0").replace("measurement_std = 0.5", "measurement_std = 0.0")
    return load_scenario(tiny.write(tmp_path_factory.mktemp("tiny"), scenario=text))


def driven(scenario, controller, *ordered):
    """The trajectory with these faults, after a look at whether every vehicle and every control is in order."""
    network = scenario.network
    trajectory = run(NmfdPlant(scenario), controller, replace(scenario, faults=ordered), seed=0)
    entered = scenario.step * np.cumsum(scenario.demand.sum(axis=(1, 2)))
    inside = trajectory.accumulation.sum(axis=(1, 2))[1:]
    np.testing.assert_allclose(inside + trajectory.completed[1:], entered, rtol=0, atol=1e-6)
    u = trajectory.perimeter[:, network.adjacency]
    assert np.isfinite(u).all() and network.u_min - 1e-9 <= u.min() and u.max() <= network.u_max + 1e-9
    return trajectory


@pytest.mark.parametrize(
    "kind, reason",
    [
        ("solver-fails", "solver failed (FloatingPointError)"),
        ("solver-diverges", "not a number"),
        ("solver-late", "time limit"),
    ],
)
@pytest.mark.parametrize("guidance", [False, True])
def test_mpc_without_a_solver_uses_its_plan_and_then_gates(scenario, kind, reason, guidance):
    controller = EconomicMpc(planning_model(scenario), guidance=guidance)
    status = driven(scenario, controller, f"{kind}@3-15").note
    reach = controller.options.horizon - 2
    assert set(status[:3]) == set(status[15:]) == {""}
    assert set(status[3 : 3 + reach]) == {f"{reason}: last plan used"}
    assert set(status[3 + reach : 15]) == {f"{reason}: pi-gating in control"}


def test_the_plan_is_moved_on_and_gating_is_pi_gating(scenario):
    controller = EconomicMpc(planning_model(scenario), guidance=False)
    busy = Observation(step=2, time=60.0, accumulation=np.array([[0.0, 200.0], [0.0, 500.0]]), backlog=np.zeros((2, 2)))
    controller.act(busy)
    plan = controller._plan.copy()
    controller.fault = "solver-fails"
    for ahead in range(1, len(plan)):
        expected, _ = controller.admissible.controls(plan[ahead])
        np.testing.assert_array_equal(controller.act(busy).perimeter, expected)
    gating = PiGating(planning_model(scenario))
    for _ in range(3):
        np.testing.assert_array_equal(controller.act(busy).perimeter, gating.act(busy).perimeter)


def test_without_a_protected_region_the_perimeter_is_opened(scenario):
    controller = EconomicMpc(planning_model(replace(scenario, protected=())), guidance=True)
    status = driven(scenario, controller, "solver-fails").note
    assert set(status) == {"solver failed (FloatingPointError): perimeter opened, nominal splits"}


@pytest.mark.parametrize("guidance", [False, True])
def test_a_policy_that_returns_nan(scenario, guidance):
    torch.manual_seed(0)
    controller = DpcController(Policy(scenario.network, Architecture(width=4, guidance=guidance)))
    trajectory = driven(scenario, controller, "policy-nan@5-8")
    assert [k for k, status in enumerate(trajectory.note) if status] == [5, 6, 7]
    assert set(trajectory.note[5:8]) == {"dpc: policy returned NaN, perimeter opened"}
    np.testing.assert_allclose(trajectory.perimeter[5:8, 0, 1], scenario.network.u_max, rtol=1e-6)


def test_a_policy_whose_weights_are_nan(scenario):
    policy = Policy(scenario.network, Architecture(width=4))
    with torch.no_grad():
        policy.perimeter_decoder.weight[:] = torch.nan
    assert set(driven(scenario, DpcController(policy)).note) == {"dpc: policy returned NaN, perimeter opened"}


class Mad(NoControl):
    def act(self, measurement):
        return Controls(perimeter=np.full((2, 2), np.inf), splits=None)


def test_controls_of_any_controller_that_are_no_numbers(scenario):
    note = driven(scenario, Mad(planning_model(scenario))).note
    assert set(note) == {"the controls were no numbers: perimeter opened"}


class Diary(NoControl):
    """Notes what it sees."""

    def __init__(self, scenario):
        super().__init__(scenario)
        self.seen = []

    def act(self, measurement):
        self.seen.append(measurement)
        return super().act(measurement)


@pytest.fixture
def seen(scenario):
    """What controllers see with faults: (exact accumulations (T, 2, 2), seen ones, statuses)."""

    def look(*ordered):
        diary = Diary(planning_model(scenario))
        trajectory = driven(scenario, diary, *ordered)
        assert [m.step for m in diary.seen] == list(range(scenario.steps))
        return trajectory.accumulation[:-1], np.stack([m.accumulation for m in diary.seen]), trajectory.note

    return look


def noted(status, begin, end, text):
    assert [k for k, one in enumerate(status) if one] == list(range(begin, end))
    assert set(status[begin:end]) == {text}


def test_frozen_measurements(seen):
    exact, shown, status = seen("frozen@6-12")
    assert (shown[6:12] == exact[6]).all() and (shown[12:] == exact[12:]).all() and (shown[:6] == exact[:6]).all()
    assert (exact[6] != exact[11]).any()
    noted(status, 6, 12, "measurement frozen")


def test_delayed_measurements(seen):
    exact, shown, status = seen("delayed:3@5-20")
    assert (shown[5:] == exact[2:-3]).all() and (shown[:5] == exact[:5]).all()
    noted(status, 5, 20, "measurement 3 intervals late")


def test_a_region_without_measurements(seen):
    exact, shown, status = seen("missing:0@4-10")
    assert (shown[4:10, 0] == exact[3, 0]).all() and (shown[4:10, 1] == exact[4:10, 1]).all()
    noted(status, 4, 10, "measurement 2 of 4 entries missing, last ones used")


def test_missing_detectors(scenario, tmp_path):
    """Of the 49 entries of seven regions."""
    hexagon = load_scenario(tiny.Path(__file__).parents[1] / "scenarios" / "economic_mpc")
    hexagon = replace(hexagon, steps=12, demand=hexagon.demand[:12], measurement_std=0.0)
    diary = Diary(planning_model(hexagon))
    status = run(NmfdPlant(hexagon), diary, replace(hexagon, faults=("detectors:0.2@5-12",)), seed=1).note
    missing = int(re.match(r"measurement (\d+) of 49 entries missing", status[-1])[1])
    assert 4 <= missing <= 16 and len(set(status[5:])) == 1
    moved = np.stack([m.accumulation for m in diary.seen])
    still = (moved[5:] == moved[4]).all(axis=0)
    assert still.sum() >= missing and (moved[11] != moved[4]).any()


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_measurements_that_are_off_by_half(seen, factor):
    exact, shown, status = seen(f"off:{factor}@3-9")
    np.testing.assert_allclose(shown[3:9], factor * exact[3:9])
    noted(status, 3, 9, f"measurement off by a factor of {factor}")


@pytest.mark.parametrize("name", ["pi-gating", "mpc-pc", "mpc-pcrg"])
@pytest.mark.parametrize("ordered", ["frozen@3-9", "delayed:2", "missing:1@3-9", "detectors:0.5", "off:0.5", "off:1.5"])
def test_controllers_survive_every_fault_of_the_sensors(scenario, name, ordered):
    trajectory = driven(scenario, registry.make(name, scenario), ordered)
    assert np.isfinite(trajectory.accumulation).all() and any(trajectory.note)


def test_several_faults_at_once_are_all_named(scenario):
    controller = EconomicMpc(planning_model(scenario), guidance=False)
    status = driven(scenario, controller, "off:1.5", "delayed:1", "solver-fails@1-2").note
    assert status[1] == (
        "measurement off by a factor of 1.5, 1 intervals late; solver failed (FloatingPointError): last plan used"
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "frozen:3",
        "missing",
        "missing:2",
        "missing:-1",
        "missing:0.5",
        "missing:x",
        "off:",
        "off:nan",
        "off:-1",
        "off:11",
        "detectors:1.5",
        "delayed:0",
        "delayed:1.5",
        "frozen@5",
        "frozen@5-5",
        "frozen@9-3",
        "frozen@a-b",
        "solver-fails:1",
        "closed",
        "signal",
        "closed:x@3",
        "frozen @3-4",
        "FROZEN",
    ],
)
def test_wrong_orders(tmp_path, text):
    folder, out = tiny.write(tmp_path), tmp_path / "out"
    result = call("nmfd", "benchmark", folder, "--controllers", "no-control", "--fault", text, "--out", out)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "--fault" in result.stderr, result.stderr
    assert not out.exists()
    with pytest.raises(InputError):
        faults.parse(text, "here", 2)


def test_ordered_in_the_scenario_or_on_the_command_line(tmp_path):
    folder = tiny.write(tmp_path)
    command = ("nmfd", "benchmark", folder, "--controllers", "mpc-pc,no-control", "--out")
    assert call(*command, tmp_path / "a", "--fault", "solver-fails@2-5").exit_code == 0
    (folder / "scenario.toml").write_text('faults = ["solver-fails@2-5"]\n' + tiny.SCENARIO)
    assert call(*command, tmp_path / "b").exit_code == 0
    for out in ("a", "b"):
        summary = run_folder.read_summary(tmp_path / out / "summary.csv")
        rows = {row["controller"]: row["solver_failures"] for row in summary}
        assert rows == {"mpc-pc": 3, "no-control": 0}
    assert (tmp_path / "a" / "mpc-pc-0.nc").read_bytes() == (tmp_path / "b" / "mpc-pc-0.nc").read_bytes()
    result = call(*command, tmp_path / "a")
    assert result.exit_code == 0  # the same scenario and faults
    (folder / "scenario.toml").write_text(tiny.SCENARIO)
    result = call(*command, tmp_path / "a")
    assert result.exit_code == 2 and "another configuration" in result.stderr
    (folder / "scenario.toml").write_text('faults = ["closed:x"]\n' + tiny.SCENARIO)
    result = call(*command, tmp_path / "c")
    assert result.exit_code == 2 and "closed is a fault of a city" in result.stderr


# In SUMO.

STEPS = 8


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("city")
    config = tiny_city.city(folder)
    result = call(
        "cosim",
        "import",
        config,
        "--regions",
        3,
        "--no-run",
        "--method",
        "geometric",
        "--out",
        folder / "networks" / "tiny",
    )
    assert result.exit_code == 0, result.output
    return load_scenario(folder / "scenarios" / "tiny")


def in_sumo(city, *ordered, perimeter=None, watch=None, **changed):
    """The measurements and the record of a run with these faults; watch(plant) is called when it begins."""
    scenario = replace(city, faults=ordered)
    plant = SumoPlant(scenario, overrides=settings(scenario).changed(**changed))
    opened = np.where(city.network.adjacency, city.network.u_max if perimeter is None else perimeter, 0.0)
    try:
        states = [plant.reset(0)]
        observations = [plant.observe()]
        if watch:
            watch(plant)
        for _ in range(STEPS):
            states.append(plant.step(Controls(perimeter=opened, splits=None)))
            observations.append(plant.observe())
        return states, plant.record(), observations
    finally:
        plant.close()


def test_a_closed_street(city):
    edge, found = "B1C1", {}
    n = loaded(city).edges.index(edge)
    for ordered in ((), (f"closed:{edge}@2-5",)):
        measurements, record, _ = in_sumo(city, *ordered)
        found[ordered] = record
        problems = [m.problem for m in measurements[1:]]
        assert problems == [f"edge {edge} closed" if ordered and 2 <= k < 5 else "" for k in range(STEPS)]
    free, shut = (record.edge_vehicles[:, n].astype(float) for record in found.values())
    assert shut[3:5].mean() > 2.0 * free[3:5].mean() + 1.0  # who is on it stands
    assert found[()].arrivals[2:5].sum() > found[(f"closed:{edge}@2-5",)].arrivals[2:5].sum()
    assert shut[-1] < shut[3:5].max()  # and goes on afterwards


def loaded(city):
    files = ensure_built(city.network)
    return load_city(files.net_file, files.regions_csv, city.network.regions)


def test_a_signal_that_takes_no_programme(city):
    gateways, closed = loaded(city).gateways, city.network.u_min
    signal = next(gateway.signal for gateway in gateways if gateway.signal is not None)
    _, free, _ = in_sumo(city, perimeter=closed)
    measurements, record, _ = in_sumo(city, f"signal:{signal}@3-6", perimeter=closed)
    problems = [m.problem for m in measurements[1:]]
    assert problems == [f"signal {signal} took no programme" if 3 <= k < 6 else "" for k in range(STEPS)]
    own = [n for n, gateway in enumerate(gateways) if gateway.signal == signal]
    assert own and (record.gateway_green[3:6, own] == record.gateway_original_green[3:6, own]).all()
    assert (free.gateway_green[3:6, own] < free.gateway_original_green[3:6, own]).any()


@pytest.mark.parametrize("signals, gateway", [("fixed", True), ("max-pressure", True), ("max-pressure", False)])
def test_a_deaf_signal_runs_its_own_programme(city, signals, gateway):
    """Under max-pressure too, rationed or not: second by second its own, with yellow before and after."""
    plant = SumoPlant(replace(city, faults=()))
    gateways = {gateway.signal for gateway in loaded(city).gateways}
    name = next(found.id for found in plant.simple_signals if (found.id in gateways) == gateway)
    plant.reset(0)
    own = [phase.state for phase in plant.session.programme(name).phases for _ in range(round(phase.duration))]
    plant.close()
    shown = []

    def watch(plant):
        step = plant.session.step
        plant.session.step = lambda: (step(), shown.append(plant.session.signal_state(name)))

    measurements, _, _ = in_sumo(city, f"signal:{name}@3-6", perimeter=city.network.u_min, watch=watch, signals=signals)
    problems = [m.problem for m in measurements[1:]]
    assert problems == [f"signal {name} took no programme" if 3 <= k < 6 else "" for k in range(STEPS)]
    interval = round(city.step)
    begin, end = 3 * interval + round(YELLOW), 6 * interval
    cycles = [[own[(n + k) % len(own)] for k in range(end - begin)] for n in range(len(own))]
    assert shown[begin:end] in cycles
    assert shown[begin - interval : end - interval] not in cycles and shown[-len(own) :] not in [
        cycle[: len(own)] for cycle in cycles
    ]
    for before, after in itertools.pairwise(shown):
        assert not any(a in "Gg" and b == "r" for a, b in zip(before, after, strict=True)), (before, after)


def test_silent_loop_detectors(city):
    """The estimate goes on, and differs from that with all loops."""
    estimates = []
    for ordered in ((), ("detectors:0.2@1-8",)):
        measurements, _, seen = in_sumo(city, *ordered, measurement="estimate", detector_share=1.0, probe_share=0.3)
        estimates.append(np.stack([one.accumulation for one in seen]))
        assert np.isfinite(estimates[-1]).all()
        wanted = "20 % of the loop detectors silent" if ordered else ""
        assert [m.problem for m in measurements[2:]] == [wanted] * (STEPS - 1)
    assert (estimates[0] != estimates[1]).any()
    total = [estimate.sum(axis=(1, 2)) for estimate in estimates]
    assert abs(total[0] - total[1]).max() < 0.5 * total[0].max()


@pytest.mark.parametrize(
    "ordered, message",
    [
        ("sumo-exits@1-2", "SUMO stopped at .* s: ordered by the fault sumo-exits"),
        (None, "SUMO stopped at .* s: The vehicle type 'nosuch' for vehicle 'late' is not known"),
    ],
)
def test_sumo_exits_in_mid_run(city, tmp_path, ordered, message):
    """Once by order, once by a vehicle that SUMO itself cannot make."""
    shutil.copytree(city.folder.parent.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / "scenarios" / "tiny"
    if ordered is None:
        (folder / "background.rou.xml.gz").write_bytes(
            gzip.compress(
                b"<routes><vehicle id='early' depart='850'><route edges='A1B1 B1C1'/></vehicle>"
                b"<vehicle id='late' type='nosuch' depart='1200'><route edges='A1B1 B1C1'/></vehicle></routes>"
            )
        )
    out, faults_ = tmp_path / "out", ("--fault", ordered) if ordered else ()
    result = call("cosim", "run", folder, "--controller", "no-control", "--out", out, *faults_)
    assert result.exit_code == 1 and result.stderr.count("\n") == 1, result.stderr
    assert re.search(f"cosim: error: controller no-control, seed 0: {message}", result.stderr)
    assert not out.exists()


@pytest.mark.parametrize(
    "ordered, problem",
    [
        ("closed:nowhere", "edge 'nowhere' is not in"),
        ("signal:nobody", "'nobody' is no signal with a gateway movement"),
    ],
)
def test_orders_for_what_the_city_does_not_have(city, tmp_path, ordered, problem):
    out = tmp_path / "out"
    result = call("cosim", "run", city.folder, "--controller", "no-control", "--out", out, "--fault", ordered)
    assert result.exit_code == 2 and problem in result.stderr and result.stderr.count("\n") == 1
    assert not out.exists()


def test_a_path_with_a_comma_is_named_and_one_with_a_space_is_none(city, tmp_path):
    """SUMO separates files by commas."""
    for name, status in (("a, b", 2), ("é b", 0)):
        shutil.copytree(city.folder.parent.parent, tmp_path / name)
        out = tmp_path / name / "out"
        result = call(
            "cosim",
            "run",
            tmp_path / name / "scenarios" / "tiny",
            "--controller",
            "no-control",
            "--steps",
            1,
            "--out",
            out,
        )
        assert result.exit_code == status and out.exists() == (status == 0), result.output
        assert status == 0 or re.search("error: .*a, b/.*: SUMO cannot read a file with a comma", result.stderr)


def test_statuses_of_a_city_are_in_its_tables(city, tmp_path):
    out = tmp_path / "out"
    result = call(
        "cosim",
        "run",
        city.folder,
        "--controller",
        "mpc-pc",
        "--steps",
        4,
        "--out",
        out,
        "--fault",
        "closed:B1C1@1-3",
        "--fault",
        "solver-fails@2-3",
    )
    assert result.exit_code == 0, result.output
    facts = pd.read_csv(out / "sumo.csv").loc[0, "notes"]
    assert "1 x edge B1C1 closed" in facts
    assert "solver failed (FloatingPointError): last plan used; edge B1C1 closed" in facts
    row = run_folder.read_summary(out / "summary.csv")[0]
    counted = {name: row[name] for name in ("solver_failures", "fallbacks", "sensor_faults", "plant_faults")}
    assert counted == {"solver_failures": 1, "fallbacks": 1, "sensor_faults": 0, "plant_faults": 2}


# A full disk, as far as one can be had without filling one: no file may grow beyond a limit.


def with_limit(size: int, *command):
    """(exit status, stderr) of a command in a process whose files may not grow beyond `size` bytes."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        result = call(*command)
        os.write(writer, f"{result.exit_code}\n{result.stderr}".encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as stream:
        status, stderr = stream.read().split("\n", 1)
    os.waitpid(child, 0)
    return int(status), stderr


def test_a_full_disk(tmp_path):
    folder, out = tiny.write(tmp_path), tmp_path / "out"
    command = ("nmfd", "benchmark", folder, "--controllers", "no-control", "--out", out, "--seeds")
    assert call(*command, 1).exit_code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    trajectory = len(before["no-control-0.nc"])
    status, stderr = with_limit(trajectory // 2, *command, 2)
    assert status == 2 and re.fullmatch(
        r"nmfd: error: .*/out/no-control-1.nc: cannot be written \(.*\); is the disk full\?\n", stderr
    ), stderr
    after = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {name: after[name] for name in before if name != "manifest.json"} == {
        name: content for name, content in before.items() if name != "manifest.json"
    }
    assert call(*command, 2).exit_code == 0
    assert len(run_folder.read_summary(out / "summary.csv")) == 2


IN_SUMO = ("cosim", "run", "--controller", "no-control", "--steps", 4, "--sumo-output")


@pytest.fixture(scope="module")
def sizes(city, tmp_path_factory):
    """SUMO's own outputs of a run: kind -> bytes."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert call(*IN_SUMO, "tripinfo,edgedata,emission", "--out", out, city.folder).exit_code == 0
    return {file.name.split(".")[1]: file.stat().st_size for file in out.glob("*.xml*")}


@pytest.mark.parametrize(
    "kind, share",
    [
        ("tripinfo", 0.9),
        pytest.param("edgedata", 0.9, marks=pytest.mark.slow),
        pytest.param("emission", 0.9, marks=pytest.mark.slow),
        ("tripinfo", 0.001),
    ],
)
def test_a_disk_that_is_full_before_sumo_has_written_all(city, sizes, tmp_path, kind, share):
    """SUMO says nothing of it, and its files are looked at; or it ends its process (emission). Once even what it reads
    cannot be written."""
    out = tmp_path / "out"
    status, stderr = with_limit(int(share * sizes[kind]), *IN_SUMO, kind, "--out", out, city.folder)
    assert status in (1, 2) and stderr.count("\n") == 1, stderr
    assert any(words in stderr for words in ("is the disk full?", "its process died", os.strerror(errno.EFBIG))), stderr
    assert not out.exists()


def test_a_full_disk_before_the_first_run_leaves_nothing(tmp_path):
    folder, out = tiny.write(tmp_path), tmp_path / "out"
    status, stderr = with_limit(10, "nmfd", "benchmark", folder, "--controllers", "no-control", "--out", out)
    assert status == 2 and stderr.count("\n") == 1 and os.strerror(errno.EFBIG) in stderr, stderr
    assert not out.exists()
