"""Training of DPC policies by gradient descent on the total time spent.

Every step rolls out the regional model under the policy. Rollouts start from random states and
demands, because a rollout that ends in gridlock has no gradient.

Streets (plant "links") begin empty. Where they lock, gradients are rough. So the policy is
validated often there, and goes back to its best weights, with half the learning rate, when it comes
out JUMP worse.
"""

import copy
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Generator, nn
from torch.optim import Adam

from nmfd.controllers.base import check_fit
from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.first_policy import begin_as_gate, begin_as_no_control, first_policy
from nmfd.controllers.dpc.keepers import FileKeeper, Keeper, ModuleKeeper, State
from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.dpc.policy import ModuleController, Policy
from nmfd.controllers.dpc.rollout import Demands, Rollout, States, Trajectories, compiled_step
from nmfd.controllers.dpc.single_changes import SIMPLER, changed_policies
from nmfd.controllers.dpc.street_rollout import StreetRollout
from nmfd.controllers.strategy import Strategy
from nmfd.errors import InputError, RunFailed
from nmfd.model.authority import NO_GATEWAY
from nmfd.model.commands import admissible
from nmfd.model.links.network import LINKS
from nmfd.model.links.plant import link_model
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.config import error
from nmfd.runs.progress import Show
from nmfd.tensors import one_thread
from nmfd.types import Observation

REGIONAL = "nmfd"  # plant
DEMAND_SPREAD = 0.2  # every flow is scaled by a factor drawn from 1 - this to 1 + this
RANDOM_START_SHARE = 0.5  # of the rollouts start from a random state at a random time
VALIDATION_PERIOD = 20  # Adam steps
SCORE = "validation_veh_s"  # of a policy in its file
VALIDATION_ROLLOUTS = 16  # perturbed rollouts in a validation, if training perturbs demand or model
ROUGH_PERIOD = 4  # as VALIDATION_PERIOD, through streets
JUMP = 0.1
WORTH_COMPILING = 200  # Adam steps
# A policy that begins as no control must gain WORTH in validation. Otherwise one is kept whose
# gates have this logit, which is open in every state.
WORTH = 0.03
OPEN_LOGIT = 12.0
# A single change that is better by CHANGE_WORTH after training begins another descent of a compact
# policy. At the end it takes those of SIMPLER that together lose less than this.
CHANGE_WORTH = 0.005
RESTARTS = 2


def settings(scenario: Scenario, strategy: Strategy, steps: int | None = None) -> Dpc:
    """Return the options of a policy to train.

    steps: instead of those of the options
    Raises: InputError
    """
    setup = strategy.options(scenario)
    table = strategy.table(scenario)
    name = strategy.controller.name
    if not isinstance(setup, Dpc):
        problem = "cannot be trained; choose dpc-pc or dpc-pcrg"
        raise InputError(f"--controller: {strategy.name!r} {problem}")
    if table != strategy.name:
        raise InputError(
            f'--controller: {strategy.name!r} needs a table [controllers."{strategy.name}"] in '
            f"{scenario.where} with its differences; add one, or train {name}"
        )
    prefix = f"controllers.{table}."
    check_fit(setup, strategy.own_planning(scenario), f"{scenario.where}: {prefix}")
    if setup.local and setup.guides:
        problem = "a local policy guides no routes; train dpc-pc"
        raise error(scenario.where, f"{prefix}local", problem)
    if setup.prices and not setup.guides:
        raise error(scenario.where, f"{prefix}prices", "prices guide drivers; train dpc-pcrg")
    return setup if steps is None else setup.changed(steps=steps)


def check(scenario: Scenario, strategy: Strategy) -> None:
    """Check that a training is worth its time.

    Raises: InputError without gateways, for placeholder MFDs of the model to train on, or if it
        predicts worse than "as now"
    """
    city = scenario.network
    believed = strategy.planning(scenario).network
    still = "nmfd train --anyway trains all the same (nmfd.train: anyway=True)"
    if city.controllable is not None and not city.controllable.any():
        problem = f"controllable: is 0 at every boundary: {NO_GATEWAY}"
        raise InputError(f"{_file(city)}: {problem}; {still}")
    if believed.placeholder:
        problem = "placeholder: is true: its MFDs are guesses from lanes and speed limits"
        remedy = f"run 'cosim identify {city.folder}' or put in your own"
        raise InputError(f"{_file(believed)}: {problem}; {remedy}; {still}")
    if believed.misleads:
        remedy = "identify it from more runs, or choose rules"
        raise InputError(f"{_file(believed)}: held_out: {believed.misleads}; {remedy}; {still}")


def _file(network: RegionalModel) -> Path | str:
    if network.folder is None:
        return network.name
    return network.folder / "network.toml"


def available(device: str) -> str:
    """Return "cpu" or "cuda"; "auto" is the GPU if there is one.

    Raises: InputError for a missing GPU
    """
    if device == "cpu":
        return "cpu"
    if torch.cuda.is_available():
        return "cuda"
    if device == "cuda":
        raise InputError(
            "--device: cuda asked for, but PyTorch finds no GPU here; choose cpu or auto"
        )
    return "cpu"


@dataclass(frozen=True, kw_only=True)
class Task:
    """Cost, sample and constraints of the user's own; see nmfd.train.

    By default the cost is the total time spent.
    """

    cost: Callable[[Trajectories], torch.Tensor] | None = None
    sample: Callable[[Generator, int], tuple] | None = None
    constraints: Sequence[tuple[Callable[[Trajectories], torch.Tensor], float]] = ()

    def __post_init__(self) -> None:
        parts: tuple[object, ...] = (self.cost, self.sample)
        for part in parts:
            if part is not None and not callable(part):
                raise InputError(
                    f"cost, sample: expected functions, got {self.cost!r} and {self.sample!r}; see "
                    "nmfd.train"
                )
        for pair in self.constraints:
            if not (isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])):
                raise InputError(
                    f"constraints: expected pairs (function, weight), got {pair!r}; add the weight"
                )

    @property
    def own(self) -> str:
        """Names of its parts, "" for the default."""
        parts = [self.cost, self.sample, *(penalty for penalty, _ in self.constraints)]
        given = [part for part in parts if part is not None]
        return ", ".join(getattr(part, "__qualname__", repr(part)) for part in given)


@one_thread()
def train(
    scenario: Scenario,
    strategy: Strategy,
    *,
    seed: int,
    out: Path | None,
    plant: str = REGIONAL,
    module: nn.Module | None = None,
    task: Task = Task(),
    steps: int | None = None,
    resume: bool = False,
    device: str = "cpu",
    compiled: bool = False,
    anyway: bool = False,
    progress: Show = None,
) -> Any:
    """Train the policy of a strategy.

    The best in validation is written to `out`. The same seed gives the same weights.

    plant: "nmfd", the regional model, or "links", the streets of the scenario
    module: trained in place instead of the policy and returned with its best weights; no file is
        written
    resume: continue from the state in `out`.resume
    compiled: compile the step, about twice as fast after a minute or two; the weights differ by
        rounding
    anyway: train even if `check` raises
    progress: called with (done, steps, note) after every step
    """
    setup = settings(scenario, strategy, steps)
    if module is not None:
        _check_module(module, scenario)
    elif not anyway and plant == REGIONAL:
        check(scenario, strategy)
    planning = strategy.own_planning(scenario)
    torch.manual_seed(seed)
    keeper: Keeper
    if module is None:
        assert out is not None
        configuration = _configuration(strategy, planning, setup, task, seed, compiled)
        configuration["plant"] = plant
        if plant == REGIONAL and planning.network.misleads:
            configuration["model_warning"] = planning.network.misleads
        policy = first_policy(setup, planning, guidance=setup.guides)
        keeper = FileKeeper(policy, planning.network, configuration, out)
    else:
        keeper = ModuleKeeper(module)
        setup = setup.changed(from_gating=False, from_no_control=False)  # it begins as it is
    if isinstance(keeper.policy, CompactPolicy) and plant == REGIONAL:
        device = "cpu"  # a few numbers
    dtype = next(keeper.policy.parameters()).dtype
    if plant == LINKS:
        streets = link_model(scenario, labels=strategy.labels, dtype=dtype, device=device)
        rollout: Rollout = StreetRollout(planning, streets)
    else:
        rollout = Rollout(
            planning,
            dtype,
            device,
            detour_cost=setup.detour_cost,
            holding_cost=setup.holding_cost,
            process_std=setup.recipe.process_std,
        )
    run = TrainingRun(keeper, rollout, setup, task, seed, compiled)
    if resume:
        keeper.resume(run.restore)
    else:
        run.prepare(progress)
    run.finish(progress)
    if not math.isfinite(run.best):
        raise RunFailed(
            f"{strategy.name}: every validation of {setup.steps} steps diverged; "
            "lower the learning rate"
        )
    return keeper.finish()


class Change(NamedTuple):
    """Single change of a policy that is better on its own objective.

    score: its validation (veh s)
    gain: share of the total time spent that it saves (-)
    """

    name: str
    policy: Policy
    score: float
    gain: float


def _configuration(
    strategy: Strategy, planning: PlanningModel, setup: Dpc, task: Task, seed: int, compiled: bool
) -> State:
    """Return what a policy file says about its training."""
    configuration = {
        "controller": strategy.name,
        "scenario": planning.name,
        "seed": seed,
        "compiled": compiled,
        **setup.model_dump(exclude={"policy"}),
    }
    if task.own:
        configuration["task"] = task.own
    return configuration


def _check_module(module: nn.Module, scenario: Scenario) -> None:
    """Check a module on an empty city.

    Raises: InputError without weights, or for wrong controls
    """
    is_module = isinstance(module, nn.Module)
    if not is_module or not any(weights.requires_grad for weights in module.parameters()):
        raise InputError(
            f"policy: expected an nn.Module with weights to train, got {module!r:.60}; give one"
        )
    empty = np.zeros(scenario.network.adjacency.shape)
    observation = Observation(step=0, time=0.0, accumulation=empty, backlog=empty)
    controller = ModuleController(module, scenario)
    admissible(controller.act(observation), scenario.network, f"{controller.name}: interval 0")


class TrainingRun:
    """Gradient descent of one policy, with validations and a state.

    done: steps of this descent
    best: lowest validation, total time spent (veh s) or cost of the task; infinite before the first
    bar: what a validation must fall below; None if the policy does not begin as no control
    """

    def __init__(
        self,
        keeper: Keeper,
        rollout: Rollout,
        setup: Dpc,
        task: Task,
        seed: int,
        compiled: bool,
    ):
        self.done = 0
        self.best = math.inf
        self.bar: float | None = None
        self._keeper = keeper
        self._restarts = 0
        self._best_weights: State = {}
        self._setup = setup
        self._recipe = setup.recipe
        self._task = task
        self._seed = seed
        self._generator = Generator().manual_seed(seed)
        self._policy = keeper.policy.to(rollout.device).train()
        self._rollout = rollout
        self._rate = 1.0
        self._advance = compiled_step(rollout.step) if compiled else rollout.step
        self._optimizer = self._new_optimizer()

    def _new_optimizer(self) -> Adam:
        return Adam(
            self._policy.parameters(),
            lr=self._setup.learning_rate,
            weight_decay=self._recipe.weight_decay,
        )

    def prepare(self, progress: Show) -> None:
        """Begin as the settings say: like a gate, or like no control.

        A compact policy begins with the best of its single changes, not in a corner where descent
        finds nothing.
        """
        if isinstance(self._policy, CompactPolicy) and not self._task.own:
            self.validate()
            self._show(progress)
            change = self.better_change()
            while change is not None:
                self._take(change.policy, change.score)
                self._show(progress)
                change = self.better_change()
        if self._setup.from_gating:
            begin_as_gate(self._policy, self._rollout, self._generator)
        if self._setup.from_no_control and not self._task.own:
            # Keep a policy that is always open until one gains WORTH.
            first = copy.deepcopy(self._policy.state_dict())
            network = self._rollout.planning.network
            begin_as_no_control(self._policy, network, weight=0.0, logit=OPEN_LOGIT)
            self.validate()
            self.best *= 1.0 - WORTH
            self.bar = self.best
            self._policy.load_state_dict(first)

    def descend(self, progress: Show) -> None:
        """Take the steps of a descent that are left."""
        steps = self._setup.steps
        period = ROUGH_PERIOD if self._rollout.rough else VALIDATION_PERIOD
        while self.done < steps:
            self.step()
            if self.done % period == 0 or self.done == steps:
                score = self.validate()
                if self._rollout.rough and not score <= self.best * (1.0 + JUMP):
                    self._step_back()
                self._keeper.save(self.state())
            self._show(progress)

    def finish(self, progress: Show) -> None:
        """Descend, and again from a single change that is better."""
        while True:
            self.descend(progress)
            if self.best == self.bar:
                problem = f"no policy gained {WORTH:.0%} on the model: its gates stay open"
                print(f"nmfd: {problem}", file=sys.stderr)
                return
            change = self.better_change()
            if change is None:
                break
            if not self.restart(change):
                problem = f"{change.name} would take {change.gain:.1%} less time on the model"
                print(f"nmfd: the policy misses a single change: {problem}", file=sys.stderr)
                break
        self._simplify()

    def _simplify(self) -> None:
        """Leave out the outputs of a compact policy that gain next to nothing."""
        policy, setup = self._policy, self._setup
        if self._task.own or not isinstance(policy, CompactPolicy) or not self._best_weights:
            return
        policy.load_state_dict(self._best_weights)
        most = self.best * (1.0 + CHANGE_WORTH)
        for name in SIMPLER:
            changed = dict(changed_policies(policy, self._rollout.planning, setup.kept)).get(name)
            if changed:
                score = validate(changed, self._rollout, self._seed, setup)
                if score < most:
                    self._take(changed, score)

    def _step_back(self) -> None:
        """Return to the best weights, with half the learning rate."""
        self._policy.load_state_dict(self._best_weights)
        self._optimizer = self._new_optimizer()
        self._rate *= 0.5

    def _show(self, progress: Show) -> None:
        """Show the steps that are done, and the best validation so far."""
        if progress:
            best = "no validation yet"
            if math.isfinite(self.best):
                unit = "" if self._task.own else " veh s"
                best = f"best {self.best:.4g}{unit}"
            progress(self.done, self._setup.steps, best)

    def step(self) -> None:
        """Take one step of Adam."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * (self.done / self._setup.steps)))
        falling = self._setup.learning_rate * (0.1 + 0.9 * cosine)
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate * (self._recipe.learning_rate or falling)
        batch = self._rollout.batch or self._recipe.batch
        loss = self._loss(self._generator, batch, self._advance)
        if not loss.requires_grad:
            raise InputError(
                "cost: has no gradient by the weights of the policy; "
                "compute it from the run with torch"
            )
        self._optimizer.zero_grad()
        loss.backward()
        self._clear_gradients()
        norm = torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._recipe.clip)
        if self._task.own and not norm.isfinite():
            raise InputError(
                f"{self._task.own}: in step {self.done} the cost is {loss.item():.4g} and the norm "
                f"of its gradient {norm.item():.4g}; look for 0 / 0, log(0) and sqrt(0) in your "
                "own functions"
            )
        self._optimizer.step()
        if isinstance(self._policy, CompactPolicy):
            self._policy.bound()
        self.done += 1

    def _clear_gradients(self) -> None:
        """Clear the gradients of all that this step leaves alone.

        These are the kept numbers of a compact policy, and the decoders whose turn it is not.
        """
        policy = self._policy
        if isinstance(policy, CompactPolicy):
            kept = [Numbers._fields.index(name) for name in self._setup.kept]
            policy.numbers.grad[kept] = 0.0
        elif isinstance(policy, Policy):
            # Not by requires_grad: torch would compile the step once for every decoder.
            turn = self.done // self._recipe.epoch % len(policy.decoders)
            for number, decoder in enumerate(policy.decoders):
                if number != turn:
                    decoder.zero_grad()

    def _loss(
        self, generator: Generator, batch: int, advance: Callable | None = None
    ) -> torch.Tensor:
        """Return the mean loss of `batch` rollouts, each under a random model."""
        setup = self._setup
        task = self._task
        self._rollout.draw_model(batch, setup.mfd_spread, generator, setup.mfd_scale)
        x, demand = self._start(generator, batch)
        if task.cost is None and not task.constraints:
            total = self._rollout.total_time_spent(self._policy, x, demand, generator, advance)
            if self._recipe.loss == "log":
                # So that a heavily loaded rollout does not count for more than the others.
                total = torch.log(total.clamp(min=1.0))
            return total.mean()
        run = self._rollout.trajectories(self._policy, x, demand, generator, advance)
        cost = run.total_time_spent if task.cost is None else task.cost(run)
        loss = torch.as_tensor(cost).mean()
        return loss + sum(weight * penalty(run).mean() for penalty, weight in task.constraints)

    def _start(self, generator: Generator, batch: int) -> tuple[States, Demands]:
        """Return random initial states and demands, or those of the task."""
        rollout = self._rollout
        if self._task.sample is not None:
            sample = self._task.sample(generator, batch)
            x, demand = (
                torch.as_tensor(part, dtype=rollout.dtype, device=rollout.device) for part in sample
            )
            start_fits = x.shape == (batch, *rollout.start.shape)
            if not start_fits or demand.shape[1:] != x.shape or len(demand) < 2:
                raise InputError(
                    f"sample: expected start ({batch}, R, R) and demand (T, {batch}, R, R) with R "
                    f"= {len(rollout.start)} and T > 1, got {tuple(x.shape)} and "
                    f"{tuple(demand.shape)}; return these"
                )
            return x, demand
        setup = self._setup
        levels = (setup.demand_low, setup.demand_high)
        largest = self._recipe.largest_start
        if largest:
            x, demand = rollout.random_start(batch, 0.0, 0.0, generator, levels)
            x = x + largest * torch.rand(x.shape, generator=generator, dtype=torch.float32).to(x)
        else:
            share = RANDOM_START_SHARE
            if rollout.rough:
                share = 0.0  # streets begin empty
            x, demand = rollout.random_start(batch, DEMAND_SPREAD, share, generator, levels)
        noise_level = torch.rand(batch, generator=generator, dtype=torch.float32)
        return x, rollout.perturb(demand, noise_level, setup.noise, generator)

    def validate(self) -> float:
        """Return the validation of the policy, and keep the best one so far."""
        if self._task.own:
            key = "validation"
            fixed = Generator().manual_seed(self._seed)
            with torch.no_grad():
                score = self._loss(fixed, VALIDATION_ROLLOUTS).item()
        else:
            key = SCORE
            score = validate(self._policy, self._rollout, self._seed, self._setup)
        if score < self.best:
            self._keep(key, score)
        return score

    def _keep(self, key: str, score: float) -> None:
        """Keep the policy as the best so far."""
        self.best = score
        self._best_weights = copy.deepcopy(self._policy.state_dict())
        self._keeper.keep({key: score})

    def better_change(self) -> Change | None:
        """Return the best single change of the best policy, if it gains enough.

        It is the first one that does if rollouts are rough, and so take long.
        There is none for a cost or a module of the user's own, whose outputs are unknown.
        """
        policy = self._policy
        if self._task.own or not isinstance(policy, Policy) or not self._best_weights:
            return None
        best = copy.deepcopy(policy)
        best.load_state_dict(self._best_weights)
        found = None
        least = self.best * (1.0 - CHANGE_WORTH)
        for name, changed in changed_policies(best, self._rollout.planning, self._setup.kept):
            score = validate(changed, self._rollout, self._seed, self._setup)
            if score < least:
                least = score
                gain = 1.0 - score / self.best
                found = Change(name=name, policy=changed, score=score, gain=gain)
                if self._rollout.rough:
                    break
        return found

    def _take(self, policy: Policy, score: float) -> None:
        """Go on from another policy.

        score: its validation (veh s)
        """
        self._policy.load_state_dict(policy.state_dict())
        self._keep(SCORE, score)

    def restart(self, change: Change) -> bool:
        """Begin another descent of a compact policy from a single change.

        Return False for a network, or after RESTARTS.
        """
        if not isinstance(self._policy, CompactPolicy) or self._restarts == RESTARTS:
            return False
        self._restarts += 1
        self._take(change.policy, change.score)
        self._optimizer = self._new_optimizer()
        self.done = 0
        return True

    def state(self) -> State:
        """Return all that `restore` needs."""
        return {
            "step": self.done,
            "best": self.best,
            "best_weights": self._best_weights,
            "restarts": self._restarts,
            "rate": self._rate,
            "policy": self._policy.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "generator": self._generator.get_state(),
        }

    def restore(self, state: State) -> None:
        """Continue from the state of an interrupted training."""
        self._policy.load_state_dict(state["policy"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        self.done = int(state["step"])
        self.best = float(state["best"])
        self._best_weights = state["best_weights"]
        self._restarts = int(state["restarts"])
        self._rate = float(state["rate"])


def validate(policy: Policy, rollout: Rollout, seed: int, setup: Dpc) -> float:
    """Return the total time spent (veh s) of the scenario itself.

    It is a geometric mean over two draws of the noise. If training perturbs demand or model, or
    rollouts are rough, there are VALIDATION_ROLLOUTS more under increasing perturbations, or a
    batch if that is larger.
    """
    generator = Generator().manual_seed(seed)
    low = setup.demand_low
    high = setup.demand_high
    count = 2
    if setup.noise or setup.mfd_spread or low < high or rollout.rough:
        count += max(VALIDATION_ROLLOUTS, rollout.batch or 0)
    rollout.draw_model(count, setup.mfd_spread, generator, setup.mfd_scale)
    level = torch.linspace(0.0, 1.0, count // 2, dtype=torch.float32).repeat_interleave(2)
    nominal = rollout.demand.unsqueeze(1).expand(-1, count, -1, -1)
    demand = rollout.perturb(nominal, level, setup.noise, generator)
    if (low, high) != (1.0, 1.0):
        factor = low + (high - low) * level[torch.randperm(count, generator=generator)]
        demand = demand * factor.to(demand)[:, None, None]
    start = rollout.start.expand_as(demand[0])
    with torch.no_grad():
        total = rollout.total_time_spent(policy, start, demand, generator)
    return torch.log(total).mean().exp().item()
