"""Economic model predictive control: the least total time spent over a horizon of the regional model.

As in Tumu et al.: perimeter control alone ("mpc-pc") or with route guidance ("mpc-pcrg"), the demand known ahead,
nothing assumed beyond the horizon, unless a terminal cost says what comes ("mpc-pc-terminal", terminal.py). Not as
there: single shooting, so that only the controls are unknown, with exact gradients by the adjoint method (edge_model),
and projected gradients (projected_gradient). Every control is bounded or in a simplex and acts linearly on the model,
so that nearly all of them end at a bound; finding out which takes a few gradients, while an interior-point method
factorises the whole horizon some twenty times.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import model_validator

from nmfd.arrays import PerPair, PerTurn
from nmfd.controllers.mpc import edge_model
from nmfd.controllers.mpc.edge_model import Decision, Demands, PerCell, Plan, Turns
from nmfd.controllers.mpc.ipopt import Ipopt
from nmfd.controllers.mpc.projected_gradient import AT_REST, TIME_LIMIT, Late, Minimum, minimise
from nmfd.controllers.mpc.terminal import Terminal, read
from nmfd.controllers.rules import PiGating
from nmfd.errors import InputError
from nmfd.model.planning import Options, PlanningModel, options
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.config import Problem, setting, whole
from nmfd.types import Controls, Observation, Status

MAX_ITERATIONS = 1000  # of the solver, per decision
ROUNDING = 0.005  # of the smallest jam accumulation: over which the solver sees the kink of the MFD there rounded off
# The solver stops when, to first order, no admissible plan can save more than this share of the total time spent. A
# tenth changes the benchmark's total time spent by less than 1 %, either way. At its limits it may stop at ACCEPTABLE.
TOLERANCE = 1e-6
ACCEPTABLE = 1e-5
FAILED = Status.SOLVER_FAILURE | Status.FALLBACK
# With a terminal cost, which is no more exact than that, the same sums count what lies beyond the horizon as well: a
# hundredth of it changes the benchmark's total time spent by 0.1 %, and takes ten times as long.
COARSE = 1e-4
TERMINAL = "-terminal"  # behind the name
IN_TIME = 0.9  # share of the deadline that the solver has; the rest is for what becomes of its plan
FEW = 5.0  # veh: added to the vehicles that a control decides on, where these scale the solver's steps


class Mpc(Options):
    """Of model predictive control."""

    horizon: int = whole("control intervals that the plan looks ahead", 8, low=2, high=1000)
    control_horizon: int | None = whole(
        "control intervals with controls of their own, the last of which stay in force over the rest of the horizon; "
        "without it, all of them",
        None,
        low=1,
        high=1000,
    )
    solver: Literal["projected-gradient", "ipopt"] = setting(
        "ipopt: the published formulation by CasADi and IPOPT, two orders of magnitude slower: the reference",
        "projected-gradient",
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "Mpc":
        if self.control_horizon is not None and self.solver == "ipopt":
            raise Problem("control_horizon", "ipopt has controls of its own in every interval; omit one of the keys")
        return self


class Admissible:
    """The plans (K, E + V) of edge_model that a controller may choose: u in its bounds, theta in simplices.

    Without guidance theta is the nominal one.
    """

    def __init__(self, network: RegionalModel, model: Turns, *, guidance: bool):
        self._network, self._model, self._guidance = network, model, guidance
        self._edges = len(model.edges)
        unused = np.setdiff1d(np.arange(network.regions), model.destinations)
        self._unused = (slice(None), slice(None), unused)

    def open(self, moves: int) -> Plan:
        """The plan without control: perimeters open, nominal splits."""
        return np.tile(np.concatenate([np.full(self._edges, self._network.u_max), self._model.own]), (moves, 1))

    def project(self, plan: Plan) -> Plan:
        """The nearest admissible plan."""
        perimeter = np.clip(plan[:, : self._edges], self._network.u_min, self._network.u_max)
        if not self._guidance:
            return np.concatenate([perimeter, np.broadcast_to(self._model.own, plan[:, self._edges :].shape)], axis=1)
        return np.concatenate([perimeter, self._simplices(plan[:, self._edges :])], axis=1)

    def _simplices(self, splits: np.ndarray) -> np.ndarray:
        """The nearest shares (K, V) >= 0 whose sum is 1 over the turns of every cell (Michelot, 1986)."""
        groups, value = self._groups(len(splits)), splits.ravel()
        count = groups.max(initial=-1) + 1
        positive = np.ones(len(value), dtype=bool)
        while True:
            surplus = np.bincount(groups, np.where(positive, value, 0.0), count) - 1.0
            level = (surplus / np.maximum(np.bincount(groups, positive, count), 1.0))[groups]
            still = positive & (value > level)
            if still.sum() == positive.sum():
                return np.where(positive, value - level, 0.0).reshape(splits.shape)
            positive = still

    def gap(self, plan: Plan, gradient: Plan) -> float:
        """What the best admissible plan would save if the objective were linear [its unit]."""
        u, of_u = plan[:, : self._edges], gradient[:, : self._edges]
        saved = float((of_u * (u - np.where(of_u > 0, self._network.u_min, self._network.u_max))).sum())
        if not self._guidance or not len(self._model.turns):
            return saved
        splits, of_splits = plan[:, self._edges :], gradient[:, self._edges :]
        groups = self._groups(len(plan))
        least = np.full(groups.max() + 1, np.inf)
        np.minimum.at(least, groups, of_splits.ravel())
        return saved + float((splits.ravel() * (of_splits.ravel() - least[groups])).sum())

    def _groups(self, moves: int) -> np.ndarray:
        """(K * V,) int: the simplex, one per interval and cell, of every share."""
        cells = len(self._model.region)
        return (cells * np.arange(moves)[:, None] + self._model.source).ravel()

    def controls(self, decision: Decision) -> tuple[PerPair, PerTurn | None]:
        """Perimeter (R, R) and splits (R, R, R), or None without guidance, of one interval (E + V,) of a plan."""
        perimeter = np.where(self._network.adjacency, self._network.u_max, 0.0)
        perimeter[tuple(self._model.edges.T)] = decision[: self._edges]
        if not self._guidance:
            return perimeter, None
        splits = np.zeros((self._network.regions,) * 3)
        splits[self._unused] = self._network.nominal_splits[self._unused]
        splits[tuple(self._model.turns.T)] = decision[self._edges :]
        return perimeter, splits

    def decision(self, perimeter: PerPair, splits: PerTurn) -> Decision:
        """One interval (E + V,) of a plan, of perimeter (R, R) and splits (R, R, R)."""
        return np.concatenate([perimeter[tuple(self._model.edges.T)], splits[tuple(self._model.turns.T)]])


class EconomicMpc:
    """Economic MPC on a regional model and a forecast of the demand (nmfd.types.Controller).

    The solver starts from its last plan, moved on by one interval, or from no control where that is better. Where it
    stops short of its tolerance, the status says why; the best plan that it has found, which is never worse than the
    one that it started from, is used. Where it finds none (it fails, diverges, or meets its deadline first), the last
    plan is used, moved on, for as long as it reaches, and then PI gating takes over, or without a protected region the
    open perimeter, until the solver is back. The backlog counts as demand of the first interval; negative measurements
    count as 0.
    """

    def __init__(self, planning: PlanningModel, *, guidance: bool, terminal: Terminal | None = None):
        """terminal: what comes after the horizon. InputError for a wrong option."""
        self.name = _name(guidance, terminal is not None)
        self._terminal = terminal
        self._beyond: Callable[[PerCell], tuple[float, PerCell]] | None = None
        self.options = options(Mpc, planning, self.name)
        network, horizon = planning.network, self.options.horizon
        used = np.flatnonzero(planning.destinations)
        self._regions = network.regions
        self._used = used if len(used) else np.arange(network.regions)
        self._demand, self._step, self._steps = planning.forecast, planning.step, planning.steps
        # With one Euler step per interval, the last controls move vehicles that the horizon does not see arrive.
        blind = planning.integrator == "euler" and planning.substeps == 1 and terminal is None
        self._moves = min(horizon - 1 if blind else horizon, self.options.control_horizon or horizon)
        self._model = edge_model.build(network, self._used, guidance=guidance)
        rounded = replace(self._model, rounding=ROUNDING * min(mfd.jam for mfd in network.mfds))
        scheme: dict = {"step": planning.step, "substeps": planning.substeps, "integrator": planning.integrator}
        self._exact: Callable = partial(edge_model.vehicle_steps, self._model, **scheme)
        self._rounded: Callable = partial(edge_model.vehicle_steps, rounded, gradient=True, **scheme)
        self._affected: Callable = partial(edge_model.affected_vehicles, self._model, **scheme)
        self.admissible = Admissible(network, self._model, guidance=guidance)
        self._open = self.admissible.open(self._moves)
        self._gating = PiGating(planning) if planning.protected else None
        self.deadline = planning.step  # s: a later answer is of no use
        self._ipopt, self._tolerance = None, TOLERANCE if terminal is None else COARSE
        if terminal is not None and self.options.solver == "ipopt":
            raise InputError(
                f"{planning.where}: controllers.{self.name}.solver: ipopt knows no terminal cost; omit it, or use "
                f"{self.name.removesuffix(TERMINAL)}"
            )
        if self.options.solver == "ipopt":
            self._ipopt = Ipopt(
                planning,
                guidance=guidance,
                horizon=horizon,
                iterations=MAX_ITERATIONS,
                seconds=IN_TIME * self.deadline,
            )
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._plan, self._left = self._open, 0  # left: intervals of the plan that are still to come
        self._gates = False  # PI gating is in control

    def act(self, observation: Observation) -> Controls:
        deadline = time.perf_counter() + IN_TIME * self.deadline
        start, demand = self.forecast(observation)
        self._look_beyond(observation.step + self.options.horizon)
        last = np.concatenate([self._plan[1:], self._plan[-1:]]) if self._left else self._open
        try:
            if self._left and self._cheaper(self._open, last, start, demand, deadline):
                last = self._open
            found = self._solve(start, demand, last, deadline)
        except Late:
            return self._without(observation, last, TIME_LIMIT)
        except (ArithmeticError, ValueError, RuntimeError) as error:  # of NumPy and SciPy, LinAlgError too
            return self._without(observation, last, f"solver failed ({type(error).__name__})")
        known = np.isfinite(found.gap)
        reason = None if known and found.gap <= ACCEPTABLE * found.value else found.reason
        if reason is not None and (found.point is last or not known) and reason != AT_REST:
            return self._without(observation, last, reason)
        self._plan, self._left, self._gates = found.point, self._moves - 1, False
        return (
            self._first() if reason is None else self._first(Status.SOLVER_FAILURE, f"{reason}: best plan so far used")
        )

    def _cheaper(self, plan: Plan, than: Plan, start: PerCell, demand: Demands, deadline: float) -> bool:
        """Whether `plan` costs less, by the exact model. Raises Late."""
        return (
            self._exact(start, demand, plan, deadline=deadline, beyond=self._beyond)[0]
            < self._exact(start, demand, than, deadline=deadline, beyond=self._beyond)[0]
        )

    def _look_beyond(self, step: int) -> None:
        """The horizon ends at the beginning of interval `step`."""
        if self._terminal is not None:
            self._beyond = partial(self._terminal, step=step)

    def _without(self, observation: Observation, last: Plan, reason: str) -> Controls:
        """The controls of an interval for which no plan was found."""
        self._plan = last
        if self._left:
            self._left -= 1
            return self._first(FAILED, f"{reason}: last plan used")
        if self._gating is None or not np.isfinite(observation.accumulation).all():
            return self._first(FAILED, f"{reason}: perimeter opened, nominal splits")
        if not self._gates:
            self._gating.reset()
        self._gates = True
        _, splits = self.admissible.controls(self._open[0])
        return replace(
            self._gating.act(observation), splits=splits, status=FAILED, note=f"{reason}: pi-gating in control"
        )

    def _first(self, status: Status = Status.OK, note: str = "") -> Controls:
        """The first interval of the plan."""
        perimeter, splits = self.admissible.controls(self._plan[0])
        return Controls(perimeter=perimeter, splits=splits, status=status, note=note)

    def cost(self, start: PerCell, demand: Demands, plan: Plan) -> float:
        """Total time spent over the horizon [veh s] by the exact model, under a plan (moves, E + V)."""
        return self._step * self._exact(start, demand, plan)[0]

    def forecast(self, observation: Observation) -> tuple[PerCell, Demands]:
        """The cells (C,) [veh] now and the demand (horizon, C) [veh/s] of them, as edge_model numbers them."""
        first, horizon = min(observation.step, self._steps), self.options.horizon
        known = self._demand[first : first + horizon]
        demand = np.zeros((horizon, *known.shape[1:]))
        demand[: len(known)] = known
        demand[0] += observation.backlog / self._step
        held = np.maximum(observation.accumulation, 0.0)
        start = held[:, self._used].ravel()
        return start, demand[:, :, self._used].reshape(horizon, -1)

    def _solve(self, start: PerCell, demand: Demands, plan: Plan, deadline: float) -> Minimum:
        """The best plan found from `plan` (moves, E + V); its value, in vehicles, is that of the rounded model.

        deadline: by time.perf_counter [s]. Raises Late.
        """
        if self._ipopt is not None:
            return self._by_ipopt(self._ipopt, start, demand)
        return minimise(
            partial(self._rounded, start, demand, deadline=deadline, beyond=self._beyond),
            self.admissible.project,
            self.admissible.gap,
            plan,
            metric=(self._affected(start, demand, plan, deadline=deadline) + FEW) ** 2,
            tolerance=self._tolerance,
            iterations=MAX_ITERATIONS,
            seconds=deadline - time.perf_counter(),
        )

    def _by_ipopt(self, solver: Ipopt, start: PerCell, demand: Demands) -> Minimum:
        """The plan of IPOPT, made admissible: it keeps to bounds and sums up to its tolerance only."""
        regions = self._regions
        state, forecast = np.zeros((regions, regions)), np.zeros((len(demand), regions, regions))
        state[:, self._used] = start.reshape(regions, -1)
        forecast[:, :, self._used] = demand.reshape(len(demand), regions, -1)
        perimeter, splits, reason = solver.solve(state, forecast)
        rows = [self.admissible.decision(u, theta) for u, theta in zip(perimeter, splits, strict=True)]
        plan = self.admissible.project(np.stack(rows[: self._moves]))
        value, gradient = self._rounded(start, demand, plan)
        return Minimum(point=plan, value=value, gap=self.admissible.gap(plan, gradient), evaluations=1, reason=reason)


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> EconomicMpc:
    """MPC with the terminal cost in the file `path`. InputError if it is none of this model."""
    return EconomicMpc(planning, guidance=guidance, terminal=read(path, planning, _name(guidance, terminal=True)))


def _name(guidance: bool, terminal: bool) -> str:
    return ("mpc-pcrg" if guidance else "mpc-pc") + TERMINAL * terminal
