"""The record of a run in SUMO per control interval."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.meter import Meter
from cosim.plant.sampling import StreetMeans
from nmfd.arrays import Arrays
from nmfd.runs import config
from nmfd.types import Quantity, Result

# The books of the meter.
BOOKS = (
    "departures",
    "arrivals",
    "private_arrivals",
    "removals",
    "given_up",
    "crossings",
    "jumps",
    "redirected",
    "time_inside",
)


def _quantities(table: Mapping[str, tuple[str, str, str]]) -> dict[str, Quantity]:
    """Return what a table of record.toml says of its arrays."""
    quantities = {}
    for name, (axes, unit, text) in table.items():
        quantities[name] = Quantity(tuple(axes.split()), unit, text)
    return quantities


_TABLES = config.read(Path(__file__).with_name("record.toml"))
RECORD = _quantities(_TABLES["record"])
TOTALS = _quantities(_TABLES["totals"])


def settled(result: Result) -> Result:
    """Return a result with a record, corrected by the closed books.

    SUMO may report the end of a trip late, or in the last step only (cosim.plant.meter). So the
    last state, completed and removed trips follow from the books.
    """
    moved = (result["crossings"] + result["jumps"]).sum(axis=0)
    redirected = result["redirected"].sum(axis=0)
    arrivals = np.diag(result["arrivals"].sum(axis=0))
    inside = (result["departures"] - result["removals"]).sum(axis=0) - arrivals
    inside = inside + moved.sum(axis=0) - moved.sum(axis=1)
    inside = inside + redirected.sum(axis=1) - redirected.sum(axis=2)
    return result.assign(
        accumulation=np.concatenate([result["accumulation"][:-1], inside[None].astype(float)]),
        completed=_since_start(result["private_arrivals"].sum(axis=1)),
        removed=_since_start(result["removals"] + result["given_up"]),
    )


def _since_start(counts: np.ndarray) -> np.ndarray:
    """Return (K + 1, ...), sums of counts (K, ...) before every interval."""
    return np.concatenate([np.zeros_like(counts[:1]), counts]).cumsum(axis=0).astype(float)


class Recorder:
    """Rows of a record: `add` one at the end of every control interval."""

    def __init__(self, meter: Meter, guided: Callable[[], np.ndarray], actuation: Actuation):
        """Their counts so far belong to no interval.

        guided: returns drivers by region, next region and destination (veh, (R, R, R))
        """
        self._meter = meter
        self._guided = guided
        self._actuation = actuation
        self._rows: list[Arrays] = []
        self._before = self._totals()

    def add(self, streets: StreetMeans) -> Arrays:
        """Add and return the row of the interval that has just ended.

        streets: its means
        """
        totals = self._totals()
        actuation = self._actuation
        row: Arrays = {}
        for name, total in totals.items():
            added = total - self._before[name]
            if added.dtype.kind == "i":
                # Half the memory for counts, which fill the record of a long run.
                added = added.astype(np.int32)
            row[name] = added
        ungated = actuation.ungated(row["gateway_original_green"])
        row["gateway_green"] = actuation.as_shown(row["gateway_green"], ungated)
        row["gateway_original_green"] = ungated
        row["gateway_command"] = actuation.room.command_of_gateways()
        row["gateway_share"] = actuation.room.gateway_shares()
        row["production"] = streets.production
        row["mean_accumulation"] = streets.accumulation
        row["edge_vehicles"] = streets.vehicles.astype(np.float16)  # to 0.1 %, 2 bytes each
        row["gateway_queue"] = streets.queue
        row["gateway_queue_max"] = streets.queue_max
        self._rows.append(row)
        self._before = totals
        return row

    def record(self) -> Arrays:
        """Return the arrays of RECORD over all control intervals so far."""
        return {key: np.stack([row[key] for row in self._rows]) for key in self._rows[0]}

    def close(self) -> None:
        """Add to the last interval what was booked when the books were closed."""
        for name, total in self._booked().items():
            self._rows[-1][name] = self._rows[-1][name] + total - self._before[name]

    def _booked(self) -> Arrays:
        """Return the books so far."""
        booked = {name: getattr(self._meter, name).copy() for name in BOOKS}
        booked["other_time_spent"], booked["time_spent"] = self._meter.time_spent()
        return booked

    def _totals(self) -> Arrays:
        """Return everything that is counted from the beginning."""
        totals = self._booked()
        totals["teleports"] = np.array(self._meter.teleports)
        totals["guided"] = self._guided().copy()
        totals["gateway_flow"] = self._meter.gateway_flow()
        totals["gateway_green"], totals["gateway_original_green"] = self._actuation.green_time()
        return totals
