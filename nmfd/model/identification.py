"""Identification of the regional model from runs, by prediction error.

MFDs fitted to outflow samples absorb what happens at the boundaries: a region that cannot send
vehicles on looks collapsed. Here MFDs, exit rates, boundary capacities and storage are fitted
together. They minimise the error of rollouts over several control intervals, from each observed
state, under observed demand and controls (Ljung, System Identification, 1999, ch. 7).

Steps of `fit`: `windows` cuts the runs into pieces, `_Model` holds the free numbers, `_rollout`
predicts a piece, `_misfit` weighs the errors by region and by destination, and `_network` makes a
RegionalModel of the result. `prediction_errors` tests a model on runs that the fit did not use.

`nmfd.model.counting` comes first: a fit is for cities in which counting does not separate MFDs and
rates, because congestion follows at once.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Real
from torch import Tensor

from nmfd.arrays import PairsOverTime, PerRegion, StatesOverTime, TurnsOverTime
from nmfd.metrics import largest_accumulation
from nmfd.model import dynamics
from nmfd.model.mfd import Cubic, of_numbers
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.progress import Show
from nmfd.tensors import one_thread

HORIZON = 10  # control intervals
ITERATIONS = 600
BATCH = 256  # rollouts per Adam step
LEARNING_RATE = 0.03  # of Adam; falls along a cosine
LAST_LEARNING_SHARE = 0.05  # of it, at the end
LARGEST_GRADIENT = 10.0  # norm beyond which a gradient is shortened
OUTLIER = 0.3  # of the scale: beyond, an error counts linearly (Huber)
BY_DESTINATION = 3.0  # weight of errors of x_ij, beside those of x_i
LEAST_RATE = 0.01  # of the free rate, up to the jam accumulation
EXIT_RATES = 8.0  # largest, and 1 / smallest
FEWEST_CROSSINGS = 30.0  # vehicles for split ratios
LEAST_SPLIT = 0.005  # smaller observed shares count as zero
RIDGE = 1e-3  # weight of squared log changes: parameters that the data do not determine stay


@dataclass(frozen=True, kw_only=True)
class Observed:
    """One run of T control intervals.

    accumulation: at the ends of intervals (veh, (T+1, R, R))
    inside: mean over each interval (veh, (T, R, R))
    demand: vehicles that entered (veh/s, (T, R, R))
    perimeter: (-, (T, R, R))
    splits: (-, (T, R, R, R))
    crossings: [i, h] from i to h (veh, (T, R, R))
    exits: [i, j] vehicles bound for j that left i, or for j = i ended their trip (veh, (T, R, R))
    """

    accumulation: StatesOverTime
    inside: PairsOverTime
    demand: PairsOverTime
    perimeter: PairsOverTime
    splits: TurnsOverTime
    crossings: Real[np.ndarray, "T R R"]
    exits: PairsOverTime | None = None


class Windows(NamedTuple):
    """N pieces of runs, each of so many control intervals, `horizon`.

    states: at the start, and after each interval (veh, (N, horizon + 1, R, R))
    demand: (veh/s, (N, horizon, R, R))
    perimeter: (-, (N, horizon, R, R))
    splits: (-, (N, horizon, R, R, R))
    """

    states: Tensor
    demand: Tensor
    perimeter: Tensor
    splits: Tensor

    @property
    def horizon(self) -> int:
        return self.demand.shape[1]


class _Model(torch.nn.Module):
    """Parameters of the regional model as free numbers.

    All numbers give a valid network.

    fastest: largest rate of any vehicle (1/s, (R,) or one number)
    """

    def __init__(
        self,
        network: RegionalModel,
        runs: Sequence[Observed],
        step: float,
        fastest: PerRegion | float,
    ):
        super().__init__()
        limits = np.broadcast_to(fastest, network.regions)
        self._fastest = torch.tensor(limits, dtype=torch.float32)
        self._u_max = network.u_max
        self.adjacency = torch.tensor(network.adjacency, dtype=torch.float32)
        largest = largest_accumulation(run.accumulation for run in runs)
        flow = np.max([run.crossings.max(axis=0) for run in runs], axis=0) / step
        free_rates = []
        for mfd, limit in zip(network.mfds, limits, strict=True):
            free_rates.append(min(mfd.rate_up_to_jam(0.0), 0.5 * limit))
        capacity = np.log(np.maximum(1.2 * flow, 0.05))
        self._first_capacity = torch.tensor(capacity, dtype=torch.float32)
        # Shape of the rate q: its value at 0, how far it falls up to the jam, and how it bends.
        self.free_rate = _free(np.log(free_rates))
        self.drop = _free(np.full(network.regions, 0.5))
        self.bend = _free(np.zeros(network.regions))
        self.jam = _free(np.log(np.maximum(0.7 * largest, 1.0)))
        self.exit_rates = _free(np.zeros(network.adjacency.shape))
        self.capacity = _free(capacity)
        self.storage = _free(np.log(np.maximum(2.0 * largest, 1.0)))

    def shape(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return c, first, second and jam of q = c (1 - first y - second y^2).

        y is x / jam. The rate q falls, and q(jam) >= LEAST_RATE c.
        """
        drop = (1.0 - LEAST_RATE) * torch.sigmoid(self.drop)
        first = 2.0 * drop * torch.sigmoid(self.bend)
        return self.free_rate.exp(), first, drop - first, self.jam.exp()

    def regional(self) -> dynamics.Parameters:
        """Return the parameters that the free numbers stand for."""
        c, first, second, jam = self.shape()
        rates = EXIT_RATES ** torch.tanh(self.exit_rates)
        rates = torch.minimum(rates, (0.999 * self._fastest / c).unsqueeze(-1))
        return dynamics.Parameters(
            mfd=of_numbers(Cubic, a=-c * second / jam**2, b=-c * first / jam, c=c, jam=jam),
            adjacency=self.adjacency,
            off_diagonal=1.0 - torch.eye(len(jam)),
            exit_rates=rates,
            capacity=self.capacity.exp() * self.adjacency / self._u_max,
            storage=self.storage.exp(),
        )

    def penalty(self) -> Tensor:
        """Return the ridge penalty of departures from the initial values."""
        moved = (self.capacity - self._first_capacity) * self.adjacency
        return RIDGE * ((self.exit_rates**2).mean() + (moved**2).mean())


def _free(values: Any) -> torch.nn.Parameter:
    """Return numbers that a fit changes."""
    return torch.nn.Parameter(torch.tensor(np.asarray(values), dtype=torch.float32))


def observed_split_ratios(
    network: RegionalModel, crossings: Real[np.ndarray, "R R R"]
) -> dict[tuple[int, int], dict[int, float]]:
    """Return (i, j) -> {h: share}: next regions h from i on the way to j.

    crossings: [i, h, j] from i to h, bound for j (veh, (R, R, R))
    """
    crossings = crossings * network.split_mask
    ratios = {}
    for i, j in np.argwhere(crossings.sum(axis=1) >= FEWEST_CROSSINGS):
        shares = crossings[i, :, j] / crossings[i, :, j].sum()
        next_regions = np.flatnonzero(shares >= LEAST_SPLIT)
        kept = {int(h): round(float(shares[h]), 4) for h in next_regions}
        total = sum(kept.values())
        ratios[int(i), int(j)] = {h: share / total for h, share in kept.items()}
    return ratios


def fit(
    network: RegionalModel,
    runs: Sequence[Observed],
    *,
    step: float,
    substeps: int = 1,
    integrator: str = "euler",
    fastest: PerRegion | None = None,
    iterations: int = ITERATIONS,
    seed: int = 0,
    progress: Show = None,
) -> RegionalModel:
    """Return `network` with the parameters that predict `runs` best.

    Fitted are MFDs, exit rates, capacities and storage. The rate q of each region falls and stays
    positive up to the jam accumulation, and step * q * exit rate <= 1 for the integration step.

    network: its MFDs are the initial guess, their critical accumulations the scale of the errors
    step: control interval (s)
    substeps, integrator: of the integration (nmfd.model.integration.integrated)
    fastest: largest rate of any vehicle (1/s, (R,)); that of the integration if None
    seed: of the batches
    progress: takes iterations done, all, and a note
    """
    with one_thread():  # the same order of sums everywhere
        generator = torch.Generator().manual_seed(seed)
        limit = substeps / step if fastest is None else fastest
        model = _Model(network, runs, step, limit)
        horizon = min(HORIZON, max(len(run.demand) for run in runs))
        data = windows(runs, horizon)
        count = len(data.states)
        scheme = {"step": step, "substeps": substeps, "integrator": integrator}
        scale = torch.tensor(network.critical, dtype=torch.float32)
        optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
        for iteration in range(iterations):
            for group in optimizer.param_groups:
                group["lr"] = _learning_rate(iteration, iterations)
            drawn = torch.randint(count, (min(BATCH, count),), generator=generator)
            batch = Windows(*(part[drawn] for part in data))
            misfit = _misfit(model.regional(), batch, scale, scheme)
            loss = misfit + model.penalty()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), LARGEST_GRADIENT)
            optimizer.step()
            if progress:
                progress(iteration + 1, iterations, f"misfit {misfit.item():.3f}")
        return _network(network, model, runs)


def _learning_rate(iteration: int, iterations: int) -> float:
    """Return the learning rate of an iteration: it falls along half a cosine."""
    cosine = 1.0 + math.cos(math.pi * iteration / iterations)
    return LEARNING_RATE * (LAST_LEARNING_SHARE + (1.0 - LAST_LEARNING_SHARE) * 0.5 * cosine)


def windows(runs: Sequence[Observed], horizon: int) -> Windows:
    """Return all pieces of `horizon` control intervals of all runs."""
    long = [run for run in runs if len(run.demand) >= horizon]

    def stack(series: Sequence[np.ndarray], length: int) -> Tensor:
        """Return the windows of arrays over time, one of each run."""
        cut = np.lib.stride_tricks.sliding_window_view
        parts = np.concatenate([cut(values, length, axis=0) for values in series])
        return torch.tensor(np.moveaxis(parts, -1, 1), dtype=torch.float32)

    return Windows(
        states=stack([run.accumulation for run in long], horizon + 1),
        demand=stack([run.demand for run in long], horizon),
        perimeter=stack([run.perimeter for run in long], horizon),
        splits=stack([run.splits for run in long], horizon),
    )


def _misfit(
    p: dynamics.Parameters, data: Windows, scale: Tensor, scheme: Mapping[str, Any]
) -> Tensor:
    """Return the mean Huber loss of x_i and x_ij over the horizon.

    scale: unit of the errors (veh, (R,))
    scheme: step [s], substeps, integrator
    """
    total = torch.zeros(())
    huber = torch.nn.SmoothL1Loss(beta=OUTLIER)
    for k, x in enumerate(_rollout(p, data, scheme), start=1):
        by_destination = (x - data.states[:, k]) / scale.unsqueeze(-1)
        by_region = by_destination.sum(-1)
        total = total + huber(by_region, torch.zeros_like(by_region))
        zero = torch.zeros_like(by_destination)
        total = total + BY_DESTINATION * huber(by_destination, zero)
    return total / data.horizon


def _rollout(p: dynamics.Parameters, data: Windows, scheme: Mapping[str, Any]) -> Iterator[Tensor]:
    """Yield the predicted states (N, R, R) [veh] after each interval."""
    x = data.states[:, 0]
    for k in range(data.horizon):
        inputs = data.demand[:, k], data.perimeter[:, k], data.splits[:, k]
        x = dynamics.advance(p, x, *inputs, **scheme)
        yield x


def _network(network: RegionalModel, model: _Model, runs: Sequence[Observed]) -> RegionalModel:
    """Return `network` with the fitted parameters.

    Exit rates are scaled to 1 on the average of a region's vehicles; the MFDs take the rest.
    """
    with torch.no_grad():
        p = model.regional()
    assert p.exit_rates is not None
    assert p.capacity is not None
    assert p.storage is not None
    rates = p.exit_rates.double().numpy()
    weight = sum(run.accumulation.sum(axis=0) for run in runs)
    weight[weight.sum(axis=1) == 0] = 1.0  # empty in all runs
    mean = (weight * rates).sum(axis=1) / weight.sum(axis=1)
    curves = [vars(p.mfd)[name].tolist() for name in ("a", "b", "c", "jam")]
    mfds = []
    for a, b, c, jam, factor in zip(*curves, mean, strict=True):
        mfds.append(Cubic(a=a * factor, b=b * factor, c=c * factor, jam=jam))
    return replace(
        network,
        mfds=tuple(mfds),
        exit_rates=rates / mean[:, None],
        equal_ways=False,
        capacity=p.capacity.double().numpy() * network.u_max * network.adjacency,
        storage=p.storage.double().numpy(),
    )


def prediction_errors(
    network: RegionalModel, runs: Sequence[Observed], intervals: int, **scheme: Any
) -> Float[np.ndarray, "N R"]:
    """Return predicted minus observed accumulation (N, R) [veh].

    intervals: how far ahead of each observed state
    scheme: step [s], substeps, integrator
    """
    data = windows(runs, intervals)
    p = dynamics.parameters(network, dtype=torch.float32)
    with torch.no_grad():
        *_, last = _rollout(p, data, scheme)
    return (last - data.states[:, -1]).sum(-1).numpy()
