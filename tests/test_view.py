"""The view: watching changes nothing, frames of live and finished runs agree, and the page draws
them."""

import asyncio
import multiprocessing
import queue
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_city
from bokeh.document import Document
from bokeh.embed import components, file_html
from bokeh.models import Button, PlainText, Title
from bokeh.resources import CDN
from tornado.httpclient import AsyncHTTPClient

from cosim.evaluation.simulate import Simulation, simulate
from cosim.importing import maps
from cosim.plant.strategy import parse
from cosim.sumo.net import city_of
from cosim.view import live, page, picture
from cosim.view.picture import CityPicture, Frame
from nmfd.api import load_scenario
from nmfd.errors import InputError, RunFailed
from nmfd.metrics import total_time_spent

STEPS = 4
EVIL = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return load_scenario(tiny_city.imported(tmp_path_factory.mktemp("view")), {"steps": STEPS})


@pytest.fixture(scope="module")
def strategy():
    return parse("no-control+guided")


@pytest.fixture(scope="module")
def drawn(scenario):
    return CityPicture.of(scenario, city_of(scenario.network))


@pytest.fixture(scope="module")
def plain(scenario, strategy):
    return simulate(Simulation(scenario, strategy, seed=3))


@pytest.fixture(scope="module")
def seen(scenario, strategy, drawn):
    """The messages and the result of a run that is held at its start for a while."""
    messages, context = queue.Queue(), multiprocessing.get_context("spawn")
    going, delay = context.Event(), context.Value("d", 0.0)
    reporter, begin = live.Reporter(0, scenario, messages, going, delay), time.perf_counter()
    threading.Timer(0.3, going.set).start()
    result = simulate(Simulation(scenario, strategy, seed=3), observer=reporter)
    assert time.perf_counter() - begin > 0.3
    return [messages.get()[1] for _ in range(messages.qsize())], result


@pytest.fixture(scope="module")
def whole(seen):
    return [one for one in seen[0] if isinstance(one, Frame) and one.whole]


def test_watching_changes_nothing(plain, seen):
    assert plain.departures.sum() > 50
    assert plain.without_times().equals(seen[1].without_times())


def test_frames_of_a_finished_run_are_those_of_the_live_one(drawn, plain, seen, whole):
    later = picture.frames(drawn, plain)
    assert [frame.time for frame in later] == [k * drawn.step for k in range(STEPS + 1)]
    for there, here in zip(whole, later, strict=True):
        for name, value in vars(here).items():
            if name == "time_spent":  # a sum of intervals, in another order
                assert getattr(there, name) == pytest.approx(value, rel=1e-12)
            elif name != "note":  # not in the result of a plant problem
                np.testing.assert_array_equal(getattr(there, name), value, err_msg=name)
    assert later[-1].time_spent == pytest.approx(total_time_spent(plain), rel=1e-12)
    assert all(np.diff([one.time for one in seen[0] if isinstance(one, Frame)]) >= 0)


def test_the_picture_of_a_city(scenario, drawn):
    city = city_of(scenario.network)
    assert len(drawn.shapes) == len(drawn.edges) == len(drawn.lane_km) == len(city.edges)
    assert sorted(n for gate in drawn.gates for n in gate.gateways) == list(
        range(len(city.gateways))
    )
    assert all(len(rings) >= 1 for rings in drawn.outlines)
    assert (drawn.critical > 0).all()
    for curve, critical in zip(drawn.curves, drawn.critical, strict=True):
        assert abs(curve[curve[:, 1].argmax(), 0] - critical) < 0.1 * critical


def test_a_region_in_the_midst_of_another_is_drawn_after_it():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    drawn = maps.largest_first([[square], [9.0 * square, 0.5 * square]])
    assert [region for region, _ in drawn] == [1, 0, 1]
    assert maps.pale(0) != maps.pale(1)


def test_the_frame_at_a_time(whole):
    seen = live.Seen("x")
    assert seen.at(100.0) is None
    seen.whole, seen.latest = whole, replace(whole[-1], time=whole[-1].time + 20.0, whole=False)
    assert seen.at(whole[2].time + 1.0) is whole[2]
    assert seen.at(1e9) is seen.latest


def test_the_page_draws_every_street_and_escapes_names(drawn, whole):
    unseen = np.full(drawn.regions, np.nan)
    named = replace(drawn, name=EVIL, region_names=(EVIL,) * drawn.regions, critical=unseen)
    one, document = page.Page(named, {EVIL: "red", "no-control": "black"}), Document()
    document.add_root(one.layout([Button(label=EVIL)]))
    one.show([replace(whole[-1], note=EVIL), None], whole[-1].time)
    one.trace([whole, whole[:2]], whole[-1].time)
    assert np.isfinite(one.loads[0].plot.renderers[0].data_source.data["image"][0]).all(), (
        "no critical was seen"
    )
    streets = one.maps[0].streets.data
    assert list(streets["edge"]) == list(drawn.edges)
    assert len(streets["xs"]) == len(drawn.edges)
    np.testing.assert_array_equal(streets["density"], whole[-1].density.astype(np.float32))
    gates = one.maps[0].gates[0].source.data
    assert gates["rim"] == [maps.colour(gate.target) for gate in drawn.boundaries]
    assert len(one.curves.lines[0].data["time"]) == STEPS + 1
    assert len(one.curves.lines[1].data["time"]) == 2
    content = file_html(document, CDN, title=EVIL)
    assert EVIL not in content
    assert EVIL not in one.numbers.text
    for title in document.select({"type": Title}):
        assert isinstance(title.text, PlainText), "$$ would begin mathematics"
    assert one.numbers.disable_math
    for plot in (
        one.curves.region,
        one.curves.plane,
        one.curves.gates,
        one.curves.trips,
        one.curves.spent,
    ):
        assert all("[" in axis.axis_label for axis in plot.axis)  # units


def test_finished_runs_on_one_page_with_a_slider(drawn, plain):
    later = picture.frames(drawn, plain)
    emptier = [
        replace(frame, density=frame.density / 2, accumulation=frame.accumulation / 2)
        for frame in later
    ]
    runs = {"plain": later, EVIL: emptier}
    layout = page.with_slider(
        drawn, runs, dict.fromkeys(runs, "red"), picture.totals(drawn, [plain, plain])
    )
    choose = next(layout.select({"name": "streets"}))
    layers = choose.js_property_callbacks["change:value"][0].args["layers"]
    shown = [label for label, parts in layers if all(part.visible for part in parts)]
    assert len(choose.options) == 3
    assert len(layers) == 6
    assert shown == [choose.value] * 2
    streets = layers[1][1][0].data_source.data
    kilometres = streets["CO2 [kg/km]"] * drawn.lane_km / drawn.lanes
    np.testing.assert_allclose(kilometres, plain.co2, rtol=1e-5)
    slider = next(layout.select({"name": "time"}))
    arguments = slider.js_property_callbacks["change:value"][0].args
    film = [table.data["density"] for _, table, names in arguments["film"] if names == ["density"]]
    for run, values in zip(runs.values(), film, strict=True):
        for frame, row in zip(run, values, strict=True):
            np.testing.assert_array_equal(row, frame.density.astype(np.float32))
    choices = [
        table.data["accumulation"]
        for _, table, names in arguments["choices"]
        if "accumulation" in names
    ]
    for r in range(drawn.regions):
        np.testing.assert_allclose(
            choices[0][r], [frame.accumulation[r] for frame in later], rtol=1e-6
        )
    most = int(np.argmax([frame.accumulation.sum() for frame in later]))
    assert slider.value == pytest.approx(most * drawn.step / 60)
    assert len(arguments["words"]) == STEPS + 1
    for title, of_regions in zip(arguments["titles"], arguments["texts"], strict=True):
        shown = [text.text for text in of_regions]
        assert [text.split(",")[0] for text in shown] == ["Region 0", "Region 1", "Region 2"]
        assert title.text.text in shown
    script, div = components(layout, wrap_script=False)
    assert EVIL not in script
    assert EVIL not in div


def test_runs_in_processes_of_their_own(scenario, strategy, tmp_path, monkeypatch):
    """One run ends, one is wrong, and pausing holds a run; forked, since a new process imports
    everything again."""
    forked = multiprocessing.get_context("fork")
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: forked)
    (tmp_path / "wrong.py").write_text("class Wrong:\n    pass\n")
    wrong = parse(f"{tmp_path / 'wrong.py'}:Wrong")
    show = live.Show([Simulation(scenario, strategy, seed=3), Simulation(scenario, wrong, seed=3)])

    def wait(condition):
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end
            show.update()
            time.sleep(0.02)

    try:
        wait(lambda: show.picture is not None)
        viewer = live.Viewer(show, Document())
        viewer._toggle()
        assert not show.going.is_set()
        wait(lambda: show.runs[1].over)
        viewer._toggle()
        wait(lambda: show.over)
        viewer._page.regions.value = "2"
        assert viewer._pause.label == "Finished"
        assert viewer._page.region == 2
        assert show.runs[0].row["completed_veh"] > 0
        assert len(show.runs[0].whole) == STEPS + 1
        assert isinstance(show.runs[1].error, InputError)
        assert show.now == show.runs[0].latest.time
    finally:
        show.close()


def test_a_process_that_dies_is_an_error(scenario, strategy):
    show = live.Show([Simulation(scenario, strategy, seed=3)])
    try:
        show._processes[0].kill()
        show._processes[0].join()
        show.update()
        assert show.over
        assert isinstance(show.runs[0].error, RunFailed)
    finally:
        show.close()


@pytest.fixture
def site(drawn, whole):
    """The server of a page of one finished run, in an event loop that has not begun."""
    seen = live.Seen("no-control", whole, whole[-1], row={})
    show = SimpleNamespace(runs=[seen], picture=drawn, over=True, now=whole[-1].time)
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    server = live.PageServer(show)
    yield server
    server._server.stop(wait=False)
    loop.close()


@pytest.mark.parametrize(
    "host, status",
    [
        ("localhost", 200),
        ("127.0.0.1", 200),
        ("[::1]", 200),
        ("LOCALHOST", 200),
        ("attacker.example", 404),
        ("localhost.attacker.example", 404),
        ("attackerlocalhost", 404),
        ("127.0.0.1.nip.io", 404),
        ("127x0x0x1", 404),
    ],
)
def test_the_page_answers_to_the_names_of_this_machine_only(site, host, status):
    """Another web page can make its own name lead here (DNS rebinding), and would read the run."""
    port = int(site.address.split(":")[2].strip("/"))

    async def answers(path):
        request = f"http://127.0.0.1:{port}{path}"
        headers = {"Host": f"{host}:{port}"}
        return await AsyncHTTPClient().fetch(request, headers=headers, raise_error=False)

    page = site.loop.run_sync(lambda: answers("/"))
    assert page.code == status
    assert (b"Bokeh" in page.body) == (status == 200)
    assert (b": no-control</h1>" in page.body) == (status == 200)
    assert site.loop.run_sync(lambda: answers("/static/js/bokeh.min.js")).code == status
    no_websocket = site.loop.run_sync(lambda: answers("/ws"))
    assert no_websocket.code == (400 if status == 200 else 404)


@pytest.mark.slow
def test_watching_ends_when_the_runs_have_ended_and_nobody_looks(
    scenario, strategy, monkeypatch, capsys
):
    monkeypatch.setattr(live, "OPENING_S", 0.0)
    jobs = [Simulation(scenario, strategy, seed=3)]
    [run] = live.watch(jobs)
    assert run.row["completed_veh"] > 0
    assert "Watch it at http://localhost:" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="choose another"):
            live.watch(jobs, port=taken.getsockname()[1])
