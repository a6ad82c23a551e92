"""Identify how guided drivers answer prices: dispersion and longest delay in nmfd.model.answer.

    python scenarios/grid7_peak/price_response.py runs/price-response

Prices of every region are drawn at random every six minutes. Both numbers are those with the
largest likelihood of the next regions that vehicles took (crossings of boundaries by destination),
given the state at the beginning of each interval. Printed beside it: the gain in likelihood over
nominal split ratios, relative to that of the best constants.
"""

import sys
from pathlib import Path

import numpy as np
import torch

import cosim
import nmfd
from nmfd import Controls, Observation, Result
from nmfd.controllers.strategy import parse
from nmfd.model.answer import Answer
from nmfd.model.planning import PlanningModel

MOST_PRICE, HOLD = 4.0, 4  # -, control intervals
CITY = "max-pressure+guidance-period-60+metering"
SEEDS, LEVELS = (1120, 1121), (1.0, 1.3)


class RandomPrices:
    """Prices of half of the regions, from 0 to MOST_PRICE, drawn anew every HOLD control
    intervals."""

    name = "random-prices"

    def __init__(self, planning: PlanningModel):
        self._network = planning.network
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._random, self._prices = np.random.default_rng(seed), np.zeros(self._network.regions)

    def act(self, observation: Observation) -> Controls:
        if observation.step % HOLD == 0:
            priced = self._random.random(self._network.regions) < 0.5
            self._prices = priced * self._random.uniform(0.0, MOST_PRICE, self._network.regions)
        return Controls(perimeter=self._network.open_perimeter, splits=None, prices=self._prices)


def likelihood(runs: list[Result], answer: Answer, dispersion: float) -> tuple[float, float]:
    """Return the mean log-likelihood of a crossing under the answer, and under the best constant
    split ratios (-)."""
    answer.dispersion = dispersion
    total, taken = 0.0, np.zeros(answer.own.shape)
    for run in runs:
        x, prices = (
            torch.tensor(run.data[name].values, dtype=torch.float32)
            for name in ("accumulation", "prices")
        )
        splits = answer(x[:-1], prices).double().clamp(min=1e-3).numpy()
        crossings = run.data["crossings"].values * (answer.own.numpy() > 0)
        total, taken = total + (crossings * np.log(splits)).sum(), taken + crossings.sum(0)
    best = np.clip(taken / np.maximum(taken.sum(1, keepdims=True), 1.0), 1e-3, None)
    return total / taken.sum(), (taken * np.log(best)).sum() / taken.sum()


def main(folder: Path) -> None:
    """Do the runs that are not in `folder` yet, and print likelihoods of an answer."""
    scenario = nmfd.load_scenario("grid7_peak")
    table = "dpc-pcrg+max-pressure+guidance-period-60+metering"
    answer = Answer(parse(table).own_planning(scenario).network)
    strategy = f"{__file__}:RandomPrices+{CITY}"
    cosim.evaluate("grid7_peak", [strategy], seeds=SEEDS, demand=LEVELS, workers=1, out=folder)
    runs = [Result.read(file) for file in sorted(folder.glob("**/*.nc"))]
    nominal, constant = likelihood(runs, answer, 1e6)
    print("dispersion, longest delay: share of the gain of the best constants")
    for answer.longest_delay in (30.0, 60.0, 120.0, 240.0, None):
        for dispersion in (30, 60, 80, 100, 150, 200, 300, 400, 500, 700):
            value, _ = likelihood(runs, answer, dispersion)
            gain = (value - nominal) / (constant - nominal)
            print(f"{dispersion:5} s, {answer.longest_delay} s: {gain:5.2f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
