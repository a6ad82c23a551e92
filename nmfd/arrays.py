"""The shapes of NumPy arrays, for annotations: what is in them, in which unit, is said where they are used.

R regions, T control intervals, S = T + 1 states. One letter is one number within a call, or within one object. Checked
while testing, where tests/conftest.py asks for it (jaxtyping and beartype); otherwise these say what is meant, and cost
nothing. Those of torch are in nmfd.tensors.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

PerRegion = Float[np.ndarray, " R"]
PerPair = Float[np.ndarray, "R R"]  # [i, j] = in i bound for j, or [i, h] = from i to h
PerTurn = Float[np.ndarray, "R R R"]  # [i, h, j] = in i, bound for j, by way of h
PairsOverTime = Float[np.ndarray, "T R R"]
TurnsOverTime = Float[np.ndarray, "T R R R"]
RegionsOverTime = Float[np.ndarray, "T R"]
StatesOverTime = Float[np.ndarray, "S R R"]
Positions = Float[np.ndarray, "R 2"]
Adjacency = Bool[np.ndarray, "R R"]
TurnMask = Bool[np.ndarray, "R R R"]
Hops = Int[np.ndarray, "R R"]
Intervals = Float[np.ndarray, " T"]
Flags = Int[np.ndarray, " T"]
Cumulative = Float[np.ndarray, " S"]
Points = Float[np.ndarray, "_ 2"]  # of a line on the map [m], or samples of accumulation and outflow
