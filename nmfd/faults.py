"""Faults of a run: sensors that freeze, lag or fail, closed streets, signals that do not obey.

A fault is a text KIND[:VALUE][@FROM-TO] in the list `faults` of scenario.toml. FROM and TO are
control intervals, TO excluded; without them the fault lasts for the whole run. Every decision under
a fault carries it in its status.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nmfd.errors import InputError
from nmfd.types import Observation

FORMS = "frozen, delayed:INTERVALS, missing:REGION, closed:EDGE or signal:SIGNAL, with @FROM-TO for some intervals only"
FORM = re.compile(
    r"(frozen|(?:delayed|missing):\d{1,3}|(?:closed|signal):[^@]+)(?:@(\d{1,6})-(\d{1,6}))?"
)
CITY = ("closed", "signal")
FOREVER = 10**9


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault: kind, value as text, and control intervals begin <= k < end in which it is
    active."""

    kind: str
    value: str = ""
    begin: int = 0
    end: int = FOREVER

    def active(self, k: int) -> bool:
        return self.begin <= k < self.end


def parse(text: str, where: str, regions: int) -> Fault:
    """Return the fault that `text` describes. Raises InputError, which begins with `where`."""
    match = FORM.fullmatch(text)
    kind, _, value = match[1].partition(":") if match else ("", "", "")
    begin, end = (int(match[2] or 0), int(match[3] or FOREVER)) if match else (0, 0)
    if end <= begin or (kind == "missing" and int(value) >= regions):
        raise InputError(f"{where}: expected {FORMS}, got {text[:60]!r} instead")
    return Fault(kind=kind, value=value, begin=begin, end=end)


class Sensors:
    """Observations with sensor faults; missing entries keep their last value, 0 at the start."""

    def __init__(self, faults: Sequence[Fault]):
        self._faults = [fault for fault in faults if fault.kind not in CITY]
        self._seen: list[Observation] = []
        self._frozen: dict[int, Observation] = {}
        self._last: np.ndarray | None = None

    def see(self, observation: Observation) -> tuple[Observation, str]:
        """Return the observation as it arrives, and a text that names the faults, "" if there are
        none."""
        problems, k = [], observation.step
        self._seen.append(observation)
        for number, fault in enumerate(self._faults):
            if not fault.active(k):
                continue
            if fault.kind == "frozen":
                observation = replace(self._frozen.setdefault(number, observation), step=k)
                problems.append("frozen")
            elif fault.kind == "delayed":
                late = min(int(fault.value), len(self._seen) - 1)
                observation = replace(self._seen[-1 - late], step=k)
                problems.append(f"{late} intervals late")
            else:
                accumulation = observation.accumulation.copy()
                accumulation[int(fault.value)] = np.nan
                observation = replace(observation, accumulation=accumulation)
        x = observation.accumulation
        if missing := int((~np.isfinite(x)).sum()):
            last = np.zeros_like(x) if self._last is None else self._last
            observation = replace(observation, accumulation=np.where(np.isfinite(x), x, last))
            problems.append(f"{missing} of {x.size} entries missing, last ones used")
        self._last = observation.accumulation
        observation = replace(
            observation, realised=self._seen[-1].realised
        )  # which no sensor measures
        return observation, f"measurement {', '.join(problems)}" if problems else ""
