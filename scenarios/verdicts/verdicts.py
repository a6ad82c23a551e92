"""Compare verdicts of `cosim study` with ten seeds that the study did not see.

    python scenarios/verdicts/verdicts.py hamburg/run_simulation.sumocfg

A verdict comes from three seeds or more, as the study stops early; the ten other seeds are judged
by the same rule. Finished runs are kept: the same command goes on after an interruption.
"""

from dataclasses import replace
from pathlib import Path

import click
import pandas as pd

from cosim.studying import stages
from cosim.studying.conduct import judged_levels
from cosim.studying.stages import Level, Runner
from nmfd.runs.run_many import locked
from nmfd.studies.benchmark import REFERENCE

MOST_SEEDS = 10
OTHER_SEEDS = range(1200, 1210)


def judged(city: Path, out: Path, levels: list[float], workers: int) -> pd.DataFrame:
    """Return a row for each strategy that a study of the city tries at the levels."""
    scenario = stages.imported(city, out, "auto", [], None)
    runner = Runner(scenario=scenario, out=out / "runs", workers=workers)
    rows = []
    with locked(runner.out):
        load = stages.loading(runner)
        found = stages.gates(runner, load, own=True)
        runner = replace(runner, scenario=found.scenario)
        runner.done([REFERENCE], levels, [stages.LOADING_SEED])
        for level in judged_levels(runner, levels, found.reason, MOST_SEEDS, trained=True):
            names = [one.strategy for one in level.outcomes]
            others = runner.done(names, [level.demand], OTHER_SEEDS)
            rows += compared(city.parent.name, level, others)
    return pd.DataFrame(rows)


def compared(city: str, level: Level, others: pd.DataFrame) -> list[dict[str, object]]:
    """Return a row for each verdict of a study at one demand level.

    others: runs of the other seeds
    """
    rows = []
    for one in level.outcomes:
        ten = stages.outcome(others, level.demand, one.strategy).verdict
        if one.verdict is None or ten is None:
            continue
        rows.append(
            {
                "city": city,
                "demand": level.demand,
                "measure": one.label,
                "seeds": one.verdict.seeds,
                "study": one.verdict.change,
                "verdict": one.verdict.answer.value,
                "ten other seeds": ten.change,
                "their verdict": ten.answer.value,
            }
        )
    return rows


@click.command()
@click.argument("city", type=click.Path(path_type=Path, exists=True))
@click.option("--level", "levels", type=float, multiple=True, default=(1.0, 1.3))
@click.option("--workers", default=2)
def main(city: Path, levels: tuple[float, ...], workers: int) -> None:
    """Print a row for each strategy, and write them to verdicts.csv in the folder of runs."""
    out = Path("runs", f"{city.parent.name}-verdicts")
    table = judged(city, out, list(levels), workers)
    table.to_csv(out / "verdicts.csv", index=False)
    click.echo(table.to_markdown(index=False))


if __name__ == "__main__":
    main()
