"""The view of a city as large as Luxembourg, 5,747 streets: pytest -n0 tests/benchmarks --benchmark-only"""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.embed import components

from cosim.importing.maps import rings_round
from cosim.view.page import Page, with_slider
from cosim.view.picture import CityPicture, Frame, Gate, between

EDGES, REGIONS, GATES, ACROSS = 5747, 12, 300, 76


@pytest.fixture(scope="module")
def city():
    """Streets of 150 m with four bends each, in 12 regions."""
    random, shapes = np.random.default_rng(0), []
    for n in range(EDGES):
        begin = 150.0 * np.array([n // 2 % ACROSS, n // 2 // ACROSS])
        shapes.append(np.linspace(begin, begin + 150.0 * np.eye(2)[n % 2], 6) + random.normal(0.0, 8.0, (6, 2)))
    middles = np.array([shape.mean(axis=0) for shape in shapes])
    region = np.minimum(REGIONS * middles[:, 0] / np.ptp(middles[:, 0]), REGIONS - 1).astype(int).clip(0)
    gates = tuple(
        Gate(
            source=int(region[e]), target=int(region[e] + 1) % REGIONS, place=(*middles[e],), gateways=(n,), signal=True
        )
        for n, e in enumerate(random.choice(EDGES, GATES, replace=False))
    )
    return CityPicture(
        name="large",
        region_names=tuple(map(str, range(REGIONS))),
        edges=tuple(f"e{n}" for n in range(EDGES)),
        shapes=shapes,
        lane_km=np.full(EDGES, 0.15),
        limit=np.full(EDGES, 14.0),
        lanes=random.integers(1, 4, EDGES),
        region=region,
        outlines=rings_round(shapes, np.ones(EDGES, dtype=bool), region, 0.08),
        places=np.stack([middles[region == r].mean(axis=0) for r in range(REGIONS)]),
        gates=gates,
        critical=np.full(REGIONS, 500.0),
        curves=[np.ones((60, 2))] * REGIONS,
        step=60.0,
        steps=60,
    )


@pytest.fixture(scope="module")
def frame():
    return Frame(
        time=0.0,
        intervals=0,
        whole=True,
        density=np.zeros(EDGES, np.float16),
        speed=np.zeros(EDGES, np.float16),
        accumulation=np.zeros(REGIONS),
        outflow=np.zeros(REGIONS),
        waiting=0.0,
        completed=0.0,
        removed=0.0,
        time_spent=0.0,
        perimeter=np.ones((REGIONS, REGIONS)),
        green=np.ones(GATES),
        queue=np.zeros(GATES),
        guided=np.zeros((REGIONS, REGIONS)),
    )


def test_a_frame_in_the_run(benchmark, city, frame):
    vehicles, speed = np.ones(EDGES), np.ones(EDGES)
    benchmark(lambda: pickle.dumps(between(city, frame, 10.0, vehicles, speed)))
    assert benchmark.stats["median"] < 0.005


def test_a_picture_in_the_server(benchmark, city, frame):
    page, document = Page(city, ["one", "other"]), Document()
    document.add_root(page.layout([]))
    benchmark(page.show, [frame, frame], 10.0)
    assert benchmark.stats["median"] < 0.1


def test_the_size_of_a_report(benchmark, city, frame):
    """One hour of two runs, an interval a minute."""
    random = np.random.default_rng(1)
    runs = {
        name: [
            replace(
                frame,
                time=60.0 * k,
                intervals=k,
                density=random.uniform(0.0, 133.0, EDGES).astype(np.float16),
                green=random.uniform(size=GATES),
                queue=random.uniform(0.0, 30.0, GATES),
            )
            for k in range(61)
        ]
        for name in ("one", "other")
    }
    script, div = benchmark.pedantic(lambda: components(with_slider(city, runs), wrap_script=False), rounds=1)
    assert len(script) + len(div) < 13e6
