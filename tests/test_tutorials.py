"""The notebooks of scenarios/tutorials run from their first cell to the last, reduced and in any
folder."""

import os
from pathlib import Path

import pytest
from documents import NOTEBOOKS

from nmfd.runs import shipped

MOST = 200_000  # bytes of a notebook with its outputs


def test_all_are_there_and_are_small_and_have_their_outputs():
    assert [file.name[0] for file in NOTEBOOKS] == list("123456")
    nbformat = pytest.importorskip("nbformat")
    for file in NOTEBOOKS:
        assert file.stat().st_size < MOST, file
        notebook = nbformat.read(file, 4)
        nbformat.validate(notebook)
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        counts = [cell.execution_count for cell in cells]
        assert counts == list(range(1, len(cells) + 1)), (
            "run it anew, from the first cell to the last"
        )
        outputs = [output for cell in cells for output in cell.outputs]
        assert any("image/png" in output.get("data", {}) for output in outputs)
        text = "".join(cell.source for cell in notebook.cells) + str(outputs)
        assert not any(output.output_type == "error" for output in outputs)
        assert str(Path.home()) + os.sep not in text


@pytest.mark.slow
@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_it_runs(file, tmp_path, monkeypatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    if "agent" in file.stem:
        pytest.importorskip("gymnasium", reason="no extra rl")
    if "neuromancer" in file.stem:
        pytest.importorskip("neuromancer", reason="no neuromancer")
    monkeypatch.setenv("QUICK", "1")
    monkeypatch.setenv("PYTHONPATH", str(shipped.root()), prepend=os.pathsep)
    folder = tmp_path / "a folder"
    folder.mkdir()
    notebook = nbformat.read(file, 4)
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    printed = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in printed)
    assert not [out for out in printed if out.output_type == "stream" and "Warning" in out.text]
