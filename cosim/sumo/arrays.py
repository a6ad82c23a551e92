"""Shapes of a city's arrays for annotations, beside those of nmfd.arrays.

E edges, G gateways, I internal edges of turns over junctions, M moves from edge to edge,
R regions, T control intervals, N trips. A letter is the same number within a call or an object;
tests/conftest.py checks this.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import Points as Points  # as there

PerEdge = Float[np.ndarray, " E"]
EdgeMask = Bool[np.ndarray, " E"]
EdgeNumbers = Int[np.ndarray, " E"]
PerInside = Float[np.ndarray, " I"]
PerMove = Float[np.ndarray, " M"]
MoveEnds = Int[np.ndarray, " M"]
PerGateway = Float[np.ndarray, " G"]
GatewayMask = Bool[np.ndarray, " G"]
PerTrip = Float[np.ndarray, " N"]
TripNumbers = Int[np.ndarray, " N"]
