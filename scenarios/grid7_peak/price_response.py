"""Count the regional model of grid7 whose guided drivers answer prices.

    python scenarios/grid7_peak/price_response.py runs/prices networks/grid7_max_pressure_4

Gates are open, and prices change every HOLD control intervals. At 1 and 1.3 times the demand, some
are drawn at random; the protected region always has one. At 1.6 and 2, where random prices lock the
city, they are those of earlier policies, each times a random factor; trips wait as these policies
say, at 2 as if regions held a random factor more or less (reference/README.md).
Split ratios without prices, dispersions and the longest delay (nmfd.model.answer) are the most
likely ones of the next regions that vehicles took. The first SETTLED intervals of new prices do not
count: drivers answer when they are guided next, and are under way before they cross a boundary.
Rates and MFDs are counted as by cosim identify, but from means of three intervals, as an outflow
follows the accumulation late. The runs of the last seed are held out, to test a model without them.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import uniform_filter1d

import cosim
import nmfd
from cosim.evaluation import identify
from cosim.evaluation.model_validation import observed, outflow_samples
from nmfd import Controls, Observation, Result, Scenario
from nmfd.controllers.strategy import parse
from nmfd.model import counting
from nmfd.model.answer import Answer, saturated
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.studies import fit_quality

PRICES = 0.1, 4.0  # -, the least and the largest that are drawn
PRICED = 0.4  # probability of a region that is not protected
HOLD, SETTLED = 6, 2  # control intervals
CITY = "max-pressure+guidance-period-60"
DPC = f"dpc-pcrg+{CITY}+metering"
SEEDS = (1120, 1121, 1122)
LOADING = (
    ("RandomPrices", CITY, (1.0, 1.3), SEEDS),
    ("OfFirstPolicy", f"{CITY}+metering", (1.6,), SEEDS),
    ("OfSecondPolicy", f"{CITY}+metering", (2.0,), SEEDS),
    ("OfThirdPolicy", f"{CITY}+metering", (2.0,), SEEDS),
    ("OfFourthPolicy", f"{CITY}+metering", (2.0,), SEEDS),
    ("OfFifthPolicy", f"{CITY}+metering", (2.0,), SEEDS),
    ("FifthPolicy", f"{CITY}+metering", (2.0,), (1102,)),  # locks
)
ROUNDS = 3  # of answer and rates after each other
STEPS = 400  # of descent to the most likely answer
PRIOR_VEH = 20.0  # of each region and destination, which took the ways of all runs
PRIOR_DISPERSION_S = 100.0  # the logarithm has a standard deviation of 1
COUNTED = ("inside", "exits", "crossings", "perimeter", "splits")


class RandomPrices:
    """Prices of some regions, small ones as often as large ones, drawn anew every HOLD control
    intervals."""

    name = "random-prices"

    def __init__(self, planning: PlanningModel):
        self._network = planning.network
        self._protected = list(planning.protected)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._random, self._prices = np.random.default_rng(seed), np.zeros(self._network.regions)

    def act(self, observation: Observation) -> Controls:
        if observation.step % HOLD == 0:
            priced = self._random.random(self._network.regions) < PRICED
            priced[self._protected] = True
            logarithm = self._random.uniform(*np.log(PRICES), self._network.regions)
            self._prices = priced * np.exp(logarithm)
        return Controls(perimeter=self._network.open_perimeter, splits=None, prices=self._prices)


class OfPolicy:
    """Commands of an earlier policy, with factors that are drawn anew every HOLD control intervals.

    file: policy, in reference/
    model: network that it was trained through, from this folder
    elsewhere: its prices of regions that are not protected are left
    prices, fuller: least and largest factors of prices, and of the accumulations that metering sees
    """

    file: str
    model = "../../networks/grid7_max_pressure_3"
    elsewhere = False
    prices = 0.25, 1.0
    fuller = 0.85, 1.15

    def __init__(self, planning: PlanningModel):
        here = Path(__file__).parent
        self.name = type(self).__name__
        scenario = nmfd.load_scenario(here, {f"controllers.{DPC}.model": self.model})
        self._policy = parse(DPC).make(scenario, here / "reference" / self.file)
        self._priced = np.full(planning.network.regions, self.elsewhere)
        self._priced[list(planning.protected)] = True
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._policy.reset(seed)
        self._random = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        self._factors = np.ones((2, len(self._priced)))

    def act(self, observation: Observation) -> Controls:
        if observation.step % HOLD == 0:
            bounds = np.log([self.prices, self.fuller])
            pairs = zip(self._random, bounds, strict=True)
            drawn = [random.uniform(*both, len(self._priced)) for random, both in pairs]
            self._factors = np.exp(drawn)
        prices, fuller = self._factors
        controls = self._policy.act(observation)
        seen = replace(observation, accumulation=observation.accumulation * fuller[:, None])
        return replace(
            controls,
            prices=controls.prices * prices * self._priced,
            metering=self._policy.act(seen).metering,
        )


class OfFirstPolicy(OfPolicy):
    """The policy that was trained through networks/grid7_max_pressure_2."""

    file = "first-policy/policy.pt"
    model = "../../networks/grid7_max_pressure_2"
    elsewhere = True
    prices = 0.25, 4.0
    fuller = 1.0, 1.0


class OfSecondPolicy(OfPolicy):
    """The one that was trained through the model of the runs so far."""

    file = "loading/second/policy.pt"


class OfThirdPolicy(OfPolicy):
    """The same, with critical accumulations that were seen instead of guesses."""

    file = "loading/third/policy.pt"


class OfFourthPolicy(OfPolicy):
    """The first with thresholds per region, through the model of the runs so far."""

    file = "loading/fourth/policy.pt"
    model = "reference/loading/fourth"
    prices = 0.5, 2.0


class OfFifthPolicy(OfPolicy):
    """The next one, through the model of the runs so far."""

    file = "loading/fifth/policy.pt"
    model = "reference/loading/fifth"
    prices = 0.5, 2.0


class FifthPolicy(OfFifthPolicy):
    """The fifth policy as it is: the centre locks."""

    prices = fuller = 1.0, 1.0


def state_and_prices(run: Result) -> list[torch.Tensor]:
    """Return accumulations (veh, (T, R, R)) and prices (-, (T, R)) of a run."""
    both = (run["accumulation"][:-1], run["prices"])
    return [torch.tensor(values, dtype=torch.float32) for values in both]


def with_answer(network: RegionalModel, runs: list[Result]) -> RegionalModel:
    """Return `network` with the most likely split ratios, dispersions and longest delay."""
    answer, own = Answer(network), torch.tensor(network.nominal_splits)
    used = own > 0
    delays, taken = [], []
    for run in runs:
        settled = np.arange(len(run["prices"])) % HOLD >= SETTLED
        delays.append(answer.delays(*state_and_prices(run))[settled].double())
        taken.append(torch.tensor(run["crossings"][settled].astype(float)) * used)
    delay, veh = torch.cat(delays), torch.cat(taken)
    liking = torch.log(own.clamp(min=1e-3)).requires_grad_()
    prior = torch.tensor(np.log(PRIOR_DISPERSION_S)).double()
    spread = prior.expand(own[:, 0].shape).clone().requires_grad_()
    longest = prior.clone().requires_grad_()
    descent = torch.optim.Adam([liking, spread, longest], lr=0.05)

    def likelihood(worth: torch.Tensor, vehicles: torch.Tensor) -> torch.Tensor:
        shares = torch.log_softmax(worth.masked_fill(~used, -1e9), -2)
        return (vehicles * torch.where(used, shares, 0.0)).sum()

    for _ in range(STEPS):
        descent.zero_grad()
        counts_as = saturated(delay, longest.exp()) / spread.exp().unsqueeze(-2)
        unlikely = 0.5 * ((spread - prior) ** 2).sum()
        unlikely = unlikely - likelihood(liking, PRIOR_VEH * own)
        unlikely = unlikely - likelihood(liking - counts_as, veh)
        (unlikely / veh.sum()).backward()
        descent.step()
    shares = torch.softmax(liking.detach().masked_fill(~used, -1e9), -2).numpy()
    ratios = {}
    for i, j in np.argwhere(used.any(1).numpy()).tolist():
        ways = np.flatnonzero(used[i, :, j].numpy()).tolist()
        ratios[i, j] = {h: float(shares[i, h, j]) for h in ways}
    return replace(
        network,
        observed_split_ratios=ratios,
        dispersion=spread.detach().exp().numpy(),
        longest_delay=float(longest.detach().exp()),
    )


def answered(model: RegionalModel, runs: list[Result]) -> list[Result]:
    """Return runs with the split ratios that a model expects."""
    answer = Answer(model)
    return [run.assign(expected_splits=answer(*state_and_prices(run)).numpy()) for run in runs]


def counted(scenario: Scenario, runs: list[Result]) -> RegionalModel:
    """Return the model of runs."""
    model = static = identify.static_model(scenario, runs)
    for _ in range(ROUNDS):
        model = with_answer(model, runs)
        seen = []
        for run in map(observed, answered(model, runs)):
            means = {}
            for name in COUNTED:
                values = getattr(run, name).astype(float)
                means[name] = uniform_filter1d(values, 3, axis=0, mode="nearest")
            seen.append(replace(run, **means))
        answer = ("observed_split_ratios", "dispersion", "longest_delay")
        model = counting.counted(
            replace(static, **{name: getattr(model, name) for name in answer}),
            seen,
            scheme=scenario.scheme,
            fastest=identify.fastest_rates(scenario, static),
            saturation=identify.saturation_flows(static, runs),
            lane_km=identify.lane_kilometres(static),
        )
    return model


def main(folder: Path, target: Path) -> None:
    """Do the runs that are not in `folder` yet, and write the model to `target`."""
    scenario = nmfd.load_scenario("grid7_peak")
    runs = []
    for controller, city, levels, seeds in LOADING:
        strategy = f"{__file__}:{controller}+{city}"
        out = folder / controller
        cosim.evaluate("grid7_peak", [strategy], seeds=seeds, demand=levels, workers=2, out=out)
        runs += [Result.read(file) for file in sorted(out.glob("**/*.nc"))]
    write(scenario, runs, target)


def write(scenario: Scenario, runs: list[Result], target: Path) -> None:
    """Write the model of runs to `target`, and print how well it fits."""
    unseen = [run for run in runs if run.seed == SEEDS[-1]]
    without = counted(scenario, [run for run in runs if run not in unseen])
    model = counted(scenario, runs)
    seen = [observed(run) for run in answered(without, unseen)]
    errors = fit_quality.predictions(without, seen, scenario.scheme, model.known_critical)
    fits = fit_quality.region_fits(
        model,
        outflow_samples(model, runs),
        [run["accumulation"] for run in runs],
        seeds=len(SEEDS),
        lane_km=identify.lane_kilometres(model),
    )
    model = replace(
        model,
        placeholder=False,
        doubts=tuple(fits["doubts"]),
        held_out=fit_quality.held_out(errors),
        controllable=scenario.network.controllable,
    )
    print(fit_quality.fit_table(model, fits))
    print(fit_quality.ahead_table(errors, model.titles))
    seeds = sorted({run.seed for run in runs})
    identify.write_model(
        model,
        Path("networks/grid7"),
        target,
        "The city of grid7 with guided drivers who see prices, and max-pressure signals.\n"
        "# DPC is trained on it. Written by scenarios/grid7_peak/price_response.py from "
        f"{len(runs)} runs, seeds {', '.join(map(str, seeds))}.",
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
