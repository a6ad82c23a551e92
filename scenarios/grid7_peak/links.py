"""Compare the link model with SUMO on finished runs: total time spent, lock or not.

    python scenarios/grid7_peak/links.py runs/links

The folder has SUMO results, *.nc, with open gates in a city with words such as +max-pressure, or
with a constant rate of metering: cosim.run("grid7_peak", Rate(network, 0.5), city="metering"). The
link model has the routes of the trips of the same seed. No number is fitted.
"""

from pathlib import Path

import click
import numpy as np
import pandas as pd

import nmfd
from cosim.evaluation.links import link_network
from nmfd import closed_loop
from nmfd.api import loaded

LOCKED = 0.05  # share of the trips that are not finished at the end


class Rate:
    """Open gates, and a constant rate of metering."""

    def __init__(self, network: nmfd.RegionalModel, rate: float):
        """rate: veh/s in each region"""
        self.name = f"rate-{rate:g}"
        self._open = network.u_max * network.adjacency
        self._rate = np.full(network.regions, rate)

    def reset(self, seed: int = 0) -> None:
        """Do nothing."""

    def act(self, observation: nmfd.Observation) -> nmfd.Controls:
        """Return the constant command."""
        return nmfd.Controls(perimeter=self._open, metering=self._rate)


def in_links(run: nmfd.Result) -> nmfd.Result:
    """Return the run of the link model with the same demand, seed and controls."""
    name, *words = run.controller.split("+")
    city = {
        "sumo.guided": "guided" in words,
        "sumo.signals": "max-pressure" if "max-pressure" in words else "fixed",
    }
    scenario = nmfd.load_scenario(run.data.attrs["scenario"], city)
    scenario = loaded(scenario, demand=run.data.attrs["demand"])
    network = link_network(scenario, [run.seed])
    controller = nmfd.controller("no-control", scenario)
    if name.startswith("rate-"):
        controller = Rate(scenario.network, float(name.removeprefix("rate-")))
    plant = nmfd.LinkPlant(scenario, network=network)
    return closed_loop.run(plant, controller, scenario, seed=0)


def locks(run: nmfd.Result) -> bool:
    """Return True if many trips are not finished at the end."""
    left = float(run.accumulation[-1].sum() + run.backlog[-1].sum())
    return left > LOCKED * (left + run.completed_trips)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
def main(folder: Path) -> None:
    """Print a row for each run."""
    rows = []
    for file in sorted(folder.rglob("[!.]*.nc")):
        run = nmfd.Result.read(file)
        links = in_links(run)
        rows.append(
            {
                "city": run.data.attrs["scenario"],
                "control": run.controller,
                "demand": run.data.attrs["demand"],
                "seed": run.seed,
                "SUMO": run.total_time_spent / 1e6,
                "SUMO locks": locks(run),
                "links": links.total_time_spent / 1e6,
                "links lock": locks(links),
                "difference %": 100 * (links.total_time_spent / run.total_time_spent - 1),
            }
        )
        click.echo(rows[-1])
    click.echo(pd.DataFrame(rows).round(2).to_markdown(index=False))


if __name__ == "__main__":
    main()
