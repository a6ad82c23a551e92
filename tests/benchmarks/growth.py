"""How time and memory of a run grow with the city, from 10,000 to 200,000 vehicles.

    python tests/benchmarks/growth.py [--vehicles 10000,20000,50000,100000,200000] [--out growth]

Every city is a square grid of streets, BLOCK m apart, with signals at the inner junctions, and so large that
VEHICLES_PER_EDGE set out in the hour: a larger city, not a fuller one. Trips lead REACH m away at most, as they do in a
city of any size. `cosim import` cuts it into regions by k-means, and SUMO's mesoscopic model runs it without control
and with guidance by travel times, each in a process of its own; processor times, for it may be a busy machine.

    growth.csv    a row per city and controller, written as soon as it is known
    growth.png    time and memory over vehicles, logarithmic, with lines of slope one
"""

import argparse
import multiprocessing
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import sumo
import sumolib
from scipy.spatial import cKDTree

from cosim.evaluation.simulate import Task, simulate
from cosim.importing.importer import import_city
from nmfd.runs.files import write_table
from nmfd.studies import plots

BLOCK, REACH = 150.0, 3000.0  # m
VEHICLES_PER_EDGE, HOUR = 12.0, 3600.0
REGIONS = 6
CONTROLLERS = ("no-control", "route-guidance")


def streets(side: int, file: Path) -> None:
    """A grid of side x side junctions."""
    _sumo(
        "netgenerate",
        "--grid",
        "--grid.number",
        str(side),
        "--grid.length",
        str(BLOCK),
        "--default.lanenumber",
        "2",
        "--tls.guess",
        "--tls.guess.threshold",
        "100",
        "--no-turnarounds",
        "-o",
        file,
    )


def _sumo(program: str, *arguments: str | Path) -> None:
    subprocess.run(
        [Path(sumo.SUMO_HOME) / "bin" / program, *arguments],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def vehicles(net: Path, count: int, file: Path, seed: int = 0) -> None:
    """Ends at random, not further apart than REACH, all over the hour, and the fastest ways at free flow: with SUMO
    searching for them when they depart, cities of 40,000 vehicles spend nine tenths of their time on it."""
    random = np.random.default_rng(seed)
    edges = sumolib.net.readNet(str(net)).getEdges()
    names = [edge.getID() for edge in edges]
    middle = np.array([np.mean(edge.getShape(), axis=0)[:2] for edge in edges])
    origin = random.integers(len(edges), size=count)
    angle, distance = random.uniform(0.0, 2.0 * np.pi, count), random.uniform(4.0 * BLOCK, REACH, count)
    there = middle[origin] + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    _, destination = cKDTree(middle).query(np.clip(there, middle.min(axis=0), middle.max(axis=0)))
    departs = np.sort(random.uniform(0.0, HOUR, count))
    trips = file.with_name("trips.xml")
    trips.write_text(
        "<routes>\n"
        + "".join(
            f'<trip id="{n}" depart="{depart:.1f}" from="{names[a]}" to="{names[b]}"/>\n'
            for n, (depart, a, b) in enumerate(zip(departs, origin, destination, strict=True))
            if a != b
        )
        + "</routes>\n"
    )
    _sumo("duarouter", "-n", net, "-r", trips, "--routing-algorithm", "astar", "-o", file)


def _import(folder: str) -> None:
    """In a process of its own."""
    at = Path(folder)
    import_city(
        at / "net.net.xml",
        at / "networks" / "grid",
        at / "scenarios" / "grid",
        routes=(at / "city.rou.xml",),
        mesoscopic=True,
        regions=REGIONS,
        seeds=1,
    )


def _run(folder: str, controller: str) -> dict:
    """One run, in a process of its own; processor time [s], memory [GB], and what `simulate` measured."""
    begin = time.process_time()
    facts = simulate(Task(scenario=Path(folder) / "scenarios" / "grid", controller=controller, seed=0)).data.attrs
    return {
        "cpu_s": time.process_time() - begin,
        "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "wall_s": facts["wall_time_s"],
        "setup_s": facts["setup_time_s"],
        "outside_sumo_share": facts["overhead_share"],
        "trips": facts["trips"],
        "mean_trip_time_s": facts["mean_trip_time_s"],
        "teleports": facts["teleports"],
    }


def measured(count: int) -> list[dict]:
    """A row per controller of a city of so many vehicles."""
    edges = count / VEHICLES_PER_EDGE
    side = round(0.5 * (1.0 + (1.0 + edges) ** 0.5))  # a grid has 4 side (side - 1) edges
    with tempfile.TemporaryDirectory() as folder:
        net = Path(folder) / "net.net.xml"
        streets(side, net)
        vehicles(net, count, Path(folder) / "city.rou.xml")
        fresh = multiprocessing.get_context("spawn")
        rows = []
        with fresh.Pool(1, maxtasksperchild=1) as pool:
            begin = time.perf_counter()
            pool.apply(_import, (folder,))
            imported = time.perf_counter() - begin
            for controller in CONTROLLERS:
                found = pool.apply(_run, (folder, controller))
                rows.append(
                    {
                        "vehicles": count,
                        "edges": 4 * side * (side - 1),
                        "controller": controller,
                        **found,
                        "import_wall_s": imported,
                    }
                )
                print(rows[-1], flush=True)
    return rows


def draw(file: Path, table: pd.DataFrame) -> None:
    """Time and memory over vehicles."""
    drawing, axes = plots.panels(2)
    labels = {"cpu_s": "processor time [s]", "memory_gb": "memory [GB]"}
    for axis, (column, label) in zip(axes, labels.items(), strict=True):
        for name, rows in table.groupby("controller", sort=False):
            axis.loglog(rows["trips"], rows[column], "o-", label=name, color=plots.colour(str(name)))
            ends = np.array([rows["trips"].min(), rows["trips"].max()])
            axis.loglog(ends, rows[column].iloc[0] * ends / ends[0], ":", color="0.5", label="in proportion")
        axis.set(xlabel="vehicles", ylabel=label)
    plots.legend_below(drawing, axes)
    plots.save(drawing, file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", default="10000,20000,50000,100000,200000")
    parser.add_argument("--out", type=Path, default=Path("growth"), help="a folder")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    for count in map(int, chosen.vehicles.split(",")):
        rows += measured(count)
        write_table(chosen.out / "growth.csv", pd.DataFrame(rows))
    draw(chosen.out / "growth.png", pd.DataFrame(rows))


if __name__ == "__main__":
    main()
