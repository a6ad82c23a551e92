"""The reference of the Python interface is built without a warning, and examples in docstrings are
true."""

import ast
import doctest
import importlib
import re
import subprocess
import sys
import textwrap

import pytest
from copies import ROOT

import cosim
import nmfd

SLOW = ("cosim", "cosim.api", "nmfd.rl.env")  # SUMO
FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(
        ".__init__"
    ): file.read_text(encoding="utf-8")
    for folder in ("nmfd", "cosim")
    for file in sorted((ROOT / folder).rglob("*.py"))
}
EXAMPLES = [
    pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name
    for name, text in FILES.items()
    if ">>> " in text
    and name != "nmfd.studies.measured"  # test_measured.py has the tables that it reads
]


@pytest.mark.slow
def test_the_reference_is_built_without_warnings(tmp_path):
    pytest.importorskip("pdoc")
    pytest.importorskip("gymnasium", reason="no extra rl")
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "reference.py"), str(tmp_path)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for package in (nmfd, cosim):
        page = (tmp_path / f"{package.__name__}.html").read_text(encoding="utf-8")
        assert not [name for name in package.__all__ if f'id="{name}"' not in page]
    assert 'id="RegionalEnv"' in (tmp_path / "nmfd" / "rl.html").read_text(encoding="utf-8")
    assert (tmp_path / "index.html").is_file()


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_in_docstrings(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {"nmfd": nmfd, "cosim": cosim}
    if name == "nmfd.rl.env":
        given["gymnasium"] = pytest.importorskip("gymnasium", reason="no extra rl")
    found = doctest.testmod(importlib.import_module(name), extraglobs=given)
    assert found.attempted
    assert not found.failed, "see the output above"
    assert "+SKIP" not in FILES[name]


def test_every_example_in_a_docstring_has_its_prompts():
    """An indented block of calls without >>> would run nowhere."""
    for name, text in FILES.items():
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
        for node in (node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)):
            for block in re.findall(
                r"(?:^    .*\n?)+", ast.get_docstring(node) or "", flags=re.MULTILINE
            ):
                try:
                    inside = [*ast.walk(ast.parse(textwrap.dedent(block)))]
                except SyntaxError:
                    continue
                assert not any(isinstance(each, ast.Call | ast.Import) for each in inside), (
                    name,
                    block,
                )
