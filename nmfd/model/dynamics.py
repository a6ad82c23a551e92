"""The regional model (NMFD) in torch, batched and differentiable.

This is the one definition of its equations. They follow Tumu, Shaw Cortez, Drgona, Vrabie and
Glavaski, "Differentiable Predictive Control for Large-Scale Urban Road Networks", and the
multi-region models with perimeter control of Geroliminis, Haddad and Ramezani (2013). Regions i, j,
h; x_i = sum_j x_ij; N_i the regions adjacent to i:

    q_i    = g_i(x_i) / x_i                            defined at x = 0 (nmfd.model.mfd)
    m_ii   = q_i x_ii                                  trips that end in i
    m_ihj  = theta_ihj q_i x_ij                        j != i, h in N_i
    dx_ii/dt = d_ii - m_ii + sum_{h in N_i} u_hi m_hii
    dx_ij/dt = d_ij - sum_{h in N_i} u_ih m_ihj + sum_{h in N_i, h != j} u_hi m_hij        j != i

Twins: `acyclic` (no vehicle turns back), and in nmfd.controllers.mpc `ipopt` (in CasADi) and
`edge_model` (as edges, with adjoint gradients).

Shapes (`...` is any batch):

    x          (..., R, R) [veh], [i, j] in region i bound for j
    demand     (..., R, R) [veh/s]
    perimeter  (..., R, R) [-], [i, h]
    splits     (..., R, R, R) [-], [i, h, j]
"""

from dataclasses import dataclass
from typing import Any

import torch

from nmfd.model.integration import counted, integrated
from nmfd.model.mfd import Mfd, stacked
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share
from nmfd.tensors import PerPair, PerRegion, PerRollout, PerTurn


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Parameters of a network as tensors.

    mfd: of all regions
    adjacency, off_diagonal: 0 or 1 ((R, R))
    exit_rates: (-, (R, R)), or None
    detours: (-, (R, R, R)), or None
    capacity: under u = 1 (veh/s, (R, R)), or None
    storage: (veh, (R,)), or None
    """

    mfd: Mfd
    adjacency: PerPair
    off_diagonal: PerPair
    exit_rates: PerPair | None = None
    detours: PerTurn | None = None
    capacity: PerPair | None = None
    storage: PerRegion | None = None


def parameters(
    network: RegionalModel,
    *,
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> Parameters:
    """Return the parameters of `network` as tensors."""

    def tensor(values: Any) -> Any:
        if values is None:
            return None
        return torch.tensor(values, dtype=dtype, device=device)

    return Parameters(
        mfd=stacked(network.mfds, tensor),
        adjacency=tensor(network.adjacency),
        off_diagonal=1.0 - torch.eye(network.regions, dtype=dtype, device=device),
        exit_rates=tensor(network.exit_rates),
        detours=tensor(network.detours),
        capacity=tensor(network.open_capacity),
        storage=tensor(network.storage),
    )


def rate(p: Parameters, accumulation: PerRegion) -> PerRegion:
    """Return q_i = g_i(min(x_i, jam_i)) / x_i [1/s].

    accumulation: x_i (veh, (..., R))
    """
    return p.mfd.rate(accumulation, torch)


def desired_outflow(p: Parameters, x: PerPair, splits: PerTurn) -> PerPair:
    """Return the outflow without boundaries (veh/s, (..., R, R))."""
    leaving = rate(p, x.sum(-1)).unsqueeze(-1) * x
    if p.exit_rates is not None:
        leaving = leaving * p.exit_rates
    if p.detours is not None:
        leaving = leaving / (1.0 + (splits * p.detours).sum(-2))
    return leaving


def flows(
    p: Parameters, x: PerPair, perimeter: PerPair, splits: PerTurn
) -> tuple[PerRegion, PerTurn]:
    """Return trip completions (..., R) and transfer flows (..., R, R, R).

    As published, they are m_ii and u_ih m_ihj [veh/s]. Extensions: exit rates k_ij multiply m_ihj
    and m_ii; detours r_ihj divide m_ihj by 1 + sum_h theta_ihj r_ihj, the mean time in i; with
    capacities, `passing` replaces u_ih.
    """
    accumulation = x.sum(-1)
    leaving = desired_outflow(p, x, splits)
    completions = torch.diagonal(leaving, dim1=-2, dim2=-1)
    onward = (leaving * p.off_diagonal).unsqueeze(-2)
    if p.capacity is None:
        share = (perimeter * p.adjacency).unsqueeze(-1)
        return completions, share * splits * onward
    wish = splits * onward
    share = passing(p, wish.sum(-1), perimeter, accumulation).unsqueeze(-1)
    return completions, share * wish


def passing(p: Parameters, wish: PerPair, perimeter: PerPair, accumulation: PerRegion) -> PerPair:
    """Return the share (..., R, R) [-] of the desired flow that passes.

    The limit of a boundary is u_ih times capacity times the room in h, 1 - x_h / storage_h (as in
    Geroliminis, Haddad and Ramezani, 2013).

    wish: desired flow (veh/s, (..., R, R))
    accumulation: (veh, (..., R))
    """
    room = (1.0 - accumulation / p.storage).clamp(min=LEAST_ROOM)
    return passing_share(wish, perimeter * p.capacity * room.unsqueeze(-2))


def admitted(
    backlog: PerPair, demand: PerPair, metering: PerRegion | None, step: float
) -> tuple[PerPair, PerPair]:
    """Return admitted demand (..., R, R) [veh/s] and the new backlog [veh].

    backlog: vehicles that wait outside (veh, (..., R, R))
    metering: largest departure rate of each region, shared in proportion (veh/s, (..., R)); None:
        no limit
    step: time in which they are admitted (s)
    """
    if metering is None:
        return demand + backlog / step, torch.zeros_like(backlog)
    due = backlog / step + demand
    share = (metering / due.sum(-1).clamp(min=1e-9)).clamp(max=1.0).unsqueeze(-1)
    return share * due, (1.0 - share) * due * step


def derivative(
    p: Parameters, x: PerPair, demand: PerPair, perimeter: PerPair, splits: PerTurn
) -> tuple[PerPair, PerRegion]:
    """Return dx_ij/dt (..., R, R) and trip completions (..., R) [veh/s]."""
    completions, transfers = flows(p, x, perimeter, splits)
    change = demand - torch.diag_embed(completions) - transfers.sum(-2) + transfers.sum(-3)
    return change, completions


def advance(
    p: Parameters,
    x: PerPair,
    demand: PerPair,
    perimeter: PerPair,
    splits: PerTurn,
    step: float,
    **scheme: Any,
) -> PerPair:
    """Return x after one control interval under constant inputs.

    step: length of the interval (s)
    scheme: integrator and substeps of `integrated`
    """
    return integrated(lambda x: derivative(p, x, demand, perimeter, splits)[0], x, step, **scheme)


def advance_counted(
    p: Parameters,
    x: PerPair,
    demand: PerPair,
    perimeter: PerPair,
    splits: PerTurn,
    step: float,
    **scheme: Any,
) -> tuple[PerPair, PerRollout]:
    """Return `advance` and the trips (...) [veh] completed meanwhile."""

    def slope(x: PerPair) -> tuple[PerPair, PerRollout]:
        change, completions = derivative(p, x, demand, perimeter, splits)
        return change, completions.sum(-1)

    return counted(slope, x, step, **scheme)
