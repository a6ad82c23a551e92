"""What was seen on the streets of made-up cities in a control interval."""

from collections.abc import Sequence

import numpy as np

from cosim.plant.sampling import StreetMeans

# Of a session: nobody stands, or is near the end of a lane.
FAR_FROM_THE_END = {
    "standing_time": lambda vehicle: 0.0,
    "place": lambda vehicle: ("lane", 0.0),
    "lane": lambda lane: (1e9, frozenset()),
}
MANY = 1e5  # veh: so many that nothing else counts


def seen(
    speed: Sequence[float],
    vehicles: Sequence[float] | None = None,
    *,
    duration: float = 90.0,
    crossing: Sequence[float] = (),
    crossed: Sequence[float] = (),
) -> StreetMeans:
    """Speeds [m/s] by edge, NaN where nobody was; vehicles [veh]: MANY if not given."""
    mean = np.array(speed, dtype=float)
    on = np.where(np.isnan(mean), 0.0, MANY) if vehicles is None else np.array(vehicles, dtype=float)
    return StreetMeans(
        duration=duration,
        vehicles=on,
        speed=mean,
        accumulation=np.zeros(1),
        production=np.zeros(1),
        queue=np.zeros(0),
        queue_max=np.zeros(0),
        crossing=np.array(crossing, dtype=float),
        crossed=np.array(crossed, dtype=float),
    )
