"""Training of DPC policies: roll the regional model out under the policy and descend the total time spent.

Random initial states and demand keep gradients alive (a rollout that gridlocks has none) and the best policy by
validation on the scenario itself is kept. The same seed gives the same weights.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from nmfd import dynamics, toml
from nmfd.controllers.dpc import ACTIVATIONS, Architecture, Policy, checkpoint
from nmfd.errors import InputError
from nmfd.runs import atomic
from nmfd.scenario import Scenario

VALIDATE_EVERY = 20  # Adam steps
NAMES = {"dpc-pc": False, "dpc-pcrg": True}


@dataclass(frozen=True, kw_only=True)
class Training:
    """Settings of one training, from [controllers.dpc-pc] or [controllers.dpc-pcrg] of scenario.toml.

    width, layers, activation: of the policy
    steps: Adam steps
    batch: rollouts per step
    learning_rate: of Adam at the start; falls to a tenth along a cosine
    alternating: for dpc-pcrg, train the two decoders in turn (the backbone always)
    demand_spread: every flow is scaled by a factor drawn from 1 +- demand_spread, per rollout
    initial_share: share of the rollouts that start from a random state, at a random time of the scenario
    """

    width: int = 128
    layers: int = 2
    activation: str = "gelu"
    steps: int = 400
    batch: int = 16
    learning_rate: float = 1e-3
    alternating: bool = True
    demand_spread: float = 0.2
    initial_share: float = 0.5


def settings(scenario: Scenario, controller: str, steps: int | None = None) -> Training:
    """The training settings of `controller` in `scenario`, checked; `steps` overrides."""
    if controller not in NAMES:
        raise InputError(f"--controller: {controller!r} cannot be trained; choose one of {', '.join(NAMES)}")
    default = Training()
    table = toml.Table(
        scenario.controller_options.get(controller, {}), scenario.folder / "scenario.toml" if scenario.folder else
        Path("scenario"), f"controllers.{controller}.")
    chosen = Training(
        width=table.integer("width", default.width, low=1), layers=table.integer("layers", default.layers, low=1),
        activation=table.text("activation", default.activation, tuple(ACTIVATIONS)),
        steps=table.integer("steps", default.steps, low=1), batch=table.integer("batch", default.batch, low=1),
        learning_rate=table.number("learning_rate", default.learning_rate, above=0.0),
        alternating=table.flag("alternating", default.alternating),
        demand_spread=table.number("demand_spread", default.demand_spread, low=0.0, high=1.0),
        initial_share=table.number("initial_share", default.initial_share, low=0.0, high=1.0))
    table.close()
    return chosen if steps is None else Training(**{**asdict(chosen), "steps": steps})


class Rollout:
    """The scenario's regional model as tensors, for many rollouts at once."""

    def __init__(self, scenario: Scenario, dtype=torch.float32):
        network = scenario.network
        self.scenario, self.dtype = scenario, dtype
        self.parameters = dynamics.parameters(network, dtype=dtype)
        self.demand = torch.tensor(scenario.demand, dtype=dtype)
        self.nominal_splits = torch.tensor(network.nominal_splits, dtype=dtype)
        self.critical = torch.tensor([m.critical for m in network.mfds], dtype=dtype)
        self.jam = torch.tensor([m.jam for m in network.mfds], dtype=dtype)
        self.bound = (self.demand.sum((0, 1)) > 0).to(dtype)

    def random_start(self, batch: int, spread: float, share: float, generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Initial states (B, R, R) [veh] and demands (T, B, R, R) [veh/s].

        A share of the rollouts starts at a random time of the scenario from a random state, which fills the regions
        up to between nothing and 80 % of their jam accumulation with vehicles for the destinations in use.
        """
        def uniform(*shape):
            return torch.rand(*shape, generator=generator, dtype=self.dtype)

        steps, regions = self.demand.shape[:2]
        factor = 1.0 + spread * (2.0 * uniform(batch, regions, regions) - 1.0)
        shift = (uniform(batch) * steps * 0.5).long() * (torch.arange(batch) < share * batch)
        index = torch.arange(steps)[:, None] + shift
        padded = torch.cat([self.demand, torch.zeros_like(self.demand)])
        demand = padded[index] * factor
        weight = uniform(batch, regions, regions) ** 2 * self.bound
        total = uniform(batch, regions) * uniform(batch, 1) * 0.8 * self.jam
        x = total.unsqueeze(-1) * weight / weight.sum(-1, keepdim=True).clamp(min=1e-6)
        return x * (torch.arange(batch) < share * batch)[:, None, None], demand

    def total_time_spent(self, policy: Policy, x, demand, generator) -> torch.Tensor:
        """TTS (B,) [veh s] of rollouts from x (B, R, R) under `policy`, with the scenario's measurement noise."""
        total = torch.zeros(x.shape[0], dtype=self.dtype)
        scenario = self.scenario
        for k in range(demand.shape[0]):
            total = total + x.sum((-2, -1))
            noise = scenario.measurement_std * torch.randn(x.shape, generator=generator, dtype=self.dtype)
            perimeter, splits = policy(x + noise)
            x = dynamics.advance(
                self.parameters, x, demand[k], perimeter, self.nominal_splits if splits is None else splits,
                scenario.step, integrator=scenario.integrator, substeps=scenario.substeps)
        return total * scenario.step


def train(
    scenario: Scenario, controller: str, *, seed: int, out: Path, steps: int | None = None, resume: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Path:
    """Train `controller` ("dpc-pc" or "dpc-pcrg") on the regional model and write the policy to `out`.

    `out` holds the best policy so far after every validation; `out`.resume beside it holds what `resume` needs and
    goes when the training is complete. `progress(done, steps, note)` is called after every step.
    """
    chosen = settings(scenario, controller, steps)
    configuration = {"controller": controller, "scenario": scenario.name, "seed": seed, **asdict(chosen)}
    torch.set_num_threads(1)  # the matrices are small: more threads only wait for one another
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    architecture = Architecture(
        width=chosen.width, layers=chosen.layers, activation=chosen.activation, guidance=NAMES[controller])
    policy, rollout = Policy(scenario.network, architecture), Rollout(scenario)
    optimizer = torch.optim.Adam(policy.parameters(), lr=chosen.learning_rate)
    first, best, history = 0, float("inf"), []
    state_file = out.with_name(out.name + ".resume")
    if resume:
        first, best, history = _restore(state_file, configuration, policy, optimizer, generator)
    for step in range(first, chosen.steps):
        for group in optimizer.param_groups:
            cosine = 0.5 * (1.0 + math.cos(math.pi * step / chosen.steps))
            group["lr"] = chosen.learning_rate * (0.1 + 0.9 * cosine)
        if architecture.guidance and chosen.alternating:
            policy.perimeter_decoder.requires_grad_(step % 2 == 0)
            policy.splits_decoder.requires_grad_(step % 2 == 1)
        x, demand = rollout.random_start(chosen.batch, chosen.demand_spread, chosen.initial_share, generator)
        loss = rollout.total_time_spent(policy, x, demand, generator).mean()
        optimizer.zero_grad()
        (loss / loss.detach()).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        last = step + 1 == chosen.steps
        if (step + 1) % VALIDATE_EVERY == 0 or last:
            score = validate(policy, rollout, seed)
            history.append([step + 1, loss.item(), score])
            if score < best:
                best = score
                _write(checkpoint(policy, scenario.network, {**configuration, "validation_veh_s": best}), out)
            if not last:
                _write(_state(configuration, step + 1, best, history, policy, optimizer, generator), state_file)
        if progress:
            progress(step + 1, chosen.steps, f"best {best:.4g} veh s")
    if not math.isfinite(best):
        raise RuntimeError(f"{controller}: every validation of {chosen.steps} steps diverged; lower the learning rate")
    state_file.unlink(missing_ok=True)
    return out


def validate(policy: Policy, rollout: Rollout, seed: int) -> float:
    """TTS of the scenario itself from its own start, the mean of two noise draws [veh s]."""
    generator = torch.Generator().manual_seed(seed)
    demand = rollout.demand.unsqueeze(1).expand(-1, 2, -1, -1)
    with torch.no_grad():
        return rollout.total_time_spent(policy, torch.zeros_like(demand[0]), demand, generator).mean().item()


def _state(configuration, step, best, history, policy, optimizer, generator) -> dict:
    return {
        "configuration": configuration, "step": step, "best": best, "history": history,
        "policy": policy.state_dict(), "optimizer": optimizer.state_dict(), "generator": generator.get_state()}


def _restore(state_file: Path, configuration, policy, optimizer, generator) -> tuple[int, float, list]:
    try:
        state = torch.load(state_file, weights_only=True)
    except FileNotFoundError:
        raise InputError(f"{state_file}: nothing to resume; train without --resume") from None
    except Exception:
        raise InputError(f"{state_file}: is damaged; remove it and train without --resume") from None
    for key, value in configuration.items():
        if state["configuration"].get(key) != value:
            raise InputError(
                f"{state_file}: {key}: was {state['configuration'].get(key)!r}, now {value!r}; resume with the same "
                "settings or train without --resume")
    policy.load_state_dict(state["policy"])
    optimizer.load_state_dict(state["optimizer"])
    generator.set_state(state["generator"])
    return state["step"], state["best"], state["history"]


def _write(content: dict, path: Path) -> None:
    with atomic(path) as temporary:
        torch.save(content, temporary)
