"""cosim import of OpenStreetMap: a file, and a box of it from a server of our own."""

import gzip
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from commands import cosim, error_line, good

from cosim.importing import case
from cosim.importing.streets import read_streets

SIDE = 4  # junctions along a side


def street_map(south: float = 44.49, west: float = 11.33) -> bytes:
    """A grid of streets, both ways: the third of either direction is a main street, its inner
    junctions have signals; and a footway, a railway and a street that is cut off from the rest."""
    lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6'>"]
    for y in range(SIDE):
        for x in range(SIDE):
            signal = "<tag k='highway' v='traffic_signals'/>" if {x, y} <= {1, 2} else ""
            place = f"lat='{south + 0.0018 * y}' lon='{west + 0.0025 * x}'"
            lines.append(f"<node id='{10 * y + x}' {place}>{signal}</node>")
    lines += [
        f"<node id='{98 + n}' lat='{south + 0.03}' lon='{west + 0.001 * n}'/>" for n in range(2)
    ]
    ways = [
        ([10 * y + x for x in range(SIDE)], "primary" if y == 2 else "residential")
        for y in range(SIDE)
    ]
    ways += [
        ([10 * y + x for y in range(SIDE)], "primary" if x == 2 else "residential")
        for x in range(SIDE)
    ]
    ways += [([0, 11], "footway"), ([98, 99], "residential")]
    for n, (nodes, kind) in enumerate(ways, start=1):
        lines.append(
            f"<way id='{n}'>{''.join(f'<nd ref={chr(39)}{node}{chr(39)}/>' for node in nodes)}"
            f"<tag k='highway' v='{kind}'/></way>"
        )
    return "\n".join([*lines, "</osm>"]).encode()


def test_streets_and_signals_of_a_file(tmp_path):
    written = []
    for left_hand in (False, False, True):
        (tmp_path / "city.osm").write_bytes(street_map(13.75, 100.5) if left_hand else street_map())
        with case.sumo_input(tmp_path / "city.osm", lambda stage: None) as found:
            streets = read_streets(found.net, ())
            written.append(found.net.read_bytes())
            assert streets.left_hand == left_hand
            # 24 streets, both ways; a corner is no junction: its two streets are one
            assert len(streets.edges) == 2 * 24 - 2 * 4
            assert streets.drivable.all()
            assert set(streets.logics) == {"11", "12", "21", "22"}
            assert {logic.kind for logic in streets.logics.values()} == {"actuated"}
            assert "ODbL-1.0" in found.notice
        assert not found.net.exists()
    assert written[0] == written[1]
    assert b"osm.net.xml" not in written[0]


LEFT = """Bangkok 13.75 100.50, Chiang Mai 18.79 98.98, Nong Khai 17.88 102.74, Hat Yai 7.01 100.47, London 51.51 -0.13,
Dover 51.13 1.31, Dublin 53.35 -6.26, Tokyo 35.68 139.77, Naha 26.21 127.68, Sydney -33.87 151.21, Delhi 28.64 77.22,
Amritsar 31.63 74.87, Lahore 31.55 74.34, Cape Town -33.92 18.42, Windhoek -22.56 17.08, Nairobi -1.28 36.82,
Singapore 1.29 103.85, Johor 1.49 103.74, Hong Kong 22.32 114.17, Macau 22.20 113.55, Kathmandu 27.70 85.32,
Nicosia 35.17 33.36, Valletta 35.90 14.51, Jakarta -6.21 106.85, Dili -8.56 125.57, Maputo -25.97 32.58,
Georgetown 6.80 -58.16, Kingston 18.00 -76.79, Auckland -36.85 174.76, Suva -18.14 178.44, Apia -13.83 -171.77"""
RIGHT = """Yangon 16.81 96.16, Tachileik 20.45 99.88, Vientiane 17.97 102.63, Phnom Penh 11.56 104.92,
Calais 50.95 1.85, Paris 48.86 2.35, Shenzhen 22.55 114.07, Zhuhai 22.28 113.57, Seoul 37.57 126.98,
Zahedan 29.50 60.86, Luanda -8.84 13.23, Lubumbashi -11.66 27.48, Kigali -1.94 30.06, Bujumbura -3.36 29.36,
Addis Ababa 9.02 38.75, Manila 14.60 120.98, Taipei 25.03 121.57, Noumea -22.27 166.46, Boa Vista 2.82 -60.67,
Guantanamo 20.14 -75.21, New York 40.71 -74.01, Anadyr 64.73 177.50, Hanoi 21.03 105.85, Catania 37.50 15.09"""


@pytest.mark.parametrize("places, left", [(LEFT, True), (RIGHT, False)])
def test_side_of_the_road(places, left):
    """Follows from the place, across borders as well."""
    for place in places.split(","):
        *_, latitude, longitude = place.split()
        assert case.keeps_left(float(longitude), float(latitude)) == left, place


def test_a_box_is_asked_of_a_server(tmp_path, monkeypatch):
    asked = []

    class Overpass(BaseHTTPRequestHandler):
        def do_POST(self):
            asked.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(200)
            self.end_headers()
            self.wfile.write(street_map())

        def log_message(self, *arguments):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Overpass) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        monkeypatch.setattr(case, "SERVERS", f"http://127.0.0.1:{server.server_port}/")
        file = case.fetch_osm((-0.5, 44.48, 11.34, 44.5), tmp_path)
        server.shutdown()
    assert 'w="-0.5"' in asked[0]
    assert 'n="44.5"' in asked[0]
    with gzip.open(file) as stream:
        assert b"<way id='1'>" in stream.read()


@pytest.mark.slow
def test_import_makes_a_scenario_and_names_the_licence(tmp_path):
    with gzip.open(tmp_path / "city.osm.gz", "wb") as stream:
        stream.write(street_map())
    net, scenario = tmp_path / "networks" / "mycity", tmp_path / "scenarios" / "mycity"
    good(
        cosim(
            "import",
            tmp_path / "city.osm.gz",
            "--regions",
            2,
            "--demand",
            "peak",
            "--level",
            0.1,
            "--out",
            net,
        )
    )
    assert "OpenStreetMap contributors" in (net / "NOTICE.txt").read_text()
    assert "right-hand traffic; 4 signals" in (net / "import.txt").read_text()
    good(
        cosim("run", scenario, "--controller", "pi-gating", "--steps", 3, "--out", tmp_path / "run")
    )


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ("--bbox", "11.3,44.4,11.4,44.5"),
            "osmGet.py got nothing from OpenStreetMap (urllib.error.URLError",
        ),
        (("--bbox", "11.3,44.4,11.4"), "expected west,south,east,north in degrees"),
        (("--bbox", "11.4,44.4,11.3,44.5"), "expected west,south,east,north in degrees"),
        ((), "either a file or --bbox"),
        (("empty.osm", "--bbox", "11.3,44.4,11.4,44.5"), "either a file or --bbox"),
        (("empty.osm",), "netconvert cannot run it: Error: No nodes loaded"),
        (("city.osm.pbf",), "osmium cat city.osm.pbf -o city.osm"),
        (
            ("other.xml",),
            "expected a sumocfg, a net.xml or a file of OpenStreetMap, got a file of <html>",
        ),
    ],
)
def test_one_line(tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(case, "SERVERS", "http://127.0.0.1:1/")
    for name, content in (("empty.osm", "<osm/>"), ("city.osm.pbf", ""), ("other.xml", "<html/>")):
        (tmp_path / name).write_text(content)
    assert expected in error_line(
        cosim("import", *arguments, "--regions", 2, "--out", "networks/x")
    )
    assert not (tmp_path / "networks" / "x").exists()
    assert not (tmp_path / "scenarios").exists()
