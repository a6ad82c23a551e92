"""Tasks for processes of their own, in a module that is imported in no time: a time limit must not be spent on that."""

import os
import time


def whose(task: str) -> int:
    """The process that does it; "late" takes a minute."""
    if task == "late":
        time.sleep(60.0)
    return os.getpid()
