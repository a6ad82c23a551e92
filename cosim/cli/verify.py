"""The command verify of `cosim`."""

from pathlib import Path

import click

from nmfd.cli.options import FOLDER, SEED
from nmfd.errors import RunFailed
from nmfd.runs.trail import UNKNOWN


@click.command()
@click.argument("folder", type=FOLDER)
@click.option("--row", metavar="LABEL", help="Which one, in quotes also a pattern; a random one of those that fit. "
                                             "[default: any]")
@click.option("--seed", type=SEED, help="Of the choice. [default: another one every time]")
@click.option("--within", type=click.FloatRange(0.0, 1.0), metavar="SHARE",
              help="By which figures may differ, as a share of them. [default: 0 for the same version and commit, else "
                   "1e-9, for sums in another order]")
@click.option("--list", "listed", is_flag=True, help="Only show the labels of the rows.")
def verify(folder: Path, row: str | None, seed: int | None, within: float | None, listed: bool) -> None:
    """Make a row of a published table, or of a run folder, again from what is written beside it, and compare.

    FOLDER holds manifest.json beside summary.csv or robustness.csv, the levels of an evaluation, the runs.csv of one,
    whose trail names the command, or entries of cosim compete. Everything but wall times has to be the same to the last
    digit, and a kept run to the byte, if version and commit are. What differs in them and in hashes is shown; exit
    status 1 where the row came out differently.

    \b
    Examples:
      cosim verify scenarios/economic_mpc/reference/robustness
      cosim verify scenarios/economic_mpc/reference/economic_mpc --row 'dpc-pcrg,*' --seed 1
      cosim verify scenarios/bologna/reference --row '1,no-control,3000'
    """
    from cosim.compete import verify as method  # heavy

    found = method.rows(folder)
    if listed:
        click.echo("\n".join(one.label for one in found))
        return
    one = method.chosen(found, row, seed)
    click.echo(f"{folder}: {one.label}, one of {len(found)} rows")
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
        raise RunFailed(f"{one.label}: {len(verdict.differ)} of {verdict.compared} figures differ"
                        + ("" if verdict.same_bytes is not False else ", and so does the kept run"))
    exact = verdict.equal == verdict.compared
    click.echo(f"The same: {verdict.compared} figures "
               + ("to the last digit" if exact else f"within {verdict.within:g}, {verdict.equal} to the last digit")
               + (", the kept run to the byte" if verdict.same_bytes else ""))
