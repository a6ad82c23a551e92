"""Detectors that are kept, but whose counts look wrong."""

import numpy as np
import pandas as pd

FEWEST_NEIGHBOURS = 5
FACTOR = 1.6  # on the flow that others have at the same occupancy: half the flow is far beyond
SPREADS = 6.0  # the same in median absolute deviations of the logarithms


def miscounting(rows: pd.DataFrame, region: pd.Series) -> dict[str, dict[str, float]]:
    """Return region -> detector -> its flow over that of others [-].

    The flow of others is that at the same occupancy. Only detectors that differ clearly are there,
    such as loops that count half of the vehicles, or cover two lanes.

    rows: detid, flow and occ; region: by detid
    """
    sums = rows.groupby("detid")[["flow", "occ"]].sum()
    sums = sums[(sums["flow"] > 0) & (sums["occ"] > 0)]
    speed = np.log(sums["flow"] / sums["occ"])
    found = {}
    for name, own in speed.groupby(region.reindex(speed.index)):
        if len(own) < FEWEST_NEIGHBOURS:
            continue
        off = own - own.median()
        allowed = max(np.log(FACTOR), SPREADS * off.abs().median())
        odd = off[off.abs() > allowed]
        if len(odd):
            found[str(name)] = {str(detid): float(value) for detid, value in np.exp(odd).items()}
    return found
