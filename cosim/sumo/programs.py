"""SUMO's own programs and Python tools, run to their end."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import sumo

from nmfd.errors import InputError

HOME = Path(sumo.SUMO_HOME)


def run_sumo(program: str, options: Mapping[str, object], *flags: str, where: str) -> None:
    """Run one of SUMO's programs.

    Raises InputError with its first error line and the file `where`.
    """
    command = [str(HOME / "bin" / program)]
    for name, value in options.items():
        command += [f"--{name}", str(value)]
    done = _run([*command, *flags])
    if done.returncode:
        lines = (done.stderr + done.stdout).splitlines()
        error = next((line for line in lines if "rror" in line), "no reason given")
        reason = " ".join(error.split())
        raise InputError(f"{where}: {program} cannot run it: {reason}; correct the input")


def last_words(said: object) -> str:
    """Return the last line of what a finished program or an error says."""
    words = getattr(said, "stderr", "")
    if not words and isinstance(said, Exception):
        words = str(said)
    lines = (words or "").strip().splitlines()
    return lines[-1] if lines else "no message"


def run_tool(
    tool: str, *arguments: str, folder: Path, seconds: float | None = None
) -> subprocess.CompletedProcess:
    """Run a Python tool of SUMO in a folder; return its outcome.

    seconds: time limit

    Raises subprocess.TimeoutExpired.
    """
    command = [sys.executable, str(HOME / "tools" / tool), *arguments]
    return _run(command, cwd=folder, timeout=seconds)


def _run(command: list[str], **more: object) -> subprocess.CompletedProcess:
    # With this seed, sets have the same order every time.
    environment = os.environ | {"SUMO_HOME": str(HOME), "PYTHONHASHSEED": "0"}
    how = {"capture_output": True, "text": True, "errors": "replace", "stdin": subprocess.DEVNULL}
    return subprocess.run(command, env=environment, **how, **more)  # type: ignore[call-overload]
