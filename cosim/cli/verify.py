"""The command verify of `cosim`."""

import random
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cosim.cli.options import tell
from nmfd.cli.options import FOLDER, SEED
from nmfd.cli.progress import resumable
from nmfd.errors import RunFailed
from nmfd.runs.trail import UNKNOWN

if TYPE_CHECKING:  # heavy
    from cosim.compete.verify import Row


@click.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--row", metavar="LABEL", help="Which one, in quotes also a pattern; a random one of those that fit. [default: any]"
)
@click.option("--seed", type=SEED, help="Of the choice. [default: another one every time]")
@click.option(
    "--all",
    "every",
    is_flag=True,
    help="All that fit, one after the other, instead of one of them. What comes of them is in verified.csv "
    "in the folder --out; the same command goes on where it was interrupted.",
)
@click.option(
    "--missing", is_flag=True, help="With --all: only those that verified.csv does not have, of this or another commit."
)
@click.option(
    "--out",
    type=FOLDER,
    metavar="DIR",
    help="With --all: the folder of verified.csv, which may have rows of other folders. [default: runs]",
)
@click.option(
    "--within",
    type=click.FloatRange(0.0, 1.0),
    metavar="SHARE",
    help="By which figures may differ, as a share of them. [default: 0 for the same version and commit, else "
    "1e-9, for sums in another order]",
)
@click.option("--scenario", type=FOLDER, metavar="DIR", help="The rows' scenario, if it is no longer where it was.")
@click.option("--list", "listed", is_flag=True, help="Only show the labels of the rows.")
def verify(
    folder: Path,
    row: str | None,
    seed: int | None,
    every: bool,
    missing: bool,
    out: Path | None,
    within: float | None,
    scenario: Path | None,
    listed: bool,
) -> None:
    """Make a row of a published table, or of a run folder, again from what is written beside it, and compare.

    FOLDER holds manifest.json beside summary.csv or robustness.csv, the levels of an evaluation, the runs.csv of one,
    whose trail names the command, or entries of cosim compete. Everything but wall times has to be the same to the last
    digit, and a kept run to the byte, if version and commit are. What differs in them and in hashes is shown; exit
    status 1 where a row came out differently.

    \b
    Examples:
      cosim verify scenarios/economic_mpc/reference/robustness
      cosim verify scenarios/economic_mpc/reference/economic_mpc --row 'dpc-pcrg,*' --seed 1
      cosim verify scenarios/bologna/reference --row '1,no-control,3000'
      cosim verify scenarios/economic_mpc/reference/economic_mpc --all
    """
    for option in [name for name, given in (("--out", out is not None), ("--missing", missing)) if given and not every]:
        raise click.UsageError(f"{option} is for --all; add that, or omit it")
    if seed is not None and every:
        raise click.UsageError("--seed chooses one row, and --all takes every one; omit one of them")
    from cosim.compete import verify as method  # heavy

    found = method.rows(folder, scenario)
    if listed:
        click.echo("\n".join(one.label for one in found))
        return
    fitting = method.fitting(found, row)
    if every:
        _all(folder, fitting, Path("runs") if out is None else out, within, missing)
        return
    one = random.Random(seed).choice(fitting)
    click.echo(f"{folder}: {one.label}, one of {len(found)} rows")
    _one(one, within)


def _all(folder: Path, rows: "list[Row]", out: Path, within: float | None, missing: bool) -> None:
    from cosim.compete import verified  # heavy

    with resumable("verify", out, verified.TABLE) as progress:
        lines = verified.verify_all(folder, rows, out=out, within=within, missing=missing, progress=progress, tell=tell)
    count = Counter(str(line["verdict"]) for line in lines)
    words = ", ".join(f"{number} {word}" for word, number in count.items())
    click.echo(f"{folder}: {len(lines)} rows: {words}; see {out / verified.TABLE}")
    if bad := count[verified.DIFFERENT] + count[verified.FAILED]:
        raise RunFailed(f"{folder}: {bad} of {len(lines)} rows did not come out the same")


def _one(one: "Row", within: float | None) -> None:
    from cosim.compete import verify as method  # heavy

    verdict = method.verify(one, within)
    unknown = [key for key, (before, _) in verdict.depends.items() if before == UNKNOWN]
    if unknown:
        click.echo(f"  unknown then: {', '.join(unknown)}")
    for key, (before, now) in verdict.depends.items():
        if before != UNKNOWN:
            click.echo(f"  {key}: {before} then, {now} now")
    for key, (before, now) in verdict.differ.items():
        click.echo(f"  {key} differs: {before} published, {now} made again")
    if verdict.same_bytes is False:
        click.echo("  the kept run differs" + (", as it may in another version" if verdict.good else ""))
    if not verdict.good:
        raise RunFailed(
            f"{one.label}: {len(verdict.differ)} of {verdict.compared} figures differ"
            + ("" if verdict.same_bytes is not False else ", and so does the kept run")
        )
    click.echo(
        f"The same: {verdict.compared} figures "
        + ("" if verdict.exact else f"within {verdict.within:g}, {verdict.equal} ")
        + "to the last digit"
        + (", the kept run to the byte" if verdict.same_bytes else "")
    )
