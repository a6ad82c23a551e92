"""Differentiable predictive control: a neural policy from the measured state to admissible controls.

As in Tumu et al.: an MLP backbone with one decoder for the perimeter (scaled sigmoid) and one for the split ratios
(masked softmax), so that every output satisfies the constraints by construction.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from nmfd.arrays import Adjacency
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion, PerTurn
from nmfd.types import Controls, Observation

FEATURES = 6  # of a boundary, inputs of a local policy
Memory = Float[torch.Tensor, "*#B N R"]  # N numbers per region


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Shape of a policy.

    width: units per hidden layer; layers: hidden layers of the backbone
    guidance: with a decoder for the split ratios
    sparse: decoders with outputs for adjacent regions only, R^2 instead of R^3, for many regions
    local: one small network for every boundary with FEATURES inputs, perimeter control only; it fits every city
    compact: protected regions of a compact policy (nmfd.controllers.dpc.compact), () for a network
    metering: the compact policy makes trips wait
    """

    width: int = 128
    layers: int = 2
    guidance: bool = False
    sparse: bool = False
    local: bool = False
    compact: tuple[int, ...] = ()
    metering: bool = False

    @property
    def listed(self) -> bool:
        """True if outputs are those towards adjacent regions only."""
        return self.sparse or self.local


class Policy(nn.Module):
    """Policy x (veh, (..., R, R)) -> perimeter (-, (..., R, R)) and splits (-, (..., R, R, R)) or None.

    scale: normalisation of the state, the critical accumulation of each region (veh, (R, 1))
    """

    def __init__(self, network: RegionalModel, architecture: Architecture):
        super().__init__()
        regions = network.regions
        self.architecture, self.regions = architecture, regions
        self.u_min, self.u_max = network.u_min, network.u_max
        scale = torch.tensor([[m.critical] for m in network.mfds], dtype=torch.float32)
        self.register_buffer("scale", scale, persistent=not architecture.local)
        onward = _neighbours(network.adjacency) if architecture.listed else np.tile(np.arange(regions), (regions, 1))
        here = np.arange(regions)[:, None]
        allowed = torch.tensor(network.adjacency[here, onward] & (np.diff(onward, prepend=-1) != 0))
        self.register_buffer("adjacency", allowed.float(), persistent=False)
        self.register_buffer("onward", torch.tensor(onward), persistent=False)
        self._build(network)

    def _build(self, network: RegionalModel) -> None:
        """Create the weights."""
        architecture, regions, width = self.architecture, self.regions, self.architecture.width
        here, onward = np.arange(regions)[:, None], self.onward.numpy()
        layers: list[nn.Module] = []
        for layer in range(architecture.layers):
            inputs = FEATURES if architecture.local else regions**2
            layers += [nn.Linear(inputs if layer == 0 else width, width), nn.GELU()]
        self.backbone = nn.Sequential(*layers)
        self.perimeter_decoder = nn.Linear(width, 1 if architecture.local else onward.size)
        if architecture.guidance:
            self.splits_decoder = nn.Linear(width, onward.size * regions)
            mask = torch.tensor(network.split_mask[here, onward]) & self.adjacency.bool().unsqueeze(-1)
            # A softmax over nothing but -inf is NaN: rows without a turn (j = i) get finite logits and become zero.
            blocked = ~mask & mask.any(dim=1, keepdim=True)
            bias = torch.zeros(mask.shape).masked_fill(blocked, -torch.inf)
            self.register_buffer("split_mask", mask.float(), persistent=False)
            self.register_buffer("split_bias", bias, persistent=False)

    def forward(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, PerTurn | None]:
        """Return perimeter and splits of the states x; memory: what `remember` returned for x, None in rollouts."""
        perimeter, splits = self.listed(x, memory)
        if not self.architecture.listed:
            return perimeter, splits
        onward, empty = self.onward, perimeter.new_zeros(*x.shape[:-2], self.regions, self.regions)
        if splits is not None:
            turns = empty.unsqueeze(-1).repeat_interleave(self.regions, -1)
            splits = turns.scatter_add(-2, onward.unsqueeze(-1).expand_as(splits), splits)
        return empty.scatter_add(-1, onward.expand_as(perimeter), perimeter), splits

    def listed(
        self, x: PerPair, memory: Memory | None = None
    ) -> tuple[Float[torch.Tensor, "*#B R D"], Float[torch.Tensor, "*#B R D R"] | None]:
        """Return perimeter (..., R, D) and splits (..., R, D, R) towards the regions `onward`; D = R if dense."""
        shape = self.onward.shape
        hidden = self.backbone(self._around(x) if self.architecture.local else (x / self.scale).flatten(-2))
        open_share = torch.sigmoid(self.perimeter_decoder(hidden)).reshape(*x.shape[:-2], *shape)
        perimeter = (self.u_min + (self.u_max - self.u_min) * open_share) * self.adjacency
        if not self.architecture.guidance:
            return perimeter, None
        logits = self.splits_decoder(hidden).unflatten(-1, (*shape, self.regions)) + self.split_bias
        return perimeter, torch.softmax(logits, dim=-2) * self.split_mask

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """Return the memory after states x, from `memory` before them or None; None for a policy without one."""
        return None

    def prices(self, x: PerPair) -> PerRegion | None:
        """Return the prices of the ways through each region (-, (..., R)), None for a policy without them."""
        return None

    def metering(self, x: PerPair) -> PerRegion | None:
        """Return the largest rates of departures in each region (veh/s, (..., R)), None for a policy without them."""
        return None

    def _around(self, x: PerPair) -> Float[torch.Tensor, "*#B R D F"]:
        """Return n, the neighbours' mean n, and the vehicles bound for it, in critical n, for i and h of boundaries."""
        critical = self.scale.squeeze(-1)
        full, ending = (n.to(critical.dtype) / critical for n in (x.sum(-1), torch.diagonal(x, dim1=-2, dim2=-1)))
        beside = (full[..., self.onward] * self.adjacency).sum(-1) / self.adjacency.sum(-1).clamp(min=1.0)
        regions = torch.stack([full, beside, ending], dim=-1)
        here = regions.unsqueeze(-2).expand(*regions.shape[:-1], self.onward.shape[1], -1)
        return torch.cat([here, regions[..., self.onward, :]], dim=-1)


def _neighbours(adjacency: Adjacency) -> Int[np.ndarray, "R D"]:
    """Return the regions adjacent to each, (R, D), D the largest number; shorter rows repeat their last."""
    rows = [np.flatnonzero(row) for row in adjacency]
    most = max(map(len, rows))
    return np.stack([np.pad(row, (0, most - len(row)), "edge") for row in rows])


class DpcController:
    """Trained policy as a controller, "dpc-pc" or "dpc-pcrg"."""

    def __init__(self, policy: Policy):
        self.policy = policy.eval()
        self.name = "dpc-pcrg" if policy.architecture.guidance else "dpc-pc"
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._memory: Memory | None = None

    def act(self, observation: Observation) -> Controls:
        policy, accumulation = self.policy, observation.accumulation
        with torch.inference_mode():
            # A local policy needs the sums only, and no copy.
            x = torch.from_numpy(accumulation if policy.architecture.local else accumulation.astype(np.float32))
            self._memory = policy.remember(x, self._memory)
            values = *policy(x, self._memory), policy.prices(x), policy.metering(x)
        perimeter, splits, prices, metering = (None if v is None else v.numpy().astype(float) for v in values)
        if splits is not None:
            splits /= np.maximum(splits.sum(axis=1, keepdims=True), 1e-9)  # float32 misses 1
        return Controls(perimeter=perimeter, splits=splits, prices=prices, metering=metering)
