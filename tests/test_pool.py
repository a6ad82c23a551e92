"""Processes of runs."""

import os
import subprocess
import sys

import pytest

from nmfd.runs.pool import in_processes


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no server to fork from")
def test_no_run_is_forked_from_the_command_itself():
    # Threads of PyTorch do not survive a fork: a policy would wait for them for ever.
    [(_, parent)] = in_processes([os.getppid], 1, [60.0])
    assert isinstance(parent, int)
    assert parent != os.getpid()


SCRIPT = """
import os, sys
from pathlib import Path
from nmfd.runs.pool import in_processes
[(_, server)] = in_processes([os.getppid], 1, [60.0])
commands = {Path(f"/proc/{process}/cmdline").read_text() for process in (server, os.getpid())}
print(len(commands))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the server is a new process")
@pytest.mark.parametrize(
    ("first", "commands"), [("", "1"), pytest.param("import torch", "2", marks=pytest.mark.slow)]
)
def test_the_server_is_a_fork_only_of_a_process_without_threads(first, commands):
    script = f"print('begun'); {first}\n{SCRIPT}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["begun", commands], done.stderr
