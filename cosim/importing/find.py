"""The scenario that belongs to a network: `cosim identify networks/mycity` loads the city with it."""

from pathlib import Path

from nmfd.errors import InputError
from nmfd.runs import config, shipped


def scenario_of(target: Path) -> Path:
    """`target` if it is a scenario's folder; for a network's, the scenario on it in the folder scenarios beside the
    networks: that of the same name, or the only one. Both may be names of those that come with the package. Raises
    InputError."""
    target = shipped.found(target, shipped.SCENARIO, shipped.NETWORK)
    if (target / "scenario.toml").exists() or not (target / "network.toml").exists():
        return target
    scenarios = target.resolve().parent.parent / "scenarios"
    found = sorted(file.parent for file in scenarios.glob("[!.]*/scenario.toml") if _is_on(file, target))
    same = [folder for folder in found if folder.name == target.resolve().name]
    if len(same or found) == 1:
        return (same or found)[0]
    names = ", ".join(folder.name for folder in found) or "none"
    raise InputError(f"{target}: which scenario loads this network? In {scenarios} are on it: {names}; name one")


def _is_on(file: Path, network: Path) -> bool:
    try:
        name = config.read(file).get("network")
    except InputError:
        return False
    return isinstance(name, str) and (file.parent / name).resolve() == network.resolve()
