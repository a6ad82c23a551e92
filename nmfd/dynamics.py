"""The regional model in torch, batched and differentiable (design.md, section 2). CasADi twin: dynamics_casadi.

Shapes: `...` is any batch. x (..., R, R) [veh], [i, j] in region i bound for j; demand (..., R, R) [veh/s];
perimeter (..., R, R) [-], [i, h]; splits (..., R, R, R) [-], [i, h, j].
"""

from dataclasses import dataclass

import torch

from nmfd.network import Network


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """The network as tensors. a, b, c, jam: (R,) of the MFDs; adjacency, off_diagonal: (R, R), 0 or 1."""

    a: torch.Tensor
    b: torch.Tensor
    c: torch.Tensor
    jam: torch.Tensor
    adjacency: torch.Tensor
    off_diagonal: torch.Tensor


def parameters(network: Network, *, dtype=torch.float64, device="cpu") -> Parameters:
    def row(name):
        return torch.tensor([getattr(m, name) for m in network.mfds], dtype=dtype, device=device)

    return Parameters(
        a=row("a"), b=row("b"), c=row("c"), jam=row("jam"),
        adjacency=torch.tensor(network.adjacency, dtype=dtype, device=device),
        off_diagonal=1.0 - torch.eye(network.regions, dtype=dtype, device=device))


def rate(p: Parameters, accumulation: torch.Tensor) -> torch.Tensor:
    """q_i = g_i(min(x_i, jam_i)) / x_i [1/s], of accumulation (..., R) [veh]; no division by zero at x = 0."""
    body = torch.minimum(accumulation, p.jam)
    return ((p.a * body + p.b) * body + p.c) * p.jam / torch.maximum(accumulation, p.jam)


def flows(p: Parameters, x, perimeter, splits) -> tuple[torch.Tensor, torch.Tensor]:
    """Trip completions m_ii (..., R) and transfer flows u_ih m_ihj (..., R, R, R) [veh/s]."""
    leaving = rate(p, x.sum(-1)).unsqueeze(-1) * x
    completions = torch.diagonal(leaving, dim1=-2, dim2=-1)
    wishing = (leaving * p.off_diagonal).unsqueeze(-2)
    transfers = (perimeter * p.adjacency).unsqueeze(-1) * splits * wishing
    return completions, transfers


def derivative(p: Parameters, x, demand, perimeter, splits) -> torch.Tensor:
    """dx_ij/dt (..., R, R) [veh/s]."""
    completions, transfers = flows(p, x, perimeter, splits)
    return demand - torch.diag_embed(completions) - transfers.sum(-2) + transfers.sum(-3)


def euler(p: Parameters, x, demand, perimeter, splits, step: float) -> torch.Tensor:
    """x after `step` [s] by forward Euler; keeps x >= 0 where step * q <= 1 and demand >= 0."""
    return x + step * derivative(p, x, demand, perimeter, splits)


def rk4(p: Parameters, x, demand, perimeter, splits, step: float) -> torch.Tensor:
    """x after `step` [s] by the classical fourth-order Runge-Kutta scheme."""
    k1 = derivative(p, x, demand, perimeter, splits)
    k2 = derivative(p, x + 0.5 * step * k1, demand, perimeter, splits)
    k3 = derivative(p, x + 0.5 * step * k2, demand, perimeter, splits)
    k4 = derivative(p, x + step * k3, demand, perimeter, splits)
    return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


INTEGRATORS = {"euler": euler, "rk4": rk4}


def advance(p: Parameters, x, demand, perimeter, splits, step: float, *, integrator="euler", substeps=1):
    """x after one control interval of `step` [s], in `substeps` equal steps under constant controls and demand."""
    for _ in range(substeps):
        x = INTEGRATORS[integrator](p, x, demand, perimeter, splits, step / substeps)
    return x
