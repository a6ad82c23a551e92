"""The report: a self-contained page with every number; its card, and names that stay text."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import made_up
import numpy as np
import pandas as pd
import pytest
from commands import cosim, error_line

from cosim.evaluation import results, statistics
from cosim.reporting import figures, html
from nmfd.studies import plots

EVIL = "<script>alert(1)</script>"
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Tags, links and visible words of a page; every tag must be closed."""

    def __init__(self, content: str):
        super().__init__()
        self.open, self.links, self.words, self.cells = [], [], "", []
        self.feed(content)
        self.close()
        assert not self.open

    def handle_starttag(self, name, attributes):
        self.links += [value for key, value in attributes if key in ("src", "href")]
        if name not in VOID:
            self.open.append(name)
        if name == "td":
            self.cells.append("")

    def handle_endtag(self, name):
        assert self.open.pop() == name

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.words += data
        if self.open[-1:] == ["td"]:
            self.cells[-1] += data


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    return made_up.folder(tmp_path_factory.mktemp("runs") / "a<b>&c", levels=(0.8, 1.0))


@pytest.fixture(scope="module")
def content(evaluation):
    """The page, with empty pictures of demand 1 only."""

    def draw(out, finished, level):
        for name in html.PICTURES if level.demand == 1 else ():
            plots.save(plots.figure(2, 1), out / f"{name}.png")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "draw_level", draw)
        result = cosim("report", evaluation)
    assert result.exit_code == 0, result.output + str(result.exception)
    return (evaluation / "report.html").read_text()


def test_the_page_is_valid_and_needs_nothing_else(content):
    read = Page(content)
    pictures = [link for link in read.links if link.startswith("data:image/png;base64,")]
    assert len(pictures) == 2 + 3
    assert set(read.links) == {*pictures, "data:,"}
    assert content.startswith("<!DOCTYPE html>")
    assert len(content) < 8_000_000
    assert "a<b>" not in content
    assert "a<b>&c" in read.words


def test_every_number_of_the_tables_is_there(content, evaluation):
    cells = Page(content).cells
    for row in results.read(evaluation).rows.to_dict("records"):
        assert f"{row['total_time_spent_veh_s']:.7g}" in cells
    level = results.read(evaluation).level()
    emitted = np.mean([run.co2.sum() for run in level.results("dpc-pcrg")])
    assert "By region" in content
    assert {"1,300", "+30.0 %", f"{emitted:,.0f}"} <= set(cells)
    for row in statistics.statistics(results.read(evaluation).rows).to_dict("records"):
        half = row["change_half_interval_percent"]
        assert row["controller"] == "no-control" or any(
            cell.startswith(f"{row['change_percent']:+.1f} ± {half:.1f} %") for cell in cells
        )


def test_doubtful_rows_are_flagged_on_the_card_and_below_the_tables(content):
    words = Page(content).words
    assert words.count("WARNING: vehicles were removed, ") == 1 + 2  # card, and two demand levels
    assert content.index('class="warning"') < content.index('class="card"')
    assert any(cell.endswith(" !") for cell in Page(content).cells)


def test_the_card_has_the_figures_of_the_best_strategy(evaluation):
    rows = (
        results.read(evaluation).level(1.0).rows.assign(mean_trip_time_s=0.0, co2_kg=float("nan"))
    )
    rows.loc[rows["controller"] == "no-control", "mean_trip_time_s"] = 600.0
    rows.loc[rows["controller"] == "dpc-pcrg", "mean_trip_time_s"] = [299.0, 301.0]
    heading, shown, name = html.card(rows)
    assert heading.startswith("dpc-pcrg compared with no control: ")
    assert name == "dpc-pcrg"
    spent, served, trip = shown  # CO2 was not recorded
    assert (trip.value, trip.before, trip.change) == (
        "5.0 min",
        "10.0 min without control",
        "50 ± 2 % less",
    )
    assert served.value == "500"
    assert served.better is None
    times = rows.groupby("controller")["total_time_spent_veh_s"].mean() / 3600
    assert spent.label == "Vehicle hours saved"
    assert spent.value == f"{times['no-control'] - times['dpc-pcrg']:,.0f} veh h"
    assert all(one.verdict == "no proof (2 seeds)" and one.better is None for one in shown)
    third = rows[rows["seed"] == 2000].assign(seed=2002)
    assert html.card(pd.concat([rows, third]))[1][2][-2:] == ("significant", True)
    same = pd.concat([rows, third]).assign(mean_trip_time_s=600.0)
    assert html.card(same)[1][2][-3:] == ("no change", "not significant", None)
    alone = html.card(rows[rows["controller"] == "no-control"])
    assert alone[0] == "no-control"
    assert all(figure.change == "" for figure in alone[1])
    single = html.card(rows[rows["seed"] == 2000])[1]
    assert all(
        one.better is None and one.verdict == "no proof (1 seed)" and "±" not in one.change
        for one in single
    )


@pytest.mark.parametrize(
    "after, change", [(600.0, "no change"), (598.2, "0.3 % less"), (630.0, "5 % more")]
)
def test_a_small_change_of_one_seed_is_not_zero(evaluation, after, change):
    rows = results.read(evaluation).level(1.0).rows
    rows = rows[rows["seed"] == 2000].assign(mean_trip_time_s=600.0)
    rows.loc[rows["controller"] == "dpc-pcrg", "mean_trip_time_s"] = after
    assert html.card(rows)[1][2].change == change


@pytest.mark.slow
def test_names_are_escaped_and_several_folders_fit_on_a_page(evaluation, tmp_path, monkeypatch):
    monkeypatch.setattr(html, "_pictures", lambda *_: [])
    run = results.read(evaluation)
    named = replace(run, scenario=replace(run.scenario, name=EVIL))
    path = html.write_page(tmp_path / "x.html", [named, run], seed=2001)
    page = path.read_text()
    assert EVIL not in page
    assert f"Traffic control in SUMO: {EVIL}" in Page(page).words
    assert "seed 2001" in page
    assert len(re.findall("<h2>", page)) == 2


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("none",), "holds no finished runs"),
        ((".", "--seed", 7), "have no run with seed 7; choose from"),
    ],
)
def test_error_lines(evaluation, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.setattr(html, "_pictures", lambda *_: [])
    folder, *options = arguments
    assert expected in error_line(
        cosim("report", evaluation / folder, *options, "--out", tmp_path / "x.html")
    )
    assert not (tmp_path / "x.html").exists()
