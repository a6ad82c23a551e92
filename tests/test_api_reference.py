"""The reference of the Python interface is built without a warning, and examples in docstrings are true."""

import doctest
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import cosim
import nmfd

ROOT = Path(__file__).parents[1]
MODULES = (  # in which public names are defined
    "nmfd.api",
    "nmfd.metrics",
    "nmfd.types",
    "nmfd.model.mfd",
    "nmfd.model.plant",
    "nmfd.model.regional_model",
    "cosim.plant.settings",
    "nmfd.controllers.strategy",
    pytest.param("cosim.api", marks=pytest.mark.slow),
)  # starts SUMO


@pytest.mark.slow
def test_the_reference_is_built_without_warnings(tmp_path):
    pytest.importorskip("pdoc")
    pytest.importorskip("gymnasium", reason="no extra rl")
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "reference.py"), str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for package in (nmfd, cosim):
        page = (tmp_path / f"{package.__name__}.html").read_text(encoding="utf-8")
        assert not [name for name in package.__all__ if f'id="{name}"' not in page]
    assert 'id="RegionalEnv"' in (tmp_path / "nmfd" / "rl.html").read_text(encoding="utf-8")
    assert (tmp_path / "cosim" / "plant" / "env.html").is_file() and (tmp_path / "index.html").is_file()


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(
        importlib.import_module(name),
        extraglobs={"nmfd": nmfd, "cosim": cosim},
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE,
    )
    assert found.attempted and not found.failed, "see the output above"
    assert os.listdir(tmp_path) == []  # an example that writes cleans up
