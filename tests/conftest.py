"""What every test shares: one thread per process, checked annotations, and small scenarios."""

import gc
import os
import sys

import pytest
from jaxtyping import config, install_import_hook
from xdist.workermanage import NodeManager

sys.dont_write_bytecode = (
    False  # else every process rewrites the asserts of all files anew, for 6 s
)
# Here and in the commands that tests call: workers must not fight for cores. Torch reads it when it
# is imported.
os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)
# Where arrays have shapes; of the other modules, many functions are called for every vehicle or
# line of a file.
SHAPED = [
    "cosim.evaluation",
    "cosim.importing",
    "cosim.plant",
    "cosim.reporting",
    "cosim.sumo.net",
    "cosim.sumo.trips",
]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--annotations",
        choices=("on", "off"),
        default="on",
        help="whether types and shapes are checked at every call of nmfd, which costs half as much "
        "time again where arrays are all there is",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Annotations are checked at every call, but not where times are measured."""
    if config.getoption("annotations") == "on" and not config.getoption("benchmark_only"):
        install_import_hook("nmfd", "annotations.check")
        install_import_hook(SHAPED, "annotations.check_arrays")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Nothing of what collection makes is garbage until the end: looking for it takes a fifth of
    that time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_keyboard_interrupt() -> None:
    NodeManager.EXIT_TIMEOUT = (
        0.1  # s, that workers have to end: they are in the middle of a test; usually it is 10 s
    )


@pytest.fixture(scope="session", autouse=True)
def _preloaded():
    """The first run of a process decides what the server of processes imports for all later runs:
    here those in SUMO too, each of which would import them again."""
    from nmfd.runs import pool  # not before annotations are checked

    pool.PRELOADED += ("nmfd.closed_loop", "cosim.evaluation.simulate")


@pytest.fixture
def folder(tmp_path):
    """The folder of the tiny scenario; some modules have another `scenario` of their own."""
    import tiny  # not before annotations are checked

    return tiny.write(tmp_path)


@pytest.fixture
def out(tmp_path):
    """A folder to write into, which is not there yet."""
    return tmp_path / "out"


@pytest.fixture
def scenario(folder):
    from nmfd.api import load_scenario

    return load_scenario(folder)


@pytest.fixture
def three_regions(tmp_path):
    """The tiny scenario with three regions in a row."""
    import tiny  # not before annotations are checked

    from nmfd.api import load_scenario

    return load_scenario(tiny.write(tmp_path, network=tiny.row_network(3)))


@pytest.fixture
def plant_of(scenario):
    """Plants of a module's scenario that are closed in any case: SUMO allows one session per
    process."""
    from cosim.plant.plant import SumoPlant  # not before annotations are checked
    from cosim.plant.settings import Settings

    plants = []

    def make(**overrides):
        plants.append(SumoPlant(scenario, settings=Settings(**overrides)))
        return plants[-1]

    yield make
    for plant in plants:
        plant.close()


@pytest.fixture
def train(scenario, tmp_path):
    """Trains a policy, by default on the module's scenario."""
    from nmfd.controllers import training  # not before annotations are checked
    from nmfd.controllers.strategy import parse

    def file(name="dpc-pc", *, on=scenario, seed=0, out=tmp_path / "p.pt", **how):
        return training.train(on, parse(name), seed=seed, out=out, **how)

    return file


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No check of annotations: for tests of what users are told who give something of a wrong
    type."""
    monkeypatch.setattr(config, "jaxtyping_disable", True)


@pytest.fixture(scope="module")
def city(scenario):
    """The streets of the scenario of the module."""
    from cosim.sumo.net import city_of  # not before annotations are checked

    return city_of(scenario.network)
