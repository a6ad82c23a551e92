"""Differentiable predictive control (DPC): neural policies.

A policy maps states to admissible controls. As in Tumu et al.: an MLP backbone with one decoder for
the perimeter (scaled sigmoid) and one for the split ratios (masked softmax). Every output satisfies
the constraints by construction.

With `prices` the second decoder gives prices, from which the regional model derives the split
ratios (nmfd.model.answer). With `metering` a third one limits departures:

    c_i = MOST_PRICE s(y_i + PRICE_LOGIT)
    r_i = n_cr,i / FILL_TIME_S s(y_i + METERING_SLOPE (METERING_FROM - z_i))

y is the output of the decoder, z_i = n_i / n_cr,i, s the logistic function. Initially prices are
small, and trips wait only where a region is far beyond its critical accumulation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nmfd.model.answer import Answer
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Horizon
from nmfd.tensors import PerPair, PerRegion, PerTurn
from nmfd.types import Controls, Observation

DTYPE = torch.float32  # of all policies, even if torch has another default
FEATURES = 6  # of a boundary, inputs of a local policy
FILL_TIME_S = 90.0  # a signal cycle
MOST_PRICE = 10.0
PRICE_LOGIT = -3.0
METERING_SLOPE = 6.0
METERING_FROM = 1.25
Memory = Float[torch.Tensor, "*#B N R"]  # N numbers per region
PerBoundary = Float[torch.Tensor, "*#B R D"]  # of the D regions that outputs are for
PerBoundaryTurn = Float[torch.Tensor, "*#B R D R"]


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Shape of a policy.

    width: units of a hidden layer
    layers: hidden layers of the backbone
    guidance: the policy guides routes
    sparse: its outputs are for adjacent regions only, R^2 instead of R^3 numbers
    local: one small network with FEATURES inputs serves every boundary, and fits every city; only
        perimeter control
    compact: protected regions of a compact policy (nmfd.controllers.dpc.compact); () for a network
    per_region: training finds for each region the accumulation that counts as full; compact only
    metering: the policy limits departures
    prices: it chooses prices of regions instead of split ratios; not for a compact policy
    soft_exponential: activation SoftExponential instead of GELU
    decoder_layers: hidden layers of each decoder
    """

    width: int = 128
    layers: int = 2
    guidance: bool = False
    sparse: bool = False
    local: bool = False
    compact: tuple[int, ...] = ()
    per_region: bool = False
    metering: bool = False
    prices: bool = False
    soft_exponential: bool = False
    decoder_layers: int = 0

    @property
    def only_adjacent(self) -> bool:
        """True if outputs are for adjacent regions only."""
        return self.sparse or self.local


class PerimeterLayer(nn.Module):
    """Box of the perimeter control.

    It maps any numbers (..., R, R) to u in [u_min, u_max], 0 where h is not adjacent to i.
    """

    def __init__(self, network: RegionalModel, allowed: torch.Tensor | None = None):
        """Make the box.

        allowed: boundaries that the inputs (..., R, D) stand for (R, D); None: the adjacency
        """
        super().__init__()
        self.low = network.u_min
        self.high = network.u_max
        if allowed is None:
            allowed = network.adjacency
        self.register_buffer("allowed", torch.as_tensor(allowed, dtype=DTYPE), persistent=False)

    def forward(self, numbers: PerBoundary) -> PerBoundary:
        return self.opened(torch.sigmoid(numbers))

    def opened(self, share: PerBoundary) -> PerBoundary:
        """Return u that is u_min for a share of 0 and u_max for 1 (-)."""
        return (self.low + (self.high - self.low) * share) * self.allowed


class SplitsLayer(nn.Module):
    """Simplex of the split ratios.

    It maps any numbers (..., R, R, R) to theta >= 0 with sum 1 over the allowed turns.
    """

    def __init__(self, network: RegionalModel, mask: torch.Tensor | None = None):
        """Make the simplex.

        mask: turns that the inputs (..., R, D, R) stand for (R, D, R); None: all allowed ones
        """
        super().__init__()
        if mask is None:
            mask = network.split_mask
        mask = torch.as_tensor(mask)
        # A softmax over nothing but -inf is NaN: rows without a turn (j = i) get finite logits and
        # become zero.
        blocked = ~mask & mask.any(dim=1, keepdim=True)
        bias = torch.zeros(mask.shape, dtype=DTYPE).masked_fill(blocked, -torch.inf)
        self.register_buffer("mask", mask.to(DTYPE), persistent=False)
        self.register_buffer("bias", bias, persistent=False)

    def forward(self, numbers: PerBoundaryTurn) -> PerBoundaryTurn:
        return torch.softmax(numbers + self.bias, dim=-2) * self.mask


class SoftExponential(nn.Module):
    """Activation with one trained number a, initially 0.

    After Godfrey and Gashler (2015):

        -log(1 - a (x + a)) / a     for a < 0
        x                           for a = 0
        (exp(a x) - 1) / a + a      for a > 0

    Near a = 0 it is a series, so that a has a gradient. NeuroMANCER's has none at its default
    a = 0, and a network of it stays linear.
    """

    def __init__(self) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.tensor(0.0, dtype=DTYPE))

    def forward(self, x: Float[torch.Tensor, "*B"]) -> Float[torch.Tensor, "*B"]:
        near = self.a.abs() < 1e-3
        a = torch.where(near, torch.ones_like(self.a), self.a)
        falling = -torch.log((1.0 - a * (x + a)).clamp(min=1e-6)) / a
        rising = torch.expm1((a * x).clamp(max=30.0)) / a + a
        series = x + self.a * (1.0 + 0.5 * x**2)
        return torch.where(near, series, torch.where(a < 0, falling, rising))


class Policy(nn.Module):
    """Policy that maps states to perimeter, and splits or None.

    The states are (veh, (..., R, R)), perimeter (-, (..., R, R)) and splits (-, (..., R, R, R)). D
    is the number of regions that outputs are for: R, or with `only_adjacent` the largest number of
    adjacent ones.

    onward: region of every output, (R, D)
    scale: normalisation of the state, the critical accumulation of each region (veh, (R, 1))
    """

    def __init__(self, network: RegionalModel, architecture: Architecture):
        super().__init__()
        regions = network.regions
        self.architecture = architecture
        self.regions = regions
        scale = torch.tensor([[mfd.critical] for mfd in network.mfds], dtype=DTYPE)
        self.register_buffer("scale", scale, persistent=not architecture.local)
        if architecture.only_adjacent:
            rows = [np.flatnonzero(row) for row in network.adjacency]
            most = max(map(len, rows))  # shorter rows repeat their last region
            onward = np.stack([np.pad(row, (0, most - len(row)), "edge") for row in rows])
        else:
            onward = np.tile(np.arange(regions), (regions, 1))
        here = np.arange(regions)[:, None]
        repeated = np.diff(onward, prepend=-1) == 0
        allowed = torch.tensor(network.adjacency[here, onward] & ~repeated)
        self.box = PerimeterLayer(network, allowed)
        self.register_buffer("onward", torch.tensor(onward), persistent=False)
        self._build(network)
        if architecture.prices or (architecture.compact and architecture.guidance):
            self.answer = Answer(network)

    def _build(self, network: RegionalModel) -> None:
        """Add all that has weights."""
        architecture = self.architecture
        boundaries = self.onward.numel()
        inputs = self.regions**2
        openings = boundaries
        if architecture.local:
            inputs = FEATURES
            openings = 1
        layers = _hidden_layers(architecture, inputs, architecture.layers)
        self.backbone = nn.Sequential(*layers)
        self.perimeter_decoder = _decoder(architecture, openings)
        if architecture.prices:
            self.prices_decoder = _decoder(architecture, self.regions)
        elif architecture.guidance:
            self.splits_decoder = _decoder(architecture, boundaries * self.regions)
            here = np.arange(self.regions)[:, None]
            turns = torch.tensor(network.split_mask[here, self.onward.numpy()])
            self.simplex = SplitsLayer(network, turns & self.box.allowed.bool().unsqueeze(-1))
        if architecture.metering:
            self.metering_decoder = _decoder(architecture, self.regions)

    @property
    def decoders(self) -> list[nn.Module]:
        """Decoders, which training takes in turn."""
        return [part for name, part in self.named_children() if name.endswith("_decoder")]

    def forward(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, PerTurn | None]:
        """Return perimeter and splits in the states x.

        memory: result of `remember` for x; None in rollouts
        """
        perimeter, splits = self.outputs(x, memory)
        if self.architecture.only_adjacent:
            onward = self.onward
            empty = perimeter.new_zeros(*x.shape[:-2], self.regions, self.regions)
            perimeter = empty.scatter_add(-1, onward.expand_as(perimeter), perimeter)
            if splits is not None:
                turns = empty.unsqueeze(-1).repeat_interleave(self.regions, -1)
                splits = turns.scatter_add(-2, onward.unsqueeze(-1).expand_as(splits), splits)
        prices = self.prices(x)
        if prices is not None:
            splits = self.answer(x.to(self.scale.dtype), prices)
        return perimeter, splits

    def outputs(
        self, x: PerPair, memory: Memory | None = None
    ) -> tuple[PerBoundary, PerBoundaryTurn | None]:
        """Return perimeter and splits for the regions `onward`."""
        hidden = self._hidden(x)
        shape = self.onward.shape
        perimeter = self.box(self.perimeter_decoder(hidden).reshape(*x.shape[:-2], *shape))
        if not self.architecture.guidance or self.architecture.prices:
            return perimeter, None
        numbers = self.splits_decoder(hidden).unflatten(-1, (*shape, self.regions))
        return perimeter, self.simplex(numbers)

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """Return the memory after the states x, None for a policy without one.

        memory: the one before x, None at the beginning
        """
        return None

    def prices(self, x: PerPair) -> PerRegion | None:
        """Return the price of each region (-, (..., R)), or None."""
        if not self.architecture.prices:
            return None
        return MOST_PRICE * torch.sigmoid(self.prices_decoder(self._hidden(x)) + PRICE_LOGIT)

    def metering(self, x: PerPair) -> PerRegion | None:
        """Return the largest departure rates (veh/s, (..., R)), or None."""
        if not self.architecture.metering:
            return None
        room = METERING_SLOPE * (METERING_FROM - self._full(x))
        share = torch.sigmoid(self.metering_decoder(self._hidden(x)) + room)
        return self.scale.squeeze(-1) / FILL_TIME_S * share

    def _hidden(self, x: PerPair) -> Float[torch.Tensor, "... H"]:
        """Return the output of the backbone."""
        if self.architecture.local:
            # Features of every boundary, of region i and then of region h: accumulation, mean one
            # of the neighbours, and trips that end there, relative to the critical accumulation.
            critical = self.scale.squeeze(-1)
            full = x.sum(-1).to(critical.dtype) / critical
            ending = torch.diagonal(x, dim1=-2, dim2=-1).to(critical.dtype) / critical
            allowed = self.box.allowed
            beside = (full[..., self.onward] * allowed).sum(-1) / allowed.sum(-1).clamp(min=1.0)
            regions = torch.stack([full, beside, ending], dim=-1)
            here = regions.unsqueeze(-2).expand(*regions.shape[:-1], self.onward.shape[1], -1)
            return self.backbone(torch.cat([here, regions[..., self.onward, :]], dim=-1))
        return self.backbone((x / self.scale).flatten(-2))

    def _full(self, x: PerPair) -> PerRegion:
        """Return z_i, the share of what counts as full (-, (..., R))."""
        return x.to(self.scale.dtype).sum(-1) / self._counts_as_full()

    def _counts_as_full(self) -> PerRegion:
        """Return the accumulations that count as full (veh, (R,))."""
        return self.scale.squeeze(-1)


def _hidden_layers(architecture: Architecture, inputs: int, count: int) -> list[nn.Module]:
    """Return `count` hidden layers with their activations."""
    activation = SoftExponential if architecture.soft_exponential else nn.GELU
    layers: list[nn.Module] = []
    for _ in range(count):
        layers += [nn.Linear(inputs, architecture.width, dtype=DTYPE), activation()]
        inputs = architecture.width
    return layers


def _decoder(architecture: Architecture, outputs: int) -> nn.Module:
    """Return a linear layer behind the hidden layers of a decoder."""
    layers = _hidden_layers(architecture, architecture.width, architecture.decoder_layers)
    last = nn.Linear(architecture.width, outputs, dtype=DTYPE)
    if not layers:
        return last
    return nn.Sequential(*layers, last)


class DpcController:
    """Trained policy as a controller, "dpc-pc" or "dpc-pcrg"."""

    def __init__(self, policy: Policy):
        self.policy = policy.eval()
        self.name = "dpc-pcrg" if policy.architecture.guidance else "dpc-pc"
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._memory: Memory | None = None

    def act(self, observation: Observation) -> Controls:
        policy = self.policy
        accumulation = observation.accumulation
        if not policy.architecture.local:  # a local policy needs the sums only, and no copy
            accumulation = accumulation.astype(np.float32)
        with torch.inference_mode():
            x = torch.from_numpy(accumulation)
            self._memory = policy.remember(x, self._memory)
            perimeter, splits = policy(x, self._memory)
            prices = policy.prices(x)
            metering = policy.metering(x)
        shares = _array(splits)
        if shares is not None:
            shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-9)  # float32 misses 1
        return Controls(
            perimeter=_array(perimeter),
            splits=shares,
            prices=_array(prices),
            metering=_array(metering),
        )


def _array(values: torch.Tensor | None) -> Any:
    """Return a tensor as an array of float64; None stays."""
    if values is None:
        return None
    return values.numpy().astype(float)


def commanded(policy: nn.Module, x: PerPair) -> tuple[PerPair, PerTurn | None]:
    """Return perimeter, and splits or None, of any module in the states x."""
    values = policy(x)
    if isinstance(values, torch.Tensor):
        return values, None
    return tuple(values)


class ModuleController:
    """Module of your own as a controller.

    It maps states (veh, (..., R, R)) to the perimeter or to (perimeter, splits). Methods `prices`
    and `metering` of the states, if it has them, return those of nmfd.Controls. All are checked.

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
        controls: dict[str, Any] = {}
        with torch.inference_mode():
            like = next(self.module.parameters(), torch.zeros(1))
            x = torch.from_numpy(observation.accumulation).to(like)
            controls["perimeter"], controls["splits"] = commanded(self.module, x)
            for name in ("prices", "metering"):
                if hasattr(self.module, name):
                    controls[name] = getattr(self.module, name)(x)
        for name, values in controls.items():
            if values is not None:
                controls[name] = values.cpu().numpy()
        return Controls(**controls)
