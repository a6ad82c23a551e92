"""Live page: runs in processes of their own, and the server of the page.

The server answers on this machine only.
"""

import logging
import multiprocessing
import queue
import re
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
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.routing import HostMatches, Rule, RuleRouter

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
LAST_MESSAGES_S = 0.05  # wait for messages of a process that has ended
OPENING_S = 10.0  # time to open the page of runs that have ended
PACES = {  # wall time per simulated second [s]
    "as fast as possible": 0.0,
    "slow": 0.02,
    "slower": 0.1,
    "slowest": 0.5,
}
# The root of the page is empty until Bokeh has drawn it.
TEMPLATE = """
{% block inner_head %}
{{ super() }}
<style>
h1 { font: 600 22px sans-serif; margin: 8px 6px; overflow-wrap: anywhere; }
[data-root-id]:empty::before {
  content: "Loading: the browser draws the map and curves. SUMO is under way meanwhile.";
  font: 15px sans-serif;
  margin-left: 6px;
}
</style>
{% endblock %}
{% block contents %}
<h1>{{ title | e }}</h1>
{{ super() }}
{% endblock %}
"""
HOSTS = ("localhost", "127.0.0.1", "[::1]")  # names of this machine that a browser may ask for


@dataclass
class Seen:
    """One run as shown so far.

    whole: frames at the ends of control intervals
    latest: the last frame
    row, error: summary or failure of a run that has ended
    """

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
        for frame in reversed(self.whole):
            if frame.time <= time:
                return frame
        return None


class Show:
    """Runs side by side, each in its own process, at a common pace.

    going: event that is clear while the runs are held
    delay: shared value, least wall time per simulated second [s]
    """

    def __init__(self, jobs: Sequence[Simulation]):
        spawn = multiprocessing.get_context("spawn")
        self.runs = [Seen(job.strategy.name) for job in jobs]
        self.picture: CityPicture | None = None
        self._messages = spawn.Queue()
        self.going = spawn.Event()
        self.delay = spawn.Value("d", 0.0)
        self.going.set()
        self._processes = []
        for n, job in enumerate(jobs):
            given = (n, job, self._messages, self.going, self.delay)
            process = spawn.Process(target=run, args=given, daemon=True)
            process.start()
            self._processes.append(process)

    @property
    def over(self) -> bool:
        """True if all runs have ended."""
        return all(seen.over for seen in self.runs)

    @property
    def now(self) -> float:
        """Return the time [s] that all runs without an error have reached."""
        times = [seen.latest.time for seen in self.runs if seen.latest and not seen.error]
        return min(times, default=0.0)

    def update(self) -> None:
        """Take what the runs have sent."""
        # Asked before the messages are read: the last ones may still be on their way.
        ended = [not process.is_alive() for process in self._processes]
        with suppress(queue.Empty):
            while True:
                n, message = self._messages.get(block=any(ended), timeout=LAST_MESSAGES_S)
                self._take(self.runs[n], message)
        for seen, gone, process in zip(self.runs, ended, self._processes, strict=True):
            if gone and not seen.over:
                reason = f"its process ended with exit code {process.exitcode}"
                seen.error = RunFailed(f"{seen.name}: {reason}")

    def _take(self, seen: Seen, message: Any) -> None:
        if isinstance(message, CityPicture):
            self.picture = self.picture or message
        elif isinstance(message, Frame):
            seen.latest = message
            if message.whole:
                seen.whole.append(message)
        elif isinstance(message, Exception):
            seen.error = type(message)(f"{seen.name}: {message}")
        else:
            seen.row = message

    def close(self) -> None:
        """End the runs that are still under way."""
        for process in self._processes:
            process.terminate()
            process.join()
        self._messages.close()


def run(n: int, job: Simulation, messages: Any, going: Any, delay: Any) -> None:
    """Do a job, and send its picture, frames, and summary or error.

    n: its number, sent with every message
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends the runs
    try:
        result = simulate(job, observer=Reporter(n, job.scenario, messages, going, delay))
        messages.put((n, summary(result)))
    except (InputError, RunFailed) as error:
        messages.put((n, error))


class Reporter(Observer):
    """Observer of one run: it sends frames and holds the run to the pace.

    The run stays the same otherwise.
    """

    def __init__(self, n: int, scenario: Scenario, messages: Any, going: Any, delay: Any):
        """going, delay: as in `Show`"""
        self._n = n
        self._messages = messages
        self._going = going
        self._delay = delay
        self._scenario = scenario
        self._begin = settings(scenario).begin
        self._sent = 0.0
        self._time = 0.0

    def began(self, city: City, state: State) -> None:
        """Send the city and the first frame."""
        self._state = state
        self._picture = CityPicture.of(self._scenario, city)
        self._frame = first(self._picture, len(city.gateways), state)
        self._send(self._picture)
        self._send(self._frame)
        self._wait(0.0)

    def sampled(self, time_: float, vehicles: PerEdge, speed: PerEdge) -> None:
        """Send a frame within a control interval if the last one is old."""
        now = time_ - self._begin
        end = (self._state.step + 1) * self._picture.step
        if now >= end - 1e-6:
            return  # `recorded` follows
        held = not self._going.is_set()
        if held or time.perf_counter() - self._sent > 1.0 / FRAME_RATE:
            self._send(between(self._picture, self._frame, now, vehicles))
        self._wait(now)

    def recorded(self, controls: Controls, state: State, row: Mapping[str, np.ndarray]) -> None:
        """Send the frame at the end of a control interval."""
        self._state = state
        self._frame = after(self._picture, self._frame, controls, state, row)
        self._send(self._frame)
        self._wait(state.time)

    def _send(self, message: object) -> None:
        self._messages.put((self._n, message))
        self._sent = time.perf_counter()

    def _wait(self, now: float) -> None:
        """Return when the run may go on from a time [s]."""
        time.sleep(self._delay.value * (now - self._time))
        self._time = now
        parent = multiprocessing.parent_process()
        may_go = False
        while not may_go:
            if parent is not None and not parent.is_alive():
                self._messages.cancel_join_thread()  # the page does not read them any more
                raise RunFailed("the page was closed")
            may_go = self._going.wait(HOLD_PERIOD_S)


class Viewer:
    """Page of one browser; pause and pace are common to all."""

    def __init__(self, show: Show, document: Document):
        assert show.picture is not None
        names = [seen.name for seen in show.runs]
        tones = plots.colours(names)
        self._show = show
        self._page = Page(show.picture, {name: tones[name] for name in names})
        self._traced: tuple[object, ...] = ()
        self._pause = Button(label="Pause", button_type="primary", name="pause", width=90)
        self._pause.on_click(self._toggle)
        paces = list(PACES)
        pace = Select(title="Pace", name="pace", width=170, value=paces[0], options=paces)
        pace.on_change("value", self._set_pace)
        self._page.regions.on_change("value", self._choose)
        document.title = f"{show.picture.name}: {' against '.join(self._page.names)}"
        document.template = TEMPLATE
        document.add_root(self._page.layout([self._pause, pace, self._page.regions]))
        self.refresh()
        document.add_periodic_callback(self.refresh, REFRESH_MS)

    def refresh(self) -> None:
        """Draw what has changed."""
        show = self._show
        now = show.now
        if show.over:
            self._pause.label = "Finished"
        elif show.going.is_set():
            self._pause.label = "Pause"
        else:
            self._pause.label = "Go on"
        self._pause.disabled = show.over
        self._page.show([seen.at(now) for seen in show.runs], now)
        runs = [[frame for frame in seen.whole if frame.time <= now] for seen in show.runs]
        traced = (self._page.region, *map(len, runs))
        if traced != self._traced:
            self._page.trace(runs, now)
            self._traced = traced

    def _toggle(self) -> None:
        going = self._show.going
        if going.is_set():
            going.clear()
        else:
            going.set()
        self.refresh()

    def _set_pace(self, _: str, __: str, name: str) -> None:
        self._show.delay.value = PACES[name]

    def _choose(self, _: str, __: str, region: str) -> None:
        self._page.choose(int(region))
        self.refresh()


class PageServer:
    """Server of the live page on this machine.

    address: of the page
    loop: tornado's event loop, in which it answers
    """

    def __init__(self, show: Show, port: int = 0):
        """Bind the port, a free one if 0. Raises InputError for a port in use."""
        try:
            sockets, port = bind_sockets("localhost", port)
        except OSError as error:
            raise InputError(
                f"--port {port}: cannot be used ({error.strerror}); choose another one"
            ) from None
        self._show = show
        self._ended_at: float | None = None
        self.address = f"http://localhost:{port}/"
        application = BokehTornado(
            {"/": self._open},
            absolute_url=self.address,
            extra_websocket_origins=[f"{host}:{port}" for host in HOSTS],
            unused_session_lifetime_milliseconds=3000,
            check_unused_sessions_milliseconds=1000,
        )
        # A web page that has its own name lead to this machine (DNS rebinding) asks for that name.
        names = "|".join(map(re.escape, HOSTS))
        http = HTTPServer(RuleRouter([Rule(HostMatches(f"({names})$"), application)]))
        http.add_sockets(sockets)
        self.loop = IOLoop.current()
        self._server = BaseServer(self.loop, application, http)

    def run(self) -> None:
        """Serve until all runs have ended and no browser is connected."""
        self._server.start()
        PeriodicCallback(self._update, REFRESH_MS / 2).start()
        try:
            self.loop.start()
        finally:
            self._server.stop()

    def _open(self, document: Document) -> None:
        Viewer(self._show, document)

    def _update(self) -> None:
        """Take what the runs have sent, and stop if nobody looks any more."""
        self._show.update()
        if not self._show.over:
            return
        if all(seen.error is not None for seen in self._show.runs):
            self.loop.stop()
            return
        now = time.monotonic()
        if self._ended_at is None:
            self._ended_at = now
        if now - self._ended_at > OPENING_S and not self._server.get_sessions("/"):
            self.loop.stop()


def watch(jobs: Sequence[Simulation], *, port: int = 0, browse: bool = False) -> list[Seen]:
    """Do simulations side by side with a live page.

    Return when they have ended and the page is closed.

    port: of the page on this machine; 0 for a free one
    browse: True opens the page in a browser
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
            server = PageServer(show, port)
            print(f"cosim: Watch it at {server.address}", file=sys.stderr)
            if browse:
                webbrowser.open(server.address)
            server.run()
    finally:
        show.close()
    for seen in show.runs:
        if seen.error is not None:
            raise seen.error
    return show.runs
