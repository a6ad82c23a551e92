"""Economic model predictive control: the least total time spent over a horizon of the regional model, by IPOPT.

As in Tumu et al.: perimeter control alone ("mpc-pc") or with route guidance ("mpc-pcrg"), the demand known ahead,
nothing assumed beyond the horizon. Multiple shooting on nmfd.dynamics_casadi with exact second derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nmfd import dynamics_casadi as model
from nmfd import toml
from nmfd.network import Network
from nmfd.scenario import Scenario
from nmfd.types import Controls, Measurement

UNIT = 1000.0       # veh: accumulations in the solver, so that its variables are of the order of 1
ROUNDING = 50.0     # veh: over which the solver sees the kink of the MFD at the jam accumulation rounded off
TOLERANCE = 1e-6    # of the optimality conditions; a tenth changes the benchmark's total time spent by 0.02 %
# Closing a perimeter, or leaving the drivers' own routes, must save this many vehicles for one interval. Far below the
# measurement noise; without it whatever has no effect floats between its bounds, and IPOPT needs twice the iterations.
LEAST_GAIN = 0.1    # veh


@dataclass(frozen=True, kw_only=True)
class Options:
    """The table [controllers.mpc-pc] or [controllers.mpc-pcrg] of scenario.toml.

    horizon: control intervals that the plan looks ahead
    max_iterations: of the solver, per decision
    time_limit: of the solver, per decision [s]; default the control interval, as a later answer would be of no use
    """

    horizon: int
    max_iterations: int
    time_limit: float


def options(scenario: Scenario, name: str) -> Options:
    """The options of controller `name`, checked; InputError for an unknown key or a wrong value."""
    where = "scenario.toml" if scenario.folder is None else scenario.folder / "scenario.toml"
    table = toml.Table(scenario.controller_options.get(name, {}), where, f"controllers.{name}.")
    chosen = Options(
        horizon=table.integer("horizon", 8, low=2), max_iterations=table.integer("max_iterations", 200),
        time_limit=table.number("time_limit", scenario.step, above=0.0))
    table.close()
    return chosen


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What the solver decides in one interval: a vector (C,) [-] of the u_ih of all edges, then theta_ihj of all turns.

    destinations: (J,) int, the j with any demand in the scenario; no vehicle is ever bound elsewhere
    edges: (E, 2) int, the (i, h) with a choice of u_ih
    turns: (V, 3) int, the (i, h, j) with a choice of theta_ihj; none without guidance
    group: (V,) int, the pair (i, j) of every turn, numbered from 0: its shares sum to 1
    perimeter: (R, R) [-], open; splits: (R, R, R) [-], nominal: the values of all that is not decided
    lower, upper: (C,) [-], bounds
    """

    destinations: np.ndarray
    edges: np.ndarray
    turns: np.ndarray
    group: np.ndarray
    perimeter: np.ndarray
    splits: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def decision(self, perimeter: np.ndarray, splits: np.ndarray) -> np.ndarray:
        """The vector of a perimeter (R, R) and splits (R, R, R)."""
        return np.concatenate([perimeter[tuple(self.edges.T)], splits[tuple(self.turns.T)]])

    def controls(self, decision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Perimeter (R, R) and splits (R, R, R) of a vector, admissible also where the vector is so only nearly."""
        perimeter, splits = self.perimeter.copy(), self.splits.copy()
        decision = np.clip(decision, self.lower, self.upper)
        perimeter[tuple(self.edges.T)] = decision[:len(self.edges)]
        if len(self.turns):
            share = np.maximum(decision[len(self.edges):], 1e-9)  # a pair of nothing but zeros is shared equally
            splits[tuple(self.turns.T)] = share / np.bincount(self.group, share)[self.group]
        return perimeter, splits

    def symbols(self, decision: ca.SX) -> tuple[ca.SX, list[ca.SX]]:
        """Perimeter and splits of nmfd.dynamics_casadi; destinations out of use are left out of their sparsity."""
        perimeter = ca.SX(ca.sparsify(ca.DM(self.perimeter)))
        for n, (i, h) in enumerate(self.edges.tolist()):
            perimeter[i, h] = decision[n]
        in_use = np.isin(np.arange(len(self.perimeter)), self.destinations)
        splits = [ca.SX(rows) for rows in model.splits_list(self.splits * in_use)]
        for n, (i, h, j) in enumerate(self.turns.tolist()):
            splits[i][h, j] = decision[len(self.edges) + n]
        return perimeter, splits


def layout(network: Network, destinations: np.ndarray, *, guidance: bool) -> Layout:
    """The decisions that can matter for vehicles bound for `destinations` (J,), with theta among them or nominal."""
    in_use = np.isin(np.arange(network.regions), destinations)
    useful = (network.split_mask if guidance else network.nominal_splits > 0) & in_use
    choice = useful & (useful.sum(axis=1, keepdims=True) > 1) & guidance
    edges, turns = np.argwhere(useful.any(axis=2)), np.argwhere(choice)
    pairs = turns[:, 0] * network.regions + turns[:, 2]
    return Layout(
        destinations=destinations, edges=edges, turns=turns, group=np.unique(pairs, return_inverse=True)[1],
        perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=network.nominal_splits,
        lower=np.concatenate([np.full(len(edges), network.u_min), np.zeros(len(turns))]),
        upper=np.concatenate([np.full(len(edges), network.u_max), np.ones(len(turns))]))


def interval(scenario: Scenario, chosen: Layout, *, substeps: int, rounding: float = 0.0) -> ca.Function:
    """The regional model over `substeps` integration steps: (state, decision, demand) -> state.

    state (R*J,) [UNIT veh] and demand (R*J,) [veh/s]: the columns of the destinations in use, one after the other.
    """
    regions, columns = scenario.network.regions, chosen.destinations.tolist()
    state, demand = (ca.SX.sym(name, regions * len(columns)) for name in ("state", "demand"))
    decision = ca.SX.sym("decision", len(chosen.lower))

    def matrix(vector):
        full = ca.SX(regions, regions)
        full[:, columns] = ca.reshape(vector, regions, len(columns))
        return full

    x = model.advance(
        model.parameters(scenario.network, rounding=rounding), UNIT * matrix(state), matrix(demand),
        *chosen.symbols(decision), scenario.step / scenario.substeps * substeps, integrator=scenario.integrator,
        substeps=substeps)
    return ca.Function("interval", [state, decision, demand], [ca.vec(ca.densify(x)[:, columns]) / UNIT])


def solver(scenario: Scenario, chosen: Layout, moves: int, limits: Options) -> ca.Function:
    """IPOPT on the horizon: variables are the decisions (C, moves) and the state after every integration step.

    Parameters: the state now, then the demand of every interval. The states are nodes without bounds: the model keeps
    them non-negative by itself, and a bound that the dynamics pin (an empty region) has no interior.
    """
    advance = interval(scenario, chosen, substeps=1, rounding=ROUNDING)
    cells, nodes = advance.size1_in(0), limits.horizon * scenario.substeps
    decisions, states = ca.SX.sym("decisions", len(chosen.lower), moves), ca.SX.sym("states", cells, nodes)
    start, demand = ca.SX.sym("start", cells), ca.SX.sym("demand", cells, limits.horizon)
    constraints, state = [], start
    for node in range(nodes):
        k = node // scenario.substeps
        constraints.append(advance(state, decisions[:, min(k, moves - 1)], demand[:, k]) - states[:, node])
        state = states[:, node]
    open_edges, shares = decisions[:len(chosen.edges), :], decisions[len(chosen.edges):, :]
    if len(chosen.turns):
        sums = ca.DM.ones(len(chosen.turns)).T
        member = ca.DM.triplet(chosen.group.tolist(), list(range(len(chosen.turns))), sums.T)
        constraints.append(ca.vec(member @ shares) - 1.0)
    own = chosen.splits[tuple(chosen.turns.T)]
    preference = ca.sum1(ca.vec(1.0 - open_edges)) + ca.sum1(ca.vec(ca.repmat(1.0 - own, 1, moves) * shares))
    time_spent = ca.sum1(ca.vec(states[:, scenario.substeps - 1::scenario.substeps]))
    problem = {
        "x": ca.vertcat(ca.vec(decisions), ca.vec(states)), "p": ca.vertcat(start, ca.vec(demand)),
        "f": time_spent + LEAST_GAIN / UNIT * preference, "g": ca.vertcat(*constraints)}
    return ca.nlpsol("solver", "ipopt", problem, {
        "print_time": False, "ipopt": {
            "print_level": 0, "sb": "yes", "tol": TOLERANCE, "max_iter": limits.max_iterations,
            "max_wall_time": limits.time_limit}})


class EconomicMpc:
    """Economic MPC on the scenario's own regional model and demand (nmfd.types.Controller).

    The last plan, moved on by one interval, is where the solver starts and what its answer is compared with on the
    exact model. Where the solver does not converge, the status gives its reason and what is done instead: its
    unfinished plan if that is better than the last one, else the last one for as long as it reaches, else the
    perimeter opened and nominal splits. `backlog` counts as demand of the first interval.
    """

    def __init__(self, scenario: Scenario, *, guidance: bool):
        """InputError for a wrong option or a scenario without demand (an optimum of nothing)."""
        self.name = "mpc-pcrg" if guidance else "mpc-pc"
        self._guidance, self._step = guidance, scenario.step
        self._options = options(scenario, self.name)
        destinations = np.flatnonzero(scenario.demand.sum(axis=(0, 1)) > 0)
        self._layout = layout(scenario.network, destinations, guidance=guidance)
        after = np.zeros((self._options.horizon, *scenario.demand.shape[1:]))
        self._demand = np.concatenate([scenario.demand, after])
        # With one Euler step per interval, the last controls move vehicles that the horizon does not see arrive.
        blind = scenario.integrator == "euler" and scenario.substeps == 1
        self._moves = self._options.horizon - 1 if blind else self._options.horizon
        self._substeps = scenario.substeps
        self._advance = interval(scenario, self._layout, substeps=1)
        self._solver = solver(scenario, self._layout, self._moves, self._options)
        self._open = np.tile(self._layout.decision(self._layout.perimeter, self._layout.splits), (self._moves, 1))
        self.reset()

    def reset(self) -> None:
        self._plan, self._left = self._open, 0

    def act(self, measurement: Measurement) -> Controls:
        state, demand = self._forecast(measurement)
        plan = np.vstack([self._plan[1:], self._plan[-1:]]) if self._left > 0 else self._open
        self._left = max(self._left - 1, 0)
        found, reason = self._solve(state, demand, plan)
        better = self._cost(state, demand, found) < self._cost(state, demand, plan)
        if better or reason is None:
            self._left = self._moves
        if reason is None:
            status = "ok"
        elif better:
            status = f"{reason}: unfinished plan used"
        else:
            status = f"{reason}: last plan used" if self._left else f"{reason}: perimeter opened, nominal splits"
        self._plan = found if better else plan
        perimeter, splits = self._layout.controls(self._plan[0])
        return Controls(perimeter=perimeter, splits=splits if self._guidance else None, status=status)
