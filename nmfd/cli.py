"""Command line `nmfd`: it parses options and calls nmfd.api.

It also declares the options that cosim.cli shares.
"""

import math
import os
import shlex
import signal
import sys
import threading
import tomllib
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NoReturn

import click

import nmfd
from nmfd.errors import InputError, RunFailed
from nmfd.runs.files import check_name, parts_of

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
COUNT = click.IntRange(1, 10**6)
SEED = click.IntRange(0, 2**31 - 1)  # SUMO's seeds have 32 bits


class Seeds(click.ParamType):
    """Number of seeds, or the seeds A,B,... or FROM-TO."""

    name = "N|A,B|FROM-TO"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | tuple[int, ...]:
        if isinstance(value, int | tuple):
            return value
        try:
            first, dash, last = value.partition("-")
            if dash:
                seeds = tuple(range(int(first), int(last) + 1))
            elif "," in value:
                seeds = tuple(int(word) for word in value.split(","))
            else:
                return COUNT.convert(value, param, ctx)
            if not seeds or len(set(seeds)) < len(seeds):
                raise ValueError
        except ValueError:
            form = "a number of seeds, seeds such as 3300,3301, or a range such as 3300-3309"
            self.fail(f"expected {form}, got {value!r} instead", param, ctx)
        return tuple(SEED.convert(seed, param, ctx) for seed in seeds)


class Number(click.FloatRange):
    """Number in a range; NaN is in none."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value!r} is not a number.", param, ctx)
        return number


class Commands(click.Group):
    """Command group with sections in its help.

    User errors and Ctrl-C end a command with one line on stderr.
    """

    def __init__(
        self,
        *args: Any,
        sections: Mapping[str, Sequence[str]],
        elsewhere: Mapping[str, str],
        **options: Any,
    ):
        """elsewhere: a command of the other program -> its name"""
        super().__init__(*args, **options)
        self.sections = sections
        self.elsewhere = elsewhere

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Find the command; name the one of the other program."""
        name = args[0]
        if name not in self.commands and name in self.elsewhere:
            ctx.fail(f"No such command '{name}': it is `{self.elsewhere[name]}`.")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands section by section, in the order of use."""
        width = max(map(len, self.commands))
        for title, names in self.sections.items():
            with formatter.section(title):
                rows = []
                for name in names:
                    text = self.commands[name].get_short_help_str(60)
                    rows.append((f"{name:{width}}", text))
                formatter.write_dl(rows)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command.

        Exit with 2 after a user error, 1 after failed runs, 130 after Ctrl-C or SIGTERM.
        """
        stops = []

        def stop(*_: object) -> NoReturn:
            stops.append(True)  # an import may make another exception of this one
            raise KeyboardInterrupt

        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, stop)
            if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                signal.signal(signal.SIGINT, stop)
        for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
            if getattr(sys, name) is None:  # closed: some other file would get its number
                stream = open(os.devnull, mode)  # noqa: SIM115 - open as long as the process
                setattr(sys, name, stream)
                os.set_inheritable(stream.fileno(), True)
        try:
            return super().invoke(ctx)
        except (KeyboardInterrupt, Exception) as error:
            text = f"error: {error}"
            status = 2
            if stops or isinstance(error, KeyboardInterrupt):
                text = "interrupted"
                status = 130
                if isinstance(error, KeyboardInterrupt) and str(error):
                    text += f": {error}"
            elif isinstance(error, RunFailed):
                status = 1
            elif isinstance(error, BrokenPipeError) or not isinstance(error, (InputError, OSError)):
                raise  # click ends without a word if nobody reads on
        click.echo(f"{self.name}: {' '.join(text.split())}", err=True)
        raise click.exceptions.Exit(status)


def combined(*decorators: Callable) -> Callable:
    """Return one decorator that applies several.

    Their options appear in this order.
    """

    def decorate(command: Callable) -> Callable:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


class ControllerName(click.types.StringParamType):
    """Name of a controller; the error without one names `examples`."""

    def __init__(self, examples: str):
        self.examples = examples

    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"Name one, such as {self.examples}; `nmfd show` lists them."


def listed(kind: click.ParamType) -> Callable[[str], tuple]:
    """Return a parser of values of a kind that are separated by commas."""

    def parse(text: str) -> tuple:
        values = tuple(kind.convert(word, None, None) for word in parts_of(text))
        if len(set(values)) < len(values):
            raise click.BadParameter(
                f"expected distinct values separated by commas, got {text!r} instead"
            )
        return values

    parse.__name__ = "A,B,..."
    return parse


def parsed(form: str, convert: Callable[[str], Any]) -> Callable:
    """Return the callback of a repeated option KEY=VALUE, which gives a dict.

    form: what is expected; it begins with the metavar
    """

    def parse(_ctx: Any, _param: Any, values: Sequence[str]) -> dict[str, Any]:
        result = {}
        for text in values:
            key, _, value = text.partition("=")
            try:
                if not key.strip() or not value:
                    raise ValueError
                result[key.strip()] = convert(value.strip())
            except ValueError:
                raise click.BadParameter(f"expected {form}, got {text!r} instead") from None
        return result

    return parse


def toml_or_text(value: str) -> Any:
    """Return a value of TOML, or the text if it is none."""
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value


CITATION = resources.files("nmfd").joinpath("CITATION.cff").read_text(encoding="utf-8")
VERSION = combined(
    click.version_option(nmfd.__version__),
    click.version_option(
        nmfd.__version__,
        "--cite",
        message=f"{CITATION}version: %(version)s",
        help="How to cite it.",
    ),
)
SET = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    callback=parsed("KEY=VALUE, such as steps=12", toml_or_text),
    help="Change a setting of the scenario, such as steps=12 or controllers.pi-gating.kp=2. "
    "May be repeated.",
)
SCENARIO = combined(click.argument("scenario", type=click.Path(path_type=Path)), SET)
CONTROLLERS = click.option(
    "--controllers",
    type=listed(click.STRING),
    required=True,
    metavar="A,B,...",
    help="Controllers, such as no-control,pi-gating or 'dpc-*' in quotes; `nmfd show` lists them.",
)
POLICIES = click.option(
    "--policy",
    "policies",
    multiple=True,
    metavar="NAME=FILE",
    callback=parsed("NAME=FILE, such as dpc-pc=mine.pt", Path),
    help="Policy or plan file of a controller. May be repeated. "
    "[default: SCENARIO/NAME.pt or .npz]",
)
WORKERS = click.option("--workers", type=COUNT, default=1, help="Number of parallel runs.")
TRY = "; try it: nmfd benchmark {0} --controllers no-control,{1} --policy {1}={2}"


SCHEDULER = click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler for the runs, such as tls://host:8786."
)
TIME_LIMIT = click.option(
    "--time-limit",
    type=Number(0.0, min_open=True),
    metavar="S",
    help="Time after which a run in a process of its own is ended. [default: ten times the "
    "expected one, at least 600]",
)
OVERWRITE = click.option(
    "--overwrite", is_flag=True, help="Do finished runs again whose settings have changed."
)
RUNNING = combined(WORKERS, SCHEDULER, TIME_LIMIT, OVERWRITE)
LEVEL = Number(0.0, 10.0, min_open=True)
STEPS = click.option(
    "--steps", type=COUNT, help="Number of control intervals. [default: as in the scenario]"
)
DEMAND = click.option(
    "--demand",
    "--levels",
    "demand",
    type=listed(LEVEL),
    default="1",
    help="Factors that multiply the demand.",
)


def file_option(name: str, text: str, metavar: str = "FILE", **more: Any) -> Callable:
    """Return the option of a file."""
    return click.option(name, type=FILE, metavar=metavar, help=text, **more)


def controller_option(examples: str, text: str, metavar: str = "NAME") -> Callable:
    """Return the option --controller; the error without one names `examples`."""
    kind = ControllerName(examples)
    return click.option("--controller", type=kind, required=True, metavar=metavar, help=text)


def seeds_option(default: int, text: str, *others: str) -> Callable:
    """Return the option --seeds, and its older names."""
    return click.option("--seeds", *others, "seeds", type=Seeds(), default=default, help=text)


def seed_option(text: str = "Random seed.") -> Callable:
    """Return the option --seed."""
    return click.option("--seed", type=SEED, default=0, help=text)


def out_option(
    default: str, text: str = "Run folder; finished runs in it are not repeated."
) -> Callable:
    """Return the option --out of a folder.

    default: where results go without it
    """
    return click.option("--out", type=FOLDER, metavar="DIR", help=f"{text} [default: {default}]")


@click.group(
    name="nmfd",
    cls=Commands,
    context_settings={"show_default": True},
    sections={
        "Commands in the order of use": ("show", "benchmark", "robustness"),
        "Controllers": ("train", "bound", "new-controller"),
        "Networks from measured data": ("identify",),
    },
    elsewhere={"list": "nmfd show", "run": "nmfd benchmark` or, in SUMO, `cosim run"}
    | {
        name: f"cosim {name}"
        for name in ("demo", "watch", "evaluate", "report", "compare", "tune", "get", "import")
    },
)
@VERSION
def main() -> None:
    """Perimeter control and route guidance on the regional model (NMFD).

    \b
    Begin with `nmfd show`, then
    `nmfd benchmark economic_mpc --controllers no-control,pi-gating`.
    """


@main.command()
@click.argument("scenario", type=click.Path(path_type=Path), required=False)
@SET
@out_option("runs/SCENARIO-show", "Folder of the figures.")
def show(scenario: Path | None, settings: dict, out: Path | None) -> None:
    """Draw a scenario; without SCENARIO list what is shipped.

    Draws demand, region map and MFDs. The list contains scenarios, networks, policies and
    controllers.

    \b
    Examples:
      nmfd show
      nmfd show economic_mpc --out figures
    """
    if scenario is None:
        click.echo(nmfd.api.listing(nmfd.api.catalogue()))
        return
    loaded = nmfd.load_scenario(scenario, settings)
    files = nmfd.api.show(loaded, out=out)
    click.echo(nmfd.api.described(loaded))
    for file in files:
        click.echo(f"Written to {file}")


@main.command()
@SCENARIO
@CONTROLLERS
@seeds_option(1, "Number of runs, with seeds from 0, or the seeds.")
@DEMAND
@STEPS
@click.option(
    "--plant", type=click.Choice(["nmfd", "acyclic", "links"]), default="nmfd", help="Plant model."
)
@POLICIES
@RUNNING
@out_option("runs/SCENARIO-TIME")
def benchmark(scenario: Path, settings: dict, **options: Any) -> None:
    """Run controllers on a regional model and compare them.

    SCENARIO is a name that `nmfd show` lists, or a folder with a scenario.toml. The run folder
    holds tables, results and figures; if --out is an existing run folder, only missing runs are
    done.

    \b
    Example:
      nmfd benchmark economic_mpc --controllers no-control,dpc-pc --seeds 5
    """
    rows = nmfd.api.benchmark(nmfd.load_scenario(scenario, settings), **options)
    out = rows.attrs["folder"]
    click.echo(nmfd.api.summary_table(rows))
    click.echo(f"Written to {out}: see the figures; more seeds: --seeds N --out {out}")
    nmfd.api.raise_failures(rows)


@main.command()
@SCENARIO
@CONTROLLERS
@click.option(
    "--kind",
    type=click.Choice(["demand", "demand-total", "mfd-scale", "mfd-axis", "trip-lengths"]),
    default="demand",
    help="What differs from the scenario.",
)
@click.option(
    "--sigmas",
    type=listed(Number(0.0)),
    help="Noise (veh/s) or spread (-). [default: 0,...,5 or 0,...,0.4]",
)
@seeds_option(20, "Number of random scenarios per sigma, or their seeds.", "--scenarios")
@STEPS
@RUNNING
@out_option("runs/SCENARIO-TIME")
def robustness(scenario: Path, settings: dict, **options: Any) -> None:
    """Run controllers under unexpected demand or MFDs.

    demand adds noise per pair of regions and control interval; demand-total then restores the
    number of trips; other kinds multiply MFDs or trip lengths by a random factor per region. Prints
    and draws the gain over no-control.

    \b
    Example:
      nmfd robustness economic_mpc --controllers pi-gating,dpc-pcrg --out runs/robust
    """
    rows = nmfd.api.robustness(nmfd.load_scenario(scenario, settings), **options)
    click.echo(nmfd.api.improvement_table(rows))
    click.echo(f"Written to {rows.attrs['folder']}: see runs.csv and robustness.png")
    nmfd.api.raise_failures(rows)


@main.command()
@SCENARIO
@controller_option("dpc-pc", "dpc-pc or dpc-pcrg.")
@seed_option("Seed of the initial weights and the training states.")
@click.option(
    "--plant", type=click.Choice(["nmfd", "links"]), default="nmfd", help="Model to train through."
)
@click.option("--steps", type=COUNT, help="Adam steps. [default: as in scenario.toml, else 400]")
@click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True
)
@click.option("--resume", is_flag=True, help="Continue an interrupted training.")
@click.option(
    "--anyway", is_flag=True, help="Train even if model or gateways make it pointless; see errors."
)
@file_option("--out", "Policy file. [default: SCENARIO/NAME.pt]")
def train(scenario: Path, settings: dict, controller: str, **options: Any) -> None:
    """Train a DPC policy on a scenario.

    The policy file always holds the policy that is best in validation. After Ctrl-C, --resume
    continues the training.

    \b
    Example:
      nmfd train economic_mpc --controller dpc-pc --steps 200 --out mine.pt
    """
    file = nmfd.api.train(nmfd.load_scenario(scenario, settings), controller, **options)
    click.echo(f"Written to {file}{TRY.format(scenario, controller, file)}")


@main.command()
@SCENARIO
@controller_option("bound-pc", "bound-pc or bound-pcrg.")
@file_option("--out", "Plan file. [default: SCENARIO/NAME.npz]")
def bound(scenario: Path, settings: dict, controller: str, **options: Any) -> None:
    """Find the best plan for known demand, and a lower bound.

    `nmfd benchmark --controllers bound-pc,bound-pcrg` replays the plans; its table shows by how
    much each controller exceeds the lower bound.

    \b
    Example:
      nmfd bound economic_mpc --controller bound-pcrg
    """
    plan = nmfd.api.bound(nmfd.load_scenario(scenario, settings), controller, **options)
    file = options["out"] or f"{scenario}/{controller}.npz"
    click.echo(nmfd.api.bound_report(plan))
    click.echo(f"Written to {file}{TRY.format(scenario, controller, file)}")


@main.command(name="new-controller")
@click.argument("file", type=FILE)
def new_controller(file: Path) -> None:
    """Write a commented template of a controller.

    Commands accept it as a controller named FILE:Class.

    \b
    Example:
      nmfd new-controller mine.py
      nmfd benchmark economic_mpc --controllers no-control,mine.py:MyController
    """
    check_name(file)
    if file.suffix != ".py":
        better = file.with_suffix(".py")
        raise InputError(f"{file}: expected a name that ends in .py, such as {better}")
    if file.exists():
        raise InputError(f"{file}: exists; choose another name")
    text = resources.files("nmfd.controllers").joinpath("template.py").read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", str(file)), encoding="utf-8")
    own = f"{shlex.quote(str(file))}:MyController"
    command = f"nmfd benchmark economic_mpc --controllers no-control,{own}"
    click.echo(f"Written to {file}; try it: {command}")


@main.command()
@click.argument("counts", type=FILE)
@file_option(
    "--detectors",
    "Table: detid, length (km), lanes, linkid, pos, long and lat or x and y, region.",
    "CSV",
)
@file_option("--regions", "Table detid,region, unless another table has regions.", "CSV")
@file_option("--about", "Table of regions: region, lane_km, trip_length, x, y (m).", "CSV")
@file_option("--adjacency", "Table region,neighbour. [default: by position]", "CSV")
@click.option(
    "--trip-length",
    type=float,
    metavar="M",
    help="Mean trip length in a region. [default: from its size]",
)
@click.option("--city", metavar="NAME", help="City to use, if the tables hold several.")
@click.option(
    "--skip-bad",
    is_flag=True,
    help="Leave out and count rows that are doubled or have impossible numbers.",
)
@click.option(
    "--out", type=FOLDER, required=True, metavar="DIR", help="New folder for the network."
)
def identify(counts: Path, out: Path, **options: Any) -> None:
    """Fit a network to counts and occupancies of detectors.

    COUNTS has the columns of UTD19 (utd19.ethz.ch): day, interval (s since midnight), detid, flow
    (veh/h per lane), occ (share of the time); error, city, region if known. Writes network.toml,
    and mfd.png and identify.txt about the fit.

    \b
    Example:
      nmfd identify counts.csv --detectors detectors.csv --out networks/mine
    """
    click.echo(nmfd.identify(counts, out=out, **options).text)
    next_step = f'a scenario.toml with network = "{out}"'
    click.echo(f"Written to {out}: see mfd.png and identify.txt; next: {next_step}")
