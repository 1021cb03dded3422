"""The notebook runs from its first cell to its last, and shows what it says it does."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "examples" / "tutorial.ipynb"


def test_it_runs_and_shows_world_belief_and_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("nbformat", "nbclient", "ipykernel"):
        pytest.importorskip(module, reason=f"notebooks are run by {module}, which is not installed")
    import nbclient
    import nbformat

    paths = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in cells), "outputs are made when it is run, not kept"
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [output for cell in cells for output in cell.outputs if "data" in output]
    pictures = [
        cv2.imdecode(np.frombuffer(base64.b64decode(output.data["image/png"]), np.uint8), cv2.IMREAD_COLOR)
        for output in shown
        if "image/png" in output.data
    ]
    assert len(pictures) == 4, "world, belief, belief later, errors, each once"
    assert pictures[0].shape == (720, 1280, 3)
    page = shown[-1].data["text/html"]
    assert page.count("data:image/png;base64,") == 2 and "coverage" in page
    assert (tmp_path / "out" / "tutorial" / "report.html").is_file()
