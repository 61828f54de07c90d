"""Notebooks and gallery, run as a reader would run them: every cell, in an empty folder."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

REPOSITORY = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((REPOSITORY / "docs" / "notebooks").glob("*.ipynb"))
GALLERY = REPOSITORY / "docs" / "gallery.md"
CELL = re.compile(r"^```\{code-cell\} ipython3\n(?::tags: [^\n]*\n)?(.*?)^```", re.DOTALL | re.MULTILINE)
PLOTLY = "application/vnd.plotly.v1+json"
# What is not shown by itself: the page lists the figures of every result that it makes.
LIST_FIGURES = """
from imulab.procedures.result import Result
from imulab.records.calibration import Calibration
for shown in [value for value in globals().values() if isinstance(value, Result | Calibration)]:
    print(*(plot.name for plot in shown.plot()), sep="\\n")
"""


def run(notebook: Any, folder: Path) -> list[Any]:
    """Return the outputs of a notebook, run in `folder`."""
    NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def titles(outputs: list[Any]) -> Iterator[str]:
    """Yield the titles of the figures among outputs."""
    for output in outputs:
        if PLOTLY in output.get("data", {}):
            yield output.data[PLOTLY]["layout"]["title"]["text"]


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[] if path.stem == "first_calibration" else [pytest.mark.slow])
        for path in NOTEBOOKS
    ],
)
def test_a_notebook_runs_and_draws(path, tmp_path):
    outputs = run(nbformat.read(path, as_version=4), tmp_path)
    assert len(list(titles(outputs))) >= 2
    assert not [output for output in outputs if output.get("name") == "stderr"]


def test_the_first_notebook_fits_a_real_recording(real_data, tmp_path, monkeypatch):
    monkeypatch.setenv("IMULAB_DATA", str(real_data))
    notebook = nbformat.read(REPOSITORY / "docs" / "notebooks" / "first_calibration.ipynb", as_version=4)
    notebook.cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    notebook.cells = [notebook.cells[0], notebook.cells[-1]]
    *_, fit, _ = run(notebook, tmp_path)
    assert "After calibration the specific force of 22 attitudes" in fit.data["text/plain"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 20_000
    for cell in notebook.cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


def test_the_five_notebooks_are_in_the_documentation():
    index = (REPOSITORY / "docs" / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 5
    for path in NOTEBOOKS:
        assert f"\nnotebooks/{path.stem}\n" in index


@pytest.mark.slow
def test_the_gallery_has_every_figure_of_every_report(tmp_path):
    cells = [nbformat.v4.new_code_cell(text) for text in CELL.findall(GALLERY.read_text(encoding="utf-8"))]
    listing = nbformat.v4.new_code_cell(LIST_FIGURES)
    shown = set(titles(run(notebook := nbformat.v4.new_notebook(cells=[*cells, listing]), tmp_path)))
    listed = "".join(output.text for output in notebook.cells[-1].outputs if output.name == "stdout")
    figures = set(listed.splitlines())
    assert {"Residual |f| − g of each attitude", "Spectrum around the table rate"} < figures
    assert figures - shown == set()
    for others in ("of each fresh attitude", "samples less their mean", "distribution over the units"):
        assert any(others in title for title in shown)
