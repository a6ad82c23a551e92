"""Strategies: parsing, tables, planning models, fingerprints and lists of names."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
from commands import problem

import nmfd
from cosim.plant.settings import Settings
from cosim.plant.strategy import WORDS, Word, parse, vocabulary
from nmfd.controllers import strategy as regional
from nmfd.controllers.strategy import ALONE, CONTROLLERS
from nmfd.errors import InputError


@pytest.mark.parametrize(
    "name, controller, city",
    [
        ("no-control", "no-control", {}),
        ("pi-gating", "pi-gating", {}),
        ("actuated", "no-control", {"signals": "actuated"}),
        ("max-pressure+rerouting-100", "no-control", {"signals": "max-pressure", "rerouting": 1.0}),
        ("dpc-pc+rerouting-30+webster", "dpc-pc", {"signals": "webster", "rerouting": 0.3}),
        ("pi-gating+estimate", "pi-gating", {"measurement": "estimate"}),
        ("dpc-pcrg+actuated+compliance-0", "dpc-pcrg", {"signals": "actuated", "compliance": 0.0}),
        ("pi-gating+guided+max-pressure", "pi-gating", {"guided": True, "signals": "max-pressure"}),
        ("guided", "no-control", {"guided": True}),
        ("dpc-pcrg+guidance-period-90", "dpc-pcrg", {"guidance_period": 90.0}),
        ("dpc-pc+metering", "dpc-pc", {"metering": 1.2}),
        ("metering-120", "no-control", {"metering": 1.2}),
        ("a.py:Gate", "a.py:Gate", {}),
        (
            "a+b/c d.py:Gate+actuated+rerouting-30",
            "a+b/c d.py:Gate",
            {"signals": "actuated", "rerouting": 0.3},
        ),
    ],
)
def test_what_a_name_means(name, controller, city):
    """Only without control may signals with gateways be actuated."""
    strategy = parse(name)
    assert (strategy.name, strategy.controller.name) == (name, controller)
    assert strategy.changes == {"gateways_fixed": controller != ALONE, **city}
    assert hash(strategy) == hash(parse(name))


@pytest.mark.parametrize(
    "name, guides",
    [
        ("pi-gating", False),
        ("pi-gating+guided", True),
        ("guided", True),
        ("route-guidance", True),
        ("dpc-pc", False),
    ],
)
def test_who_guides(name, guides):
    assert parse(name).guides == guides


def test_every_controller_and_word_is_a_strategy():
    for controller in CONTROLLERS:
        assert parse(controller).controller is CONTROLLERS[controller]
    words = [word.lstrip("+").replace("-N", "-50") for word in vocabulary()]
    for word in words:
        assert parse(word).changes == parse(f"no-control+{word}").changes
        assert set(parse(f"mpc-pc+{word}").changes) <= set(Settings.model_fields)
    assert {"max-pressure", "guided", "metering-50"} <= set(words)


def test_a_new_word_is_one_entry(monkeypatch):
    monkeypatch.setitem(WORDS, "half", Word("compliance", 0.5, "half of the drivers follow"))
    strategy = parse("dpc-pcrg+half")
    assert strategy.city.compliance == 0.5
    assert regional.parse("dpc-pcrg+half").labels == ("half",)
    assert vocabulary()["+half"] == "half of the drivers follow"


def test_settings_are_a_city():
    city = Settings(signals="max-pressure", guidance_period=60.0)
    strategy = parse(nmfd.PiGating(kp=2.0), city)
    assert strategy.name == "pi-gating(kp=2.0)+guidance-period-60+max-pressure"
    assert parse(strategy.name).changes == strategy.changes
    assert parse("pi-gating+guided", city).changes["guided"]
    assert parse("pi-gating", Settings(chain_limit=0.2)).name == "pi-gating+chain_limit=0.2"
    with pytest.raises(InputError, match="actuated and max-pressure exclude each other"):
        parse("pi-gating+actuated", city)


@pytest.mark.parametrize(
    "options, name",
    [
        (nmfd.NoControl(), "no-control"),
        (nmfd.PiGating(), "pi-gating"),
        (nmfd.PiGating(kp=2.0, set_point=(100.0,)), "pi-gating(set_point=[100.0], kp=2.0)"),
        (nmfd.EconomicMpc(guidance=True, horizon=4), "mpc-pcrg(horizon=4)"),
        (nmfd.EconomicMpc(terminal=True), "mpc-pc-terminal"),
        (nmfd.Probing(guidance=True), "probing-pcrg"),
        (nmfd.PricingRule(metering=True), "pricing-rule(metering=true)"),
        (nmfd.Dpc(), "dpc-pcrg"),
        (nmfd.Dpc(guidance=False), "dpc-pc"),
        (nmfd.Bound(plan="a.npz"), 'bound-pc(plan="a.npz")'),
    ],
    ids=repr,
)
def test_options_have_a_name_that_means_them(options, name):
    strategy = regional.parse(options)
    assert strategy.name == name
    again = regional.parse(f"{name}()" if "(" not in name else name)
    one, other = (each.controller.default for each in (again, strategy))
    assert one.model_dump(exclude={"guidance"}) == other.model_dump(exclude={"guidance"})
    assert one.guides == other.guides


@pytest.mark.parametrize(
    "name, expected",
    [
        ("pi-gating(kp)", "expected pi-gating(key=value, ...)"),
        ("pi-gating(kq=1)", "kq: unknown key; allowed here: model, set_point"),
        ("mpc-pc(guidance=true)", "guidance: is false for mpc-pc"),
        ("pi-gating(kp=-1)", "greater than or equal to 0"),
    ],
)
def test_wrong_options_in_a_name(name, expected):
    assert expected in problem(regional.parse, name)


def test_the_table_with_most_words_applies(scenario):
    tables = [
        "dpc-pc",
        "dpc-pc+max-pressure",
        "dpc-pc+max-pressure+rerouting-30",
        "dpc-pcrg+max-pressure",
    ]
    scenario = replace(scenario, controller_options={name: {} for name in tables})
    for name, expected in (
        ("dpc-pc", "dpc-pc"),
        ("dpc-pc+webster", "dpc-pc"),
        ("dpc-pc+max-pressure", "dpc-pc+max-pressure"),
        ("dpc-pc+compliance-50+max-pressure", "dpc-pc+max-pressure"),
        ("dpc-pc+rerouting-30+max-pressure", "dpc-pc+max-pressure+rerouting-30"),
        ("max-pressure", "no-control"),
        ("mpc-pc+max-pressure", "mpc-pc"),
    ):
        assert parse(name).table(scenario) == expected


def test_tables_that_fit_equally_well_are_an_error(scenario):
    tables = {"dpc-pc+max-pressure": {}, "dpc-pc+metering": {}}
    rivals = replace(scenario, controller_options=tables)
    with pytest.raises(
        InputError, match=r'fit it equally well; add a table \[controllers."dpc-pc\+metering\+max-p'
    ):
        parse("dpc-pc+metering+max-pressure").table(rivals)
    both = "dpc-pc+max-pressure+metering"  # its words may come in any order
    solved = replace(scenario, controller_options={**tables, both: {}})
    assert parse("dpc-pc+metering+max-pressure").table(solved) == both


@pytest.mark.parametrize(
    "name, expected",
    [
        (
            "nobody",
            "controller 'nobody' is unknown; choose from no-control, route-guidance, pi-gating",
        ),
        ("pi_gating", "unknown; did you mean pi-gating?"),
        ("dpc-pcrg+max-presure", "'max-presure' is unknown; did you mean max-pressure?"),
        ("dpc-pcrg+complience-50", "did you mean compliance-N?"),
        ("", "controller '' is unknown"),
        (
            "dpc-pc+",
            "strategy 'dpc-pc+': '' is unknown; choose from webster, actuated, max-pressure",
        ),
        ("webster+no-control", "'no-control' is unknown"),
        ("rerouting-101", "rerouting-N from 1 to 100 percent"),
        ("dpc-pcrg+guidance-period-3601", "guidance-period-N from 1 to 3600 seconds"),
        ("rerouting-05", "unknown"),
        ("rerouting-2.5", "unknown"),
        ("actuated+webster", "actuated and webster exclude each other"),
        ("dpc-pcrg+guided", "dpc-pcrg guides routes itself; omit guided"),
        ("mine.py:", "is unknown"),
        ("mine.py:1a", "or file.py:Class"),
    ],
)
def test_errors_say_what_is_allowed(name, expected):
    assert expected in problem(parse, name)


def test_the_regional_model_takes_no_words_for_a_city():
    assert parse("pi-gating").regional().name == "pi-gating"
    with pytest.raises(
        InputError, match=r"\+guided\+max-pressure needs a city in SUMO .*use pi-gating"
    ):
        parse("pi-gating+guided+max-pressure").regional()


def test_an_object_is_a_strategy(scenario):
    controller = nmfd.controller("no-control", scenario)
    strategy = parse(controller, "max-pressure")
    assert (strategy.name, strategy.city.signals) == ("no-control+max-pressure", "max-pressure")
    assert strategy.make(scenario) is controller
    assert strategy.planning(scenario).network.hash == scenario.network.hash
    for wrong in (type("Half", (), {"reset": lambda self: None})(), nmfd.PiGating):
        with pytest.raises(InputError, match="an object with reset and act"):
            parse(wrong)
    with pytest.raises(InputError, match="reads no policy"):
        strategy.make(scenario, tiny)


def test_a_fingerprint_changes_with_what_the_runs_depend_on(scenario):
    gating = parse("pi-gating")
    before = gating.fingerprint(scenario)
    other = replace(scenario, controller_options={"pi-gating": {"kp": 2.0}})
    assert gating.fingerprint(other) != before == gating.fingerprint(scenario)
    assert gating.fingerprint(other)["options"] == {"kp": 2.0}
    assert parse(ALONE).fingerprint(scenario) == {}
    network = replace(
        scenario.network, mfds=tuple(replace(m, jam=2 * m.jam) for m in scenario.network.mfds)
    )
    moved = replace(scenario, network=network)
    assert gating.fingerprint(moved)["model"] != before["model"]
    assert parse("probing-pc").fingerprint(moved) == parse("probing-pc").fingerprint(scenario)


def test_a_missing_policy_is_named(scenario):
    with pytest.raises(
        InputError, match=r"dpc-pc\.pt: no such policy for dpc-pc; make one with: nmfd train"
    ):
        parse("dpc-pc").make(scenario)
    with pytest.raises(InputError, match="controller greedy reads no policy"):
        parse("greedy").make(scenario, tiny)


@pytest.mark.parametrize(
    "name", ["no-control", "route-guidance", "pi-gating", "greedy", "mpc-pc", "probing-pcrg"]
)
def test_controllers_are_made_from_arrays_of_their_own(scenario, name):
    controller, x = parse(name).make(scenario), np.full((2, 2), 100.0)
    controller.reset(1)
    controls = controller.act(tiny.seen(x))
    assert controls.perimeter.shape == (2, 2)
    assert not np.shares_memory(controls.perimeter, scenario.network.adjacency)
