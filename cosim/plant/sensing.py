"""Everything that is measured in a run: the exact state, what detectors and probes make of it, and the streets.

The city is in the state that `Meter` counts, vehicle by vehicle. Where controllers are to be given an estimate,
`Estimation` reads loop detectors and probes of the same vehicles and filters them; the state stays what it is.
`StreetSampler` has means by street, for route guidance, the queue override and the record.
"""

from dataclasses import replace

from cosim.plant import detectors, sampling
from cosim.plant.detectors import Detectors, Layout
from cosim.plant.incidents import Incidents
from cosim.plant.meter import Event, Meter
from cosim.plant.observer import Observer
from cosim.plant.sampling import StreetMeans, StreetSampler, samples_apart
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.model.estimation import Estimator, Instruments
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State


class Estimation:
    """Loop detectors and probes of one run, and the filter that they feed."""

    def __init__(
        self, session: Session, city: City, layout: Layout, meter: Meter, known: Instruments, planning: PlanningModel
    ):
        """planning: what the filter predicts with"""
        self._meter, self._detectors = meter, Detectors(session, city, layout, meter, known)
        self._filter, self._flow = Estimator(planning, known), meter.gateway_flow()

    def sample(self) -> None:
        """Read the loops."""
        self._detectors.sample()

    def update(self, controls: Controls) -> None:
        """Filter what was read in the control interval that has just ended under `controls`."""
        flow = self._meter.gateway_flow()
        self._filter.step(controls, self._detectors.readings(flow - self._flow))
        self._flow = flow

    def observation(self, step: int, time: float) -> Observation:
        """The estimate at `time` [s] since the start, when control step `step` begins."""
        return Observation(
            step=step, time=time, accumulation=self._filter.accumulation, backlog=self._detectors.backlog()
        )


class Sensing:
    """`begin` before a control interval, `measure` after every simulation step, `finish` at the end of the interval.

    meter: the exact ledger of this run; streets: means of the last control interval, None before the first has ended
    """

    def __init__(
        self,
        scenario: Scenario,
        session: Session,
        city: City,
        incidents: Incidents,
        meter: Meter,
        estimation: Estimation | None,
        observer: Observer | None = None,
    ):
        """estimation: None where controllers see the exact state; observer: is shown every sample of the streets"""
        self._session, self._observer = session, observer
        self._interval, self._incidents, self._estimation = scenario.step, incidents, estimation
        self._sampler = StreetSampler(session, city)
        steps = round(scenario.step / session.step_length)
        self._loops_apart, self._samples_apart = (
            samples_apart(seconds, session, steps) for seconds in (detectors.EVERY, sampling.EVERY)
        )
        self._measured = 0  # simulation steps of this interval
        self.meter = meter
        self.streets: StreetMeans | None = None

    def state(self, step: int) -> State:
        """The exact state, when control step `step` begins."""
        return self.meter.state(step, step * self._interval)

    def observation(self, step: int) -> Observation | None:
        """The estimate of the same; None where the state itself is measured."""
        return self._estimation.observation(step, step * self._interval) if self._estimation else None

    def begin(self) -> None:
        """A control interval begins."""
        self._measured = 0

    def measure(self) -> list[Event]:
        """Account for the last simulation step; which vehicles departed or entered a region in it."""
        events = self.meter.observe()
        self._measured += 1
        if self._estimation and self._measured % self._loops_apart == 0:
            self._estimation.sample()
        if self._measured % self._samples_apart == 0:
            self._sampler.sample()
            if self._observer:
                self._observer.sampled(self._session.time, *self._sampler.last)
        return events

    def finish(self, step: int, controls: Controls) -> tuple[State, StreetMeans]:
        """The state at the end of a control interval under `controls`, and the means of the interval; control step
        `step` begins now. LedgerError."""
        state = self.state(step)
        self.streets = means = self._sampler.finish(self._incidents.closed)
        if self._estimation:
            self._estimation.update(controls)
        return replace(state, problem=self._incidents.problem()), means
