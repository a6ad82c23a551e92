"""The steps of a control interval on a processor, by machine code."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmfd.model.links.compiled import (
    Choosing,
    City,
    Counts,
    Given,
    Histories,
    Sums,
    advance,
    derive,
)
from nmfd.model.links.flows import EPSILON, LEAST, Delay, Flows, Traffic
from nmfd.model.links.interval import Interval, LinkState, Passed, Steps
from nmfd.model.links.signals import (
    CALLED_VEH,
    DECISION_PERIOD_S,
    LONGEST_GREEN_S,
    LONGEST_RED_S,
    Actuated,
    Lights,
    MaxPressure,
    Stages,
)
from nmfd.tensors import THREADS

# Numbers of a city by the attributes of its Flows.
FLOWS = (
    "link_of_entry",
    "region_of_entry",
    "entry_of_cell",
    "onward",
    "_turn_of_cell",
    "_movement_of_turn",
    "_link_entered",
    "_link_left",
    "_served",
    "_server",
    "_link_of_lane",
    "_yielding",
    "_foe",
    "_gaps",
    "_minor",
    "_home",
    "_home_link",
    "_ahead",
    "_met",
    "_pace_to_end",
    "_earlier",
    "_part",
    "storage",
    "_most_in",
    "_first_of_lane",
    "_lanes_of_turn",
    "_lane_share",
    "_pace",
    "_per_step",
)
DELAYS = ("_along", "_started", "_to_end", "_backwards")
CHOOSING = Choosing._fields[: Choosing._fields.index("called")]
GATES = ("movement", "link", "whole", "taken", "cycle")
# What has derivatives: fields of Given, and of Traffic as in Counts.
OF_GIVEN = ("due", "cells", "metering", "gates")
OF_TRAFFIC = Counts._fields[1:-1]


class Rows(Delay):
    """Delay whose history is one tensor of rows (B, rows, n), the newest last."""

    def __init__(self, steps: np.ndarray, device: torch.device):
        super().__init__(steps, device)
        self.ages = torch.as_tensor(steps, device=device)
        self.rows = int(steps.max(initial=1)) + 1

    def start(self, values: Tensor) -> Tensor:
        return values.unsqueeze(1).expand(-1, self.rows, -1)

    def with_new(self, history: Tensor, values: Tensor) -> Tensor:
        return torch.cat([history[:, 1:], values.unsqueeze(1)], dim=1)

    def read(self, history: Tensor) -> Tensor:
        return self._aged(history, self.ages)

    def older(self, history: Tensor) -> Tensor:
        return self._aged(history, self.ages + 1)

    def younger(self, history: Tensor) -> Tensor:
        age = torch.arange(self.rows, 0, -1, device=history.device)
        return (history * (age.unsqueeze(1) <= self.ages)).sum(1)

    def _aged(self, history: Tensor, ages: Tensor) -> Tensor:
        place = (self.rows - ages).expand(len(history), 1, -1)
        return history.gather(1, place).squeeze(1)


class ProcessorFlows(Flows):
    """Flows with histories for machine code."""

    delay = Rows


class CompiledMaxPressure(MaxPressure):
    """Max-pressure by machine code."""

    def __init__(self, flows: Flows, lookahead: float):
        super().__init__(flows, lookahead)
        kind = flows.storage.numpy().dtype.type
        arrays = {name: getattr(self, f"_{name}").numpy() for name in CHOOSING}
        self.numbers = Choosing(
            **arrays,
            called=kind(CALLED_VEH),
            decision_period=kind(DECISION_PERIOD_S),
            longest_green=kind(LONGEST_GREEN_S),
            longest_red=kind(LONGEST_RED_S),
            lookahead=kind(lookahead),
            dt=kind(flows.dt),
            zero=kind(0.0),
            one=kind(1.0),
        )


class CompiledSteps(Steps):
    """Steps by machine code.

    It is compiled when first used on a machine, which takes half a minute.
    """

    def __init__(self, *parts: Any):
        super().__init__(*parts)
        self.city = self._numbers()

    def __call__(self, state: LinkState, interval: Interval) -> Passed:
        """Return the state an interval later."""
        run = _Run(self, state, interval)
        if torch.is_grad_enabled():
            return run.passed(_Differentiable.apply(run, *run.varied))
        return run.passed(run.advanced(rows=1))

    def _numbers(self) -> City:
        """Return the numbers of the city."""
        flows = self.flows
        gates = self.gates
        kind = flows.storage.numpy().dtype.type
        tensors = {name.lstrip("_"): getattr(flows, name) for name in FLOWS}
        tensors |= {name: getattr(flows, name).ages for name in DELAYS}
        tensors |= {name: getattr(gates, name) for name in GATES}
        tensors["cells"] = torch.argsort(flows.entry_of_cell, stable=True)
        cells = torch.bincount(flows.entry_of_cell, minlength=flows.entries)
        tensors["first_cell"] = torch.nn.functional.pad(torch.cumsum(cells, 0), (1, 0))
        arrays = {}
        for name, tensor in tensors.items():
            array = tensor.numpy()
            # For signed places, machine code asks whether they count from the end.
            arrays[name.lstrip("_")] = array if array.dtype == kind else array.astype(np.uint32)
        return City(
            **arrays,
            extended=gates.extended,
            chain_limit=kind(self.chain_limit),
            smoothing=kind(flows.smoothing),
            dt=kind(flows.dt),
            epsilon=kind(EPSILON),
            least=kind(LEAST),
            zero=kind(0.0),
            one=kind(1.0),
        )


class _Run:
    """The steps of one interval.

    count: their number
    varied: tensors that have derivatives: OF_GIVEN, then those of Counts but `asked`, Histories
    """

    def __init__(self, steps: CompiledSteps, state: LinkState, interval: Interval):
        traffic = state.traffic
        due = interval.due
        self.varied = [
            due,
            interval.ways.cells,
            _rows(interval.metering, due, steps.flows.network.regions),
            _rows(interval.gates, due, len(steps.city.whole)),
            *(getattr(traffic, name) for name in OF_TRAFFIC),
            state.used,
            *(getattr(traffic, name) for name in Histories._fields),
        ]
        self.count = steps.steps
        self._steps = steps
        self._state = state
        self._interval = interval
        self._stages: Any = state.stages
        self._first = state.interval * steps.steps  # number of the first step
        self._given = self._read()

    def advanced(self, rows: int) -> tuple[Tensor, ...]:
        """Return the fields of Counts, Histories and Sums after the interval.

        rows: of the counts, as Counts
        """
        count = self.count
        begin = _arrays(self.varied[len(OF_GIVEN) :])
        asked = _arrays([self._state.asked])
        counts = []
        for values in asked + begin[: -len(Histories._fields)]:
            kept = np.empty((rows, *values.shape), values.dtype)
            kept[0] = values
            counts.append(kept)
        histories = []
        for values in begin[-len(Histories._fields) :]:
            batch, first, columns = values.shape
            kept = np.empty((batch, first + count, columns), values.dtype)
            kept[:, :first] = values
            histories.append(kept)
        self._counts = Counts(*counts)
        self._histories = Histories(*histories)
        used = self._counts.used[0]
        inside = self._counts.inside[0]
        numbers = [np.zeros(len(used)) for _ in range(3)]  # sums of many: in float64
        sums = Sums(*numbers, *(np.zeros_like(values) for values in (inside, inside, used)))
        signals = self._steps.signals
        choosing = None
        stages = None
        if isinstance(signals, CompiledMaxPressure):
            choosing = signals.numbers
            self._stages = Stages(*(part.clone() for part in self._stages))
            stages = Stages(*_arrays(self._stages))
        city = self._steps.city
        arguments = (city, self._given, self._counts, self._histories, sums, choosing, stages)
        now = 0
        while now < count:
            then = self._show(now, rows)
            _in_threads(advance, len(used), *arguments, self._first, now, then)
            now = then
        after = [values[count % rows].copy() for values in counts]
        after += [values[:, count:].copy() for values in histories]
        after += [values.astype(used.dtype) for values in sums]
        return tuple(map(torch.from_numpy, after))

    def derived(self, weights: Sequence[Tensor]) -> list[Tensor]:
        """Return the derivatives by the varied tensors.

        Call it once, after `advanced` with a row for each step.

        weights: derivatives by its results
        """
        by = _arrays(weights)
        counts = [array.copy() for array in by[: len(Counts._fields)]]
        histories = []
        for values, last in zip(self._histories, by[len(counts) :], strict=False):
            found = np.zeros_like(values)
            found[:, self.count :] = last
            histories.append(found)
        sums = Sums(*by[-len(Sums._fields) :])
        given = [np.zeros_like(getattr(self._given, name)) for name in OF_GIVEN]
        _in_threads(
            derive,
            len(given[0]),
            self._steps.city,
            self._given,
            self._counts,
            self._histories,
            self._given._replace(**dict(zip(OF_GIVEN, given, strict=True))),
            Counts(*counts),
            Histories(*histories),
            sums,
        )
        for number, found in enumerate(histories):
            histories[number] = found[:, : -self.count]
        return [torch.from_numpy(array) for array in (*given, *counts[1:], *histories)]

    def passed(self, after: Sequence[Tensor]) -> Passed:
        """Return the state after the interval from what `advanced` returns."""
        fields = (*Counts._fields, *Histories._fields)
        values = dict(zip(fields, after, strict=False))
        asked = values.pop("asked")
        used = values.pop("used")
        sums = Sums(*after[-len(Sums._fields) :])
        return Passed(
            traffic=Traffic(**values, outside=sums.waiting),
            used=used,
            stages=self._stages,
            asked=asked,
            begun=sums.begun,
            present=sums.present,
            outside=sums.outside,
            held=sums.held,
            share=sums.share,
        )

    def _read(self) -> Given:
        """Return commands, shares and the lights of the programmes."""
        interval = self._interval
        ways = interval.ways
        batch = len(interval.due)
        choice = [ways.cells, torch.empty(0, 0), torch.empty(0, 0), torch.empty(0, 0, 0)]
        if ways.choice is not None:
            chosen = torch.empty_like(ways.cells)
            choice = [chosen, ways.choice.low, ways.choice.high, ways.choice.draws]
        lights = []
        for programme in (interval.light, interval.yields):
            lights.append(programme.unsqueeze(1).repeat(1, batch, 1))
        due, cells, metering, gates = self.varied[: len(OF_GIVEN)]
        fields = [due, cells, ways.goes_on, ways.ends, *choice, metering, gates, *lights]
        return Given(*_arrays([*fields, interval.opens]))

    def _show(self, now: int, rows: int) -> int:
        """Set the lights of actuated signals in step `now`.

        Return the step up to which all lights are known.
        """
        signals = self._steps.signals
        if not isinstance(signals, Actuated):
            return self.count
        interval = self._interval
        number = self._first + now
        programme = Lights(interval.light[now : now + 1], interval.yields[now : now + 1])
        with torch.no_grad():
            traffic = self._traffic(now, rows)
            self._stages, shown = signals.step(number, self._stages, traffic, programme)
        self._given.light[now] = shown.light
        self._given.yields[now] = shown.yields
        return now + 1

    def _traffic(self, now: int, rows: int) -> Traffic:
        """Return the state before step `now`."""
        counts = {}
        for name in OF_TRAFFIC:
            counts[name] = torch.from_numpy(getattr(self._counts, name)[now % rows])
        for name, values in self._histories._asdict().items():
            counts[name] = torch.from_numpy(values[:, now : values.shape[1] - self.count + now])
        return Traffic(**counts, outside=self._state.traffic.outside)


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, run: _Run, *varied: Tensor) -> tuple[Tensor, ...]:
        ctx.run = run
        return run.advanced(rows=run.count + 1)

    @staticmethod
    def backward(ctx: Any, *weights: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *ctx.run.derived(weights))


def _in_threads(function: Callable, batch: int, *arguments: Any) -> None:
    """Call machine code for B rollouts, in a thread per core."""
    threads = min(THREADS, batch)
    bounds = [number * batch // threads for number in range(threads + 1)]
    parts = list(pairwise(bounds))
    if threads == 1:
        function(*arguments, parts[0])
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(partial(function, *arguments), parts))  # raises the first error


def _rows(command: Tensor | None, due: Tensor, columns: int) -> Tensor:
    """Return a command with a row for each rollout; without one, no rows."""
    if command is None:
        return due.new_empty(0, columns)
    return command.expand(len(due), -1)


def _arrays(tensors: Sequence[Tensor]) -> list[np.ndarray]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]
