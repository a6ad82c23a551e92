"""A policy with its constraint layers as an ONNX graph, checked against torch: for use without Python or torch.

Input `accumulation` (B, R, R) float32 [veh]; outputs `perimeter` (B, R, R) [-] and, with guidance, `splits`
(B, R, R, R) [-], admissible by construction as those of the policy. B is any.
"""

import contextlib
import io
import logging
import warnings
from pathlib import Path

import numpy as np
import torch

from nmfd.controllers.dpc.policy import Policy
from nmfd.controllers.dpc.policy_file import load_policy, read_policy_file
from nmfd.errors import InputError, RunFailed
from nmfd.extras import need
from nmfd.model.planning import PlanningModel, planning_model
from nmfd.model.scenario import read_scenario
from nmfd.runs import shipped
from nmfd.runs.files import atomic
from nmfd.tensors import PerPair, PerTurn

OPSET = 18
TOLERANCE = 1e-5  # [-], of every output against torch: float32, summed in another order
SAMPLES = 64  # states of the check
MODULES = ("onnx", "onnxscript", "onnxruntime")


def export(policy_file: Path, out: Path, scenario_folder: Path | None = None) -> dict[str, float | int | str]:
    """Write the policy in `policy_file` to `out`, and run both on random states.

    scenario_folder: of the scenario that it was trained for, whose network gives the constraints; that of
        `policy_file` if None

    Returns controller, regions, samples and difference, the largest of any output [-]. Raises InputError, also without
    the extra `onnx`, and RunFailed, with nothing written, should the graph compute something else than the policy.
    """
    need("nmfd export", "onnx", *MODULES)
    policy_file = shipped.found(policy_file, shipped.SCENARIO)
    planning, content = _planning(policy_file, scenario_folder)
    policy, _ = load_policy(policy_file, planning.network)
    if policy.architecture.compact:
        raise InputError(
            f"{policy_file}: is a compact policy, whose few numbers need no graph: 'nmfd list policies' shows them, "
            "and nmfd/controllers/dpc/compact.py what they mean; choose a policy that is a network"
        )
    policy.eval()
    with atomic(out) as temporary:
        _write(policy, temporary)
        _describe(temporary, planning, str(content["configuration"].get("controller", "dpc")))
        difference = largest_difference(policy, temporary)
        if not difference <= TOLERANCE:
            raise RunFailed(f"{out}: the graph differs from the policy by {difference:.2g}, more than {TOLERANCE:g}")
    return {
        "controller": content["configuration"].get("controller", "dpc"),
        "regions": policy.regions,
        "samples": SAMPLES,
        "difference": difference,
    }


def _planning(policy_file: Path, folder: Path | None) -> tuple[PlanningModel, dict]:
    """The planning model that the policy was trained on, and the checkpoint."""
    content = read_policy_file(policy_file)
    try:
        name = str(content["configuration"].get("controller", ""))
    except (LookupError, TypeError, AttributeError):
        raise InputError(f"{policy_file}: is not a policy file; train one with 'nmfd train'") from None
    if folder is None and not (policy_file.parent / "scenario.toml").is_file():
        raise InputError(f"{policy_file}: lies in no scenario's folder; say for which it was trained with --scenario")
    return planning_model(read_scenario(policy_file.parent if folder is None else folder), name), content


def _write(policy: Policy, path: Path) -> None:
    """The graph of `policy`, in one file."""
    outputs = ["perimeter", "splits"] if policy.architecture.guidance else ["perimeter"]
    example = torch.rand(2, policy.regions, policy.regions)
    # The exporter talks about its own versions on stdout and in its log: none of it is the user's business.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    talk = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(talk), contextlib.redirect_stderr(talk):
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Outputs(policy),
            (example,),
            path,
            input_names=["accumulation"],
            output_names=outputs,
            dynamo=True,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            opset_version=OPSET,
            external_data=False,
            verbose=False,
        )


class _Outputs(torch.nn.Module):
    """The policy with as many outputs as it has decoders."""

    def __init__(self, policy: Policy):
        super().__init__()
        self.policy = policy

    def forward(self, accumulation: PerPair) -> PerPair | tuple[PerPair, PerTurn]:
        """As of nmfd.controllers.dpc.policy.Policy."""
        perimeter, splits = self.policy(accumulation)
        return perimeter if splits is None else (perimeter, splits)


def _describe(path: Path, planning: PlanningModel, controller: str) -> None:
    """What the graph is for, as ONNX metadata."""
    import onnx

    model = onnx.load(path)
    network = planning.network
    onnx.helper.set_model_props(
        model,
        {
            "controller": controller,
            "network": network.name,
            "network_hash": network.hash,
            "u_min": f"{network.u_min:g}",
            "u_max": f"{network.u_max:g}",
            "control_interval_s": f"{planning.step:g}",
            "units": "accumulation [veh], "
            "[i, j] = in region i bound for j; perimeter [-], [i, h] = u_ih; splits [-], [i, h, j] = theta_ihj",
        },
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def largest_difference(policy: Policy, path: Path) -> float:
    """Between the outputs of `policy` and those of the graph in `path` under ONNX Runtime, over random states [-]."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    random = np.random.default_rng(0)
    scale = policy.scale.numpy()
    # From empty to far beyond critical, and slightly negative as measured ones may be.
    fill = random.uniform(-0.01, 3.0, (SAMPLES, 1, 1)) * random.random((SAMPLES, policy.regions, policy.regions))
    worst = 0.0
    for states in (fill * scale, np.zeros((1, policy.regions, policy.regions))):
        states = states.astype(np.float32)
        with torch.inference_mode():
            expected = [output for output in policy(torch.from_numpy(states)) if output is not None]
        found = session.run(None, {"accumulation": states})
        worst = max(worst, *(float(np.abs(a - b.numpy()).max()) for a, b in zip(found, expected, strict=True)))
    return worst
