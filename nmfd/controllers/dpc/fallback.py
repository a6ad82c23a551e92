"""A policy that is watched: where it cannot be trusted, PI gating takes over, and where its guidance does not pay,
drivers go by travel times alone.

It is not trusted where the state has left what it was trained on, where the regional model that it was trained on no
longer predicts the city, and where that model expects it to do worse than no control. What its split ratios add to the
drivers' own choice is judged by what the model says that they gain, and by what came of it (`Judge`).
"""

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nmfd import tensors
from nmfd.arrays import PerPair
from nmfd.controllers.dpc.policy import DpcController, Policy
from nmfd.controllers.dpc.policy_file import check_guidance, load_policy
from nmfd.controllers.pi_gating import PiGating
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation, Status

# Added to the variance of every normalised state: 2 % of the critical accumulation is no departure, even in an entry
# that was always empty in training.
TOLERANCE = 0.02
QUANTILE = 0.999  # of the training states that count as inside
PATIENCE = 4  # control intervals in a row inside before the policy is trusted again
MOST_ERROR = 0.25  # of the critical accumulations: of predictions for the next interval, root mean square of regions
MEMORY = 0.5  # of the squared errors before
LOOK_AHEAD = 40  # control intervals; gating costs something at first, and pays later
MOST_LOSS = 0.05  # of the total time spent without control, in that time
JUDGED = 10  # control intervals after which split ratios are judged by what came of them
TOLERATED = 0.01  # of the time spent in them: errors of the model that are no fault of the split ratios


def statistics(states: Float[np.ndarray, "N C"]) -> dict[str, torch.Tensor]:
    """What a checkpoint keeps of the training states (N, R*R) [-], each divided by the policy's scale.

    mean (R*R,), precision (R*R, R*R): of the Mahalanobis distance; limit: the QUANTILE of it in training.
    """
    mean = states.mean(axis=0)
    precision = np.linalg.inv(np.cov(states, rowvar=False) + TOLERANCE**2 * np.eye(states.shape[1]))
    far = states - mean
    squares = ((far @ precision) * far).sum(axis=1)
    return {
        "mean": torch.from_numpy(mean),
        "precision": torch.from_numpy(precision),
        "limit": torch.tensor(float(np.sqrt(np.quantile(squares, QUANTILE))), dtype=torch.float64),
    }


@dataclass(frozen=True, kw_only=True)
class Foreseen:
    """Vehicles in the network [veh] at the end of each of the next LOOK_AHEAD control intervals, by the regional model.

    policy: under the policy; gates: with its gates and the drivers' own split ratios; none: without control
    """

    policy: Float[np.ndarray, " T"]
    gates: Float[np.ndarray, " T"]
    none: Float[np.ndarray, " T"]

    @property
    def loss(self) -> float:
        """By how much the policy is expected to exceed the total time spent without control, as a share of it [-]."""
        return float(self.policy.sum() / max(self.none.sum(), 1.0)) - 1.0

    def claim(self, intervals: int = LOOK_AHEAD) -> float:
        """What the policy's split ratios gain in so many intervals, as a share of the time spent without them [-]."""
        return 1.0 - float(self.policy[:intervals].sum() / max(self.gates[:intervals].sum(), 1.0))


class Judge:
    """Whether split ratios other than the drivers' own are worth commanding.

    They are not where the regional model expects them to cost time within LOOK_AHEAD intervals; nor where they have
    cost more, within JUDGED intervals, than they were expected to gain: where the time spent exceeds what was foreseen
    with them by so much more than it does without. Both must have been seen for that: what the model misses either way,
    such as demand that is not as forecast, is no fault of the split ratios. (With what had not been seen taken as
    foreseen exactly, noise of 1 veh/s on the demand of economic_mpc ended guidance, and the network locked.)
    """

    def __init__(self) -> None:
        self.commanded = False  # in this interval
        self._missed: dict[bool, float] = {}  # as shares of what was foreseen [-], by whether commanded
        self._claimed = 0.0  # for the intervals that were judged [-]
        self._open: deque[list[float]] = deque(maxlen=JUDGED)  # foreseen, claimed, and measured so far [veh]

    def see(self, observation: Observation) -> None:
        """Take note of what has come of the controls so far."""
        for entry in self._open:
            entry[2] += _vehicles(observation)
        if len(self._open) == JUDGED:
            foreseen, claimed, measured = self._open.popleft()
            missed = measured / max(foreseen, 1.0) - 1.0
            before = self._missed.get(self.commanded, missed)
            self._missed[self.commanded] = MEMORY * before + (1.0 - MEMORY) * missed
            if self.commanded:
                self._claimed = MEMORY * self._claimed + (1.0 - MEMORY) * claimed

    @property
    def shortfall(self) -> float:
        """By how much the split ratios have cost more than they were expected to gain, as a share of the time spent
        [-]; of those that were to pay later no early gain is asked for."""
        if len(self._missed) < 2:
            return 0.0
        return self._missed[True] - self._missed[False] - max(self._claimed, 0.0)

    def problem(self, foreseen: Foreseen) -> str:
        """Why the policy's split ratios are not worth commanding now; "" if they are."""
        if foreseen.claim() < 0.0:
            return f"split ratios expected to cost {-100 * foreseen.claim():.1f} %"
        if self.shortfall > TOLERATED:
            return f"split ratios have cost {100 * self.shortfall:.1f} %"
        return ""

    def command(self, chosen: bool, foreseen: Foreseen, observation: Observation) -> None:
        """Take note of what is commanded now: with the policy's split ratios, or without."""
        if chosen != self.commanded:
            self._open.clear()  # a time with both tells nothing of either
        self.commanded = chosen
        inside = float((foreseen.policy if chosen else foreseen.gates)[:JUDGED].sum())
        waiting = JUDGED * float(observation.backlog.sum())
        self._open.append([inside + waiting, foreseen.claim(JUDGED), 0.0])


def _vehicles(observation: Observation) -> float:
    """In the network and waiting to enter it [veh]: no policy shall look good by keeping them out."""
    return float(observation.accumulation.sum() + observation.backlog.sum())


class Guarded:
    """A policy with PI gating behind it (nmfd.types.Controller).

    Outside: the Mahalanobis distance of the measured state from the training states is beyond its limit, the last
    predictions missed by more than MOST_ERROR, or the total time spent over the next LOOK_AHEAD intervals of the
    regional model, from the measured state under the forecast demand, is more than MOST_LOSS above that without
    control. PI gating starts anew with an open perimeter when it takes over, and hands back after PATIENCE intervals
    inside. A policy that guides routes leaves guidance by travel times behind it: with PI gating, and wherever the
    Judge finds that its split ratios do not pay.
    """

    def __init__(self, policy: Policy, states: dict[str, torch.Tensor], planning: PlanningModel):
        self._policy, self._fallback, self._network = DpcController(policy), PiGating(planning), policy
        self.name = f"{self._policy.name}-guarded"
        self._scale = policy.scale.numpy().astype(float)
        self._mean, self._precision = states["mean"].numpy(), states["precision"].numpy()
        self._limit = float(states["limit"])
        self._planning, network = planning, planning.network
        self._model = dynamics.parameters(network, dtype=torch.float32)
        self._demand = torch.tensor(planning.forecast, dtype=torch.float32)
        self._open = torch.tensor(np.where(network.adjacency, network.u_max, 0.0), dtype=torch.float32)
        self._own = torch.tensor(network.nominal_splits, dtype=torch.float32)
        self._drivers = network.nominal_splits if policy.architecture.guidance else None
        self.reset()

    @property
    def fault(self) -> str | None:
        """Of the policy, injected (nmfd.faults)."""
        return self._policy.fault

    @fault.setter
    def fault(self, kind: str | None) -> None:
        self._policy.fault = kind

    def reset(self, seed: int = 0) -> None:
        self._policy.reset(seed)
        self._left = 0  # intervals that PI gating keeps the control for
        self._judge = Judge()
        self._error = 0.0  # squared, of the predictions so far
        self._predicted: np.ndarray | None = None  # accumulations (R,) at the end of this interval

    def distance(self, accumulation: PerPair) -> float:
        """Mahalanobis distance of accumulation (R, R) [veh] from the training states, as a share of its limit."""
        far = (accumulation / self._scale).ravel() - self._mean
        return float(np.sqrt(far @ self._precision @ far)) / self._limit

    def act(self, observation: Observation) -> Controls:
        foreseen = self.foresee(observation)
        self._judge.see(observation)
        problem = self._problem(observation, foreseen)
        if problem:
            if self._left == 0:
                self._fallback.reset()
            self._left = PATIENCE
        elif self._left > 0:
            self._left -= 1
        if self._left == 0:
            controls = self._judged(self._policy.act(observation), foreseen, observation)
        else:
            reason = problem or f"inside again for {PATIENCE - self._left} of {PATIENCE} intervals"
            controls = replace(
                self._fallback.act(observation),
                splits=self._drivers,
                status=Status.FALLBACK,
                note=f"guard: {reason}, pi-gating in control",
            )
        self._predict(observation, controls)
        return controls

    def _judged(self, controls: Controls, foreseen: Foreseen, observation: Observation) -> Controls:
        """`controls` of the policy, without its split ratios where they do not pay."""
        if controls.splits is None:
            return controls
        problem = self._judge.problem(foreseen)
        self._judge.command(not problem, foreseen, observation)
        if not problem:
            return controls
        return replace(
            controls,
            splits=self._drivers,
            prices=None,
            status=controls.status | Status.FALLBACK,
            note=f"guard: {problem}, the drivers' own instead",
        )

    def _problem(self, observation: Observation, foreseen: Foreseen) -> str | None:
        """Why the policy is not to be trusted now."""
        if self._predicted is not None:
            missed = (observation.accumulation.sum(axis=1) - self._predicted) / self._scale[:, 0]
            self._error = MEMORY * self._error + (1.0 - MEMORY) * float((missed**2).mean())
        if (distance := self.distance(observation.accumulation)) > 1.0:
            return f"state at {distance:.2f} of the limit"
        if (error := self._error**0.5) > MOST_ERROR:
            return f"predictions miss by {100 * error:.0f} % of the critical accumulation"
        if foreseen.loss > MOST_LOSS:
            return f"expected to take {100 * foreseen.loss:.0f} % more time than no control"
        return None

    def foresee(self, observation: Observation) -> Foreseen:
        """What the regional model expects from the measured state on, under the forecast demand."""
        x = torch.from_numpy(np.maximum(observation.accumulation, 0.0)).float().expand(3, -1, -1)
        first, totals = min(observation.step, len(self._demand) - 1), []
        unlimited = torch.full_like(x[:1].sum(-1), torch.inf)
        with torch.inference_mode():
            waiting = torch.zeros_like(x)
            for demand in self._demand[first : first + LOOK_AHEAD]:
                (perimeter, splits), metering = self._network(x[:2]), self._network.metering(x[:2])
                own = self._own.expand(3, -1, -1, -1)
                entering, waiting = dynamics.admitted(
                    waiting,
                    demand.expand_as(x),
                    None if metering is None else torch.cat([metering, unlimited]),
                    self._planning.step,
                )
                x = self._advance(
                    x,
                    entering,
                    torch.cat([perimeter, self._open[None]]),
                    own if splits is None else torch.cat([splits[:1], own[1:]]),
                )
                totals.append((x + waiting).sum((1, 2)))
        policy, gates, none = torch.stack(totals, dim=-1).numpy().astype(float)
        return Foreseen(policy=policy, gates=gates, none=none)

    def _predict(self, observation: Observation, controls: Controls) -> None:
        splits = self._own if controls.splits is None else torch.from_numpy(controls.splits).float()
        demand = self._demand[min(observation.step, len(self._demand) - 1)]
        with torch.inference_mode():
            if controls.metering is not None:
                demand, _ = dynamics.admitted(
                    torch.from_numpy(observation.backlog).float(),
                    demand,
                    torch.from_numpy(controls.metering).float(),
                    self._planning.step,
                )
            x = self._advance(
                torch.from_numpy(observation.accumulation).float(),
                demand,
                torch.from_numpy(controls.perimeter).float(),
                splits,
            )
        self._predicted = x.sum(-1).numpy().astype(float)

    def _advance(
        self, x: tensors.PerPair, demand: tensors.PerPair, perimeter: tensors.PerPair, splits: tensors.PerTurn
    ) -> tensors.PerPair:
        planning = self._planning
        return dynamics.advance(
            self._model,
            x,
            demand,
            perimeter,
            splits,
            planning.step,
            integrator=planning.integrator,
            substeps=planning.substeps,
        )


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> Guarded:
    """The policy in `path`, guarded. InputError as dpc.load, and if the file holds no statistics of its training."""
    policy, content = load_policy(path, planning.network)
    check_guidance(policy, path, guidance)
    if "states" not in content:
        raise InputError(f"{path}: holds no statistics of its training states; train it again with 'nmfd train'")
    try:
        return Guarded(policy, content["states"], planning)
    except (KeyError, TypeError, AttributeError, RuntimeError):
        raise InputError(
            f"{path}: states: are damaged or of another version; train it again with 'nmfd train'"
        ) from None
