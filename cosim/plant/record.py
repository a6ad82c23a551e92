"""The record of a run in SUMO per control interval, beside its states and controls."""

from pathlib import Path

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.guidance import Guide
from cosim.plant.meter import Meter
from cosim.plant.sampling import StreetMeans
from nmfd.runs import config
from nmfd.types import Quantity, Result

BOOKS = (
    "departures",
    "arrivals",
    "private_arrivals",
    "removals",
    "given_up",
    "crossings",
    "jumps",
    "redirected",
)  # of the meter
RECORD, TOTALS = (
    {name: Quantity(tuple(axes.split()), unit, text) for name, (axes, unit, text) in arrays.items()}
    for arrays in config.read(Path(__file__).with_name("record.toml")).values()
)


def settled(result: Result) -> Result:
    """Return a result with a record whose last state, completed and removed trips follow from the
    closed books.

    SUMO may report the end of a trip late, or in the last step only (cosim.plant.meter).
    """

    def since_start(counts: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros_like(counts[:1]), counts]).cumsum(axis=0).astype(float)

    moved, redirected = (result.crossings + result.jumps).sum(axis=0), result.redirected.sum(axis=0)
    inside = (result.departures - result.removals).sum(axis=0) - np.diag(
        result.arrivals.sum(axis=0)
    )
    inside = (
        inside
        + moved.sum(axis=0)
        - moved.sum(axis=1)
        + redirected.sum(axis=1)
        - redirected.sum(axis=2)
    )
    return result.assign(
        accumulation=np.concatenate([result.accumulation[:-1], inside[None].astype(float)]),
        completed=since_start(result.private_arrivals.sum(axis=1)),
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
            "edge_vehicles": streets.vehicles.astype(
                np.float16
            ),  # to 0.1 %, as small as an integer
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
