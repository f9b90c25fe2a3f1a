"""The notebook runs from top to bottom, with a training of two epochs."""

from __future__ import annotations

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "first_walk.ipynb"
SHORT = {"EPOCHS = 110": "EPOCHS = 2", "NUM_ENVS = 512": "NUM_ENVS = 64"}


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient").NotebookClient
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        for before, after in SHORT.items():
            cell.source = cell.source.replace(before, after)
    client(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ())
    )
    assert "error:" not in printed
    assert "epoch 2/2" in printed
    assert "played 32 episodes" in printed
    assert (tmp_path / "notebook" / "walk.webp").is_file()


def test_it_is_committed_without_outputs() -> None:
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    assert not any(cell.outputs or cell.execution_count for cell in code)
    text = "".join(cell.source for cell in code)
    assert all(text.count(before) == 1 for before in SHORT)
