"""Estimation of x_ij from loop detectors, boundary counts and probe vehicles: an extended Kalman
filter on the NMFD.

After Saeedmanesh, Kouvelas and Geroliminis, "An extended Kalman filter approach for real-time state
estimation in multi-region MFD urban networks", Transportation Research C 132 (2021); joint
estimation of state and model parameters as in Wang and Papageorgiou, "Real-time freeway traffic
state estimation based on extended Kalman filter", Transportation Research B 39 (2005).

State: x (R, R) [veh] and, per region, three relative errors around zero: of the outflow of the MFD,
    of the forecast
demand, and of the expansion of the loop detectors. The readings of a control interval (mean
accumulations, boundary counts, probes) are predicted together with the state at its end. The
covariance follows from counting vehicles: every flow is Poisson, and a probe that moves is one of
the vehicles that move.

Bounds: no cell holds fewer vehicles than its probes (Simon, "Kalman filtering with state
    constraints", IET Control
Theory and Applications 4, 2010). Forward Euler in the scenario's substeps; the Jacobian by forward
differences in one batch of R^2 rollouts: a few milliseconds for 7 regions, not meant for hundreds.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Real
from scipy.optimize import nnls
from torch import Tensor

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.model import dynamics
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls

Vector = Float[np.ndarray, " N"]
Square = Float[np.ndarray, "N N"]
Inputs = tuple[
    PerPair, PerPair, PerTurn
]  # demand [veh/s], perimeter and splits [-] of a control interval
# Relative errors: memory [s] and standard deviation [-] (of the expansion:
# `Instruments.detector_error`).
MEMORY, EXPANSION_MEMORY = 900.0, 3600.0
OUTFLOW_ERROR, DEMAND_ERROR = 0.3, 0.3
# Relative error of each flow, and of each turn as a share of what leaves the cell, with the memory
# MEMORY: modelled as white noise with the same sum instead of a state each.
FLOW_ERROR, STRAY = 0.2, 0.02
COUNT_ERROR = 0.3  # [-], of crossings expanded from one counted gateway to all
FLOOR = 0.01  # [veh^2], variance of an exact reading
DIFFERENCE = 1e-5  # of the Jacobian [veh] or [-]


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Coverage and errors of the instruments.

    detector_share: (R,) [-], share of the lane length of each region covered by loop detectors
    detector_error, detector_noise: (R,) [-], standard deviations of the lasting and of the white
        relative error of the expanded accumulation
    counted_share: (R, R) [-], [i, h]: share of the lanes over that boundary that are counted
    counted_gateways: (R, R), their number
    probe_share: share of all vehicles [-]
    """

    detector_share: PerRegion
    detector_error: PerRegion
    detector_noise: PerRegion
    counted_share: PerPair
    counted_gateways: Real[np.ndarray, "R R"]
    probe_share: float


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Measurements of one control interval; NaN where there is none.

    accumulation: (R,) [veh], mean over the interval, expanded from the detectors to the region
    crossings: (R, R) [veh], [i, h], counted during the interval, expanded to all gateways
    probes: (R, R) [veh], [i, j]: in region i bound for j at the end of the interval; not expanded
    probe_departures: (R, R) [veh], [i, j]: departed during the interval; not expanded
    """

    accumulation: PerRegion
    crossings: PerPair
    probes: PerPair
    probe_departures: PerPair


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Mean and covariance of the state.

    mean: (3 R + R^2,), relative errors of outflow, demand and expansion, and x by rows
    probes: (R, R) [veh], at their last reading
    """

    mean: Vector
    covariance: Square
    probes: PerPair


class Estimator:
    """Filter along one run: call `step` once per control interval.

    Z = (3 relative errors, x | mean accumulations (R,), crossings (E,), probes (R^2,), departures of probes (R^2,)):
    state at the end of an interval and readings, jointly Gaussian. E: the boundaries (i, h).
    Prediction and update are in torch, whose threads can be limited.
    """

    def __init__(self, planning: PlanningModel, instruments: Instruments):
        network, self._planning, self._instruments = planning.network, planning, instruments
        self._step, self._substeps = planning.step, planning.substeps
        self._parameters, self._probe_share = dynamics.parameters(network), instruments.probe_share
        regions = self._regions = network.regions
        cells = self._cells = regions**2
        self._fastest = torch.tensor(
            [m.rate(np.linspace(0.0, m.jam, 501)).max() for m in network.mfds]
        )
        if network.exit_rates is not None:
            self._fastest *= torch.from_numpy(network.exit_rates.max(axis=1))
        self._boundaries = np.argwhere(network.adjacency)
        sizes = (2 * regions, regions, cells, regions, len(self._boundaries), cells, cells)
        ends = np.cumsum(sizes)
        (
            _,
            self._expansion,
            self._x,
            self._mean,
            self._crossings,
            self._probes,
            self._departures,
        ) = (slice(int(end - size), int(end)) for end, size in zip(ends, sizes, strict=True))
        self._states, self._size = int(ends[2]), int(ends[-1])
        errors = (
            np.full(regions, OUTFLOW_ERROR),
            np.full(regions, DEMAND_ERROR),
            instruments.detector_error,
        )
        self._spread = torch.from_numpy(np.concatenate(errors))
        memory = torch.tensor([MEMORY, MEMORY, EXPANSION_MEMORY], dtype=torch.float64)
        self._kept = torch.exp(-self._step / memory).repeat_interleave(regions)
        kept = np.exp(-self._step / MEMORY)
        self._lasting = float((1.0 + kept) / (1.0 - kept))  # variance of white over lasting noise
        self._turns = np.argwhere(network.split_mask)
        # Cell of each event but departures.
        left = self._turns[:, 0] * regions + self._turns[:, 2], np.arange(regions) * (regions + 1)
        self._from = torch.from_numpy(np.concatenate(left))
        vehicle, probe = (torch.from_numpy(part) for part in self._effects())
        self._pairs = [_pairs(vehicle, vehicle), _pairs(vehicle, probe), _pairs(probe, probe)]
        self._half = vehicle[cells : cells + regions]
        self.reset()

    def reset(self) -> None:
        self._k, self._seen = 0, list[np.ndarray]()
        variance = torch.cat(
            [self._spread**2, torch.full((self._cells,), FLOOR, dtype=torch.float64)]
        )
        probes = np.zeros((self._regions, self._regions))
        self.belief = Belief(
            mean=np.zeros(self._states), covariance=torch.diag(variance).numpy(), probes=probes
        )

    @property
    def accumulation(self) -> PerPair:
        return self.belief.mean[self._x].reshape(self._regions, self._regions).copy()

    def step(self, controls: Controls, readings: Readings) -> PerPair:
        """Return the estimate (R, R) [veh] at the end of the interval under `controls`."""
        demand = self._planning.forecast[min(self._k, self._planning.steps - 1)]
        splits = (
            self._planning.network.nominal_splits if controls.splits is None else controls.splits
        )
        # A detector with three identical readings is stuck.
        self._seen = [*self._seen[-2:], readings.accumulation]
        stuck = (
            np.ptp(self._seen, axis=0) == 0
            if len(self._seen) == 3
            else np.zeros(len(demand), dtype=bool)
        )
        loops = np.where(stuck & (readings.accumulation > 0), np.nan, readings.accumulation)
        self.belief = self._advanced(
            self.belief, (demand, controls.perimeter, splits), readings, loops
        )
        self._k += 1
        return self.accumulation

    def _effects(self) -> tuple[np.ndarray, np.ndarray]:
        """Return changes per event (rows, events): (x, mean accumulations, crossings) and (probes,
        departures)."""
        # Events: turns (i, h, j), completed trips in i, departures from i for j, in this order.
        regions, cells = self._regions, np.arange(self._cells)
        here, onward, bound = self._turns.T
        number, turns = np.arange(len(here)), len(here)
        place = np.zeros((self._cells, turns + regions + self._cells))
        place[here * regions + bound, number] = -1.0
        place[onward * regions + bound, number] = 1.0
        place[np.arange(regions) * (regions + 1), turns + np.arange(regions)] = -1.0
        place[cells, turns + regions + cells] = 1.0
        crossing, departure = (
            np.zeros((len(self._boundaries), place.shape[1])),
            np.zeros_like(place),
        )
        crossing[:, :turns] = (self._turns[None, :, :2] == self._boundaries[:, None]).all(axis=2)
        departure[cells, turns + regions + cells] = 1.0
        # An event in the middle of the interval, on average, counts half in the mean.
        half = 0.5 * place.reshape(regions, regions, -1).sum(axis=1)
        return np.concatenate([place, half, crossing]), np.concatenate([place, departure])

    def _advanced(
        self, belief: Belief, inputs: Inputs, readings: Readings, loops: PerRegion
    ) -> Belief:
        """Return the belief one control interval later; loops: (R,) [veh], valid detector
        readings."""
        z, covariance, leaving = self._predicted(belief, inputs)
        mean, posterior = z[: self._states], covariance[: self._states, : self._states]
        reading, expected, noise = self._readings(z, leaving, readings, loops)
        there = np.flatnonzero(np.isfinite(reading))
        if len(there):
            ahead = self._rows(z, covariance)[there]
            spread = self._rows(z, ahead.T)[there] + torch.diag(torch.from_numpy(noise[there]))
            towards = ahead[:, : self._states]
            root = torch.linalg.cholesky(spread)
            innovation = torch.from_numpy((reading - expected)[there])[:, None]
            # With S = L L' the covariance of the readings: L^-1 of innovation and cross-covariance.
            whitened = torch.linalg.solve_triangular(
                root, torch.cat([towards, innovation], dim=1), upper=False
            )
            mean = mean + (whitened[:, :-1].T @ whitened[:, -1]).numpy()
            posterior = posterior - whitened[:, :-1].T @ whitened[:, :-1]
        posterior = (0.5 * (posterior + posterior.T)).numpy()
        counted = np.isfinite(readings.probes)
        probes = np.where(
            counted, readings.probes, np.maximum(z[self._probes].reshape(counted.shape), 0.0)
        )
        lower = np.concatenate(
            [np.full(self._x.start, -0.95), np.where(counted, probes, 0.0).ravel()]
        )
        mean = bounded(mean, posterior, lower)
        probes = np.minimum(probes, mean[self._x].reshape(counted.shape))
        return Belief(mean=mean, covariance=posterior, probes=probes)

    def _predicted(self, belief: Belief, inputs: Inputs) -> tuple[np.ndarray, Tensor, np.ndarray]:
        """Return Z (size,), its covariance, and the vehicles that leave each cell (R^2,) [veh]."""
        mean, errors, first = torch.from_numpy(belief.mean), self._x.start, self._expansion.start
        # Flows depend on the whole state but the expansion.
        varied = torch.cat([torch.arange(first), torch.arange(errors, self._states)])
        points = mean[varied].repeat(len(varied) + 1, 1)
        points[1:] += DIFFERENCE * torch.eye(len(varied), dtype=torch.float64)
        outputs, moves, of_probes = self._rollout(points, belief.probes, inputs)
        jacobian = torch.zeros(self._size, self._states, dtype=torch.float64)
        jacobian[:errors, :errors] = torch.diag(self._kept)
        jacobian[errors:, varied] = (outputs[1:] - outputs[0]).T / DIFFERENCE
        covariance = jacobian @ torch.from_numpy(belief.covariance) @ jacobian.T
        covariance.diagonal()[:errors] += (1.0 - self._kept**2) * self._spread**2
        leaving = torch.zeros(self._cells, dtype=torch.float64)
        leaving.index_add_(0, self._from, moves[: len(self._from)])  # turns and ends of trips
        covariance[errors:, errors:] += self._flow_noise(belief, moves, of_probes, leaving)
        return (
            torch.cat([self._kept * mean[:errors], outputs[0]]).numpy(),
            covariance,
            leaving.numpy(),
        )

    def _rollout(
        self, points: Tensor, probes: PerPair, inputs: Inputs
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return Z without errors at `points` (B, 2 R + R^2), and the first one's events [veh], all
        and of probes."""
        regions, batch = self._regions, len(points)
        duration = self._step / self._substeps
        demand, *controls = (torch.tensor(values, dtype=torch.float64) for values in inputs)
        x = points[:, 2 * regions :].reshape(batch, regions, regions)
        outflow, wish = (
            (1.0 + points[:, : 2 * regions].reshape(batch, 2, regions)).clamp(min=0.0).unbind(1)
        )
        outflow = outflow.minimum(1.0 / (duration * self._fastest))  # at most all vehicles leave
        entering = duration * demand * wish[:, :, None]
        n = torch.from_numpy(probes).expand(batch, -1, -1)
        mean, crossings = torch.zeros_like(outflow), torch.zeros_like(x)
        moves = torch.zeros(2, regions, regions, regions, dtype=x.dtype)
        ends = torch.zeros(2, regions, dtype=x.dtype)
        for _ in range(self._substeps):
            completions, transfers = dynamics.flows(self._parameters, x + 1e-9, *controls)
            completions = duration * outflow * completions
            transfers = duration * outflow[:, :, None, None] * transfers
            share = n / (x + 1e-9)
            for level, part in enumerate((torch.ones_like(share), share)):
                moves[level] += (transfers * part.unsqueeze(2))[0]
                ends[level] += (completions * torch.diagonal(part, dim1=1, dim2=2))[0]
            crossings = crossings + transfers.sum(3)
            before, arrived = x.sum(2), self._probe_share * entering
            x = x + entering - torch.diag_embed(completions) - transfers.sum(2) + transfers.sum(1)
            moved, ended = (
                share.unsqueeze(2) * transfers,
                torch.diagonal(share, dim1=1, dim2=2) * completions,
            )
            n = n + arrived + (moved.sum(1) - moved.sum(2) - torch.diag_embed(ended))
            mean = mean + 0.5 * (before + x.sum(2)) / self._substeps
        departed = self._substeps * self._probe_share * entering
        crossings = crossings[:, *self._boundaries.T]
        outputs = torch.cat(
            [part.reshape(batch, -1) for part in (x, mean, crossings, n, departed)], dim=1
        )
        entered = (self._substeps * entering)[0].reshape(-1)
        share = (1.0, self._probe_share)
        here, onward, bound = self._turns.T
        events = [
            torch.cat([moves[k][here, onward, bound], ends[k], share[k] * entered]) for k in (0, 1)
        ]
        every = events[0].clamp(min=0.0)
        return outputs, every, events[1].clamp(min=0.0).minimum(every)

    def _flow_noise(
        self, belief: Belief, moves: Tensor, of_probes: Tensor, leaving: Tensor
    ) -> Tensor:
        """Return the covariance of Z, without relative errors, due to Poisson counts and errors of
        the flows [veh]."""
        x, turns = torch.from_numpy(belief.mean[self._x]), len(self._turns)
        cell = self._from[:turns]
        error = FLOW_ERROR * moves
        error[:turns] += STRAY * leaving[cell]
        share = of_probes / moves.clamp(min=1e-9)
        in_cell = torch.from_numpy(belief.probes.ravel()) / x.clamp(min=1e-9)
        share[:turns] = torch.where(
            moves[:turns] > 1e-9, share[:turns], in_cell[cell].clamp(max=1.0)
        )
        wrong = self._lasting * error**2
        weights = moves + wrong, of_probes + share * wrong, of_probes + share**2 * wrong
        parts = [
            torch.zeros(shape, dtype=x.dtype).index_put_(
                index[:2], value * weight[index[2]], accumulate=True
            )
            for (shape, index, value), weight in zip(self._pairs, weights, strict=True)
        ]
        # The time of an event, uniform in the interval, adds 1/12 of its squared effect to the
        # mean.
        parts[0].diagonal()[self._cells : self._cells + self._regions] += (
            self._half**2 @ moves / 3.0
        )
        return torch.cat([torch.cat(parts[:2], dim=1), torch.cat([parts[1].T, parts[2]], dim=1)])

    def _readings(
        self, z: np.ndarray, leaving: np.ndarray, readings: Readings, loops: np.ndarray
    ) -> tuple:
        """Return the readings (m,), NaN where there is none, their expectation and their noise
        variance (m,)."""
        instruments = self._instruments
        here, to = self._boundaries.T
        mean, expansion, counts = z[self._mean], z[self._expansion], z[self._crossings]
        share = np.maximum(instruments.detector_share, 1e-6)
        boundary = np.maximum(instruments.counted_share[here, to], 1e-6)
        gateways = np.maximum(instruments.counted_gateways[here, to], 1)
        cells, p = np.full(self._cells, FLOOR), self._probe_share
        there = np.maximum(z[self._x], 1.0)
        # Pseudo-readings against model drift: probes are a fixed share of the vehicles. They count
        # less each time, because they stay until they leave, MEMORY at most.
        kept = np.minimum(np.exp(-leaving / there), np.exp(-self._step / MEMORY))
        thinning = p * (1.0 - p) * there * (1.0 + kept) / (1.0 - kept) + FLOOR
        # The lasting part of the error of the detectors is a state.
        loops_noise = (
            np.maximum(mean, 1.0) * (1.0 - share) / share
            + (instruments.detector_noise * mean) ** 2
            + FLOOR
        )
        uncounted = np.maximum(counts, 1.0) / boundary + COUNT_ERROR**2 * counts**2 / gateways
        probes = readings.probes.ravel()
        parts = (
            (loops, (1.0 + expansion) * mean, loops_noise),
            (readings.crossings[here, to], counts, (1.0 - boundary) * uncounted + FLOOR),
            (probes, z[self._probes], cells),
            (readings.probe_departures.ravel(), z[self._departures], cells),
            (0.0 * probes, z[self._probes] - p * z[self._x], thinning),
        )
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

    def _rows(self, z: np.ndarray, matrix: Tensor) -> Tensor:
        """Return the Jacobian of the readings by Z times a matrix (size, n): (m, n)."""
        expansion, mean = (
            torch.from_numpy(z[part])[:, None] for part in (self._expansion, self._mean)
        )
        loops = (1.0 + expansion) * matrix[self._mean] + mean * matrix[self._expansion]
        share = matrix[self._probes] - self._probe_share * matrix[self._x]
        return torch.cat([loops, matrix[self._crossings.start :], share])


def _pairs(left: Tensor, right: Tensor) -> tuple:
    """Return shape, (row, column, event) and product of the non-zeros of left diag(w) right' (m,
    n)."""
    product = left[:, None] * right[None]
    index = product.nonzero(as_tuple=True)
    return product.shape[:2], index, product[index]


def bounded(mean: Vector, covariance: Square, lower: Vector) -> Vector:
    """Return the point nearest to `mean` (n,) in the metric of `covariance` (n, n) that is >=
    `lower` (n,).

    It is mean + C y with multipliers y >= 0: a non-negative least-squares problem in y.
    """
    below = lower - mean
    if (below <= 0).all():
        return mean
    root = np.linalg.cholesky(covariance + (1e-6 + 1e-9 * np.trace(covariance)) * np.eye(len(mean)))
    multipliers, _ = nnls(root.T, np.linalg.solve(root, below), maxiter=30 * len(mean))
    return np.maximum(mean + covariance @ multipliers, lower)  # the jitter leaves small violations
