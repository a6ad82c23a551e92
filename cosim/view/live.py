"""The live page: runs in processes of their own, and the Bokeh server that shows them on this
machine."""

import logging
import multiprocessing
import queue
import signal
import sys
import time
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import Button, Select
from bokeh.server.server import Server
from tornado.ioloop import PeriodicCallback

from cosim.evaluation.simulate import Simulation, simulate
from cosim.plant.plant import Observer
from cosim.plant.settings import settings
from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City
from cosim.view.page import Page
from cosim.view.picture import CityPicture, Frame, after, between, first
from nmfd.errors import InputError, RunFailed
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario
from nmfd.studies import plots
from nmfd.types import Controls, State

REFRESH_MS = 250  # between two pictures
FRAME_RATE = 8.0  # frames per second of wall time within control intervals, at most
HOLD_PERIOD_S = 0.05  # between two looks at the page by a run that is held
OPENING_S = 10.0  # time to open the page of runs that have ended
PACES = {
    "as fast as possible": 0.0,
    "slow": 0.02,
    "slower": 0.1,
    "slowest": 0.5,
}  # wall time per simulated second [s]


@dataclass
class Seen:
    """One run as shown so far: frames at the ends of control intervals, the last frame, and summary
    or failure."""

    name: str
    whole: list[Frame] = field(default_factory=list)
    latest: Frame | None = None
    row: dict | None = None
    error: Exception | None = None

    @property
    def over(self) -> bool:
        """True if the run has ended."""
        return self.row is not None or self.error is not None

    def at(self, time: float) -> Frame | None:
        """Return the last frame until a time [s]."""
        if self.latest is not None and self.latest.time <= time:
            return self.latest
        return next((frame for frame in reversed(self.whole) if frame.time <= time), None)


class Show:
    """Runs side by side, each in its own process, at a common pace.

    going: event that is clear while the runs are held; delay: shared value, least wall time per
        simulated second [s]
    """

    def __init__(self, jobs: Sequence[Simulation]):
        spawn = multiprocessing.get_context("spawn")
        self.runs = [Seen(job.strategy.name) for job in jobs]
        self.picture: CityPicture | None = None
        self._messages = spawn.Queue()
        self.going, self.delay = spawn.Event(), spawn.Value("d", 0.0)
        self.going.set()
        self._processes = [
            spawn.Process(
                target=run, args=(n, job, self._messages, self.going, self.delay), daemon=True
            )
            for n, job in enumerate(jobs)
        ]
        for process in self._processes:
            process.start()

    @property
    def over(self) -> bool:
        """True if all runs have ended."""
        return all(seen.over for seen in self.runs)

    @property
    def now(self) -> float:
        """Return the time [s] that all runs without an error have reached."""
        return min(
            (seen.latest.time for seen in self.runs if seen.latest and not seen.error), default=0.0
        )

    def update(self) -> None:
        """Take what the runs have sent."""
        ended = [
            not process.is_alive() for process in self._processes
        ]  # before their last messages are read
        with suppress(queue.Empty):
            while True:
                n, message = (
                    self._messages.get_nowait()
                    if not any(ended)
                    else self._messages.get(timeout=0.05)
                )
                if isinstance(message, CityPicture):
                    self.picture = self.picture or message
                elif isinstance(message, Frame):
                    self.runs[n].latest = message
                    self.runs[n].whole += [message] * message.whole
                elif isinstance(message, Exception):
                    self.runs[n].error = type(message)(f"{self.runs[n].name}: {message}")
                else:
                    self.runs[n].row = message
        for seen, gone, process in zip(self.runs, ended, self._processes, strict=True):
            if gone and not seen.over:
                seen.error = RunFailed(
                    f"{seen.name}: its process ended with exit code {process.exitcode}"
                )

    def close(self) -> None:
        """End the runs that are still under way."""
        for process in self._processes:
            process.terminate()
            process.join()
        self._messages.close()


def run(n: int, job: Simulation, messages: Any, going: Any, delay: Any) -> None:
    """Do a job as number n, and send its picture, frames, and summary or error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends the runs
    try:
        result = simulate(job, observer=Reporter(n, job.scenario, messages, going, delay))
        messages.put((n, summary(result)))
    except (InputError, RunFailed) as error:
        messages.put((n, error))


class Reporter(Observer):
    """The observer of one run: it sends frames and holds the run to the pace; the run stays the
    same otherwise."""

    def __init__(self, n: int, scenario: Scenario, messages: Any, going: Any, delay: Any):
        """going, delay: as in `Show`"""
        self._n, self._messages, self._going, self._delay = n, messages, going, delay
        self._scenario, self._begin = scenario, settings(scenario).begin
        self._sent = self._time = 0.0

    def began(self, city: City, state: State) -> None:
        """Send the city and the first frame."""
        self._picture = CityPicture.of(self._scenario, city)
        self._state, self._frame = state, first(self._picture, len(city.gateways), state)
        self._send(self._picture)
        self._send(self._frame)
        self._wait(0.0)

    def sampled(self, time_: float, vehicles: PerEdge, speed: PerEdge) -> None:
        """Send a frame within a control interval if the last one is old enough."""
        now = time_ - self._begin
        if now < (self._state.step + 1) * self._picture.step - 1e-6:  # else `recorded` follows
            if not self._going.is_set() or time.perf_counter() - self._sent > 1.0 / FRAME_RATE:
                self._send(between(self._picture, self._frame, now, vehicles))
            self._wait(now)

    def recorded(self, controls: Controls, state: State, row: Mapping[str, np.ndarray]) -> None:
        """Send the frame at the end of a control interval."""
        self._frame, self._state = after(self._picture, self._frame, controls, state, row), state
        self._send(self._frame)
        self._wait(state.time)

    def _send(self, message: object) -> None:
        self._messages.put((self._n, message))
        self._sent = time.perf_counter()

    def _wait(self, now: float) -> None:
        """Return when the run may go on from a time [s]."""
        time.sleep(self._delay.value * (now - self._time))
        self._time = now
        parent, held = multiprocessing.parent_process(), True
        while held:
            if parent is not None and not parent.is_alive():
                self._messages.cancel_join_thread()  # the page does not read them any more
                raise RunFailed("the page was closed")
            held = not self._going.wait(HOLD_PERIOD_S)


class Viewer:
    """The page of one browser; pause and pace are common to all."""

    def __init__(self, show: Show, document: Document):
        assert show.picture is not None
        tones = plots.colours(names := [seen.name for seen in show.runs])
        self._show, self._page = show, Page(show.picture, {name: tones[name] for name in names})
        self._traced: tuple[object, ...] = ()
        self._pause = Button(label="Pause", button_type="primary", name="pause", width=90)
        self._pause.on_click(self._toggle)
        pace = Select(
            title="Pace", name="pace", width=170, value=next(iter(PACES)), options=list(PACES)
        )
        pace.on_change("value", lambda _, __, new: setattr(show.delay, "value", PACES[new]))
        self._page.regions.on_change("value", lambda _, __, new: self._choose(int(new)))
        document.title = f"{show.picture.name}: {' against '.join(self._page.names)}"
        document.add_root(self._page.layout([self._pause, pace, self._page.regions]))
        self.refresh()
        document.add_periodic_callback(self.refresh, REFRESH_MS)

    def refresh(self) -> None:
        """Draw what has changed."""
        show, now = self._show, self._show.now
        self._pause.label = (
            "Finished" if show.over else ("Pause" if show.going.is_set() else "Go on")
        )
        self._pause.disabled = show.over
        self._page.show([seen.at(now) for seen in show.runs], now)
        runs = [[frame for frame in seen.whole if frame.time <= now] for seen in show.runs]
        if self._traced != (traced := (self._page.region, *map(len, runs))):
            self._page.trace(runs, now)
            self._traced = traced

    def _toggle(self) -> None:
        going = self._show.going
        going.clear() if going.is_set() else going.set()
        self.refresh()

    def _choose(self, region: int) -> None:
        self._page.choose(region)
        self.refresh()


def watch(jobs: Sequence[Simulation], *, port: int = 0, browse: bool = False) -> list[Seen]:
    """Do simulations side by side with a live page until they have ended and the page is closed.

    port: of the page on this machine; 0 for a free one
    Raises: InputError for a port in use or a strategy that cannot run in the city, RunFailed if a
    run failed
    """
    logging.getLogger("bokeh").setLevel(logging.ERROR)
    show = Show(jobs)
    try:
        while show.picture is None and not show.over:
            show.update()
            time.sleep(0.05)
        if show.picture is not None:
            _serve(show, port, browse)
    finally:
        show.close()
    for seen in show.runs:
        if seen.error is not None:
            raise seen.error
    return show.runs


def _serve(show: Show, port: int, browse: bool) -> None:
    """Serve the page until all runs have ended and no browser is connected."""
    try:
        server = Server(
            {"/": lambda document: Viewer(show, document) and None},
            address="localhost",
            port=port,
            unused_session_lifetime_milliseconds=3000,
            check_unused_sessions_milliseconds=1000,
        )
    except OSError as error:
        raise InputError(
            f"--port {port}: cannot be used ({error.strerror}); choose another one"
        ) from None
    ended_at: float | None = None

    def update() -> None:
        nonlocal ended_at
        show.update()
        if show.over:
            ended_at = ended_at or time.monotonic()
            failed = all(seen.error is not None for seen in show.runs)
            if failed or (not server.get_sessions("/") and time.monotonic() - ended_at > OPENING_S):
                server.io_loop.stop()

    address = f"http://localhost:{server.port}/"
    print(f"cosim: Watch it at {address}", file=sys.stderr)
    if browse:
        webbrowser.open(address)
    server.start()
    PeriodicCallback(update, REFRESH_MS / 2).start()
    try:
        server.io_loop.start()
    finally:
        server.stop()
