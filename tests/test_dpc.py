"""DPC: constraints by construction, policy files, and training."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from commands import problem

import nmfd
from nmfd import api
from nmfd.api import load_scenario
from nmfd.controllers import training
from nmfd.controllers.dpc import first_policy
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.dpc.policy import FILL_TIME_S, MOST_PRICE, Architecture, DpcController, Policy
from nmfd.controllers.dpc.policy_file import checkpoint, load, load_policy
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import load_network
from nmfd.types import Controls, Status

PRICED = {"guidance": True, "prices": True, "metering": True}
NETWORK = load_network("hexagon7")


def policy(*, guidance, network=NETWORK, spread=1.0, **outputs):
    torch.manual_seed(0)
    made = Policy(network, Architecture(width=16, guidance=guidance, **outputs))
    with torch.no_grad():
        for weights in made.parameters():
            weights.add_(spread * torch.randn_like(weights))
    return made


@pytest.mark.parametrize(
    "outputs", [{}, {"guidance": True}, PRICED, {**PRICED, "sparse": True}], ids=str
)
def test_any_weights_and_any_state_give_admissible_controls(outputs):
    controller, random = (
        DpcController(policy(**{"guidance": False, **outputs})),
        np.random.default_rng(0),
    )
    for scale in (0.0, 1.0, 1e3, 1e5, 1e7):
        controls = controller.act(tiny.seen(scale * random.standard_normal((7, 7))))
        assert controls.status == Status.OK
        u = controls.perimeter[NETWORK.adjacency]
        assert NETWORK.u_min - 1e-7 <= u.min()
        assert u.max() <= NETWORK.u_max + 1e-7
        assert (controls.perimeter[~NETWORK.adjacency] == 0.0).all()
        assert (controls.splits is not None) == ("guidance" in outputs)
        if controls.splits is not None:
            assert controls.splits.min() >= 0.0
            assert (controls.splits[~NETWORK.split_mask] == 0.0).all()
            np.testing.assert_allclose(
                controls.splits.sum(axis=1), 1.0 - np.eye(7), rtol=0.0, atol=1e-12
            )
        if "prices" in outputs:
            assert (controls.prices >= 0.0).all()
            assert (controls.prices <= MOST_PRICE).all()
            assert (controls.metering >= 0.0).all()
            assert (controls.metering * FILL_TIME_S < NETWORK.critical + 0.1).all()


def test_forbidden_regions_have_no_gradient_and_no_nan():
    made = policy(guidance=True)
    _, splits = made(torch.full((3, 7, 7), 500.0))
    (splits**2).sum().backward()
    gradient = made.splits_decoder.weight.grad.unflatten(0, (7, 7, 7))
    assert torch.isfinite(gradient).all()
    assert (gradient[torch.tensor(~NETWORK.split_mask)] == 0.0).all()
    assert gradient.abs().max() > 0.0


def test_a_policy_that_returns_nan_ends_the_run_in_one_line():
    made = policy(guidance=True)
    torch.nn.init.constant_(made.splits_decoder.bias, torch.nan)
    with pytest.raises(
        InputError, match=r"^dpc-pcrg: interval 0: splits\[0, 0, 0\]: expected a finite number"
    ):
        nmfd.run("economic_mpc", DpcController(made), steps=1)


def test_a_batch_is_the_same_as_one_by_one():
    made, x = policy(guidance=True), 1000.0 * torch.rand(5, 7, 7)
    together = made(x)
    for n in range(5):
        for batched, single in zip(together, made(x[n]), strict=True):
            torch.testing.assert_close(batched[n], single, rtol=1e-5, atol=1e-6)


def saved(path, made, network):
    torch.save(checkpoint(made, network, {"seed": 0}), path)
    return path


@pytest.mark.parametrize("guidance", [False, True], ids=["pc", "pcrg"])
def test_a_policy_file_gives_the_policy_back(tmp_path, guidance):
    made = policy(guidance=guidance)
    loaded, content = load_policy(saved(tmp_path / "p.pt", made, NETWORK), NETWORK)
    x = 1000.0 * torch.rand(4, 7, 7)
    for before, after in zip(made(x), loaded(x), strict=True):
        assert (before is None and after is None) or torch.equal(before, after)
    assert torch.equal(content["weights"]["scale"], made.scale)
    assert content["network_hash"] == NETWORK.hash
    assert content["configuration"] == {"seed": 0}


def test_a_policy_for_another_network_is_refused(tmp_path, scenario):
    path = saved(tmp_path / "p.pt", policy(guidance=False), NETWORK)
    line = problem(load_policy, path, scenario.network)
    assert line.startswith(f"{path}: ")
    assert "trained for network 'hexagon7'" in line
    wider = replace(NETWORK, u_max=1.0)
    with pytest.raises(InputError, match="network_hash"):
        load_policy(path, wider)


def test_a_policy_of_the_other_kind_is_refused(tmp_path, scenario):
    path = saved(
        tmp_path / "p.pt", policy(guidance=False, network=scenario.network), scenario.network
    )
    line = problem(load, path, planning_model(scenario), guidance=True)
    assert line.startswith(f"{path}: ")
    assert "dpc-pc policy, not dpc-pcrg" in line


def weights(path):
    return torch.load(path, weights_only=True)["weights"]


def test_another_seed_is_another_policy(tmp_path, train):
    paths = [train(seed=seed, out=tmp_path / f"{seed}.pt", steps=1) for seed in (0, 1)]
    assert not torch.equal(
        weights(paths[0])["backbone.0.weight"], weights(paths[1])["backbone.0.weight"]
    )


def test_training_lowers_the_total_time_spent(train, scenario):
    """An untrained policy holds the perimeter half closed, to no purpose."""
    trained = train(steps=20)
    rollout = training.Rollout(planning_model(scenario))
    torch.manual_seed(0)
    fresh = Policy(scenario.network, Architecture())
    after = training.validate(load_policy(trained, scenario.network)[0], rollout, 0, Dpc())
    assert after < training.validate(fresh, rollout, 0, Dpc())


def test_resume_needs_something_to_resume_and_the_same_settings(train, monkeypatch):
    monkeypatch.setattr(training, "VALIDATION_PERIOD", 1)

    def interrupt(done, steps, note):
        raise KeyboardInterrupt

    with pytest.raises(InputError, match="nothing to resume"):
        train(steps=4, resume=True)
    with pytest.raises(KeyboardInterrupt):
        train(steps=4, progress=interrupt)
    with pytest.raises(InputError, match="seed: was 0, now 1"):
        train(seed=1, steps=4, resume=True)


@pytest.mark.parametrize("content", [{}, {"configuration": 1}, [1.0], b"", b"x"], ids=str)
def test_what_is_no_state_of_a_training_cannot_be_resumed(tmp_path, train, content):
    if isinstance(content, bytes):
        (tmp_path / "p.pt.resume").write_bytes(content)
    else:
        torch.save(content, tmp_path / "p.pt.resume")
    line = problem(train, steps=4, resume=True)
    assert line.startswith(f"{tmp_path / 'p.pt.resume'}: ")
    assert "is no state of a training; train without" in line


def test_a_policy_cannot_be_resumed(tmp_path, train):
    """Nor the state of another architecture, though the settings are the same."""
    trained = torch.load(train(steps=1), weights_only=True)
    for wrong in ({}, {"policy": {}}, {"policy": trained["weights"], "optimizer": {}}):
        torch.save({**trained, **wrong}, tmp_path / "p.pt.resume")
        with pytest.raises(InputError, match="is no state of a training"):
            train(steps=1, resume=True)


@pytest.fixture
def default_dtype():
    yield torch.set_default_dtype
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    "controller, table",
    [
        ("dpc-pc", {"noise": 0.1, "demand_high": 2.0}),
        ("dpc-pcrg", {"prices": True, "metering": True}),
        ("dpc-pcrg", {"compact": True}),
        ("dpc-pcrg", {"preset": "published"}),
        ("dpc-pc", {"from_gating": True}),
    ],
)
def test_torch_s_default_dtype_changes_nothing(
    tmp_path, train, scenario, default_dtype, monkeypatch, controller, table
):
    """float64 is a usual first line of scripts: the same weights, and the same run."""
    monkeypatch.setattr(first_policy, "GATE_STEPS", 3)
    chosen = replace(scenario, controller_options={controller: table})
    files, runs = [], []
    for dtype in (torch.float32, torch.float64):
        default_dtype(dtype)
        out = tmp_path / f"{dtype}.pt"
        files.append(train(controller, on=chosen, out=out, steps=2))
        runs.append(nmfd.run(chosen, controller, policy=out))
    assert files[0].read_bytes() == files[1].read_bytes()
    np.testing.assert_array_equal(runs[0].perimeter, runs[1].perimeter)
    np.testing.assert_array_equal(runs[0].accumulation, runs[1].accumulation)


@pytest.mark.parametrize("controller", ["dpc-pc", "dpc-pcrg"])
def test_every_tensor_of_a_training_step_is_on_the_device(scenario, controller):
    """On the device "meta", which like a GPU refuses tensors of another."""
    guidance = controller == "dpc-pcrg"
    made = Policy(scenario.network, Architecture(width=8, guidance=guidance)).to("meta")
    rollout = training.Rollout(planning_model(scenario), device="meta", detour_cost=1.0)
    generator = torch.Generator().manual_seed(0)
    rollout.draw_model(4, 0.1, generator)
    x, demand = rollout.random_start(4, 0.2, 0.5, generator)
    demand = rollout.perturb(demand, torch.rand(4, generator=generator), 1.0, generator)
    total = rollout.total_time_spent(made, x, demand, generator)
    torch.log(total).mean().backward()
    assert total.device.type == "meta"
    assert all(weights.grad.device.type == "meta" for weights in made.parameters())


def test_the_device_is_the_gpu_where_there_is_one(monkeypatch):
    for there, expected in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert training.available("auto") == expected
        assert training.available("cpu") == "cpu"


@pytest.mark.parametrize(
    "controller, options, expected",
    [
        ("dpc-pc", {"widht": 3}, "widht: unknown key"),
        ("dpc-pc", {"steps": 0}, "steps: should be greater"),
        (
            "dpc-pc",
            {"from_gating": True},
            "from_gating: expected a scenario with protected regions",
        ),
        (
            "dpc-pc",
            {"demand_high": 0.8},
            "demand_low: expected at most demand_high, 0.8, got 1; change one of them",
        ),
        (
            "dpc-pc",
            {"from_gating": True, "from_no_control": True},
            "from_gating: a policy cannot begin as a gate and",
        ),
        ("dpc-pcrg", {"local": True}, "local: a local policy guides no routes; train dpc-pc"),
        ("dpc-pc", {"numbers": [1.0] * 8}, "numbers: expected 8 to 12 numbers >= 0 of a compact"),
        (
            "dpc-pc",
            {"compact": True, "numbers": [-1.0] * 8},
            "numbers: expected 8 to 12 numbers >= 0",
        ),
        ("dpc-pc", {"compact": True, "local": True}, "compact: begins with its numbers"),
        ("dpc-pc", {"kept": ["gain"]}, "kept: expected numbers of a compact policy"),
        (
            "dpc-pc",
            {"local": True, "metering": True},
            "metering: a local policy controls gates only",
        ),
        ("dpc-pc", {"per_region": True}, "per_region: is for a compact policy"),
        ("dpc-pc", {"start": "p.pt", "from_gating": True}, "start: a trained policy begins as"),
        ("dpc-pc", {"prices": True}, "prices: prices guide drivers"),
        (
            "dpc-pcrg",
            {"compact": True, "prices": True},
            "prices: a compact policy has prices anyway",
        ),
    ],
)
def test_wrong_training_settings(scenario, controller, options, expected):
    wrong = replace(scenario, protected=(), controller_options={controller: options})
    with pytest.raises(InputError, match=f"controllers.{controller}.{expected}"):
        training.settings(wrong, parse(controller))


@pytest.mark.parametrize("guidance", [False, True], ids=["pc", "pcrg"])
def test_a_sparse_policy_is_the_dense_one_with_the_same_weights(guidance):
    """Of the dense decoders it holds the rows of adjacent regions; hexagon7 has regions with 3 and
    with 6 of them."""
    dense = policy(guidance=guidance)
    sparse = Policy(NETWORK, Architecture(width=16, guidance=guidance, sparse=True))
    here, onward = np.arange(7)[:, None], sparse.onward.numpy()
    rows = {"perimeter_decoder": (here * 7 + onward).ravel()}
    rows["splits_decoder"] = ((here * 7 + onward)[..., None] * 7 + np.arange(7)).ravel()
    weights = dense.state_dict()
    sparse.load_state_dict(
        {
            key: value[rows[key.split(".")[0]]] if key.split(".")[0] in rows else value
            for key, value in weights.items()
        }
    )
    x = 1000.0 * torch.rand(5, 7, 7)
    for a, b in zip(dense(x), sparse(x), strict=True):
        if a is not None:
            torch.testing.assert_close(a, b)
    both = [
        DpcController(made).act(tiny.seen(x[0].numpy().astype(float))) for made in (dense, sparse)
    ]
    np.testing.assert_allclose(both[0].perimeter, both[1].perimeter, rtol=1e-6)
    if guidance:
        np.testing.assert_allclose(both[0].splits, both[1].splits, atol=1e-7)


def test_a_local_policy_looks_around_every_boundary():
    """From region 2 of hexagon7, in the west, to 0 in the north-west: the numbers by hand; then the
    same network there as everywhere, and in any city."""
    torch.manual_seed(0)
    local = Policy(NETWORK, Architecture(width=8, local=True))
    critical, x = NETWORK.mfds[0].critical, 1000.0 * torch.rand(7, 7)
    full, ending = x.sum(1) / critical, x.diagonal() / critical
    by_hand = torch.stack(
        [full[2], full[[0, 3, 5]].mean(), ending[2], full[0], full[[1, 2, 3]].mean(), ending[0]]
    )
    share = torch.sigmoid(local.perimeter_decoder(local.backbone(by_hand)))
    perimeter, splits = local(x)
    assert splits is None
    assert perimeter[2, 0].item() == pytest.approx(0.1 + 0.8 * share.item(), rel=1e-5)
    assert ((perimeter > 0.0).numpy() == NETWORK.adjacency).all()
    np.testing.assert_allclose(
        DpcController(local).act(tiny.seen(x.numpy().astype(float))).perimeter,
        perimeter.detach(),
        rtol=1e-5,
    )
    torch.testing.assert_close(local(x.expand(3, 2, 7, 7))[0], perimeter.expand(3, 2, 7, 7))
    alike = local(torch.full((7, 7), 300.0))[0]  # the gates of the centre to all sides
    assert alike[3, NETWORK.adjacency[3]].max() == alike[3, NETWORK.adjacency[3]].min()


def test_a_local_policy_drives_another_city(tmp_path):
    """Its weights are as many as in any other."""
    made = Policy(NETWORK, Architecture(width=8, local=True))
    loaded, _ = load_policy(saved(tmp_path / "p.pt", made, NETWORK), load_network("two_regions"))
    assert loaded(torch.full((2, 2), 100.0))[0].shape == (2, 2)


def test_every_rollout_has_a_model_of_its_own(scenario):
    """Around the nominal one, always valid for the integration step; without a spread it is the
    nominal one again."""
    limited = replace(scenario, network=tiny.limited(scenario.network))
    rollout = training.Rollout(planning_model(limited))
    nominal = rollout.parameters
    rollout.draw_model(4000, 0.2, torch.Generator().manual_seed(0))
    p = rollout.parameters
    assert torch.log(p.mfd.jam / nominal.mfd.jam).std().item() == pytest.approx(
        0.2, rel=0.15
    )  # cut at two deviations
    assert torch.log(p.mfd.jam / nominal.mfd.jam).abs().max().item() == pytest.approx(0.4, rel=1e-3)
    assert torch.log(p.capacity / nominal.capacity)[:, 0, 1].std().item() == pytest.approx(
        0.1, rel=0.15
    )
    torch.testing.assert_close(p.storage / nominal.storage, p.mfd.jam / nominal.mfd.jam)
    fastest = (p.mfd.c.unsqueeze(-1) * p.exit_rates).max().item()
    assert fastest * limited.step / limited.substeps <= 1.0 + 1e-6
    x = 0.5 * p.mfd.jam  # the same curve along a stretched axis, and scaled by one factor
    scale = torch.from_numpy(
        np.array([m.rate(0.5 * m.jam) / m.c for m in limited.network.mfds])
    ).float()
    torch.testing.assert_close(
        dynamics.rate(p, x) / p.mfd.c, scale.expand(4000, -1), rtol=1e-4, atol=0.0
    )
    rollout.draw_model(4000, 0.0, torch.Generator().manual_seed(0))
    assert rollout.parameters is nominal
    rollout.draw_model(3, 0.0, torch.Generator().manual_seed(0), scale=0.75)
    torch.testing.assert_close(rollout.parameters.mfd.jam, 0.75 * nominal.mfd.jam.expand(3, -1))
    shorter = dynamics.rate(rollout.parameters, 0.75 * x[:3])
    torch.testing.assert_close(shorter, dynamics.rate(nominal, x[:3]))


def test_a_policy_begins_as_a_gate(scenario):
    """Entries of the protected region close as it fills, about the set point of pi-gating; the
    others stay open."""
    rollout, network = training.Rollout(planning_model(scenario)), scenario.network
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    made = Policy(network, Architecture(width=32, guidance=False))
    first_policy.begin_as_gate(made, rollout, generator)
    x, _ = rollout.random_start(50, 0.0, 1.0, generator)
    x = torch.where(x[:, 1:].sum((1, 2), keepdim=True) > 1.0, x, torch.full_like(x, 50.0))
    shares = []
    for full in (0.7, 1.0, 1.4):
        filled = x.clone()
        filled[:, 1] *= (
            full * api.controller("pi-gating", scenario).set_point[0] / x[:, 1].sum(-1)
        ).unsqueeze(-1)
        with torch.no_grad():
            shares.append((made(filled)[0] - network.u_min) / (network.u_max - network.u_min))
    assert shares[0][:, 0, 1].min() > 0.8
    assert shares[2][:, 0, 1].max() < 0.2
    assert 0.3 < shares[1][:, 0, 1].mean() < 0.7
    assert min(share[:, 1, 0].min() for share in shares) > 0.8


PEAK = replace(tiny.part(load_scenario("grid7_peak"), 20, 12), measurement_std=0.0)


class Gated(torch.nn.Module):
    """Policy with gates and metering that depend on the state; a third of the nominal split ratios
    are exchanged."""

    architecture = SimpleNamespace(metering=True, guidance=True)
    usual, gates = (
        torch.from_numpy(PEAK.network.nominal_splits),
        torch.from_numpy(PEAK.network.adjacency),
    )

    def forward(self, x):
        perimeter = self.gates * (0.2 + 0.5 * torch.exp(-x.sum(-1, keepdim=True) / 50.0))
        return perimeter, self.usual.lerp(self.usual.roll(1, -1), 1.0 / 3.0)

    def metering(self, x):
        return torch.tensor([0.4, 2.0, 0.3, 0.5, 0.6, 0.8, 0.1]) / (1.0 + x.sum(-1) / 99.0)


def test_a_rollout_with_metering_and_detours_is_the_plant():
    """Compare states, backlog, and TTS with detours step by step."""
    network, made, plant = PEAK.network, Gated(), NmfdPlant(PEAK)
    rollout = training.Rollout(planning_model(PEAK), dtype=torch.float64, detour_cost=40.0)
    start, demand = (
        rollout.start.expand(2, 7, 7),
        rollout.demand[:, None] * torch.tensor([1.0, 0.5]).reshape(2, 1, 1),
    )
    exact, seen, waiting = rollout.states(made, start, demand, torch.Generator())
    waiting, state, spent = waiting.sum((-2, -1)), plant.reset(0), 0.0
    assert torch.equal(exact, seen)
    assert waiting[-1, 0] > 2.0 * waiting[-1, 1] > 10.0
    for k in range(PEAK.steps):
        x = state.accumulation
        np.testing.assert_allclose(exact[k, 0], x, rtol=1e-9, atol=1e-9)
        assert waiting[k, 0].item() == pytest.approx(state.backlog.sum())
        perimeter, splits = (part.numpy() for part in made(torch.from_numpy(x)))
        rate = np.array([mfd.rate(n) for mfd, n in zip(network.mfds, x.sum(axis=1), strict=True)])
        off = (
            0.5
            * np.abs(splits - network.nominal_splits).sum(axis=1)
            * rate[:, None]
            * x
            * network.exit_rates
        )
        spent += x.sum() + state.backlog.sum() + 40.0 * off.sum()
        metering = made.metering(torch.from_numpy(x)).numpy()
        state = plant.step(Controls(perimeter=perimeter, splits=splits, metering=metering))
    total = rollout.total_time_spent(made, start, demand, torch.Generator())
    assert total.shape == (2,)
    assert total[0].item() == pytest.approx(PEAK.step * spent)
