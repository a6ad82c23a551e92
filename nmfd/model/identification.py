"""The regional model from observed runs: all its parameters at once, by prediction error.

MFDs fitted to outflow samples explain one interval at a time, and take the blame for what happens at the boundaries: a
region that cannot send its vehicles on looks as if it had collapsed. Here the parameters of `dynamics` - MFDs,
exit rates, boundary capacities and storage - are those whose rollouts over some control intervals, started from every
observed state under the observed demand and controls, come closest to what was observed (Ljung, System
Identification, 1999, ch. 7; output error over a finite horizon).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Real

from nmfd.arrays import PairsOverTime, StatesOverTime, TurnsOverTime
from nmfd.model import disturbance, dynamics
from nmfd.model.disturbance import LOOK, Disturbance
from nmfd.model.mfd import Mfd
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion
from nmfd.threads import one_thread

HORIZON = 10  # control intervals
ITERATIONS = 600
BATCH = 256  # rollouts per Adam step
LEARNING_RATE = 0.03
OUTLIER = 0.3  # of the scale: from here on an error counts linearly (Huber)
BY_DESTINATION = 3.0  # weight of the errors of x_ij, beside those of x_i
LEAST_RATE = 0.01  # of the free rate, up to the jam accumulation
EXIT_RATES = 8.0  # most and 1 / least
FEWEST = 30.0  # vehicles that must have crossed before their split ratios count
RIDGE = 1e-3  # of the squared logarithm of exit rates and capacities: what the data do not say stays as it was


@dataclass(frozen=True, kw_only=True)
class Observed:
    """One run of T control intervals.

    accumulation: (T+1, R, R) [veh]; demand: (T, R, R) [veh/s], what entered; perimeter: (T, R, R) [-];
    splits: (T, R, R, R) [-]; crossings: (T, R, R) [veh], [i, h] from i to h
    """

    accumulation: StatesOverTime
    demand: PairsOverTime
    perimeter: PairsOverTime
    splits: TurnsOverTime
    crossings: Real[np.ndarray, "T R R"]  # counts are whole numbers


class _Model(torch.nn.Module):
    """`dynamics.Parameters` from free numbers: every choice of them is a valid network."""

    def __init__(self, network: RegionalModel, runs: Sequence[Observed], step: float, fastest: float):
        super().__init__()

        def free(values: Any) -> torch.nn.Parameter:
            return torch.nn.Parameter(torch.as_tensor(np.asarray(values), dtype=torch.float32).clone())

        self.adjacency, self._fastest = torch.tensor(network.adjacency, dtype=torch.float32), fastest
        self._u_max = network.u_max
        largest = np.max([run.accumulation.sum(axis=2).max(axis=0) for run in runs], axis=0)
        flow = np.max([run.crossings.max(axis=0) for run in runs], axis=0) / step
        self.free_rate = free(np.log([min(mfd.c, 0.5 * fastest) for mfd in network.mfds]))
        self.drop, self.bend = free(np.full(network.regions, 0.5)), free(np.zeros(network.regions))
        self.jam = free(np.log(np.maximum(0.7 * largest, 1.0)))
        self.exit_rates = free(np.zeros(network.adjacency.shape))
        self._first_capacity = torch.tensor(np.log(np.maximum(1.2 * flow, 0.05)), dtype=torch.float32)
        self.capacity = free(self._first_capacity)
        self.storage = free(np.log(np.maximum(2.0 * largest, 1.0)))

    def shape(self) -> tuple[torch.Tensor, ...]:
        """q = c (1 - first y - second y^2), y = x / jam, falls from c to at least LEAST_RATE c at the jam."""
        drop = (1.0 - LEAST_RATE) * torch.sigmoid(self.drop)
        first = 2.0 * drop * torch.sigmoid(self.bend)
        return self.free_rate.exp(), first, drop - first, self.jam.exp()

    def parameters_of(self, off_diagonal: PerPair) -> dynamics.Parameters:
        """With `off_diagonal`, 1 but for zeros on the diagonal."""
        c, first, second, jam = self.shape()
        rates = EXIT_RATES ** torch.tanh(self.exit_rates)
        rates = torch.minimum(rates, 0.999 * self._fastest / c.unsqueeze(-1))
        return dynamics.Parameters(
            a=-c * second / jam**2,
            b=-c * first / jam,
            c=c,
            jam=jam,
            adjacency=self.adjacency,
            off_diagonal=off_diagonal,
            exit_rates=rates,
            capacity=self.capacity.exp() * self.adjacency / self._u_max,
            storage=self.storage.exp(),
        )

    def penalty(self) -> torch.Tensor:
        """What it costs to depart from where the search starts."""
        moved = (self.capacity - self._first_capacity) * self.adjacency
        return RIDGE * ((self.exit_rates**2).mean() + (moved**2).mean())


def observed_split_ratios(
    network: RegionalModel, crossings: Real[np.ndarray, "R R R"]
) -> dict[tuple[int, int], dict[int, float]]:
    """(i, j) -> {h: share}: by which neighbour h the vehicles in i bound for j went on in fact.

    crossings: (R, R, R) [veh], [i, h, j] = from i to h, bound for j
    """
    crossings = crossings * network.split_mask
    found = {}
    for i, j in np.argwhere(crossings.sum(axis=1) >= FEWEST):
        shares = crossings[i, :, j] / crossings[i, :, j].sum()
        kept = {int(h): round(float(shares[h]), 4) for h in np.flatnonzero(shares >= 0.005)}
        found[int(i), int(j)] = {h: share / sum(kept.values()) for h, share in kept.items()}
    return found


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
    """`network` with the MFDs, exit rates, capacities and storage that predict `runs` best.

    The MFDs of `network` are where the search starts. Errors are scaled by their critical accumulations, one scale per
    region. The curve of every region falls in q and stays positive up to its jam accumulation, beyond which the outflow
    is constant, and step * q * exit rate <= 1 for the integration step: the result is always a valid network.
    """
    with one_thread():  # and sums are always in the same order
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        model = _Model(network, runs, step, substeps / step)
        horizon = min(HORIZON, max(len(run.demand) for run in runs))
        data, scheme = windows(runs, horizon), {"step": step, "substeps": substeps, "integrator": integrator}
        scale = torch.tensor(network.critical, dtype=torch.float32)
        off_diagonal = 1.0 - torch.eye(network.regions)
        optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
        for iteration in range(iterations):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * iteration / iterations)))
            chosen = torch.randint(len(data[0]), (min(BATCH, len(data[0])),), generator=generator)
            loss = _misfit(model.parameters_of(off_diagonal), [part[chosen] for part in data], scale, scheme)
            optimizer.zero_grad()
            (loss + model.penalty()).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
            optimizer.step()
            if progress:
                progress(iteration + 1, iterations, f"misfit {loss.item():.3f}")
        return _network(network, model, runs, off_diagonal)


def fit_disturbance(
    network: RegionalModel,
    runs: Sequence[Observed],
    *,
    step: float,
    substeps: int = 1,
    integrator: str = "euler",
    iterations: int = ITERATIONS // 4,
    seed: int = 0,
) -> RegionalModel:
    """`network` with the disturbance (nmfd.model.disturbance) that corrects its predictions of `runs` best; as it is
    where no run is long enough."""
    horizon = min(HORIZON, max(len(run.demand) for run in runs) - LOOK)
    if horizon < 1:
        return network
    with one_thread():
        generator = torch.Generator().manual_seed(seed)
        free = torch.nn.Parameter(torch.tensor([1.0, 1.0, 2.0, 0.5]))
        p = dynamics.parameters(network, dtype=torch.float32)
        scale = torch.tensor(network.critical, dtype=torch.float32)
        data, scheme = windows(runs, horizon + LOOK), {"step": step, "substeps": substeps, "integrator": integrator}
        optimizer = torch.optim.Adam([free], lr=LEARNING_RATE)
        for _ in range(iterations):
            chosen = torch.randint(len(data[0]), (min(BATCH, len(data[0])),), generator=generator)
            part = [values[chosen] for values in data]
            loss = _misfit(p, corrected(_law(free), p, part, scale, scheme), scale, scheme)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return replace(network, disturbance=Disturbance(*(float(value) for value in _law(free.detach()))))


def _law(free: torch.Tensor) -> Disturbance:
    """Of four free numbers."""
    return Disturbance(torch.sigmoid(free[0]), torch.sigmoid(free[1]), free[2], free[3])


def corrected(
    law: Disturbance,
    p: dynamics.Parameters,
    data: Sequence[torch.Tensor],
    critical: PerRegion,
    scheme: Mapping[str, Any],
) -> list[torch.Tensor]:
    """`windows` without their first LOOK intervals, whose innovations correct the demand of the others."""
    foreseen, step = dynamics.advance(p, *(part[:, :LOOK] for part in data), **scheme), scheme["step"]
    estimate = disturbance.estimated(law, (data[0][:, 1 : LOOK + 1] - foreseen) / step)
    observed, demand, perimeter, splits = (part[:, LOOK:] for part in data)
    added = disturbance.ahead(law, estimate, observed[:, 0], critical, demand.shape[1], step)
    return [observed, demand + added, perimeter, splits]


def windows(runs: Sequence[Observed], horizon: int) -> list[torch.Tensor]:
    """States (N, horizon + 1, R, R), demands, perimeters and splits (N, horizon, ...) of every `horizon` intervals."""

    def stack(name: str, length: int) -> torch.Tensor:
        parts = [
            np.lib.stride_tricks.sliding_window_view(getattr(run, name), length, axis=0)
            for run in runs
            if len(run.demand) >= horizon
        ]
        return torch.tensor(np.moveaxis(np.concatenate(parts), -1, 1), dtype=torch.float32)

    return [stack("accumulation", horizon + 1), *(stack(name, horizon) for name in ("demand", "perimeter", "splits"))]


def _misfit(
    p: dynamics.Parameters, data: Sequence[torch.Tensor], scale: torch.Tensor, scheme: Mapping[str, Any]
) -> torch.Tensor:
    """The mean Huber loss of the errors of x_i and x_ij over the horizon, in units of `scale` (R,) [veh]."""
    total, horizon = torch.zeros(()), data[1].shape[1]
    for k, x in enumerate(_foreseen(p, data, scheme), start=1):
        error = (x - data[0][:, k]) / scale.unsqueeze(-1)
        total = total + _huber(error.sum(-1)) + BY_DESTINATION * _huber(error)
    return total / horizon


def _foreseen(
    p: dynamics.Parameters, data: Sequence[torch.Tensor], scheme: Mapping[str, Any]
) -> Iterator[torch.Tensor]:
    """(N, R, R) [veh] after every interval of `windows`, from their first states on."""
    observed, demand, perimeter, splits = data
    x = observed[:, 0]
    for k in range(demand.shape[1]):
        x = dynamics.advance(p, x, demand[:, k], perimeter[:, k], splits[:, k], **scheme)
        yield x


def _huber(error: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER)


def _network(
    network: RegionalModel, model: _Model, runs: Sequence[Observed], off_diagonal: torch.Tensor
) -> RegionalModel:
    """The fitted numbers, scaled such that the exit rates of a region are 1 on the average of its vehicles."""
    with torch.no_grad():
        p = model.parameters_of(off_diagonal)
    assert p.exit_rates is not None and p.capacity is not None and p.storage is not None  # `_Model` has them all
    rates = p.exit_rates.double().numpy()
    weight = sum(run.accumulation.sum(axis=0) for run in runs)
    weight[weight.sum(axis=1) == 0] = 1.0  # nobody was ever there
    mean = (weight * rates).sum(axis=1) / weight.sum(axis=1)
    mfds = tuple(
        Mfd(a=float(a) * m, b=float(b) * m, c=float(c) * m, jam=float(jam))
        for a, b, c, jam, m in zip(p.a, p.b, p.c, p.jam, mean, strict=True)
    )
    return replace(
        network,
        mfds=mfds,
        exit_rates=rates / mean[:, None],
        capacity=p.capacity.double().numpy() * network.u_max * network.adjacency,
        storage=p.storage.double().numpy(),
    )


def prediction_errors(
    network: RegionalModel,
    runs: Sequence[Observed],
    intervals: int,
    *,
    step: float,
    substeps: int = 1,
    integrator: str = "euler",
    law: Disturbance | None = None,
) -> Float[np.ndarray, "N R"]:
    """(N, R) [veh]: predicted minus observed accumulation, `intervals` ahead of every observed state of `runs`.

    law: corrected by this disturbance, from every state with LOOK intervals before it
    """
    p = dynamics.parameters(network, dtype=torch.float32)
    scheme: dict = {"step": step, "substeps": substeps, "integrator": integrator}
    with torch.no_grad():
        data = windows(runs, intervals + (0 if law is None else LOOK))
        if law is not None:
            data = corrected(law, p, data, torch.tensor(network.critical, dtype=torch.float32), scheme)
        *_, last = _foreseen(p, data, scheme)
    return (last - data[0][:, -1]).sum(-1).numpy()


def intervals_within(ahead: float, step: float, runs: Sequence[Observed]) -> int:
    """Control intervals of `step` [s] in `ahead` [s], no more than the longest run has and at least one."""
    return min(max(1, round(ahead / step)), max(len(run.demand) for run in runs))


def prediction_shares(
    network: RegionalModel, runs: Sequence[Observed], intervals: Sequence[int], **scheme: Any
) -> Float[np.ndarray, "L R"]:
    """(len(intervals), R) [-]: RMSE of `prediction_errors`, as a share of the critical accumulation."""
    return _shares(network, [prediction_errors(network, runs, n, **scheme) for n in intervals])


def persistence_shares(
    network: RegionalModel, runs: Sequence[Observed], intervals: Sequence[int]
) -> Float[np.ndarray, "L R"]:
    """(len(intervals), R) [-]: as `prediction_shares`, of the prediction that nothing changes."""
    states = [run.accumulation.sum(axis=2) for run in runs]
    return _shares(network, [np.concatenate([state[:-n] - state[n:] for state in states]) for n in intervals])


def _shares(network: RegionalModel, errors: Sequence[Float[np.ndarray, "_ R"]]) -> Float[np.ndarray, "L R"]:
    """(len(errors), R) [-]: root mean squares, as a share of the critical accumulation."""
    return np.sqrt([(error**2).mean(axis=0) for error in errors]) / network.critical
