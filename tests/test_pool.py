"""Processes of runs."""

import os

import pytest

from nmfd.runs.pool import in_processes


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no server to fork from")
def test_no_run_is_forked_from_the_command_itself():
    # Threads of PyTorch do not survive a fork: a policy would wait for them for ever.
    [(_, parent)] = in_processes([os.getppid], 1, [60.0])
    assert isinstance(parent, int)
    assert parent != os.getpid()
