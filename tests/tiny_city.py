"""A small SUMO city with everything that a real one brings: buses, flows, zones, persons, several
files."""

import gzip
import shutil
import subprocess
from atexit import register
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from types import SimpleNamespace
from xml.etree.ElementTree import parse

import numpy as np
import sumo
from commands import words
from scipy.sparse.csgraph import connected_components
from tiny import gates_at

from cosim.importing.case import read_sumo_input
from cosim.importing.demand import Traffic, read_traffic
from cosim.importing.importer import import_city
from cosim.importing.streets import Streets, graph, read_streets
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from nmfd.model.scenario import Scenario, with_demand

CONFIG = """<configuration>
  <input><net-file value="city.net.xml"/><route-files value="cars.rou.xml.gz,buses.rou.xml"/>
  <additional-files value="city.add.xml"/></input>
  <time><begin value="0:10:00"/><end value="1500"/></time>
</configuration>"""
ADDITIONAL = """<additional>
  <vType id="lorry" vClass="truck" length="9"/><vType id="citybus" vClass="bus"/>
  <vTypeDistribution id="mixed"><vType id="small" vClass="passenger" probability="0.7"/>
    <vType id="large" vClass="delivery" probability="0.3"/></vTypeDistribution>
  <route id="loop" edges="A0A1 A1B1 B1B0 B0A0 A0A1"/>
  <busStop id="stop" lane="B1C1_0" startPos="20" endPos="40"/>
  <inductionLoop id="loop" lane="A0A1_0" pos="5" freq="60" file="counts.xml"/>
  <edgeData id="all" file="edges.xml"/>
</additional>"""
CARS = """<routes>
  <trip id="early" depart="5" from="A0A1" to="D1D2"/>
  <flow id="zones" begin="600" end="1200" number="30" from="A0A1" to="D1D2"/>
  <flow id="across" begin="600" end="1200" period="8" from="A1B1" to="C1D1" type="mixed"/>
  <flow id="back" begin="600" end="1200" vehsPerHour="360" from="D2C2" to="B2A2"/>
  <flow id="chance" begin="600" end="1200" probability="0.1" from="B3C3" to="C0B0"/>
  <flow id="down" begin="600" end="1200" period="exp(0.1)" from="C3C2" to="C1C0"/>
  <vehicle id="round" depart="610" type="mixed" route="loop"/>
  <vehicle id="stops" depart="612" type="lorry"><route edges="A1B1 B1C1 C1D1"/>
    <stop lane="B1C1_0" endPos="60" duration="20"/></vehicle>
  <trip id="astray" depart="620" from="A0A1" to="nowhere"/>
  <vehicle id="gap" depart="620"><route edges="A0A1 D1D2"/></vehicle>
  <trip id="short" depart="0:10:30" from="B1C1" to="B1C1"/>
</routes>"""
BUSES = """<routes>
  <flow id="line2" type="citybus" begin="600" end="1200" period="200" from="A2B2" to="C2D2"/>
  <vehicle id="bus" type="citybus" line="1" depart="605"><route edges="A1B1 B1C1 C1D1 D1D2"/>
    <stop busStop="stop" duration="15"/></vehicle>
  <person id="walker" depart="615"><walk edges="B1C1 C1D1"/></person>
</routes>"""


def run(program: str, *arguments) -> None:
    done = subprocess.run(
        words(Path(sumo.SUMO_HOME) / "bin" / program, *arguments),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def network(folder: Path, *options: str, name: str = "city.net.xml") -> Path:
    """A grid of 4 x 4 junctions A0 to D3, 200 m apart, with signals at all inner ones unless told
    otherwise."""
    (folder / name).write_bytes(_grid(options or ("--tls.set B1,B2,C1,C2,B3,C0",)))
    return folder / name


@cache
def _grid(options: tuple[str, ...]) -> bytes:
    grid = "--grid --grid.number 4 --grid.length 200 --default.lanenumber 2"
    usual = "--no-turnarounds true --seed 1 --output-file"
    with TemporaryDirectory() as folder:
        file = Path(folder) / "city.net.xml"
        run("netgenerate", grid, usual, file, *options)
        return file.read_bytes()


def regions(net: Path, region_of: Callable[[str], int]) -> Path:
    """The table of regions of all edges of a network, beside it."""
    edges = [edge.get("id") for edge in parse(net).iterfind("edge") if not edge.get("function")]
    file = net.with_name("regions.csv")
    lines = (f"{edge},{region_of(edge)}\n" for edge in sorted(edges))
    file.write_text("edge,region\n" + "".join(lines))
    return file


def pieces(streets: Streets, members: np.ndarray) -> int:
    """Number of parts into which some edges fall by the connections between them."""
    numbers = np.cumsum(members) - 1
    links = streets.links[members[streets.links].all(axis=1)]
    return int(connected_components(graph(numbers[links], int(members.sum())), directed=False)[0])


def city(folder: Path, *options: str) -> Path:
    """The sumocfg of a city with demand."""
    network(folder, *options)
    (folder / "city.add.xml").write_text(ADDITIONAL)
    (folder / "buses.rou.xml").write_text(BUSES)
    with gzip.open(folder / "cars.rou.xml.gz", "wt") as stream:
        stream.write(CARS)
    (folder / "city.sumocfg").write_text(CONFIG)
    return folder / "city.sumocfg"


def traffic_of(config: Path) -> Traffic:
    """What an import reads of a city's vehicles."""
    case = read_sumo_input(config)
    return read_traffic(case, read_streets(case.net, case.additional), seed=0)


def imported(folder: Path, regions: int = 3, source: Path | None = None, **options) -> Path:
    """Import a city, by default the one with demand, into `folder`; return its scenario."""
    if source is None:
        shutil.copytree(_with_demand(), folder, dirs_exist_ok=True)
    else:
        out = folder / "networks" / "tiny"
        import_city(source, out, _scenario(folder), regions=regions, seeds=1, **options)
    return _scenario(folder)


def _scenario(folder: Path) -> Path:
    return folder / "scenarios" / "tiny"


@cache
def _with_demand() -> Path:
    """The folder of the city with demand, and of what it is imported to, once in a process."""
    folder = Path(mkdtemp())
    register(shutil.rmtree, folder)
    return imported(folder, source=city(folder)).parents[1]


class Record(SimpleNamespace):
    """Arrays of a record, by name and, as those of a Result, by item."""

    def __getitem__(self, name: str) -> np.ndarray:
        return getattr(self, name)


@contextmanager
def plant_of(scenario: Scenario, **overrides) -> Iterator[SumoPlant]:
    """The plant of a scenario with other settings, closed at the end."""
    plant = SumoPlant(scenario, settings=settings(scenario).changed(**overrides))
    try:
        yield plant
    finally:
        plant.close()


@contextmanager
def played(
    scenario: Scenario, intervals: int, gates: float, splits: np.ndarray | None = None, **overrides
) -> Iterator:
    """A plant after so many intervals with all u at `gates`, its state and its record; the ledger
    is checked in every interval."""
    scenario = with_demand(scenario, steps=max(intervals, 1))
    controls = replace(gates_at(scenario, gates), splits=splits)
    with plant_of(scenario, **overrides) as plant:
        states = [plant.reset(0), *(plant.step(controls) for _ in range(intervals))]
        yield plant, states[-1], Record(**plant.record()) if intervals else None


def driven(scenario: Scenario, intervals: int, gates: float, **overrides) -> tuple:
    """(trips due, departures, arrivals, accumulation, backlog) of `played` with nominal split
    ratios."""
    with played(scenario, intervals, gates, scenario.network.nominal_splits, **overrides) as (
        plant,
        state,
        record,
    ):
        due, inside = len(plant.meter.trips()), state.accumulation.sum()
        return due, record.departures.sum(), record.arrivals.sum(), inside, state.backlog.sum()
