r"""Time of a decision and peak memory against the number of regions; write scaling.csv and
scaling.png.

    python scenarios/large_grids/scaling.py --family hexagonal --load congested \
        --regions 7,19,37 --out runs/scaling

As in Tumu et al.: random MFDs and initial states, no demand, untrained policies. Each case runs in
its own process.
"""

import argparse
import multiprocessing
import resource  # noqa: TID251 (this study runs on POSIX only)
import statistics
import time
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pebble import ProcessPool

import nmfd
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.controllers.mpc import edge_model
from nmfd.controllers.mpc.controller import EconomicMpc
from nmfd.model.mfd import Cubic
from nmfd.model.regional_model import RegionalModel
from nmfd.studies import plots
from nmfd.tensors import one_thread

BENCHMARK = 4.133e-11, -8.282e-7, 0.0042, 10_000.0  # a, b, c, jam
SPREAD = 0.2  # each region's speed and size is drawn from 1 +- SPREAD times the benchmark's
STEP_S, STEPS, TIME_LIMIT_S = 30.0, 10, 600.0
GUIDES = {
    "dpc-pc": False,
    "dpc-pcrg": True,
    "mpc-pc": False,
    "mpc-pcrg": True,
    "dpc-pc-local": False,
}  # by controller


def lattice(regions: int) -> np.ndarray:
    """Return (R, 2): the points of a triangular lattice nearest to one of them [lattice
    spacings]."""
    reach = np.arange(-int(regions**0.5) - 2, int(regions**0.5) + 3)
    column, row = (axis.ravel() for axis in np.meshgrid(reach, reach))
    points = np.stack([column + 0.5 * row, 0.75**0.5 * row], axis=1)
    around = np.round(np.arctan2(points[:, 1], points[:, 0]), 6)
    return points[np.lexsort((around, np.round((points**2).sum(axis=1), 6)))[:regions]]


def network(family: str, regions: int, seed: int = 0) -> RegionalModel:
    """Return a network with random MFDs, "complete" or "hexagonal"."""
    random, where = np.random.default_rng([seed, regions]), lattice(regions)
    near = np.linalg.norm(where[:, None] - where, axis=2) < (
        np.inf if family == "complete" else 1.1
    )
    (a, b, c, jam), factors = BENCHMARK, random.uniform(1.0 - SPREAD, 1.0 + SPREAD, (regions, 2))
    return RegionalModel(
        name=f"{family}-{regions}",
        region_names=tuple(map(str, range(regions))),
        positions=where,
        adjacency=near & ~np.eye(regions, dtype=bool),
        mfds=tuple(Cubic(a=a * v / n**2, b=b * v / n, c=c * v, jam=jam * n) for v, n in factors),
        u_min=0.1,
        u_max=0.9,
    )


def initial_state(network: RegionalModel, load: str, seed: int = 0) -> np.ndarray:
    """Return (R, R) [veh]: each x_ij from [0, 100), as published, or regions from empty to 20 %
    above their jam."""
    random = np.random.default_rng([seed, network.regions, 1])
    x = random.uniform(0.0, 100.0, (network.regions, network.regions))
    filled = random.uniform(0.0, 1.2, network.regions) * [mfd.jam for mfd in network.mfds]
    return x if load == "published" else x * (filled / x.sum(axis=1))[:, None]


@one_thread()
def measure(family: str, load: str, regions: int, name: str) -> dict:
    """Return the row of one controller on one network, measured on one thread."""
    begin, city = time.perf_counter(), network(family, regions)
    forecast = np.zeros((STEPS, regions, regions))
    planning = nmfd.PlanningModel(
        name=city.name, network=city, step=STEP_S, steps=STEPS, forecast=forecast
    )
    torch.manual_seed(0)
    small, sparse = (
        Architecture(width=32, local=True),
        Architecture(guidance=GUIDES[name], sparse=True),
    )
    if name.startswith("mpc"):
        controller = EconomicMpc(guidance=GUIDES[name]).make(planning)
    else:
        controller = DpcController(Policy(city, small if name.endswith("local") else sparse))
    controller.reset()
    row = dict(
        family=family,
        load=load,
        regions=regions,
        controller=name,
        set_up_s=time.perf_counter() - begin,
    )
    model = edge_model.build(city, np.arange(regions), guidance=True, step=STEP_S)
    x = initial_state(city, load)
    times, unsolved = [], 0
    for k in range(STEPS):
        seen, begin = (
            nmfd.Observation(step=k, time=STEP_S * k, accumulation=x, backlog=0.0 * x),
            time.process_time(),
        )
        controls = controller.act(seen)
        times.append(time.process_time() - begin)
        unsolved += controls.status != nmfd.Status.OK
        theta = city.nominal_splits if controls.splits is None else controls.splits
        flows = controls.perimeter[tuple(model.edges.T)], theta[tuple(model.turns.T)]
        x = edge_model.advance(model, x.ravel(), np.zeros(x.size), *flows)[0].reshape(x.shape)
    row |= dict(
        first_s=times[0],
        median_s=statistics.median(times[1:]),
        longest_s=max(times[1:]),
        unsolved=unsolved,
    )
    return row | dict(
        peak_memory_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10, failure=""
    )


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draw the time of a decision and the memory against the number of regions."""
    figure, axes = plots.panels(2)
    for ax, column, label in zip(
        axes, ("median_s", "peak_memory_mib"), ("decision [s]", "memory [MiB]"), strict=True
    ):
        for name, rows in table.groupby("controller", sort=False):
            ax.loglog(rows["regions"], rows[column], "o-", color=plots.COLOURS[name], label=name)
        ax.set(xlabel="regions", ylabel=label)
    plots.legend_below(figure, axes)
    plots.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--regions", default="2,4,8,16,32,64")
    parser.add_argument(
        "--controllers", default="dpc-pc,dpc-pcrg,mpc-pc,mpc-pcrg", help=", ".join(GUIDES)
    )
    parser.add_argument("--family", choices=["complete", "hexagonal"], default="complete")
    parser.add_argument("--load", choices=["published", "congested"], default="published")
    parser.add_argument("--out", type=Path, default=Path("runs/scaling"))
    o, table = parser.parse_args(), pd.DataFrame()
    o.out.mkdir(parents=True, exist_ok=True)
    with ProcessPool(
        max_workers=1, max_tasks=1, context=multiprocessing.get_context("spawn")
    ) as pool:
        for case in product(
            [o.family], [o.load], map(int, o.regions.split(",")), o.controllers.split(",")
        ):
            try:
                row = pool.schedule(measure, args=case, timeout=TIME_LIMIT_S).result()
            except Exception as error:  # time limit, memory or crash: a row says so
                row = dict(
                    family=o.family,
                    load=o.load,
                    regions=case[2],
                    controller=case[3],
                    failure=repr(error),
                )
            table = pd.concat([table, pd.DataFrame([row])], ignore_index=True)
            table.to_csv(o.out / "scaling.csv", index=False)
    draw(table, o.out / "scaling.png")
    print(table.to_string(index=False))
