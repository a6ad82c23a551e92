"""Batched rollouts of the streets of a city under a policy, for training.

Each rollout has trips and turns of single vehicles of its own (nmfd.model.links.chance), so one may
lock where another one flows. Beyond such a cliff gradients are rough, and the total time spent
jumps: training steps back (nmfd.controllers.training).
"""

import torch
from torch import Generator, nn
from torch.utils._pytree import tree_leaves

from nmfd.controllers.dpc.policy import commanded
from nmfd.controllers.dpc.rollout import Demands, Rollout, States
from nmfd.errors import InputError
from nmfd.model.links.flows import Traffic
from nmfd.model.links.model import Commands, LinkModel, gate_shares
from nmfd.model.planning import PlanningModel
from nmfd.tensors import PerPair

DRAWS = 2**31  # of trips and turns
# Rollouts in an Adam step. Each takes seconds of a processor; 64 take a GPU little longer than one.
BATCH = {"cpu": 6, "cuda": 64}
MOST_DELAYED = 10.0


class Bound:
    """Bound of costates, the derivatives of the loss by vehicles.

    One vehicle more counts for at most MOST_DELAYED vehicles that are there all the time. Costates
    in a city that locks would grow without limit.
    """

    def __init__(self) -> None:
        self._most: torch.Tensor | None = None

    def measure(self, states: Demands) -> None:
        """Measure by states (veh, (T, B, R, R)) what a vehicle counts for."""
        if states.requires_grad:
            states.register_hook(self._measured)

    def hold(self, traffic: Traffic) -> None:
        """Bound the derivatives by all parts of a state."""
        for tensor in tree_leaves(traffic):
            if tensor.requires_grad:
                tensor.register_hook(self._held)

    def _measured(self, derivative: Demands) -> None:
        all_the_time = derivative.abs().amax((0, 2, 3)) * len(derivative)
        self._most = MOST_DELAYED * all_the_time

    def _held(self, derivative: torch.Tensor | None) -> torch.Tensor | None:
        # None: nothing depends on this part.
        if derivative is None or self._most is None:
            return None
        most = self._most.view(-1, *[1] * (derivative.dim() - 1))
        return derivative.clamp(-most, most)


class StreetRollout(Rollout):
    """Link model of a scenario as tensors.

    Observations and demand are those of the planning model. MFDs are not used.
    """

    rough = True

    def __init__(self, planning: PlanningModel, streets: LinkModel):
        flows = streets.flows
        super().__init__(planning, flows.dtype, str(flows.device))
        self.batch = BATCH[flows.device.type]
        self._streets = streets

    def draw_model(
        self, batch: int, spread: float, generator: Generator, scale: float = 1.0
    ) -> None:
        """Draw trips and turns of vehicles for each of `batch` rollouts.

        spread, scale: of MFDs; have no effect
        """
        self._draws = torch.randint(DRAWS, (batch,), generator=generator).tolist()

    def states(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: object = None,
    ) -> tuple[Demands, Demands, Demands]:
        """Return states, observed states and backlog (veh, (T, B, R, R)).

        Raises: InputError if a city does not begin empty
        """
        if x.any():
            raise InputError(
                "--plant: links begin empty; omit preset, and start from no vehicles in sample"
            )
        streets = self._streets
        noise = self.planning.measurement_std * self._normal(generator, *demand.shape)
        traffic = streets.start(len(x), self._draws, chance=True)
        states = [x]
        waiting = [torch.zeros_like(x)]
        bound = Bound()
        for k in range(len(demand) - 1):
            commands = self._commands(policy, states[-1] + noise[k])
            traffic = streets.advance(traffic, demand[k], commands)
            bound.hold(traffic.traffic)
            states.append(streets.accumulation(traffic))
            waiting.append(streets.backlog(traffic))
        exact = torch.stack(states)
        bound.measure(exact)
        return exact, exact + noise, torch.stack(waiting)

    def _commands(self, policy: nn.Module, x: PerPair) -> Commands:
        """Return the commands of a policy in the states x."""
        perimeter, splits = commanded(policy, x)
        by_name = {}
        for name in ("prices", "metering"):
            if hasattr(policy, name):
                by_name[name] = getattr(policy, name)(x)
        gates = gate_shares(self.planning.network, perimeter)
        return Commands(gates=gates, splits=splits, **by_name)
