"""What a run in SUMO leaves behind, beside its trajectory."""

from dataclasses import dataclass

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.guidance import Guide
from cosim.plant.meter import Meter
from cosim.plant.sampling import StreetMeans
from cosim.sumo.arrays import EdgesOverTime, GatewaysOverTime, PairCounts, RegionCounts, Series, TurnCounts
from nmfd.quantities import quantity
from nmfd.types import Result

BOOKS = ("departures", "arrivals", "removals", "given_up", "crossings", "jumps", "redirected")  # of the meter


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a closed-loop trajectory does not hold, per control interval k = 0 .. T-1.

    Gateways that share the edge before them share its queue.
    """

    departures: PairCounts = quantity("interval", "region", "destination", unit="veh", text="trips begun")
    arrivals: RegionCounts = quantity(
        "interval", "destination", unit="veh", text="trips completed: on the last edge of their route"
    )
    removals: PairCounts = quantity(
        "interval", "region", "destination", unit="veh", text="vehicles taken out on their way, whoever did it"
    )
    given_up: PairCounts = quantity(
        "interval", "region", "destination", unit="veh", text="trips that SUMO dropped before they began"
    )
    crossings: TurnCounts = quantity(
        "interval", "region", "next_region", "destination", unit="veh", text="vehicles that crossed a boundary"
    )
    jumps: TurnCounts = quantity(
        "interval",
        "region",
        "next_region",
        "destination",
        unit="veh",
        text="vehicles that came into another region where no gateway leads there",
    )
    redirected: TurnCounts = quantity(
        "interval",
        "region",
        "destination",
        "next_region",
        unit="veh",
        text="vehicles there whose route was changed to end in another region, the next, instead of destination",
    )
    production: RegionCounts = quantity("interval", "region", unit="veh m/s", text="travel production, mean of samples")
    mean_accumulation: RegionCounts = quantity(
        "interval", "region", unit="veh", text="vehicles inside, mean of the same samples"
    )
    edge_vehicles: EdgesOverTime = quantity(
        "interval", "edge", unit="veh", text="vehicles on the edge to 0.1 %, mean of the same samples"
    )
    gateway_green: GatewaysOverTime = quantity(
        "interval", "gateway", unit="s", text="green shown, mean of the gateway's links; NaN without a signal"
    )
    gateway_original_green: GatewaysOverTime = quantity(
        "interval", "gateway", unit="s", text="green in the original programme, mean of the gateway's links"
    )
    gateway_flow: GatewaysOverTime = quantity(
        "interval", "gateway", unit="veh", text="vehicles that crossed the boundary"
    )
    gateway_queue: GatewaysOverTime = quantity(
        "interval", "gateway", unit="veh", text="vehicles halting on the edge before it, mean of samples"
    )
    gateway_queue_max: GatewaysOverTime = quantity(
        "interval", "gateway", unit="veh", text="vehicles halting on the edge before it, largest of samples"
    )
    teleports: Series = quantity("interval", unit="1", text="vehicles that SUMO took out of a jam")
    guided: TurnCounts = quantity(
        "interval", "region", "next_region", "destination", unit="veh", text="reroutes by route guidance"
    )


def settled(trajectory: Result, record: Record) -> Result:
    """What became of vehicles as the closed books have it, for where SUMO told late (cosim.plant.meter). Who was taken
    out in the last step, too, is no longer there at the end."""

    def since_start(counts: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros_like(counts[:1]), counts]).cumsum(axis=0).astype(float)

    moved, redirected = (record.crossings + record.jumps).sum(axis=0), record.redirected.sum(axis=0)
    inside = (record.departures - record.removals).sum(axis=0) - np.diag(record.arrivals.sum(axis=0))
    inside = inside + moved.sum(axis=0) - moved.sum(axis=1) + redirected.sum(axis=1) - redirected.sum(axis=2)
    return trajectory.assign(
        accumulation=np.concatenate([trajectory.accumulation[:-1], inside[None].astype(float)]),
        completed=since_start(record.arrivals.sum(axis=1)),
        removed=since_start(record.removals + record.given_up),
    )


def _small(counts: np.ndarray) -> np.ndarray:
    """Whole numbers of one control interval in half the memory, which a record of days fills."""
    return counts.astype(np.int32) if counts.dtype.kind == "i" else counts


class Recorder:
    """Adds up a record: `add` at the end of every control interval."""

    def __init__(self, meter: Meter, guide: Guide, actuation: Actuation):
        """What they have counted until now belongs to no interval."""
        self._meter, self._guide, self._actuation = meter, guide, actuation
        self._rows: list[dict[str, np.ndarray]] = []
        self._before = self._totals()

    def add(self, streets: StreetMeans) -> None:
        """streets: means of the interval that has just ended; all else is what was added since the last call"""
        totals = self._totals()
        added = {key: _small(total - self._before[key]) for key, total in totals.items()}
        self._rows.append(
            {
                **added,
                "gateway_green": self._actuation.as_shown(added["gateway_green"]),
                "gateway_original_green": self._actuation.original_green,
                "production": streets.production,
                "mean_accumulation": streets.accumulation,
                "edge_vehicles": streets.vehicles.astype(np.float16),  # to 0.1 % and as small as an integer
                "gateway_queue": streets.queue,
                "gateway_queue_max": streets.queue_max,
            }
        )
        self._before = totals

    def repeat(self) -> None:
        """Another interval in which everything stands and is shown as in the last one, and nothing was counted."""
        counted = [key for key in self._before if key != "gateway_green"]
        self._rows.append({**self._rows[-1], **{key: np.zeros_like(self._rows[-1][key]) for key in counted}})

    @property
    def last(self) -> dict[str, np.ndarray]:
        """The fields of the record in the last control interval."""
        return self._rows[-1]

    def record(self) -> Record:
        """Of all control intervals so far."""
        return Record(**{key: np.stack([row[key] for row in self._rows]) for key in self._rows[0]})

    def close(self) -> None:
        """The books were closed: what was booked at last belongs to the last interval."""
        totals = {name: getattr(self._meter, name).copy() for name in BOOKS}
        for name in BOOKS if self._rows else ():
            self._rows[-1][name] = self._rows[-1][name] + totals[name] - self._before[name]
        self._before |= totals

    def _totals(self) -> dict[str, np.ndarray]:
        meter = self._meter
        return {
            **{name: getattr(meter, name).copy() for name in BOOKS},
            "teleports": np.array(meter.teleports),
            "guided": self._guide.realised.copy(),
            "gateway_flow": meter.gateway_flow(),
            "gateway_green": self._actuation.green_time(),
        }
