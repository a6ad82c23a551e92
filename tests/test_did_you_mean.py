"""A misspelt key, controller, option or folder gets a hint; something else gets none."""

import pytest
import tiny

from nmfd.api import load_scenario
from nmfd.controllers.strategy import CONTROLLERS, parse
from nmfd.errors import InputError, did_you_mean


def problem(call, *arguments) -> str:
    with pytest.raises(InputError) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "call, arguments, hint",
    [
        (parse, ["dpc-prcg"], "dpc-pcrg"),
        (parse, ["pi_gating"], "pi-gating"),
        (parse, ["dpc-pcrg+max-presure"], "max-pressure"),
        (parse, ["no-controll"], "no-control"),
        (parse, ["dpc-pcrg+complience-50"], "compliance-N"),
        (parse, ["actuatd"], "actuated"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_names(call, arguments, hint):
    assert f"did you mean {hint}?" in problem(call, *arguments)


@pytest.mark.parametrize(
    "old, new, key",
    [
        ("step = 30.0", "stepp = 30.0", "step"),
        ("ramp_up", "rampup", "ramp_up"),
        ("measurement_std", "measurment_std", "measurement_std"),
    ],
    ids=["in place of a required key", "in a list", "a table"],
)
def test_keys(tmp_path, old, new, key):
    scenario = tiny.write(tmp_path, scenario=tiny.SCENARIO.replace(old, new))
    assert f"unknown key; did you mean {key}?; allowed here: " in problem(load_scenario, scenario)


def test_what_is_like_nothing_gets_no_hint():
    assert did_you_mean("quux", CONTROLLERS) == ""
    assert "did you mean" not in problem(parse, "nobody")
