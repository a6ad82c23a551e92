"""Scenarios on a base, and controllers that plan with another model than that of the scenario."""

import numpy as np
import pytest
import tiny

from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.controllers.dpc import training
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.planning import planning_model

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
    return tiny.write(tmp_path, scenario=tiny.SCENARIO + "\n[controllers.pi-gating]\nkp = 1.0\nki = 0.02\n")


def beside(base, text, name="other"):
    folder = base.parent / name
    folder.mkdir()
    (folder / "scenario.toml").write_text(text)
    return folder


def test_what_a_scenario_does_not_say_is_its_bases(base):
    own, inherited = load_scenario(base), load_scenario(beside(base, OTHER))
    assert (inherited.name, inherited.steps, inherited.step) == ("other", 5, own.step)
    assert inherited.network.hash == own.network.hash and inherited.protected == own.protected
    np.testing.assert_allclose(inherited.demand, 2.0 * own.demand[:5])
    assert inherited.controller_options["pi-gating"] == {"kp": 3.0, "ki": 0.02}


def test_a_base_in_another_folder(base):
    deeper = base.parent / "deep" / "other"
    deeper.mkdir(parents=True)
    (deeper / "scenario.toml").write_text('name = "deep"\nbase = "../../scenario"\n')
    assert load_scenario(deeper).network.hash == load_scenario(base).network.hash


@pytest.mark.parametrize(
    "text, message",
    [
        ('name = "x"\nbase = "../nowhere"\n', "nowhere/scenario.toml: no such file"),
        ('name = "x"\nbase = "."\n', "base: the scenarios are each other's base"),
        ('name = "x"\nbase = "../scenario"\ndemand_factor = -1.0\n', "demand_factor: should be greater"),
    ],
)
def test_errors_of_a_base(base, text, message):
    with pytest.raises(InputError, match=message):
        load_scenario(beside(base, text))


def test_a_controller_plans_with_the_model_that_it_names(base, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "network.toml").write_text(tiny.row_network(2).replace("jam = 1000.0", "jam = 800.0"))
    folder = beside(base, 'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\nhorizon = 4\n')
    scenario = load_scenario(folder)
    planned = planning_model(scenario, "mpc-pc")
    assert planned.network.mfds[0].jam == 800.0 and planned.controller_options["mpc-pc"] == {"horizon": 4}
    assert planning_model(scenario, "mpc-pcrg").network.mfds[0].jam == 1000.0
    assert make_controller("mpc-pc", scenario).options.horizon == 4


def test_guiding_controllers_find_the_model_of_guided_drivers(base, tmp_path):
    network = load_scenario(base).network.folder
    (network / "guided").mkdir()
    (network / "guided" / "network.toml").write_text(tiny.row_network(2).replace("jam = 1000.0", "jam = 800.0"))
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "network.toml").write_text(tiny.row_network(2).replace("jam = 1000.0", "jam = 700.0"))
    scenario = load_scenario(
        beside(base, 'name = "x"\nbase = "../scenario"\n[controllers."dpc-pcrg+max-pressure"]\nmodel = "../model"\n')
    )
    jam = {
        name: planning_model(scenario, name).network.mfds[0].jam
        for name in ("dpc-pcrg", "mpc-pcrg", "dpc-pcrg-robust", "dpc-pc", "bound-pcrg", "dpc-pcrg+max-pressure")
    }
    assert list(jam.values()) == [800.0, 800.0, 800.0, 1000.0, 1000.0, 700.0]
    (network / "guided" / "network.toml").write_text(tiny.row_network(3))
    with pytest.raises(InputError, match="guided/network.toml: network .* has other regions"):
        planning_model(scenario, "dpc-pcrg")


def test_an_inherited_model_lies_where_the_base_says(base, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "network.toml").write_text(tiny.row_network(2).replace("jam = 1000.0", "jam = 800.0"))
    beside(base, 'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\n')
    far = tmp_path / "far" / "away"
    far.mkdir(parents=True)
    [first] = [folder.parent for folder in tmp_path.glob("*/scenario.toml") if 'name = "x"' in folder.read_text()]
    (far / "scenario.toml").write_text(f'name = "y"\nbase = "../../{first.name}"\n')
    assert planning_model(load_scenario(far), "mpc-pc").network.mfds[0].jam == 800.0


def test_a_variant_has_options_model_and_policy_of_its_own(base, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "network.toml").write_text(tiny.row_network(2).replace("jam = 1000.0", "jam = 800.0"))
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
    with pytest.raises(InputError, match="'dpc-pc\\+webster' needs a table"):
        training.settings(scenario, parse("dpc-pc+webster"))


def test_a_model_of_another_city_is_refused(base, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "network.toml").write_text(tiny.row_network(3))
    folder = beside(base, 'name = "x"\nbase = "../scenario"\n[controllers.mpc-pc]\nmodel = "../model"\n')
    with pytest.raises(InputError, match="controllers.mpc-pc.model: network row3 has other regions"):
        make_controller("mpc-pc", load_scenario(folder))
