"""A signal control of one's own is one class and one entry."""

import cosim
from cosim.plant.gates import Green
from cosim.plant.settings import SIGNAL_CONTROLS, SignalControl
from cosim.plant.strategy import parse, vocabulary
from cosim.sumo.net import gateway_movements


class Turns:
    """Every signal shows the phases of its programme in turn, each for five seconds."""

    def __init__(self, session, city, signals, flows, *, show, lookahead):
        self._show = show
        self._signals = signals
        self._links = gateway_movements(city)

    def command(self, share):
        """Ignore the gates."""

    def play(self, now):
        for signal in self._signals:
            phase = int(now // 5) % len(signal.phases)
            self._show(signal.id, signal.phases[phase].state)

    def green_time(self):
        green = {}
        for signal in self._signals:
            green[signal.id] = dict.fromkeys(self._links.get(signal.id, ()), Green(0.0, 0.0))
        return green


def test_a_new_signal_control_runs_by_its_name(monkeypatch):
    control = SignalControl("all phases in turn", f"{__name__}:Turns")
    monkeypatch.setitem(SIGNAL_CONTROLS, "turns", control)
    assert vocabulary()["+turns"] == "all phases in turn"
    assert parse("no-control+turns").city == cosim.Settings(signals="turns")
    result = cosim.run("demo", "no-control+turns", steps=4)
    plain = cosim.run("demo", "no-control", steps=4)
    assert result.controller == "no-control+turns"
    assert (result["gateway_flow"] != plain["gateway_flow"]).any()
