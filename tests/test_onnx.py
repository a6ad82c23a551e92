"""nmfd export: the graph computes what the policy computes, for any batch, and keeps the constraints."""

from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from commands import nmfd

from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint, load_policy
from nmfd.model.regional_model import load_network

ROOT = Path(__file__).parents[1]
# A check of shapes makes the batch of the graph a constant.
pytestmark = pytest.mark.usefixtures("onnxruntime", "unchecked")


@pytest.fixture(scope="module")
def onnxruntime():
    """Imported for these tests only, by the process that runs them: it brings sympy, and takes a second."""
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    return pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")


def test_a_committed_policy(tmp_path, onnxruntime):
    file, out = ROOT / "scenarios" / "economic_mpc" / "dpc-pcrg.pt", tmp_path / "policy.onnx"
    done = nmfd("export", file, "--out", out)
    assert done.exit_code == 0, done.output
    assert done.stdout.count("\n") == 2 and list(tmp_path.iterdir()) == [out]
    network = load_network(ROOT / "networks" / "hexagon7")
    policy, _ = load_policy(file, network)
    session = onnxruntime.InferenceSession(str(out))
    x = (3000.0 * np.random.default_rng(1).random((5, 7, 7))).astype(np.float32)
    perimeter, splits = session.run(["perimeter", "splits"], {"accumulation": x})
    with torch.inference_mode():
        expected = policy(torch.from_numpy(x))
    np.testing.assert_allclose(perimeter, expected[0].numpy(), atol=1e-5)
    np.testing.assert_allclose(splits, expected[1].numpy(), atol=1e-5)
    inside = perimeter[:, network.adjacency]
    assert inside.min() >= network.u_min - 1e-6 and inside.max() <= network.u_max + 1e-6
    assert (perimeter[:, ~network.adjacency] == 0).all() and (splits[:, ~network.split_mask] == 0).all()
    np.testing.assert_allclose(splits.sum(axis=2)[:, network.split_mask.any(axis=1)], 1.0, atol=1e-5)
    assert session.get_modelmeta().custom_metadata_map["network_hash"] == network.hash


@pytest.mark.parametrize(
    "architecture",
    [Architecture(width=8, activation="soft-exponential"), Architecture(width=8, guidance=True, sparse=True)],
)
def test_other_architectures_and_a_policy_elsewhere(tmp_path, architecture):
    scenario = load_scenario(tiny.write(tmp_path, network=tiny.row_network(3)))
    torch.manual_seed(0)
    policy = Policy(scenario.network, architecture)
    with torch.no_grad():
        for weights in policy.parameters():
            weights.add_(0.1 * torch.randn_like(weights))
    torch.save(checkpoint(policy, scenario.network, {}), tmp_path / "mine.pt")
    refused = nmfd("export", tmp_path / "mine.pt", "--out", tmp_path / "mine.onnx")
    assert refused.exit_code == 2 and "--scenario" in refused.stderr
    done = nmfd("export", tmp_path / "mine.pt", "--out", tmp_path / "mine.onnx", "--scenario", scenario.folder)
    assert done.exit_code == 0, done.output + str(done.exception)


def test_mistakes(tmp_path):
    scenario = tiny.write(tmp_path)
    for policy, expected in ((tmp_path / "no.pt", "no such policy"), (scenario / "scenario.toml", "is not a policy")):
        done = nmfd("export", policy, "--out", tmp_path / "x.onnx", "--scenario", scenario)
        assert done.exit_code == 2 and expected in done.stderr and done.stderr.count("\n") == 1
    policy = ROOT / "scenarios" / "economic_mpc" / "dpc-pc.pt"
    done = nmfd("export", policy, "--out", tmp_path / "x.onnx", "--scenario", scenario)
    assert done.exit_code == 2 and "network_hash" in done.stderr and not (tmp_path / "x.onnx").exists()
