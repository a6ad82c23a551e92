"""Compare the link model and the regional model with SUMO: total time spent, lock or not.

    python scenarios/grid7_peak/links.py runs/links --again scenarios/grid7_peak/reference/links.csv

The folder has SUMO results, *.nc, of controllers in a city with words such as +max-pressure, or of
a constant rate of metering: cosim.run("grid7_peak", metered(network, 0.5), city="metering"). The
link model has the routes of the trips of the same seed, and ten draws of where vehicles turn. The
regional model is the one that controllers with these words are planned with. Beside them stands
what SUMO takes with other seeds.
"""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pandas as pd
from sklearn.metrics import roc_auc_score

import nmfd
from cosim.evaluation.link_fit import left_share, locks, repeated, strategy_in_links
from cosim.evaluation.links import link_network
from cosim.plant.strategy import parse
from nmfd import closed_loop
from nmfd.api import loaded
from nmfd.controllers.rules import Constant

SEEDS = tuple(range(10))  # of the link model
RATE = "rate-"  # how the name of a constant rate of metering begins
KEY = ["city", "control", "demand", "seed"]
COLUMNS = [*KEY, "SUMO", "SUMO locks"]
WITHIN = 10.0  # % of the total time in SUMO


def metered(network: nmfd.RegionalModel, rate: float) -> nmfd.Controller:
    """Return open gates, and a constant rate of metering.

    rate: in each region (veh/s)
    """
    metering = np.full(network.regions, rate)
    controls = nmfd.Controls(perimeter=network.open_perimeter, metering=metering)
    return Constant(f"{RATE}{rate:g}", controls)


def controller_of(scenario: nmfd.Scenario, control: str) -> nmfd.Controller | str:
    """Return the controller of a name such as rate-0.5+metering; other names as they are."""
    if not control.startswith(RATE):
        return control
    rate = control.partition("+")[0].removeprefix(RATE)
    return metered(scenario.network, float(rate))


def in_links(scenario: nmfd.Scenario, control: str, seed: int) -> list[nmfd.Result]:
    """Return runs of the link model with the trips of a seed."""
    strategy = strategy_in_links(controller_of(scenario, control))
    return repeated(scenario, strategy, link_network(scenario, [seed]), None, SEEDS)


def in_regions(scenario: nmfd.Scenario, control: str) -> nmfd.Result:
    """Return the run of the regional model."""
    strategy = parse(controller_of(scenario, control))
    believed = replace(scenario, network=strategy.planning(scenario).network)
    controller = strategy.make(scenario, None)
    return closed_loop.run(nmfd.NmfdPlant(believed), controller, believed, seed=0)


def in_sumo(folder: Path, again: Path | None) -> pd.DataFrame:
    """Return COLUMNS of the runs in a folder, and of those in an earlier table."""
    rows = []
    for file in sorted(folder.rglob("[!.]*.nc")):
        run = nmfd.Result.read(file)
        about = (run.data.attrs["scenario"], run.controller, run.data.attrs["demand"], run.seed)
        rows.append((*about, run.total_time_spent / 1e6, locks(run)))
    tables = [pd.DataFrame(rows, columns=COLUMNS)]
    if again is not None:
        tables.insert(0, pd.read_csv(again)[COLUMNS])
    table = pd.concat(tables, ignore_index=True).drop_duplicates(KEY)
    return table.sort_values(KEY, ignore_index=True).astype({"SUMO": float, "SUMO locks": bool})


def by_other_seeds(table: pd.DataFrame) -> pd.Series:
    """Return how far off (%) the mean of SUMO's runs with other seeds is, NaN without any."""
    runs = table.groupby(KEY[:-1])["SUMO"]
    others = (runs.transform("sum") - table["SUMO"]) / (runs.transform("count") - 1)
    return 100 * (others / table["SUMO"] - 1)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--again", type=click.Path(path_type=Path, exists=True), help="Table whose runs come first."
)
def main(folder: Path, again: Path | None) -> None:
    """Print a row for each run, and write them to links.csv in the folder."""
    table = in_sumo(folder, again)
    seen = []
    for row in table.to_dict("records"):
        scenario = loaded(nmfd.load_scenario(row["city"]), demand=row["demand"])
        links = in_links(scenario, row["control"], row["seed"])
        regions = in_regions(scenario, row["control"])
        spent = np.array([one.total_time_spent for one in links]) / 1e6
        lock = np.array([locks(one) for one in links])
        both_flow = not row["SUMO locks"] and not lock.all()
        flowing = spent[~lock].mean() if both_flow else np.nan
        seen.append(
            {
                "links": spent.mean(),
                "links lock": lock.mean(),
                "links left": np.mean([left_share(one) for one in links]),
                "difference %": 100 * (spent.mean() / row["SUMO"] - 1),
                "flowing %": 100 * (flowing / row["SUMO"] - 1),
                "regions": regions.total_time_spent / 1e6,
                "regions left": left_share(regions),
            }
        )
        click.echo(row | seen[-1])
    table = pd.concat([table, pd.DataFrame(seen)], axis=1)
    table["other seeds %"] = by_other_seeds(table)
    table = table.round(3)
    table.to_csv(folder / "links.csv", index=False)
    click.echo(table.to_markdown(index=False))
    flowing_runs = table[~table["SUMO locks"]]
    with_other_seeds = flowing_runs.dropna(subset="other seeds %")
    for rows, name, what in (
        (flowing_runs, "difference %", "all draws"),
        (flowing_runs, "flowing %", "draws that flow"),
        (with_other_seeds, "difference %", "all draws, where SUMO has other seeds"),
        (with_other_seeds, "other seeds %", "SUMO with other seeds"),
    ):
        off = rows[name].abs()
        click.echo(
            f"{len(off)} runs flow in SUMO: {off.median():.1f} % off in the median, "
            f"{(off <= WITHIN).sum()} within {WITHIN:g} % ({what})"
        )
    click.echo(f"area under the curve of {len(table)} runs:")
    for name in ("links lock", "links left", "regions left"):
        area = roc_auc_score(table["SUMO locks"], table[name])
        click.echo(f"{name} {area:.3f}")


if __name__ == "__main__":
    main()
