"""The packages as libraries: the Python of the READMEs, lazy imports, help, and agreement with the
command line."""

import json
import pkgutil
import pydoc
import re
import subprocess
import sys
from importlib import resources

import numpy as np
import pytest
import tiny
from commands import good
from commands import nmfd as command
from documents import ROOT, kind, read

import cosim
import nmfd
from nmfd.studies.benchmark import summary_table


@pytest.mark.parametrize("package", ["nmfd", pytest.param("cosim", marks=pytest.mark.slow)])
def test_the_python_of_the_readmes(package, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    blocks = [
        block for block in read(ROOT / package / "README.md").blocks if kind(block) == "python"
    ]
    for block in blocks:
        short = block.replace("seed=1)", "seed=1, steps=3)")
        exec(short.replace("seeds=10)", "seeds=1, steps=2)"), {})
    assert blocks


@pytest.mark.parametrize("package", [nmfd, cosim], ids=str)
def test_no_public_name_is_that_of_a_module(package):
    # Python would put the module in its place as soon as something imports it.
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    assert "api" in modules
    assert modules.isdisjoint(package.__all__)


def test_importing_the_packages_imports_nothing_heavy():
    code = (
        "import sys, json, nmfd, cosim; nmfd.__all__, cosim.__all__; print(json.dumps([m for m in "
        "('torch', 'numpy', 'pandas', 'libsumo', 'casadi', 'matplotlib') if m in sys.modules]))"
    )
    assert json.loads(subprocess.check_output([sys.executable, "-c", code], text=True)) == []


@pytest.mark.parametrize(
    ("modules", "tables"),
    [
        ("nmfd.api, cosim.api", ()),
        ("cosim.evaluation.simulate, cosim.plant.guidance", ("pandas", "xarray")),
    ],
)
def test_runs_without_policies_load_neither_torch_nor_figures(modules, tables):
    heavy = ("torch", "casadi", "matplotlib", "bokeh", "optuna", "sklearn", "distributed", *tables)
    code = f"import sys, {modules}; print(*(name for name in {heavy} if name in sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "\n"


@pytest.mark.parametrize("package", [nmfd, cosim])
def test_every_public_name_is_there_with_help_and_types(package):
    for name in package.__all__:
        thing = getattr(package, name)
        assert len(pydoc.getdoc(thing)) > 25, name
        assert name in dir(package)
    assert resources.files(package).joinpath("py.typed").is_file()
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_run_and_benchmark_agree_with_the_command_line(tmp_path):
    folder, out = tiny.write(tmp_path), tmp_path / "out"
    said = good(command("benchmark", folder, "--controllers pi-gating --seeds 2 --out", out))
    trajectory = nmfd.run(folder, "pi-gating", seed=1)
    assert trajectory.without_times().identical(
        nmfd.Result.read(out / "pi-gating-1.nc").without_times()
    )
    rows = nmfd.benchmark(folder, ["pi-gating"], seeds=2, out=out)
    assert len(rows) == 2
    assert summary_table(rows) in said


HALF = tiny.Acting(
    lambda seen: nmfd.Controls(perimeter=np.full(seen.accumulation.shape, 0.5)), "half"
)


@pytest.mark.slow
def test_figures_are_drawn_again_if_a_run_is_new(tmp_path, out):
    scenario = tiny.write(tmp_path)

    def drawn(*controllers):
        nmfd.benchmark(scenario, controllers, steps=2, out=out)
        return (out / "region_accumulation.png").stat().st_mtime_ns

    first = drawn("no-control")
    assert drawn("no-control") == first
    assert drawn("no-control", "greedy") > first


@pytest.mark.parametrize(
    "arguments, options, expected",
    [
        (("nobody",), {}, "controller 'nobody' is unknown"),
        (
            ("pi-gating",),
            {"plant": "sumo"},
            "plant 'sumo' is unknown; choose from nmfd, acyclic, links",
        ),
        (("pi-gating",), {"plant": HALF}, "plant: Acting has no step"),
        (("pi-gating",), {"steps": 0}, "steps: expected 1 to 20 control intervals, got 0"),
        (("pi-gating",), {"steps": 21}, "got 21 instead; for more, change steps in"),
        ((HALF,), {"policy": "x.pt"}, "x.pt: controller half reads no policy"),
        ((3,), {}, "with reset and act, got 3"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_mistakes_are_input_errors(tmp_path, arguments, options, expected):
    with pytest.raises(nmfd.InputError, match=re.escape(expected)):
        nmfd.run(tiny.write(tmp_path), *arguments, **options)
