"""Identification of the regional model from observed runs: all parameters at once, by prediction
error.

MFDs fitted to outflow samples absorb what happens at the boundaries: a region that cannot send
vehicles on looks collapsed. Here MFDs, exit rates, boundary capacities and storage minimise the
error of rollouts over several control intervals, from each observed state under observed demand and
controls (Ljung, System Identification, 1999, ch. 7).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Real
from torch import Tensor

from nmfd.arrays import PairsOverTime, StatesOverTime, TurnsOverTime
from nmfd.metrics import largest_accumulation
from nmfd.model import dynamics
from nmfd.model.mfd import Cubic, of_numbers
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import one_thread

HORIZON = 10  # control intervals
ITERATIONS = 600
BATCH = 256  # rollouts per Adam step
LEARNING_RATE = 0.03
OUTLIER = 0.3  # of the scale: beyond, an error counts linearly (Huber)
BY_DESTINATION = 3.0  # weight of errors of x_ij, beside those of x_i
LEAST_RATE = 0.01  # of the free rate, up to the jam accumulation
EXIT_RATES = 8.0  # largest, and 1 / smallest
FEWEST_CROSSINGS = 30.0  # vehicles for split ratios
RIDGE = 1e-3  # weight of squared log changes: parameters that the data do not determine stay


@dataclass(frozen=True, kw_only=True)
class Observed:
    """One run of T control intervals.

    accumulation: (T+1, R, R) [veh]; demand: (T, R, R) [veh/s], entered vehicles; perimeter: (T, R,
        R) [-];
    splits: (T, R, R, R) [-]; crossings: (T, R, R) [veh], [i, h] from i to h
    """

    accumulation: StatesOverTime
    demand: PairsOverTime
    perimeter: PairsOverTime
    splits: TurnsOverTime
    crossings: Real[np.ndarray, "T R R"]


class _Model(torch.nn.Module):
    """Parametrisation of `dynamics.Parameters` in which every choice of free numbers is a valid
    network."""

    def __init__(
        self, network: RegionalModel, runs: Sequence[Observed], step: float, fastest: float
    ):
        super().__init__()

        def free(values: Any) -> torch.nn.Parameter:
            return torch.nn.Parameter(
                torch.as_tensor(np.asarray(values), dtype=torch.float32).clone()
            )

        self.adjacency, self._fastest = (
            torch.tensor(network.adjacency, dtype=torch.float32),
            fastest,
        )
        self._u_max = network.u_max
        largest = largest_accumulation(run.accumulation for run in runs)
        flow = np.max([run.crossings.max(axis=0) for run in runs], axis=0) / step
        self.free_rate = free(
            np.log([min(mfd.rate_up_to_jam(0.0), 0.5 * fastest) for mfd in network.mfds])
        )
        self.drop, self.bend = free(np.full(network.regions, 0.5)), free(np.zeros(network.regions))
        self.jam = free(np.log(np.maximum(0.7 * largest, 1.0)))
        self.exit_rates = free(np.zeros(network.adjacency.shape))
        self._first_capacity = torch.tensor(
            np.log(np.maximum(1.2 * flow, 0.05)), dtype=torch.float32
        )
        self.capacity = free(self._first_capacity)
        self.storage = free(np.log(np.maximum(2.0 * largest, 1.0)))

    def shape(self) -> tuple[Tensor, ...]:
        """Return c, first, second, jam of q = c (1 - first y - second y^2), y = x / jam, q(jam) >=
        LEAST_RATE c."""
        drop = (1.0 - LEAST_RATE) * torch.sigmoid(self.drop)
        first = 2.0 * drop * torch.sigmoid(self.bend)
        return self.free_rate.exp(), first, drop - first, self.jam.exp()

    def regional(self) -> dynamics.Parameters:
        c, first, second, jam = self.shape()
        rates = EXIT_RATES ** torch.tanh(self.exit_rates)
        rates = torch.minimum(rates, 0.999 * self._fastest / c.unsqueeze(-1))
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


def observed_split_ratios(
    network: RegionalModel, crossings: Real[np.ndarray, "R R R"]
) -> dict[tuple[int, int], dict[int, float]]:
    """Return (i, j) -> {h: share}, the observed next regions of vehicles in i bound for j.

    crossings: (R, R, R) [veh], [i, h, j] = from i to h, bound for j
    """
    crossings = crossings * network.split_mask
    ratios = {}
    for i, j in np.argwhere(crossings.sum(axis=1) >= FEWEST_CROSSINGS):
        shares = crossings[i, :, j] / crossings[i, :, j].sum()
        kept = {int(h): round(float(shares[h]), 4) for h in np.flatnonzero(shares >= 0.005)}
        ratios[int(i), int(j)] = {h: share / sum(kept.values()) for h, share in kept.items()}
    return ratios


def fit(
    network: RegionalModel,
    runs: Sequence[Observed],
    *,
    step: float,
    substeps: int = 1,
    integrator: str = "euler",
    iterations: int = ITERATIONS,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> RegionalModel:
    """Return `network` with the MFDs, exit rates, capacities and storage that predict `runs` best.

    Its MFDs are the initial guess and their critical accumulations the scale of the errors. The
    rate q of each region falls and stays positive up to the jam accumulation, and step * q * exit
    rate <= 1 for the integration step.
    """
    with one_thread():  # the same order of sums everywhere
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        model = _Model(network, runs, step, substeps / step)
        horizon = min(HORIZON, max(len(run.demand) for run in runs))
        data, scheme = (
            windows(runs, horizon),
            {"step": step, "substeps": substeps, "integrator": integrator},
        )
        scale = torch.tensor(network.critical, dtype=torch.float32)
        optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
        for iteration in range(iterations):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (
                    0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * iteration / iterations))
                )
            batch = torch.randint(len(data[0]), (min(BATCH, len(data[0])),), generator=generator)
            loss = _misfit(model.regional(), [part[batch] for part in data], scale, scheme)
            optimizer.zero_grad()
            (loss + model.penalty()).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
            optimizer.step()
            if progress:
                progress(iteration + 1, iterations, f"misfit {loss.item():.3f}")
        return _network(network, model, runs)


def windows(runs: Sequence[Observed], horizon: int) -> list[Tensor]:
    """Return states (N, horizon + 1, R, R), demands, perimeters and splits (N, horizon, ...) of all
    windows."""

    cut, long = (
        np.lib.stride_tricks.sliding_window_view,
        [run for run in runs if len(run.demand) >= horizon],
    )

    def stack(name: str, length: int) -> Tensor:
        parts = [cut(getattr(run, name), length, axis=0) for run in long]
        return torch.tensor(np.moveaxis(np.concatenate(parts), -1, 1), dtype=torch.float32)

    return [
        stack("accumulation", horizon + 1),
        *(stack(name, horizon) for name in ("demand", "perimeter", "splits")),
    ]


def _misfit(
    p: dynamics.Parameters, data: Sequence[Tensor], scale: Tensor, scheme: Mapping[str, Any]
) -> Tensor:
    """Return the mean Huber loss of x_i and x_ij over the horizon, in units of `scale` (R,)
    [veh]."""
    total, horizon, huber = torch.zeros(()), data[1].shape[1], torch.nn.SmoothL1Loss(beta=OUTLIER)
    for k, x in enumerate(_rollout(p, data, scheme), start=1):
        error = (x - data[0][:, k]) / scale.unsqueeze(-1)
        for off, weight in ((error.sum(-1), 1.0), (error, BY_DESTINATION)):
            total = total + weight * huber(off, torch.zeros_like(off))
    return total / horizon


def _rollout(
    p: dynamics.Parameters, data: Sequence[Tensor], scheme: Mapping[str, Any]
) -> Iterator[Tensor]:
    """Yield the states (N, R, R) [veh] after each interval, from the first states of `windows`."""
    observed, demand, perimeter, splits = data
    x = observed[:, 0]
    for k in range(demand.shape[1]):
        x = dynamics.advance(p, x, demand[:, k], perimeter[:, k], splits[:, k], **scheme)
        yield x


def _network(network: RegionalModel, model: _Model, runs: Sequence[Observed]) -> RegionalModel:
    """Return the fitted network, with exit rates scaled to 1 on the average of a region's
    vehicles."""
    with torch.no_grad():
        p = model.regional()
    assert p.exit_rates is not None
    assert p.capacity is not None
    assert p.storage is not None
    rates = p.exit_rates.double().numpy()
    weight = sum(run.accumulation.sum(axis=0) for run in runs)
    weight[weight.sum(axis=1) == 0] = 1.0  # empty in all runs
    mean = (weight * rates).sum(axis=1) / weight.sum(axis=1)
    curves = zip(*(part.tolist() for part in vars(p.mfd).values()), mean, strict=True)
    return replace(
        network,
        mfds=tuple(Cubic(a=a * m, b=b * m, c=c * m, jam=jam) for a, b, c, jam, m in curves),
        exit_rates=rates / mean[:, None],
        capacity=p.capacity.double().numpy() * network.u_max * network.adjacency,
        storage=p.storage.double().numpy(),
    )


def prediction_errors(
    network: RegionalModel, runs: Sequence[Observed], intervals: int, **scheme: Any
) -> Float[np.ndarray, "N R"]:
    """Return predicted minus observed accumulation (N, R) [veh], `intervals` ahead of each observed
    state.

    scheme: step [s], substeps, integrator
    """
    data = windows(runs, intervals)
    with torch.no_grad():
        *_, last = _rollout(dynamics.parameters(network, dtype=torch.float32), data, scheme)
    return (last - data[0][:, -1]).sum(-1).numpy()
