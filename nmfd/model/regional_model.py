"""Regions, their adjacency, control bounds and MFDs; loaded from network.toml and checked."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csgraph

from nmfd.errors import InputError
from nmfd.model.mfd import Mfd
from nmfd.runs import config

# Of boundaries with a capacity. What passes is a smooth minimum of wish and limit, (wish^-n + limit^-n)^(-1/n), 84 % of
# either where they are equal: demand within a control interval is not even.
SHARPNESS = 4
LEAST_ROOM = 0.03    # of the capacity, into a region however full: it never locks for good
LEAST_LIMIT = 1e-6   # veh/s, against a division by zero
MOST = 1e9           # veh in a region: beyond, it is a mistake
LONGEST_NAME = 100   # characters: names become file names


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
    own_splits: {(i, j): {h: share}}, what drivers do by themselves where it was measured; elsewhere they follow the
        fewest boundaries
    exit_rates: (R, R) [-], [i, j]: how fast vehicles in i bound for j leave i, relative to the mean g_i(x_i)/x_i of
        the MFD; None for 1: trips of all kinds have the same length in a region
    capacity: (R, R) [veh/s], [i, h]: the most that passes from i to an empty region h under u_max; None: u_ih is a
        share of the flow that wishes to pass, however little that is
    storage: (R,) [veh], the accumulation that leaves no room for vehicles from other regions; with `capacity`
    folder: where network.toml was, or None
    """

    name: str
    region_names: tuple[str, ...]
    positions: np.ndarray
    adjacency: np.ndarray
    mfds: tuple[Mfd, ...]
    u_min: float
    u_max: float
    own_splits: Mapping[tuple[int, int], Mapping[int, float]] = field(default_factory=dict)
    exit_rates: np.ndarray | None = None
    capacity: np.ndarray | None = None
    storage: np.ndarray | None = None
    folder: Path | None = None

    @property
    def regions(self) -> int:
        """R."""
        return len(self.region_names)

    @cached_property
    def hops(self) -> np.ndarray:
        """(R, R) int: boundaries to cross on a shortest way; -1 where there is none."""
        return _hops(self.adjacency)

    @cached_property
    def split_mask(self) -> np.ndarray:
        """(R, R, R) bool, [i, h, j]: theta_ihj may be positive.

        h must be adjacent to i, j != i, and j must be reachable from h without coming back to i.
        """
        mask = np.zeros((self.regions,) * 3, dtype=bool)
        for i in range(self.regions):
            without_i = self.adjacency.copy()
            without_i[i, :] = without_i[:, i] = False
            mask[i] = self.adjacency[i][:, None] & (_hops(without_i) >= 0)
            mask[i, :, i] = False
        return mask

    @cached_property
    def nominal_splits(self) -> np.ndarray:
        """(R, R, R), [i, h, j]: theta without guidance [-]: `own_splits`, else the fewest boundaries, equally where
        there are several such ways."""
        closer = self.hops[None, :, :] == self.hops[:, None, :] - 1
        theta = (self.adjacency[:, :, None] & closer & self.split_mask).astype(float)
        for (i, j), shares in self.own_splits.items():
            theta[i, :, j] = 0.0
            theta[i, list(shares), j] = list(shares.values())
        sums = theta.sum(axis=1, keepdims=True)
        return theta / np.where(sums > 0, sums, 1.0)

    @property
    def open_capacity(self) -> np.ndarray | None:
        """(R, R) [veh/s]: `capacity` for u = 1."""
        return None if self.capacity is None else self.capacity / self.u_max

    @cached_property
    def hash(self) -> str:
        """A fingerprint of all that the dynamics depend on; a policy is valid for one network only."""
        content = [
            self.adjacency.astype(int).tolist(), [[m.a, m.b, m.c, m.jam] for m in self.mfds], self.u_min, self.u_max,
            self.nominal_splits.round(12).tolist()]
        options = {"exit_rates": self.exit_rates, "capacity": self.capacity, "storage": self.storage}
        content += [[name, option.tolist()] for name, option in options.items() if option is not None]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _hops(adjacency: np.ndarray) -> np.ndarray:
    hops = csgraph.shortest_path(adjacency, unweighted=True)
    return np.where(np.isfinite(hops), hops, -1).astype(int)


def load_network(folder: Path | str) -> RegionalModel:
    """Read `folder`/network.toml.

    Raises InputError for a missing file, an unknown key, a wrong type or range, an adjacency that is not symmetric
    or not connected, or an MFD that is none. The table [sumo] is left to the microsimulation.
    """
    folder = Path(folder)
    root = config.read(folder / "network.toml")
    name = root.text("name", longest=LONGEST_NAME)
    perimeter = root.table("perimeter")
    u_min = perimeter.number("min", low=0.0, high=1.0)
    u_max = perimeter.number("max", low=0.0, high=1.0)
    perimeter.close()
    if u_min >= u_max:
        raise root.error("perimeter", f"min must be less than max, got min = {u_min:g} and max = {u_max:g}")
    default_mfd = _mfd(root.table("mfd")) if root.has("mfd") else None
    rows = root.tables("regions")
    if not rows:
        raise root.error("regions", "empty; add at least one [[regions]] table")
    names, positions, neighbours, barred, onward, mfds, boundaries = [], [], [], [], [], [], []
    for number, row in enumerate(rows):
        names.append(row.text("name", str(number), longest=LONGEST_NAME))
        positions.append(row.numbers("position", length=2))
        neighbours.append(row.integers("adjacent", high=len(rows) - 1))
        barred.append(row.integers("no_way_to", (), high=len(rows) - 1))
        if unknown := sorted(set(barred[-1]) - set(neighbours[-1])):
            raise row.error(
                "no_way_to", f"expected some of the adjacent regions {list(neighbours[-1])}, got {unknown[0]} instead")
        mfds.append(_mfd(row.table("mfd")) if default_mfd is None or row.has("mfd") else default_mfd)
        onward.append(tuple(h for h in neighbours[-1] if h not in barred[-1]))
        boundaries.append(_boundary(row, len(rows), onward[-1]))
        row.close()
    own_splits = {}
    for row in root.tables("own_splits", ()):
        here, to = row.integer("region", high=len(rows) - 1), row.integer("destination", high=len(rows) - 1)
        own_splits[here, to] = _shares(row, onward[here])
        row.close()
    root.raw_table("sumo")
    root.close()
    adjacency = np.zeros((len(rows), len(rows)), dtype=bool)
    for i, regions in enumerate(neighbours):
        adjacency[i, list(regions)] = True
    _check_symmetry(adjacency, root)
    for i, regions in enumerate(barred):
        adjacency[i, list(regions)] = False
    network = RegionalModel(
        name=name, region_names=tuple(names), positions=np.array(positions), adjacency=adjacency, mfds=tuple(mfds),
        u_min=u_min, u_max=u_max, own_splits=own_splits, folder=folder, **_boundaries(root, onward, boundaries))
    _check_graph(network, root)
    for i, j in own_splits:
        for h in own_splits[i, j]:
            if not network.split_mask[i, h, j]:
                raise root.error("own_splits", f"from region {i} to {j} by way of {h} leads back into {i}; remove it")
    return network


def _shares(row: config.Table, neighbours: tuple[int, ...]) -> dict[int, float]:
    via, share = row.integers("next", high=10**6), row.numbers("share")
    if not via or not set(via) <= set(neighbours):
        raise row.error("next", f"expected some of the adjacent regions {list(neighbours)}, got {list(via)} instead")
    if len(share) != len(via) or min(share) < 0 or abs(sum(share) - 1.0) > 1e-3:
        raise row.error("share", f"expected {len(via)} numbers >= 0 with sum 1, got {list(share)} instead")
    return dict(zip(via, share, strict=True))


def _boundary(row: config.Table, regions: int, adjacent: tuple[int, ...]) -> dict:
    """The options of one region: exit_rates (R,), capacity (one per region it leads to), storage; None if absent."""
    found: dict = {
        "exit_rates": row.numbers("exit_rates", length=regions) if row.has("exit_rates") else None,
        "capacity": row.numbers("capacity", length=len(adjacent)) if row.has("capacity") else None,
        "storage": row.number("storage", above=0.0, high=MOST) if row.has("storage") else None}
    for key in ("exit_rates", "capacity"):
        if found[key] is not None and min(found[key], default=1.0) <= 0:
            raise row.error(key, f"expected numbers above 0, got {list(found[key])} instead")
    for key, other in (("storage", "capacity"), ("capacity", "storage")):
        if found[key] is not None and found[other] is None:
            raise row.error(key, f"needs {other} beside it: both limit what passes a boundary; add or remove one")
    return found


def _boundaries(root: config.Table, neighbours: list[tuple], rows: list[dict]) -> dict[str, np.ndarray | None]:
    """exit_rates, capacity and storage of RegionalModel; InputError where only some of the regions have one."""
    fields: dict[str, np.ndarray | None] = {}
    for key in rows[0]:
        given = [row[key] is not None for row in rows]
        if any(given) and not all(given):
            raise root.error(f"regions[{given.index(False)}].{key}", "missing; give it for every region or for none")
        fields[key] = np.array([row[key] for row in rows], dtype=float) if all(given) and key != "capacity" else None
    if rows[0]["capacity"] is not None:
        fields["capacity"] = np.zeros((len(rows), len(rows)))
        for i, row in enumerate(rows):
            fields["capacity"][i, list(neighbours[i])] = row["capacity"]
    return fields


def _mfd(table: config.Table) -> Mfd:
    mfd = Mfd(a=table.number("a"), b=table.number("b"), c=table.number("c"),
              jam=table.number("jam", above=0.0, high=MOST))
    table.close()
    if problem := mfd.problem():
        raise table.error("c" if mfd.c <= 0 else "jam", problem)
    return mfd


def _check_symmetry(adjacency: np.ndarray, root: config.Table) -> None:
    for i in range(len(adjacency)):
        if adjacency[i, i]:
            raise root.error(f"regions[{i}].adjacent", f"region {i} is listed as adjacent to itself; remove it")
        for h in np.flatnonzero(adjacency[i] & ~adjacency[:, i]):
            raise root.error(
                f"regions[{i}].adjacent",
                f"not symmetric: region {i} lists {h}, but region {h} does not list {i}; add or remove one of them "
                "(no_way_to lists the adjacent regions into which no road leads)")


def _check_graph(network: RegionalModel, root: config.Table) -> None:
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        raise root.error("regions", f"region {j} cannot be reached from region {i}; connect them with adjacent")


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
                f"{1.0 / fastest:.3g} s: raise substeps or shorten step")
