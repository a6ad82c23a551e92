"""Differentiable predictive control: a neural policy from the measured state to admissible
controls.

As in Tumu et al.: an MLP backbone with one decoder for the perimeter (scaled sigmoid) and one for
the split ratios (masked softmax), so that every output satisfies the constraints by construction.
With `prices` the second decoder gives prices, from which the regional model derives the split
ratios (nmfd.model.answer); a third one meters departures:

    c_i = MOST_PRICE s(y_i + PRICE_LOGIT)    r_i = n_cr,i / FILL_TIME_S s(y_i + METERING_SLOPE (METERING_FROM - z_i))

y the output of the decoder, z_i = n_i / n_cr,i, s the logistic function. Initially prices are
small, and trips wait only where a region is far beyond its critical accumulation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from nmfd.arrays import Adjacency
from nmfd.model.answer import Answer
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Horizon
from nmfd.tensors import PerPair, PerRegion, PerTurn
from nmfd.types import Controls, Observation

FEATURES = 6  # of a boundary, inputs of a local policy
FILL_TIME_S = 90.0  # a signal cycle
MOST_PRICE, PRICE_LOGIT = 10.0, -3.0
METERING_SLOPE, METERING_FROM = 6.0, 1.25
Memory = Float[torch.Tensor, "*#B N R"]  # N numbers per region


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Shape of a policy.

    width: units per hidden layer; layers: hidden layers of the backbone
    guidance: with a decoder for the split ratios
    sparse: decoders with outputs for adjacent regions only, R^2 instead of R^3, for many regions
    local: one small network for every boundary with FEATURES inputs, perimeter control only; it
        fits every city
    compact: protected regions of a compact policy (nmfd.controllers.dpc.compact), () for a network
    metering: with largest rates of departures; prices: with prices of regions instead of split
        ratios, for a network
    soft_exponential: activation SoftExponential instead of GELU; decoder_layers: hidden layers of
        each decoder
    """

    width: int = 128
    layers: int = 2
    guidance: bool = False
    sparse: bool = False
    local: bool = False
    compact: tuple[int, ...] = ()
    metering: bool = False
    prices: bool = False
    soft_exponential: bool = False
    decoder_layers: int = 0

    @property
    def listed(self) -> bool:
        """True if outputs are those towards adjacent regions only."""
        return self.sparse or self.local


class PerimeterLayer(nn.Module):
    """Box of the perimeter control: any numbers (..., R, R) -> u in [u_min, u_max], 0 where h is
    not adjacent to i."""

    def __init__(self, network: RegionalModel, allowed: torch.Tensor | None = None):
        """allowed: (R, D), the boundaries that the inputs (..., R, D) stand for; by default the
        adjacency"""
        super().__init__()
        self.low, self.high = network.u_min, network.u_max
        allowed = torch.as_tensor(network.adjacency if allowed is None else allowed)
        self.register_buffer("allowed", allowed.float(), persistent=False)

    def forward(self, numbers: Float[torch.Tensor, "*#B R D"]) -> Float[torch.Tensor, "*#B R D"]:
        return (self.low + (self.high - self.low) * torch.sigmoid(numbers)) * self.allowed


class SplitsLayer(nn.Module):
    """Simplex of the split ratios: any numbers (..., R, R, R) -> theta >= 0 with sum 1 over the
    allowed turns."""

    def __init__(self, network: RegionalModel, mask: torch.Tensor | None = None):
        """mask: (R, D, R), the turns that the inputs (..., R, D, R) stand for; by default
        network.split_mask"""
        super().__init__()
        mask = torch.as_tensor(network.split_mask if mask is None else mask)
        # A softmax over nothing but -inf is NaN: rows without a turn (j = i) get finite logits and
        # become zero.
        blocked = ~mask & mask.any(dim=1, keepdim=True)
        self.register_buffer("mask", mask.float(), persistent=False)
        self.register_buffer(
            "bias", torch.zeros(mask.shape).masked_fill(blocked, -torch.inf), persistent=False
        )

    def forward(
        self, numbers: Float[torch.Tensor, "*#B R D R"]
    ) -> Float[torch.Tensor, "*#B R D R"]:
        return torch.softmax(numbers + self.bias, dim=-2) * self.mask


class SoftExponential(nn.Module):
    """Activation with one trained number a, initially 0 (Godfrey and Gashler, 2015).

    -log(1 - a (x + a)) / a for a < 0, x for a = 0, (exp(a x) - 1) / a + a for a > 0; near a = 0 its
    series, so that a has a gradient. NeuroMANCER's has none at its own default a = 0: there a
    network of it stays linear.
    """

    def __init__(self) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.tensor(0.0))

    def forward(self, x: Float[torch.Tensor, "*B"]) -> Float[torch.Tensor, "*B"]:
        near = self.a.abs() < 1e-3
        a = torch.where(near, torch.ones_like(self.a), self.a)
        falling = -torch.log((1.0 - a * (x + a)).clamp(min=1e-6)) / a
        rising = torch.expm1((a * x).clamp(max=30.0)) / a + a
        return torch.where(
            near, x + self.a * (1.0 + 0.5 * x**2), torch.where(a < 0, falling, rising)
        )


class Policy(nn.Module):
    """Policy x (veh, (..., R, R)) -> perimeter (-, (..., R, R)) and splits (-, (..., R, R, R)) or
    None.

    scale: normalisation of the state, the critical accumulation of each region (veh, (R, 1))
    """

    def __init__(self, network: RegionalModel, architecture: Architecture):
        super().__init__()
        regions = network.regions
        self.architecture, self.regions = architecture, regions
        scale = torch.tensor([[m.critical] for m in network.mfds], dtype=torch.float32)
        self.register_buffer("scale", scale, persistent=not architecture.local)
        onward = (
            _neighbours(network.adjacency)
            if architecture.listed
            else np.tile(np.arange(regions), (regions, 1))
        )
        here = np.arange(regions)[:, None]
        allowed = torch.tensor(network.adjacency[here, onward] & (np.diff(onward, prepend=-1) != 0))
        self.box = PerimeterLayer(network, allowed)
        self.register_buffer("onward", torch.tensor(onward), persistent=False)
        self._build(network)
        if architecture.prices or (architecture.compact and architecture.guidance):
            self.answer = Answer(network)

    def _build(self, network: RegionalModel) -> None:
        architecture, regions, width = self.architecture, self.regions, self.architecture.width
        here, onward = np.arange(regions)[:, None], self.onward.numpy()
        activation = SoftExponential if architecture.soft_exponential else nn.GELU

        def hidden(inputs: int, layers: int) -> list[nn.Module]:
            sizes = [inputs, *[width] * layers]
            return [
                part for n in range(layers) for part in (nn.Linear(sizes[n], width), activation())
            ]

        def decoder(outputs: int) -> nn.Module:
            layers = [*hidden(width, architecture.decoder_layers), nn.Linear(width, outputs)]
            return nn.Sequential(*layers) if len(layers) > 1 else layers[0]

        self.backbone = nn.Sequential(
            *hidden(FEATURES if architecture.local else regions**2, architecture.layers)
        )
        self.perimeter_decoder = decoder(1 if architecture.local else onward.size)
        if architecture.prices:
            self.prices_decoder = decoder(regions)
        elif architecture.guidance:
            self.splits_decoder = decoder(onward.size * regions)
            mask = torch.tensor(
                network.split_mask[here, onward]
            ) & self.box.allowed.bool().unsqueeze(-1)
            self.simplex = SplitsLayer(network, mask)
        if architecture.metering:
            self.metering_decoder = decoder(regions)

    @property
    def decoders(self) -> list[nn.Module]:
        """Decoders, which training takes in turn."""
        return [part for name, part in self.named_children() if name.endswith("_decoder")]

    def forward(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, PerTurn | None]:
        """Return perimeter and splits of the states x; memory: what `remember` returned for x, None
        in rollouts."""
        perimeter, splits = self.listed(x, memory)
        if self.architecture.listed:
            onward, empty = (
                self.onward,
                perimeter.new_zeros(*x.shape[:-2], self.regions, self.regions),
            )
            perimeter = empty.scatter_add(-1, onward.expand_as(perimeter), perimeter)
            if splits is not None:
                turns = empty.unsqueeze(-1).repeat_interleave(self.regions, -1)
                splits = turns.scatter_add(-2, onward.unsqueeze(-1).expand_as(splits), splits)
        prices = self.prices(x)
        return perimeter, splits if prices is None else self.answer(x.to(self.scale.dtype), prices)

    def listed(
        self, x: PerPair, memory: Memory | None = None
    ) -> tuple[Float[torch.Tensor, "*#B R D"], Float[torch.Tensor, "*#B R D R"] | None]:
        """Return perimeter (..., R, D) and splits (..., R, D, R) towards the regions `onward`; D =
        R if dense."""
        shape, hidden = self.onward.shape, self._hidden(x)
        perimeter = self.box(self.perimeter_decoder(hidden).reshape(*x.shape[:-2], *shape))
        if not self.architecture.guidance or self.architecture.prices:
            return perimeter, None
        return perimeter, self.simplex(
            self.splits_decoder(hidden).unflatten(-1, (*shape, self.regions))
        )

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """Return the memory after states x, from `memory` before them or None; None for a policy
        without one."""
        return None

    def prices(self, x: PerPair) -> PerRegion | None:
        """Return the prices of the ways through each region (-, (..., R)), None for a policy
        without them."""
        if not self.architecture.prices:
            return None
        return MOST_PRICE * torch.sigmoid(self.prices_decoder(self._hidden(x)) + PRICE_LOGIT)

    def metering(self, x: PerPair) -> PerRegion | None:
        """Return the largest rates of departures in each region (veh/s, (..., R)), None for a
        policy without them."""
        if not self.architecture.metering:
            return None
        numbers = self.metering_decoder(self._hidden(x)) + METERING_SLOPE * (
            METERING_FROM - self._full(x)
        )
        return self.scale.squeeze(-1) / FILL_TIME_S * torch.sigmoid(numbers)

    def _hidden(self, x: PerPair) -> Float[torch.Tensor, "*#B H"]:
        return self.backbone(
            self._around(x) if self.architecture.local else (x / self.scale).flatten(-2)
        )

    def _full(self, x: PerPair) -> PerRegion:
        """Return the accumulations relative to the critical ones (-, (..., R))."""
        return x.to(self.scale.dtype).sum(-1) / self.scale.squeeze(-1)

    def _around(self, x: PerPair) -> Float[torch.Tensor, "*#B R D F"]:
        """Return n, the neighbours' mean n, and the vehicles bound for it, in critical n, for i and
        h of boundaries."""
        critical = self.scale.squeeze(-1)
        full, ending = (
            n.to(critical.dtype) / critical
            for n in (x.sum(-1), torch.diagonal(x, dim1=-2, dim2=-1))
        )
        beside = (full[..., self.onward] * self.box.allowed).sum(-1) / self.box.allowed.sum(
            -1
        ).clamp(min=1.0)
        regions = torch.stack([full, beside, ending], dim=-1)
        here = regions.unsqueeze(-2).expand(*regions.shape[:-1], self.onward.shape[1], -1)
        return torch.cat([here, regions[..., self.onward, :]], dim=-1)


def _neighbours(adjacency: Adjacency) -> Int[np.ndarray, "R D"]:
    """Return the regions adjacent to each, (R, D), D the largest number; shorter rows repeat their
    last."""
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
            x = torch.from_numpy(
                accumulation if policy.architecture.local else accumulation.astype(np.float32)
            )
            self._memory = policy.remember(x, self._memory)
            values = *policy(x, self._memory), policy.prices(x), policy.metering(x)
        perimeter, splits, prices, metering = (
            None if v is None else v.numpy().astype(float) for v in values
        )
        if splits is not None:
            splits /= np.maximum(splits.sum(axis=1, keepdims=True), 1e-9)  # float32 misses 1
        return Controls(perimeter=perimeter, splits=splits, prices=prices, metering=metering)


def commanded(policy: nn.Module, x: PerPair) -> tuple[PerPair, PerTurn | None]:
    """Return perimeter, and splits or None, of any module in the states x."""
    values = policy(x)
    return (values, None) if isinstance(values, torch.Tensor) else tuple(values)


class ModuleController:
    """Module of your own as a controller: states (veh, (..., R, R)) -> perimeter or (perimeter,
    splits).

    Methods `prices` and `metering` of the states, if it has them, return those of nmfd.Controls.
    All are checked.

        >>> scenario = nmfd.load_scenario("economic_mpc")
        >>> gates = nmfd.PerimeterLayer(scenario.network)  # opens with every vehicle more
        >>> nmfd.run(scenario, nmfd.ModuleController(gates, scenario), steps=1).controller
        'PerimeterLayer'
    """

    def __init__(self, module: nn.Module, scenario: Horizon):
        self.module = module.eval()
        self.name = type(module).__name__

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        with torch.inference_mode():
            like = next(self.module.parameters(), torch.zeros(1))
            x = torch.from_numpy(observation.accumulation).to(like)
            parts = dict(zip(("perimeter", "splits"), commanded(self.module, x), strict=True))
            parts |= {
                name: getattr(self.module, name)(x)
                for name in ("prices", "metering")
                if hasattr(self.module, name)
            }
        controls: dict[str, Any] = {
            name: v.cpu().numpy() for name, v in parts.items() if v is not None
        }
        return Controls(**controls)
