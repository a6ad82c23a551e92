"""Where and with what a run was made."""

import platform
import subprocess
from contextlib import suppress
from datetime import datetime
from functools import cache
from importlib import metadata
from pathlib import Path

from nmfd import __version__

PACKAGES = ("numpy", "torch", "casadi", "libsumo")


def provenance() -> dict:
    """Date, versions, and the commit of the checkout that this package lies in; commit is None outside one."""
    commit, dirty = _checkout()
    return {
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "versions": dict(_versions()),
        "commit": commit,
        "dirty": dirty,
    }


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    versions = {"python": platform.python_version(), "perimeter-cosim": __version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return tuple(versions.items())


@cache
def _checkout() -> tuple[str | None, bool | None]:
    """Commit, and whether files differ from it; as this process found them first, for that is the code that it runs."""
    here = Path(__file__).resolve()
    # An installed copy may lie inside somebody else's checkout: the commit counts only if this file is tracked.
    tracked = _git(here.parent, "ls-files", "--error-unmatch", here.name) is not None
    commit = _git(here.parent, "rev-parse", "HEAD") if tracked else None
    changes = _git(here.parent, "status", "--porcelain", "--untracked-files=no") if commit else None
    return commit, None if changes is None else bool(changes)


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]  # killed, a lock would stay for ever
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
