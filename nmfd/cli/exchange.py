"""Commands of `nmfd` for what comes from elsewhere and goes there: controllers of one's own, and exported policies."""

from importlib import resources
from pathlib import Path

import click

from nmfd.cli.options import FILE, FOLDER, quoted
from nmfd.errors import InputError


@click.command(name="new-controller")
@click.argument("file", type=FILE)
def new_controller(file: Path) -> None:
    """Write a commented controller to begin with. Any command takes it as FILE:Class instead of a controller's name.

    A package may offer controllers too, by name: entry points of the group nmfd.controllers.

    \b
    Example:
      nmfd new-controller mine.py
      nmfd benchmark economic_mpc --controllers no-control,pi-gating,mine.py:MyController
    """
    if file.suffix != ".py":
        raise InputError(f"{file}: expected a name that ends in .py, such as {file.with_suffix('.py')}")
    if file.exists():
        raise InputError(f"{file}: is there already; choose another name")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it first")
    text = resources.files("nmfd.controllers").joinpath("template.py").read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", str(file)), encoding="utf-8")
    click.echo(f"Written to {file}; try it with: nmfd benchmark economic_mpc "
               f"--controllers no-control,pi-gating,{quoted(file)}:MyController")


@click.command()
@click.argument("policy", type=FILE)
@click.option("--out", type=FILE, required=True, metavar="FILE", help="The ONNX file.")
@click.option("--scenario", type=FOLDER, metavar="DIR",
              help="For which the policy was trained. [default: the folder that it lies in]")
def export(policy: Path, out: Path, scenario: Path | None) -> None:
    """Export a policy with its constraint layers to ONNX, and check it against torch. Needs the extra onnx.

    Its input is the accumulation (B, R, R) [veh] in float32; its outputs are perimeter (B, R, R) and, with route
    guidance, splits (B, R, R, R), within their bounds and with sum 1 as those of the policy.

    \b
    Example:
      nmfd export economic_mpc/dpc-pcrg.pt --out dpc-pcrg.onnx
    """
    from nmfd.controllers.dpc import onnx_export  # heavy

    if not out.parent.is_dir():
        raise InputError(f"{out.parent}: no such folder; make it first or choose another --out")
    done = onnx_export.export(policy, out, scenario)
    click.echo(f"{done['controller']}, {done['regions']} regions: differs from torch by at most "
               f"{done['difference']:.1e} over {done['samples']} random states")
    click.echo(f"Written to {out}")
