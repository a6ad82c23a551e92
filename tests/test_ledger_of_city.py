"""The vehicle ledger of generated cities against SUMO's own tripinfo: whoever takes vehicles out,
none goes unnoticed.

Every case is a small grid of three regions in a row, random trips, and somebody who meddles: files
of SUMO (calibrators, rerouters, stops), options of SUMO (collisions, teleports), or another program
in the same simulation.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import copies
import libsumo
import numpy as np
import pytest
import tiny_city

import cosim
from cosim.plant.meter import Meter
from cosim.sumo.net import city_of, load_city
from cosim.sumo.outputs import TripReader, options
from cosim.sumo.recorded_trips import MESOSCOPIC
from cosim.sumo.session import Session, _flush_all
from nmfd import metrics
from nmfd.ledger import LedgerError
from nmfd.model.regional_model import load_network

COUNT_EVERY, STEPS = 25, 250
# By the junction that an edge leads to: 0 and 2 do not touch.
REGION = {"A": 0, "B": 0, "C": 1, "D": 2}
CALIBRATOR = (
    '<calibrator id="c{0}" edge="{0}" pos="{1}" freq="10" jamThreshold="0.99">'
    '<flow begin="0" end="900" {2}/></calibrator>'
)
REROUTER = (
    '<rerouter id="r" edges="A1B1 B1C1 B2C2 C2B2 C1B1 B1B2 C1C2">'
    '<interval begin="0" end="900">{}</interval></rerouter>'
)
RECKLESS = (
    'jmIgnoreFoeProb="1" jmIgnoreFoeSpeed="99" jmIgnoreJunctionFoeProb="1" '
    'jmDriveAfterRedTime="999" collisionMinGapFactor="0"'
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """additional, vehicles: XML; type: attributes of the vehicles' type; script(step, random) acts
    before every step of SUMO, `after` it where `late`; expects: attributes of the meter that are
    not zero at the end"""

    additional: str = ""
    vehicles: str = ""
    type: str = ""
    options: tuple[str, ...] = ()
    session: dict = field(default_factory=dict)
    script: Callable | None = None
    late: bool = False
    trips: int = 120
    expects: tuple[str, ...] = field(default=())


def some(random, share=0.05):
    return [vehicle for vehicle in sorted(libsumo.vehicle.getIDList()) if random.random() < share]


def remove(*reasons):
    def script(step, random):
        for vehicle in some(random) if step % 5 == 0 else ():
            libsumo.vehicle.remove(vehicle, int(random.choice(reasons)))

    return script


def shorten(step, random):
    for vehicle in some(random) if step % 5 == 0 else ():
        route, index = libsumo.vehicle.getRoute(vehicle), libsumo.vehicle.getRouteIndex(vehicle)
        if index >= 0 and not libsumo.vehicle.getRoadID(vehicle).startswith(":"):
            libsumo.vehicle.setRoute(vehicle, route[index : index + int(random.integers(1, 4))])


def change_target(step, random):
    for vehicle in some(random) if step % 5 == 0 else ():
        with suppress(libsumo.TraCIException):  # on a junction, without a way
            libsumo.vehicle.changeTarget(
                vehicle, str(random.choice(["C3D3", "B1A1", "C2C1", "D1C1"]))
            )


def add(step, random):
    if step % 10 == 5:
        libsumo.route.add(f"route{step}", libsumo.simulation.findRoute("A0B0", "C2D2").edges)
        libsumo.vehicle.add(f"added{step}", f"route{step}", departLane="best")


def reuse(step, random):
    """An id that has just gone is used again, for a trip from elsewhere."""
    if step % 20 == 10:
        libsumo.route.add(f"again{step}", ["C2B2", "B2A2"])
        for vehicle in some(random, 0.1)[:3]:
            libsumo.vehicle.remove(vehicle)
            libsumo.vehicle.add(vehicle, f"again{step}")


def move(step, random):
    """By hand, far off; a waiting vehicle may come onto the road like that."""
    for vehicle in some(random, 0.1) if step % 20 == 10 else ():
        with suppress(libsumo.TraCIException):
            libsumo.vehicle.setRoute(vehicle, ["C1D1", "D1D2"]) if step % 40 == 10 else None
            libsumo.vehicle.moveTo(vehicle, "C1D1_0", 10.0)


def forget(step, random):
    """Trips that wait or are to come are taken back."""
    if step % 20 == 10:
        for vehicle in sorted(
            set(libsumo.vehicle.getLoadedIDList()) - set(libsumo.vehicle.getIDList())
        )[:3]:
            libsumo.vehicle.remove(vehicle)


def block(step, random):
    """Some drivers stop where they are and never go on; others must be teleported past them."""
    for vehicle in some(random, 0.1) if step % 20 == 10 else ():
        libsumo.vehicle.setSpeed(vehicle, 0.0)


def tried(script, step, random):
    with suppress(libsumo.TraCIException):  # of a vehicle that another script has just removed
        script(step, random)


def flow(rate):
    return f'vehsPerHour="{rate}" speed="10"'


CALIBRATORS = "".join(
    CALIBRATOR.format(edge, 5, flow(30))
    for edge in ("B1C1", "C2C1", "B2B1", "C1D1", "A1B1", "B0C0")
)
INSERTING = CALIBRATOR.format("A1B1", 5, 'vehsPerHour="900" speed="10" route="in" type="car"')
CASES = {
    "plain": Case(expects=("arrivals", "crossings")),
    "calibrators": Case(additional=CALIBRATORS, expects=("arrivals", "removals")),
    "calibrator-that-inserts": Case(
        additional='<route id="in" edges="A1B1 B1C1 C1D1"/><vType id="car"/>' + INSERTING,
        trips=10,
        expects=("arrivals",),
    ),
    "collisions": Case(
        type=RECKLESS,
        trips=300,
        session={"collision_action": "remove"},
        options=("--collision.check-junctions",),
        expects=("removals",),
    ),
    "removed-as-anything": Case(script=remove(0, 1, 2, 3, 4), expects=("removals",)),
    "removed-after-the-step": Case(script=remove(3), late=True, expects=("removals",)),
    "another-target": Case(script=change_target, expects=("arrivals", "redirected")),
    "ids-used-again": Case(script=reuse, expects=("removals",)),
    "moved-by-program": Case(script=move, expects=("jumps",)),
    "taken-back": Case(script=forget, expects=("given_up",)),
    "destination-rerouter": Case(
        additional=REROUTER.format(
            '<destProbReroute id="C3D3" probability="0.5"/>'
            '<destProbReroute id="B2A2" probability="0.5"/>'
        ),
        expects=("arrivals", "redirected"),
    ),
    "teleports": Case(script=block, session={"time_to_teleport": 8.0}),
    "disconnected-teleports": Case(
        vehicles='<flow id="gap" begin="0" end="80" period="4"><route edges="A1B1 C2D2"/></flow>',
        session={"time_to_teleport": 8.0},
        options=("--ignore-route-errors", "--time-to-teleport.disconnected", "1"),
        expects=("jumps",),
    ),
    "long-waits": Case(
        vehicles='<flow id="f" begin="0" end="99" period="0.3" from="A1B1" to="C1D1"/>',
        options=("--max-depart-delay", "10"),
        expects=("arrivals", "given_up"),
    ),
    "persons-cars": Case(
        vehicles="".join(
            f'<trip id="own{n}" depart="triggered" from="A1B1" to="C1D1"/>'
            f'<person id="p{n}" depart="{3 * n}">'
            f'<ride from="A1B1" to="C1D1" lines="own{n}"/></person>'
            for n in range(30)
        ),
        trips=20,
        expects=("arrivals",),
    ),
    "everything": Case(
        additional=CALIBRATORS + REROUTER.format('<destProbReroute id="C3D3" probability="0.3"/>'),
        type=RECKLESS,
        session={"collision_action": "remove", "time_to_teleport": 10.0},
        options=("--collision.check-junctions", "--max-depart-delay", "20"),
        trips=300,
        script=lambda step, random: [
            tried(part, step, random)
            for part in (remove(0, 1, 2, 3, 4), shorten, change_target, add, reuse, move, block)
        ],
        expects=("arrivals", "removals", "redirected"),
    ),
}
# What SUMO's mesoscopic model does not have: collisions, standing drivers, places on edges, parking
# rerouters.
MICRO_ONLY = {"collisions", "teleports", "moved-by-program"}
QUICK = {  # in the default suite
    False: (
        "calibrators",
        "collisions",
        "removed-as-anything",
        "ids-used-again",
        "moved-by-program",
    ),
    True: ("another-target", "calibrators", "long-waits"),
}
MANY = [
    pytest.param(
        name, meso, id=f"{name}-{way}", marks=() if name in QUICK[meso] else (pytest.mark.slow,)
    )
    for name in CASES
    for meso, way in ((False, "micro"), (True, "meso"))
    if not (meso and name in MICRO_ONLY)
]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("city")
    net = tiny_city.network(folder, "--tls.set B1,B2,C1")
    return load_city(net, tiny_city.regions(net, lambda edge: REGION[edge[2]]), 3)


def trips(city, case: Case, seed: int) -> str:
    random = np.random.default_rng(seed)
    pairs = random.choice(city.edges, (case.trips, 2))
    trip = '<trip id="t{}" depart="{:.1f}" from="{}" to="{}"/>'
    several = "".join(trip.format(n, 150 * n / case.trips, *pair) for n, pair in enumerate(pairs))
    return f'<routes><vType id="DEFAULT_VEHTYPE" {case.type}/>{case.vehicles}{several}</routes>'


def run(folder: Path, city, case: Case, *, mesoscopic: bool, seed: int):
    """The meter after the run, its states, and the elements of SUMO's tripinfo."""
    (folder / "trips.rou.xml").write_text(trips(city, case, seed))
    (folder / "more.add.xml").write_text(f"<additional>{case.additional}</additional>")
    out, random = folder / "tripinfo.xml", np.random.default_rng(seed)
    session = Session(
        city.net_file,
        folder / "trips.rou.xml",
        seed=seed,
        **case.session,
        options=(
            *(*options(out, detailed=False), "--additional-files", str(folder / "more.add.xml")),
            *("--ignore-junction-blocker", "20", *case.options),
            *(f"--{key}={value}" for key, value in MESOSCOPIC.items() if mesoscopic),
        ),
    )
    states = []
    try:
        reader = TripReader(out, session.flush)
        meter = Meter(session, city, trips=reader)
        for step in range(STEPS):
            if case.script and not case.late:
                case.script(step, random)
            session.step()
            if case.script and case.late:
                case.script(step, random)
            meter.observe()
            if (step + 1) % COUNT_EVERY == 0:
                states.append(
                    (
                        meter.state(step, session.time),
                        meter.arrivals.sum(),
                        meter.removals.sum(),
                        told(out),
                    )
                )
                now = np.zeros((3, 3))
                for vehicle in libsumo.vehicle.getIDList():
                    road, end = session.road(vehicle), session.route(vehicle)[-1]
                    now[city.region_of[road], city.region_of[end]] += 1
                rest = states[-1][0].accumulation - now
                away = set(libsumo.vehicle.getLoadedIDList()) - set(
                    libsumo.vehicle.getIDList()
                )  # or waiting
                assert (rest >= 0).all()
                assert rest.sum() == sum(libsumo.vehicle.getDeparture(v) >= 0 for v in away)
        _flush_all()()
        count = told(out)
    finally:
        session.close()
    meter.close_books()
    return meter, states, list(ElementTree.parse(out).getroot().iter("tripinfo")), count


def time_spent(infos) -> float:
    """Duration and departure delay by SUMO's tripinfo [s]."""
    return sum(
        max(float(trip.get("duration")), 0.0) + float(trip.get("departDelay")) for trip in infos
    )


def told(path: Path) -> int:
    """How many vehicles SUMO has written of."""
    return path.read_text(encoding="utf-8").count("<tripinfo ")


def check(city, meter, states, infos, count):
    """The books are those that SUMO's own tripinfo gives, at the end and at every count."""
    ended = infos[:count]  # what is written after that is of those under way
    good = [not trip.get("vaporized") for trip in ended]
    assert (meter.arrivals.sum(), meter.removals.sum()) == (sum(good), count - sum(good))
    lanes = [trip.get("arrivalLane") for trip, there in zip(ended, good, strict=True) if there]
    arrived = [city.region_of[lane.rpartition("_")[0]] for lane in lanes if lane]
    assert (meter.arrivals >= np.bincount(arrived, minlength=3)).all()
    departed = sum(float(trip.get("depart")) >= 0 for trip in infos)
    assert meter.departures.sum() == departed
    for state, arrivals, removed, then in states:
        assert (arrivals, removed) == (sum(good[:then]), then - sum(good[:then]))
        assert state.completed == arrivals
        assert state.removed.sum() >= removed
    joined = {(g.source, g.target) for g in city.gateways}
    touching = np.array([[(i, h) in joined for h in range(3)] for i in range(3)])
    assert not meter.crossings[~touching].any()
    assert not meter.jumps[touching].any()
    for counts in (
        meter.arrivals,
        meter.removals,
        meter.given_up,
        meter.crossings,
        meter.jumps,
        meter.redirected,
    ):
        assert (counts >= 0).all()
    # Time spent is that of tripinfo, but for trips that SUMO dropped before they began.
    known = [trip.time for trip in meter.trips() if trip.outcome != "given up"]
    assert sum(known) == pytest.approx(time_spent(infos), rel=1e-9)
    assert len(known) == len(infos)
    # x_ij follows from the books alone.
    x = meter.departures - meter.removals - np.diag(meter.arrivals) + meter.redirected.sum(axis=1)
    x = (
        x
        - meter.redirected.sum(axis=2)
        + sum(c.sum(axis=0) - c.sum(axis=1) for c in (meter.crossings, meter.jumps))
    )
    assert (x == meter._running).all()


@pytest.mark.parametrize("name, mesoscopic", MANY)
def test_nobody_goes_unnoticed(city, tmp_path, name, mesoscopic):
    case = CASES[name]
    meter, *found = run(tmp_path, city, case, mesoscopic=mesoscopic, seed=1)
    check(city, meter, *found)
    for what in case.expects:
        assert getattr(meter, what).any(), what


def test_a_vehicle_that_sumo_tells_nothing_of_is_an_error(city, tmp_path):
    silent = Case(
        vehicles='<vType id="s"><param key="has.tripinfo.device" value="false"/></vType>'
        '<flow id="f" type="s" begin="0" end="50" period="5" from="A1B1" to="B1C1"/>',
        trips=5,
    )
    says = (
        r"such as f\.\d\): is the disk full\? Or does their type have has\.tripinfo\.device = false"
    )
    with pytest.raises(LedgerError, match=says):
        run(tmp_path, city, silent, mesoscopic=False, seed=1)


MEDDLER = """
import libsumo
from nmfd import Controls

class Meddler:
    name = "meddler"

    def __init__(self, scenario):
        self._open = scenario.network.open_perimeter

    def reset(self, seed=0):
        pass

    def act(self, observation):
        for vehicle in sorted(libsumo.vehicle.getIDList())[:4] if libsumo.isLoaded() else ():
            libsumo.vehicle.remove(vehicle)
        return Controls(perimeter=self._open, splits=None)
"""


def test_a_run_says_who_was_removed_and_counts_them_until_then(tmp_path):
    """Calibrators of the city's own files, and a controller that takes out four vehicles in every
    interval."""
    scenario = copies.peak(tmp_path)
    city = city_of(load_network(tmp_path / "networks" / "grid7"))
    (scenario / "more.add.xml").write_text(
        "<additional>"
        + "".join(CALIBRATOR.format(edge, 5, flow(1)) for edge in city.edges[::5])
        + "</additional>"
    )
    text = (scenario / "scenario.toml").read_text()
    (scenario / "scenario.toml").write_text(
        text.replace("[sumo]", '[sumo]\nadditional = ["more.add.xml"]')
    )
    (tmp_path / "mine.py").write_text(MEDDLER)
    trips = tmp_path / "trips.xml"
    run = cosim.run(scenario, f"{tmp_path / 'mine.py'}:Meddler", steps=8, seed=1, tripinfo=trips)
    ended = [
        trip.get("vaporized")
        for trip in ElementTree.parse(trips).getroot()
        if float(trip.get("arrival")) >= 0
    ]
    spent = time_spent(ElementTree.parse(trips).getroot())
    assert metrics.total_time_spent(run) == run.time_spent.sum() == pytest.approx(spent, rel=1e-9)
    assert {"", "traci", "calibrator"} <= set(ended)
    assert ended.count("traci") >= 24
    assert run.completed[-1] == ended.count("") == run.arrivals.sum() > 0
    assert (
        run.removed_veh
        == len(ended) - ended.count("")
        == run.removals.sum()
        == run.removed[-1].sum()
    )
    assert run.departed_veh == run.completed[-1] + run.removed_veh + run.accumulation[-1].sum()
