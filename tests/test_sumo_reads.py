"""Every form in which SUMO takes vehicles: an import drives the same ones, trip by trip."""

import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import tiny_city

from cosim.api import run
from cosim.importing.case import read_sumo_input
from cosim.importing.demand import read_traffic
from cosim.importing.importer import import_city
from cosim.importing.streets import read_streets
from nmfd.errors import InputError

ADDITIONAL = """<vType id="own" vClass="taxi" maxSpeed="9"/><vType id="thin" scale="0.5"/>
<vType id="spread" speedFactor="normc(1,0.2,0.5,1.5)"/>
<vTypeDistribution id="mixed"><vType id="a" probability="0.6"/>
<vType id="b" vClass="truck" probability="0.4"/>
</vTypeDistribution><vTypeDistribution id="named" vTypes="own spread"/>
<route id="r" edges="A1B1 B1C1 C1D1"/><route id="s" edges="A1B1 B1B2"/>
<route id="halt" edges="A1B1 B1C1"><stop lane="A1B1_0" duration="7"/></route>
<routeDistribution id="d"><route id="d1" edges="A1B1 B1C1" probability="1"/>
<route edges="A1B1 B1B2" probability="2"/>
</routeDistribution><routeDistribution id="refs" routes="r s" probabilities="1 3"/>
<busStop id="bus" lane="B1C1_0" startPos="20" endPos="40"/>
<parkingArea id="park" lane="B1C1_0" startPos="60" endPos="80"/>
<taz id="west" edges="A0A1 A1B1"/>
<taz id="east"><tazSource id="C1D1" weight="1"/><tazSink id="C1D1" weight="1"/></taz>
"""
BESIDE = '<trip id="beside" depart="9" from="A1B1" to="C1D1"/>'
ADDITIONAL += BESIDE
CALIBRATOR = """<calibrator id="c" edge="B2C2" pos="0">
<flow begin="0" end="60" route="r" vehsPerHour="600"/></calibrator>"""
TRIP, ENDS = '<trip id="{0}" depart="{1}" ', 'from="A1B1" to="C1D1"'
FLOW, ROUTED = '<flow id="{0}" begin="{1}" ', '<vehicle id="{0}" depart="{1}" '
FORMS = {
    "line": FLOW.replace("{1}", "{1}.4")
    + 'end="25" period="1" line="7" departPos="base" '
    + ENDS
    + "/>",
    "trip": TRIP + ENDS + "/>",
    "via": TRIP + ENDS + ' via="B2C2"/>',
    "blanks": TRIP + 'from=" A1B1 " to="C1D1&#9;" via=" B2C2 "/>',
    "stops_only": TRIP
    + '><stop lane="A1B1_0" duration="3"/><stop lane="C1D1_0" duration="3"/></trip>',
    "stop_on_the_way": TRIP
    + ENDS
    + '><stop lane="B2C2_0" duration="3" startPos="5" endPos="30"/></trip>',
    "stop_at_the_end": TRIP + 'from="A1B1"><stop busStop="bus" duration="5"/></trip>',
    "parking": TRIP + ENDS + '><stop parkingArea="park" duration="9"/></trip>',
    "junctions": TRIP + 'fromJunction="A1" toJunction="D1"/>',
    "zones": TRIP + 'fromTaz="west" toTaz="east"/>',
    "coordinates": TRIP + 'fromXY="100,195" toXY="500,195"/>',
    "one_edge": TRIP + 'from="B1C1" to="B1C1"/>',
    "clock": TRIP.replace("{1}", "0:00:{1}") + ENDS + "/>",
    "own_type": TRIP + ENDS + ' type="own" color="1,0,0"><param key="a" value="b"/></trip>',
    "types": TRIP + ENDS + ' type="mixed"/>',
    "named_types": TRIP + ENDS + ' type="named"/>',
    "own_speed": TRIP + ENDS + ' speedFactor="1.3"/>',
    "places": TRIP
    + ENDS
    + ' departLane="free" departPos="random" departSpeed="random" arrivalPos="random"/>',
    "last": TRIP
    + ENDS
    + ' departLane="best_prob" departPos="last" departSpeed="avg" arrivalLane="1"/>',
    "numbers": TRIP
    + ENDS
    + ' departLane="1" departPos="30.5" departSpeed="0" arrivalPos="-20" arrivalSpeed="3"/>',
    "rerouting": TRIP + ENDS + '><param key="has.rerouting.device" value="true"/></trip>',
    "named_route": ROUTED + 'route="r"/>',
    "route_with_stop": ROUTED + 'route="halt"/>',
    "nested": ROUTED + '><route edges="A1B1&#10;  B1C1"/></vehicle>',
    "repeat": ROUTED + '><route edges="A1B1 B1B2 B2A2 A2A1" repeat="2"/></vehicle>',
    "nested_stop": ROUTED
    + '><route edges="A1B1 B1C1"/><stop lane="B1C1_1" until="90" parking="true"/></vehicle>',
    "depart_edge": ROUTED + 'route="r" departEdge="1" arrivalEdge="2"/>',
    "reroute": ROUTED + 'reroute="true"><route edges="A1B1 C1D1"/></vehicle>',
    "shared": ROUTED + 'route="d"/>',
    "references": ROUTED + 'route="refs"/>',
    "alternatives": ROUTED
    + '><routeDistribution last="0"><route cost="9" probability="0.4" edges="A1B1 B1C1"/>'
    + '<route cost="9" probability="0.6" edges="A1B1 B1B2"/></routeDistribution></vehicle>',
    "period": FLOW + 'end="60" period="7.3" ' + ENDS + "/>",
    "hourly": FLOW + 'end="60" vehsPerHour="700" route="d" type="mixed"/>',
    "per_hour": FLOW + 'end="60" perHour="333" ' + ENDS + ' departPos="random_free"/>',
    "count": FLOW + 'end="60" number="7" route="r"/>',
    "at_once": FLOW + 'end="{1}" number="4" ' + ENDS + ' departLane="best"/>',
    "chance": FLOW + 'end="60" probability="0.3" route="refs"/>',
    "poisson": FLOW + 'end="60" period="exp(0.2)" ' + ENDS + ' type="named"/>',
    "until_then": FLOW + 'period="20" number="3" ' + ENDS + "/>",
    "endless": FLOW + 'vehsPerHour="60" ' + ENDS + "/>",
    "flow_via": FLOW
    + 'end="60" number="3" via="B2C2" '
    + ENDS
    + '><stop lane="C1D1_0" duration="2"/></flow>',
    "flow_zones": FLOW + 'end="60" number="3" fromTaz="west" toTaz="east"/>',
    "scaled_type": FLOW + 'end="60" number="9" route="r" type="thin"/>',
    "waits_for_a_person": ROUTED.replace("{1}", "triggered")
    + 'route="r"/><person id="p{0}" depart="{1}">'
    '<ride from="A1B1" to="B1C1" lines="{0}"/></person>',
    "walker": '<personFlow id="{0}" begin="{1}" end="60" number="3">'
    '<walk from="A1B1" to="B1C1"/></personFlow>',
    "unsorted": TRIP.replace("{1}", "1") + ENDS + "/>",
    "later": TRIP.replace("{1}", "700") + ENDS + "/>",
}
OPTIONS = {  # of SUMO
    "scale": '<scale value="1.7"/>',
    "offset": '<random-depart-offset value="20"/>',
    "text": "<step-length>0.5</step-length>",
    "meso": '<mesosim value="yes"/><meso-tauff value="1.9"/>',
    "window": '<begin value="0:00:13"/>',
    "lateral": '<lateral-resolution v="0.8"/><default.action-step-length v="1"/>'
    '<time-to-teleport v="60"/>',
    "equipped": '<device.rerouting.probability v="1"/><device.rerouting.period v="30"/>'
    '<max-depart-delay v="15"/>',
}


# SUMO draws these with other random numbers of a run, or differs by itself: the same vehicles,
# driven otherwise.
DRIVEN = ("meso", "lateral", "equipped", "window")
OF_CHANCE = ("per_hour", "places", "last", "walker", "waits_for_a_person", "line")
DRAWN = ("chance", "hourly", "shared", "references", "alternatives")  # their destinations


def city(folder, forms, options="", additional=ADDITIONAL):
    """A sumocfg with these forms, every one with its own time."""
    tiny_city.network(folder)
    lines = "\n".join(FORMS[name].format(name, 2 + n // 4) for n, name in enumerate(forms))
    (folder / "c.rou.xml").write_text(f"<routes>{lines}</routes>")
    (folder / "c.add.xml").write_text(f"<additional>{additional}</additional>")
    (folder / "c.sumocfg").write_text(
        '<configuration><net-file value="city.net.xml"/><route-files value="c.rou.xml"/>'
        '<additional-files value="c.add.xml"/><end value="600"/><junction-taz value="true"/>'
        f"{options}</configuration>"
    )
    return folder / "c.sumocfg"


def given(folder, routes, options=""):
    """A sumocfg with these vehicles and no others."""
    config = city(folder, [], options, ADDITIONAL.replace(BESIDE, ""))
    config.with_name("c.rou.xml").write_text(f"<routes>{routes}</routes>")
    return config


def trips(file) -> dict[str, dict[str, str]]:
    """Id -> what SUMO says about every vehicle that departed, without those of the calibrator."""
    driven = (trip.attrib for trip in ElementTree.parse(file).iter("tripinfo"))
    return {
        trip["id"]: trip
        for trip in driven
        if not trip["id"].startswith("c.") and float(trip["depart"]) >= 0
    }


def plain(config):
    """The trips of SUMO alone."""
    out = config.with_name("plain.xml")
    usual = "--tripinfo-output.write-unfinished --seed 0 --tripinfo-output"
    tiny_city.run("sumo", "-c", config, usual, out)
    return trips(out)


def imported(config, **options) -> str:
    """The report of an import into networks/x and scenarios/x."""
    folders = [config.with_name(name) / "x" for name in ("networks", "scenarios")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    return import_city(config, *folders, regions=2, seeds=1, **options)


def one_of(names, slow):
    """Names of OPTIONS, some of them for `pytest -m slow`."""
    return [
        pytest.param(OPTIONS[name], id=name, marks=pytest.mark.slow if name in slow else ())
        for name in names
    ]


@pytest.mark.parametrize("options", one_of(OPTIONS, ("text", "lateral")))
def test_an_import_reads_what_sumo_reads(tmp_path, options):
    """The same vehicles from edge to edge, with the same departures; none is left out."""
    config = city(tmp_path, FORMS, options, ADDITIONAL + CALIBRATOR)
    case, driven = read_sumo_input(config), plain(config)
    streets = read_streets(case.net, case.additional)
    traffic = read_traffic(case, streets, seed=0)
    read = {vehicle.get("id"): n for n, vehicle in enumerate(traffic.vehicles)}
    assert traffic.left_out == (0.0, 0.0)
    timed = {name for name in driven if not name.startswith(("waits_for_a_person", "line"))}
    assert timed <= set(read)
    if "max-depart-delay" not in case.options:
        assert timed == set(read)
    for name in timed:
        start, end = (driven[name][key].rpartition("_")[0] for key in ("departLane", "arrivalLane"))
        assert streets.edges[traffic.origin[read[name]]] == start, name
        if end and name.partition(".")[0] not in DRAWN:
            assert streets.edges[traffic.destination[read[name]]] == end, name
        due = float(driven[name]["depart"]) - float(driven[name]["departDelay"])
        assert -0.02 <= traffic.depart[read[name]] - due < case.step_length + 0.02, name


SURE = [name for name in FORMS if name not in OF_CHANCE]


@pytest.mark.parametrize(
    "options", [pytest.param("", id="plain"), *one_of(DRIVEN, ("lateral", "equipped", "window"))]
)
def test_seed_0_without_control_is_plain_sumo(tmp_path, options):
    drive_and_compare(city(tmp_path, SURE, options), ended=26)


def test_buses_wait_in_one_queue_with_cars(tmp_path):
    drive_and_compare(city(tmp_path, ["line", "until_then"]), ended=26)


def test_buses_keep_their_place_among_cars_that_depart_with_them(tmp_path):
    """SUMO puts vehicles of files before those that flows make at the same time."""
    config = city(tmp_path, ["trip"])
    flow = '<flow id="f" begin="0" end="60" period="10" from="A1B1" to="C1D1"/>'
    bus = '<vehicle id="b{0}" line="1" depart="{0}"><route edges="A1B1 B1C1 C1D1"/></vehicle>'
    buses = "".join(map(bus.format, range(0, 60, 10)))
    config.with_name("c.rou.xml").write_text(f"<routes>{flow}{buses}</routes>")
    drive_and_compare(config, ended=12)


TRIPS = "".join(
    f'<trip id="t{n}" depart="{1.2 * n:.1f}" from="A1B1" to="C1D1"/>' for n in range(60)
)
SECONDS = '<flow id="f" begin="0" end="90" period="5" from="A2B2" to="C2D2"/>'
HOURLY = """<flow id="p" begin="0" end="200" vehsPerHour="500" from="A1B1" to="D2D3"/>
<flow id="q" begin="0" end="200" vehsPerHour="650" from="A2B2" to="D1D0"/>"""
DEVICES = """<device.rerouting.probability v="0.5"/><device.rerouting.period v="30"/>
<device.emissions.probability v="0.4"/><device.fcd.probability v="0.5"/>"""


@pytest.mark.parametrize(
    "routes, options",
    [
        (SECONDS + HOURLY + TRIPS, ""),
        pytest.param(SECONDS + TRIPS, '<step-length v="0.5"/>', marks=pytest.mark.slow),
        pytest.param(HOURLY + TRIPS, DEVICES, marks=pytest.mark.slow),
        pytest.param(
            TRIPS,
            '<device.rerouting.probability v="0.5"/><device.emissions.probability v="1"/>',
            marks=pytest.mark.slow,
        ),
    ],
    ids=["whole-steps", "half-steps", "devices", "two-devices"],
)
def test_departures_are_those_of_sumo(tmp_path, routes, options):
    """A vehicle queues only with those of its own step, and finds its way in the same step."""
    config = given(tmp_path, routes, options)
    text = config.read_text().replace('<end value="600"/>', '<end value="400"/>')
    config.write_text(text)
    drive_and_compare(config, ended=30)


def drive_and_compare(config, ended):
    """Compare a run of the imported city with SUMO alone, trip by trip. ended: least number of
    trips"""
    report = imported(config)
    tmp_path = config.parent
    out = tmp_path / "t.xml"
    run(tmp_path / "scenarios" / "x", "no-control", seed=0, tripinfo=out)
    keys = ("depart", "arrival", "routeLength", "departLane", "arrivalLane", "timeLoss")
    mine, alone = (
        {name: [trip[key] for key in keys] for name, trip in t.items()}
        for t in (trips(out), plain(config))
    )
    done = {
        name: trip for name, trip in alone.items() if trip[1] != "-1.00"
    }  # the import simulates longer
    assert {name: mine[name] for name in done} == done
    assert len(done) >= ended
    assert set(mine) == set(alone)
    private = [name for name in alone if not re.fullmatch(r"line\..*|b\d+", name)]
    assert f"same city: {len(private)} of {len(private)} trips, time spent +0.0 %" in report


@pytest.mark.slow
def test_vehicles_of_a_loaded_state_begin_where_they_are(tmp_path):
    config = city(tmp_path, ["trip", "via", "period", "later"])
    state = tmp_path / "state.xml"
    saving = "--end 51 --save-state.times 50 --save-state.files"
    tiny_city.run("sumo", "-c", config, saving, state)
    config.write_text(config.read_text().replace("<end", '<load-state value="state.xml"/><end'))
    traffic = tiny_city.traffic_of(config)
    placed = [vehicle for vehicle in traffic.vehicles if float(vehicle.get("depart")) == 50.0]
    assert read_sumo_input(config).begin == 50.0
    assert {"trip", "via", "period.0"} <= {vehicle.get("id") for vehicle in placed}
    assert all(vehicle.get("departLane") in "01" and vehicle.get("departPos") for vehicle in placed)
    assert len(traffic.vehicles) == len(plain(config)) == 11
    imported(config)
    result = run(tmp_path / "scenarios" / "x", "no-control", seed=0)
    assert result["departures"].sum() == 11


def test_what_is_left_out_is_said_first_and_last(tmp_path):
    """SUMO refuses a route with a gap, or drives it if it is told to ignore errors."""
    config = city(tmp_path, ["count", "reroute"])
    route = '<vehicle id="gap" depart="9"><route edges="A1B1 C1D1"/></vehicle></routes>'
    (tmp_path / "c.rou.xml").write_text(
        (tmp_path / "c.rou.xml").read_text().replace("</routes>", route)
    )
    first, *_, last, _ = imported(config).splitlines()
    share = "10.0% of the vehicles and 6.9% of the distance left out"
    assert share in first
    assert last == f"WARNING: {share}: this is not the traffic of c.sumocfg"
    assert last in (tmp_path / "networks" / "x" / "verdict.txt").read_text()
    config.write_text(config.read_text().replace("<end", '<ignore-route-errors value="true"/><end'))
    assert " 0.0% of the vehicles and 0.0% of the distance left out" in imported(config)


def read(config):
    return tiny_city.traffic_of(config)


RIDE = '<person id="p{0}" depart="1"><ride from="A1B1" to="B1C1" lines="{0}"/></person>'
LOAD = '<container id="k" depart="1"><transport from="A1B1" to="B1C1" lines="{0}"/></container>'
MINUTES = '<flow id="f" begin="0" end="600" period="60" from="A1B1" to="C1D1"/>'
WAITING = (
    '<trip id="w1" depart="triggered" from="A1B1" to="C1D1"/>',
    '<trip id="w1.x" depart="0" from="A1B1" to="C1D1"/>',
    '<vehicle id="w2" depart="triggered" route="r"/>' + RIDE.format("w2"),
    '<vehicle id="w3" depart="containerTriggered" route="r"/>' + LOAD.format("w3"),
    '<flow id="w4" begin="triggered" number="3" route="r"/>' + RIDE.format("w4.0"),
)


def test_vehicles_that_wait_for_somebody_do_not_end_the_reading(tmp_path):
    """For persons and containers, one by one and as a flow; another's id begins as theirs."""
    config = given(tmp_path, MINUTES + "".join(WAITING))
    traffic = read(config)
    flow = [v for v in traffic.vehicles if v.get("id").startswith("f.")]
    assert len(flow) == 10
    assert {"w1", "w2", "w3", "w4"} <= {element.get("id") for element in traffic.background}
    assert traffic.notes["vehicles without a time of departure, left alone"] == 6
    assert traffic.left_out == (0.0, 0.0)
    assert "same city" in imported(config)


def test_a_person_far_ahead_does_not_end_the_reading(tmp_path):
    lines = [TRIP.format("a", 1) + ENDS + "/>", '<person id="p" depart="400"><walk from="A1B1" ']
    lines += ['to="B1C1"/></person>', TRIP.format("b", 550) + ENDS + "/>"]
    config = given(tmp_path, "".join(lines))
    assert [vehicle.get("id") for vehicle in read(config).vehicles] == ["a", "b"]


def test_a_vehicle_days_later_is_no_oversight(tmp_path):
    """Without an end somebody would wait for ever, or lose the vehicle."""
    late = TRIP.format("a", 1) + ENDS + "/>" + TRIP.format("b", 500000) + ENDS + "/>"
    config = given(tmp_path, late)
    config.write_text(config.read_text().replace('<end value="600"/>', ""))
    with pytest.raises(InputError, match="c.sumocfg: nothing begins in the day after 2 s"):
        read(config)


def test_what_sumo_does_not_read_is_named_and_counted(tmp_path):
    """SUMO drops the vehicles that come too late in a file, and says so once for each."""
    times = {"a": 9, "b": 1, "c": 2, "d": 9, "e": 10}
    lines = [TRIP.format(name, time) + ENDS + "/>" for name, time in times.items()]
    config = given(tmp_path, "".join(lines))
    traffic = read(config)
    assert [vehicle.get("id") for vehicle in traffic.vehicles] == ["a", "d", "e"]
    assert traffic.notes == {}
    said = "SUMO says: Route file should be sorted by departure time, ignoring 'b'! (2 in all)"
    assert traffic.remarks == (said,)
    report = imported(config)
    assert said in report
    assert "same city: 3 of 3 trips" in report
    assert "vehicles depart in 1 control intervals of 90 s, too few for an MFD" in report
    assert f"WARNING: {said}" in (tmp_path / "networks" / "x" / "verdict.txt").read_text()


def test_vehicles_of_another_network_are_named(tmp_path):
    """All vehicles of a flow count, as if they drove as far as the others."""
    flow = MINUTES.replace("A1B1", "nowhere").replace('"f"', '"g"')
    config = given(tmp_path, MINUTES + flow)
    traffic = read(config)
    assert len(traffic.vehicles) == 10
    assert traffic.notes["vehicles on edges that the network has not, left out"] == 10
    assert traffic.left_out == pytest.approx((0.5, 0.5))
    remark = "edge nowhere of flow g is not in city.net.xml (10 in all)"
    assert traffic.remarks == (remark,)
    report = imported(config)
    assert remark in report
    assert "50.0% of the vehicles and 50.0% of the distance left out" in report
    assert "not compared with plain SUMO: it refuses the city" in report
    config.with_name("c.rou.xml").write_text(f"<routes>{flow}</routes>")
    with pytest.raises(InputError, match="names no vehicles .* edge nowhere of flow g is not in"):
        imported(config)


def test_a_vehicle_may_have_the_id_of_a_flow(tmp_path):
    """The flow is a bus line, the vehicle a car."""
    line = '<flow id="f" begin="0" end="600" period="60" route="r" line="7"/>'
    traffic = read(given(tmp_path, line + '<vehicle id="f" depart="3" route="r"/>'))
    assert ["line" in vehicle.attrib for vehicle in traffic.vehicles] == [False]
    assert len(traffic.background) == 10


def test_vehicles_before_the_beginning_are_counted(tmp_path):
    config = given(tmp_path, TRIP.format("t", 3) + ENDS + "/>")
    with pytest.raises(InputError, match="before the simulation begins: 1; it begins at 60 s"):
        imported(config, begin="60")


@pytest.mark.slow
def test_another_traffic_is_told_with_a_reason(tmp_path):
    slow = '<flow id="s" begin="0" end="90" number="9" route="r" departSpeed="1.0"/>'
    config = given(tmp_path, slow)
    report = imported(config)
    assert re.search(r"not the same city as in plain SUMO: [0-8] of 9 trips, time spent", report)
    assert re.search(r"; vehicle s\.\d arrives at \d+ s instead of at \d+ s; ", report)
    assert "fixed speeds at the departure, made the highest safe ones: 9" in report
    report = imported(config, mesoscopic=True)
    assert re.search(r"same city.* of 9 trips, time spent .* %, both in SUMO's queue model", report)
    assert "not compared with plain SUMO: the demand is 2 times its own" in imported(
        config, level=2.0
    )


@pytest.mark.slow
def test_a_script_without_a_guard_reads_vehicles(tmp_path):
    """A process that ran the script again would end the import."""
    script = tmp_path / "script.py"
    script.write_text(f"""
from pathlib import Path
from cosim.importing.case import read_sumo_input
from cosim.importing.demand import read_traffic
from cosim.importing.streets import read_streets
case = read_sumo_input(Path({str(city(tmp_path, ["trip", "count"]))!r}))
print(len(read_traffic(case, read_streets(case.net, case.additional), seed=0).vehicles))
""")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == [str(len(plain(tmp_path / "c.sumocfg")))], done.stderr
