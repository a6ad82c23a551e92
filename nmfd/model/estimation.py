"""Estimation of x_ij from loop detectors, boundary counts and probes.

It is an extended Kalman filter on the NMFD, after Saeedmanesh, Kouvelas and Geroliminis, "An
extended Kalman filter approach for real-time state estimation in multi-region MFD urban networks",
Transportation Research C 132 (2021), with joint estimation of state and model parameters as in Wang
and Papageorgiou, "Real-time freeway traffic state estimation based on extended Kalman filter",
Transportation Research B 39 (2005).

State: x (R, R) [veh] and, per region, three relative errors around zero: of the outflow of the MFD,
of the forecast demand, and of the expansion of the loop detectors. The readings of a control
interval (mean accumulations, boundary counts, probes) are predicted together with the state at its
end. The covariance follows from counting vehicles: every flow is Poisson, and a probe that moves is
one of the vehicles that move.

Bounds: no cell holds fewer vehicles than its probes (Simon, "Kalman filtering with state
constraints", IET Control Theory and Applications 4, 2010). Integration: forward Euler in the
scenario's substeps. Jacobian: forward differences in one batch of R^2 rollouts, a few milliseconds
for 7 regions, not meant for hundreds.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls
from torch import Tensor

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.model import dynamics
from nmfd.model.instruments import Instruments, Readings
from nmfd.model.planning import PlanningModel
from nmfd.tensors import one_thread
from nmfd.types import Controls

Vector = Float[np.ndarray, " N"]
Square = Float[np.ndarray, "N N"]
# Memory of the relative errors [s]: of outflow and demand, and of the expansion.
MEMORY = 900.0
EXPANSION_MEMORY = 3600.0
# Their standard deviations [-]; that of the expansion is `Instruments.detector_error`.
OUTFLOW_ERROR = 0.3
DEMAND_ERROR = 0.3
# Relative error of each flow, and of each turn as a share of what leaves the cell, with the memory
# MEMORY: modelled as white noise with the same sum instead of a state each.
FLOW_ERROR = 0.2
STRAY = 0.02
COUNT_ERROR = 0.3  # [-], of crossings expanded from one counted gateway to all
FLOOR = 0.01  # [veh^2], variance of an exact reading
DIFFERENCE = 1e-5  # of the Jacobian [veh] or [-]
LEAST_ERROR = -0.95  # of the relative errors
SAME_READINGS = 3  # of a detector, one after the other, show that it is stuck


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Mean and covariance of the state.

    mean: relative errors of outflow, demand and expansion, and x by rows ((3 R + R^2,))
    probes: at their last reading (veh, (R, R))
    """

    mean: Vector
    covariance: Square
    probes: PerPair


class _Inputs(NamedTuple):
    """Demand [veh/s], perimeter and splits [-] of a control interval."""

    demand: PerPair
    perimeter: PerPair
    splits: PerTurn


class _Rollout(NamedTuple):
    """Control interval of the regional model from several points.

    outputs: Z without errors ((points, size - errors))
    moves, of_probes: number of each event from the first point, and those of probes (veh)
    """

    outputs: Tensor
    moves: Tensor
    of_probes: Tensor


class _Prediction(NamedTuple):
    """Mean and covariance of Z, and the vehicles that leave each cell [veh]."""

    z: np.ndarray
    covariance: Tensor
    leaving: np.ndarray


class _Comparison(NamedTuple):
    """Readings (m,), NaN if missing, their expectation and noise variance."""

    reading: np.ndarray
    expected: np.ndarray
    noise: np.ndarray


class _Product(NamedTuple):
    """Matrices left and right' with events between them, as non-zeros.

    places: row, column and event of each non-zero
    values: product of the effects on row and column
    """

    shape: torch.Size
    places: tuple[Tensor, Tensor, Tensor]
    values: Tensor

    def weighted(self, weight: Tensor) -> Tensor:
        """Return left diag(weight) right'."""
        row, column, event = self.places
        matrix = torch.zeros(self.shape, dtype=weight.dtype)
        return matrix.index_put_((row, column), self.values * weight[event], accumulate=True)


class Estimator:
    """Filter along one run: call `step` once per control interval.

    Z is the state at the end of an interval, then the readings, jointly Gaussian:

        (3 relative errors, x | mean accumulations (R,), crossings (E,), probes (R^2,),
        departures of probes (R^2,))

    E: the boundaries (i, h). Prediction and update are in torch, whose threads can be limited.
    """

    def __init__(self, planning: PlanningModel, instruments: Instruments):
        network = planning.network
        regions = network.regions
        cells = regions**2
        self._planning = planning
        self._instruments = instruments
        self._step = planning.step
        self._substeps = planning.substeps
        self._parameters = dynamics.parameters(network)
        self._probe_share = instruments.probe_share
        self._regions = regions
        self._cells = cells
        self._fastest = torch.from_numpy(network.fastest_rates)
        self._boundaries = np.argwhere(network.adjacency)
        self._turns = np.argwhere(network.split_mask)
        # The parts of Z, in its order.
        sizes = (2 * regions, regions, cells, regions, len(self._boundaries), cells, cells)
        ends = np.cumsum(sizes)
        parts = [slice(int(end - size), int(end)) for end, size in zip(ends, sizes, strict=True)]
        _, self._expansion, self._x, *of_readings = parts
        self._mean, self._crossings, self._probes, self._departures = of_readings
        self._states = self._x.stop
        self._size = self._departures.stop
        spread = [np.full(regions, OUTFLOW_ERROR), np.full(regions, DEMAND_ERROR)]
        self._spread = torch.from_numpy(np.concatenate([*spread, instruments.detector_error]))
        memory = torch.tensor([MEMORY, MEMORY, EXPANSION_MEMORY], dtype=torch.float64)
        self._kept = torch.exp(-self._step / memory).repeat_interleave(regions)
        kept = np.exp(-self._step / MEMORY)
        self._lasting = float((1.0 + kept) / (1.0 - kept))  # variance of white over lasting noise
        # Cell of each event but departures.
        here, _, bound = self._turns.T
        own = np.arange(regions) * (regions + 1)
        self._from = torch.from_numpy(np.concatenate([here * regions + bound, own]))
        vehicle, probe = self._effects()
        self._products = (
            _product(vehicle, vehicle),
            _product(vehicle, probe),
            _product(probe, probe),
        )
        self._half = vehicle[cells : cells + regions]
        self.reset()

    def reset(self) -> None:
        self._k = 0
        self._seen: list[np.ndarray] = []
        exact = torch.full((self._cells,), FLOOR, dtype=torch.float64)
        self.belief = Belief(
            mean=np.zeros(self._states),
            covariance=torch.diag(torch.cat([self._spread**2, exact])).numpy(),
            probes=np.zeros((self._regions, self._regions)),
        )

    @property
    def accumulation(self) -> PerPair:
        return self.belief.mean[self._x].reshape(self._regions, self._regions).copy()

    @one_thread()
    def step(self, controls: Controls, readings: Readings) -> PerPair:
        """Return the estimate (R, R) [veh] after an interval under `controls`."""
        demand = self._planning.forecast[min(self._k, self._planning.steps - 1)]
        splits = controls.splits
        if splits is None:
            splits = self._planning.network.nominal_splits
        inputs = _Inputs(demand, controls.perimeter, splits)
        loops = self._without_stuck(readings.accumulation)
        self.belief = self._advanced(self.belief, inputs, readings, loops)
        self._k += 1
        return self.accumulation

    def _without_stuck(self, accumulation: PerRegion) -> PerRegion:
        """Return the readings of the detectors, NaN for those that are stuck.

        A detector that shows 0 is not: its street may be empty.
        """
        self._seen = [*self._seen, accumulation][-SAME_READINGS:]
        if len(self._seen) < SAME_READINGS:
            return accumulation
        same = np.ptp(self._seen, axis=0) == 0
        return np.where(same & (accumulation > 0), np.nan, accumulation)

    def _effects(self) -> tuple[Tensor, Tensor]:
        """Return the changes by each event (rows, events), in two matrices.

        Rows: x, mean accumulations and crossings of vehicles; probes and departures of probes.
        Events: turns (i, h, j), completed trips in i, departures from i for j, in this order.
        """
        regions = self._regions
        cells = np.arange(self._cells)
        here, onward, bound = self._turns.T
        turns = np.arange(len(self._turns))
        completed = len(turns) + np.arange(regions)
        departed = len(turns) + regions + cells
        place = np.zeros((self._cells, len(turns) + regions + self._cells))
        place[here * regions + bound, turns] = -1.0
        place[onward * regions + bound, turns] = 1.0
        place[np.arange(regions) * (regions + 1), completed] = -1.0
        place[cells, departed] = 1.0
        crossing = np.zeros((len(self._boundaries), place.shape[1]))
        of_turn = (self._turns[None, :, :2] == self._boundaries[:, None]).all(axis=2)
        crossing[:, : len(turns)] = of_turn
        departure = np.zeros_like(place)
        departure[cells, departed] = 1.0
        # An event in the middle of the interval, on average, counts half in the mean.
        half = 0.5 * place.reshape(regions, regions, -1).sum(axis=1)
        vehicle = np.concatenate([place, half, crossing])
        probe = np.concatenate([place, departure])
        return torch.from_numpy(vehicle), torch.from_numpy(probe)

    def _advanced(
        self, belief: Belief, inputs: _Inputs, readings: Readings, loops: PerRegion
    ) -> Belief:
        """Return the belief one control interval later.

        loops: readings of detectors that are not stuck (veh, (R,))
        """
        prediction = self._predicted(belief, inputs)
        comparison = self._compared(prediction, readings, loops)
        mean, covariance = self._updated(prediction, comparison)
        counted = np.isfinite(readings.probes)
        expected = np.maximum(prediction.z[self._probes].reshape(counted.shape), 0.0)
        probes = np.where(counted, readings.probes, expected)
        least = np.where(counted, probes, 0.0).ravel()
        lower = np.concatenate([np.full(self._x.start, LEAST_ERROR), least])
        mean = bounded(mean, covariance, lower)
        probes = np.minimum(probes, mean[self._x].reshape(counted.shape))
        return Belief(mean=mean, covariance=covariance, probes=probes)

    def _updated(
        self, prediction: _Prediction, comparison: _Comparison
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the state, given the readings."""
        z, covariance, _ = prediction
        mean = z[: self._states]
        posterior = covariance[: self._states, : self._states]
        there = np.flatnonzero(np.isfinite(comparison.reading))
        if len(there):
            noise = torch.diag(torch.from_numpy(comparison.noise[there]))
            ahead = self._rows(z, covariance)[there]
            spread = self._rows(z, ahead.T)[there] + noise
            innovation = torch.from_numpy((comparison.reading - comparison.expected)[there])
            # With S = L L' the covariance of the readings: L^-1 of cross-covariance and innovation.
            root = torch.linalg.cholesky(spread)
            columns = torch.cat([ahead[:, : self._states], innovation[:, None]], dim=1)
            whitened = torch.linalg.solve_triangular(root, columns, upper=False)
            gain = whitened[:, :-1]
            mean = mean + (gain.T @ whitened[:, -1]).numpy()
            posterior = posterior - gain.T @ gain
        return mean, (0.5 * (posterior + posterior.T)).numpy()

    def _predicted(self, belief: Belief, inputs: _Inputs) -> _Prediction:
        """Return Z at the end of the interval, before its readings."""
        mean = torch.from_numpy(belief.mean)
        errors = self._x.start
        # Flows depend on the whole state but the expansion.
        without_expansion = torch.arange(self._expansion.start)
        varied = torch.cat([without_expansion, torch.arange(errors, self._states)])
        points = mean[varied].repeat(len(varied) + 1, 1)
        points[1:] += DIFFERENCE * torch.eye(len(varied), dtype=torch.float64)
        rollout = self._rollout(points, belief.probes, inputs)
        outputs = rollout.outputs
        jacobian = torch.zeros(self._size, self._states, dtype=torch.float64)
        jacobian[:errors, :errors] = torch.diag(self._kept)
        jacobian[errors:, varied] = (outputs[1:] - outputs[0]).T / DIFFERENCE
        covariance = jacobian @ torch.from_numpy(belief.covariance) @ jacobian.T
        covariance.diagonal()[:errors] += (1.0 - self._kept**2) * self._spread**2
        leaving = torch.zeros(self._cells, dtype=torch.float64)
        leaving.index_add_(0, self._from, rollout.moves[: len(self._from)])
        noise = self._flow_noise(belief, rollout.moves, rollout.of_probes, leaving)
        covariance[errors:, errors:] += noise
        z = torch.cat([self._kept * mean[:errors], outputs[0]])
        return _Prediction(z.numpy(), covariance, leaving.numpy())

    def _rollout(self, points: Tensor, probes: PerPair, inputs: _Inputs) -> _Rollout:
        """Return what happens in a control interval.

        points: relative errors of outflow and demand, and x ((B, 2 R + R^2))
        probes: at the begin of the interval (veh, (R, R))
        """
        regions = self._regions
        batch = len(points)
        duration = self._step / self._substeps
        demand, perimeter, splits = (torch.tensor(part, dtype=torch.float64) for part in inputs)
        factors = 1.0 + points[:, : 2 * regions].reshape(batch, 2, regions)
        outflow, wish = factors.clamp(min=0.0).unbind(1)
        outflow = outflow.minimum(1.0 / (duration * self._fastest))  # at most all vehicles leave
        entering = duration * demand * wish[:, :, None]
        x = points[:, 2 * regions :].reshape(batch, regions, regions)
        n = torch.from_numpy(probes).expand(batch, -1, -1)
        mean = torch.zeros_like(outflow)
        crossings = torch.zeros_like(x)
        moves = torch.zeros(regions, regions, regions, dtype=x.dtype)
        moves_of_probes = torch.zeros_like(moves)
        ends = torch.zeros(regions, dtype=x.dtype)
        ends_of_probes = torch.zeros_like(ends)
        for _ in range(self._substeps):
            flows = dynamics.flows(self._parameters, x + 1e-9, perimeter, splits)
            completed = duration * outflow * flows[0]
            moved = duration * outflow[:, :, None, None] * flows[1]
            share = n / (x + 1e-9)  # of probes
            completed_probes = torch.diagonal(share, dim1=1, dim2=2) * completed
            moved_probes = share.unsqueeze(2) * moved
            moves += moved[0]
            moves_of_probes += moved_probes[0]
            ends += completed[0]
            ends_of_probes += completed_probes[0]
            crossings = crossings + moved.sum(3)
            before = x.sum(2)
            x = x + entering - torch.diag_embed(completed) - moved.sum(2) + moved.sum(1)
            change = moved_probes.sum(1) - moved_probes.sum(2) - torch.diag_embed(completed_probes)
            n = n + self._probe_share * entering + change
            mean = mean + 0.5 * (before + x.sum(2)) / self._substeps
        departed = self._substeps * self._probe_share * entering
        crossings = crossings[:, *self._boundaries.T]
        parts = [part.reshape(batch, -1) for part in (x, mean, crossings, n, departed)]
        entered = (self._substeps * entering)[0].reshape(-1)
        turns = tuple(self._turns.T)
        events = torch.cat([moves[turns], ends, entered])
        of_probes = [moves_of_probes[turns], ends_of_probes, self._probe_share * entered]
        events = events.clamp(min=0.0)
        return _Rollout(
            outputs=torch.cat(parts, dim=1),
            moves=events,
            of_probes=torch.cat(of_probes).clamp(min=0.0).minimum(events),
        )

    def _flow_noise(
        self, belief: Belief, moves: Tensor, of_probes: Tensor, leaving: Tensor
    ) -> Tensor:
        """Return the covariance of Z, without relative errors, due to the flows.

        Flows are Poisson counts, and have errors besides.

        moves, of_probes: those of the rollout (veh)
        leaving: vehicles that leave each cell (veh, (R^2,))
        """
        turns = len(self._turns)
        cell = self._from[:turns]
        error = FLOW_ERROR * moves
        error[:turns] += STRAY * leaving[cell]
        wrong = self._lasting * error**2
        # The share of probes among those that turn; where nobody does, among those in the cell.
        x = torch.from_numpy(belief.mean[self._x])
        in_cell = torch.from_numpy(belief.probes.ravel()) / x.clamp(min=1e-9)
        share = of_probes / moves.clamp(min=1e-9)
        turned = moves[:turns] > 1e-9
        share[:turns] = torch.where(turned, share[:turns], in_cell[cell].clamp(max=1.0))
        all_by_all, all_by_probes, probes_by_probes = self._products
        of_all = all_by_all.weighted(moves + wrong)
        mixed = all_by_probes.weighted(of_probes + share * wrong)
        of_both = probes_by_probes.weighted(of_probes + share**2 * wrong)
        # The time of an event, uniform in the interval, adds 1/12 of its squared effect to the
        # mean.
        means = slice(self._cells, self._cells + self._regions)
        of_all.diagonal()[means] += self._half**2 @ moves / 3.0
        upper = torch.cat([of_all, mixed], dim=1)
        lower = torch.cat([mixed.T, of_both], dim=1)
        return torch.cat([upper, lower])

    def _compared(
        self, prediction: _Prediction, readings: Readings, loops: PerRegion
    ) -> _Comparison:
        """Return readings, what is expected of them, and their noise.

        loops: readings of detectors that are not stuck (veh, (R,))
        """
        z = prediction.z
        instruments = self._instruments
        x = z[self._x]
        probes = readings.probes.ravel()
        # Detectors see a share of the lanes. The lasting part of their error is a state.
        mean = z[self._mean]
        share = np.maximum(instruments.detector_share, 1e-6)
        sampled = np.maximum(mean, 1.0) * (1.0 - share) / share
        loops_noise = sampled + (instruments.detector_noise * mean) ** 2 + FLOOR
        # Counts miss the lanes and gateways without a counter.
        here, to = self._boundaries.T
        counts = z[self._crossings]
        boundary = np.maximum(instruments.counted_share[here, to], 1e-6)
        gateways = np.maximum(instruments.counted_gateways[here, to], 1)
        uncounted = np.maximum(counts, 1.0) / boundary + COUNT_ERROR**2 * counts**2 / gateways
        # Pseudo-readings against model drift: probes are a fixed share of the vehicles. They count
        # less each time, because they stay until they leave, MEMORY at most.
        p = self._probe_share
        there = np.maximum(x, 1.0)
        kept = np.minimum(np.exp(-prediction.leaving / there), np.exp(-self._step / MEMORY))
        thinning = p * (1.0 - p) * there * (1.0 + kept) / (1.0 - kept) + FLOOR
        exact = np.full(self._cells, FLOOR)
        parts = (
            _Comparison(loops, (1.0 + z[self._expansion]) * mean, loops_noise),
            _Comparison(readings.crossings[here, to], counts, (1.0 - boundary) * uncounted + FLOOR),
            _Comparison(probes, z[self._probes], exact),
            _Comparison(readings.probe_departures.ravel(), z[self._departures], exact),
            _Comparison(0.0 * probes, z[self._probes] - p * x, thinning),
        )
        return _Comparison(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _rows(self, z: np.ndarray, matrix: Tensor) -> Tensor:
        """Return the Jacobian (m, size) of the readings times a matrix (size, n)."""
        expansion = torch.from_numpy(z[self._expansion])[:, None]
        mean = torch.from_numpy(z[self._mean])[:, None]
        loops = (1.0 + expansion) * matrix[self._mean] + mean * matrix[self._expansion]
        share = matrix[self._probes] - self._probe_share * matrix[self._x]
        return torch.cat([loops, matrix[self._crossings.start :], share])


def _product(left: Tensor, right: Tensor) -> _Product:
    """Return the products of effects (m, events) and (n, events)."""
    product = left[:, None] * right[None]
    places = product.nonzero(as_tuple=True)
    return _Product(shape=product.shape[:2], places=places, values=product[places])


def bounded(mean: Vector, covariance: Square, lower: Vector) -> Vector:
    """Return the point (n,) nearest to `mean` that is >= `lower`.

    Distances are in the metric of `covariance` C. The point is mean + C y with multipliers y >= 0:
    a non-negative least-squares problem in y.
    """
    below = lower - mean
    if (below <= 0).all():
        return mean
    jitter = 1e-6 + 1e-9 * np.trace(covariance)
    root = np.linalg.cholesky(covariance + jitter * np.eye(len(mean)))
    multipliers, _ = nnls(root.T, np.linalg.solve(root, below), maxiter=30 * len(mean))
    return np.maximum(mean + covariance @ multipliers, lower)  # the jitter leaves small violations
