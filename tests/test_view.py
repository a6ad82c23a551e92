"""The live view: watching changes nothing, gates that are switched are ordered faults, frames, the page, the server."""

import http.client
import itertools
import multiprocessing
import re
import threading
from dataclasses import replace

import numpy as np
import pytest
import tiny_city
from bokeh.document import Document
from bokeh.embed import file_html
from bokeh.models import Button
from bokeh.resources import CDN
from commands import cosim, error_line
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine
from tornado.ioloop import IOLoop

from cosim.evaluation.simulate import Task, scenario_of, simulate
from cosim.sumo.net import city_of
from cosim.view import city_map, picture, replay, run
from cosim.view import server as server_module
from cosim.view.budget import SAVED, SHARE, Budget
from cosim.view.page import Page, numbers
from cosim.view.picture import CityPicture, Frame
from cosim.view.run import Pace, Switch, Switched
from cosim.view.server import Server
from cosim.view.show import DELAYS, Seen
from nmfd import faults
from nmfd.errors import InputError
from nmfd.metrics import total_time_spent

STEPS = 5
EVIL = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    """A tiny city with gates that are closed to half."""
    return Task(
        scenario=tiny_city.imported(tmp_path_factory.mktemp("view")),
        controller="no-control+guided",
        seed=3,
        steps=STEPS,
    )


@pytest.fixture(scope="module")
def city(task):
    return city_of(scenario_of(task).network)


@pytest.fixture(scope="module")
def gate(task, city):
    """The gate with a signal whose gateways carry most in a plain run."""
    drawn = CityPicture.of(scenario_of(task), city)
    return drawn.boundaries[0]


@pytest.fixture(scope="module")
def plain(task):
    return simulate(task)


def watched(task, *, orders=()):
    """(result, what was shown) of a run that waits at the end of its first control interval, is given the orders there,
    and then goes on."""
    here, there = multiprocessing.Pipe()
    step, shown, waited = scenario_of(task).step, [], []

    def listen():
        while True:
            try:
                shown.append(here.recv())
            except EOFError:
                return
            if isinstance(shown[-1], Frame) and shown[-1].time == step:
                waited.append(not here.poll(0.3))  # nothing comes: it waits
                for order in (*orders, Pace()):
                    here.send(order)

    thread = threading.Thread(target=listen)
    thread.start()
    try:
        result = run.run(there, Pace(until=step), task)
    finally:
        thread.join()
    assert waited == [True]
    return result, shown


@pytest.fixture(scope="module")
def seen(task):
    return watched(task)


@pytest.fixture(scope="module")
def switched(task, gate):
    return watched(task, orders=[Switch(source=gate[0], target=gate[1], share=0.0)])


def same(one, other, tmp_path):
    """To the last digit, but for wall times."""
    return one.without_times().identical(other.without_times())


def test_watching_changes_nothing(plain, seen, tmp_path):
    assert plain["departures"].sum() > 50
    assert same(plain, seen[0], tmp_path)


def test_a_gate_that_is_switched_by_hand_is_an_ordered_fault(task, plain, switched, gate, tmp_path):
    result, shown = switched
    order = next(one for one in shown if isinstance(one, Switched))
    assert order.k == 1
    name = f"gate {gate[0]}-{gate[1]} held at 0"
    assert [name in note for note in result.note] == [False] + [True] * (STEPS - 1)
    texts = faults.by_hand([(order.k, *gate, 0.0)])
    assert texts == [f"gate:{gate[0]}-{gate[1]}=0@1-999999"]
    assert same(simulate(replace(task, faults=tuple(texts))), result, tmp_path)
    green = result["gateway_green"] / plain["gateway_green"]
    assert np.nanmin(green[1:]) < 0.9 and np.nanmax(np.abs(green[0] - 1.0)) == 0.0
    assert not same(plain, result, tmp_path)


def test_frames_of_a_finished_run_are_those_that_were_shown(task, city, plain, seen):
    drawn = CityPicture.of(scenario_of(task), city)
    shown = [one for one in seen[1] if isinstance(one, Frame)]
    whole = [one for one in shown if one.whole]
    later = picture.frames(drawn, plain)
    assert [frame.time for frame in later] == [k * drawn.step for k in range(STEPS + 1)]
    for there, here in zip(whole, later, strict=True):
        for name, value in vars(here).items():
            if name not in ("speed", "note"):  # that is in no record
                np.testing.assert_array_equal(getattr(there, name), value, err_msg=name)
    assert later[-1].time_spent == pytest.approx(total_time_spent(plain), rel=1e-12)
    assert 0.0 < np.nanmean(whole[-1].speed) < 1.3 and np.isnan(later[-1].speed).all()
    assert all(np.diff([frame.time for frame in shown]) >= 0)


def test_the_picture_of_a_city(task, city):
    drawn = CityPicture.of(scenario_of(task), city)
    assert len(drawn.shapes) == len(drawn.edges) == len(drawn.lane_km) == len(city.edges)
    assert sorted(n for gate in drawn.gates for n in gate.gateways) == list(range(len(city.gateways)))
    assert all(len(rings) >= 1 for rings in drawn.outlines) and (drawn.critical > 0).all()
    for curve, critical in zip(drawn.curves, drawn.critical, strict=True):
        assert abs(curve[curve[:, 1].argmax(), 0] - critical) < 0.1 * critical


def test_gates_by_hand_one_after_the_other():
    orders = [(2, 0, 1, 0.0), (2, 1, 0, 1.0), (4, 0, 1, 0.5), (6, 0, 1, None), (7, 0, 1, None)]
    assert faults.by_hand(orders) == ["gate:0-1=0@2-4", "gate:1-0=1@2-999999", "gate:0-1=0.5@4-6"]
    for text in faults.by_hand(orders):
        assert faults.parse(text, "here", 2).text == text
    assert faults.by_hand([(2, 0, 1, 0.0), (2, 0, 1, None)]) == []


@pytest.mark.parametrize(
    "text",
    [
        "gate",
        "gate:",
        "gate:0-1",
        "gate:0-0=1",
        "gate:0-2=1",
        "gate:0-1=2",
        "gate:0-1=-1",
        "gate:0-1=nan",
        "gate:0-1=x",
        "gate:0>1=1",
        "gate:x-1=0",
    ],
)
def test_gates_that_cannot_be_held(text):
    with pytest.raises(InputError, match="here: "):
        faults.parse(text, "here", 2)


def test_a_gate_where_no_street_leads(task, city, tmp_path):
    joined = {(gateway.source, gateway.target) for gateway in city.gateways}
    missing = [(i, h) for i in range(3) for h in range(3) if i != h and (i, h) not in joined]
    if not missing:
        missing = [(0, 7)]
    i, h = missing[0]
    line = error_line(
        cosim(
            "run", task.scenario, "--controller", "no-control", "--out", tmp_path / "out", "--fault", f"gate:{i}-{h}=0"
        )
    )
    assert "gate" in line and not (tmp_path / "out").exists()


def test_looking_back():
    frames = [
        Frame(
            time=60.0 * k,
            intervals=k,
            whole=True,
            **dict.fromkeys(("density", "speed"), np.zeros(1, np.float16)),
            accumulation=np.zeros(1),
            outflow=np.zeros(1),
            waiting=0.0,
            completed=k,
            removed=0.0,
            time_spent=0.0,
            perimeter=np.zeros((1, 1)),
            green=np.zeros(0),
            queue=np.zeros(0),
            guided=np.zeros((1, 1)),
        )
        for k in range(4)
    ]
    seen = Seen("x")
    assert seen.at(100.0) is None
    for frame in frames:
        seen.add(frame)
    seen.add(replace(frames[-1], time=200.0, whole=False))
    times = {0.0: 0.0, 61.0: 60.0, 179.0: 120.0, 180.0: 180.0, 199.0: 180.0, 1e9: 200.0}
    assert {time: seen.at(time).time for time in times} == times
    assert len(seen.whole) == 4 and DELAYS[0] == 0.0 == min(DELAYS)
    text = numbers([EVIL], [replace(frames[-1], note=EVIL)], 180.0)
    assert "<script" not in text and text.count("&lt;script&gt;") == 2 and "3.0 min" in text


def test_a_page_shows_every_street_and_trusts_no_name(task, city, seen):
    drawn = CityPicture.of(scenario_of(task), city)
    drawn = replace(drawn, name=EVIL, region_names=(EVIL,) * drawn.regions)
    page, document = Page(drawn, [EVIL, "no-control"]), Document()
    whole = [one for one in seen[1] if isinstance(one, Frame) and one.whole]
    page.place(document, EVIL, [Button(label=EVIL, name="pause")], [Button(label="x", name="close")])
    page.show([whole[-1], None], whole[-1].time, city_map.SPEED, [frozenset(drawn.boundaries[:1]), frozenset()])
    page.trace([whole, whole[:2]], whole[-1].time)
    arrows = page.maps[0].arrows.data
    assert len(arrows["width"])
    sent_elsewhere = replace(whole[-1], guided=np.full_like(whole[-1].guided, -1.0))
    page.show([sent_elsewhere, None], whole[-1].time, city_map.SPEED, [frozenset(), frozenset()])
    assert not any(arrows[column].any() for column in ("width", "head", "guided"))
    page.show([whole[-1], None], whole[-1].time, city_map.SPEED, [frozenset(drawn.boundaries[:1]), frozenset()])
    for one in page.maps:
        assert list(one.streets.data["edge"]) == list(city.edges)
        assert len(one.streets.data["xs"]) == len(city.edges)
    speed = np.nan_to_num(whole[-1].speed.astype(np.float32), nan=-1.0)
    np.testing.assert_array_equal(page.maps[0].streets.data["value"], speed)
    ends = page.maps[0].gates.data["end"]
    assert len(ends) == len(drawn.gates) and (page.maps[0].gates.data["rim_width"] == 3.0).any()
    busiest = int(np.argmax(whole[-1].density))
    page.choose_street(busiest)
    page.trace([whole, whole[:2]], whole[-1].time)
    seen_there = page.curves.lines[0].data["density"]
    np.testing.assert_array_equal(seen_there, np.array([frame.density[busiest] for frame in whole], np.float32))
    assert city.edges[busiest] in page.curves.street.title.text
    assert list(page.maps[1].chosen.data["xs"][0]) == list(page.maps[0].streets.data["xs"][busiest])
    assert len(page.curves.lines[0].data["time"]) == STEPS + 1 and len(page.curves.lines[1].data["time"]) == 2
    html = file_html(
        document, CDN, title=document.title, template=document.template, template_variables=document.template_variables
    )
    assert EVIL not in html and html.count("<script") == html.count("</script") and "&lt;script&gt;" in html
    for plot in (*page.maps, *page.loads):
        assert plot.plot.name
    curves = page.curves
    for plot in (curves.region, curves.plane, curves.gate, curves.trips, curves.spent):
        assert all("[" in axis.axis_label for axis in plot.axis)  # units


def test_finished_runs_on_one_page_with_a_slider(task, city, plain, switched):
    drawn = replace(CityPicture.of(scenario_of(task), city), name=EVIL)
    runs = {
        "plain": picture.frames(drawn, plain),
        EVIL: picture.frames(drawn, switched[0]),
    }
    models, _ = replay.layout(drawn, runs)
    callback = models["time"].js_property_callbacks["change:value"][0]
    film, choices = callback.args["film"].data, callback.args["choices"].data
    assert {len(rows) for rows in film.values()} == {STEPS + 1}
    assert {len(rows) for rows in choices.values()} == {drawn.regions}
    for n, frames in enumerate(runs.values()):
        for k, frame in enumerate(frames):
            np.testing.assert_array_equal(film[f"streets{n}.value"][k], frame.density.astype(np.float32))
        for r in range(drawn.regions):
            wanted = [frame.accumulation[r] for frame in frames]
            np.testing.assert_array_equal(choices[f"lines{n}.accumulation"][r], np.array(wanted, np.float32))
    assert film["streets0.value"][-1].tolist() != film["streets1.value"][-1].tolist()
    made = replay.embedded(drawn, runs)
    assert set(made.roots) == set(models) and not any(EVIL in text for text in (*made.scripts, *made.roots.values()))
    inside = [np.array([frame.accumulation.sum() for frame in frames]) for frames in runs.values()]
    most = int(np.argmax(np.abs(inside[0] - inside[1])))
    assert models["time"].value == pytest.approx(most * drawn.step / 60)
    [value] = (one.data_source.data["value"] for one in models["map1"].renderers if "value" in one.data_source.data)
    np.testing.assert_array_equal(value, film["streets1.value"][most])


# The server.


def request(path="/", host="127.0.0.1:5006", **headers):
    found = HTTPHeaders({"Host": host} if host is not None else {})
    for name, value in headers.items():
        found.add(name, value)
    return HTTPServerRequest(start_line=RequestStartLine("GET", path, "HTTP/1.1"), headers=found)


@pytest.fixture(scope="module")
def guards():
    """(this machine alone, everybody with the token, that token)"""
    here, beyond = Server(lambda document: None), Server(lambda document: None, host="0.0.0.0")
    assert here.address == f"http://127.0.0.1:{here.port}/" and "token=" in beyond.address
    for server in (here, beyond):
        server._tornado.start()
    yield here._tornado, beyond._tornado, beyond.address.partition("token=")[2]
    for server in (here, beyond):
        server._server.unlisten()
        server._tornado.stop()


@pytest.mark.parametrize(
    "good, asked",
    [
        (True, {}),
        (True, {"host": "localhost:8080"}),
        (True, {"host": "[::1]:5006"}),
        (True, {"Origin": "http://127.0.0.1:5006"}),
        (False, {"path": "/ws", "Origin": "http://127.0.0.1:5006"}),
        (False, {"host": "evil.example"}),
        (False, {"host": "127.0.0.1.evil.example:5006"}),
        (False, {"host": ""}),
        (False, {"host": "[::1"}),
        (False, {"host": "10.0.0.1:5006"}),
        (False, {"Origin": "http://evil.example"}),
        (False, {"Origin": "null"}),
        (False, {"Origin": "http://localhost:5006"}),
        (False, {"path": "/ws", "Origin": "http://127.0.0.1:3000"}),
        (False, {"path": "/ws", "host": "evil.example"}),
        (False, {"path": "/static/js/bokeh.min.js", "host": "evil.example"}),
    ],
)
def test_who_may_ask_on_this_machine(guards, good, asked):
    assert guards[0].allowed(request(**asked)) == good


def test_beyond_this_machine_nothing_without_the_token(guards):
    _, guard, token = guards
    assert len(token) >= 24
    for host in ("192.168.1.7:5006", "localhost:5006"):
        assert guard.allowed(request(f"/?token={token}", host=host))
        for path in (
            "/",
            "/?token=",
            f"/?token={token[:-1]}",
            f"/?token={token}x",
            f"/?token={token}&token=x",
            "/autoload.js",
            "/metadata",
            "/?token=%ff%ff",
        ):
            assert not guard.allowed(request(path, host=host)), path
    assert not guard.allowed(request(f"/?token={token}", host="evil.example"))
    assert guard.sign_sessions and guard.secret_key  # so that a websocket needs what only the page gives out


def test_the_guard_stands_before_everything():
    """A server in a thread, asked over its socket: nothing for foreign Hosts, no websocket without a signed session."""
    ready, loop, box = threading.Event(), [], []

    def serve():
        import asyncio

        asyncio.set_event_loop(asyncio.new_event_loop())
        generous = Budget(clock=itertools.count(0.0, 10.0).__next__)
        server = Server(lambda document: document.add_root(Button(label="x", name="x")), budget=generous)
        box.append(server)
        loop.append(IOLoop.current())
        ready.set()
        server.serve(0.05, lambda: stop.is_set())

    stop = threading.Event()
    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(10.0)
    port = box[0].port

    def ask(path, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        answer = connection.getresponse()
        found = answer.status, answer.read() if answer.status != 101 else b""
        connection.close()
        return found

    upgrade = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec_WebSocket_Protocol": "bokeh, made-up",
    }
    try:
        status, page = ask("/")
        assert status == 200 and b"cdn." not in page and b"https://" not in page.replace(b"https://bokeh", b"")
        assert ask("/", Host="evil.example")[0] == 403
        assert ask("/", Origin="http://evil.example")[0] == 403
        assert ask("/static/js/bokeh.min.js", Host="evil.example")[0] == 403
        assert ask("/ws", **upgrade, Origin=f"http://127.0.0.1:{port}")[0] == 403
        assert ask("/ws", **upgrade, Origin="http://evil.example")[0] == 403
        assert ask("/?bokeh-session-id=made-up")[0] == 403
        assert ask("/")[0] == 200  # it is still there
        assert box[0].viewers >= 1
        signed = re.search(rb'"token":"([^"]+)"', page)[1].decode()
        assert ask("/ws", **{**upgrade, "Sec_WebSocket_Protocol": f"bokeh, {signed}x"})[0] == 403
        assert ask("/ws", **{**upgrade, "Sec_WebSocket_Protocol": f"bokeh, {signed}"})[0] == 101
        given = [ask("/") for _ in range(server_module.MOST_VIEWERS + 2)]
        assert {status for status, _ in given} == {200, 503} and box[0].viewers <= server_module.MOST_VIEWERS
        assert given[-1][0] == 503 and b"asks again" in given[-1][1] and len(given[-1][1]) < 500
        assert ask("/static/js/bokeh.min.js")[0] == 200  # of those who are in
    finally:
        stop.set()
        thread.join(10.0)
    assert not thread.is_alive()


def test_the_processor_time_of_viewers_is_limited():
    now, spent = [0.0], [0.0]
    budget = Budget(clock=lambda: now[0], spent=lambda: spent[0])
    made = 0
    while now[0] < 100.0:  # ever more ask for pages of half a second each
        if budget.page():
            made, spent[0] = made + 1, spent[0] + 0.5
        now[0] += 0.1
    assert made == pytest.approx((100 * SHARE + SAVED) / 0.5, abs=1.5)
    assert budget.slower() > 1.0
    for _ in range(100):  # forty viewers, 10 ms for a picture
        period = 0.25 * budget.slower()
        now[0], spent[0] = now[0] + period, spent[0] + 40 * 0.01
    assert 40 * 0.01 / period == pytest.approx(SHARE, rel=0.3)
    for _ in range(100):  # one
        now[0], spent[0] = now[0] + 0.25, spent[0] + 0.01
        budget.slower()
    assert budget.slower() == 1.0


def test_pages_that_are_asked_for_at_once_are_paid_for_before_they_are_made():
    budget = Budget(clock=lambda: 0.0, spent=lambda: 0.0)
    assert sum(budget.page() for _ in range(40)) == 3


def test_a_port_that_is_taken_and_a_host_that_is_elsewhere():
    server = Server(lambda document: None)
    try:
        with pytest.raises(InputError, match=f"--port {server.port}"):
            Server(lambda document: None, port=server.port)
        with pytest.raises(InputError, match="--host 203.0.113.9"):
            Server(lambda document: None, host="203.0.113.9")
    finally:
        server._server.unlisten()


def test_wrong_ways_to_watch(task):
    base = ("watch", task.scenario, "--controller", "no-control")
    assert "--gui: shows one run" in error_line(cosim(*base, "--gui", "--port", 5006))
    assert cosim(*base, "--port", 70000).exit_code == 2
    assert "nobody" in error_line(cosim(*base, "--against", "nobody"))
    assert "no such" in error_line(cosim("watch", "nowhere", "--controller", "no-control"))
