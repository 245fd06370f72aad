"""The notebook of the manual: committed without outputs, and runs from top to bottom."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

BOOK = Path(__file__).resolve().parents[1] / "docs" / "examples" / "recon.ipynb"


def cells() -> list[dict]:
    found = json.loads(BOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


def test_it_is_stripped_of_outputs_and_begins_with_the_installation() -> None:
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells())
    assert "%pip install -q ../.." in "".join(cells()[0]["source"])


@pytest.mark.slow
def test_it_runs_from_top_to_bottom(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbclient comes with the extra `dev`")
    from nbclient import NotebookClient

    book = nbformat.read(BOOK, as_version=4)
    NotebookClient(book, timeout=600, kernel_name="python3", resources={
        "metadata": {"path": str(tmp_path)}}).execute()
    said = "".join(
        output.get("text", "") for cell in book.cells if cell.cell_type == "code"
        for output in cell.outputs if output.output_type == "stream" and output.name == "stdout")
    assert "16 frames" in said
    assert "pruned: " in said
    first, last = (float(said.split("error ")[1].split(word)[0].split()[-1])
                   for word in (" at first", " at the end"))
    assert last < first
    pictures = [output for cell in book.cells if cell.cell_type == "code"
                for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    assert not [output for cell in book.cells if cell.cell_type == "code"
                for output in cell.outputs if output.get("name") == "stderr"]
    assert (tmp_path / "room" / "export" / "splats.html").is_file()
