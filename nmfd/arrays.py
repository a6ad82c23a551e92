"""Shapes of NumPy arrays for annotations.

Content and unit are documented where they are used. R regions, T control intervals, S = T + 1
states. One letter is one number within a call, or within one object. The tests check shapes
(tests/conftest.py, jaxtyping and beartype); elsewhere they cost nothing. The shapes of torch's
tensors are in nmfd.tensors.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

PerRegion = Float[np.ndarray, " R"]
PerPair = Float[np.ndarray, "R R"]  # [i, j] = in i bound for j, or [i, h] = from i to h
PerTurn = Float[np.ndarray, "R R R"]  # [i, h, j] = in i, bound for j, by way of h
PairsOverTime = Float[np.ndarray, "T R R"]
TurnsOverTime = Float[np.ndarray, "T R R R"]
StatesOverTime = Float[np.ndarray, "S R R"]
Positions = Float[np.ndarray, "R 2"]
Adjacency = Bool[np.ndarray, "R R"]
TurnMask = Bool[np.ndarray, "R R R"]
Hops = Int[np.ndarray, "R R"]
Intervals = Float[np.ndarray, " T"]
# Places on a map [m], or pairs of accumulation and outflow.
Points = Float[np.ndarray, "_ 2"]
Arrays = dict[str, np.ndarray]  # by name
