"""Regional model of a city, and the network.toml that holds it."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from scipy.sparse import csgraph, csr_array

from nmfd.arrays import Adjacency, Hops, PerPair, PerRegion, PerTurn, Positions, TurnMask
from nmfd.errors import InputError
from nmfd.model.mfd import Cubic, Mfd, RoundedLinear
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
# For every region or for none.
FOR_ALL = ("exit_rates", "dispersions", "capacity", "storage", "controllable")


def passing_share(wish: Any, limit: Any) -> Any:
    """Return the share [-] of a desired flow that passes a boundary.

    wish, limit: desired flow and limit of the boundary, arrays of any library (veh/s)
    """
    return (1.0 + (wish / (limit + LEAST_LIMIT)) ** SHARPNESS) ** (-1.0 / SHARPNESS)


class Errors(NamedTuple):
    """RMSE of predicted accumulations, over regions and states [veh].

    model: of the regional model
    as_now: of the prediction that nothing changes
    """

    model: float
    as_now: float


class HeldOut(NamedTuple):
    """Errors in runs that the model has not seen.

    ahead: time from a state to the prediction (s)
    flowing, congested: while no region is beyond its critical accumulation, and else; None if there
        are no such states
    """

    ahead: float
    flowing: Errors | None
    congested: Errors | None

    @property
    def problem(self) -> str:
        """Say where the model is worse than "as now", "" if it is nowhere."""
        places = {"while traffic flows": self.flowing, "beyond critical": self.congested}
        worse = []
        for place, errors in places.items():
            if errors is not None and errors.model > errors.as_now:
                worse.append(f"{place} its error is {errors.model:.0f} veh, of {errors.as_now:.0f}")
        if not worse:
            return ""
        return f'it predicts worse than "as now" {self.ahead:g} s ahead: {", ".join(worse)}'


@dataclass(frozen=True, kw_only=True)
class RegionalModel:
    """R regions, numbered from 0.

    region_names: R names
    positions: place on the map ((R, 2), any unit)
    adjacency: [i, h]: roads lead from i to h (bool, (R, R)); False on the diagonal
    mfds: R outflow MFDs
    u_min, u_max: bounds of the perimeter control (-)
    observed_split_ratios: {(i, j): {h: share}}, measured; elsewhere vehicles cross the fewest
        boundaries
    exit_rates: [i, j]: rate of vehicles in i bound for j relative to g_i(x_i)/x_i (-, (R, R));
        None: 1
    capacity: [i, h]: largest flow from i into an empty region h under u_max (veh/s, (R, R)); None:
        u_ih is a share of the desired flow
    storage: accumulation that leaves no room for vehicles from other regions (veh, (R,)); with
        `capacity`
    controllable: [i, h]: share of the flow that passes signals under control (-, (R, R)); None if
        unknown
    critical_above: {region: largest accumulation [veh]} where data show no falling branch; the MFD
        is a guess beyond
    equal_ways: ways in use take the same time in free flow, whichever region comes next (see
        `detours`); False: the time in a region does not depend on the next one
    dispersion: of the logit by which guided drivers in i bound for j answer prices, see
        nmfd.model.answer (s, (R, R) or one number)
    longest_delay: by prices, beyond which guided drivers hardly tell ways apart (s); None: a plain
        logit
    placeholder: the MFDs are guesses that no run has measured
    doubts: warnings about the fit of each region; () if unknown
    held_out: errors in runs that the model has not seen; None if unknown
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
    equal_ways: bool = False
    dispersion: PerPair | float = DISPERSION_S
    longest_delay: float | None = None
    placeholder: bool = False
    doubts: tuple[tuple[str, ...], ...] = ()
    held_out: HeldOut | None = None
    folder: Path | None = None

    @property
    def regions(self) -> int:
        return len(self.region_names)

    @property
    def titles(self) -> tuple[str, ...]:
        """Number and name of each region: "3 centre", or "region 3" without."""
        titles = []
        for number, name in enumerate(self.region_names):
            if name == str(number):
                titles.append(f"region {number}")
            else:
                titles.append(f"{number} {name}")
        return tuple(titles)

    @property
    def critical(self) -> PerRegion:
        """Critical accumulations (R,) [veh]."""
        return np.array([mfd.critical for mfd in self.mfds])

    @property
    def seen_critical(self) -> PerRegion:
        """Critical accumulations (R,) [veh], NaN where they were not seen."""
        critical = self.critical
        critical[list(self.critical_above)] = np.nan
        return critical

    @cached_property
    def hops(self) -> Hops:
        """Boundaries on a shortest path (R, R) int; -1 where there is none."""
        hops = csgraph.shortest_path(self.adjacency, unweighted=True)
        return np.where(np.isfinite(hops), hops, -1).astype(int)

    @cached_property
    def split_mask(self) -> TurnMask:
        """Turns with theta_ihj > 0 allowed (R, R, R) bool.

        Region h is adjacent to i, and j is reachable from h without i.
        """
        mask = np.zeros((self.regions,) * 3, dtype=bool)
        roads = csr_array(self.adjacency)
        for i in range(self.regions):
            others = np.arange(self.regions) != i
            onward = self.adjacency[i]
            without_i = _reachable(roads[others][:, others])
            mask[np.ix_([i], onward, others)] = without_i[onward[others]]
        return mask

    @cached_property
    def nominal_splits(self) -> PerTurn:
        """Theta without guidance (R, R, R) [-], [i, h, j].

        It is observed, or equal shares of the shortest paths.
        """
        closer = self.hops[None, :, :] == self.hops[:, None, :] - 1
        theta = (self.adjacency[:, :, None] & closer & self.split_mask).astype(float)
        for (i, j), shares in self.observed_split_ratios.items():
            theta[i, :, j] = 0.0
            theta[i, list(shares), j] = list(shares.values())
        sums = theta.sum(axis=1, keepdims=True)
        theta /= np.where(sums > 0, sums, 1.0)  # in place: large for hundreds of regions
        return theta

    @cached_property
    def detours(self) -> PerTurn | None:
        """Time in i by the next region h (R, R, R) [-]; None without `equal_ways`.

        [i, h, j] is relative to the mean time of vehicles in i bound for j, less 1. The dynamics
        alone would let a detour cost nothing in i. But drivers choose the fastest way, so that ways
        in use take about the same time: with the mean time t_ij in i in free flow, and W_ij from i
        to the boundary of j,

            W_ij = t_ij + sum_h theta0_ihj W_hj
            detour_ihj = max(W_ij - W_hj, least) / t_ij - 1

        `least` is the least t_ij of region i, and t_ij where nobody goes that way.
        """
        if not self.equal_ways:
            return None
        time = 1.0 / (self.relative_rates * self.free_rates[:, None])
        elsewhere = ~np.eye(self.regions, dtype=bool)
        onward = np.zeros(time.shape)
        for _ in range(self.regions):  # no way has more boundaries
            onward = (time + np.einsum("ihj,hj->ij", self.nominal_splits, onward)) * elsewhere
        used = self.nominal_splits > 0
        least = np.where(used, time.min(axis=1)[:, None, None], time[:, None, :])
        in_region = np.maximum(onward[:, None, :] - onward[None, :, :], least)
        return np.where(self.split_mask, in_region / time[:, None, :] - 1.0, 0.0)

    @property
    def free_rates(self) -> PerRegion:
        """Rates g_i(x_i)/x_i of empty regions (1/s, (R,))."""
        return np.array([mfd.rate_up_to_jam(0.0) for mfd in self.mfds])

    @property
    def fastest_rates(self) -> PerRegion:
        """Largest rates at which vehicles leave (1/s, (R,))."""
        rates = [mfd.rate(np.linspace(0.0, mfd.jam, 2001)).max() for mfd in self.mfds]
        return np.array(rates) * self.relative_rates.max(axis=1)

    @property
    def relative_rates(self) -> PerPair:
        """`exit_rates`, 1 if they are None (R, R) [-]."""
        if self.exit_rates is None:
            return np.ones(self.adjacency.shape)
        return self.exit_rates

    @property
    def misleads(self) -> str:
        """Text that says where "as now" predicts better, "" if unknown."""
        return "" if self.held_out is None else self.held_out.problem

    @property
    def known_critical(self) -> PerRegion:
        """Critical accumulations (R,) [veh], else the largest that were seen."""
        critical = self.critical
        for region, largest in self.critical_above.items():
            critical[region] = largest
        return critical

    @property
    def open_perimeter(self) -> PerPair:
        """Perimeter control (R, R) [-] with u_max at every boundary."""
        return np.where(self.adjacency, self.u_max, 0.0)

    @property
    def open_capacity(self) -> PerPair | None:
        """`capacity` for u = 1 (R, R) [veh/s]."""
        if self.capacity is None:
            return None
        return self.capacity / self.u_max

    @cached_property
    def hash(self) -> str:
        """Hash of all that the dynamics depend on.

        A policy carries it: it is valid for one network only.
        """
        mfds = []
        for curve in self.mfds:
            numbers = list(vars(curve).values())
            if isinstance(curve, Cubic):  # the default, which has no name in the hash
                mfds.append(numbers)
            else:
                mfds.append([type(curve).__name__, *numbers])
        splits = self.nominal_splits.round(12).tolist()
        content = [self.adjacency.astype(int).tolist(), mfds, self.u_min, self.u_max, splits]
        for name in ("exit_rates", "capacity", "storage"):
            numbers = getattr(self, name)
            if numbers is not None:
                content.append([name, numbers.tolist()])
        if self.equal_ways:
            content.append("equal_ways")
        if np.any(self.dispersion != DISPERSION_S):
            content.append(["dispersion", np.asarray(self.dispersion).tolist()])
        if self.longest_delay is not None:
            content.append(["longest_delay", self.longest_delay])
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _reachable(roads: csr_array) -> Adjacency:
    """Return (R, R) bool, [h, j]: j is reachable from h."""
    # If as many parts are strongly as weakly connected, they are the same: much faster.
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
            problem = f"min must be less than max, got min = {self.min:g} and max = {self.max:g}"
            raise Problem("", problem)
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
        problem = self.mfd.problem()
        if problem:
            raise Problem("jam", problem)
        return self

    @property
    def mfd(self) -> Cubic:
        return Cubic(**vars(self))


class PiecewiseTable(Settings):
    """Outflow MFD along straight lines from (0, 0) through points.

    It is constant beyond the last one.
    """

    accumulations: config.PositiveNumbers = setting(
        "rising; the last one is the jam accumulation", unit="veh"
    )
    outflows: config.PositiveNumbers = setting("as many", unit="veh/s")

    @model_validator(mode="after")
    def _valid(self) -> "PiecewiseTable":
        try:
            _ = self.mfd
        except InputError as error:
            raise Problem("accumulations", str(error)) from None
        return self

    @property
    def mfd(self) -> RoundedLinear:
        return RoundedLinear(accumulations=tuple(self.accumulations), outflows=tuple(self.outflows))


ErrorPair = Annotated[
    tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]], Field(strict=False)
]


class HeldOutTable(Settings):
    """Errors in runs that the model has not seen.

    They are RMSE of the model, and of "as now", the prediction that nothing changes.
    """

    ahead: float = setting("time from a state to the prediction", unit="s", gt=0.0)
    flowing: ErrorPair | None = setting(
        "while no region is beyond its critical accumulation", None, unit="veh"
    )
    congested: ErrorPair | None = setting("in all other states", None, unit="veh")

    @property
    def held_out(self) -> HeldOut:
        flowing = None if self.flowing is None else Errors(*self.flowing)
        congested = None if self.congested is None else Errors(*self.congested)
        return HeldOut(ahead=self.ahead, flowing=flowing, congested=congested)


class RegionTable(Settings):
    """Region; regions are numbered from 0 in the order of the file."""

    name: config.Name | None = setting("name; by default the number", None)
    position: Annotated[tuple[float, float], Field(strict=False)] = setting(
        "place on the map, in any unit"
    )
    adjacent: Regions = setting("regions into which roads lead from here")
    mfd: MfdTable | None = setting("own MFD instead of [mfd]", None)
    piecewise_mfd: PiecewiseTable | None = setting("own MFD along straight lines", None)
    exit_rates: config.PositiveNumbers | None = setting(
        "rate at which vehicles leave, relative to the MFD, per destination; for all regions or "
        "none",
        None,
        unit="-",
    )
    dispersions: config.PositiveNumbers | None = setting(
        "own dispersion instead of that of the city, per destination; for all regions or none",
        None,
        unit="s",
    )
    capacity: config.PositiveNumbers | None = setting(
        "largest flow into each adjacent region while that is empty, at the largest u, in the "
        "order of adjacent; with storage, for all regions or none",
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
        "share of the flow into each adjacent region that passes signals under control, in the "
        "order of adjacent; for all regions or none",
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
        "measured shares: destination region = { next region = share }, sum 1; elsewhere vehicles "
        "cross the fewest boundaries",
        {},
    )


class NetworkTable(Settings):
    """Regional model of a city."""

    name: config.Name = setting("name of the model")
    placeholder: bool = setting(
        "MFDs are guesses from lanes and speed limits; no policy is trained on them", False
    )
    perimeter: PerimeterTable = setting("bounds of the control")
    equal_ways: bool = setting(
        "ways in use take the same time in free flow, whichever region comes next", False
    )
    dispersion: float = setting(
        "spread of travel times by which guided drivers answer prices (logit)",
        DISPERSION_S,
        unit="s",
        ge=1.0,
        le=1e4,
    )
    longest_delay: float | None = setting(
        "delay by prices beyond which guided drivers hardly tell ways apart",
        None,
        unit="s",
        gt=0.0,
        le=1e4,
    )
    mfd: MfdTable | None = setting("MFD of every region without one of its own", None)
    held_out: HeldOutTable | None = setting(
        "errors in runs that the model has not seen, by cosim identify; nmfd train and MPC refuse "
        'a model that is worse than "as now"',
        None,
    )
    regions: Rows[RegionTable] = setting("one table per region", min_length=1)
    sumo: dict[str, Any] = setting("simulated city, for cosim", {})

    @model_validator(mode="after")
    def _consistent(self) -> "NetworkTable":
        for i, row in enumerate(self.regions):
            self._check_region(i, row)
        return self

    def _check_region(self, i: int, row: RegionTable) -> None:
        """Check the table of region i against the others.

        Raises: Problem
        """
        count = len(self.regions)
        where = f"regions[{i}]"
        if max(row.adjacent, default=0) >= count or i in row.adjacent:
            allowed = f"a list of distinct whole numbers from 0 to {count - 1}"
            allowed += f" without {i}, the region itself"
            raise Problem(f"{where}.adjacent", got(allowed, list(row.adjacent)))
        if row.mfd is None and row.piecewise_mfd is None and self.mfd is None:
            remedy = "missing; add a table [regions.mfd], or [mfd] for all regions"
            raise Problem(f"{where}.mfd", remedy)
        if row.mfd is not None and row.piecewise_mfd is not None:
            raise Problem(f"{where}.mfd", "there is piecewise_mfd, too; remove one of them")
        if (row.storage is None) != (row.capacity is None):
            remedy = "capacity and storage belong together; add or remove one"
            raise Problem(f"{where}.capacity", remedy)
        for key in FOR_ALL:
            given = [getattr(other, key) is not None for other in self.regions]
            if any(given) and not given[i]:
                raise Problem(f"{where}.{key}", "missing; give it for every region or for none")
        neighbours = len(row.adjacent)
        lengths = dict.fromkeys(("exit_rates", "dispersions"), count)
        lengths |= dict.fromkeys(("capacity", "controllable"), neighbours)
        for key, length in lengths.items():
            values = getattr(row, key)
            if values is not None and len(values) != length:
                allowed = f"a list of {length} numbers"
                raise Problem(f"{where}.{key}", got(allowed, list(values)))
        for destination, shares in row.observed_split_ratios.items():
            there = destination in map(str, range(count))
            adjacent = set(shares) <= set(map(str, row.adjacent))
            complete = abs(sum(shares.values()) - 1.0) <= 1e-3
            if not (there and adjacent and complete):
                allowed = f"destination = {{ one of {list(row.adjacent)} = share, ... }} with sum 1"
                key = f"{where}.observed_split_ratios.{destination}"
                raise Problem(key, got(allowed, shares))


def load_network(folder: Path | str) -> RegionalModel:
    """Read `folder`/network.toml, or a shipped network by its name.

    >>> network = load_network("hexagon7")
    >>> network.regions, network.u_min, network.u_max
    (7, 0.1, 0.9)
    >>> network.nominal_splits[2, :, 4]  # from west to east through the centre
    array([0., 0., 0., 1., 0., 0., 0.])

    Raises: InputError
    """
    folder = shipped.found(folder, shipped.NETWORK)
    path = folder / "network.toml"
    table = config.checked(NetworkTable, config.read(path), path)
    network = _network(table, folder)
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        problem = f"region {j} cannot be reached from region {i}; connect them with adjacent"
        raise config.error(path, "regions", problem)
    for (i, j), shares in network.observed_split_ratios.items():
        for h in shares:
            if not network.split_mask[i, h, j]:
                key = f"regions[{i}].observed_split_ratios.{j}"
                raise config.error(path, key, f"region {h} leads back into {i}; remove it")
    return network


def _network(table: NetworkTable, folder: Path) -> RegionalModel:
    """Return the regional model of a checked network.toml."""
    rows = table.regions
    adjacency = np.zeros((len(rows), len(rows)), dtype=bool)
    ratios = {}
    critical_above = {}
    for i, row in enumerate(rows):
        adjacency[i, list(row.adjacent)] = True
        for j, shares in row.observed_split_ratios.items():
            ratios[i, int(j)] = {int(h): share for h, share in shares.items()}
        if row.critical_above is not None:
            critical_above[i] = row.critical_above
    dispersions = _by_region(rows, "dispersions")
    curves = [row.piecewise_mfd or row.mfd or table.mfd for row in rows]
    doubts = tuple(row.doubts for row in rows)
    if not any(doubts):
        doubts = ()
    return RegionalModel(
        name=table.name,
        region_names=tuple(row.name or str(i) for i, row in enumerate(rows)),
        positions=np.array([row.position for row in rows]),
        adjacency=adjacency,
        mfds=tuple(curve.mfd for curve in curves),  # type: ignore[union-attr]  # `_check_region`
        u_min=table.perimeter.min,
        u_max=table.perimeter.max,
        observed_split_ratios=ratios,
        exit_rates=_by_region(rows, "exit_rates"),
        capacity=_by_boundary(rows, "capacity"),
        storage=_by_region(rows, "storage"),
        controllable=_by_boundary(rows, "controllable"),
        critical_above=critical_above,
        equal_ways=table.equal_ways,
        dispersion=table.dispersion if dispersions is None else dispersions,
        longest_delay=table.longest_delay,
        placeholder=table.placeholder,
        doubts=doubts,
        held_out=None if table.held_out is None else table.held_out.held_out,
        folder=folder,
    )


def _by_region(rows: Sequence[RegionTable], key: str) -> Any:
    """Return the values of a key as an array, a row per region, or None."""
    values = [getattr(row, key) for row in rows]
    if values[0] is None:
        return None
    return np.array(values)


def _by_boundary(rows: Sequence[RegionTable], key: str) -> PerPair | None:
    """Return the values of a key as a matrix, or None.

    A row of the table has them in the order of `adjacent`.
    """
    if getattr(rows[0], key) is None:
        return None
    matrix = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        matrix[i, list(row.adjacent)] = getattr(row, key)
    return matrix


def check_step(network: RegionalModel, step: float, where: str) -> None:
    """Check that Euler keeps accumulations non-negative: step * q <= 1.

    step: integration step (s)
    where: what the message of an error begins with

    Raises: InputError
    """
    for region, fastest in enumerate(network.fastest_rates.tolist()):
        if step * fastest > 1.0:
            raise InputError(
                f"{where}: step: an integration step of {step:g} s is too long for region {region} "
                f"of network {network.name}, whose vehicles leave at {fastest:.3g} 1/s; allowed is "
                f"at most {1.0 / fastest:.3g} s: raise substeps or shorten step"
            )


def network_toml(network: RegionalModel, sumo: Mapping[str, str], comment: str) -> str:
    """Return the text of a network.toml.

    sumo: table [sumo], the simulated city
    comment: first lines of the file, without the first "# "
    """
    observed: list[list] = [[] for _ in range(network.regions)]
    for (i, j), shares in sorted(network.observed_split_ratios.items()):
        observed[i].append((j, shares))
    values = {"network": network, "sumo": sumo, "comment": comment, "observed": observed}
    return filled(Path(__file__).with_name("network.toml.j2"), **values)
