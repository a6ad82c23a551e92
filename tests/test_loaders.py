"""Hypothesis on everything that is read from files: what comes out is good, or one line says what is wrong."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cosim.importing.case import seconds
from cosim.sumo.net import load_city
from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network
from nmfd.runs import run_folder
from nmfd.studies import bound

SCENARIO_KEYS = {
    "name": "x",
    "network": "../network",
    "step": 30.0,
    "steps": 20,
    "integrator": "euler",
    "substeps": 1,
    "protected": [1],
    "demand_factor": 1.0,
    "demand_file": "demand.csv",
    "base": "../scenario",
    "noise": {},
    "forecast": {"error": 0.1},
    "sumo": {},
    "controllers": {"mpc-pc": {"horizon": 4}, "dpc-pc": {"batch": 4}},
}
DEMAND_KEYS = {
    "from": 0,
    "to": 1,
    "start": 0.0,
    "peak": 1.0,
    "ramp_up": 1.0,
    "flat": 1.0,
    "ramp_down": 1.0,
    "both_ways": True,
}
REGION_KEYS = {
    "name": "a",
    "position": [0.0, 0.0],
    "adjacent": [1],
    "no_way_to": [],
    "exit_rates": [1.0, 1.0],
    "capacity": [1.0],
    "storage": 900.0,
    "mfd": {"a": 4.1e-9, "b": -8.2e-6, "c": 0.0042, "jam": 1000.0},
}
VALUES = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(),
        st.integers(-3, 30),
        st.floats(),
        st.floats(-2.0, 2000.0),
        st.text(max_size=12),
        st.sampled_from(["../network", "euler", "mpc-pc", "", ".", "/", "\x00", 10**30, -1, 0]),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
examples = settings(
    max_examples=60,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def toml(value) -> str:
    """A value as TOML writes it."""
    match value:
        case bool():
            return str(value).lower()
        case float() if not math.isfinite(value):
            return "nan" if value != value else "inf" if value > 0 else "-inf"
        case str():
            return json.dumps(value).replace("\x7f", "\\u007f")
        case list():
            return f"[{', '.join(map(toml, value))}]"
        case dict():
            return f"{{ {', '.join(f'{json.dumps(key)} = {toml(item)}' for key, item in value.items())} }}"
    return repr(value)


def good_or_one_line(load, *arguments):
    """What `load` gives, or None with an InputError of one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return load(*arguments)
        except InputError as error:
            line = " ".join(str(error).split())
            assert line and len(line) < 3000
            return None


@st.composite
def changed(draw, keys: dict):
    """A table with a few keys of `keys` changed, missing or unknown."""
    table = dict(keys)
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from([*keys, "unknown"]))
        if draw(st.booleans()):
            table.pop(key, None)
        else:
            table[key] = draw(VALUES)
    return table


def written(folder: Path, name: str, tables: dict) -> Path:
    folder.mkdir(exist_ok=True)
    text = "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in tables.items())
    (folder / name).write_bytes(text.encode("utf-8", "replace"))
    return folder


@examples
@given(table=changed(SCENARIO_KEYS), demand=changed(DEMAND_KEYS))
def test_scenarios(tmp_path, table, demand):
    if not (tmp_path / "network").exists():
        tiny.write(tmp_path)
    scenario = good_or_one_line(
        load_scenario, written(tmp_path / "other", "scenario.toml", table | {"demand": [demand]})
    )
    if scenario is not None:
        assert scenario.demand.shape == (scenario.steps, 2, 2)
        assert np.isfinite(scenario.demand).all() and (scenario.demand >= 0).all() and scenario.step > 0


@examples
@given(table=changed({"name": "x", "perimeter": {"min": 0.1, "max": 0.9}}), first=changed(REGION_KEYS))
def test_networks(tmp_path, table, first):
    second = REGION_KEYS | {"adjacent": [0], "position": [1.0, 0.0]}
    network = good_or_one_line(
        load_network, written(tmp_path / "network", "network.toml", table | {"regions": [first, second]})
    )
    if network is not None:
        assert network.regions == 2 and 0.0 <= network.u_min < network.u_max <= 1.0
        assert all(np.isfinite(mfd.capacity) and mfd.capacity > 0 for mfd in network.mfds)
        assert np.allclose(network.nominal_splits.sum(axis=1)[~np.eye(2, dtype=bool)], 1.0)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return load_network(tiny.write(tmp_path_factory.mktemp("tiny")).parent / "network")


@examples
@given(content=st.binary(max_size=300), kind=st.sampled_from(["nc", "pt", "csv", "xml", "xml.gz", "toml"]))
def test_any_bytes(tmp_path, network, content, kind):
    file = tmp_path / f"file.{kind}"
    magic = {"nc": b"\x89HDF\r\n\x1a\n", "pt": b"PK\x03\x04", "xml.gz": b"\x1f\x8b\x08\x00"}.get(kind, b"")
    for bytes_ in (content, magic + content):
        file.write_bytes(bytes_)
        (tmp_path / "n").mkdir(exist_ok=True)
        (tmp_path / "n" / "network.toml").write_bytes(bytes_)
        loaders = {
            "nc": [run_folder.read_trajectory],
            "pt": [lambda path: load_policy(path, network)],
            "csv": [run_folder.read_summary, lambda path: load_city(tmp_path / "none.net.xml", path, 2)],
            "xml": [read_originals_of, lambda path: load_city(path, tmp_path / "none.csv", 2)],
            "xml.gz": [read_originals_of, lambda path: load_city(path, tmp_path / "none.csv", 2)],
            "toml": [lambda path: load_network(tmp_path / "n")],
        }
        for load in loaders[kind]:
            assert good_or_one_line(load, file) is None


def read_originals_of(path: Path):
    found = read_recorded_trips([path])
    return None if not len(found.depart) else found


@examples
@given(text=st.text(max_size=30) | st.from_regex(r"[a-z0-9,.+=:-]{0,20}", fullmatch=True))
def test_texts_of_the_command_line(text):
    for load in (
        parse,
        lambda value: seconds(value, "--begin"),
        bound.check,
    ):
        good_or_one_line(load, text)
