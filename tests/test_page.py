"""The report: a valid page that needs nothing else, holds every number, and says in words what the numbers say."""

import base64
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import made_up
import pandas as pd
import pytest
from commands import cosim, error_line
from made_up import rows_of

from cosim.evaluation import results
from cosim.evaluation import statistics as tables
from cosim.report import card, html, summary_text

VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """The texts of table cells and of everything, what is referred to, and whether all that opens is closed."""

    def __init__(self, content: str):
        super().__init__()
        self.open, self.links, self.ids, self.tags = [], [], [], []
        self.tables, self.words, self.rows, self.scripts = {}, "", None, []
        self.feed(content)
        self.close()
        assert not self.open

    def handle_starttag(self, name, attributes):
        values = dict(attributes)
        self.tags.append(name)
        self.links += [values[key] for key in ("src", "href", "srcset", "data", "action") if key in values]
        self.ids += [values["id"]] if "id" in values else []
        if name not in VOID:
            self.open.append(name)
        if name == "div" and values.get("role") == "region":
            self.rows = self.tables.setdefault(values["aria-label"], [])
        elif name == "tr":
            self.rows.append([])
        elif name in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, name):
        assert self.open.pop() == name

    def handle_data(self, data):
        if self.open[-1:] == ["script"]:
            self.scripts.append(data)
        elif "style" not in self.open:
            self.words += data
        if self.open[-1:] and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """Two levels and three controllers, in a folder with a name that is no HTML."""
    return made_up.folder(tmp_path_factory.mktemp("runs") / "a<b>&c", levels=(0.8, 1.0))


@pytest.fixture(scope="module")
def content(evaluation):
    """The page, with pictures at demand 1 only: they take most of the time."""
    draw, more = html.pictures.draw, html.pictures.draw_more
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(html.pictures, "draw", lambda *a: draw(*a) if a[3]["demand"].iloc[0] == 1 else None)
        patch.setattr(html.pictures, "draw_more", lambda *a: more(*a) if a[3]["demand"].iloc[0] == 1 else None)
        result = cosim("report", evaluation, "--reference", "pi-gating")
    assert result.exit_code == 0, result.output + str(result.exception)
    return (evaluation / "report.html").read_text()


@pytest.fixture
def blind(monkeypatch):
    for name in ("draw", "draw_more"):
        monkeypatch.setattr(html.pictures, name, lambda *_: None)
    monkeypatch.setattr(html, "_replay", lambda *_: (None, "no map"))


def test_the_page_is_valid_and_needs_nothing_else(content):
    read = Page(content)
    assert content.startswith("<!DOCTYPE html>") and read.tags.count("html") == read.tags.count("main") == 1
    assert len(read.ids) == len(set(read.ids))
    pictures = [link for link in read.links if link.startswith("data:image/png;base64,")]
    assert len(pictures) == 1 + 5
    assert all(base64.b64decode(link.partition(",")[2]).startswith(b"\x89PNG") for link in pictures)
    for link in set(read.links) - set(pictures):
        assert link == "data:," or (link.startswith("#") and link[1:] in read.ids)
    plain = re.sub(r"(base64,|sha256-)[\w+/=]+", "", re.sub(r"(?s)<script>.*?</script>", "", content))
    assert "//" not in plain and "url(" not in plain and "@import" not in plain
    assert len(content) < 8_000_000


def test_no_script_runs_but_those_of_the_page(content):
    allowed = re.search(r"default-src 'none'; .*; script-src ([^;\"]*) 'unsafe-eval'\"", content)[1].split()
    scripts = Page(content).scripts
    assert "sort" in scripts[-1] and len(scripts) == 5 and any("dpc-pcrg" in text for text in scripts)
    assert allowed == [
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in scripts
    ]


def test_every_column_says_what_it_is(content):
    headings = re.findall(r'<th scope="col"( title="[^"]+")?>([^<]+)<', content)
    assert len(headings) > 2 * 60 and [name for told, name in headings if not told] == []


def test_the_card_has_the_figures_of_the_best_strategy(evaluation):
    rows = (
        results.read(evaluation)
        .level(1.0)
        .rows.assign(mean_trip_time_s=0.0, mean_departure_delay_s=0.0, co2_kg=float("nan"))
    )
    rows.loc[rows["controller"] == "no-control", "mean_trip_time_s"] = 600.0
    rows.loc[rows["controller"] == "dpc-pcrg", "mean_trip_time_s"] = [269.0, 271.0]
    rows.loc[rows["controller"] == "dpc-pcrg", "mean_departure_delay_s"] = 30.0
    heading, figures, name = card.card(rows)
    assert heading == "dpc-pcrg instead of no control" and name == "dpc-pcrg"
    trip, served, saved = figures  # CO2 was not recorded
    assert (trip.value, trip.before, trip.better) == ("5.0 min", "10.0 min without control", True)
    assert trip.change == "-50 % ± 2 (95 %, 2 seeds)"
    assert served.value == "500" and served.better is None
    tts = rows.groupby("controller")["total_time_spent_veh_s"].mean() / 3600
    assert saved.label == "Hours of delay saved" and saved.better
    assert saved.value == f"{tts['no-control'] - tts['dpc-pcrg']:,.0f} h"
    alone = card.card(rows[rows["controller"] == "no-control"])
    assert alone[0] == "no-control" and all(figure.change == "" for figure in alone[1])


def test_a_single_seed_claims_nothing(evaluation):
    rows = results.read(evaluation).level(1.0).rows
    assert all(
        figure.better is None and figure.change.endswith("on one seed")
        for figure in card.card(rows[rows["seed"] == 2000])[1]
    )


def test_names_are_escaped(content, evaluation, tmp_path, blind):
    assert "a<b>" not in content and "a<b>&c" in Page(content).words
    run, name = results.read(evaluation / "demand-1"), "\"'><script>alert(1)</script>"
    named = replace(run, scenario=replace(run.scenario, name=name))
    page = html.write_page(tmp_path / "x.html", [named]).read_text()
    assert name not in page and f"Traffic control in SUMO: {name}" in Page(page).words


def test_why_a_strategy_gains_is_told(content, evaluation):
    """The lines of evaluate.md, at every demand level."""
    why = (evaluation / "evaluate.md").read_text().partition("## Why")[2]
    lines = [line.removeprefix("- ") for line in why.splitlines() if line.startswith("- ")]
    assert len(lines) == 2 * 2 and "Signals under control see" in why
    words = Page(content).words
    for line in [*lines, *(line for line in why.splitlines() if line.startswith("Signals under"))]:
        assert html.typeset(line) in words, line


def test_every_number_of_the_tables_is_there(content, evaluation):
    read = Page(content)
    runs = pd.read_csv(evaluation / "runs.csv", keep_default_na=False, dtype=str)
    header = read.tables["runs"][0]
    every = [row for row in read.tables["runs"] if row[0] != "controller"]
    assert set(header) == set(runs.columns) and len(every) == len(runs)
    for shown, row in zip(every, runs[header].itertuples(index=False), strict=True):
        for value, wanted in zip(shown, row, strict=True):
            try:
                assert float(value) == pytest.approx(float(wanted), rel=1e-6)
            except ValueError:
                assert value == (wanted or "–")
    statistics = pd.read_csv(evaluation / "evaluate.csv")
    for level in (0.8, 1.0):
        cells = sum(read.tables[f"What came of it, demand times {level:g}"], [])
        for row in statistics[statistics["demand"] == level].to_dict("records"):
            half = row["change_half_interval_percent"]
            assert f"{row['mean_' + tables.TTS]:.3e} ± {row['half_interval_' + tables.TTS]:.1e}" in cells
            assert row["controller"] == "no-control" or any(
                cell.startswith(f"{row['change_percent']:+.1f} ± {half:.1f} %") for cell in cells
            )
    assert "against pi-gating" in read.tables["What came of it, demand times 1"][0]
    for word in ("demand_hash", "libsumo", "2000 to 2001", "outflow_share"):
        assert word in read.words


def test_it_says_what_was_best_and_on_which_seeds(content):
    words = " ".join(Page(content).words.split()).replace("\N{NO-BREAK SPACE}", " ")
    assert "At demand times 0.8: The best strategy was dpc-pcrg" in words and "seeds 2000 to 2001" in words
    assert "Without control, the region north-west held more vehicles than it serves best with for 67 % of" in words
    assert "because signals at the boundaries held vehicles back and drivers were guided to other routes." in words
    assert "pi-gating 6" in words and "Trips not completed at the end, mean per run: no-control 100 of 600" in words
    assert "Pictures of single runs show seed 2000 and, where two are compared, no-control and dpc-pcrg" in words


def test_several_folders_and_one_level_on_a_page(evaluation, tmp_path, blind):
    one = evaluation / "demand-1"
    arguments = ("report", one, one, "--out", tmp_path / "x.html")
    assert cosim(*arguments).exit_code == 0
    read = Page((tmp_path / "x.html").read_text())
    assert [link for link in read.links if link.startswith("#")] == ["#run-0", "#run-1"] == [f"#{i}" for i in read.ids]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.html"]


def test_an_old_folder_and_a_changed_city_give_a_page_with_what_there_is(evaluation, tmp_path, monkeypatch):
    one = tmp_path / "one"
    shutil.copytree(evaluation / "demand-1", one)
    facts = pd.read_csv(one / "sumo.csv").drop(columns="co2_kg")
    facts.to_csv(one / "sumo.csv", index=False)
    text = (one / "manifest.json").read_text()
    (one / "manifest.json").write_text(re.sub(r'"net_file_hash": "\w+"', '"net_file_hash": "0"', text))
    assert cosim("report", one).exit_code == 0
    read = Page((one / "report.html").read_text())
    assert "has changed since the runs were made" in read.words and "nan" not in read.words.split()
    assert {row[3] for row in read.tables["How, demand times 1"][1:]} == {"–"}  # CO2
    assert "There is no map with a slider" in read.words and "CO2\n" not in read.words


def test_a_failure_leaves_the_old_page(evaluation, tmp_path, monkeypatch):
    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(html.pictures, "draw", fail)
    (tmp_path / "report.html").write_text("old")
    assert cosim("report", evaluation, "--out", tmp_path / "report.html").exit_code == 130
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize(
    "name, arguments, expected",
    [
        ("none", (), "holds no finished runs; give a folder of `cosim run` or `cosim evaluate`"),
        ("one", ("--reference", "mpc-pc"), "--reference: 'mpc-pc' is not in these runs; did you mean dpc-pcrg"),
        ("one", ("--scenario", made_up.SCENARIO.with_name("economic_mpc")), "the runs are of grid7_peak"),
        ("lost", (), "scenario_folder: there is no gone; give it with --scenario"),
        ("broken", (), "manifest.json: is no manifest of runs in SUMO"),
    ],
)
def test_error_lines(evaluation, tmp_path, name, arguments, expected):
    folder = tmp_path / name
    if name != "none":
        shutil.copytree(evaluation / "demand-1", folder)
    manifest = folder / "manifest.json"
    if name == "lost":
        manifest.write_text(re.sub(r'"scenario_folder": "[^"]+"', '"scenario_folder": "gone"', manifest.read_text()))
    if name == "broken":
        manifest.write_text("{}")
    assert expected in error_line(cosim("report", folder, *arguments))
    assert not (folder / "report.html").exists()


DAMAGED = {
    "runs.csv": "is no table of runs",
    "demand-1/sumo.csv": "is no table of runs",
    "demand-1/summary.csv": "delete",
    "demand-1/manifest.json": "is no manifest of runs",
    "demand-1/pi-gating-2000.nc": "is no run",
}


@pytest.mark.parametrize("name, expected", DAMAGED.items())
def test_damaged_files_are_one_line(evaluation, tmp_path, blind, name, expected):
    """Empty, noise, cut in two, and something else; no page is written."""
    folder = tmp_path / "runs"
    shutil.copytree(evaluation, folder, ignore=shutil.ignore_patterns("demand-0.8", "report.html"))
    whole = (folder / name).read_bytes()
    contents = (
        [b"\0\xff\xfe" * 100, whole[: len(whole) // 2]]
        if name.endswith((".nc", ".json"))
        else [b"", b"\0\xff\xfe" * 100, b"a,b\n1,2\n"]
    )
    for content in contents:
        (folder / name).write_bytes(content)
        line = error_line(cosim("report", folder))
        assert name.rpartition("/")[2] in line and expected in line, content
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("key, value", [("demand_factor", "x"), ("steps", None), ("step_s", [1])])
def test_a_manifest_with_a_wrong_value(evaluation, tmp_path, key, value):
    shutil.copytree(evaluation / "demand-1", tmp_path / "one")
    file = tmp_path / "one" / "manifest.json"
    content = json.loads(file.read_text())
    content["configuration"][key] = value
    file.write_text(json.dumps(content))
    assert "is no manifest of runs in SUMO" in error_line(cosim("report", tmp_path / "one"))


def test_a_run_whose_row_is_gone_is_not_shown(evaluation, tmp_path, monkeypatch):
    shutil.copytree(evaluation / "demand-1", tmp_path / "one")
    file, shown = tmp_path / "one" / "sumo.csv", []
    file.write_text("".join([line for line in file.open() if "pi-gating" not in line]))
    monkeypatch.setattr(html.pictures, "draw_accumulations", lambda out, scenario, runs, **_: shown.extend(runs))
    run = results.read(tmp_path / "one")
    html.pictures.draw(tmp_path / "one", run.scenario, None, run.rows)
    assert {trajectory.controller for trajectory in shown} == {"no-control", "dpc-pcrg"}


def rows(**times):
    return rows_of({(1.0, name.replace("_", "-")): values for name, values in times.items()}).assign(
        trips=100, completed_veh=100.0, teleports=0
    )


def test_the_words_of_worked_examples():
    three = rows(no_control={1: 100.0, 2: 200.0, 3: 300.0}, pi_gating={1: 90.0, 2: 160.0, 3: 210.0})
    text = summary_text.best(three)  # -20 ± 4.302653 * 10 / sqrt(3) %
    assert "best strategy was pi-gating" in text and "20.0 % less than without control" in text
    assert "paired over 3 seeds, is -44.8 to +4.8 % and includes zero" in text and "flattered" not in text
    sure = summary_text.best(
        rows(no_control={1: 100.0, 2: 200.0}, pi_gating={1: 50.0, 2: 101.0}, mpc_pc={1: 99.0, 2: 199.0})
    )
    assert "excludes zero: more than chance" in sure and "chosen among 2 on these very runs (seeds 1 to 2)" in sure
    assert "there is no interval" in summary_text.best(rows(no_control={1: 100.0}, pi_gating={1: 90.0}))
    worse = summary_text.best(rows(no_control={1: 100.0, 2: 100.0}, pi_gating={1: 110.0, 2: 112.0}))
    assert "No strategy was better than no control" in worse and "11.0 % more" in worse
    assert "no run of no-control with the same seed" in summary_text.best(rows(pi_gating={1: 1.0}, no_control={2: 1.0}))
    assert summary_text.seeds([3, 1, 2, 7]) == "1 to 3, 7"


def test_the_words_name_what_is_uneven_late_or_lost():
    table = rows(no_control={1: 100.0, 2: 200.0}, pi_gating={1: 50.0})
    head = summary_text.head(table)
    assert "Every trip was completed" in head and "No vehicle was teleported" in head
    assert any("Not all strategies have all 2 seeds (pi-gating 1)" in text for text in summary_text.details(table))
    table.loc[0, ["teleports", "completed_veh"]] = 5, 40.0
    table["late_decisions"], table["solver_failures"] = [0, 0, 2], [0, 0, 1]
    head = summary_text.head(table)
    assert "no-control 30 of 100. The others completed all." in head and head.endswith("no-control 5.")
    late = "pi-gating 1 without an answer of the solver or policy, pi-gating 2 late"
    assert any(late in text for text in summary_text.details(table))


def test_minus_signs_and_units():
    assert html.typeset("rerouting-30: -5.1 to +2 %") == "rerouting-30: \N{MINUS SIGN}5.1 to +2\N{NO-BREAK SPACE}%"


def test_finished_prefers_the_level_of_the_scenario(evaluation):
    found = results.read(evaluation)
    assert found.level(None).demand == 1.0 and found.level(0.8).folder == evaluation / "demand-0.8"
    assert len(found.rows) == 12 and found.evaluation and found.city is not None
