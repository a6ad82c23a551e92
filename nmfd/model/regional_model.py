"""Regions, their adjacency, control bounds and MFDs; loaded from network.toml and checked."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csgraph, csr_array

from nmfd.arrays import Adjacency, Hops, PerPair, PerRegion, PerTurn, Positions, TurnMask
from nmfd.errors import InputError
from nmfd.model.disturbance import Disturbance
from nmfd.model.mfd import Mfd
from nmfd.model.network_file import NetworkTable, RegionTable
from nmfd.runs import config, shipped

# Of boundaries with a capacity. What passes is a smooth minimum of wish and limit, (wish^-n + limit^-n)^(-1/n), 84 % of
# either where they are equal: demand within a control interval is not even.
SHARPNESS = 4
LEAST_ROOM = 0.03  # of the capacity, into a region however full: it never locks for good
LEAST_LIMIT = 1e-6  # veh/s, against a division by zero


@dataclass(frozen=True, kw_only=True)
class RegionalModel:
    """R regions, numbered from 0.

    name
    region_names: R names
    positions: (R, 2), where a region is drawn on the map [any unit]
    adjacency: (R, R) bool, [i, h] = vehicles can go from i to h; false on the diagonal, and symmetric but for the
        neighbours that only one-way streets join
    mfds: one outflow MFD per region
    u_min, u_max: bounds of the perimeter control [-]
    observed_split_ratios: {(i, j): {h: share}}, what drivers do by themselves where it was measured; elsewhere they
        follow the fewest boundaries
    exit_rates: (R, R) [-], [i, j]: how fast vehicles in i bound for j leave i, relative to the mean g_i(x_i)/x_i of
        the MFD; None for 1: trips of all kinds have the same length in a region
    capacity: (R, R) [veh/s], [i, h]: the most that passes from i to an empty region h under u_max; None: u_ih is a
        share of the flow that wishes to pass, however little that is
    storage: (R,) [veh], the accumulation that leaves no room for vehicles from other regions; with `capacity`
    controllable: (R, R) [-], [i, h]: share of the flow from i to h that passes signals under control; None if unknown
    disturbance: how what the model got wrong lately says what it will get wrong; None if unknown
    placeholder: whether the MFDs are a guess that no run has measured
    doubts: of every region, what is doubtful about its fit; () if unknown
    folder: where network.toml was, or None
    """

    name: str
    region_names: tuple[str, ...]
    positions: Positions
    adjacency: Adjacency
    mfds: tuple[Mfd, ...]
    u_min: float
    u_max: float
    observed_split_ratios: Mapping[tuple[int, int], Mapping[int, float]] = field(default_factory=dict)
    exit_rates: PerPair | None = None
    capacity: PerPair | None = None
    storage: PerRegion | None = None
    controllable: PerPair | None = None
    disturbance: Disturbance | None = None
    placeholder: bool = False
    doubts: tuple[tuple[str, ...], ...] = ()
    folder: Path | None = None

    @property
    def regions(self) -> int:
        """R."""
        return len(self.region_names)

    @property
    def critical(self) -> PerRegion:
        """(R,) [veh]: the critical accumulations."""
        return np.array([mfd.critical for mfd in self.mfds])

    @cached_property
    def hops(self) -> Hops:
        """(R, R) int: boundaries to cross on a shortest way; -1 where there is none."""
        return _hops(self.adjacency)

    @cached_property
    def split_mask(self) -> TurnMask:
        """(R, R, R) bool, [i, h, j]: theta_ihj may be positive.

        h must be adjacent to i, j != i, and j must be reachable from h without coming back to i.
        """
        mask = np.zeros((self.regions,) * 3, dtype=bool)
        roads = csr_array(self.adjacency)
        for i in range(self.regions):
            others, onward = np.arange(self.regions) != i, self.adjacency[i]
            mask[np.ix_([i], onward, others)] = _reaches(roads[others][:, others])[onward[others]]
        return mask

    @cached_property
    def nominal_splits(self) -> PerTurn:
        """(R, R, R), [i, h, j]: theta without guidance [-]: `observed_split_ratios`, else the fewest boundaries,
        equally where there are several such ways."""
        closer = self.hops[None, :, :] == self.hops[:, None, :] - 1
        theta = (self.adjacency[:, :, None] & closer & self.split_mask).astype(float)
        for (i, j), shares in self.observed_split_ratios.items():
            theta[i, :, j] = 0.0
            theta[i, list(shares), j] = list(shares.values())
        sums = theta.sum(axis=1, keepdims=True)
        theta /= np.where(sums > 0, sums, 1.0)  # in place: of very many regions it is as large as memory
        return theta

    @property
    def open_capacity(self) -> PerPair | None:
        """(R, R) [veh/s]: `capacity` for u = 1."""
        return None if self.capacity is None else self.capacity / self.u_max

    @cached_property
    def hash(self) -> str:
        """A fingerprint of all that the dynamics depend on; a policy is valid for one network only."""
        content = [
            self.adjacency.astype(int).tolist(),
            [[m.a, m.b, m.c, m.jam] for m in self.mfds],
            self.u_min,
            self.u_max,
            self.nominal_splits.round(12).tolist(),
        ]
        options = {"exit_rates": self.exit_rates, "capacity": self.capacity, "storage": self.storage}
        content += [[name, option.tolist()] for name, option in options.items() if option is not None]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _reaches(roads: csr_array) -> Adjacency:
    """(R, R) bool, [h, j]: j can be reached from h by roads (R, R) bool, [h, j] = from h to j.

    Where all one-way streets lie on ways back, as nearly always, by the parts that hang together: in a city of many
    regions shortest ways would take most of the time that a controller needs to be made.
    """
    parts, label = csgraph.connected_components(roads, connection="weak")
    if parts == csgraph.connected_components(roads, connection="strong", return_labels=False):
        return label[:, None] == label
    return np.isfinite(csgraph.shortest_path(roads, unweighted=True))


def _hops(adjacency: Adjacency) -> Hops:
    hops = csgraph.shortest_path(adjacency, unweighted=True)
    return np.where(np.isfinite(hops), hops, -1).astype(int)


def load_network(folder: Path | str) -> RegionalModel:
    """Read `folder`/network.toml (nmfd.model.network_file); a name alone is that of one that comes with the package.

    Raises InputError for a missing file, an unknown key, a wrong type or range, an adjacency that is not symmetric
    or not connected, or an MFD that is none. The table [sumo] is left to the microsimulation.

        >>> network = load_network("hexagon7")
        >>> network.regions, network.u_min, network.u_max
        (7, 0.1, 0.9)
        >>> network.nominal_splits[2, :, 4]  # from west to east by the centre
        array([0., 0., 0., 1., 0., 0., 0.])
    """
    folder = shipped.found(folder, shipped.NETWORK)
    path = folder / "network.toml"
    table = config.checked(NetworkTable, config.read(path), path)
    rows = table.regions
    adjacency = np.zeros((len(rows), len(rows)), dtype=bool)
    for i, row in enumerate(rows):
        adjacency[i, list(row.onward)] = True
    capacity, controllable = (_by_pair(rows, name) for name in ("capacity", "controllable"))
    network = RegionalModel(
        name=table.name,
        region_names=tuple(row.name or str(number) for number, row in enumerate(rows)),
        positions=np.array([row.position for row in rows]),
        adjacency=adjacency,
        mfds=tuple(table.mfd_of(row) for row in rows),
        u_min=table.perimeter.min,
        u_max=table.perimeter.max,
        observed_split_ratios={
            (row.region, row.destination): dict(zip(row.next, row.share, strict=True))
            for row in table.observed_split_ratios
        },
        exit_rates=None if rows[0].exit_rates is None else np.array([row.exit_rates for row in rows]),
        capacity=capacity,
        storage=None if rows[0].storage is None else np.array([row.storage for row in rows]),
        controllable=controllable,
        placeholder=table.placeholder,
        folder=folder,
        disturbance=None if table.disturbance is None else table.disturbance.law,
        doubts=tuple(row.doubts for row in rows) if any(row.doubts for row in rows) else (),
    )
    _check_ways(network, path)
    return network


def _by_pair(rows: Sequence[RegionTable], name: str) -> PerPair | None:
    """(R, R), [i, h]: a key of every region that has a number for each region into which roads lead."""
    if getattr(rows[0], name) is None:
        return None
    found = np.zeros((len(rows),) * 2)
    for i, row in enumerate(rows):
        found[i, list(row.onward)] = getattr(row, name)
    return found


def _check_ways(network: RegionalModel, path: Path) -> None:
    """InputError for a region that cannot be reached, or drivers whose way leads back to where they are."""
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        raise config.error(path, "regions", f"region {j} cannot be reached from region {i}; connect them with adjacent")
    for (i, j), shares in network.observed_split_ratios.items():
        for h in shares:
            if not network.split_mask[i, h, j]:
                raise config.error(
                    path,
                    "observed_split_ratios",
                    f"from region {i} to {j} by way of {h} leads back into {i}; remove it",
                )


def check_step(network: RegionalModel, step: float, where: str) -> None:
    """InputError unless forward Euler with `step` [s] keeps every accumulation non-negative (step * q <= 1)."""
    for region, mfd in enumerate(network.mfds):
        grid = np.linspace(0.0, mfd.jam, 2001)
        fastest = float(mfd.rate(grid).max())
        if network.exit_rates is not None:
            fastest *= float(network.exit_rates[region].max())
        if step * fastest > 1.0:
            raise InputError(
                f"{where}: step: an integration step of {step:g} s is too long for region {region} of network "
                f"{network.name}, whose vehicles leave at up to {fastest:.3g} 1/s; allowed is at most "
                f"{1.0 / fastest:.3g} s: raise substeps or shorten step"
            )
