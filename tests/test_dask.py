"""Runs on a Dask cluster: whom it trusts, and workers and a scheduler that are killed in the middle of them."""

import csv
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import copies
import pytest
import tiny
import tiny_city
from commands import cosim, good

from cosim.compete import entry
from cosim.compete.metrics import METRICS
from cosim.compete.verify import CLOCK
from cosim.evaluation import dask_cluster, dask_worker
from cosim.evaluation.simulate import Task, simulate
from nmfd.errors import InputError
from nmfd.runs.workers import Failure

WAIT = 240.0  # s, for what has to happen
# It tells of every run that begins, and waits in the middle of all but those of seed 0 until it is let go.
HELD = """
import os, time
from pathlib import Path
import numpy as np
from nmfd import Controls

HERE = Path(__file__).parent

class Held:
    def __init__(self, planning):
        self.adjacency = planning.network.adjacency

    def reset(self, seed=0):
        self.seed = seed

    def act(self, observation):
        if observation.step == 1:  # in no trial of what the class can do
            (HERE / "begun" / f"{self.seed}-{os.getpid()}").touch()
        while observation.step and self.seed and not (HERE / "go").exists():
            time.sleep(0.02)
        return Controls(perimeter=np.where(self.adjacency, 0.5, 0.0).astype(np.float32), splits=None)
"""
TASKS = """
name = "mine"
text = "one task"
[[tasks]]
id = "one"
text = "on the regional model"
scenario = "scenario"
plant = "acyclic"
seeds = [0, 1, 2]
time_limit = 100.0
steps = 4
"""


@pytest.fixture(scope="module")
def peak(tmp_path_factory):
    return copies.peak(tmp_path_factory.mktemp("city"))


def test_a_process_that_dies_is_a_failure(monkeypatch, tmp_path):
    monkeypatch.setattr(dask_worker.sys, "executable", shutil.which("false"))
    task = Task(scenario=tmp_path, controller="no-control", seed=0)
    assert dask_worker.run(simulate, task, str(tmp_path)) == Failure("its process died (status 1)")


def test_remote_gives_the_reason(tmp_path):
    task = Task(scenario=Path("nowhere"), controller="no-control", seed=0)
    outcome = dask_worker.run(simulate, task, str(tmp_path))
    assert "nowhere: no such folder here" in outcome.reason and "\n" not in outcome.reason


@pytest.mark.parametrize(
    "command, chosen",
    [
        ("sweep", ("--controllers", "no-control")),
        ("frontier", ("--controllers", "no-control")),
        ("identify", ("--own",)),
    ],
)
def test_no_scheduler_answers(peak, tmp_path, monkeypatch, command, chosen):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr("cosim.evaluation.dask_cluster.PATIENCE", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        done = cosim(command, peak, *chosen, "--scheduler", address, "--out", tmp_path / "out")
        assert done.exit_code == 2 and "no Dask scheduler answers at" in done.stderr, done.output + str(done.exception)
        assert done.stderr.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory) -> Path:
    """A folder with two authorities, here and other, and a certificate of each: NAME-ca.pem, NAME.pem, NAME.key."""
    folder = tmp_path_factory.mktemp("certificates")

    def openssl(*arguments):
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for name in ("here", "other"):
        openssl(
            "req",
            "-x509",
            *new,
            "-keyout",
            f"{name}-ca.key",
            "-out",
            f"{name}-ca.pem",
            "-days",
            "2",
            "-subj",
            f"/CN={name} authority",
        )
        openssl("req", *new, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", "/CN=localhost")
        openssl(
            "x509",
            "-req",
            "-in",
            f"{name}.csr",
            "-CA",
            f"{name}-ca.pem",
            "-CAkey",
            f"{name}-ca.key",
            "-CAcreateserial",
            "-out",
            f"{name}.pem",
            "-days",
            "2",
        )
    return folder


def shown(folder: Path, name: str, authority: str) -> dict:
    return {"ca": folder / f"{authority}-ca.pem", "cert": folder / f"{name}.pem", "key": folder / f"{name}.key"}


def encrypted(folder: Path, **more):
    """A cluster that trusts who has a certificate of the authority here."""
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    security = distributed.security.Security(
        require_encryption=True,
        tls_ca_file=str(folder / "here-ca.pem"),
        **{
            f"tls_{side}_{what}": str(folder / f"here.{end}")
            for side in ("client", "scheduler", "worker")
            for what, end in (("cert", "pem"), ("key", "key"))
        },
    )
    return distributed.LocalCluster(
        security=security,
        protocol="tls://",
        threads_per_worker=1,
        dashboard_address=None,
        silence_logs=50,
        memory_limit=0,
        **more,
    )


def test_an_encrypted_scheduler_is_reached_with_its_authority_only(certificates, monkeypatch):
    monkeypatch.setattr(dask_cluster, "PATIENCE", 1.0)
    with encrypted(certificates, n_workers=0, processes=False) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        told = []
        dask_cluster.source(dask_cluster.Scheduler(address=address, **shown(certificates, "here", "here")), told.append)
        assert told == [f"--scheduler {address}: has no workers; runs wait for the first (dask worker {address})"]
        for cert, authority in (("other", "here"), ("here", "other")):
            with pytest.raises(InputError, match="no Dask scheduler answers at .* with certificates that it trusts"):
                dask_cluster.connect(dask_cluster.Scheduler(address=address, **shown(certificates, cert, authority)))
        with pytest.raises(InputError, match="--scheduler-ca: missing"):
            dask_cluster.connect(address)


@pytest.mark.parametrize(
    "address, warned",
    [
        ("tcp://127.0.0.1:1", False),
        ("localhost:1", False),
        ("tcp://[::1]:1", False),
        ("tls://far:1", False),
        ("inproc://1/2", False),
        ("tcp://far:1", True),
        ("10.0.0.1:8786", True),
        ("ucx://10.0.0.1:1", True),
        ("", True),
    ],
)
def test_who_is_trusted_is_said(address, warned):
    assert ("whoever reaches it can run code" in dask_cluster.Scheduler(address=address).warning) == warned


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (
            ("--scheduler", "tcp://x:1", "--scheduler-ca", "here-ca.pem"),
            "--scheduler-ca: is for an encrypted scheduler",
        ),
        (("--scheduler", "tls://x:1", "--scheduler-ca", "nowhere.pem"), "nowhere.pem: no such file"),
        (("--scheduler", "tls://x:1", "--scheduler-ca", "here-ca.pem"), "--scheduler-cert: missing"),
        (
            (
                "--scheduler",
                "tls://x:1",
                *(word for what in ("ca", "cert", "key") for word in (f"--scheduler-{what}", "here.csr")),
            ),
            "no Dask scheduler answers",
        ),
        (("--scheduler-key", "here.key"), "--scheduler: missing"),
    ],
)
def test_mistakes_with_certificates(peak, tmp_path, certificates, monkeypatch, arguments, expected):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.chdir(certificates)
    done = cosim("sweep", peak, "--controllers", "no-control", *arguments, "--out", tmp_path / "out")
    assert done.exit_code == 2 and expected in done.stderr and done.stderr.count("\n") == 1, done.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("back, expected", [(False, "did not come back in 0 s"), (True, "was lost 6 times in a row")])
def test_a_scheduler_that_stays_away_or_dies_of_the_runs(monkeypatch, back, expected):
    """What had ended counts, the others are failures that say why."""
    answered, told = [], []

    def connect(scheduler):
        answered.append(scheduler)
        if len(answered) > 1 and not back:
            raise InputError("nobody")
        return object()

    monkeypatch.setattr(dask_cluster, "connect", connect)
    monkeypatch.setattr(dask_cluster, "RETURN", 60.0 if back else 0.0)
    monkeypatch.setattr(
        dask_cluster,
        "_until_lost",
        lambda client, function, tasks: ((task, function(task)) for task in tasks if task == 1),
    )
    found = dict(dask_cluster.outcomes("tcp://127.0.0.1:1", str, [1, 2, 3], tell=told.append))
    assert found[1] == "1" and found[2] == found[3] == Failure(f"the scheduler at tcp://127.0.0.1:1 {expected}")
    assert "tcp://127.0.0.1:1 was lost; its 2 runs begin again" in told[0] and len(told) == (6 if back else 1)


class Cluster:
    """A scheduler and workers, each a process of its own, encrypted."""

    def __init__(self, certificates: Path):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.options = [
            word
            for what, end in (("ca-file", "-ca.pem"), ("cert", ".pem"), ("key", ".key"))
            for word in (f"--tls-{what}", str(certificates / f"here{end}"))
        ]
        self.scheduler = dask_cluster.Scheduler(
            address=f"tls://127.0.0.1:{self.port}", **shown(certificates, "here", "here")
        )
        self.workers: list[subprocess.Popen] = []
        self.began: list[subprocess.Popen] = []

    def start(self, workers: int) -> None:
        """A scheduler, always at the same address, with so many new workers."""
        self.master = self._process("scheduler", "--protocol", "tls", "--host", "tls://127.0.0.1", "--port", self.port)
        until(self._answers)  # workers do not wait for it longer than half a minute
        self.workers = [self.work() for _ in range(workers)]
        client = dask_cluster.connect(self.scheduler)
        client.wait_for_workers(workers, timeout=WAIT)
        client.close()

    def work(self) -> subprocess.Popen:
        """One more worker."""
        return self._process("worker", self.scheduler.address, "--no-nanny", "--nthreads", 1, "--memory-limit", 0)

    def _answers(self) -> bool:
        try:
            dask_cluster.connect(self.scheduler).close()
        except InputError:
            return False
        return True

    def _process(self, what: str, *arguments) -> subprocess.Popen:
        self.began.append(
            subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    f"distributed.cli.dask_{what}",
                    *map(str, arguments),
                    "--no-dashboard",
                    *self.options,
                ],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        )
        return self.began[-1]

    def end(self) -> None:
        for process in self.began:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(certificates, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.chdir(tmp_path)
    made = Cluster(certificates)
    try:
        made.start(workers=2)
        yield made
    finally:
        made.end()


def until(true) -> None:
    deadline = time.monotonic() + WAIT
    while not true():
        assert time.monotonic() < deadline, "that took too long"
        time.sleep(0.05)


def begun(folder: Path) -> Counter:
    """How often the run of each seed was begun."""
    return Counter(int(file.name.split("-")[0]) for file in folder.iterdir())


def seeds(summary: Path) -> list[int]:
    """Of the runs that are kept."""
    if not summary.is_file():
        return []
    with summary.open(newline="", encoding="utf-8") as stream:
        return [int(row["seed"]) for row in csv.DictReader(stream)]


def meddle(cluster: Cluster, here: Path, summary: Path, wrong: list) -> None:
    """Kill a worker in mid-run, and, when another one is at that run, the scheduler, and start that again; then let the
    runs end."""
    try:
        until(lambda: seeds(summary) == [0] and sum(begun(here / "begun").values()) == 3)
        cluster.workers[0].kill()
        cluster.workers[0].wait()
        cluster.work()
        until(lambda: sum(begun(here / "begun").values()) == 4)
        cluster.master.kill()
        cluster.master.wait()
        before = sum(begun(here / "begun").values())
        cluster.start(workers=2)
        until(lambda: sum(begun(here / "begun").values()) >= before + 2)
    except BaseException as error:
        wrong.append(error)
        cluster.end()  # else the runs might wait for workers for ever
    finally:
        (here / "go").touch()


def timeless(file: Path) -> object:
    """What a table or an entry says, but for wall times and when and where it was made."""
    if file.suffix == ".csv":
        with file.open(newline="", encoding="utf-8") as stream:
            return [{key: value for key, value in row.items() if key not in CLOCK} for row in csv.DictReader(stream)]
    found = entry.read(file).model_dump(exclude={"sessions"})
    for outcome in found["tasks"]:
        for run in outcome["runs"]:
            run["metrics"] = {key: value for key, value in run["metrics"].items() if key not in CLOCK}
            assert set(run["metrics"]) <= set(METRICS)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("command", ["evaluate", "compete"])
def test_a_worker_and_the_scheduler_are_killed_and_nothing_is_lost_or_done_twice(command, cluster, tmp_path):
    """Nor is a byte different from what is made without a cluster; all of it encrypted."""
    (tmp_path / "begun").mkdir()
    Path("held.py").write_text(HELD, encoding="utf-8")
    if command == "evaluate":
        tiny_city.city(tmp_path)
        scenario = tiny_city.imported(tmp_path).relative_to(tmp_path)
        order = (
            "evaluate",
            scenario,
            "--controllers",
            "held.py:Held",
            "--seeds",
            3,
            "--first-seed",
            0,
            "--steps",
            2,
            "--time-limit",
            100,
        )
        runs, tables = "demand-1", ("runs.csv", "demand-1/sumo.csv")
    else:
        tiny.write(tmp_path)
        Path("mine.toml").write_text(TASKS, encoding="utf-8")
        order = ("compete", "held.py:Held", "--tasks", "mine.toml")
        runs, tables = "one", ("held.py%3AHeld.json",)
    wrong: list = []
    thread = threading.Thread(target=meddle, args=(cluster, tmp_path, tmp_path / "there" / runs / "summary.csv", wrong))
    thread.start()
    at = cluster.scheduler
    there = cosim(
        *order,
        "--out",
        "there",
        "--scheduler",
        at.address,
        "--scheduler-ca",
        at.ca,
        "--scheduler-cert",
        at.cert,
        "--scheduler-key",
        at.key,
    )
    thread.join()
    assert not wrong, wrong
    until(lambda: cluster.began[2].poll() is not None)  # a worker that lost its scheduler ends
    good(there)
    assert "was lost; its 2 runs begin again when it is back" in there.stderr
    counts = begun(tmp_path / "begun")
    assert sorted(seeds(tmp_path / "there" / runs / "summary.csv")) == [0, 1, 2] and counts[0] == 1
    good(cosim(*order, "--out", "here", "--workers", 1))
    files = sorted(file.name for file in (tmp_path / "here" / runs).glob("*.nc"))
    assert len(files) == 3 and files == sorted(file.name for file in (tmp_path / "there" / runs).glob("*.nc"))
    for file in files:
        assert Path("there", runs, file).read_bytes() == Path("here", runs, file).read_bytes(), file
    for table in tables:
        assert timeless(Path("there", table)) == timeless(Path("here", table))
