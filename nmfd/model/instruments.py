"""Instruments of a city: what they cover, and what they measure."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Real

from nmfd.arrays import PerPair, PerRegion


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Coverage and errors of the instruments.

    detector_share: share of the lane length of each region covered by loop detectors (-, (R,))
    detector_error, detector_noise: standard deviations of the lasting and of the white relative
        error of the expanded accumulation (-, (R,))
    counted_share: [i, h]: share of the lanes over that boundary that are counted (-, (R, R))
    counted_gateways: [i, h]: number of gateways that are counted ((R, R))
    probe_share: share of all vehicles (-)
    """

    detector_share: PerRegion
    detector_error: PerRegion
    detector_noise: PerRegion
    counted_share: PerPair
    counted_gateways: Real[np.ndarray, "R R"]
    probe_share: float


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Measurements of one control interval; NaN where there is none.

    accumulation: mean over the interval, expanded from the detectors to the region (veh, (R,))
    crossings: [i, h] counted during the interval, expanded to all gateways (veh, (R, R))
    probes: [i, j] in region i bound for j at the end of the interval, not expanded (veh, (R, R))
    probe_departures: [i, j] departed during the interval, not expanded (veh, (R, R))
    """

    accumulation: PerRegion
    crossings: PerPair
    probes: PerPair
    probe_departures: PerPair
