"""The record of a run in SUMO per control interval, beside its states and controls."""

from collections.abc import Mapping

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.guidance import Guide
from cosim.plant.meter import Meter
from cosim.plant.sampling import StreetMeans
from nmfd.types import Quantity, Result

BOOKS = ("departures", "arrivals", "removals", "given_up", "crossings", "jumps", "redirected")  # of the meter
_PAIRS = ("interval", "region", "destination")
_TURNS = ("interval", "region", "next_region", "destination")
_GATEWAYS = ("interval", "gateway")

# Gateways that share the edge before them share its queue.
RECORD: Mapping[str, Quantity] = {
    "departures": Quantity(_PAIRS, "veh", "trips begun"),
    "arrivals": Quantity(("interval", "destination"), "veh", "trips completed, on the last edge of their route"),
    "removals": Quantity(_PAIRS, "veh", "vehicles taken out on their way"),
    "given_up": Quantity(_PAIRS, "veh", "trips that SUMO dropped before they began"),
    "crossings": Quantity(_TURNS, "veh", "vehicles that crossed a boundary"),
    "jumps": Quantity(_TURNS, "veh", "vehicles that came into another region where no gateway leads there"),
    "redirected": Quantity(
        ("interval", "region", "destination", "next_region"),
        "veh",
        "vehicles whose route was changed to end in another region, the next, instead of destination",
    ),
    "production": Quantity(("interval", "region"), "veh m/s", "travel production, mean of samples"),
    "mean_accumulation": Quantity(("interval", "region"), "veh", "vehicles inside, mean of the same samples"),
    "edge_vehicles": Quantity(("interval", "edge"), "veh", "vehicles on the edge to 0.1 %, mean of the same samples"),
    "gateway_green": Quantity(_GATEWAYS, "s", "green shown, mean of the gateway's links; NaN without a signal"),
    "gateway_original_green": Quantity(_GATEWAYS, "s", "green in the original programme, mean of the gateway's links"),
    "gateway_command": Quantity(_GATEWAYS, "1", "share of the boundary's capacity that was commanded"),
    "gateway_share": Quantity(_GATEWAYS, "1", "share of the green that the gateway was given, mean over the interval"),
    "gateway_flow": Quantity(_GATEWAYS, "veh", "vehicles that crossed the boundary"),
    "gateway_queue": Quantity(_GATEWAYS, "veh", "vehicles halting on the edge before it, mean of samples"),
    "gateway_queue_max": Quantity(_GATEWAYS, "veh", "vehicles halting on the edge before it, largest of samples"),
    "teleports": Quantity(("interval",), "1", "vehicles that SUMO took out of a jam"),
    "time_spent": Quantity(("interval",), "veh s", "by private vehicles on the road, or due and waiting to enter"),
    "other_time_spent": Quantity(("interval",), "veh s", "by public transport and classes that nothing commands"),
    "guided": Quantity(_TURNS, "veh", "reroutes by route guidance"),
}
# Over the whole run.
TOTALS: Mapping[str, Quantity] = {
    "co2": Quantity(("edge",), "kg", "CO2 of all vehicles on the edge and on the turns over junctions into it"),
    "queue_max": Quantity(("edge",), "veh", "vehicles halting on the edge, largest of samples"),
    "trip_time_by_origin": Quantity(
        ("region",), "s", "mean time of private trips that began here, as mean_trip_time_s; NaN without any"
    ),
}


def settled(result: Result) -> Result:
    """Return a result with a record whose last state, completed and removed trips follow from the closed books.

    SUMO may report the end of a trip late, or in the last step only (cosim.plant.meter).
    """

    def since_start(counts: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros_like(counts[:1]), counts]).cumsum(axis=0).astype(float)

    moved, redirected = (result.crossings + result.jumps).sum(axis=0), result.redirected.sum(axis=0)
    inside = (result.departures - result.removals).sum(axis=0) - np.diag(result.arrivals.sum(axis=0))
    inside = inside + moved.sum(axis=0) - moved.sum(axis=1) + redirected.sum(axis=1) - redirected.sum(axis=2)
    return result.assign(
        accumulation=np.concatenate([result.accumulation[:-1], inside[None].astype(float)]),
        completed=since_start(result.arrivals.sum(axis=1)),
        removed=since_start(result.removals + result.given_up),
    )


class Recorder:
    """Rows of a record: `add` one at the end of every control interval."""

    def __init__(self, meter: Meter, guide: Guide, actuation: Actuation):
        """Their counts so far belong to no interval."""
        self._meter, self._guide, self._actuation = meter, guide, actuation
        self._rows: list[dict[str, np.ndarray]] = []
        self._before = self._totals()

    def add(self, streets: StreetMeans) -> dict[str, np.ndarray]:
        """Add and return the row of the interval that has just ended. streets: its means"""
        totals = self._totals()
        added = {key: total - self._before[key] for key, total in totals.items()}
        row = {
            # Half the memory for counts, which fill the record of a long run.
            **{key: a.astype(np.int32) if a.dtype.kind == "i" else a for key, a in added.items()},
            "gateway_green": self._actuation.as_shown(added["gateway_green"]),
            "gateway_original_green": self._actuation.original_green,
            "gateway_command": self._actuation.room.command_of_gateways(),
            "gateway_share": self._actuation.room.gateway_shares(),
            "production": streets.production,
            "mean_accumulation": streets.accumulation,
            "edge_vehicles": streets.vehicles.astype(np.float16),  # to 0.1 %, as small as an integer
            "gateway_queue": streets.queue,
            "gateway_queue_max": streets.queue_max,
        }
        self._rows.append(row)
        self._before = totals
        return row

    def record(self) -> dict[str, np.ndarray]:
        """Return the arrays of RECORD over all control intervals so far."""
        return {key: np.stack([row[key] for row in self._rows]) for key in self._rows[0]}

    def close(self) -> None:
        """Add to the last interval what was booked when the books were closed."""
        for name, total in self._booked().items():
            self._rows[-1][name] = self._rows[-1][name] + total - self._before[name]

    def _booked(self) -> dict[str, np.ndarray]:
        other, private = self._meter.time_spent()
        spent = {"time_spent": private, "other_time_spent": other}
        return {name: getattr(self._meter, name).copy() for name in BOOKS} | spent

    def _totals(self) -> dict[str, np.ndarray]:
        return {
            **self._booked(),
            "teleports": np.array(self._meter.teleports),
            "guided": self._guide.realised.copy(),
            "gateway_flow": self._meter.gateway_flow(),
            "gateway_green": self._actuation.green_time(),
        }
