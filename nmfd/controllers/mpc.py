"""Economic model predictive control: the least total time spent over a horizon of the regional model, by IPOPT.

As in Tumu et al.: perimeter control alone ("mpc-pc") or with route guidance ("mpc-pcrg"), the demand known ahead,
nothing assumed beyond the horizon. Multiple shooting on nmfd.dynamics_casadi with exact second derivatives.
"""

import signal
import threading
from contextlib import contextmanager
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nmfd import dynamics_casadi as model
from nmfd import toml
from nmfd.network import Network
from nmfd.scenario import Scenario
from nmfd.types import Controls, Measurement

UNIT = 1000.0       # veh: accumulations in the solver, so that its variables are of the order of 1
ROUNDING = 0.005    # of the smallest jam accumulation: over which the solver sees the kink of the MFD there rounded off
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


def step_function(scenario: Scenario, chosen: Layout, *, rounding: float = 0.0) -> ca.Function:
    """One integration step of the regional model, (state, decision, demand) -> state.

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
        *chosen.symbols(decision), scenario.step / scenario.substeps, integrator=scenario.integrator)
    return ca.Function("step", [state, decision, demand], [ca.vec(ca.densify(x)[:, columns]) / UNIT])


def solver(scenario: Scenario, chosen: Layout, moves: int, limits: Options) -> ca.Function:
    """IPOPT on the horizon: variables are the decisions (C, moves) and the state after every integration step.

    Parameters: the state now, then the demand of every interval. The states are nodes without bounds: the model keeps
    them non-negative by itself, and a bound that the dynamics pin (an empty region) has no interior.
    """
    advance = step_function(scenario, chosen, rounding=ROUNDING * min(mfd.jam for mfd in scenario.network.mfds))
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
        member = ca.DM.triplet(chosen.group.tolist(), list(range(len(chosen.turns))), [1.0] * len(chosen.turns))
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
            "max_wall_time": limits.time_limit,
            "mumps_pivot_order": 0}})  # AMD: for these matrices 1.5 times as fast as MUMPS's own choice


class EconomicMpc:
    """Economic MPC on the scenario's own regional model and demand (nmfd.types.Controller).

    The last plan, moved on by one interval, is where the solver starts and what its answer is compared with on the
    exact model. Where the solver does not converge, the status gives its reason and what is done instead: its
    unfinished plan if that is better than the last one, else the last one for as long as it reaches, else the
    perimeter opened and nominal splits. The backlog counts as demand of the first interval; negative measurements
    count as 0.
    """

    def __init__(self, scenario: Scenario, *, guidance: bool):
        """InputError for a wrong option."""
        self.name = "mpc-pcrg" if guidance else "mpc-pc"
        self._guidance, self._step, self._substeps = guidance, scenario.step, scenario.substeps
        chosen = options(scenario, self.name)
        used = np.flatnonzero(scenario.demand.sum(axis=(0, 1)) > 0)
        self._used = used if len(used) else np.arange(scenario.network.regions)
        self._demand = np.concatenate([scenario.demand, np.zeros((chosen.horizon, *scenario.demand.shape[1:]))])
        self._steps, self._horizon = scenario.steps, chosen.horizon
        # With one Euler step per interval, the last controls move vehicles that the horizon does not see arrive.
        blind = scenario.integrator == "euler" and scenario.substeps == 1
        self._moves = chosen.horizon - 1 if blind else chosen.horizon
        self._layout = layout(scenario.network, self._used, guidance=guidance)
        self._advance = step_function(scenario, self._layout)
        self._solver = solver(scenario, self._layout, self._moves, chosen)
        states = np.full(self._advance.size1_in(0) * chosen.horizon * scenario.substeps, np.inf)
        self._lower = np.concatenate([np.tile(self._layout.lower, self._moves), -states])
        self._upper = np.concatenate([np.tile(self._layout.upper, self._moves), states])
        self._open = np.tile(self._layout.decision(self._layout.perimeter, self._layout.splits), (self._moves, 1))
        self.reset()

    def reset(self) -> None:
        self._plan, self._left = self._open, 0  # left: intervals of the plan that are still to come

    def act(self, measurement: Measurement) -> Controls:
        start, demand = self._forecast(measurement)
        last = np.vstack([self._plan[1:], self._plan[-1:]]) if self._left else self._open
        found, reason = self._solve(start, demand, last)
        better = self.cost(start, demand, found) < self.cost(start, demand, last)
        if reason is None:
            status = "ok"
        elif better:
            status = f"{reason}: unfinished plan used"
        else:
            status = f"{reason}: " + ("last plan used" if self._left else "perimeter opened, nominal splits")
        self._plan = found if better else last
        self._left = self._moves - 1 if better or reason is None else max(self._left - 1, 0)
        perimeter, splits = self._layout.controls(self._plan[0])
        return Controls(perimeter=perimeter, splits=splits if self._guidance else None, status=status)

    def cost(self, start: np.ndarray, demand: np.ndarray, plan: np.ndarray) -> float:
        """Total time spent over the horizon [veh s] by the exact model, under a plan (moves, C)."""
        states = self._rollout(start, demand, plan)
        return self._step * UNIT * float(states[self._substeps - 1::self._substeps].sum())

    def _forecast(self, measurement: Measurement) -> tuple[np.ndarray, np.ndarray]:
        """The state (R*J,) [UNIT veh] and the demand (horizon, R*J) [veh/s], in the order of `step_function`."""
        k = min(measurement.step, self._steps)
        demand = self._demand[k:k + self._horizon].copy()
        demand[0] += measurement.backlog / self._step
        start = np.maximum(measurement.accumulation, 0.0)[:, self._used].T.ravel() / UNIT
        return start, demand[:, :, self._used].transpose(0, 2, 1).reshape(self._horizon, -1)

    def _rollout(self, start: np.ndarray, demand: np.ndarray, plan: np.ndarray) -> np.ndarray:
        """The states (horizon * substeps, R*J) [UNIT veh] after every integration step."""
        states = [start]
        for node in range(self._horizon * self._substeps):
            k = node // self._substeps
            states.append(self._advance(states[-1], plan[min(k, self._moves - 1)], demand[k]).full().ravel())
        return np.stack(states[1:])

    def _solve(self, start: np.ndarray, demand: np.ndarray, plan: np.ndarray) -> tuple[np.ndarray, str | None]:
        """An admissible plan (moves, C) from the guess `plan`, and why the solver stopped short, or None."""
        guess = np.concatenate([plan.ravel(), self._rollout(start, demand, plan).ravel()])
        with _interruptible():
            answer = self._solver(
                x0=guess, p=np.concatenate([start, demand.ravel()]), lbx=self._lower, ubx=self._upper, lbg=0.0, ubg=0.0)
        decisions = answer["x"].full().ravel()[:plan.size].reshape(plan.shape)
        found = np.array([self._layout.decision(*self._layout.controls(decision)) for decision in decisions])
        report = self._solver.stats()
        return found, None if report["success"] else report["return_status"]


@contextmanager
def _interruptible():
    """CasADi takes a KeyboardInterrupt inside a solve for a failure of the solver; here Ctrl-C still ends the run."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    seen = []

    def interrupt(number, frame):
        seen.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if seen:
        raise KeyboardInterrupt
