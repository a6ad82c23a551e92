"""Scenario and network files: settings, bases, errors, and models that controllers plan with."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
from commands import problem

from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.controllers import training
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network, network_toml
from nmfd.model.scenario import read_scenario

OTHER = """
name = "other"
base = "../scenario"
steps = 5
demand_factor = 2.0

[controllers.pi-gating]
kp = 3.0
"""


@pytest.fixture
def base(tmp_path):
    return tiny.write(
        tmp_path, scenario=tiny.SCENARIO + "\n[controllers.pi-gating]\nkp = 1.0\nki = 0.02\n"
    )


def beside(base, text, name="other"):
    folder = base.parent / name
    folder.mkdir()
    (folder / "scenario.toml").write_text(text)
    return folder


def model(folder, jam=800.0, regions=2):
    """A network in `folder`, named by its jam accumulation."""
    folder.mkdir()
    (folder / "network.toml").write_text(
        tiny.row_network(regions).replace("jam = 1000.0", f"jam = {jam}")
    )


def test_what_a_scenario_does_not_say_is_its_bases(base):
    own, inherited = load_scenario(base), load_scenario(beside(base, OTHER))
    assert (inherited.name, inherited.steps, inherited.step) == ("other", 5, own.step)
    assert inherited.network.hash == own.network.hash
    assert inherited.protected == own.protected
    np.testing.assert_allclose(inherited.demand, 2.0 * own.demand[:5])
    assert inherited.controller_options["pi-gating"] == {"kp": 3.0, "ki": 0.02}


def test_a_base_in_another_folder(base):
    deeper = base.parent / "deep" / "other"
    deeper.mkdir(parents=True)
    (deeper / "scenario.toml").write_text('name = "deep"\nbase = "../../scenario"\n')
    assert load_scenario(deeper).network.hash == load_scenario(base).network.hash


def test_settings_replace_those_of_the_file(base):
    changed = read_scenario(
        base,
        {
            "steps": 12,
            "controllers.pi-gating.kp": 2,
            'controllers."pi-gating+rerouting-30".ki': 0.1,
            "sumo.seed": 1,
        },
    )
    assert changed.steps == 12
    assert len(changed.demand) == 12
    assert changed.sumo == {"seed": 1}
    assert changed.controller_options["pi-gating"] == {"kp": 2, "ki": 0.02}
    assert changed.controller_options["pi-gating+rerouting-30"] == {"ki": 0.1}
    with pytest.raises(InputError, match="scenario.toml: stepz"):
        read_scenario(base, {"stepz": 12})


def test_vehicles_at_the_start(base):
    assert not load_scenario(base).start.any()
    begun = read_scenario(base, {"initial": [[0.0, 100.0], [0.0, 50.0]]})
    assert begun.start.tolist() == [[0.0, 100.0], [0.0, 50.0]]
    assert begun.hash != load_scenario(base).hash
    for wrong in ([[1.0, 2.0]], [[1.0, 2.0], [3.0]], [[1.0, -2.0], [0.0, 0.0]]):
        with pytest.raises(
            InputError, match="scenario.toml: initial: expected 2 lists of 2 numbers"
        ):
            read_scenario(base, {"initial": wrong})


def test_a_network_is_written_as_it_is_read(tmp_path):
    network = load_network("grid7")
    doubted = replace(
        network,
        doubts=(("one seed",),) * 7,
        placeholder=True,
        controllable=np.where(network.adjacency, 0.25, 0.0),
    )
    (tmp_path / "network.toml").write_text(network_toml(doubted, {}, "a test"))
    again = load_network(tmp_path)
    assert again.hash == network.hash
    assert again.doubts == doubted.doubts
    assert again.placeholder
    assert again.observed_split_ratios.keys() == network.observed_split_ratios.keys() != set()
    np.testing.assert_array_equal(again.controllable, doubted.controllable)


@pytest.mark.parametrize(
    "text, message",
    [
        ('name = "x"\nbase = "../nowhere"\n', "nowhere/scenario.toml: no such file"),
        ('name = "x"\nbase = "."\n', "base: the scenarios are each other's base"),
        (
            'name = "x"\nbase = "../scenario"\ndemand_factor = -1.0\n',
            "scenario.toml: demand_factor",
        ),
        ('name = "x"\nbase = "../scenario"\nprotected = [2]\n', "scenario.toml: protected"),
        ('name = "x"\nbase = "../scenario"\nnetwork = "../none"\n', "network.toml: no such file"),
        (
            'name = "x"\nnetwork = "../network"\nstep = 30.0\nsteps = 5\n',
            "scenario.toml: demand: missing",
        ),
        (
            tiny.SCENARIO.replace("to = 1", "to = 7"),
            r"scenario.toml: demand\[0\].to: region 7 is unknown",
        ),
    ],
)
def test_wrong_scenarios(base, text, message):
    assert re.search(message, problem(load_scenario, beside(base, text)))


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("[0]", "[5]", r"regions\[1\].adjacent: .*\[5\]"),
        ("adjacent = [1]", "adjacent = []", "regions: region 1 cannot be reached from region 0"),
        (
            "adjacent = [1]",
            "adjacent = [1]\ncapacity = [1.0]",
            r"regions\[0\].capacity: capacity and storage belong",
        ),
        (
            "adjacent = [1]",
            "adjacent = [1]\nexit_rates = [1.0]",
            r"regions\[0\].exit_rates: .* 2 numbers",
        ),
        (
            "adjacent = [0]",
            "adjacent = [0]\nexit_rates = [1.0, 1.0]",
            r"regions\[0\].exit_rates: missing",
        ),
        ("adjacent = [1]", "adjacent = [1]\nobserved_split_ratios.1 = { 1 = 0.5 }", "with sum 1"),
        ("max = 0.9", "max = 0.1", "perimeter: min must be less"),
    ],
)
def test_wrong_networks(tmp_path, old, new, message):
    folder = tiny.write(tmp_path, network=tiny.row_network().replace(old, new)).parent / "network"
    with pytest.raises(InputError, match=f"network.toml: {message}|network.toml: .*{message}"):
        load_network(folder)


def test_a_controller_plans_with_the_model_that_it_names(base, tmp_path):
    model(tmp_path / "model")
    folder = beside(
        base,
        'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\nhorizon = 4\n',
    )
    scenario = load_scenario(folder)
    planned = parse("mpc-pc").own_planning(scenario)
    assert planned.network.mfds[0].jam == 800.0
    assert planned.controller_options["mpc-pc"] == {"horizon": 4}
    assert parse("mpc-pcrg").own_planning(scenario).network.mfds[0].jam == 1000.0
    assert make_controller("mpc-pc", scenario).options.horizon == 4


def test_guiding_controllers_find_the_model_of_guided_drivers(base, tmp_path):
    network = load_scenario(base).network.folder
    model(network / "guided")
    model(tmp_path / "model", jam=700.0)
    scenario = load_scenario(
        beside(
            base,
            'name = "x"\nbase = "../scenario"\n[controllers."dpc-pcrg+max-pressure"]\n'
            'model = "../model"\n',
        )
    )
    jam = {
        name: parse(name).own_planning(scenario).network.mfds[0].jam
        for name in ("dpc-pcrg", "mpc-pcrg", "dpc-pc", "bound-pcrg", "dpc-pcrg+max-pressure")
    }
    assert list(jam.values()) == [800.0, 800.0, 1000.0, 1000.0, 700.0]
    (network / "guided" / "network.toml").write_text(tiny.row_network(3))
    with pytest.raises(InputError, match="guided/network.toml: network .* has other regions"):
        parse("dpc-pcrg").own_planning(scenario)


def test_an_inherited_model_lies_where_the_base_says(base, tmp_path):
    model(tmp_path / "model")
    first = beside(
        base, 'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\n'
    )
    far = tmp_path / "far" / "away"
    far.mkdir(parents=True)
    (far / "scenario.toml").write_text(f'name = "y"\nbase = "../../{first.name}"\n')
    assert parse("mpc-pc").own_planning(load_scenario(far)).network.mfds[0].jam == 800.0


def test_a_variant_has_options_model_and_policy_of_its_own(base, tmp_path):
    model(tmp_path / "model")
    folder = beside(
        base,
        """name = "x"
base = "../scenario"
[controllers.dpc-pc]
steps = 3
mfd_spread = 0.1
detour_cost = 1.0
[controllers."dpc-pc+max-pressure"]
model = "../model"
mfd_spread = 0.2
""",
    )
    scenario = load_scenario(folder)
    chosen = training.settings(scenario, parse("dpc-pc+max-pressure"))
    assert (chosen.steps, chosen.mfd_spread, chosen.detour_cost) == (3, 0.2, 1.0)
    assert training.settings(scenario, parse("dpc-pc")).mfd_spread == 0.1
    for name in ("dpc-pc", "dpc-pc+max-pressure"):
        training.train(scenario, parse(name), seed=0, out=folder / f"{name}.pt", steps=1)
        assert parse(name).file(scenario) == folder / f"{name}.pt"
        assert make_controller(name, scenario).name == "dpc-pc"
    with pytest.raises(InputError, match="network"):  # each was trained on its own model
        make_controller("dpc-pc", scenario, policy=folder / "dpc-pc+max-pressure.pt")


def test_a_model_of_another_city_is_refused(base, tmp_path):
    model(tmp_path / "model", regions=3)
    folder = beside(
        base, 'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\n'
    )
    with pytest.raises(
        InputError, match="controllers.mpc-pc.model: network row3 has other regions"
    ):
        make_controller("mpc-pc", load_scenario(folder))
