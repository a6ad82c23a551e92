"""Faults of a run: of sensors, streets and signals.

Sensors freeze, lag or fail; streets are closed; signals do not obey. A fault is a text
KIND[:VALUE][@FROM-TO] in the list `faults` of scenario.toml. FROM and TO are control intervals, TO
excluded; without them the fault lasts for the whole run. Every decision under a fault carries it in
its status.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nmfd.errors import InputError
from nmfd.types import Observation

FORMS = (
    "frozen, delayed:INTERVALS, missing:REGION, closed:EDGE or signal:SIGNAL, with @FROM-TO for "
    "some intervals only"
)
FORM = re.compile(
    r"(frozen|(?:delayed|missing):\d{1,3}|(?:closed|signal):[^@]+)(?:@(\d{1,6})-(\d{1,6}))?"
)
CITY = ("closed", "signal")
FOREVER = 10**9


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Fault, active in control intervals begin <= k < end; value: as text."""

    kind: str
    value: str = ""
    begin: int = 0
    end: int = FOREVER

    def active(self, k: int) -> bool:
        return self.begin <= k < self.end


def parse(text: str, where: str, regions: int) -> Fault:
    """Return the fault that `text` describes.

    where: what the message of an error begins with
    regions: number of regions

    Raises: InputError
    """
    wrong = InputError(f"{where}: expected {FORMS}, got {text[:60]!r} instead")
    match = FORM.fullmatch(text)
    if match is None:
        raise wrong
    kind, _, value = match[1].partition(":")
    begin = int(match[2] or 0)
    end = int(match[3] or FOREVER)
    if end <= begin:
        raise wrong
    if kind == "missing" and int(value) >= regions:
        raise wrong
    return Fault(kind=kind, value=value, begin=begin, end=end)


class Sensors:
    """Observations with sensor faults.

    Missing entries keep their last value, 0 at the start.
    """

    def __init__(self, faults: Sequence[Fault]):
        self._faults = [fault for fault in faults if fault.kind not in CITY]
        self._seen: list[Observation] = []
        self._frozen: dict[int, Observation] = {}
        self._last: np.ndarray | None = None

    def see(self, observation: Observation) -> tuple[Observation, str]:
        """Return the observation as it arrives, and a text that names the faults.

        The text is "" if there are none.
        """
        k = observation.step
        self._seen.append(observation)
        arrived = observation
        problems = []
        for number, fault in enumerate(self._faults):
            if not fault.active(k):
                continue
            if fault.kind == "frozen":
                first = self._frozen.setdefault(number, arrived)
                arrived = replace(first, step=k)
                problems.append("frozen")
            elif fault.kind == "delayed":
                late = min(int(fault.value), len(self._seen) - 1)
                arrived = replace(self._seen[-1 - late], step=k)
                problems.append(f"{late} intervals late")
            else:
                accumulation = arrived.accumulation.copy()
                accumulation[int(fault.value)] = np.nan
                arrived = replace(arrived, accumulation=accumulation)
        there = np.isfinite(arrived.accumulation)
        missing = int((~there).sum())
        if missing:
            last = 0.0 if self._last is None else self._last
            filled = np.where(there, arrived.accumulation, last)
            arrived = replace(arrived, accumulation=filled)
            problems.append(f"{missing} of {there.size} entries missing, last ones used")
        self._last = arrived.accumulation
        # `realised` comes from the signals, not from a sensor.
        arrived = replace(arrived, realised=observation.realised)
        if not problems:
            return arrived, ""
        return arrived, f"measurement {', '.join(problems)}"
