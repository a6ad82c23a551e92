"""Terminal cost of economic MPC: a learned value function.

    V(x, k) = (T - k) sum_ij s(o_ij) x_ij + (1 - k / T) OFFSET o_0
    s(a)    = 1 / (1 + e^(LATE - a))

It approximates the sum of all vehicles over the intervals k + 1 .. T - 1 under a DPC policy, from
the state x in interval k. Every vehicle stays for a share s of the remaining time. (o_ij, o_0) is a
small network of x in critical accumulations and of the time.
scenarios/economic_mpc/terminal_cost.py learns it from rollouts, on values and derivatives.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nmfd.controllers.mpc.edge_model import PerCell
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel

WAVES = 8  # sines and cosines of the time
OFFSET = 1e4  # veh intervals
LATE = 2.5  # offset of s: initially vehicles leave soon
WEIGHTS = ("first", "second", "last")


@dataclass(frozen=True, kw_only=True)
class Terminal:
    """Value function V of one scenario, which takes forty microseconds.

    steps: T
    used: destinations of the cells, (R,)
    scale: critical accumulation of the region of each cell (veh, (C,))
    weights, biases: of three layers
    network_hash: of the regional model of the rollouts
    controller: name of the MPC that uses it
    """

    steps: int
    used: Bool[np.ndarray, " R"]
    scale: PerCell
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    network_hash: str
    controller: str

    def __call__(self, x: PerCell, step: int) -> tuple[float, PerCell]:
        """Return V (veh intervals) and dV/dx (C,).

        x: vehicles in the cells at the beginning of interval `step` (veh, (C,))
        """
        step = min(step, self.steps)
        left = float(self.steps - step)
        share = step / self.steps
        first, second, last = self.weights
        of_first, of_second, of_last = self.biases
        features = np.concatenate([x / self.scale, clock(share)])
        hidden, slope = _gelu(first @ features + of_first)
        deeper, steeper = _gelu(second @ hidden + of_second)
        out = last @ deeper + of_last
        stays = 1.0 / (1.0 + np.exp(LATE - out[:-1]))
        value = left * float(stays @ x) + OFFSET * (1.0 - share) * float(out[-1])
        of_out = np.append(left * x * stays * (1.0 - stays), OFFSET * (1.0 - share))
        of_x = first.T @ (slope * (second.T @ (steeper * (last.T @ of_out))))
        return value, left * stays + of_x[: len(x)] / self.scale


def clock(share: float) -> Float[np.ndarray, " F"]:
    """Return the features of the time (1 + 2 WAVES,).

    share: of the horizon (-)
    """
    angles = math.pi * share * np.arange(1, WAVES + 1)
    return np.concatenate([[share], np.sin(angles), np.cos(angles)])


def _gelu(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return torch.nn.GELU and its derivative.

    It is a times the normal distribution function.
    """
    from scipy.special import erf  # slow to import

    below = 0.5 * (1.0 + erf(a / math.sqrt(2.0)))
    return a * below, below + a * np.exp(-0.5 * a * a) / math.sqrt(2.0 * math.pi)


def read(path: Path, planning: PlanningModel, controller: str) -> Terminal:
    """Return the value function in an .npz file of terminal_cost.py.

    Raises: InputError if it is of another regional model or controller
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
        terminal = Terminal(
            steps=int(content["steps"]),
            used=content["used"],
            scale=content["scale"],
            weights=tuple(content[f"{name}_weight"].astype(float) for name in WEIGHTS),
            biases=tuple(content[f"{name}_bias"].astype(float) for name in WEIGHTS),
            network_hash=str(content["network_hash"]),
            controller=str(content["controller"]),
        )
    except Exception:
        raise InputError(f"{path}: is no value function") from None
    network = planning.network
    same_destinations = np.array_equal(terminal.used, planning.destinations)
    if terminal.network_hash != network.hash or not same_destinations:
        raise InputError(
            f"{path}: network_hash: was learned for another regional model or other destinations "
            f"than those of {network.name!r}"
        )
    if terminal.controller != controller:
        raise InputError(
            f"{path}: is the value function of {terminal.controller}, not of {controller}"
        )
    return terminal
