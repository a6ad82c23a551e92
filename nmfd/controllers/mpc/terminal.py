"""What comes after the horizon of economic MPC: a value function, learned from rollouts of a DPC policy.

    V(x, k) = (T - k) sum_ij s(o_ij) x_ij + (1 - k / T) OFFSET o_0        s(a) = 1 / (1 + e^(LATE - a))

is about the sum of all vehicles in the network over the intervals k + 1 .. T - 1 under the policy, from the state x at
the beginning of interval k; every vehicle stays for a share s of the time that is left. (o_ij, o_0) is a small network
of x in critical accumulations and of the time. Learned by `terminal_training`, on derivatives as well as on values: MPC
goes by the former. With it a horizon of a few intervals is short-sighted no more.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import erf

from nmfd.controllers.mpc.edge_model import PerCell
from nmfd.errors import InputError
from nmfd.model.planning import PlanningModel
from nmfd.runs.files import atomic, check_file

WAVES = 8  # sines and cosines of the time
OFFSET = 1e4  # veh intervals
LATE = 2.5  # of s: vehicles are first thought to be gone soon
MAKE = "make one with scenarios/economic_mpc/terminal_cost.py"
WEIGHTS = ("first", "second", "last")


@dataclass(frozen=True, kw_only=True)
class Terminal:
    """V of one scenario, in numbers that NumPy evaluates in some forty microseconds.

    steps: T; used: (R,) bool, the destinations of the cells; scale: (C,) [veh]; weights, biases: of three layers
    network_hash: of the regional model that the policy was rolled out in; controller: whose value it is
    """

    steps: int
    used: Bool[np.ndarray, " R"]
    scale: PerCell
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    network_hash: str
    controller: str

    def __call__(self, x: PerCell, step: int) -> tuple[float, PerCell]:
        """V [veh intervals] of the cells x (C,) [veh] at the beginning of interval `step`; dV/dx (C,) [intervals]."""
        step = min(step, self.steps)
        left, share = float(self.steps - step), step / self.steps
        (first, second, last), (of_first, of_second, of_last) = self.weights, self.biases
        hidden, slope = _gelu(first @ np.concatenate([x / self.scale, clock(share)]) + of_first)
        deeper, steeper = _gelu(second @ hidden + of_second)
        out = last @ deeper + of_last
        stays = 1.0 / (1.0 + np.exp(LATE - out[:-1]))
        of_out = np.append(left * x * stays * (1.0 - stays), OFFSET * (1.0 - share))
        of_x = first.T @ (slope * (second.T @ (steeper * (last.T @ of_out))))
        value = left * float(stays @ x) + OFFSET * (1.0 - share) * float(out[-1])
        return value, left * stays + of_x[: len(x)] / self.scale


def clock(share: float) -> Float[np.ndarray, " F"]:
    """(1 + 2 WAVES,) [-]: what V knows of the time, `share` [-] of the horizon."""
    angles = math.pi * share * np.arange(1, WAVES + 1)
    return np.concatenate([[share], np.sin(angles), np.cos(angles)])


def _gelu(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x times the normal distribution function, as torch.nn.GELU, and its derivative."""
    below = 0.5 * (1.0 + erf(a / math.sqrt(2.0)))
    return a * below, below + a * np.exp(-0.5 * a * a) / math.sqrt(2.0 * math.pi)


def write(terminal: Terminal, path: Path) -> None:
    """As an .npz file without pickles; atomically."""
    with atomic(path) as temporary:
        np.savez_compressed(
            temporary,
            steps=np.array(terminal.steps),
            used=terminal.used,
            scale=terminal.scale,
            network_hash=np.array(terminal.network_hash),
            controller=np.array(terminal.controller),
            **{f"{name}_weight": w.astype(np.float32) for name, w in zip(WEIGHTS, terminal.weights, strict=True)},
            **{f"{name}_bias": b.astype(np.float32) for name, b in zip(WEIGHTS, terminal.biases, strict=True)},
        )


def read(path: Path, planning: PlanningModel, controller: str) -> Terminal:
    """What `write` wrote; InputError if it is none, of another regional model, or of another controller."""
    check_file(path, MAKE)
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
        found = Terminal(
            steps=int(content["steps"]),
            used=content["used"],
            scale=content["scale"],
            weights=tuple(content[f"{name}_weight"].astype(float) for name in WEIGHTS),
            biases=tuple(content[f"{name}_bias"].astype(float) for name in WEIGHTS),
            network_hash=str(content["network_hash"]),
            controller=str(content["controller"]),
        )
        cells = planning.network.regions * int(planning.destinations.sum())
        shapes = [w.shape for w in found.weights]
        fits = found.scale.shape == (cells,) and shapes[0][1] == cells + 1 + 2 * WAVES and shapes[2][0] == cells + 1
    except Exception:
        raise InputError(f"{path}: is no value function; {MAKE}") from None
    if found.network_hash != planning.network.hash or not fits or (found.used != planning.destinations).any():
        raise InputError(
            f"{path}: network_hash: was learned for another regional model or other destinations than those of "
            f"{planning.network.name!r}; {MAKE}"
        )
    if found.controller != controller:
        raise InputError(f"{path}: is the value function of {found.controller}, not of {controller}; {MAKE}")
    return found
