"""The estimator against cities whose truth is known: whole vehicles that move by chance as the
regional model says."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from nmfd.api import load_scenario
from nmfd.model import dynamics, estimation
from nmfd.model.estimation import Estimator, bounded
from nmfd.model.instruments import Instruments, Readings
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.types import Controls

# With one curve per region, as published: what is tested here is the filter, not how good a model a
# city has.
_PEAK = load_scenario("grid7_peak")
SCENARIO = replace(
    _PEAK, network=replace(_PEAK.network, exit_rates=None, capacity=None, storage=None)
)
NETWORK = SCENARIO.network
REGIONS = NETWORK.regions
STEPS = 40
OPEN = Controls(perimeter=NETWORK.open_perimeter)


def equipped(*, detectors=0.3, probes=0.1, error=0.15):
    """Instruments that are alike in every region."""
    return Instruments(
        detector_share=np.full(REGIONS, detectors),
        detector_error=np.full(REGIONS, error),
        detector_noise=np.full(REGIONS, error),
        counted_share=np.where(NETWORK.adjacency, detectors, 0.0),
        counted_gateways=np.where(NETWORK.adjacency, 2, 0),
        probe_share=probes,
    )


def nothing():
    unknown = np.full((REGIONS, REGIONS), np.nan)
    return Readings(
        accumulation=unknown[0], crossings=unknown, probes=unknown, probe_departures=unknown
    )


class Crowd:
    """Whole vehicles in the regional model, every one of which moves by chance, and instruments
    with the errors that the estimator reckons with: of outflow, demand, single flows and detectors.
    wrong: times those of the model."""

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
        keep = np.exp(-SCENARIO.step / estimation.MEMORY)
        outflow, wish = np.clip(1.0 + 0.3 * self._wrong * self._factors, 0.0, 2.0)
        lasting = np.sqrt((1.0 + keep) / (1.0 - keep))
        each = 1.0 + self._wrong * estimation.FLOW_ERROR * lasting * random.normal(
            size=(REGIONS,) * 3
        )
        each = np.clip(each, 0.0, 3.0)
        mean = np.zeros(REGIONS)
        crossings = np.zeros((REGIONS, REGIONS))
        departures = np.zeros((REGIONS, REGIONS))
        shares = np.array([self._known.probe_share, 1.0 - self._known.probe_share])
        for _ in range(SCENARIO.substeps):
            x = self.accumulation
            before = x.sum(axis=1)
            given = map(torch.from_numpy, (x + 1e-9, controls.perimeter, NETWORK.nominal_splits))
            ends, transfers = (part.numpy() for part in dynamics.flows(self._parameters, *given))
            change = np.zeros_like(self.groups)
            for i, j in np.argwhere(x > 0):
                ways = step * outflow[i] * each[i, :, j] * transfers[i, :, j] / x[i, j]
                ways[i] = step * outflow[i] * each[i, i, j] * ends[i] / x[i, j] if i == j else 0.0
                ways /= max(1.0, ways.sum())
                for group in (0, 1):
                    moved = random.multinomial(
                        self.groups[group, i, j], [*ways, max(0.0, 1.0 - ways.sum())]
                    )[:-1]
                    change[group, i, j] -= moved.sum()
                    crossings[i] += np.where(np.arange(REGIONS) == i, 0, moved)
                    moved[i] = 0
                    change[group, :, j] += moved
            entered = random.poisson(
                shares[:, None, None] * step * SCENARIO.demand[k] * wish[:, None]
            )
            departures += entered[0]
            self.groups += change + entered
            mean += 0.5 * (before + self.accumulation.sum(axis=1)) / SCENARIO.substeps
        self._factors = keep * self._factors + np.sqrt(1.0 - keep**2) * random.normal(
            size=(2, REGIONS)
        )
        known = self._known
        slow = np.exp(-SCENARIO.step / estimation.EXPANSION_MEMORY)
        change = known.detector_error * random.normal(size=REGIONS)
        self._expansion = slow * self._expansion + np.sqrt(1.0 - slow**2) * change
        sampled = mean * (1.0 - known.detector_share) / known.detector_share
        noise = random.normal(size=REGIONS) * np.sqrt(sampled + (known.detector_noise * mean) ** 2)
        share = np.where(NETWORK.adjacency, known.counted_share, 1.0)
        spread = crossings / share + (estimation.COUNT_ERROR * crossings) ** 2 / np.maximum(
            known.counted_gateways, 1
        )
        uneven = np.sqrt(np.maximum(1.0 - share, 0.0) * spread) * random.normal(size=share.shape)
        return Readings(
            accumulation=np.maximum((1.0 + self._expansion) * mean + noise, 0.0),
            crossings=np.where(NETWORK.adjacency, crossings + uneven, np.nan),
            probes=self.groups[0].astype(float),
            probe_departures=departures,
        )


def watch(seed, known, *, steps=STEPS, changed=lambda observation: observation, wrong=1.0):
    """Truth and estimate (steps, R, R), and what the detectors said (steps, R)."""
    crowd = Crowd(seed, known, wrong=wrong)
    estimator = Estimator(planning_model(SCENARIO), known)
    rows = []
    for k in range(steps):
        observation = crowd.step(k)
        estimate = estimator.step(OPEN, changed(observation))
        rows.append((crowd.accumulation, estimate, observation.accumulation))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def rmse(error):
    return float(np.sqrt((error**2).mean()))


@pytest.fixture(scope="module")
def runs():
    """Truth, estimates and detectors of six cities, and estimates without the readings."""
    known = equipped()
    blind = Estimator(planning_model(SCENARIO), known)
    open_loop = np.array([blind.step(OPEN, nothing()) for _ in range(STEPS)])
    return [(*watch(seed, known), open_loop) for seed in range(6)]


def test_beats_the_detectors_and_the_open_loop(runs):
    off = []
    for truth, estimate, detectors, open_loop in runs:
        total = truth.sum(axis=2)
        off.append(
            [
                rmse(guess - total)
                for guess in (estimate.sum(axis=2), detectors, open_loop.sum(axis=2))
            ]
        )
        assert off[-1][0] < off[-1][1]
        assert off[-1][0] < 0.5 * off[-1][2]
        assert rmse(estimate - truth) < 0.5 * rmse(open_loop - truth)
    pooled = np.sqrt((np.array(off) ** 2).mean(axis=0))
    assert pooled[0] < 0.5 * pooled[1]
    assert pooled[0] < 0.1 * pooled[2]


def test_the_whole_model_of_a_city_too(monkeypatch):
    """With exit rates, boundary capacities and storage, in the city and in the filter."""
    here = sys.modules[__name__]
    monkeypatch.setattr(here, "SCENARIO", _PEAK)
    monkeypatch.setattr(here, "NETWORK", _PEAK.network)
    assert NETWORK.exit_rates is not None
    assert NETWORK.capacity is not None
    known = equipped()
    truth, estimate, detectors = watch(0, known)
    open_loop = watch(0, known, changed=lambda observation: nothing())[1]
    total, seen = truth.sum(axis=2), estimate.sum(axis=2)
    assert rmse(seen - total) < 0.5 * min(
        rmse(detectors - total), rmse(open_loop.sum(axis=2) - total)
    )
    assert rmse(estimate - truth) < rmse(open_loop - truth)


def test_unbiased_and_consistent(runs):
    """Over cities, the errors of the totals cancel, and the innovations are about as large as the
    covariances say: a little smaller, since vehicles that leave by lot vary less than the Poisson
    flows that the estimator reckons with.
    """
    bias = [float((estimate - truth).sum(axis=(1, 2)).mean()) for truth, estimate, *_ in runs]
    scale = np.mean([rmse((estimate - truth).sum(axis=(1, 2))) for truth, estimate, *_ in runs])
    assert abs(np.mean(bias)) < 0.6 * scale
    assert abs(np.mean(bias)) < 0.02 * np.mean(
        [truth.sum(axis=(1, 2)).mean() for truth, *_ in runs]
    )


def test_never_negative_nor_fewer_than_the_probes(runs):
    for _, estimate, *_ in runs:
        assert estimate.min() >= 0.0
    random, estimator = np.random.default_rng(0), Estimator(planning_model(SCENARIO), equipped())
    for _ in range(30):  # readings that contradict one another
        probes = random.integers(0, 40, (REGIONS, REGIONS)).astype(float)
        observation = Readings(
            accumulation=random.uniform(0.0, 300.0, REGIONS),
            probes=probes,
            crossings=np.where(
                NETWORK.adjacency, random.uniform(0.0, 50.0, (REGIONS, REGIONS)), np.nan
            ),
            probe_departures=random.integers(0, 5, (REGIONS, REGIONS)).astype(float),
        )
        estimate = estimator.step(OPEN, observation)
        assert np.isfinite(estimate).all()
        assert (estimate >= probes - 1e-9).all()


def test_everything_measured_is_the_state():
    known = equipped(detectors=1.0, probes=1.0, error=0.0)
    truth, estimate, *_ = watch(1, known, steps=20)
    assert np.abs(estimate - truth).max() < 1.0
    assert rmse(estimate - truth) < 0.1


def test_without_readings_it_is_the_regional_model():
    """So it conserves vehicles as that does."""
    plant, estimator = NmfdPlant(SCENARIO), Estimator(planning_model(SCENARIO), equipped())
    plant.reset(0)
    for _ in range(30):
        exact = plant.step(OPEN).accumulation
        estimate = estimator.step(OPEN, nothing())
        assert np.abs(estimate - exact).max() < 1e-6
    assert exact.sum() > 500.0


def test_detectors_tell_the_total_and_probes_the_destinations():
    """Demand and outflow are other than the model has them: either instrument notices, and only
    probes tell apart."""
    off = {}
    for name, known, changed in (
        ("detectors", equipped(), lambda o: replace(nothing(), accumulation=o.accumulation)),
        ("probes", equipped(), lambda o: replace(o, accumulation=nothing().accumulation)),
        ("nothing", equipped(), lambda o: nothing()),
    ):
        truth, estimate, *_ = watch(2, known, changed=changed)
        off[name] = rmse((estimate - truth).sum(axis=2)), rmse(estimate - truth)
    assert max(off["detectors"][0], off["probes"][0]) < 0.5 * off["nothing"][0]
    assert off["probes"][1] < off["detectors"][1] < off["nothing"][1]


@pytest.mark.parametrize("broken", [np.nan, 40.0])
def test_a_region_without_its_detector_is_predicted_on(broken):
    """Missing, or stuck at a number: without probes there, it would follow a stuck one for ever."""

    def without_region_0(observation):
        accumulation = observation.accumulation.copy()
        accumulation[0] = broken
        return replace(observation, accumulation=accumulation)

    truth, whole, *_ = watch(2, equipped())
    _, partial, *_ = watch(2, equipped(), changed=without_region_0)
    assert np.isfinite(partial).all()
    error = [rmse((estimate - truth)[5:, 0].sum(axis=1)) for estimate in (whole, partial)]
    assert error[1] < max(3.0 * error[0], 0.25 * truth[:, 0].sum(axis=1).max())
    assert rmse((partial - truth)[:, 1:]) < 1.3 * rmse((whole - truth)[:, 1:])


def test_bounded_moves_what_correlates():
    """Two cells of a region whose total is known: what one is raised by, the other loses."""
    covariance = np.array([[1.0, -1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(
        bounded(np.array([-2.0, 12.0]), covariance, np.zeros(2)), [0.0, 10.0], atol=1e-3
    )
    np.testing.assert_allclose(
        bounded(np.array([-2.0, 12.0]), np.eye(2), np.zeros(2)), [0.0, 12.0], atol=1e-3
    )
    inside = np.array([3.0, 4.0])
    assert bounded(inside, covariance, np.zeros(2)) is inside


def readings(known, *, mean=40.0, expansion=0.1, crossings=9.0, x=25.0, probes=10.0, leaving=2.0):
    """Expectations and variances of the readings of one kind each, where all regions and boundaries
    are alike."""
    model = Estimator(planning_model(SCENARIO), known)
    z = np.zeros(model._size)
    z[model._expansion], z[model._x], z[model._mean] = expansion, x, mean
    z[model._crossings], z[model._probes], z[model._departures] = crossings, probes, 3.0
    observation = Readings(
        accumulation=np.full(REGIONS, 1.0),
        crossings=np.full((REGIONS, REGIONS), 2.0),
        probes=np.full((REGIONS, REGIONS), 3.0),
        probe_departures=np.full((REGIONS, REGIONS), 4.0),
    )
    prediction = estimation._Prediction(
        z, covariance=torch.zeros(0), leaving=np.full(REGIONS**2, leaving)
    )
    columns = model._compared(prediction, observation, observation.accumulation)
    ends = np.cumsum([REGIONS, len(model._boundaries), REGIONS**2, REGIONS**2])
    kinds = [np.split(column, ends) for column in columns]
    assert all(np.ptp(part) == 0 for kind in kinds for part in kind)
    return [[float(part[0]) for part in kind] for kind in kinds]


def test_the_noise_of_every_kind_of_reading():
    """Detectors on a share s of the links see a binomial part; so do counts, besides their own
    error; probes are seen exactly; and are a binomial share of the vehicles, as long as the same
    ones are there."""
    loops, counts, probes, departures, share = readings(
        equipped(detectors=0.25, probes=0.1, error=0.2)
    )[2]
    floor = estimation.FLOOR
    assert loops == pytest.approx(40.0 * 3.0 + (0.2 * 40.0) ** 2 + floor)
    assert counts == pytest.approx(
        0.75 * (9.0 / 0.25 + estimation.COUNT_ERROR**2 * 81.0 / 2.0) + floor
    )
    assert probes == departures == floor
    kept = np.exp(-max(2.0 / 25.0, SCENARIO.step / estimation.MEMORY))
    assert share == pytest.approx(0.1 * 0.9 * 25.0 * (1.0 + kept) / (1.0 - kept) + floor)
    assert readings(equipped(probes=0.1), leaving=50.0)[2][4] < share  # they are others every time


def test_a_detector_is_stuck_at_its_third_same_reading():
    """Two may be chance, and an empty street shows 0 for ever."""
    taken, model = [], Estimator(planning_model(SCENARIO), equipped())
    advance = model._advanced
    model._advanced = lambda *given: taken.append(given[-1][:3].tolist()) or advance(*given)
    for first in (7.0, 7.0, 7.0, 7.0, 8.0):
        accumulation = np.full(REGIONS, np.nan)
        accumulation[:3] = first, 0.0, 10.0 + len(taken)
        model.step(OPEN, replace(nothing(), accumulation=accumulation))
    assert [np.isnan(first) for first, _, _ in taken] == [False, False, True, True, False]
    assert [rest for _, *rest in taken] == [[0.0, 10.0 + k] for k in range(5)]


def test_the_covariance_of_one_step_by_finite_differences():
    """Compare the covariance of an error and each cell with what the error does to the estimate."""
    model = Estimator(planning_model(SCENARIO), equipped())

    def stepped(shift=()):
        model.reset()
        model._k, model.belief.mean[model._x] = 20, 30.0
        model.belief.mean[list(shift)] = 1e-4
        model.step(OPEN, nothing())
        return model.belief

    plain = stepped()
    for error, sigma, memory in (
        (0, 0.3, 900.0),
        (REGIONS, 0.3, 900.0),
        (2 * REGIONS, 0.15, 3600.0),
    ):
        moved, kept = stepped([error]), np.exp(-SCENARIO.step / memory)
        np.testing.assert_allclose(
            [moved.mean[error], plain.covariance[error, error]], [1e-4 * kept, sigma**2]
        )
        slope = (moved.mean - plain.mean)[model._x] / 1e-4
        np.testing.assert_allclose(
            plain.covariance[error, model._x], kept * sigma**2 * slope, rtol=1e-3, atol=1e-3
        )
        assert (np.abs(slope).max() > 1.0) == (error < 2 * REGIONS)


def test_the_noise_of_one_flow_by_hand():
    """9 vehicles cross, a quarter of them probes: half of each counts in the mean, its square by a
    third."""
    model = Estimator(planning_model(SCENARIO), equipped())
    moves = torch.zeros(len(model._turns) + REGIONS + REGIONS**2, dtype=torch.float64)
    here, onward, bound = (int(n) for n in model._turns[0])
    crossing = int(np.flatnonzero((model._boundaries == [here, onward]).all(axis=1))[0])
    moves[0] = 9.0
    left = REGIONS * here + bound
    came = REGIONS * onward + bound
    before = REGIONS**2 + here
    after = REGIONS**2 + onward
    passed = REGIONS**2 + REGIONS + crossing
    probe = REGIONS**2 + REGIONS + len(model._boundaries)
    kept = np.exp(-SCENARIO.step / 900.0)
    for leaving in (0.0, 50.0):  # turns stray by a share of what leaves the cell
        out = torch.zeros(REGIONS**2, dtype=torch.float64).index_fill(
            0, torch.tensor([left]), leaving
        )
        wrong = (1.0 + kept) / (1.0 - kept) * (0.2 * 9.0 + 0.02 * leaving) ** 2
        noise = model._flow_noise(model.belief, moves, 0.25 * moves, out).numpy()
        np.testing.assert_allclose(
            noise[came, [came, left, passed]], [9.0 + wrong, -9.0 - wrong, 9.0 + wrong]
        )
        np.testing.assert_allclose(
            noise[after, [after, before]], [3.0 + wrong / 4, -2.25 - wrong / 4]
        )
        np.testing.assert_allclose(
            noise[came, [probe + came, after]], [2.25 + wrong / 4, 4.5 + wrong / 2]
        )
        np.testing.assert_allclose(noise[probe + came, probe + came], 2.25 + wrong / 16)
        assert (noise == noise.T).all()
