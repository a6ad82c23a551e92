"""cosim demo: what it says, which page it makes, and that its city locks without gates and flows with them."""

import re
import webbrowser

import made_up
import pytest
from commands import cosim, error_line, good

from cosim.cli import demo
from cosim.evaluation import experiment
from cosim.report import html
from nmfd.api import load_scenario


@pytest.fixture
def made(monkeypatch):
    """Runs that are made up, on another city, without pictures; the addresses that a browser was to open."""
    scenario, opened = load_scenario(made_up.SCENARIO), []
    city = made_up.city_of(scenario.network)
    monkeypatch.setattr(demo, "SCENARIO", made_up.SCENARIO)
    monkeypatch.setattr(
        experiment,
        "outcomes",
        lambda function, todo, workers, **_: ((task, made_up.result(task, city)) for task in todo),
    )
    for module, name in ((html.pictures, "draw"), (html.pictures, "draw_more"), (experiment, "draw_accumulations")):
        monkeypatch.setattr(module, name, lambda *_, **__: None)
    monkeypatch.setattr(html, "_replay", lambda *_: (None, "no map"))
    monkeypatch.setattr(webbrowser, "open", opened.append)
    return opened


def test_it_says_what_came_of_it_and_where_the_page_is(made, tmp_path):
    out = tmp_path / "with space"
    lines = good(cosim("demo", "--seed", 3, "--out", out, "--open")).splitlines()
    assert re.fullmatch(r"no-control:  6,400 of 600 trips served, \d+\.\d minutes per trip", lines[0])
    assert lines[1].startswith("pi-gating: ") and len(lines) == 3
    assert lines[2] == f"Both side by side: {out.resolve() / 'report.html'}" and (out / "report.html").is_file()
    assert made == [(out.resolve() / "report.html").as_uri()] and "%20" in made[0]
    good(cosim("demo", "--seed", 3, "--out", out, "--no-open"))  # finished runs are kept
    assert len(made) == 1


def test_a_folder_of_something_else_is_one_line(made, tmp_path):
    (tmp_path / "x").write_text("")
    assert "x" in error_line(cosim("demo", "--out", tmp_path / "x" / "y", "--no-open"))


@pytest.mark.slow
def test_the_city_locks_without_gates_and_flows_with_them(tmp_path):
    """Half a minute on two cores."""
    said = good(cosim("demo", "--out", tmp_path / "demo", "--no-open")).splitlines()
    (locked, trips), (served, same) = (
        [float(number.replace(",", "")) for number in re.findall(r"[\d,]+(?= of)|(?<=of )[\d,]+", line)]
        for line in said[:2]
    )
    assert trips == same and locked < 0.75 * trips and served > 0.99 * trips
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert "pi-gating instead of no control" in page and len(page) < 8e6
