"""How far ahead region accumulations can be predicted at all: SUMO against itself.

    python tests/benchmarks/predictability.py [--demand 1.0] [--seed 2000] [--every 900] [--branches 6]

A run without control is saved at several times, and continued from each of them several times with other random
numbers (dawdling, desired speeds, places of departure) and the same trips and signals. How far apart the accumulations
then are is what no model can foresee, not even one that knows every vehicle. Compare it with the prediction errors that
`cosim identify` prints: standard deviation between continuations, as a share of the critical accumulation.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import sumo

from cosim.sumo.build import ensure_built
from cosim.sumo.net import City, load_city
from cosim.sumo.trips import write_trips
from nmfd.api import load_scenario

SCENARIO = Path(__file__).parents[2] / "scenarios" / "grid7_peak"
AHEAD = (90, 900)  # s


def simulate(folder: Path, *options: str) -> None:
    """The bare sumo binary on city and trips of `folder`."""
    subprocess.run(
        [
            Path(sumo.SUMO_HOME) / "bin" / "sumo",
            "--net-file",
            "net.xml",
            "--route-files",
            "trips.rou.xml",
            "--time-to-teleport",
            "-1",
            "--no-step-log",
            "true",
            "--no-warnings",
            "true",
            *options,
        ],
        check=True,
        cwd=folder,
    )


def accumulations(folder: Path, city: City, begin: int, seed: int) -> np.ndarray:
    """(len(AHEAD), R) [veh] after continuing from the state saved at `begin` [s]; on normal edges."""
    outputs = [f'<edgeData id="{a}" file="edges-{a}.xml" begin="{begin + a - 1}" end="{begin + a}"/>' for a in AHEAD]
    (folder / "edges.add.xml").write_text("<additional>" + "".join(outputs) + "</additional>")
    simulate(
        folder,
        "--load-state",
        f"state_{begin}.00.xml.gz",
        "--seed",
        str(seed),
        "--end",
        str(begin + AHEAD[-1]),
        "--additional-files",
        "edges.add.xml",
    )
    counts = np.zeros((len(AHEAD), city.regions))
    for n, ahead in enumerate(AHEAD):
        for edge in ElementTree.parse(folder / f"edges-{ahead}.xml").iter("edge"):
            if edge.get("id") in city.region_of:
                counts[n, city.region_of[edge.get("id")]] += float(edge.get("sampledSeconds"))
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demand", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=2000)
    parser.add_argument("--every", type=int, default=900, help="s between saved states")
    parser.add_argument("--branches", type=int, default=6)
    chosen = parser.parse_args()
    scenario = load_scenario(SCENARIO)
    files = ensure_built(scenario.network)
    city = load_city(files.net_file, files.regions_csv, scenario.network.regions)
    critical = np.array([mfd.critical for mfd in scenario.network.mfds])
    begins = range(chosen.every, round(scenario.step * scenario.steps) - AHEAD[-1] + 1, chosen.every)
    print(
        f"{'saved at':>10}{'vehicles':>10}"
        + "".join(f"{f'{ahead} s ahead':>15}" for ahead in AHEAD)
        + f"   demand {chosen.demand:g}, seed {chosen.seed}, {chosen.branches} continuations, mean over regions"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "net.xml").symlink_to(files.net_file.resolve())
        write_trips(city, chosen.demand * scenario.demand, scenario.step, chosen.seed, folder / "trips.rou.xml")
        simulate(
            folder,
            "--seed",
            str(chosen.seed),
            "--end",
            str(begins[-1] + 1),
            "--save-state.times",
            ",".join(map(str, begins)),
            "--save-state.prefix",
            "state",
            "--save-state.suffix",
            ".xml.gz",
        )
        variance = []
        for begin in begins:
            counts = np.array([accumulations(folder, city, begin, seed) for seed in range(1, chosen.branches + 1)])
            variance.append(counts.var(axis=0, ddof=1))
            share = (np.sqrt(variance[-1]) / critical).mean(axis=1)
            print(
                f"{begin:>9}s{counts[:, 0].sum(axis=1).mean():>10.0f}"
                + "".join(f"{100 * part:>13.1f} %" for part in share),
                flush=True,
            )
    overall = np.sqrt(np.mean(variance, axis=0)) / critical
    for region, shares in enumerate(overall.T):
        print(f"{f'region {region}':>20}" + "".join(f"{100 * part:>13.1f} %" for part in shares))
    print(f"{'mean of the regions':>20}" + "".join(f"{100 * part:>13.1f} %" for part in overall.mean(axis=1)))


if __name__ == "__main__":
    main()
