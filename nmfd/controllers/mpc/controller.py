"""Economic MPC: the least total time spent over a horizon.

As in Tumu et al.: perimeter control alone ("mpc-pc") or with route guidance ("mpc-pcrg"), on the
regional model, with the demand known ahead. Nothing beyond the horizon counts unless there is a
terminal cost (terminal.py).

Unlike there: single shooting, so that only the controls are unknown, with exact gradients by the
adjoint method (edge_model.py) and projected gradients (projected_gradient.py). Nearly all controls
end at a bound; a few gradients find out which.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import model_validator

from nmfd.arrays import PerPair, PerTurn
from nmfd.controllers.base import FileKind, Options
from nmfd.controllers.mpc import edge_model
from nmfd.controllers.mpc.edge_model import (
    Decision,
    Demands,
    PerCell,
    Plan,
    Turns,
    affected_vehicles,
)
from nmfd.controllers.mpc.projected_gradient import AT_REST, TIME_LIMIT, Late, Minimum, minimise
from nmfd.controllers.mpc.terminal import Terminal, read
from nmfd.controllers.rules import PiGate, scenario_gate
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.config import Problem, setting, whole
from nmfd.types import Controls, Observation, Status

if TYPE_CHECKING:
    from nmfd.controllers.mpc.ipopt import Ipopt

MAX_ITERATIONS = 1000  # of the solver, per decision
# Width of the rounded kink of the MFDs in the solver, as a share of the smallest jam accumulation.
JAM_ROUNDING = 0.005
# Relative tolerance: to first order, no admissible plan saves more of the total time spent. A tenth
# of it changes the benchmark's total time spent by less than 1 %. At its limits the solver may stop
# at ACCEPTABLE_TOLERANCE.
TOLERANCE = 1e-6
ACCEPTABLE_TOLERANCE = 1e-5
TERMINAL_TOLERANCE = 1e-4  # with a terminal cost, which is no more exact
VALUE = FileKind("value function", ".npz", "python scenarios/economic_mpc/terminal_cost.py {name}")
FAILED = Status.SOLVER_FAILURE | Status.FALLBACK
DEADLINE_SHARE = 0.9  # of the deadline for the solver
# Added to the vehicles that a control affects, which scale the solver's steps.
METRIC_OFFSET_VEH = 5.0


class EconomicMpc(Options):
    """Economic model predictive control, run by `MpcController`.

    >>> nmfd.run("economic_mpc", nmfd.EconomicMpc(horizon=4), steps=1).controller
    'mpc-pc(horizon=4)'
    """

    guidance: bool = setting("route guidance besides perimeter control", False)
    terminal: bool = setting("with a terminal cost, read from the scenario's folder", False)
    horizon: int = whole("horizon of the plan, in control intervals", 8, low=2, high=1000)
    control_horizon: int | None = whole(
        "intervals with controls of their own, of which the last hold on; by default all",
        None,
        low=1,
        high=1000,
    )
    solver: Literal["projected-gradient", "ipopt"] = setting(
        "ipopt: the published formulation, as a reference, a hundred times slower",
        "projected-gradient",
    )
    anyway: bool = setting('plan with a model that predicts worse than "as now", too', False)

    @model_validator(mode="after")
    def _fits_together(self) -> "EconomicMpc":
        if self.control_horizon is not None and self.solver == "ipopt":
            raise Problem(
                "control_horizon",
                "ipopt has controls of its own in every interval; omit one of the keys",
            )
        if self.terminal and self.solver == "ipopt":
            raise Problem("solver", "ipopt has no terminal cost; omit it")
        return self

    @property
    def reads(self) -> FileKind | None:
        return VALUE if self.terminal else None

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return a model that is not worth planning with as a problem."""
        network = planning.network
        if not network.misleads or self.anyway:
            return None
        problem = f"the model {network.name}: {network.misleads}"
        return Problem("anyway", f"{problem}; set anyway = true to plan with it")

    def make(self, planning: PlanningModel) -> "MpcController":
        return MpcController(planning, self)

    def load(self, file: Path, planning: PlanningModel, scenario: Scenario) -> "MpcController":
        name = "mpc-pcrg-terminal" if self.guidance else "mpc-pc-terminal"
        return MpcController(planning, self, terminal=read(file, planning, name))


class Admissible:
    """Set of admissible plans (K, E + V).

    u is within its bounds. theta lies in simplices, or is nominal without guidance.
    """

    def __init__(self, network: RegionalModel, model: Turns, *, guidance: bool):
        self._network = network
        self._model = model
        self._guidance = guidance
        self._edges = len(model.edges)

    def open(self, moves: int) -> Plan:
        """Return the plan without control: open perimeter, nominal splits."""
        perimeter = np.full(self._edges, self._network.u_max)
        return np.tile(np.concatenate([perimeter, self._model.own]), (moves, 1))

    def project(self, plan: Plan) -> Plan:
        """Return the nearest admissible plan."""
        network = self._network
        perimeter = np.clip(plan[:, : self._edges], network.u_min, network.u_max)
        splits = plan[:, self._edges :]
        if self._guidance:
            splits = self._simplices(splits)
        else:
            splits = np.broadcast_to(self._model.own, splits.shape)
        return np.concatenate([perimeter, splits], axis=1)

    def _simplices(self, splits: np.ndarray) -> np.ndarray:
        """Return the nearest shares (K, V) >= 0 with sum 1 in every cell.

        Michelot (1986)
        """
        groups = self._groups(len(splits))
        count = groups.max(initial=-1) + 1
        value = splits.ravel()
        positive = np.ones(len(value), dtype=bool)
        while True:
            surplus = np.bincount(groups, np.where(positive, value, 0.0), count) - 1.0
            level = (surplus / np.maximum(np.bincount(groups, positive, count), 1.0))[groups]
            still = positive & (value > level)
            if still.sum() == positive.sum():
                return np.where(positive, value - level, 0.0).reshape(splits.shape)
            positive = still

    def gap(self, plan: Plan, gradient: Plan) -> float:
        """Return what the best admissible plan saves on the linearised objective."""
        network = self._network
        edges = self._edges
        of_u = gradient[:, :edges]
        best = np.where(of_u > 0, network.u_min, network.u_max)
        saved = float((of_u * (plan[:, :edges] - best)).sum())
        if not self._guidance or not len(self._model.turns):
            return saved
        splits = plan[:, edges:].ravel()
        of_splits = gradient[:, edges:].ravel()
        groups = self._groups(len(plan))
        least = np.full(groups.max() + 1, np.inf)
        np.minimum.at(least, groups, of_splits)
        return saved + float((splits * (of_splits - least[groups])).sum())

    def _groups(self, moves: int) -> np.ndarray:
        """Return the simplex of every share (K * V,).

        There is one for every interval and cell.
        """
        cells = len(self._model.region)
        return (cells * np.arange(moves)[:, None] + self._model.source).ravel()

    def controls(self, decision: Decision) -> tuple[PerPair, PerTurn | None]:
        """Return perimeter (R, R), and splits (R, R, R) or None.

        decision: one interval of a plan (E + V,)
        """
        perimeter = self._network.open_perimeter
        perimeter[tuple(self._model.edges.T)] = decision[: self._edges]
        if not self._guidance:
            return perimeter, None
        splits = self._network.nominal_splits.copy()
        splits[tuple(self._model.turns.T)] = decision[self._edges :]
        return perimeter, splits

    def decision(self, perimeter: PerPair, splits: PerTurn) -> Decision:
        """Return one interval (E + V,) of a plan.

        perimeter: (R, R); splits: (R, R, R)
        """
        of_edges = perimeter[tuple(self._model.edges.T)]
        return np.concatenate([of_edges, splits[tuple(self._model.turns.T)]])


class MpcController:
    """Economic MPC on a regional model and a demand forecast.

    The solver starts from its last plan, shifted by one interval, or from no control if that is
    better. If it stops short of its tolerance, the status says so. Its best plan is used, which is
    no worse than the initial one.

    If the solver fails, or meets its deadline first, the shifted last plan is used as long as it
    lasts; then PI gating, or the open perimeter without a protected region. The backlog counts as
    demand of the first interval.
    """

    def __init__(
        self, planning: PlanningModel, options: EconomicMpc, *, terminal: Terminal | None = None
    ):
        """Make the controller, with the scenario's pi-gating as its fallback.

        terminal: cost beyond the horizon
        Raises: InputError for wrong options of pi-gating
        """
        guidance = options.guidance
        self.name = "mpc-pcrg" if guidance else "mpc-pc"
        if terminal is not None:
            self.name += "-terminal"
        self.options = options
        network = planning.network
        horizon = options.horizon
        self._terminal = terminal
        self._tolerance = TOLERANCE if terminal is None else TERMINAL_TOLERANCE
        self._planning = planning
        self._used = np.flatnonzero(planning.destinations)
        if not len(self._used):
            self._used = np.arange(network.regions)
        self._moves = horizon
        if planning.integrator == "euler" and planning.substeps == 1 and terminal is None:
            # With one Euler step per interval, the last controls move vehicles that do not arrive
            # within the horizon.
            self._moves = horizon - 1
        if options.control_horizon is not None:
            self._moves = min(self._moves, options.control_horizon)
        self._model = edge_model.build(network, self._used, guidance=guidance, **planning.scheme)
        rounded = replace(self._model, rounding=JAM_ROUNDING * min(mfd.jam for mfd in network.mfds))
        self.vehicle_steps = partial(edge_model.vehicle_steps, self._model)  # exact
        self._rounded: Callable = partial(edge_model.vehicle_steps, rounded, gradient=True)
        self.admissible = Admissible(network, self._model, guidance=guidance)
        self._open = self.admissible.open(self._moves)
        self._gating: PiGate | None = None
        if planning.protected:
            self._gating = scenario_gate(planning)
        self.deadline = planning.step  # s: a later answer is of no use
        self._ipopt = None
        if options.solver == "ipopt":
            from nmfd.controllers.mpc.ipopt import Ipopt  # with CasADi and torch

            limits = {"max_iter": MAX_ITERATIONS, "max_wall_time": DEADLINE_SHARE * self.deadline}
            self._ipopt = Ipopt(planning, guidance=guidance, horizon=horizon, limits=limits)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._plan = self._open
        self._left = 0  # intervals of the plan that are still to come
        self._gates = False  # PI gating is in control

    def act(self, observation: Observation) -> Controls:
        deadline = time.perf_counter() + DEADLINE_SHARE * self.deadline
        start, demand = self.forecast(observation)
        beyond = None
        if self._terminal is not None:
            beyond = partial(self._terminal, step=observation.step + self.options.horizon)
        last = self._open
        if self._left:
            last = np.concatenate([self._plan[1:], self._plan[-1:]])
        try:
            if self._left:
                cost = partial(self.vehicle_steps, start, demand, deadline=deadline, beyond=beyond)
                if cost(self._open)[0] < cost(last)[0]:
                    last = self._open
            minimum = self._solve(start, demand, last, deadline, beyond)
        except Late:
            return self._fallback(observation, last, TIME_LIMIT)
        except (ArithmeticError, ValueError, RuntimeError) as failure:
            # NumPy and SciPy raise these; LinAlgError is a ValueError.
            return self._fallback(observation, last, f"solver failed ({type(failure).__name__})")
        known = np.isfinite(minimum.gap)
        reason = minimum.reason
        if known and minimum.gap <= ACCEPTABLE_TOLERANCE * minimum.value:
            reason = None
        no_better = minimum.point is last or not known
        if reason is not None and no_better and reason != AT_REST:
            return self._fallback(observation, last, reason)
        self._plan = minimum.point
        self._left = self._moves - 1
        self._gates = False
        if reason is None:
            return self._first()
        return self._first(Status.SOLVER_FAILURE, f"{reason}: best plan so far used")

    def _fallback(self, observation: Observation, last: Plan, reason: str) -> Controls:
        """Return the controls of an interval without a new plan."""
        self._plan = last
        if self._left:
            self._left -= 1
            return self._first(FAILED, f"{reason}: last plan used")
        controls = self._first(FAILED, f"{reason}: perimeter opened, nominal splits")
        if self._gating is None or not np.isfinite(observation.accumulation).all():
            return controls
        if not self._gates:
            self._gating.reset()
            self._gates = True
        gating = self._gating.act(observation)
        return replace(controls, perimeter=gating.perimeter, note=f"{reason}: pi-gating in control")

    def _first(self, status: Status = Status.OK, note: str = "") -> Controls:
        """Return the controls of the first interval of the plan."""
        perimeter, splits = self.admissible.controls(self._plan[0])
        return Controls(perimeter=perimeter, splits=splits, status=status, note=note)

    def forecast(self, observation: Observation) -> tuple[PerCell, Demands]:
        """Return the cells (veh, (C,)) now and their demand (veh/s, (horizon, C)).

        Cells are numbered as in edge_model.
        """
        planning = self._planning
        horizon = self.options.horizon
        first = min(observation.step, planning.steps)
        known = planning.forecast[first : first + horizon]
        demand = np.zeros((horizon, *known.shape[1:]))
        demand[: len(known)] = known
        demand[0] += observation.backlog / planning.step
        start = np.maximum(observation.accumulation, 0.0)[:, self._used].ravel()
        return start, demand[:, :, self._used].reshape(horizon, -1)

    def _solve(
        self, start: PerCell, demand: Demands, plan: Plan, deadline: float, beyond: Callable | None
    ) -> Minimum:
        """Return the best plan from `plan` on.

        Its value (veh) is that of the rounded model.

        Raises: Late
        """
        if self._ipopt is not None:
            return self._by_ipopt(self._ipopt, start, demand)
        affected = affected_vehicles(self._model, start, demand, plan, deadline=deadline)
        return minimise(
            partial(self._rounded, start, demand, deadline=deadline, beyond=beyond),
            self.admissible.project,
            self.admissible.gap,
            plan,
            metric=(affected + METRIC_OFFSET_VEH) ** 2,
            tolerance=self._tolerance,
            iterations=MAX_ITERATIONS,
            seconds=deadline - time.perf_counter(),
        )

    def _by_ipopt(self, solver: "Ipopt", start: PerCell, demand: Demands) -> Minimum:
        """Return the plan of IPOPT, made admissible.

        IPOPT meets bounds and sums to its tolerance only.
        """
        regions = solver.shape[0]
        state = np.zeros(solver.shape)
        state[:, self._used] = start.reshape(regions, -1)
        forecast = np.zeros((len(demand), *solver.shape))
        forecast[:, :, self._used] = demand.reshape(len(demand), regions, -1)
        perimeter, splits, reason = solver.solve(state, forecast)
        rows = [
            self.admissible.decision(u, theta) for u, theta in zip(perimeter, splits, strict=True)
        ]
        plan = self.admissible.project(np.stack(rows[: self._moves]))
        value, gradient = self._rounded(start, demand, plan)
        gap = self.admissible.gap(plan, gradient)
        return Minimum(point=plan, value=value, gap=gap, reason=reason)
