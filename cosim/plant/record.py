"""What a run in SUMO leaves behind, beside its trajectory."""

from dataclasses import dataclass

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.guidance import Guide
from cosim.plant.meter import Meter
from cosim.plant.sampling import StreetMeans


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a closed-loop trajectory does not hold, per control interval k = 0 .. T-1.

    departures: (T, R, R) [veh]; arrivals: (T, R) [veh], by the region of the destination
    crossings: (T, R, R, R) [veh], [i, h, j] = from i to h, bound for j
    production: (T, R) [veh m/s], mean of samples; mean_accumulation: (T, R) [veh], of the same samples
    edge_vehicles: (T, E) [veh], mean of the same samples, by the city's edges
    gateway_green: (T, G) [s], green shown per gateway, its links' mean; NaN without a signal
    gateway_original_green: (T, G) [s], the same in the original programme
    gateway_flow: (T, G) [veh] over the boundary there
    gateway_queue, gateway_queue_max: (T, G) [veh] halting on the edge before it, mean and largest of samples; gateways
        that share this edge share its queue
    teleports: (T,); guided: (T, R, R, R) [veh], reroutes by route guidance
    """

    departures: np.ndarray
    arrivals: np.ndarray
    crossings: np.ndarray
    production: np.ndarray
    mean_accumulation: np.ndarray
    edge_vehicles: np.ndarray
    gateway_green: np.ndarray
    gateway_original_green: np.ndarray
    gateway_flow: np.ndarray
    gateway_queue: np.ndarray
    gateway_queue_max: np.ndarray
    teleports: np.ndarray
    guided: np.ndarray


class Recorder:
    """Adds up a record: `add` at the end of every control interval."""

    def __init__(self, meter: Meter, guide: Guide, actuation: Actuation):
        self._meter, self._guide, self._actuation = meter, guide, actuation
        self._rows: list[dict[str, np.ndarray]] = []
        self._before = self._totals()

    def add(self, streets: StreetMeans) -> None:
        """streets: means of the interval that has just ended; all else is what was added since the last call"""
        totals = self._totals()
        added = {key: total - self._before[key] for key, total in totals.items()}
        self._rows.append({
            **added, "gateway_green": self._actuation.as_shown(added["gateway_green"]),
            "gateway_original_green": self._actuation.original_green,
            "production": streets.production, "mean_accumulation": streets.accumulation,
            "edge_vehicles": streets.vehicles.astype(np.float16),  # to 0.1 % and as small as an integer
            "gateway_queue": streets.queue, "gateway_queue_max": streets.queue_max})
        self._before = totals

    def record(self) -> Record:
        """Of all control intervals so far."""
        return Record(**{key: np.stack([row[key] for row in self._rows]) for key in self._rows[0]})

    def _totals(self) -> dict[str, np.ndarray]:
        meter = self._meter
        return {
            "departures": meter.departures.copy(), "arrivals": meter.arrivals.copy(),
            "crossings": meter.crossings.copy(), "teleports": np.array(meter.teleports),
            "guided": self._guide.realised.copy(), "gateway_flow": meter.gateway_flow(),
            "gateway_green": self._actuation.green_time()}
