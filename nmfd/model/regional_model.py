"""Regions, their adjacency, control bounds and MFDs, and the network.toml that declares them."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator
from scipy.sparse import csgraph, csr_array

from nmfd.arrays import Adjacency, Hops, PerPair, PerRegion, PerTurn, Positions, TurnMask
from nmfd.errors import InputError
from nmfd.model.mfd import Cubic, Mfd
from nmfd.runs import config, shipped
from nmfd.runs.config import Problem, Regions, Rows, Settings, Share, filled, got, setting

# Flow over a boundary with a capacity: a smooth minimum of desired flow and limit, (desired^-n +
# limit^-n)^(-1/n), 84 % of either where they are equal, because demand within a control interval is
# not even.
SHARPNESS = 4
LEAST_ROOM = 0.03  # of the capacity, into a region however full: no boundary closes for good
LEAST_LIMIT = 1e-6  # veh/s, against a division by zero

MOST_VEHICLES = 1e9  # in a region
DISPERSION_S = 60.0  # of the travel times that drivers perceive; assumed
FOR_ALL = (
    "exit_rates",
    "capacity",
    "storage",
    "controllable",
)  # given for every region or for none


def passing_share(wish: Any, limit: Any) -> Any:
    """Return the share [-] of a desired flow that passes a boundary of this limit [veh/s]; any
    library's arrays."""
    return (1.0 + (wish / (limit + LEAST_LIMIT)) ** SHARPNESS) ** (-1.0 / SHARPNESS)


@dataclass(frozen=True, kw_only=True)
class RegionalModel:
    """R regions, numbered from 0.

    region_names: R names
    positions: (R, 2), place on the map [any unit]
    adjacency: (R, R) bool, [i, h]: roads lead from i to h; false on the diagonal
    mfds: R outflow MFDs
    u_min, u_max: bounds of the perimeter control [-]
    observed_split_ratios: {(i, j): {h: share}}, measured; elsewhere vehicles cross the fewest
        boundaries
    exit_rates: (R, R) [-], [i, j]: rate of vehicles in i bound for j relative to g_i(x_i)/x_i;
        None: 1
    capacity: (R, R) [veh/s], [i, h]: largest flow from i into an empty region h under u_max; None:
        u_ih is a share of the desired flow
    storage: (R,) [veh], accumulation that leaves no room for vehicles from other regions; with
        `capacity`
    controllable: (R, R) [-], [i, h]: share of the flow that passes signals under control; None if
        unknown
    critical_above: {region: largest accumulation [veh]} where data show no falling branch; the MFD
        is a guess beyond
    dispersion: of the logit by which guided drivers answer prices (nmfd.model.answer) [s]
    placeholder: the MFDs are guesses that no run has measured
    doubts: warnings about the fit of each region; () if unknown
    folder: of network.toml, or None
    """

    name: str
    region_names: tuple[str, ...]
    positions: Positions
    adjacency: Adjacency
    mfds: tuple[Mfd, ...]
    u_min: float
    u_max: float
    observed_split_ratios: Mapping[tuple[int, int], Mapping[int, float]] = field(
        default_factory=dict
    )
    exit_rates: PerPair | None = None
    capacity: PerPair | None = None
    storage: PerRegion | None = None
    controllable: PerPair | None = None
    critical_above: Mapping[int, float] = field(default_factory=dict)
    dispersion: float = DISPERSION_S
    placeholder: bool = False
    doubts: tuple[tuple[str, ...], ...] = ()
    folder: Path | None = None

    @property
    def regions(self) -> int:
        return len(self.region_names)

    @property
    def titles(self) -> tuple[str, ...]:
        """Number and name of each region, such as "3 centre"; "region 3" if that is the name."""
        return tuple(
            f"region {n}" if name == str(n) else f"{n} {name}"
            for n, name in enumerate(self.region_names)
        )

    @property
    def critical(self) -> PerRegion:
        """Critical accumulations (R,) [veh]."""
        return np.array([mfd.critical for mfd in self.mfds])

    @property
    def seen_critical(self) -> PerRegion:
        """Critical accumulations (R,) [veh], NaN where data show no falling branch."""
        return np.where(
            [r in self.critical_above for r in range(self.regions)], np.nan, self.critical
        )

    @cached_property
    def hops(self) -> Hops:
        """Boundaries on a shortest path (R, R) int; -1 where there is none."""
        hops = csgraph.shortest_path(self.adjacency, unweighted=True)
        return np.where(np.isfinite(hops), hops, -1).astype(int)

    @cached_property
    def split_mask(self) -> TurnMask:
        """Turns with theta_ihj > 0 allowed (R, R, R) bool: h adjacent to i, and j reachable from h
        without i."""
        mask = np.zeros((self.regions,) * 3, dtype=bool)
        roads = csr_array(self.adjacency)
        for i in range(self.regions):
            others, onward = np.arange(self.regions) != i, self.adjacency[i]
            mask[np.ix_([i], onward, others)] = _reachable(roads[others][:, others])[onward[others]]
        return mask

    @cached_property
    def nominal_splits(self) -> PerTurn:
        """Theta without guidance (R, R, R) [-], [i, h, j]: observed, otherwise equal shares of
        shortest paths."""
        closer = self.hops[None, :, :] == self.hops[:, None, :] - 1
        theta = (self.adjacency[:, :, None] & closer & self.split_mask).astype(float)
        for (i, j), shares in self.observed_split_ratios.items():
            theta[i, :, j] = 0.0
            theta[i, list(shares), j] = list(shares.values())
        sums = theta.sum(axis=1, keepdims=True)
        theta /= np.where(sums > 0, sums, 1.0)  # in place: large for hundreds of regions
        return theta

    @property
    def open_perimeter(self) -> PerPair:
        """Perimeter control without a closed gate (R, R) [-]: u_max at every boundary."""
        return np.where(self.adjacency, self.u_max, 0.0)

    @property
    def open_capacity(self) -> PerPair | None:
        """`capacity` for u = 1 (R, R) [veh/s]."""
        return None if self.capacity is None else self.capacity / self.u_max

    @cached_property
    def hash(self) -> str:
        """Hash of all that the dynamics depend on; a policy is valid for one network only."""
        mfds = [
            [*([] if isinstance(m, Cubic) else [type(m).__name__]), *vars(m).values()]
            for m in self.mfds
        ]
        content = [self.adjacency.astype(int).tolist(), mfds, self.u_min, self.u_max]
        content += [self.nominal_splits.round(12).tolist()]
        options = {
            "exit_rates": self.exit_rates,
            "capacity": self.capacity,
            "storage": self.storage,
        }
        content += [
            [name, option.tolist()] for name, option in options.items() if option is not None
        ]
        content += [["dispersion", self.dispersion]] if self.dispersion != DISPERSION_S else []
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _reachable(roads: csr_array) -> Adjacency:
    """Return (R, R) bool, [h, j]: j is reachable from h; by components where possible, which is
    much faster."""
    parts, label = csgraph.connected_components(roads, connection="weak")
    if parts == csgraph.connected_components(roads, connection="strong", return_labels=False):
        return label[:, None] == label
    return np.isfinite(csgraph.shortest_path(roads, unweighted=True))


class PerimeterTable(Settings):
    """Bounds of the perimeter control at every boundary."""

    min: Share = setting("least control")
    max: Share = setting("largest control, more than min")

    @model_validator(mode="after")
    def _ordered(self) -> "PerimeterTable":
        if self.min >= self.max:
            raise Problem(
                "", f"min must be less than max, got min = {self.min:g} and max = {self.max:g}"
            )
        return self


class MfdTable(Settings):
    """Outflow MFD: a n^3 + b n^2 + c n [veh/s] at accumulation n [veh]."""

    a: float = setting("cubic coefficient", unit="veh^-2 s^-1")
    b: float = setting("quadratic coefficient", unit="veh^-1 s^-1")
    c: float = setting("linear coefficient", unit="s^-1", gt=0.0)
    jam: float = setting(
        "accumulation beyond which the outflow is constant", unit="veh", gt=0.0, le=MOST_VEHICLES
    )

    @model_validator(mode="after")
    def _valid(self) -> "MfdTable":
        if problem := self.mfd.problem():
            raise Problem("jam", problem)
        return self

    @property
    def mfd(self) -> Cubic:
        return Cubic(**vars(self))


class RegionTable(Settings):
    """Region; regions are numbered from 0 in the order of the file."""

    name: config.Name | None = setting("name; by default the number", None)
    position: Annotated[tuple[float, float], Field(strict=False)] = setting(
        "place on the map, in any unit"
    )
    adjacent: Regions = setting("regions into which roads lead from here")
    mfd: MfdTable | None = setting("own MFD instead of [mfd]", None)
    exit_rates: config.PositiveNumbers | None = setting(
        "rate at which vehicles leave, relative to the MFD, per destination; for all regions or none",
        None,
        unit="-",
    )
    capacity: config.PositiveNumbers | None = setting(
        "largest flow into each adjacent region while that is empty, at the largest u, in the order of adjacent; with "
        "storage, for all regions or none",
        None,
        unit="veh/s",
    )
    storage: float | None = setting(
        "accumulation at which no vehicle can enter; with capacity",
        None,
        unit="veh",
        gt=0.0,
        le=MOST_VEHICLES,
    )
    controllable: Annotated[tuple[Share, ...], Field(strict=False)] | None = setting(
        "share of the flow into each adjacent region that passes signals under control, in the order of adjacent; for "
        "all regions or none",
        None,
        unit="-",
    )
    critical_above: float | None = setting(
        "largest accumulation in data without a falling branch; the critical one is above it",
        None,
        unit="veh",
        ge=0.0,
    )
    doubts: config.Texts = setting("warnings of cosim identify about the fit", ())
    observed_split_ratios: dict[str, dict[str, Share]] = setting(
        "measured shares: destination region = { next region = share }, sum 1; elsewhere vehicles cross the fewest "
        "boundaries",
        {},
    )


class NetworkTable(Settings):
    """Regional model of a city."""

    name: config.Name = setting("name of the model")
    placeholder: bool = setting(
        "MFDs are guesses from lanes and speed limits; no policy is trained on them", False
    )
    perimeter: PerimeterTable = setting("bounds of the control")
    dispersion: float = setting(
        "spread of travel times by which guided drivers answer prices (logit)",
        DISPERSION_S,
        unit="s",
        ge=1.0,
        le=1e4,
    )
    mfd: MfdTable | None = setting("MFD of every region without one of its own", None)
    regions: Rows[RegionTable] = setting("one table per region", min_length=1)
    sumo: dict[str, Any] = setting("simulated city, for cosim", {})

    @model_validator(mode="after")
    def _consistent(self) -> "NetworkTable":
        count = len(self.regions)
        for i, row in enumerate(self.regions):
            where = f"regions[{i}]"
            if max(row.adjacent, default=0) >= count or i in row.adjacent:
                allowed = f"a list of distinct whole numbers from 0 to {count - 1} without {i}, the region itself"
                raise Problem(f"{where}.adjacent", got(allowed, list(row.adjacent)))
            if row.mfd is None and self.mfd is None:
                raise Problem(
                    f"{where}.mfd", "missing; add a table [regions.mfd], or [mfd] for all regions"
                )
            if (row.storage is None) != (row.capacity is None):
                raise Problem(
                    f"{where}.capacity", "capacity and storage belong together; add or remove one"
                )
            for key in FOR_ALL:
                if getattr(row, key) is None and any(
                    getattr(other, key) is not None for other in self.regions
                ):
                    raise Problem(f"{where}.{key}", "missing; give it for every region or for none")
            lengths = {
                "exit_rates": count,
                "capacity": len(row.adjacent),
                "controllable": len(row.adjacent),
            }
            for key, length in lengths.items():
                if (values := getattr(row, key)) is not None and len(values) != length:
                    raise Problem(
                        f"{where}.{key}", got(f"a list of {length} numbers", list(values))
                    )
            for destination, shares in row.observed_split_ratios.items():
                known = destination in map(str, range(count)) and set(shares) <= set(
                    map(str, row.adjacent)
                )
                if not known or abs(sum(shares.values()) - 1.0) > 1e-3:
                    allowed = (
                        f"destination = {{ one of {list(row.adjacent)} = share, ... }} with sum 1"
                    )
                    raise Problem(
                        f"{where}.observed_split_ratios.{destination}", got(allowed, shares)
                    )
        return self


def load_network(folder: Path | str) -> RegionalModel:
    """Read `folder`/network.toml, or a shipped network by its name. Raises InputError.

    >>> network = load_network("hexagon7")
    >>> network.regions, network.u_min, network.u_max
    (7, 0.1, 0.9)
    >>> network.nominal_splits[2, :, 4]  # from west to east through the centre
    array([0., 0., 0., 1., 0., 0., 0.])
    """
    folder = shipped.found(folder, shipped.NETWORK)
    path = folder / "network.toml"
    table = config.checked(NetworkTable, config.read(path), path)
    rows = table.regions
    adjacency = np.zeros((len(rows), len(rows)), dtype=bool)
    for i, row in enumerate(rows):
        adjacency[i, list(row.adjacent)] = True

    def numbers(key: str, *, by_pair: bool = False) -> Any:
        values = [getattr(row, key) for row in rows]
        if values[0] is None or not by_pair:
            return None if values[0] is None else np.array(values)
        matrix = np.zeros(adjacency.shape)
        for i, row in enumerate(rows):
            matrix[i, list(row.adjacent)] = values[i]
        return matrix

    network = RegionalModel(
        name=table.name,
        region_names=tuple(row.name or str(number) for number, row in enumerate(rows)),
        positions=np.array([row.position for row in rows]),
        adjacency=adjacency,
        mfds=tuple((row.mfd or table.mfd).mfd for row in rows),  # type: ignore[union-attr]  # `_consistent`
        u_min=table.perimeter.min,
        u_max=table.perimeter.max,
        observed_split_ratios={
            (i, int(j)): {int(h): share for h, share in shares.items()}
            for i, row in enumerate(rows)
            for j, shares in row.observed_split_ratios.items()
        },
        exit_rates=numbers("exit_rates"),
        capacity=numbers("capacity", by_pair=True),
        storage=numbers("storage"),
        controllable=numbers("controllable", by_pair=True),
        critical_above={
            i: row.critical_above for i, row in enumerate(rows) if row.critical_above is not None
        },
        dispersion=table.dispersion,
        placeholder=table.placeholder,
        folder=folder,
        doubts=tuple(row.doubts for row in rows) if any(row.doubts for row in rows) else (),
    )
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        raise config.error(
            path,
            "regions",
            f"region {j} cannot be reached from region {i}; connect them with adjacent",
        )
    for (i, j), observed in network.observed_split_ratios.items():
        for h in observed:
            if not network.split_mask[i, h, j]:
                key = f"regions[{i}].observed_split_ratios.{j}"
                raise config.error(path, key, f"region {h} leads back into {i}; remove it")
    return network


def check_step(network: RegionalModel, step: float, where: str) -> None:
    """Raise InputError unless forward Euler with `step` [s] keeps accumulations non-negative (step
    * q <= 1)."""
    for region, mfd in enumerate(network.mfds):
        fastest = float(mfd.rate(np.linspace(0.0, mfd.jam, 2001)).max())
        if network.exit_rates is not None:
            fastest *= float(network.exit_rates[region].max())
        if step * fastest > 1.0:
            problem = f"an integration step of {step:g} s is too long for region {region} of network {network.name}"
            allowed = f"allowed is at most {1.0 / fastest:.3g} s: raise substeps or shorten step"
            raise InputError(
                f"{where}: step: {problem}, whose vehicles leave at {fastest:.3g} 1/s; {allowed}"
            )


def network_toml(network: RegionalModel, sumo: Mapping[str, str], comment: str) -> str:
    """Return network.toml of `network` with this table [sumo]."""
    ratios = sorted(network.observed_split_ratios.items())
    observed = [
        [(j, shares) for (i, j), shares in ratios if i == region]
        for region in range(network.regions)
    ]
    values = {"network": network, "sumo": sumo, "comment": comment, "observed": observed}
    return filled(Path(__file__).with_name("network.toml.j2"), **values)
