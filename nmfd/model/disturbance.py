"""What the regional model does not foresee, as a disturbance: seen in what it got wrong, and faded into the future.

The same accumulation can flow or stand, and the model knows the mean of both. Where a region does worse than that, it
does so for a while. The innovation e_k of a control interval is what came of it less what the model foresaw, per
second; of the last LOOK intervals

    d_k = gain sum_a memory^a e_k-a / sum_a memory^a                      a = 0, 1, ..., LOOK - 1
    d_k+n|k = d_k f_i^n,    f_i = s(fade_critical + fade_slope (x_i / n_cr,i - 1))       s(z) = 1 / (1 + e^-z)

is added to the demand n intervals ahead: in a full region, which may have locked, what is wrong stays, in an empty one
it passes. Where d is negative it takes no more than is there. Predictions that are corrected so are right on the
average after a step that the model does not know ("offset-free": Pannocchia and Rawlings, AIChE Journal 49, 2003;
Maeder, Borrelli and Morari, Automatica 45, 2009). The four numbers are identified (`identification.fit_disturbance`).

Shapes: `...` is any batch, x and d (..., R, R), [i, j] in region i bound for j.
"""

from typing import NamedTuple

import torch

from nmfd.tensors import PerPair, PerRegion

LOOK = 3  # control intervals


class Disturbance(NamedTuple):
    """How much of the last innovations is believed [-], how long one is remembered, and how fast it fades."""

    gain: float
    memory: float
    fade_critical: float
    fade_slope: float


def estimated(law: Disturbance, innovations: torch.Tensor) -> PerPair:
    """d (..., R, R) [veh/s] of the innovations (..., n, R, R) [veh/s] of the last n <= LOOK intervals, oldest first."""
    count = innovations.shape[-3]
    weight = torch.as_tensor(law.memory, dtype=innovations.dtype) ** torch.arange(count - 1, -1, -1)
    return law.gain * (weight[:, None, None] * innovations).sum(-3) / weight.sum()


def ahead(
    law: Disturbance, disturbance: PerPair, x: PerPair, critical: PerRegion, intervals: int, step: float
) -> torch.Tensor:
    """(..., intervals, R, R) [veh/s] to be added to the demand from x (..., R, R) [veh] on.

    disturbance: (..., R, R) [veh/s]; critical: (R,) [veh]; step: of an interval [s]
    """
    fade = torch.sigmoid(law.fade_critical + law.fade_slope * (x.sum(-1) / critical - 1.0))
    shares = fade[..., None, :, None] ** torch.arange(intervals)[:, None, None]
    least = -x / (step * shares.sum(-3))
    return shares * torch.maximum(disturbance, least).unsqueeze(-3)
