"""The preset of the training that the paper describes."""

import math

import numpy as np
import pytest
import tiny
import torch

import nmfd
from nmfd.controllers import training
from nmfd.controllers.dpc.options import PUBLISHED
from nmfd.controllers.dpc.policy import SoftExponential
from nmfd.controllers.strategy import parse


def published(tmp_path, *without):
    settings = {
        "controllers.dpc-pcrg.preset": "published",
        "controllers.dpc-pcrg.preset_without": list(without),
    }
    return nmfd.load_scenario(tiny.write(tmp_path), settings)


@pytest.mark.slow
def test_the_published_preset_trains_loads_and_drives(tmp_path, monkeypatch):
    """All its parts act: the rates, the noise, the turns of the decoders, and the network in the
    file."""
    scenario, seen = published(tmp_path), []
    adam = training.Adam.step

    def step(self):
        (group,) = self.param_groups
        trained = {
            tuple(p.shape) for p in group["params"] if p.grad is not None
        }  # last layers: (8, 128) and (4, 128)
        seen.append((group["lr"], group["weight_decay"], (8, 128) in trained, (4, 128) in trained))
        return adam(self)

    monkeypatch.setattr(training.Adam, "step", step)
    file = nmfd.train(scenario, "dpc-pcrg", out=tmp_path / "mine.pt", steps=12)
    assert seen == [(1e-4, 1e-6, False, True)] * 10 + [(1e-4, 1e-6, True, False)] * 2
    weights = torch.load(file, weights_only=True)["weights"]
    assert {
        name: tuple(weights[name].shape)
        for name in weights
        if "splits" in name and "weight" in name
    } == {
        "splits_decoder.0.weight": (128, 128),
        "splits_decoder.2.weight": (8, 128),
    }
    assert weights["backbone.1.a"] != 0.0
    assert weights["perimeter_decoder.1.a"] != 0.0
    result = nmfd.run(scenario, "dpc-pcrg", policy=file)
    assert (result["perimeter"][:, 0, 1] >= 0.1).all()
    assert np.isfinite(result["accumulation"]).all()


def test_one_part_at_a_time_and_what_does_not_fit(tmp_path):
    setup = training.settings(published(tmp_path, "batch", "clip"), parse("dpc-pcrg"))
    assert (setup.recipe.batch, setup.recipe.clip, setup.recipe.weight_decay) == (16, 1.0, 1e-6)
    assert math.isinf(PUBLISHED.clip)
    with pytest.raises(
        nmfd.InputError,
        match=r"preset_without: expected parts of the preset published, of learning_rat",
    ):
        published(tmp_path / "other", "colour")
    with pytest.raises(
        nmfd.InputError, match="dpc-pcrg.preset: begins with a random network; omit compact, local"
    ):
        nmfd.load_scenario(
            tmp_path / "scenario",
            {"controllers.dpc-pcrg.preset": "published", "controllers.dpc-pcrg.compact": True},
        )


@pytest.mark.parametrize("a", [-0.7, -1e-3, 0.0, 5e-4, 1e-3, 0.4])
def test_the_soft_exponential(a):
    """Godfrey and Gashler (2015), equation by equation; the gradient of a by finite differences, at
    0 too."""
    x = torch.linspace(-0.5, 3.0, 15, dtype=torch.float64)
    made = SoftExponential().double()
    made.a.data.fill_(a)
    if a:
        expected = (
            -np.log(1.0 - a * (x.numpy() + a)) / a if a < 0 else np.expm1(a * x.numpy()) / a + a
        )
        np.testing.assert_allclose(made(x).detach().numpy(), expected, rtol=2e-5, atol=2e-6)
    made(x).sum().backward()
    sums = []
    for step in (1e-5, -1e-5):
        with torch.no_grad():
            made.a.fill_(a + step)
            sums.append(made(x).sum().item())
    if abs(abs(a) - 1e-3) > 1e-4:
        assert made.a.grad.item() == pytest.approx((sums[0] - sums[1]) / 2e-5, rel=1e-3)
