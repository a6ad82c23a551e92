"""Everything that is measured in a run: the exact state, what detectors and probes make of it, and the streets.

A plant is in the state that `Meter` counts, vehicle by vehicle. Where controllers are to see an estimate, `Estimation`
reads loop detectors and probes of the same vehicles and filters them; the state stays what it is. `StreetSampler`
has means by street, for route guidance, the queue override and the record.
"""

from dataclasses import replace

from cosim.plant import detectors, sampling
from cosim.plant.detectors import Detectors, Layout
from cosim.plant.incidents import Incidents
from cosim.plant.meter import Event, Meter
from cosim.plant.sampling import StreetMeans, StreetSampler, samples_apart
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.model.estimation import Estimator, Instruments
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Measurement


class Estimation:
    """Loop detectors and probes of one run, and the filter that they feed."""

    def __init__(
        self, session: Session, city: City, layout: Layout, meter: Meter, known: Instruments, model: Scenario,
    ):
        """model: the scenario with the regional model that the filter predicts with"""
        self._meter, self._detectors = meter, Detectors(session, city, layout, meter, known)
        self._filter, self._flow = Estimator(model, known), meter.gateway_flow()

    def silence(self, share: float) -> None:
        """Let a share of the loops tell nothing from now on."""
        self._detectors.silence(share)

    def sample(self) -> None:
        """Read the loops."""
        self._detectors.sample()

    def update(self, controls: Controls) -> None:
        """Filter what was read in the control interval that has just ended under `controls`."""
        flow = self._meter.gateway_flow()
        self._filter.step(controls, self._detectors.observation(flow - self._flow))
        self._flow = flow

    def seen(self, exact: Measurement) -> Measurement:
        """The exact measurement, with what is estimated instead."""
        return replace(exact, estimate=self._filter.accumulation, estimated_backlog=self._detectors.backlog())


class Sensing:
    """`begin` before a control interval, `observe` after every simulation step, `measure` at the end of the interval.

    meter: the exact ledger of this run; streets: means of the last control interval, None before the first has ended
    """

    def __init__(
        self, scenario: Scenario, session: Session, city: City, incidents: Incidents, meter: Meter,
        estimation: Estimation | None,
    ):
        self._step, self._city, self._incidents = scenario.step, city, incidents
        self._estimation, self._sampler = estimation, StreetSampler(session, city)
        steps = round(scenario.step / session.step_length)
        self._loops_apart, self._samples_apart = (
            samples_apart(seconds, session, steps) for seconds in (detectors.EVERY, sampling.EVERY))
        self._observed = 0  # simulation steps of this interval
        self.meter = meter
        self.streets: StreetMeans | None = None

    def first(self) -> Measurement:
        """The state before the first control interval."""
        exact = self.meter.measurement(0, 0.0)
        return self._estimation.seen(exact) if self._estimation else exact

    def begin(self) -> None:
        """A control interval begins."""
        self._observed = 0
        if self._estimation:
            self._estimation.silence(self._incidents.silent_loops)

    def observe(self) -> list[Event]:
        """Account for the last simulation step; which vehicles departed or entered a region in it."""
        events = self.meter.observe()
        self._observed += 1
        if self._estimation and self._observed % self._loops_apart == 0:
            self._estimation.sample()
        if self._observed % self._samples_apart == 0:
            self._sampler.sample()
        return events

    def measure(self, step: int, controls: Controls) -> Measurement:
        """The state at the end of a control interval under `controls`; control step `step` begins now."""
        measurement = self.meter.measurement(step, step * self._step)
        self.streets = self._sampler.finish(self._incidents.closed)
        if self._estimation:
            self._estimation.update(controls)
            measurement = self._estimation.seen(measurement)
        return replace(measurement, problem=self._incidents.problem(estimating=self._estimation is not None))
