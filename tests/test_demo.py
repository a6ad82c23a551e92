"""cosim demo: what it says, which page it makes, and that its city locks without gates and flows
with them."""

import re
from functools import partial

import made_up
import pytest
from commands import cosim, good

from cosim import api
from cosim.reporting import html
from nmfd.api import load_scenario


@pytest.fixture
def made(monkeypatch):
    """Runs that are made up, on another city, without pictures."""
    scenario = load_scenario(made_up.SCENARIO)
    city = made_up.city_of(scenario.network)
    monkeypatch.setattr(api, "DEMO", made_up.SCENARIO)
    made_up.instead_of_sumo(monkeypatch, partial(made_up.result, city=city))
    monkeypatch.setattr(html, "_pictures", lambda *_: [])
    monkeypatch.setattr(html, "map_of", lambda *_, **__: html.Map(0, "", []))


def test_report_and_page(made, tmp_path):
    out = tmp_path / "with space"
    lines = good(cosim("demo --out", out)).splitlines()
    assert re.fullmatch(
        r"no-control:  6,400 of 600 trips completed, \d+\.\d minutes per trip", lines[0]
    )
    assert lines[1].startswith("pi-gating: ")
    assert len(lines) == 3
    assert f"Both side by side: {out.resolve() / 'report.html'}; next: " in lines[2]
    assert (out / "report.html").is_file()
    good(cosim("demo --out", out))  # finished runs are kept


@pytest.mark.slow
def test_the_city_locks_without_gates_and_flows_with_them(tmp_path):
    """Half a minute on two cores."""
    said = good(cosim("demo --out", tmp_path / "demo")).splitlines()
    (locked, trips), (served, same) = (
        [
            float(number.replace(",", ""))
            for number in re.findall(r"[\d,]+(?= of)|(?<=of )[\d,]+", line)
        ]
        for line in said[:2]
    )
    assert trips == same
    assert locked < 0.75 * trips
    assert served > 0.99 * trips
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert "pi-gating compared with no control" in page
    assert len(page) < 8e6
