"""Training of DPC policies: roll the regional model out under the policy and descend the total time spent.

Random initial states and demand keep gradients alive (a rollout that gridlocks has none) and the best policy by
validation on the scenario itself is kept. The same seed gives the same weights.
"""

import io
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.options import Training
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint, new_policy, read_file
from nmfd.controllers.dpc.rollout import Rollout, compiled_step
from nmfd.controllers.options import options
from nmfd.controllers.pi_gating import PiGating
from nmfd.errors import InputError, RunFailed
from nmfd.model.authority import NO_GATEWAY
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.files import atomic, locked, sweep
from nmfd.runs.workers import reached
from nmfd.threads import one_thread

VALIDATE_EVERY = 20  # Adam steps
WORTH_COMPILING = 200  # Adam steps
# Of the first policy from a gate: Adam steps, states in each, learning rate; width of the gate and the fullest region,
# as a share of the set point; share of u where there is no gate.
GATE_STEPS, GATE_BATCH, GATE_RATE, GATE_WIDTH, GATE_FULLEST, OPENED = 1000, 256, 2e-3, 0.05, 2.5, 0.95
WEAK, OPEN, RARE = 0.1, 3.0, 1e-3  # of the first policy from no control: factor of weights, logit of u, least theta
VALIDATIONS = 16  # perturbed scenarios in a validation, if training perturbs the demand
NAMES = {"dpc-pc": False, "dpc-pcrg": True}


def settings(scenario: Scenario, controller: str, steps: int | None = None) -> Training:
    """The training settings of `controller` in `scenario`, checked; `steps` overrides.

    controller: one of NAMES, or "NAME+..." if the scenario has a table of that name (planning_model)
    """
    name, variant, _ = controller.partition("+")
    if name not in NAMES:
        raise InputError(f"--controller: {controller!r} cannot be trained; choose one of {', '.join(NAMES)}")
    if variant and controller not in scenario.controller_options:
        raise InputError(
            f'--controller: {controller!r} needs a table [controllers."{controller}"] in {scenario.folder}/'
            f"scenario.toml that says what is different from {name}; add one, or train {name}"
        )
    chosen = options(Training, planning_model(scenario, controller), name, controller)
    if chosen.local and NAMES[name]:
        raise InputError(
            f"{scenario.folder}/scenario.toml: controllers.{controller}.local: a local policy guides no routes; train "
            f"{name.replace('pcrg', 'pc')}, or omit it"
        )
    if not chosen.descend and steps is not None:
        raise InputError(
            f"--steps: {controller} stays as it begins (descend = false in {scenario.folder}/scenario.toml); omit one "
            "of them"
        )
    return chosen if steps is None else chosen.changed(steps=steps)


def check(scenario: Scenario, controller: str) -> RegionalModel:
    """The regional model on which `controller` is trained. InputError where training would be for nothing: no gateway
    of the city can be controlled, or the MFDs are placeholders that no run has measured."""
    city, believed = scenario.network, planning_model(scenario, controller).network
    if city.controllable is not None and not city.controllable.any():
        raise InputError(
            f"{_file(city)}: controllable: is 0 at every boundary: {NO_GATEWAY}; --anyway trains {controller} all the "
            "same"
        )
    if believed.placeholder:
        raise InputError(
            f"{_file(believed)}: placeholder: is true: its MFDs are guesses from lanes and speed limits, and a policy "
            f"would learn these; run 'cosim identify {os.path.dirname(_file(city)) or 'NETWORK'}' first, or set it to "
            f"false once you have put in MFDs of your own; --anyway trains {controller} all the same"
        )
    return believed


def _file(network: RegionalModel) -> str:
    return network.name if network.folder is None else os.path.normpath(network.folder / "network.toml")


def available(device: str) -> str:
    """ "cpu" or "cuda", with "auto" the GPU where there is one. InputError for a GPU that is not there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: cuda asked for, but PyTorch finds no GPU here; choose cpu or auto")
    return "cuda" if device == "auto" and torch.cuda.is_available() else device.replace("auto", "cpu")


def train(
    scenario: Scenario,
    controller: str,
    *,
    seed: int,
    out: Path,
    steps: int | None = None,
    resume: bool = False,
    device: str = "cpu",
    compiled: bool = False,
    anyway: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
    log: Callable[[int, float, float], object] | None = None,
) -> Path:
    """Train `controller`, one that `settings` knows, on the regional model and write the policy to `out`.

    `out` holds the best policy so far after every validation; `out`.resume beside it holds what `resume` needs and
    goes when the training is complete. `progress(done, steps, note)` is called after every step, `log(done,
    TTS in training, TTS in validation)` [veh s] after every validation, also for those from before `resume`. `compiled`
    makes a step about twice as fast, after up to a minute or two of compilation; the weights differ by rounding.
    `anyway`: even where `check` refuses.
    """
    with one_thread():
        chosen = settings(scenario, controller, steps)
        if not anyway:
            check(scenario, controller)
        planning = planning_model(scenario, controller)
        steps = chosen.steps if chosen.descend else 0
        configuration = {
            "controller": controller,
            "scenario": planning.name,
            "seed": seed,
            "compiled": compiled,
            **vars(chosen),
            "steps": steps,
        }
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        guidance = NAMES[controller.partition("+")[0]]
        architecture = Architecture(
            width=chosen.width,
            layers=chosen.layers,
            activation=chosen.activation,
            guidance=guidance,
            local=chosen.local,
            compact=planning.protected if chosen.compact else (),
            metering=chosen.metering,
        )
        policy = new_policy(planning.network, architecture)
        if chosen.numbers and isinstance(policy, CompactPolicy):
            policy.begin_with(chosen.numbers)
        if chosen.from_no_control:
            begin_as_no_control(policy, planning.network)
        device = "cpu" if chosen.compact else device
        policy = policy.to(device)
        rollout = Rollout(planning, device=device, detour_cost=chosen.detour_cost, swing_cost=chosen.swing_cost)
        if chosen.from_gating and not resume:
            begin_as_gate(policy, rollout, generator)
        advance = compiled_step(rollout.step) if compiled else rollout.step
        optimizer = torch.optim.Adam(policy.parameters(), lr=chosen.learning_rate)
        first, best, history = 0, float("inf"), list[list[float]]()
        state_file = out.with_name(out.name + ".resume")
        with locked(out.with_name(f".{out.name}.lock"), out):
            sweep(out.parent, {out.stem, state_file.stem})
            if resume:
                first, best, history = _restore(state_file, configuration, policy, optimizer, generator)
                for done, trained, score in history:
                    if log:
                        log(int(done), trained, score)
            for step in range(first, steps):
                for group in optimizer.param_groups:
                    cosine = 0.5 * (1.0 + math.cos(math.pi * step / steps))
                    group["lr"] = chosen.learning_rate * (0.1 + 0.9 * cosine)
                rollout.draw_model(chosen.batch, chosen.mfd_spread, generator, chosen.mfd_scale)
                x, demand = rollout.random_start(
                    chosen.batch, chosen.demand_spread, chosen.initial_share, generator, chosen.levels
                )
                demand = rollout.perturb(demand, torch.rand(chosen.batch, generator=generator), chosen.noise, generator)
                # The logarithm, because a rollout that is heavily loaded must not count for more than the others.
                loss = torch.log(rollout.total_time_spent(policy, x, demand, generator, advance).clamp(min=1.0)).mean()
                optimizer.zero_grad()
                loss.backward()
                if architecture.guidance and chosen.alternating and not chosen.compact:
                    # Not by requires_grad, which would compile the step once for each decoder.
                    for weights in (policy.splits_decoder if step % 2 == 0 else policy.perimeter_decoder).parameters():
                        weights.grad = None
                torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
                optimizer.step()
                if isinstance(policy, CompactPolicy):
                    policy.bound()
                last = step + 1 == steps
                if (step + 1) % VALIDATE_EVERY == 0 or last:
                    score = validate(policy, rollout, seed, chosen)
                    history.append([step + 1, math.exp(loss.item()), score])
                    if log:
                        log(step + 1, history[-1][1], score)
                    if score < best:
                        best = score
                        _keep(policy, rollout, configuration, best, out)
                    if not last:
                        write(_state(configuration, step + 1, best, history, policy, optimizer, generator), state_file)
                reached((step + 1) / steps)
                if progress:
                    progress(step + 1, steps, f"best {best:.4g} veh s")
            if not steps:  # as it begins
                best = validate(policy, rollout, seed, chosen)
                if log:
                    log(0, best, best)
                if progress:
                    progress(1, 1, f"as it begins {best:.4g} veh s")
                _keep(policy, rollout, configuration, best, out)
            if not math.isfinite(best):
                raise RunFailed(f"{controller}: every validation of {steps} steps diverged; lower the learning rate")
            state_file.unlink(missing_ok=True)
        return out


def begin_as_no_control(policy: Policy, network: RegionalModel) -> None:
    """Let `policy` hardly depend on the state, with nearly open gateways and nearly the drivers' own split ratios."""
    with torch.no_grad():
        policy.perimeter_decoder.weight.mul_(WEAK)
        policy.perimeter_decoder.bias.fill_(OPEN)
        if policy.architecture.guidance:
            own = torch.tensor(network.nominal_splits[np.arange(network.regions)[:, None], policy.onward.numpy()])
            policy.splits_decoder.weight.mul_(WEAK)
            policy.splits_decoder.bias.copy_(own.clamp(min=RARE).log().flatten())


def begin_as_gate(policy: Policy, rollout: Rollout, generator: torch.Generator) -> None:
    """Let `policy` close the entries of every region that pi-gating holds as this fills, half at its set point."""
    network, gate = rollout.planning.network, PiGating(rollout.planning)
    protected = gate.regions.tolist()
    set_point = torch.tensor(gate.set_point, dtype=rollout.dtype, device=rollout.device)
    counts = rollout.parameters.adjacency.expand(GATE_BATCH, -1, -1)
    optimizer = torch.optim.Adam(policy.parameters(), lr=GATE_RATE)
    for _ in range(GATE_STEPS):
        x, _ = rollout.random_start(GATE_BATCH, 0.0, 1.0, generator)
        full = torch.rand(GATE_BATCH, len(protected), generator=generator).to(x) * GATE_FULLEST * set_point
        x[:, protected] *= (full / x[:, protected].sum(-1).clamp(min=1.0)).unsqueeze(-1)
        wanted = torch.full_like(x, OPENED)
        wanted[:, :, protected] = torch.sigmoid((set_point - full) / (GATE_WIDTH * set_point)).unsqueeze(1)
        share = (policy(x)[0] - network.u_min) / (network.u_max - network.u_min)
        loss = torch.nn.functional.binary_cross_entropy(share.clamp(0.0, 1.0), wanted, weight=counts)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def validate(policy: Policy, rollout: Rollout, seed: int, chosen: Training) -> float:
    """TTS of the scenario itself from its own start, the geometric mean of two noise draws [veh s].

    If training perturbs demand or model: also of VALIDATIONS perturbed ones, whose sigma rises to that of `chosen`.
    """
    generator = torch.Generator().manual_seed(seed)
    perturbed = chosen.noise or chosen.mfd_spread or chosen.demand_low < chosen.demand_high
    count = 2 + (VALIDATIONS if perturbed else 0)
    rollout.draw_model(count, chosen.mfd_spread, generator, chosen.mfd_scale)
    level = torch.linspace(0.0, 1.0, count // 2).repeat_interleave(2)  # in twos: one of each kind of noise
    nominal = rollout.demand.unsqueeze(1).expand(-1, count, -1, -1)
    demand = rollout.perturb(nominal, level, chosen.noise, generator)
    if chosen.demand_low < chosen.demand_high:
        low, high = chosen.levels
        demand = (
            demand * (low + (high - low) * level[torch.randperm(count, generator=generator)]).to(demand)[:, None, None]
        )
    with torch.no_grad():
        total = rollout.total_time_spent(policy, rollout.start.expand_as(demand[0]), demand, generator)
    return torch.log(total).mean().exp().item()


def _keep(policy: Policy, rollout: Rollout, configuration: Mapping[str, Any], score: float, out: Path) -> None:
    """Write the policy to `out`, with its `score` in validation [veh s]."""
    write(checkpoint(policy, rollout.planning.network, {**configuration, "validation_veh_s": score}), out)


def _state(
    configuration: Mapping[str, Any],
    step: int,
    best: float,
    history: list[list[float]],
    policy: Policy,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
) -> dict[str, Any]:
    return {
        "configuration": configuration,
        "step": step,
        "best": best,
        "history": history,
        "policy": policy.state_dict(),
        "optimizer": optimizer.state_dict(),
        "generator": generator.get_state(),
    }


def _restore(
    state_file: Path,
    configuration: Mapping[str, Any],
    policy: Policy,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
) -> tuple[int, float, list[list[float]]]:
    state = read_file(
        state_file, "nothing to resume; train without --resume", "is damaged; remove it and train without --resume"
    )
    try:
        there = dict(state["configuration"])
        for key, value in configuration.items():
            if there.get(key) != value:
                raise InputError(
                    f"{state_file}: {key}: was {there.get(key)!r}, now {value!r}; resume with the same settings or "
                    "train without --resume"
                )
        policy.load_state_dict(state["policy"])
        optimizer.load_state_dict(state["optimizer"])
        generator.set_state(state["generator"])
        return int(state["step"]), float(state["best"]), list(state["history"])
    except InputError:
        raise
    except Exception:
        raise InputError(f"{state_file}: is damaged; remove it and train without --resume") from None


def write(content: dict, path: Path) -> None:
    """A checkpoint, or what a training needs to go on: the same content, the same bytes."""
    buffer = io.BytesIO()  # given a path, torch would write its name into the file: never the same bytes twice
    torch.save(content, buffer)
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
