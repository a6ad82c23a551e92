"""The estimator against cities whose truth is known: whole vehicles that move by chance as the regional model says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nmfd import dynamics, estimation
from nmfd.estimation import Estimator, Instruments, Observation, bounded
from nmfd.plant import NmfdPlant
from nmfd.scenario import load_scenario
from nmfd.types import Controls

SCENARIO = load_scenario(Path(__file__).parents[1] / "scenarios" / "grid7_peak")
NETWORK = SCENARIO.network
REGIONS = NETWORK.regions
OPEN = Controls(perimeter=np.where(NETWORK.adjacency, NETWORK.u_max, 0.0), splits=None)


def equipped(*, detectors=0.3, probes=0.1, error=0.15):
    """Instruments that are alike in every region."""
    return Instruments(
        detector_share=np.full(REGIONS, detectors), detector_error=np.full(REGIONS, error),
        counted_share=np.where(NETWORK.adjacency, detectors, 0.0),
        counted_gateways=np.where(NETWORK.adjacency, 2, 0), probe_share=probes)


def nothing():
    unknown = np.full((REGIONS, REGIONS), np.nan)
    return Observation(accumulation=unknown[0], crossings=unknown, probes=unknown, probe_departures=unknown)


class Crowd:
    """Whole vehicles in the regional model, every one of which moves by chance, and instruments with the errors that the
    estimator reckons with: of outflow, demand, single flows and detectors."""

    def __init__(self, seed, known, *, wrong=1.0):
        self._random, self._known, self._wrong = np.random.default_rng(seed), known, wrong
        self._parameters = dynamics.parameters(NETWORK)
        self.groups = np.zeros((2, REGIONS, REGIONS), dtype=int)  # probes, others
        self._factors = self._random.normal(0.0, 1.0, (2, REGIONS))
        self._expansion = known.detector_error * self._random.normal(0.0, 1.0, REGIONS)

    @property
    def accumulation(self):
        return self.groups.sum(axis=0).astype(float)

    def step(self, k, controls=OPEN):
        random, step = self._random, SCENARIO.step / SCENARIO.substeps
        keep = np.exp(-SCENARIO.step / estimation.OUTFLOW_MEMORY)
        outflow, wish = np.clip(1.0 + 0.3 * self._wrong * self._factors, 0.0, 2.0)
        each = np.clip(1.0 + self._wrong * estimation.FLOW_ERROR * random.normal(size=(REGIONS,) * 3), 0.0, 2.0)
        mean, crossings, departures = np.zeros(REGIONS), np.zeros((REGIONS, REGIONS)), np.zeros((REGIONS, REGIONS))
        shares = np.array([self._known.probe_share, 1.0 - self._known.probe_share])
        for _ in range(SCENARIO.substeps):
            x = self.accumulation
            before = x.sum(axis=1)
            ends, transfers = (part.numpy() for part in dynamics.flows(
                self._parameters, torch.from_numpy(x + 1e-9), torch.from_numpy(controls.perimeter),
                torch.from_numpy(NETWORK.nominal_splits)))
            change = np.zeros_like(self.groups)
            for i, j in np.argwhere(x > 0):
                ways = step * outflow[i] * each[i, :, j] * transfers[i, :, j] / x[i, j]
                ways[i] = step * outflow[i] * each[i, i, j] * ends[i] / x[i, j] if i == j else 0.0
                for group in (0, 1):
                    moved = random.multinomial(self.groups[group, i, j], [*ways, max(0.0, 1.0 - ways.sum())])[:-1]
                    change[group, i, j] -= moved.sum()
                    crossings[i] += np.where(np.arange(REGIONS) == i, 0, moved)
                    moved[i] = 0
                    change[group, :, j] += moved
            entered = random.poisson(
                shares[:, None, None] * step * SCENARIO.demand[k] * wish[:, None])
            departures += entered[0]
            self.groups += change + entered
            mean += 0.5 * (before + self.accumulation.sum(axis=1)) / SCENARIO.substeps
        self._factors = keep * self._factors + np.sqrt(1.0 - keep**2) * random.normal(size=(2, REGIONS))
        known = self._known
        slow = np.exp(-SCENARIO.step / estimation.EXPANSION_MEMORY)
        self._expansion = slow * self._expansion + np.sqrt(1.0 - slow**2) * known.detector_error * random.normal(
            size=REGIONS)
        noise = np.sqrt(mean * (1.0 - known.detector_share) / known.detector_share) * random.normal(size=REGIONS)
        share = np.where(NETWORK.adjacency, known.counted_share, 1.0)
        uneven = np.sqrt(np.maximum(1.0 - share, 0.0)) * random.normal(size=share.shape) * np.sqrt(
            crossings / share + estimation.COUNT_ERROR**2 * crossings**2 / np.maximum(known.counted_gateways, 1))
        return Observation(
            accumulation=np.maximum((1.0 + self._expansion) * mean + noise, 0.0),
            crossings=np.where(NETWORK.adjacency, crossings + uneven, np.nan), probes=self.groups[0].astype(float),
            probe_departures=departures)


def watch(seed, known, *, steps=40, changed=lambda observation: observation, wrong=1.0):
    """Truth and estimate (steps, R, R), what the detectors said (steps, R), and the surprises."""
    crowd, estimator, rows = Crowd(seed, known, wrong=wrong), Estimator(SCENARIO, known), []
    for k in range(steps):
        observation = crowd.step(k)
        estimate = estimator.step(OPEN, changed(observation))
        rows.append((crowd.accumulation, estimate, observation.accumulation, estimator.belief.surprise))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def rmse(error):
    return float(np.sqrt((error**2).mean()))


if __name__ == "__main__":
    import time
    torch.set_num_threads(1)
    known = equipped()
    for seed in range(6):
        b = time.process_time()
        truth, est, raw, s = watch(seed, known)
        op = watch(seed, known, changed=lambda o: nothing())[1]
        print(seed, 'est', rmse((est-truth).sum(2)), 'raw', rmse(raw-truth.sum(2)), 'open', rmse((op-truth).sum(2)),
              'cells', rmse(est-truth), rmse(op-truth), 'nis', np.nanmean(s[5:]), s[30:33], 'bias', (est-truth).sum(2).mean(), truth.sum((1,2)).max(), time.process_time()-b)
