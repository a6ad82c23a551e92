"""Tasks for processes of their own, in a module that imports little: a time limit must not be spent on that."""

import os
import time

import numpy as np

from nmfd.controllers import custom
from nmfd.types import Observation


def whose(task: str) -> int:
    """The process that does it; "late" takes a minute."""
    if task == "late":
        time.sleep(60.0)
    return os.getpid()


def acted(task: tuple) -> int:
    """Five decisions of a controller of the user's own, (name, scenario); how many there were."""
    name, scenario = task
    own, nothing = custom.make(name, scenario), np.zeros((scenario.network.regions,) * 2)
    own.reset(1)
    for step in range(5):
        own.act(Observation(step=step, time=0.0, accumulation=nothing.copy(), backlog=nothing.copy()))
    return step + 1
