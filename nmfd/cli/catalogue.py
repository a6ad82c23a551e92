"""What comes with the package, as (name, line) rows: from the files themselves and the controllers."""

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from nmfd.controllers.dpc.policy_file import read_policy_file
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.model.regional_model import NetworkTable
from nmfd.model.scenario import ScenarioTable, read_tables
from nmfd.runs import config, shipped

LONGEST = 100  # characters of what a file says
Rows = Iterator[tuple[str, str]]


def scenarios() -> Rows:
    """What the comment at the top of scenario.toml says, network, duration."""
    for folder in shipped.folders(shipped.SCENARIO):
        table = config.checked(ScenarioTable, read_tables(folder), folder / "scenario.toml")
        yield (
            folder.name,
            (
                f"{_about(folder / 'scenario.toml')} ({(folder / table.network).resolve().name}, "
                f"{table.steps} intervals of {table.step:g} s)"
            ),
        )


def networks() -> Rows:
    """How many regions, whether there is a city to simulate, and what the comment at the top of network.toml says."""
    for folder in shipped.folders(shipped.NETWORK):
        table = config.checked(NetworkTable, config.read(folder / "network.toml"), folder / "network.toml")
        yield (
            folder.name,
            (
                f"{len(table.regions)} regions, {'SUMO city' if table.sumo else 'regional model only'}: "
                f"{_about(folder / 'network.toml')}"
            ),
        )


def policies() -> Rows:
    """How they were trained."""
    for folder in shipped.folders(shipped.SCENARIO):
        for file in sorted(folder.glob("dpc-*.pt")):
            content = read_policy_file(file)
            of, numbers = content["configuration"], content["weights"].get("numbers")
            compact = "" if numbers is None else f": {', '.join(f'{number:.3g}' for number in numbers.tolist())}"
            yield (
                f"{folder.name}/{file.name}",
                (
                    f"{of['steps']} Adam steps, seed {of['seed']}, {of['validation_veh_s']:.4g} veh s in validation"
                    f"{compact}"
                ),
            )
        for file in sorted(folder.glob("bound-*.npz")):
            yield f"{folder.name}/{file.name}", "a plan found with all demand known"


def controllers() -> Rows:
    """What they do."""
    yield from ((kind.name, kind.text) for kind in CONTROLLERS.values())


def _about(file: Path) -> str:
    """The first sentence of the comment at the top of a file, or its beginning; "" without one."""
    words: list[str] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("#:"):  # the schema, for editors
            words += line.lstrip("# ").split()
    first = re.split(r"\.\s+(?=[A-Z\d])", " ".join(words))[0].rstrip(".")
    return textwrap.shorten(first.removeprefix("Regional model: "), LONGEST, placeholder=" ...", break_on_hyphens=False)
