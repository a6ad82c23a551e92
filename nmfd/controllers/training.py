"""Training of DPC policies: roll out the regional model under the policy and descend the total time
spent.

Random initial states and demand keep gradients alive: a rollout that gridlocks has none.
"""

import copy
import io
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Generator, nn
from torch.optim import Adam

from nmfd.controllers.base import check_fit, from_table
from nmfd.controllers.dpc.compact import CompactPolicy, Numbers
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.dpc.policy import Architecture, ModuleController, Policy
from nmfd.controllers.dpc.policy_file import checkpoint, new_policy, read_file
from nmfd.controllers.dpc.rollout import Rollout, Trajectories, compiled_step
from nmfd.controllers.rules import PiGating
from nmfd.controllers.strategy import Strategy
from nmfd.errors import InputError, RunFailed
from nmfd.model.authority import NO_GATEWAY
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.config import error
from nmfd.runs.files import atomic
from nmfd.tensors import one_thread
from nmfd.types import Observation

DEMAND_SPREAD = 0.2  # every flow is scaled by a factor drawn from 1 - this to 1 + this
RANDOM_START_SHARE = 0.5  # of the rollouts start from a random state at a random time
VALIDATION_PERIOD = 20  # Adam steps
VALIDATION_ROLLOUTS = 16  # perturbed rollouts in a validation, if training perturbs demand or model
WORTH_COMPILING = 200  # Adam steps
# First policy from a gate: Adam steps, states in each, learning rate; width of the gate and largest
# accumulation, as a share of the set point; opening without a gate.
GATE_STEPS, GATE_BATCH, GATE_RATE, GATE_WIDTH, GATE_FULLEST, GATE_OPEN = (
    1000,
    256,
    2e-3,
    0.05,
    2.5,
    0.95,
)
# First policy from no control: factor of the weights, logit of u, least theta. Instead of it, a
# policy that is open whatever happens is kept if none gains WORTH in validation.
NO_CONTROL_WEIGHT, NO_CONTROL_LOGIT, NO_CONTROL_SPLIT = 0.1, 3.0, 1e-3
OPEN_LOGIT, WORTH = 12.0, 0.03


def settings(scenario: Scenario, strategy: Strategy, steps: int | None = None) -> Dpc:
    """Return the options of a policy to train; `steps` overrides. Raise InputError."""
    setup = strategy.options(scenario)
    table = strategy.table(scenario)
    name = strategy.controller.name
    if not isinstance(setup, Dpc):
        problem = "cannot be trained; choose dpc-pc or dpc-pcrg"
        raise InputError(f"--controller: {strategy.name!r} {problem}")
    if table != strategy.name:
        needs = f'needs a table [controllers."{strategy.name}"] in {scenario.where}'
        remedy = f"add one, or train {name}"
        raise InputError(f"--controller: {strategy.name!r} {needs} with its differences; {remedy}")
    prefix = f"controllers.{table}."
    check_fit(setup, strategy.own_planning(scenario), f"{scenario.where}: {prefix}")
    if setup.local and setup.guides:
        problem = "a local policy guides no routes; train dpc-pc"
        raise error(scenario.where, f"{prefix}local", problem)
    if setup.prices and not setup.guides:
        raise error(scenario.where, f"{prefix}prices", "prices guide drivers; train dpc-pcrg")
    return setup if steps is None else setup.changed(steps=steps)


def check(scenario: Scenario, strategy: Strategy) -> None:
    """Raise InputError without gateways, or for placeholder MFDs of the model to train on."""
    city, believed = scenario.network, strategy.planning(scenario).network
    still = "nmfd.train(..., anyway=True) trains all the same"
    if city.controllable is not None and not city.controllable.any():
        raise InputError(
            f"{_file(city)}: controllable: is 0 at every boundary: {NO_GATEWAY}; {still}"
        )
    if believed.placeholder:
        guess = "is true: its MFDs are guesses from lanes and speed limits"
        remedy = f"run 'cosim identify {city.folder}' or put in your own"
        raise InputError(f"{_file(believed)}: placeholder: {guess}; {remedy}; {still}")


def _file(network: RegionalModel) -> Path | str:
    return network.name if network.folder is None else network.folder / "network.toml"


def available(device: str) -> str:
    """Return "cpu" or "cuda"; "auto" is the GPU if there is one. Raise InputError for a missing
    GPU."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device: cuda asked for, but PyTorch finds no GPU here; choose cpu or auto"
        )
    return (
        "cuda" if device == "auto" and torch.cuda.is_available() else device.replace("auto", "cpu")
    )


@dataclass(frozen=True, kw_only=True)
class Task:
    """Cost, sample and constraints of the user's own, as of nmfd.train; by default the total time
    spent."""

    cost: Callable[[Trajectories], torch.Tensor] | None = None
    sample: Callable[[Generator, int], tuple] | None = None
    constraints: Sequence[tuple[Callable[[Trajectories], torch.Tensor], float]] = ()

    def __post_init__(self) -> None:
        if not all(map(callable, filter(None, (self.cost, self.sample)))):
            raise InputError(
                f"cost, sample: expected functions, got {self.cost!r} and {self.sample!r}; see nmfd.train"
            )
        for pair in self.constraints:
            if not (isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])):
                raise InputError(
                    f"constraints: expected pairs (function, weight), got {pair!r}; add the weight"
                )

    @property
    def own(self) -> str:
        """Names of its parts, "" for the default."""
        parts = [self.cost, self.sample, *(part for part, _ in self.constraints)]
        return ", ".join(getattr(part, "__qualname__", repr(part)) for part in parts if part)


@one_thread()
def train(
    scenario: Scenario,
    strategy: Strategy,
    *,
    seed: int,
    out: Path | None,
    module: nn.Module | None = None,
    task: Task = Task(),
    steps: int | None = None,
    resume: bool = False,
    device: str = "cpu",
    compiled: bool = False,
    anyway: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Any:
    """Train the policy of `strategy` and write the best in validation to `out`; the same seed gives
    the same weights.

    module: instead of the policy, trained in place and returned with its best weights, without a
        file
    resume: continue from the state in `out`.resume
    compiled: compile the step, about twice as fast after a minute or two; the weights differ by
        rounding
    anyway: train even if `check` raises
    progress: called with (done, steps, note) after every step
    """
    setup = settings(scenario, strategy, steps)
    if module is not None:
        if not isinstance(module, nn.Module) or not any(
            weights.requires_grad for weights in module.parameters()
        ):
            raise InputError(
                f"policy: expected an nn.Module with weights to train, got {module!r:.60}; give one"
            )
        empty = np.zeros(scenario.network.adjacency.shape)
        ModuleController(module, scenario).act(
            Observation(step=0, time=0.0, accumulation=empty, backlog=empty)
        )
    elif not anyway:
        check(scenario, strategy)
    planning = strategy.own_planning(scenario)
    configuration = {
        "controller": strategy.name,
        "scenario": planning.name,
        "seed": seed,
        "compiled": compiled,
    }
    configuration |= vars(setup) | ({"task": task.own} if task.own else {})
    torch.manual_seed(seed)
    generator = Generator().manual_seed(seed)
    recipe, steps, guidance = setup.recipe, setup.steps, setup.guides
    policy = _first_policy(setup, planning, guidance=guidance) if module is None else module
    device = "cpu" if isinstance(policy, CompactPolicy) else device
    policy = policy.to(device).train()
    costs = {
        "detour_cost": setup.detour_cost,
        "holding_cost": setup.holding_cost,
        "process_std": recipe.process_std,
    }
    rollout = Rollout(planning, next(policy.parameters()).dtype, device, **costs)
    if setup.from_gating and not resume and module is None:
        begin_as_gate(policy, rollout, generator)
    advance = compiled_step(rollout.step) if compiled else rollout.step
    optimizer = Adam(policy.parameters(), lr=setup.learning_rate, weight_decay=recipe.weight_decay)
    first, best, kept = 0, float("inf"), copy.deepcopy(policy.state_dict())
    state_file = None if out is None else out.with_name(out.name + ".resume")
    objective = partial(_loss, policy, rollout, setup, task)

    def keep_the_better(best: float) -> float:
        with torch.no_grad():
            fixed = Generator().manual_seed(seed)
            own = objective(fixed, VALIDATION_ROLLOUTS).item() if task.own else None
        score = validate(policy, rollout, seed, setup) if own is None else own
        if score < best and out is not None:
            key = "validation" if task.own else "validation_veh_s"
            write(checkpoint(policy, planning.network, {**configuration, key: score}), out)
        elif score < best:
            kept.update(copy.deepcopy(policy.state_dict()))
        return min(best, score)

    if resume and state_file is not None:
        first, best = _restore(state_file, configuration, policy, optimizer, generator)
    bar = None
    if setup.from_no_control and not resume and module is None and not task.own:
        initial = copy.deepcopy(policy.state_dict())
        begin_as_no_control(policy, planning.network, weight=0.0, logit=OPEN_LOGIT)
        bar = best = (1.0 - WORTH) * keep_the_better(best)
        policy.load_state_dict(initial)
    for step in range(first, steps):
        cosine = 0.5 * (1.0 + math.cos(math.pi * (step / steps)))
        for group in optimizer.param_groups:
            group["lr"] = recipe.learning_rate or setup.learning_rate * (0.1 + 0.9 * cosine)
        _descend(
            policy, objective(generator, recipe.batch, advance), optimizer, setup, step, task.own
        )
        if (step + 1) % VALIDATION_PERIOD == 0 or step + 1 == steps:
            best = keep_the_better(best)
            state = {"configuration": configuration, "step": step + 1, "best": best}
            state |= {"policy": policy.state_dict(), "optimizer": optimizer.state_dict()}
            if state_file is not None:
                write(state | {"generator": generator.get_state()}, state_file)
        if progress:
            progress(step + 1, steps, f"best {best:.4g}" + ("" if task.own else " veh s"))
    if best == bar:
        print(
            f"nmfd: no policy gained {WORTH:.0%} on the model: its gates stay open", file=sys.stderr
        )
    if not math.isfinite(best):
        raise RunFailed(
            f"{strategy.name}: every validation of {steps} steps diverged; lower the learning rate"
        )
    if state_file is not None:
        state_file.unlink(missing_ok=True)
        return out
    policy.load_state_dict(kept)
    return policy.cpu().eval()


def _first_policy(setup: Dpc, planning: PlanningModel, *, guidance: bool) -> Policy:
    """Return the untrained policy that the settings describe."""
    recipe = setup.recipe
    architecture = Architecture(
        guidance=guidance,
        local=setup.local,
        compact=planning.protected if setup.compact else (),
        metering=setup.metering,
        prices=setup.prices,
        soft_exponential=recipe.activation != "gelu",
        decoder_layers=recipe.decoder_layers,
    )
    policy = new_policy(planning.network, architecture)
    if setup.numbers and isinstance(policy, CompactPolicy):
        policy.numbers.data.copy_(torch.tensor(Numbers(*setup.numbers)))
    if setup.from_no_control:
        begin_as_no_control(policy, planning.network)
    return policy


def _loss(
    policy: nn.Module,
    rollout: Rollout,
    setup: Dpc,
    task: Task,
    generator: Generator,
    batch: int,
    advance: Callable | None = None,
) -> torch.Tensor:
    """Return the loss of `batch` rollouts under random models, from random states and demands or
    those of the task."""
    most, levels = setup.recipe.largest_start, (setup.demand_low, setup.demand_high)
    rollout.draw_model(batch, setup.mfd_spread, generator, setup.mfd_scale)
    if task.sample:
        given = task.sample(generator, batch)
        x, demand = (
            torch.as_tensor(part, dtype=rollout.dtype, device=rollout.device) for part in given
        )
        if (
            x.shape != (batch, *rollout.start.shape)
            or demand.shape[1:] != x.shape
            or len(demand) < 2
        ):
            wanted = f"start ({batch}, R, R) and demand (T, {batch}, R, R) with R = {len(rollout.start)} and T > 1"
            raise InputError(
                f"sample: expected {wanted}, got {tuple(x.shape)} and {tuple(demand.shape)}; return these"
            )
    else:
        spread, share = (0.0, 0.0) if most else (DEMAND_SPREAD, RANDOM_START_SHARE)
        x, demand = rollout.random_start(batch, spread, share, generator, levels)
        x = x + most * torch.rand(x.shape, generator=generator).to(x) if most else x
        demand = rollout.perturb(
            demand, torch.rand(batch, generator=generator), setup.noise, generator
        )
    if not (task.cost or task.constraints):
        total = rollout.total_time_spent(policy, x, demand, generator, advance)
        # The logarithm, because a rollout that is heavily loaded must not count for more than the
        # others.
        return (
            torch.log(total.clamp(min=1.0)).mean() if setup.recipe.loss == "log" else total.mean()
        )
    run = rollout.trajectories(policy, x, demand, generator, advance)
    loss = torch.as_tensor(task.cost(run) if task.cost else run.total_time_spent).mean()
    return loss + sum(weight * penalty(run).mean() for penalty, weight in task.constraints)


def _descend(
    policy: nn.Module, loss: torch.Tensor, optimizer: Adam, setup: Dpc, step: int, own: str
) -> None:
    if not loss.requires_grad:
        raise InputError(
            "cost: has no gradient by the weights of the policy; compute it from the run with torch"
        )
    optimizer.zero_grad()
    loss.backward()
    if isinstance(policy, CompactPolicy):
        policy.numbers.grad[[Numbers._fields.index(name) for name in setup.kept]] = 0.0
    decoders = policy.decoders if isinstance(policy, Policy) else []
    for n, decoder in enumerate(
        decoders
    ):  # in turn; not by requires_grad, which would compile the step once for each
        for weights in (
            decoder.parameters() if n != step // setup.recipe.epoch % len(decoders) else ()
        ):
            weights.grad = None
    size = torch.nn.utils.clip_grad_norm_(policy.parameters(), setup.recipe.clip)
    if own and not size.isfinite():
        what = f"{own}: in step {step} the cost is {loss.item():.4g} and the norm of its gradient {size.item():.4g}"
        raise InputError(f"{what}; look for 0 / 0, log(0) and sqrt(0) in your own functions")
    optimizer.step()
    if isinstance(policy, CompactPolicy):
        policy.bound()


def begin_as_no_control(
    policy: Policy,
    network: RegionalModel,
    weight: float = NO_CONTROL_WEIGHT,
    logit: float = NO_CONTROL_LOGIT,
) -> None:
    """Make `policy` nearly independent of the state, with open gateways, nominal split ratios or no
    prices.

    weight: factor of the weights; logit: of u
    """
    with torch.no_grad():
        for decoder in policy.decoders:
            decoder.weight.mul_(weight)
        policy.perimeter_decoder.bias.fill_(logit)
        if policy.architecture.guidance and not policy.architecture.prices:
            own = torch.tensor(
                network.nominal_splits[np.arange(network.regions)[:, None], policy.onward.numpy()]
            )
            policy.splits_decoder.bias.copy_(own.clamp(min=NO_CONTROL_SPLIT).log().flatten())


def begin_as_gate(policy: Policy, rollout: Rollout, generator: Generator) -> None:
    """Fit `policy` to gates that close the entries of protected regions as these fill, half at the
    set point."""
    network, gate = (
        rollout.planning.network,
        from_table(PiGating, rollout.planning, "pi-gating").make(rollout.planning),
    )
    protected = gate.regions.tolist()
    set_point = torch.tensor(gate.set_point, dtype=rollout.dtype, device=rollout.device)
    counts = rollout.parameters.adjacency.expand(GATE_BATCH, -1, -1)
    optimizer = Adam(policy.parameters(), lr=GATE_RATE)
    for _ in range(GATE_STEPS):
        x, _ = rollout.random_start(GATE_BATCH, 0.0, 1.0, generator)
        full = (
            torch.rand(GATE_BATCH, len(protected), generator=generator).to(x)
            * GATE_FULLEST
            * set_point
        )
        x[:, protected] *= (full / x[:, protected].sum(-1).clamp(min=1.0)).unsqueeze(-1)
        wanted = torch.full_like(x, GATE_OPEN)
        wanted[:, :, protected] = torch.sigmoid(
            (set_point - full) / (GATE_WIDTH * set_point)
        ).unsqueeze(1)
        share = (policy(x)[0] - network.u_min) / (network.u_max - network.u_min)
        loss = torch.nn.functional.binary_cross_entropy(
            share.clamp(0.0, 1.0), wanted, weight=counts
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def validate(policy: Policy, rollout: Rollout, seed: int, setup: Dpc) -> float:
    """Return the TTS (veh s) of the scenario itself, the geometric mean of two noise draws.

    If training perturbs demand or model, also of VALIDATION_ROLLOUTS perturbed rollouts of
    increasing sigma.
    """
    generator, low, high = Generator().manual_seed(seed), setup.demand_low, setup.demand_high
    count = 2 + (VALIDATION_ROLLOUTS if setup.noise or setup.mfd_spread or low < high else 0)
    rollout.draw_model(count, setup.mfd_spread, generator, setup.mfd_scale)
    level = torch.linspace(0.0, 1.0, count // 2).repeat_interleave(2)
    nominal = rollout.demand.unsqueeze(1).expand(-1, count, -1, -1)
    demand = rollout.perturb(nominal, level, setup.noise, generator)
    if low < high:
        factor = low + (high - low) * level[torch.randperm(count, generator=generator)]
        demand = demand * factor.to(demand)[:, None, None]
    with torch.no_grad():
        total = rollout.total_time_spent(
            policy, rollout.start.expand_as(demand[0]), demand, generator
        )
    return torch.log(total).mean().exp().item()


def _restore(
    state_file: Path,
    configuration: Mapping[str, Any],
    policy: Policy,
    optimizer: Adam,
    generator: Generator,
) -> tuple[int, float]:
    """Restore the state of a training; return the number of its next step and its best
    validation."""
    state = read_file(state_file, "nothing to resume; train without --resume")
    for key, value in configuration.items():
        if (before := state["configuration"].get(key)) != value:
            remedy = "resume with the same settings or train without --resume"
            raise InputError(f"{state_file}: {key}: was {before!r}, now {value!r}; {remedy}")
    policy.load_state_dict(state["policy"])
    optimizer.load_state_dict(state["optimizer"])
    generator.set_state(state["generator"])
    return int(state["step"]), float(state["best"])


def write(content: dict, path: Path) -> None:
    """Write a checkpoint or the state of a training; the same content gives the same bytes."""
    buffer = io.BytesIO()  # given a path, torch would write its name into the file
    torch.save(content, buffer)
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
