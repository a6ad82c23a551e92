"""The commands, called as a user calls them: in this process, or in one of its own that is killed."""

import os
import signal
import time
from contextlib import suppress
from functools import partial

from click.testing import CliRunner, Result

from cosim.cli import main as main_of_cosim
from nmfd.cli import main as main_of_nmfd

MAINS = {"nmfd": main_of_nmfd, "cosim": main_of_cosim}


def call(program: str, *arguments) -> Result:
    return CliRunner().invoke(MAINS[program], [str(argument) for argument in arguments])


nmfd, cosim = (partial(call, program) for program in MAINS)


def good(result: Result) -> str:
    """What a command printed that ended well."""
    assert result.exit_code == 0, result.output + result.stderr + repr(result.exception)
    return result.stdout


def error_line(result: Result, program: str = "cosim") -> str:
    """The one line that a command ended with."""
    assert result.exit_code == 2, result.output + repr(result.exception)
    assert result.stderr.startswith(f"{program}: error: ") and result.stderr.count("\n") == 1, result.stderr
    return result.stderr


def killed(*command, write: int | None = None, behind: bool = False, after: float = 60.0) -> bool:
    """Run a command in a forked process that is killed: beside its `write`-th write, or after so many seconds.

    behind: when that write has got its name, else just before. False if it ended before.
    """
    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            writes, replace = [0], os.replace

            def replace_or_die(source, target):
                writes[0] += 1
                if behind and writes[0] == write:
                    replace(source, target)
                if writes[0] == write:
                    os.kill(os.getpid(), signal.SIGKILL)
                replace(source, target)

            os.replace = replace_or_die
            call(*command)
        os._exit(0)
    deadline = time.monotonic() + after
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.WIFSIGNALED(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True
