"""Compare the link model and the regional model with SUMO: total time spent, lock or not.

    python scenarios/grid7_peak/links.py runs/links --again scenarios/grid7_peak/reference/links.csv

The folder has SUMO results, *.nc, of controllers in a city with words such as +max-pressure, or of
a constant rate of metering: cosim.run("grid7_peak", metered(network, 0.5), city="metering"). The
link model has the routes of the trips of the same seed, and ten draws of where vehicles turn. The
regional model is the one that controllers with these words are planned with.
"""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pandas as pd

import nmfd
from cosim.evaluation.link_fit import locks, repeated, strategy_in_links
from cosim.evaluation.links import link_network
from cosim.plant.strategy import parse as parse_in_sumo
from nmfd import closed_loop
from nmfd.api import loaded
from nmfd.controllers.rules import Constant
from nmfd.controllers.strategy import parse

SEEDS = tuple(range(10))  # of the link model
RATE = "rate-"  # how the name of a constant rate of metering begins
KEY = ["city", "control", "demand", "seed"]
COLUMNS = [*KEY, "SUMO", "SUMO locks"]


def metered(network: nmfd.RegionalModel, rate: float) -> nmfd.Controller:
    """Return open gates, and a constant rate of metering.

    rate: in each region (veh/s)
    """
    metering = np.full(network.regions, rate)
    controls = nmfd.Controls(perimeter=network.open_perimeter, metering=metering)
    return Constant(f"{RATE}{rate:g}", controls)


def left_share(run: nmfd.Result) -> float:
    """Return the share of the trips that are not finished at the end."""
    left = float((run["accumulation"][-1] + run["backlog"][-1]).sum())
    return left / (left + run.completed_trips)


def in_links(scenario: nmfd.Scenario, control: str, seed: int) -> list[nmfd.Result]:
    """Return runs of the link model with the trips of a seed."""
    if control.startswith(RATE):
        strategy = parse(_rated(scenario, control))
    else:
        strategy = strategy_in_links(control)
    return repeated(scenario, strategy, link_network(scenario, [seed]), None, SEEDS)


def in_regions(scenario: nmfd.Scenario, control: str) -> nmfd.Result:
    """Return the run of the regional model."""
    rated = control.startswith(RATE)
    strategy = parse_in_sumo(_rated(scenario, control) if rated else control)
    believed = replace(scenario, network=strategy.planning(scenario).network)
    controller = strategy.make(scenario, None)
    return closed_loop.run(nmfd.NmfdPlant(believed), controller, believed, seed=0)


def _rated(scenario: nmfd.Scenario, control: str) -> nmfd.Controller:
    """Return the controller of a name such as rate-0.5+metering."""
    rate = control.partition("+")[0].removeprefix(RATE)
    return metered(scenario.network, float(rate))


def curve_area(score: pd.Series, locked: pd.Series) -> float:
    """Return how often a run that locks has a higher score than one that flows.

    Equal scores count half: the area under the receiver operating characteristic.
    """
    yes = score[locked].to_numpy()[:, None]
    no = score[~locked].to_numpy()
    return float(np.mean((yes > no) + 0.5 * (yes == no)))


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--again", type=click.Path(path_type=Path, exists=True), help="Table whose runs come first."
)
def main(folder: Path, again: Path | None) -> None:
    """Print a row for each run, and write them to links.csv in the folder."""
    known = [] if again is None else [pd.read_csv(again)[COLUMNS]]
    rows = []
    for file in sorted(folder.rglob("[!.]*.nc")):
        run = nmfd.Result.read(file)
        about = (run.data.attrs["scenario"], run.controller, run.data.attrs["demand"], run.seed)
        rows.append((*about, run.total_time_spent / 1e6, locks(run)))
    new = pd.DataFrame(rows, columns=COLUMNS)
    table = pd.concat([*known, new], ignore_index=True).drop_duplicates(KEY)
    table = table.sort_values(KEY, ignore_index=True).astype({"SUMO locks": bool})
    seen = []
    for row in table.to_dict("records"):
        scenario = loaded(nmfd.load_scenario(row["city"]), demand=row["demand"])
        links = in_links(scenario, row["control"], row["seed"])
        regions = in_regions(scenario, row["control"])
        spent = np.mean([one.total_time_spent for one in links]) / 1e6
        seen.append(
            {
                "links": spent,
                "links lock": np.mean([locks(one) for one in links]),
                "links left": np.mean([left_share(one) for one in links]),
                "difference %": 100 * (spent / row["SUMO"] - 1),
                "regions": regions.total_time_spent / 1e6,
                "regions left": left_share(regions),
            }
        )
        click.echo(row | seen[-1])
    table = pd.concat([table, pd.DataFrame(seen)], axis=1).round(3)
    table.to_csv(folder / "links.csv", index=False)
    click.echo(table.to_markdown(index=False))
    flowing = table.loc[~table["SUMO locks"] & (table["links lock"] < 0.5), "difference %"].abs()
    click.echo(
        f"{len(flowing)} runs flow in both: {flowing.median():.1f} % off in the median, "
        f"{flowing.max():.1f} % at most; area under the curve of {len(table)} runs:"
    )
    for name in ("links lock", "links left", "regions left"):
        click.echo(f"{name} {curve_area(table[name], table['SUMO locks']):.3f}")


if __name__ == "__main__":
    main()
