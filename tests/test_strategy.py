"""Strategies by name."""

import pytest

from cosim.plant.settings import Settings
from cosim.plant.strategy import ALONE, OPTIONS, configured, metered, model_free, parse
from nmfd.controllers import registry
from nmfd.errors import InputError


@pytest.mark.parametrize(
    "name, controller, overrides",
    [
        ("no-control", "no-control", {"gateways_fixed": False}),
        ("pi-gating", "pi-gating", {"gateways_fixed": True}),
        ("actuated", "no-control", {"gateways_fixed": False, "signals": "actuated"}),
        (
            "max-pressure+rerouting-100",
            "no-control",
            {"gateways_fixed": False, "signals": "max-pressure", "rerouting": 1.0},
        ),
        ("dpc-pc+rerouting-30+webster", "dpc-pc", {"gateways_fixed": True, "signals": "webster", "rerouting": 0.3}),
        ("pi-gating+estimate", "pi-gating", {"gateways_fixed": True, "measurement": "estimate"}),
        (
            "dpc-pcrg+redistribute+compliance-0",
            "dpc-pcrg",
            {"gateways_fixed": True, "actuation": "redistribute", "compliance": 0.0},
        ),
        (
            "pi-gating+guided+max-pressure",
            "pi-gating",
            {"gateways_fixed": True, "guided": True, "signals": "max-pressure"},
        ),
        ("guided", "no-control", {"gateways_fixed": False, "guided": True}),
        ("dpc-pcrg+guidance-period-90", "dpc-pcrg", {"gateways_fixed": True, "guidance_period": 90.0}),
        ("dpc-pc+metering", "dpc-pc", {"gateways_fixed": True, "metering": True}),
        ("metering-120", "no-control", {"gateways_fixed": False, "metering": True, "metering_level": 1.2}),
    ],
)
def test_what_a_name_means(name, controller, overrides):
    strategy = parse(name)
    assert (strategy.name, strategy.controller, strategy.overrides) == (name, controller, overrides)
    assert model_free(name) == (controller == ALONE)


@pytest.mark.parametrize(
    "name, guides",
    [("pi-gating", False), ("pi-gating+guided", True), ("guided", True), ("route-guidance", True), ("dpc-pc", False)],
)
def test_who_guides(name, guides):
    assert parse(name).guides == guides


@pytest.mark.parametrize(
    "name, waits",
    [
        ("pi-gating+metering", True),
        ("route-guidance+metering-90", True),
        ("mine.py:Gate+metering", True),
        ("no-control+metering-100+short-first", True),
        ("pi-gating", False),
        ("max-pressure+rerouting-30", False),
    ],
)
def test_who_can_make_trips_wait(name, waits):
    assert metered(name) == waits


def test_every_controller_and_option_is_a_strategy():
    names = set(Settings.model_fields)
    for controller in registry.names():
        assert parse(controller).controller == controller
    for option in OPTIONS:
        option = option.replace("-N", "-50")
        assert parse(option).overrides == parse(f"no-control+{option}").overrides
        assert set(parse(f"mpc-pc+{option}").overrides) <= names


def test_a_strategy_uses_the_table_that_fits_it_best():
    tables = ["dpc-pc", "dpc-pc+max-pressure", "dpc-pc+max-pressure+rerouting-30", "dpc-pcrg+max-pressure"]
    for name, expected in (
        ("dpc-pc", "dpc-pc"),
        ("dpc-pc+webster", "dpc-pc"),
        ("dpc-pc+max-pressure", "dpc-pc+max-pressure"),
        ("dpc-pc+compliance-50+max-pressure", "dpc-pc+max-pressure"),
        ("dpc-pc+rerouting-30+max-pressure", "dpc-pc+max-pressure+rerouting-30"),
        ("max-pressure", "no-control"),
        ("mpc-pc+max-pressure", "mpc-pc"),
    ):
        assert configured(name, tables) == expected


def test_tables_that_fit_equally_well_are_an_error():
    tables = ["dpc-pc+max-pressure", "dpc-pc+metering"]
    with pytest.raises(
        InputError,
        match=(
            r"^scenario.toml: strategy 'dpc-pc\+metering\+max-pressure': the tables "
            r'\[controllers."dpc-pc\+max-pressure"\] and \[controllers."dpc-pc\+metering"\] fit it equally well; .*'
            r'\[controllers."dpc-pc\+metering\+max-pressure"\] of its own$'
        ),
    ):
        configured("dpc-pc+metering+max-pressure", tables)
    assert configured("dpc-pc+max-pressure", tables) == "dpc-pc+max-pressure"
    both = "dpc-pc+max-pressure+metering"  # its words may come in any order
    assert configured("dpc-pc+metering+max-pressure", [*tables, both]) == both


@pytest.mark.parametrize(
    "name, expected",
    [
        ("nobody", "controller 'nobody' is unknown; choose from no-control, route-guidance, pi-gating"),
        ("", "controller '' is unknown"),
        ("dpc-pc+", "strategy 'dpc-pc+': '' is unknown; choose from webster, actuated, max-pressure"),
        ("dpc-pc+pi-gating", "'pi-gating' is unknown"),
        ("webster+no-control", "'no-control' is unknown"),
        ("rerouting-0", "rerouting-N from 1 to 100"),
        ("rerouting-101", "rerouting-N from 1 to 100 percent"),
        ("guidance-period-0", "guidance-period-N from 1 to 3600 seconds"),
        ("dpc-pcrg+guidance-period-3601", "unknown"),
        ("rerouting-05", "unknown"),
        ("metering-0", "metering-N from 1 to 1000 percent"),
        ("rerouting", "unknown"),
        ("rerouting-2.5", "unknown"),
        ("actuated+webster", "actuated and webster exclude each other"),
        ("dpc-pcrg+guided", "dpc-pcrg guides routes itself; omit guided"),
        ("rerouting-30+rerouting-40", "exclude each other"),
        ("pi-gating+hold-back+redistribute", "exclude each other"),
    ],
)
def test_errors_say_what_is_allowed(name, expected):
    with pytest.raises(InputError) as caught:
        parse(name)
    assert expected in str(caught.value) and "\n" not in str(caught.value)
