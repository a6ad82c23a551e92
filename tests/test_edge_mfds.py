"""cosim mfd: MFDs from SUMO's edgeData."""

import numpy as np
import pandas as pd
import pytest
import tiny_city
from commands import cosim, error_line, good

import cosim.api as api
from cosim.evaluation.model_validation import mean_inside, outflow_samples
from cosim.evaluation.simulate import regional_outflow
from cosim.importing.edge_mfds import _turns, edge_mfds
from cosim.importing.streets import read_streets
from cosim.sumo.net import city_files
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model import mfd
from nmfd.studies import fit_quality

FULL = 30.0  # veh on an edge at which nothing moves
FREE = 10.0  # m/s
SLOWER = 0.8  # while unloading


def meandata(streets, loads, freq=300.0):
    """edgeData with equally many vehicles on all edges, which drive slower while they get fewer."""
    lines = ["<meandata>"]
    for k, (before, load) in enumerate(zip([0.0, *loads], loads, strict=False)):
        speed = FREE * (1.0 - load / FULL)
        if load < before:
            speed *= SLOWER
        lines.append(f'<interval begin="{k * freq}" end="{(k + 1) * freq}">')
        for edge, length in zip(streets.edges, streets.length, strict=True):
            about = f'sampledSeconds="{load * freq}" speed="{speed}" arrived="1"'
            lines.append(f'<edge id="{edge}" density="{1000 * load / length}" {about}/>')
        lines.append("</interval>")
    return "\n".join([*lines, "</meandata>"])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A network, edgeData up to 24 vehicles on each edge and down again, and a table of regions."""
    folder = tmp_path_factory.mktemp("made")
    net = tiny_city.network(folder)
    streets = read_streets(net)
    edges = streets.edges
    loads = [*range(1, 25), *range(23, 0, -1)]
    (folder / "edges.xml").write_text(meandata(streets, loads))
    west = [int("A" not in edge and "B" not in edge) for edge in edges]
    pd.DataFrame({"edge": edges, "region": west}).to_csv(folder / "own.csv", index=False)
    return folder


def test_the_curve_that_made_the_data_comes_back(made, tmp_path):
    files = made / "city.net.xml", made / "edges.xml"
    found = edge_mfds(files[0], [files[1]], str(made / "own.csv"), tmp_path)
    edges = np.bincount(found.regions["region"])
    samples = pd.read_csv(tmp_path / "samples.csv")
    first = samples[samples["region"] == found.network.region_names[0]]
    assert first["accumulation_veh"].tolist()[:2] == pytest.approx([edges[0], 2 * edges[0]])
    production = 3.6 * 2.0 * edges[0] * FREE * (1.0 - 2.0 / FULL)
    assert first["production_veh_km_h"][1] == pytest.approx(production, rel=1e-4)
    assert (first["arrived_veh"] == edges[0]).all()
    assert first["outflow_veh_s"].to_numpy() == pytest.approx(edges[0] / 300.0)  # nobody drives on
    assert found.fits["critical_veh"].to_numpy() / edges == pytest.approx(15.0, rel=0.1)
    loop = (1.0 - SLOWER) / (0.5 + 0.5 * SLOWER)
    assert found.fits["hysteresis"].to_numpy() == pytest.approx(loop, rel=0.05)
    assert (tmp_path / "mfd.png").is_file()


def test_the_command(made, tmp_path):
    """Two runs and one region, found without a table; the table of the terminal is narrow."""
    edges = made / "edges.xml"
    options = "--regions 1 --explain --out", tmp_path
    text = good(cosim("mfd", made / "city.net.xml", edges, edges, *options))
    assert max(map(len, text.splitlines())) <= 100
    line = text.splitlines()[1].split()
    assert line[:2] == ["0", "centre"]
    assert line[3] == "94"  # samples of two runs of 47 intervals


@pytest.mark.parametrize("regions", ["2", "auto"])
def test_regions_are_found(made, tmp_path, regions):
    found = edge_mfds(made / "city.net.xml", [made / "edges.xml"], regions, tmp_path)
    assert sorted(set(pd.read_csv(tmp_path / "regions.csv")["region"])) == [0, 1]
    assert bool(found.chosen) == (regions == "auto")


EDGE = '<edge id="A0A1" sampledSeconds="{}" {}/>'
ONE = '<interval begin="0" end="{}">{}</interval>'


@pytest.mark.parametrize(
    "content, expected",
    [
        ("day,interval\n", "is not SUMO's edgeData"),
        ("<net/>", "expected <meandata>, got a file of <net>"),
        ("<meandata></meandata>", "has no edges; put <edgeData"),
        (ONE.format(60, EDGE.format(9, "")), "edge A0A1: density: missing"),
        (ONE.format(60, EDGE.format(9, 'density="1"')), "edge A0A1: speed: missing"),
        (ONE.format(60, '<edge id="A0A1"/>'), "edge A0A1: sampledSeconds: missing"),
        (2 * ONE.format(60, EDGE.format(0, "")), "of 0 s to 60 s begins before 60 s"),
        (ONE.format(60, '<edge id="none" sampledSeconds="0"/>'), "edge none is not in"),
        (
            ONE.format(60, EDGE.format(9, 'density="1" speed="1"')),
            "has vehicles in 1 intervals; an MFD needs",
        ),
    ],
)
def test_one_clear_line(made, tmp_path, out, content, expected):
    if content.startswith("<interval"):
        content = f"<meandata>{content}</meandata>"
    (tmp_path / "edges.xml").write_text(content)
    options = "--regions 1 --out", out
    line = error_line(cosim("mfd", made / "city.net.xml", tmp_path / "edges.xml", *options))
    assert expected in line
    assert not out.exists()


def test_missing_files_and_odd_numbers(made, tmp_path):
    net = made / "city.net.xml"
    with pytest.raises(InputError, match="none.xml: no such file"):
        edge_mfds(net, [tmp_path / "none.xml"], "1", tmp_path)
    with pytest.raises(InputError, match="--regions: expected 1 or more regions"):
        edge_mfds(net, [made / "edges.xml"], "0", tmp_path)


def test_a_vehicle_on_a_junction_counts_where_it_comes_from(made, tmp_path):
    """On a junction of two parts, too; what passes a pedestrian crossing is left out."""
    streets = read_streets(made / "city.net.xml")
    inside, before = next(iter(streets.inside.items()))
    density = 1000.0 * 3.0 / before.length
    extra = f'<edge id="{inside}" sampledSeconds="900" density="{density}" speed="1" entered="9"/>'
    extra += '<edge id=":A0_c0" sampledSeconds="900" density="9" speed="1"/>'
    text = (made / "edges.xml").read_text()
    with_junctions = tmp_path / "edges.xml"
    with_junctions.write_text(text.replace("</interval>", extra + "</interval>"))
    samples = []
    for edges in made / "edges.xml", with_junctions:
        found = edge_mfds(made / "city.net.xml", [edges], str(made / "own.csv"), tmp_path / "out")
        columns = ["accumulation_veh", "production_veh_km_h", "outflow_veh_s"]
        samples.append(found.samples.groupby("region")[columns].mean())
    region = found.network.region_names[found.regions["region"][streets.number[before.before]]]
    more = (samples[1] - samples[0]).loc[region]
    assert more.to_numpy() == pytest.approx([3.0, 3.6 * 900.0 / 300.0, 0.0], abs=1e-6)
    assert (samples[1] - samples[0]).drop(region).to_numpy() == pytest.approx(0.0)


def test_turns_add_up(made):
    streets = read_streets(made / "city.net.xml")
    source, target = streets.links.T
    turns = np.random.default_rng(0).integers(0, 30, len(source))
    left = np.bincount(source, turns)
    entered = np.bincount(target, turns)
    rows = pd.DataFrame({"number": range(len(left)), "left": left, "entered": entered})
    found = _turns(streets, rows)
    assert np.bincount(target, found) == pytest.approx(entered)
    assert np.bincount(source, found) == pytest.approx(left, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("junctions", ["false", "true"])
def test_the_accumulations_are_those_of_the_run(tmp_path, junctions):
    """The MFD of the outflow is the one that a run's own counts give and, with vehicles on
    junctions, that of `identify`."""
    measure = tmp_path / "edges.add.xml"
    output = tmp_path / "edges.xml"
    options = f'freq="90" withInternal="{junctions}" file="{output}"'
    measure.write_text(f'<additional><edgeData id="a" {options}/></additional>')
    scenario = load_scenario("demo", {"sumo.additional": [str(measure)], "steps": 12})
    run = api.run(scenario, "no-control", seed=1000)
    net, regions = city_files(scenario.network)
    found = api.mfd(net, output, regions=regions, out=tmp_path / "out")
    columns = ["accumulation_veh", "production_veh_km_h"]
    tables = found.samples.pivot(index="begin_s", columns="region", values=columns)
    names = list(found.network.region_names)
    vehicles = tables["accumulation_veh"][names].to_numpy()
    production = tables["production_veh_km_h"][names].to_numpy() / 3.6
    if junctions == "true":
        assert vehicles == pytest.approx(mean_inside(run).sum(axis=2), rel=0.02, abs=1.0)
        assert (vehicles.sum(axis=0) > 1.03 * run["mean_accumulation"].sum(axis=0)).all()
    else:
        assert vehicles == pytest.approx(run["mean_accumulation"], rel=0.1, abs=3.0)
        assert production == pytest.approx(run["production"], rel=0.15, abs=20.0)
    outflow = regional_outflow(run, run.step)
    centre = 4
    seen = found.samples.pivot(index="begin_s", columns="region", values="outflow_veh_s")
    assert seen[names[centre]].to_numpy() == pytest.approx(outflow[:, centre], rel=0.01, abs=0.01)
    critical = found.fits["outflow_critical_veh"]
    if junctions == "true":
        samples = outflow_samples(scenario.network, [run])
        identified = [fit_quality.outflow_critical(cloud) for cloud in samples]
        assert critical.to_numpy() == pytest.approx(identified, rel=0.02, nan_ok=True)
        assert not np.isnan(critical[centre])
    else:
        counted = mfd.fit(run["mean_accumulation"][:, centre], outflow[:, centre])
        assert critical[centre] == pytest.approx(counted.critical, rel=0.05)
