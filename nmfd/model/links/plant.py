"""The link model as a plant, in float64."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nmfd import ledger
from nmfd.errors import InputError
from nmfd.model.links.flows import Numbers
from nmfd.model.links.model import Commands, LinkModel, choices_of, gate_shares
from nmfd.model.links.network import FILE, LinkNetwork, read_links
from nmfd.model.links.signals import FIXED
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State

DT_S = 2.0  # time step; a second if it does not divide the control interval


class LinkPlant:
    """City of streets without SUMO (nmfd.types.Plant).

    `cosim links` writes its file.

    A seed chooses a draw of trips of the file, and where each vehicle turns. The city begins empty.

    >>> plant = nmfd.LinkPlant(nmfd.load_scenario("grid7_peak"))
    >>> plant.reset(0).time
    0.0

    model: for rollouts with gradients; state: of one rollout
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        network: LinkNetwork | None = None,
        numbers: Numbers | None = None,
        labels: Sequence[str] = (),
        gated: bool = True,
        chance: bool = True,
    ):
        """network: that of the scenario's file if None
        numbers: those of the network if None
        labels, gated: of a strategy, as in `choices_of`
        chance: single vehicles draw their turns; without, streams divide

        Raises: InputError if the file is missing or does not fit the scenario
        """
        self._scenario = scenario
        self._chance = chance
        self.model = link_model(
            scenario,
            network=network,
            numbers=numbers,
            labels=labels,
            gated=gated,
            dtype=torch.float64,
        )
        self._demand = torch.from_numpy(scenario.demand).unsqueeze(1)

    def reset(self, seed: int) -> State:
        """Return the empty city."""
        self.state = self.model.start(1, [seed], chance=self._chance)
        self._realised: np.ndarray | None = None
        return self._state()

    def step(self, controls: Controls) -> State:
        """Advance by one control interval.

        Raises: LedgerError if vehicles appear or vanish
        """
        network = self._scenario.network
        perimeter = torch.from_numpy(controls.perimeter).unsqueeze(0)
        commands = Commands(
            gates=gate_shares(network, perimeter),
            metering=_batch(controls.metering),
            splits=_batch(controls.splits),
            prices=_batch(controls.prices),
        )
        demand = self._demand[self.state.interval]
        with torch.inference_mode():
            self.state = self.model.advance(self.state, demand, commands)
        share = self.state.realised[0].numpy()
        self._realised = network.u_min + share * (network.u_max - network.u_min)
        state = self._state()
        ledger.check(
            state.step,
            state.time,
            entered=float(self.state.begun),
            ended=state.completed,
            inside=float(state.unfinished.sum()),
            least=float(state.accumulation.min()),
        )
        return state

    def observe(self) -> Observation | None:
        """Return None: controllers observe the state with noise."""

    def _state(self) -> State:
        step = self.state.interval
        return State(
            step=step,
            time=step * self._scenario.step,
            accumulation=self.model.accumulation(self.state)[0].numpy(),
            backlog=self.model.backlog(self.state)[0].numpy(),
            completed=float(self.state.traffic.completed.sum()),
            realised=self._realised,
        )


def link_model(
    scenario: Scenario,
    *,
    network: LinkNetwork | None = None,
    numbers: Numbers | None = None,
    labels: Sequence[str] = (),
    gated: bool = True,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> LinkModel:
    """Return the link model of a scenario.

    network, numbers, labels, gated: as of LinkPlant
    Raises: InputError if the file is missing or does not fit the scenario
    """
    where = links_file(scenario)
    network = network or read_links(where)
    if scenario.initial is not None:
        raise InputError(f"{scenario.where}: initial: a city of links begins empty; remove it")
    if scenario.step % 1.0:
        raise InputError(f"{scenario.where}: step: expected whole seconds, got {scenario.step:g}")
    _check_demand(scenario, network, where)
    choices = choices_of(scenario, labels, gated=gated)
    if choices.signals != FIXED and not len(network.stages):
        raise InputError(
            f"{scenario.where}: sumo.signals: {choices.signals} needs signals with several "
            f"green phases, but {where} has none; choose {FIXED}"
        )
    return LinkModel(
        network,
        scenario.step,
        nominal=scenario.network.nominal_splits,
        numbers=numbers or Numbers(*network.numbers.tolist()),
        choices=choices,
        dt=1.0 if scenario.step % DT_S else DT_S,
        dtype=dtype,
        device=device,
    )


def links_file(scenario: Scenario) -> Path:
    """Return the file of a scenario's link network."""
    return (scenario.folder or Path()) / FILE


def _batch(command: np.ndarray | None) -> torch.Tensor | None:
    """Return a command as one of a batch of one."""
    return None if command is None else torch.from_numpy(command).unsqueeze(0)


def _check_demand(scenario: Scenario, network: LinkNetwork, where: Path) -> None:
    """Check that all trips have routes. Raises InputError."""
    regions = network.regions
    remedy = "write it with 'cosim links'"
    if regions != scenario.network.regions:
        raise InputError(
            f"{where}: has {regions} regions, the scenario {scenario.network.regions}; {remedy}"
        )
    pair = network.region[network.entry_link] * regions + network.destination
    begin = np.bincount(pair, network.origin.max(axis=0), regions**2).reshape(regions, regions)
    missing = (scenario.demand.sum(axis=0) > 0.0) & (begin == 0.0)
    if missing.any():
        i, j = np.argwhere(missing)[0]
        raise InputError(f"{where}: no route leads from region {i} to region {j}; {remedy}")
