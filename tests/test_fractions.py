"""Phases and offsets of fractions of a second: gateway signals switch in the same simulation step
as in plain SUMO."""

import numpy as np
import pytest
from test_leaks import SIGNALS, imported
from test_responsive import drive

from cosim.sumo.xml_files import read_xml

DURATIONS = {"halves": (0.5, 0.5), "mixed": (0.3, 0.75)}  # beyond the own ones [s]
OFFSETS = dict(zip(SIGNALS, (0.5, 12.25, -7.5, 0.0), strict=True))  # s


def fractional(beyond):
    """A programme of the network file with phases some fractions longer, and with an offset."""

    def made(net, signal):
        offset = OFFSETS[signal]
        rows = [f'<tlLogic id="{signal}" type="static" programID="more" offset="{offset}">']
        logic = next(one for one in read_xml(net).iter("tlLogic") if one.get("id") == signal)
        for n, phase in enumerate(logic.iter("phase")):
            duration = float(phase.get("duration")) + beyond[n % 2]
            rows.append(f'<phase duration="{duration}" state="{phase.get("state")}"/>')
        return "".join([*rows, "</tlLogic>"])

    return made


@pytest.fixture(scope="module", params=["mixed", pytest.param("halves", marks=pytest.mark.slow)])
def town(request, tmp_path_factory):
    """A city with fixed-time gateway signals, beside actuated signals elsewhere."""
    others = ("--tls.set B1,B2,C1,C2,A1,D2 --tls.default-type actuated",)
    made = fractional(DURATIONS[request.param])
    programmes = [(signal, made) for signal in SIGNALS]
    return imported(tmp_path_factory.mktemp(request.param), programmes, signals=others)


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_open_gates_are_sumo_s_own_signals(town, step):
    """Second by second, and in the traffic."""
    opened = drive(town, [0.9] * 3, step_length=step)
    plain = drive(town, [0.9] * 3, step_length=step, leave_signals=SIGNALS)
    assert not np.isnan(opened.record.gateway_green).all()
    assert np.isnan(plain.record.gateway_green).all()
    assert opened.shown == plain.shown
    assert (opened.record.edge_vehicles == plain.record.edge_vehicles).all()


def test_closed_gates_hold(town):
    held, free = (drive(town, [u] * 3).record for u in (0.1, 0.9))
    assert held.gateway_flow[1:].sum() < 0.5 * free.gateway_flow[1:].sum()
