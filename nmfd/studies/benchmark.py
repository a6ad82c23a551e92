"""Benchmark of controllers x seeds on a regional plant, and robustness.

The benchmark has a table and the paper's figures.

For robustness every controller is made for the nominal scenario (MPC has its forecast, the policies
their training) and meets another demand, or other MFDs (nmfd.model.scenario.perturbed); its
improvement is over no control in the same perturbed scenario. The acyclic plant alone is no
mismatch: on economic_mpc totals differ from the NMFD by 2e-6.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nmfd import closed_loop, faults
from nmfd.controllers import open_loop
from nmfd.controllers.strategy import Strategy
from nmfd.errors import InputError
from nmfd.metrics import COUNTED, decision_ms, percent_change, summary
from nmfd.model.links.network import LINKS
from nmfd.model.scenario import Scenario, perturbed
from nmfd.runs.files import file_hash, is_newer, run_name
from nmfd.runs.run_many import TABLE
from nmfd.runs.tables import cell, text_columns, text_table
from nmfd.types import Plant, Result

if TYPE_CHECKING:
    import pandas as pd

    from nmfd.model.links.flows import Numbers
    from nmfd.model.links.network import LinkNetwork
    from nmfd.model.links.plant import LinkPlant
    from nmfd.runs.frame import Table

PLANTS = ("nmfd", "acyclic", LINKS)
MODULES = ("nmfd.model.plant", "nmfd.model.links.plant")  # of PLANTS, with torch
REFERENCE = "no-control"
CAPTION = (
    "TTS: total time spent, mean over seeds ± 95 % interval; change: of TTS against {against}; "
    "control: processor time of all decisions of a run; step: first / median / longest decision; "
    "decisions of all seeds: "
) + "; ".join(f"{heading}: {what}" for heading, what in COUNTED.values())
BOUND_CAPTION = (
    "; above the optimum: at most, by the lower bound with the same controls (nmfd bound)"
)
IMPOSSIBLE = "impossible"
IMPOSSIBLE_CAPTION = (
    "; impossible: a run falls below the lower bound for its controls, so its plant or commands "
    "are wrong"
)
SIGMAS_VEH_S = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)  # of the noise on the demand
SPREADS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # of the MFDs and trip lengths
LAST_FIGURE = "region_accumulation.png"  # of draw_accumulations
BOUND_TOLERANCE = 1e-6  # of the solver of the bound
PERTURBED_PLANT = "acyclic"
KEPT = (
    "controller",
    "seed",
    "plant",
    "total_time_spent_veh_s",
    "final_accumulation_veh",
    "fallbacks",
)
ROBUSTNESS_CAPTION = (
    "improvement of total time spent over no-control in the same perturbed scenario [%], mean "
    "± 95 % interval; trips: mean of all perturbed scenarios [veh]; sigma of {kind}: {meaning}"
)


def compared_with(controllers: Iterable[str]) -> str:
    """Return the controller that others are compared with.

    It is no control, or the first controller if no control is not among them.
    """
    names = list(controllers)
    return REFERENCE if REFERENCE in names else names[0]


def plant_of(name: str, scenario: Scenario, strategy: Strategy) -> Plant:
    """Return one of PLANTS; the labels of the strategy change streets."""
    from nmfd.model.plant import AcyclicPlant, NmfdPlant  # torch takes two seconds

    if name == LINKS:
        return streets_of(scenario, strategy)
    if name == "acyclic":
        return AcyclicPlant(scenario)
    return NmfdPlant(scenario)


def streets_of(
    scenario: Scenario,
    strategy: Strategy,
    network: "LinkNetwork | None" = None,
    numbers: "Numbers | None" = None,
) -> "LinkPlant":
    """Return the streets of a city under a strategy.

    network, numbers: as of LinkPlant
    Raises: InputError for labels that streets do not know
    """
    from nmfd.model.links.plant import LinkPlant

    check_labels(scenario, strategy)
    gated = strategy.controller.name != REFERENCE
    return LinkPlant(
        scenario, network=network, numbers=numbers, labels=strategy.labels, gated=gated
    )


def check_labels(scenario: Scenario, strategy: Strategy) -> None:
    """Raise InputError for labels that streets do not know."""
    from nmfd.model.links.model import METERING, choices_of

    choices_of(scenario, strategy.labels)
    options = strategy.options(scenario)
    if METERING not in strategy.labels or options is None:
        return
    commands_rates = getattr(options, "metering", False)
    if not commands_rates:
        raise InputError(
            f"{strategy.name}: streets (plant links) meter only as a controller commands, and "
            f"{strategy.controller.name} commands no rates; omit +{METERING}, or run it in SUMO "
            "(cosim)"
        )


def closed_loop_of(
    strategy: Strategy,
    seed: int,
    *,
    scenario: Scenario,
    plant: str,
    policy: Path | None = None,
    demand: float = 1.0,
    actual: Scenario | None = None,
) -> Result:
    """Run the controller that `strategy` makes for `scenario`.

    demand: factor of the demand that the scenario already has, to be noted in the result
    actual: perturbed scenario that it meets, the same if None
    """
    controller = strategy.make(scenario, policy)
    actual = actual or scenario
    city = plant_of(plant, actual, strategy)
    result = closed_loop.run(city, controller, actual, seed=seed)
    return result.assign(controller=strategy.name, plant=plant, demand=demand)


def workers_for(strategies: Sequence[Strategy], workers: int) -> int:
    """Return `workers` for `run_many`.

    A single worker is this process (0), unless controllers of the user's own may crash it.
    """
    own = any(strategy.own for strategy in strategies)
    return workers if own or workers > 1 else 0


def key_of(
    scenario: Scenario, strategies: Sequence[Strategy], plant: str, policies: Mapping[str, Path]
) -> Callable[[str], dict]:
    """Return the function of a controller's name that returns its key.

    The key holds everything that its runs depend on.

    Raises: InputError if a controller cannot be made, or the regional model has no such fault
    """
    for fault in scenario.ordered_faults:
        if fault.kind in faults.CITY:
            raise InputError(
                f"{scenario.name}: faults: {fault.kind} is a fault of a city in SUMO; omit it"
            )
    own = {}
    for strategy in strategies:
        policy = policies.get(strategy.name)
        strategy.make(scenario, policy)
        own[strategy.name] = strategy.fingerprint(scenario, policy)
        if strategy.labels:
            own[strategy.name]["labels"] = strategy.labels
    shared = {
        "scenario": scenario.name,
        "scenario_hash": scenario.hash,
        "network": scenario.network.name,
        "network_hash": scenario.network.hash,
        "plant": plant,
    }
    if plant == LINKS:
        from nmfd.model.links.plant import LinkPlant, links_file

        # Errors before the first run.
        LinkPlant(scenario)
        for strategy in strategies:
            check_labels(scenario, strategy)
        shared["links_hash"] = file_hash(links_file(scenario))
    return lambda name: {**shared, "controller": own[name]}


def lower_bound(scenario: Scenario, strategy: Strategy, plant: str) -> float:
    """Return the lower bound (veh s) in the scenario's plan file; NaN without.

    It is for the controls of `strategy`. Controllers of the user's own may meter, and plants of the
    user's own are other models.
    """
    if strategy.own or plant == LINKS or plant not in PLANTS:
        return math.nan
    if getattr(strategy.options(scenario), "metering", False):
        return math.nan
    if plant == "acyclic" and scenario.network.observed_split_ratios:  # which it renormalises
        return math.nan
    name = "bound-pcrg" if strategy.guides else "bound-pc"
    file = (scenario.folder or Path()) / f"{name}.npz"
    if not file.is_file():
        return math.nan
    try:
        return open_loop.read(file, scenario, guidance=strategy.guides).lower
    except InputError:  # of another demand or network
        return math.nan


def with_bounds(rows: "Table", lower: Mapping[tuple[str, float], float], level: float) -> "Table":
    """Return the rows with columns `lower_bound_veh_s` and `impossible`.

    A row is impossible if it falls below the bound.

    lower: (controller, factor of the demand) -> lower bound (veh s)
    level: factor of rows that do not say theirs
    """
    bounds = []
    for row in rows.to_dict("records"):
        factor = row.get("demand", level)
        if math.isnan(factor):
            factor = level
        bounds.append(lower.get((row["controller"], factor), math.nan))
    rows["lower_bound_veh_s"] = bounds
    spent = rows.get("total_time_spent_veh_s", math.nan)
    rows["impossible"] = spent < rows["lower_bound_veh_s"] * (1.0 - BOUND_TOLERANCE)
    return rows


def draw(folder: Path, scenarios: Mapping[float, Scenario], rows: "pd.DataFrame") -> None:
    """Draw the finished runs of a benchmark, and its scenario.

    Figures of runs that are newer than runs.csv stay: it changes with every run.
    """
    done = rows[rows["failure"] == ""]
    if done.empty:
        return
    several = len(scenarios) > 1
    for level, scenario in scenarios.items():
        below = f"demand-{level:g}" if several else ""
        prefix = f"{below}-" if below else ""
        if is_newer(folder / f"{prefix}{LAST_FIGURE}", folder / TABLE):
            continue
        results = []
        for row in done.to_dict("records"):
            if row.get("folder", "") == below:
                name = run_name(row["controller"], row["seed"])
                file = folder / below / f"{name}.nc"
                results.append(Result.read(file, only=("accumulation", "backlog")))
        if results:
            draw_accumulations(folder, scenario, results, prefix=prefix)
    draw_scenario(folder, next(iter(scenarios.values())))


def summary_table(rows: "pd.DataFrame") -> str:
    """Return a table with a line per controller, for every demand level.

    Total time spent (TTS) is the mean over seeds with its 95 % interval. Controllers with an
    impossible run come last, without a rank.
    """
    done = rows[rows["failure"] == ""]
    if done.empty:
        return "no run is finished"
    levels = done["demand"].unique() if "demand" in done else [1.0]
    if len(levels) == 1:
        return _level_table(done)
    tables = []
    for level in levels:
        tables.append(f"demand x {level:g}\n{_level_table(done[done['demand'] == level])}")
    return "\n\n".join(tables)


def _level_table(done: "pd.DataFrame") -> str:
    groups = dict(list(done.groupby("controller", sort=False)))
    against = compared_with(groups)
    reference = groups[against]["total_time_spent_veh_s"].tolist()
    with_bound = "lower_bound_veh_s" in done and bool(done["lower_bound_veh_s"].notna().any())
    lines = []
    impossible = []
    for name, group in groups.items():
        spent = group["total_time_spent_veh_s"].tolist()
        mean = group.mean(numeric_only=True).to_dict()
        spread = interval(spent)
        half = "" if math.isnan(spread) else f" ± {_scientific(spread, 1)}"
        line = {
            "controller": name,
            "seeds": len(group),
            "TTS [veh s]": _scientific(statistics.fmean(spent)) + half,
            "change": "" if name == against else _percent(spent, reference),
        }
        if with_bound:
            above = _percent(spent, [mean["lower_bound_veh_s"]])
            line["above the optimum"] = above.replace("+", "≤ ")
        line["final [veh]"] = f"{mean['final_accumulation_veh']:,.0f}"
        line["max [veh]"] = f"{mean['max_accumulation_veh']:,.0f}"
        line["completed [veh]"] = f"{mean['completed_veh']:,.0f}"
        line["control [s]"] = f"{mean['evaluation_time_s']:.3g}"
        longest = group["control_step_ms_max"].max()
        line["step [ms]"] = decision_ms(mean | {"control_step_ms_max": longest})
        for column, (heading, _) in COUNTED.items():
            line[heading] = int(group[column].sum())
        if "impossible" in group and group["impossible"].any():
            line["change"] = IMPOSSIBLE
            impossible.append(line)
        else:
            lines.append(line)
    caption = CAPTION.format(against=against)
    if with_bound:
        caption += BOUND_CAPTION
    if impossible:
        caption += IMPOSSIBLE_CAPTION
    return text_table(lines + impossible, caption)


def _percent(values: Sequence[float], reference: Sequence[float]) -> str:
    change = percent_change(statistics.fmean(values), statistics.fmean(reference))
    return cell(change, "{:+.1f} %")


def _scientific(value: float, digits: int = 4) -> str:
    """Return a number like 1.7730e8."""
    mantissa, exponent = f"{value:.{digits}e}".split("e")
    return f"{mantissa}e{int(exponent)}" if value else "0"


def draw_accumulations(
    folder: Path,
    scenario: Scenario,
    trajectories: Sequence[Result],
    *,
    seed: int | None = None,
    title: str | None = None,
    prefix: str = "",
) -> None:
    """Draw total and regional accumulation over time as png files.

    seed: shown instead of the mean over seeds
    title: text above both pictures
    prefix: begins the names of the files
    """
    from nmfd.studies import plots  # Matplotlib takes half a second

    network = scenario.network
    drawing = plots.figure(8.0, 4.6)
    ax = plots.total_accumulation(drawing.subplots(), trajectories, seed)
    drawing.suptitle(title, fontsize="medium")
    plots.legend_below(drawing, [ax], columns=6)
    plots.save(drawing, folder / f"{prefix}total_accumulation.png")
    drawing, axes = plots.panels(network.regions)
    for region, ax in enumerate(axes):
        plots.region_accumulation(ax, network, region, trajectories, seed)
    drawing.suptitle(title, fontsize="medium")
    plots.legend_below(drawing, axes, columns=3)
    plots.save(drawing, folder / f"{prefix}{LAST_FIGURE}")


def draw_scenario(folder: Path, scenario: Scenario) -> list[Path]:
    """Draw spawn matrix, region map and MFDs; return the png files."""
    from nmfd.studies import plots

    demand = plots.figure(11.0, 4.8)
    left, right = demand.subplots(1, 2)
    plots.spawn_matrix(left, scenario)
    plots.demand(right, scenario)
    plots.legend_below(demand, [right])
    regions = plots.figure(5.5, 5.0)
    plots.region_map(regions.subplots(), scenario.network)
    return [
        plots.save(demand, folder / "spawn_matrix.png"),
        plots.save(regions, folder / "region_map.png"),
        plots.draw_mfds(folder / "mfd.png", scenario.network),
    ]


def interval(values: Sequence[float]) -> float:
    """Return half of the 95 % interval of a mean (Student's t).

    It is NaN of a single value, or if a value is NaN.
    """
    count = len(values)
    if count < 2 or any(map(math.isnan, values)):
        return math.nan
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(count - 1, 0.975)) * statistics.stdev(values) / math.sqrt(count)


def run_perturbed(
    strategy: Strategy, seed: int, *, scenario: Scenario, sigma: float, kind: str
) -> Result:
    """Run one closed loop in a perturbed scenario; return its figures.

    seed: number of the draw of the perturbation and of the noise on measurements
    sigma, kind: see `perturbed`
    """
    actual = perturbed(scenario, sigma, seed, kind)
    result = closed_loop_of(strategy, seed, scenario=scenario, plant=PERTURBED_PLANT, actual=actual)
    row = summary(result)
    facts = {"kind": kind, "sigma": sigma, "trips_veh": scenario.step * float(actual.demand.sum())}
    return Result({}, facts | {column: row[column] for column in KEPT})


def improvements(rows: "pd.DataFrame", controller: str) -> dict[float, tuple[float, float]]:
    """Return sigma -> mean and half interval of the improvement (%).

    The improvement is over no control, the interval one of 95 %.
    """
    totals = _finished(rows).pivot_table("total_time_spent_veh_s", ["sigma", "seed"], "controller")
    pairs = totals.reindex(columns=[controller, REFERENCE]).dropna()
    gains: dict[float, list[float]] = {}
    for (sigma, _), own, reference in pairs.itertuples():
        gains.setdefault(sigma, []).append(-percent_change(own, reference))
    result = {}
    for sigma, values in gains.items():
        result[sigma] = (math.fsum(values) / len(values), interval(values))
    return result


def draw_robustness(folder: Path, rows: "pd.DataFrame") -> None:
    """Draw the improvement over sigma as robustness.png in `folder`."""
    from nmfd.studies import plots

    drawing = plots.figure(8.0, 4.8)
    ax = drawing.subplots()
    ax.axhline(0.0, color=plots.COLOURS[REFERENCE], linewidth=1.0)
    plots.with_intervals(ax, {name: improvements(rows, name) for name in _compared(rows)})
    kind = _finished(rows)["kind"].iloc[0]
    ax.set(xlabel=f"sigma of {kind}: {_meaning(kind)}", ylabel="total time spent saved [%]")
    plots.legend_below(drawing, [ax])
    plots.save(drawing, folder / "robustness.png")


def improvement_table(rows: "pd.DataFrame") -> str:
    """Return the improvements: a line per controller, a column per sigma."""
    done = _finished(rows)
    if done.empty:
        return "no run is finished"
    kind = done["kind"].iloc[0]
    trips = done[done["controller"] == REFERENCE].groupby("sigma")["trips_veh"].mean()
    lines = [["trips", *(f"{total:,.0f}" for total in trips)]]
    for name in _compared(rows):
        gains = improvements(rows, name)
        cells = [name]
        for sigma in trips.index:
            mean, half = gains.get(sigma, (math.nan, math.nan))
            cells.append("-" if math.isnan(mean) else f"{mean:.1f} ± {half:.1f}")
        lines.append(cells)
    caption = ROBUSTNESS_CAPTION.format(kind=kind, meaning=_meaning(kind))
    return text_columns(["sigma", *(f"{sigma:g}" for sigma in trips.index)], lines, caption)


def _meaning(kind: str) -> str:
    if kind.startswith("demand"):
        return "noise on the demand [veh/s]"
    return "spread of the logarithm [-]"


def _finished(rows: "pd.DataFrame") -> "pd.DataFrame":
    """Return the finished runs of the last kind, whose rows come first."""
    done = rows[rows["failure"] == ""]
    return done[done["kind"] == done["kind"].iloc[0]] if len(done) else done


def _compared(rows: "pd.DataFrame") -> list[str]:
    return [name for name in _finished(rows)["controller"].unique() if name != REFERENCE]
