"""Compare the link model with SUMO on finished runs: total time spent, lock or not.

    python scenarios/grid7_peak/links.py runs/links

The folder has SUMO results, *.nc, of controllers in a city with words such as +max-pressure, or of
a constant rate of metering: cosim.run("grid7_peak", metered(network, 0.5), city="metering"). The
link model has the routes of the trips of the same seed, and three draws of where vehicles turn.
"""

from pathlib import Path

import click
import numpy as np
import pandas as pd

import nmfd
from cosim.evaluation.link_fit import locks, repeated, strategy_in_links
from cosim.evaluation.links import link_network
from nmfd.api import loaded
from nmfd.controllers.rules import Constant
from nmfd.controllers.strategy import parse

SEEDS = (0, 1, 2)  # of the link model
RATE = "rate-"  # how the name of a constant rate of metering begins


def metered(network: nmfd.RegionalModel, rate: float) -> nmfd.Controller:
    """Return open gates, and a constant rate of metering.

    rate: in each region (veh/s)
    """
    metering = np.full(network.regions, rate)
    controls = nmfd.Controls(perimeter=network.open_perimeter, metering=metering)
    return Constant(f"{RATE}{rate:g}", controls)


def in_links(run: nmfd.Result) -> list[nmfd.Result]:
    """Return runs of the link model with the same demand, trips and controls."""
    scenario = nmfd.load_scenario(run.data.attrs["scenario"])
    scenario = loaded(scenario, demand=run.data.attrs["demand"])
    network = link_network(scenario, [run.seed])
    name = run.controller.partition("+")[0]
    if name.startswith(RATE):
        rate = float(name.removeprefix(RATE))
        strategy = parse(metered(scenario.network, rate))
    else:
        strategy = strategy_in_links(run.controller)
    return repeated(scenario, strategy, network, None, SEEDS)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
def main(folder: Path) -> None:
    """Print a row for each run, and write them to links.csv in the folder."""
    rows = []
    for file in sorted(folder.rglob("[!.]*.nc")):
        run = nmfd.Result.read(file)
        links = in_links(run)
        spent = np.mean([one.total_time_spent for one in links])
        rows.append(
            {
                "city": run.data.attrs["scenario"],
                "control": run.controller,
                "demand": run.data.attrs["demand"],
                "seed": run.seed,
                "SUMO": run.total_time_spent / 1e6,
                "SUMO locks": locks(run),
                "links": spent / 1e6,
                "links lock": np.mean([locks(one) for one in links]),
                "difference %": 100 * (spent / run.total_time_spent - 1),
            }
        )
        click.echo(rows[-1])
    table = pd.DataFrame(rows).round(3)
    table.to_csv(folder / "links.csv", index=False)
    click.echo(table.to_markdown(index=False))


if __name__ == "__main__":
    main()
