"""Faults to order: what sensors, solvers, policies, signals and streets may do in earnest, injected into a run.

A fault is a text, KIND[:VALUE][@FROM-TO], in the list `faults` of scenario.toml or behind --fault; FROM and TO are
control intervals, TO the first one that is well again; without them it lasts for the whole run. Whatever is done
instead is in the status of every decision (nmfd.types.Status, counted apart in every table).
"""

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nmfd.arrays import PerPair
from nmfd.errors import InputError, did_you_mean
from nmfd.types import Controller, Controls, Observation, Status

# Kind -> what its value is, or None. Of the measurements, of what computes the controls, and of the city.
SENSORS = {"frozen": None, "delayed": "intervals", "missing": "region", "detectors": "share", "off": "factor"}
COMPUTING = {"solver-fails": None, "solver-diverges": None, "solver-late": None, "policy-nan": None}
CITY = {"closed": "edge", "signal": "signal", "gate": "gate", "sumo-exits": None}
KINDS = {**SENSORS, **COMPUTING, **CITY}
EXAMPLES = {
    "intervals": "delayed:2",
    "region": "missing:3",
    "share": "detectors:0.2",
    "factor": "off:1.5",
    "edge": "closed:A0A1",
    "signal": "signal:B1",
    "gate": "gate:2-3=0",
}
GATE = re.compile(r"(?P<source>\d{1,4})-(?P<target>\d{1,4})=(?P<share>[^=]+)")
LAST = 999_999  # the last control interval that a text can name
FORM = re.compile(r"(?P<kind>[a-z-]+)(:(?P<value>[^@]+))?(@(?P<begin>\d{1,6})-(?P<end>\d{1,6}))?")


@dataclass(frozen=True, kw_only=True)
class Fault:
    """kind: one of KINDS; number, name: its value; begin, end: control intervals, begin <= k < end.

    pair: (i, h) of a gate, which is held at the share `number` between u_min (0) and u_max (1)
    """

    kind: str
    number: float = 0.0
    name: str = ""
    begin: int = 0
    end: int = 10**9
    pair: tuple[int, int] | None = None

    @property
    def text(self) -> str:
        """As it is ordered: what `parse` makes the same fault of."""
        value = self.name if self.name or KINDS[self.kind] is None else f"{self.number:g}"
        when = f"@{self.begin}-{min(self.end, LAST)}" if self.begin or self.end <= LAST else ""
        return self.kind + (f":{value}" if value else "") + when

    def active(self, k: int) -> bool:
        """Whether it is there in control interval k."""
        return self.begin <= k < self.end


def parse(text: str, where: str, regions: int) -> Fault:
    """The fault that `text` orders. InputError, which begins with `where`."""
    match = FORM.fullmatch(text)
    if match is None or match["kind"] not in KINDS:
        hint = did_you_mean(re.split("[:@]", text)[0], KINDS)
        raise InputError(
            f"{where}: expected KIND[:VALUE][@FROM-TO] with a kind out of {', '.join(KINDS)}, got {text[:60]!r} "
            f"instead{hint}"
        )
    kind, value = match["kind"], match["value"]
    begin, end = int(match["begin"] or 0), int(match["end"] or 10**9)
    unit = KINDS[kind]
    if end <= begin:
        raise InputError(f"{where}: {text}: expected control intervals FROM-TO with FROM < TO, such as @10-20")
    if (value is None) != (unit is None):
        what = f"needs a {unit}, such as {EXAMPLES[unit]}" if unit else "takes no value"
        raise InputError(f"{where}: {text}: {kind} {what}")
    if unit == "gate":
        return replace(gate(value or "", f"{where}: {text}", regions), begin=begin, end=end)
    if unit in (None, "edge", "signal"):
        return Fault(kind=kind, name=value or "", begin=begin, end=end)
    low, high, whole = {
        "intervals": (1, 1000, True),
        "region": (0, regions - 1, True),
        "share": (0.0, 1.0, False),
        "factor": (0.0, 10.0, False),
    }[unit]
    try:
        number = float(value)
    except ValueError:
        number = np.nan
    if not low <= number <= high or (whole and number != int(number)):
        kind_of = "whole number" if whole else "number"
        raise InputError(
            f"{where}: {kind}: expected a {kind_of} from {low:g} to {high:g} as its {unit}, got {value[:60]!r} instead"
        )
    return Fault(kind=kind, number=number, begin=begin, end=end)


def gate(value: str, where: str, regions: int) -> Fault:
    """The fault that I-H=SHARE orders. InputError, which begins with `where`."""
    match = GATE.fullmatch(value)
    source, target = (int(match["source"]), int(match["target"])) if match else (0, 0)
    try:
        share = float(match["share"]) if match else np.nan
    except ValueError:
        share = np.nan
    if source == target or max(source, target) >= regions or not 0.0 <= share <= 1.0:
        raise InputError(
            f"{where}: expected I-H=SHARE, two regions from 0 to {regions - 1} and a share from 0 (the least green) to "
            f"1 (all), such as {EXAMPLES['gate']}, got {value[:60]!r} instead"
        )
    return Fault(kind="gate", number=share, name=f"{source}-{target}={share:g}", pair=(source, target))


def by_hand(orders: Sequence[tuple[int, int, int, float | None]]) -> list[str]:
    """The faults that would have ordered the same beforehand: gates that were switched while a run went on.

    orders: (k, i, h, share) in their order: from control interval k on; share None: let go of
    """
    held: dict[tuple[int, int], Fault] = {}
    found = []
    for k, source, target, share in orders:
        before = held.pop((source, target), None)
        if before is not None and before.begin < k:
            found.append(replace(before, end=k))
        if share is not None:
            value = f"{source}-{target}={share:g}"
            held[source, target] = Fault(kind="gate", number=share, name=value, begin=k, pair=(source, target))
    return [fault.text for fault in sorted([*found, *held.values()], key=lambda fault: (fault.begin, fault.name))]


def without_city(faults: Sequence[Fault], where: str) -> None:
    """InputError for a fault that only a simulated city can have."""
    for fault in faults:
        if fault.kind in CITY:
            raise InputError(f"{where}: {fault.kind} is a fault of a city in SUMO, not of the regional model; omit it")


class Sensors:
    """What controllers see, with the faults of `SENSORS`; what is missing is what was seen last, 0 before the first.

    Of estimates (of a plant that simulates detectors) missing detectors are the plant's own business.
    """

    def __init__(self, faults: Sequence[Fault], seed: int):
        self._faults = [fault for fault in faults if fault.kind in SENSORS]
        self._random = np.random.default_rng([seed, 0x6661756C])
        longest = max((int(fault.number) for fault in self._faults if fault.kind == "delayed"), default=0)
        self._seen: deque[Observation] = deque(maxlen=longest + 1)
        self._frozen: dict[int, Observation] = {}
        self._silent: np.ndarray | None = None
        self._last: np.ndarray | None = None

    def see(self, observation: Observation, *, estimated: bool) -> tuple[Observation, str]:
        """The observation as it arrives, and what is wrong with it, "" if nothing is."""
        problems, k = [], observation.step
        self._seen.append(observation)
        for number, fault in enumerate(self._faults):
            if not fault.active(k):
                continue
            x, problem = observation.accumulation, ""
            match fault.kind:
                case "frozen":
                    observation, problem = self._then(self._frozen.setdefault(number, observation), k), "frozen"
                case "delayed":
                    late = min(int(fault.number), len(self._seen) - 1)
                    observation, problem = self._then(self._seen[-1 - late], k), f"{late} intervals late"
                case "missing":
                    observation = replace(
                        observation, accumulation=np.where(np.arange(len(x))[:, None] == int(fault.number), np.nan, x)
                    )
                case "detectors" if not estimated:
                    if self._silent is None:
                        self._silent = self._random.random(x.shape) < fault.number
                    observation = replace(observation, accumulation=np.where(self._silent, np.nan, x))
                case "off":
                    observation = replace(
                        observation, accumulation=fault.number * x, backlog=(fault.number * observation.backlog)
                    )
                    problem = f"off by a factor of {fault.number:g}"
            problems += [problem] if problem else []
        observation, missing = self._filled(observation)
        problems += [f"{missing} of {observation.accumulation.size} entries missing, last ones used"] if missing else []
        return observation, f"measurement {', '.join(problems)}" if problems else ""

    @staticmethod
    def _then(before: Observation, k: int) -> Observation:
        """`before` as if it were of now: the controller does not know better."""
        return replace(before, step=k)

    def _filled(self, observation: Observation) -> tuple[Observation, int]:
        """With what was seen last in place of what is no number, and how many entries that were."""
        x, backlog = observation.accumulation, observation.backlog
        good = np.isfinite(x)
        missing = int(x.size - good.sum())
        if missing or not np.isfinite(backlog).all():
            last = np.zeros_like(x) if self._last is None else self._last
            observation = replace(
                observation, accumulation=np.where(good, x, last), backlog=np.nan_to_num(backlog, posinf=0.0)
            )
        self._last = observation.accumulation
        return observation, missing


class Supervised:
    """A controller with the faults of COMPUTING, whose controls are looked at before they go anywhere.

    Controls that are no numbers are replaced by the open perimeter, without route guidance.
    """

    def __init__(self, controller: Controller, faults: Sequence[Fault], opened: PerPair):
        """opened: (R, R) [-], the perimeter that is taken instead"""
        self.name, self._controller, self._opened = controller.name, controller, opened
        self._faults = [fault for fault in faults if fault.kind in COMPUTING]

    def reset(self, seed: int = 0) -> None:
        self._controller.reset(seed)

    def act(self, observation: Observation, problem: str = "") -> Controls:
        """problem: with the observation, for the status"""
        if self._faults and hasattr(self._controller, "fault"):  # others have no solver and no policy
            kinds = [fault.kind for fault in self._faults if fault.active(observation.step)]
            self._controller.fault = kinds[0] if kinds else None
        controls = self._controller.act(observation)
        asked = (controls.perimeter, controls.splits, controls.prices, controls.metering)
        if not all(np.isfinite(numbers).all() for numbers in asked if numbers is not None):
            controls = Controls(
                perimeter=self._opened,
                splits=None,
                status=Status.SOLVER_FAILURE | Status.FALLBACK,
                note="the controls were no numbers: perimeter opened",
            )
        if not problem:
            return controls
        return replace(
            controls,
            status=controls.status | Status.SENSOR_FAULT,
            note="; ".join(note for note in (problem, controls.note) if note),
        )
