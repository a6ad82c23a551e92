"""Differentiable predictive control: a neural policy from the measured state to admissible controls.

As in Tumu et al.: an MLP backbone with one decoder for the perimeter (scaled sigmoid) and one for the split ratios
(masked softmax), so that every output satisfies the constraints by construction. Trained by `training`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from nmfd.arrays import Adjacency
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion, PerTurn
from nmfd.types import Controls, Observation, Status

Activation = Literal["gelu", "relu", "tanh", "soft-exponential"]
FEATURES = 6  # of a boundary, that a local policy sees
Memory = Float[torch.Tensor, "*#B N R"]  # N numbers per region


class SoftExponential(nn.Module):
    """Trainable activation between logarithm, identity and exponential (Godfrey and Gashler, 2015), per unit.

    f(a, x) = -ln(1 - a (x + a)) / a for a < 0, x at a = 0, (exp(a x) - 1) / a + a for a > 0. Near its pole and below
    the logarithm goes on along its tangent, and the exponential stops growing at e^20, so that f and its gradients
    are finite for every x.
    """

    POLE = 1e-3  # the argument of the logarithm from which on its tangent is taken

    def __init__(self, width: int):
        super().__init__()
        self.alpha = nn.Parameter(torch.zeros(width))

    def forward(self, x: Float[torch.Tensor, "*B W"]) -> Float[torch.Tensor, "*B W"]:
        """f(alpha, x)."""
        small = self.alpha.abs() < 1e-4
        safe = torch.where(small, torch.full_like(self.alpha, 1e-4), self.alpha)
        rising = torch.expm1((safe * x).clamp(max=20.0)) / safe + safe
        argument = 1.0 - safe * (x + safe)
        logarithm = torch.log(argument.clamp(min=self.POLE)) + (argument - self.POLE).clamp(max=0.0) / self.POLE
        # Near a = 0 the first-order expansion in a: with x alone, a would have no gradient and stay 0 for ever.
        identity = x + self.alpha * (1.0 + 0.5 * x * x)
        return torch.where(small, identity, torch.where(safe > 0, rising, -logarithm / safe))


ACTIVATIONS: dict[Activation, Callable[[int], nn.Module]] = {
    "gelu": lambda width: nn.GELU(),
    "relu": lambda width: nn.ReLU(),
    "tanh": lambda width: nn.Tanh(),
    "soft-exponential": SoftExponential,
}


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """width: units per hidden layer; layers: hidden layers of the backbone; activation: a key of ACTIVATIONS;
    guidance: with a decoder for the split ratios; sparse: decoders with outputs for adjacent regions only, which a
    city of many regions needs (their number grows with R^2 instead of R^3); local: one small network, the same at
    every boundary, which knows FEATURES numbers of what is around it: it has no more weights in a large city than in
    a small one, and one that was trained in one city can drive another. Perimeter control only; compact: the protected
    regions of a policy of a few numbers (nmfd.controllers.dpc.compact), () for a network; metering: whether that policy
    lets trips wait."""

    width: int = 128
    layers: int = 2
    activation: Activation = "gelu"
    guidance: bool = False
    sparse: bool = False
    local: bool = False
    compact: tuple[int, ...] = ()
    metering: bool = False

    @property
    def listed(self) -> bool:
        """Whether outputs are those towards adjacent regions only."""
        return self.sparse or self.local


class Policy(nn.Module):
    """State x (..., R, R) [veh] -> perimeter (..., R, R) [-] and splits (..., R, R, R) [-], or None without guidance.

    scale: (R, 1) [veh], the normalisation of the state: the critical accumulation of each region.
    """

    def __init__(self, network: RegionalModel, architecture: Architecture):
        super().__init__()
        regions = network.regions
        self.architecture, self.regions = architecture, regions
        self.u_min, self.u_max = network.u_min, network.u_max
        self.register_buffer(
            "scale",
            torch.tensor([[m.critical] for m in network.mfds], dtype=torch.float32),
            persistent=not architecture.local,
        )
        onward = _neighbours(network.adjacency) if architecture.listed else np.tile(np.arange(regions), (regions, 1))
        here = np.arange(regions)[:, None]
        allowed = torch.tensor(network.adjacency[here, onward] & (np.diff(onward, prepend=-1) != 0))
        self.register_buffer("adjacency", allowed.float(), persistent=False)
        self.register_buffer("onward", torch.tensor(onward), persistent=False)
        self._build(network)

    def _build(self, network: RegionalModel) -> None:
        """Its weights."""
        architecture, regions, width = self.architecture, self.regions, self.architecture.width
        here, onward = np.arange(regions)[:, None], self.onward.numpy()
        layers: list[nn.Module] = []
        for layer in range(architecture.layers):
            inputs = FEATURES if architecture.local else regions**2
            layers += [nn.Linear(inputs if layer == 0 else width, width), ACTIVATIONS[architecture.activation](width)]
        self.backbone = nn.Sequential(*layers)
        self.perimeter_decoder = nn.Linear(width, 1 if architecture.local else onward.size)
        if architecture.guidance:
            self.splits_decoder = nn.Linear(width, onward.size * regions)
            mask = torch.tensor(network.split_mask[here, onward]) & self.adjacency.bool().unsqueeze(-1)
            # A softmax over nothing but -inf is NaN: rows with no way out (j = i) get finite logits and are zeroed.
            blocked = ~mask & mask.any(dim=1, keepdim=True)
            bias = torch.zeros(mask.shape).masked_fill(blocked, -torch.inf)
            self.register_buffer("split_mask", mask.float(), persistent=False)
            self.register_buffer("split_bias", bias, persistent=False)

    def forward(self, x: PerPair) -> tuple[PerPair, PerTurn | None]:
        """Perimeter and splits of the states x."""
        perimeter, splits = self.listed(x)
        if not self.architecture.listed:
            return perimeter, splits
        onward, shape = self.onward, (self.regions,) * 2
        perimeter = perimeter.new_zeros(*x.shape[:-2], *shape).scatter_add(-1, onward.expand_as(perimeter), perimeter)
        if splits is not None:
            splits = splits.new_zeros(*x.shape[:-2], self.regions, *shape).scatter_add(
                -2, onward.unsqueeze(-1).expand_as(splits), splits
            )
        return perimeter, splits

    def listed(
        self, x: PerPair, memory: Memory | None = None
    ) -> tuple[Float[torch.Tensor, "*#B R D"], Float[torch.Tensor, "*#B R D R"] | None]:
        """Perimeter (..., R, D) and splits (..., R, D, R) towards the regions `onward` (R, D); all D = R if dense.

        memory: what `remember` made of x; None, as in rollouts, for nothing
        """
        shape = self.onward.shape
        hidden = self.backbone(self._around(x) if self.architecture.local else (x / self.scale).flatten(-2))
        open_share = torch.sigmoid(self.perimeter_decoder(hidden)).reshape(*x.shape[:-2], *shape)
        perimeter = (self.u_min + (self.u_max - self.u_min) * open_share) * self.adjacency
        if not self.architecture.guidance:
            return perimeter, None
        logits = self.splits_decoder(hidden).unflatten(-1, (*shape, self.regions)) + self.split_bias
        return perimeter, torch.softmax(logits, dim=-2) * self.split_mask

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """What a policy that remembers knows after states x, where it was `memory` before; None where it begins."""
        return None

    def prices(self, x: PerPair) -> PerRegion | None:
        """(..., R) [-] of the ways through each region, of a policy that brings its split ratios about by prices."""
        return None

    def metering(self, x: PerPair) -> PerRegion | None:
        """(..., R) [veh/s], the most trips that may begin in each region, of a policy that lets trips wait."""
        return None

    def _around(self, x: PerPair) -> Float[torch.Tensor, "*#B R D F"]:
        """Of every boundary (i, h): how full i and h are, their neighbours on average, and how many of those in i and h
        end there, in critical accumulations."""
        critical = self.scale.squeeze(-1)
        full, ending = (n.to(critical.dtype) / critical for n in (x.sum(-1), torch.diagonal(x, dim1=-2, dim2=-1)))
        beside = (full[..., self.onward] * self.adjacency).sum(-1) / self.adjacency.sum(-1).clamp(min=1.0)
        regions = torch.stack([full, beside, ending], dim=-1)
        here = regions.unsqueeze(-2).expand(*regions.shape[:-1], self.onward.shape[1], -1)
        return torch.cat([here, regions[..., self.onward, :]], dim=-1)


def _neighbours(adjacency: Adjacency) -> Int[np.ndarray, "R D"]:
    """(R, D) int: the regions adjacent to each, D the most that any has; shorter rows repeat their last."""
    rows = [np.flatnonzero(row) for row in adjacency]
    most = max(map(len, rows))
    return np.stack([np.pad(row, (0, most - len(row)), "edge") for row in rows])


class DpcController:
    """A trained policy as a controller (nmfd.types.Controller), "dpc-pc" or "dpc-pcrg"."""

    def __init__(self, policy: Policy):
        self._policy = policy.eval()
        self.name = "dpc-pcrg" if policy.architecture.guidance else "dpc-pc"
        self._onward = policy.onward.numpy() if policy.architecture.listed else None
        self._u_max = self._full(policy.u_max * policy.adjacency.numpy())
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._memory: Memory | None = None

    def act(self, observation: Observation) -> Controls:
        with torch.inference_mode():
            seen = observation.accumulation  # of which a local policy needs the sums only, and no copy
            x = torch.from_numpy(seen if self._policy.architecture.local else seen.astype(np.float32))
            self._memory = self._policy.remember(x, self._memory)
            perimeter, splits = self._policy.listed(x, self._memory)
            prices, metering = (
                None if asked is None else asked.numpy().astype(float)
                for asked in (self._policy.prices(x), self._policy.metering(x))
            )
        perimeter = perimeter.numpy()
        if splits is not None:
            splits = splits.numpy().astype(float)
            sums = splits.sum(axis=1, keepdims=True)
        # The sum is finite if every number is: they are bounded unless they are NaN.
        if not math.isfinite(perimeter.sum()) or (splits is not None and not math.isfinite(sums.sum())):
            return Controls(
                perimeter=self._u_max,
                splits=None,
                status=Status.SOLVER_FAILURE | Status.FALLBACK,
                note="dpc: policy returned NaN, perimeter opened",
            )
        if splits is not None:
            splits /= np.maximum(sums, 1e-9)  # float32 sums miss 1 by 1e-7; those of j = i are 0
        return Controls(
            perimeter=self._full(perimeter),
            splits=None if splits is None else self._full(splits),
            prices=prices,
            metering=metering,
        )

    def _full(self, listed: np.ndarray) -> np.ndarray:
        """(R, R) or (R, R, R) of (R, D) or (R, D, R): the second axis, over the policy's neighbours, over all regions.

        The zeros are never written, so that many regions cost no time.
        """
        if self._onward is None:
            return listed.astype(float, copy=False)
        full = np.zeros((len(listed), len(listed), *listed.shape[2:]))
        here, way = np.nonzero(np.diff(self._onward, prepend=-1))
        full[here, self._onward[here, way]] = listed[here, way]
        return full
