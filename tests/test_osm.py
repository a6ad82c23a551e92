"""cosim import of OpenStreetMap: a file, and a box of it from a server of our own."""

import gzip
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from commands import cosim, error_line, good

from cosim.importing import case, osm
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
        (tmp_path / "city.osm").write_bytes(street_map())
        source = tmp_path / "city.osm"
        with case.sumo_input(source, lambda stage: None, left_hand=left_hand) as found:
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
        monkeypatch.setattr(osm, "SERVERS", f"http://127.0.0.1:{server.server_port}/")
        file = osm.fetch((-0.5, 44.48, 11.34, 44.5), tmp_path)
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
            "--regions 2 --demand peak --level 0.1 --left-hand --out",
            net,
        )
    )
    assert "OpenStreetMap contributors" in (net / "NOTICE.txt").read_text()
    assert "left-hand traffic; 4 signals" in (net / "import.txt").read_text()
    good(cosim("run", scenario, "--controller pi-gating --steps 3 --out", tmp_path / "run"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ("--bbox 11.3,44.4,11.4,44.5",),
            "osmGet.py got nothing from OpenStreetMap (urllib.error.URLError",
        ),
        (("--bbox 11.3,44.4,11.4",), "expected west,south,east,north in degrees"),
        (("--bbox 11.4,44.4,11.3,44.5",), "expected west,south,east,north in degrees"),
        ((), "either a file or --bbox"),
        (("empty.osm --bbox 11.3,44.4,11.4,44.5",), "either a file or --bbox"),
        (("empty.osm",), "netconvert cannot run it: Error: No nodes loaded"),
        (("other.net.xml --left-hand",), "--left-hand: other.net.xml says itself"),
        (("city.osm.pbf",), "osmium cat city.osm.pbf -o city.osm"),
        (
            ("other.xml",),
            "expected a sumocfg, a net.xml or a file of OpenStreetMap, got a file of <html>",
        ),
    ],
)
def test_one_line(tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(osm, "SERVERS", "http://127.0.0.1:1/")
    files = {
        "empty.osm": "<osm/>",
        "city.osm.pbf": "",
        "other.xml": "<html/>",
        "other.net.xml": "<net/>",
    }
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    assert expected in error_line(cosim("import", *arguments, "--regions 2 --out networks/x"))
    assert not (tmp_path / "networks" / "x").exists()
    assert not (tmp_path / "scenarios").exists()
