"""The live page of one viewer: what they look at, and the buttons. Runs and pace are everybody's."""

import time
from functools import partial

from bokeh.document import Document
from bokeh.models import Button, RadioButtonGroup, Select, Slider, TextInput

from cosim.view.budget import Budget
from cosim.view.city_map import DENSITY, SPEED
from cosim.view.curves import MINUTE
from cosim.view.page import Page
from cosim.view.show import Show

EVERY = 200  # ms of wall time between two pictures: 5 Hz, 4 Hz where the browser is slow


class Viewer:
    """A document of the server: it looks at `show` a few times a second, more seldom if `budget` says so."""

    def __init__(self, show: Show, document: Document, budget: Budget):
        """show: whose picture is there; budget: of all viewers"""
        assert show.picture is not None
        self._show, picture = show, show.picture
        self._page = Page(picture, [seen.name for seen in show.runs])
        self._numbers = {edge: n for n, edge in enumerate(picture.edges)}
        self._at: float | None = None  # the time that is looked back at [s], None for the present
        self._by = DENSITY
        self._drawn: tuple[object, ...] = ()
        self._traced: tuple[object, ...] = ()
        self._moving = False
        bar, choices = self._buttons(), self._choices()
        for n, one in enumerate(self._page.maps):
            one.regions.selected.on_change("indices", partial(self._region_clicked, n))
            one.gates.selected.on_change("indices", partial(self._gate_clicked, n))
            one.streets.selected.on_change("indices", partial(self._street_clicked, n))
        self._page.place(
            document,
            f"{len(picture.edges):,} streets, {picture.regions} regions, control interval "
            f"{picture.step:g} s, {picture.steps} intervals",
            bar,
            choices,
            streets=True,
        )
        self._next, self._budget = 0.0, budget
        self.refresh()
        document.add_periodic_callback(self._look, EVERY)

    def _look(self) -> None:
        """Draw, if the last picture is long enough ago."""
        now = time.monotonic()
        if now >= self._next:
            self.refresh()
            self._next = now + (self._budget.slower() - 0.5) * EVERY / 1000.0

    def refresh(self) -> None:
        """Draw what has changed."""
        show = self._show
        now = show.now if self._at is None else min(self._at, show.now)
        frames = [seen.at(now) for seen in show.runs]
        held = [
            frozenset(
                (i, h)
                for (i, h), share in {(i, h): share for _, i, h, share in seen.switched}.items()
                if share is not None
            )
            for seen in show.runs
        ]
        drawn = (now, self._by, *held, *(None if frame is None else (frame.time, frame.whole) for frame in frames))
        whole = [[frame for frame in seen.whole if frame.time <= show.now] for seen in show.runs]
        traced = (self._page.region, self._page.gate, self._page.street, self._at, *(len(frames) for frames in whole))
        if drawn != self._drawn:
            self._page.show(frames, now, self._by, held)
            self._drawn = drawn
        if traced != self._traced:
            self._page.trace(whole, now)
            self._traced = traced
        self._label(now)

    def _buttons(self) -> list:
        self._pause = Button(label="Pause", button_type="primary", name="pause", width=90)
        self._pause.on_click(lambda: self._do(self._show.go if self._show.paused else self._show.pause))
        step = Button(label="Step", name="step", width=70)
        step.on_click(lambda: self._do(self._show.step))
        slower, faster = (Button(label=label, name=label.lower(), width=80) for label in ("Slower", "Faster"))
        self._running = [self._pause, step, slower, faster]
        slower.on_click(lambda: self._do(partial(self._show.hurry, -1)))
        faster.on_click(lambda: self._do(partial(self._show.hurry, 1)))
        picture = self._page.picture
        self._time = Slider(
            start=0.0,
            end=picture.steps * picture.step / MINUTE,
            value=0.0,
            step=picture.step / MINUTE,
            name="time",
            title="time [min]",
            sizing_mode="stretch_width",
        )
        self._time.on_change("value", self._jumped)
        self._live = Button(label="Live", name="live", width=70, button_type="success")
        self._live.on_click(self._back_to_live)
        self._state = Button(label="", name="state", disabled=True, width=200, button_type="light")
        return [self._pause, step, slower, faster, self._time, self._live, self._state]

    def _choices(self) -> list:
        picture = self._page.picture
        colour = RadioButtonGroup(labels=["Density", "Speed"], active=0, name="colour")
        colour.on_change("active", lambda _, __, new: self._coloured((DENSITY, SPEED)[new]))
        self._regions = Select(
            title="Region",
            name="region",
            value=str(self._page.region),
            width=210,
            options=[(str(n), f"{n} {name}") for n, name in enumerate(picture.region_names)],
        )
        self._regions.on_change("value", lambda _, __, new: self._choose(int(new), None))
        self._gates = Select(
            title="Gate",
            name="gate",
            value=_text(self._page.gate),
            width=110,
            options=[_text(gate) for gate in picture.boundaries],
        )
        self._gates.on_change("value", lambda _, __, new: self._choose(self._page.region, _pair(new)))
        self._whose = Select(
            title="of the run",
            name="whose",
            value="0",
            width=200,
            options=[(str(n), seen.name) for n, seen in enumerate(self._show.runs)],
        )
        self._street = TextInput(title="Street", name="street", placeholder="its name, or click it", width=170)
        self._street.on_change("value", lambda _, __, new: self._choose_street(new))
        buttons: list[Button] = []
        for label, name, share in (
            ("Close gate", "close", 0.0),
            ("Open gate", "open", 1.0),
            ("Let go", "release", None),
        ):
            button = Button(label=label, name=name, width=100, disabled=self._page.gate is None)
            button.on_click(partial(self._switch, share))
            buttons.append(button)
        self._running += buttons
        return [colour, self._regions, self._street, self._gates, self._whose, *buttons]

    def _do(self, command: object) -> None:
        command()  # type: ignore[operator]
        self.refresh()

    def _switch(self, share: float | None) -> None:
        if self._page.gate is not None:
            self._show.switch(int(self._whose.value), *self._page.gate, share)

    def _coloured(self, by: str) -> None:
        self._by = by
        self.refresh()

    def _jumped(self, _: str, __: float, new: float) -> None:
        if not self._moving:
            self._at = MINUTE * new
            self.refresh()

    def _back_to_live(self) -> None:
        self._at = None
        self.refresh()

    def _region_clicked(self, n: int, _: str, __: list[int], new: list[int]) -> None:
        source = self._page.maps[n].regions
        if new:
            region = int(source.data["region"][new[0]])
            source.selected.indices = []
            self._choose(region, None)

    def _gate_clicked(self, n: int, _: str, __: list[int], new: list[int]) -> None:
        if new:
            gate = self._page.picture.gates[new[0]]
            self._page.maps[n].gates.selected.indices = []
            self._whose.value = str(n)
            if gate.signal:
                self._choose(gate.target, (gate.source, gate.target))

    def _street_clicked(self, n: int, _: str, __: list[int], new: list[int]) -> None:
        if new:
            self._page.maps[n].streets.selected.indices = []
            self._street.value = self._page.picture.edges[new[0]]

    def _choose_street(self, name: str) -> None:
        """Nothing for a name that no street has."""
        if (name := name.strip()) in self._numbers:
            self._page.choose_street(self._numbers[name])
            self.refresh()

    def _choose(self, region: int, gate: tuple[int, int] | None) -> None:
        """gate: None for the region's first one"""
        if self._moving:
            return
        gate = gate or self._page.gate_of(region)
        if (region, gate) == (self._page.region, self._page.gate):
            return
        self._page.choose(region, gate)
        self._moving = True
        self._regions.value, self._gates.value = str(region), _text(gate)
        self._moving = False
        self.refresh()

    def _label(self, now: float) -> None:
        show = self._show
        self._pause.label = "Go on" if show.paused else "Pause"
        self._moving = True
        self._time.value = min(now / MINUTE, self._time.end)
        self._moving = False
        self._live.button_type = "success" if self._at is None else "default"
        for button in self._running if show.over else ():
            button.disabled = True
        rate = "as fast as SUMO goes" if not show.pace.delay else f"{1.0 / show.pace.delay:,.0f} s per second at most"
        self._state.label = "finished" if show.over else ("paused" if show.paused else rate)


def _text(gate: tuple[int, int] | None) -> str:
    return "" if gate is None else f"{gate[0]} → {gate[1]}"


def _pair(text: str) -> tuple[int, int] | None:
    source, _, target = text.partition(" → ")
    return (int(source), int(target)) if target else None
