"""The shapes of torch's tensors, for annotations, as nmfd.arrays has them. B: any batch, or none, that broadcasts."""

import torch
from jaxtyping import Float

PerRollout = Float[torch.Tensor, "*#B"]
PerRegion = Float[torch.Tensor, "*#B R"]
PerPair = Float[torch.Tensor, "*#B R R"]
PerTurn = Float[torch.Tensor, "*#B R R R"]
