"""The notebooks have short cells, small files and committed outputs, and they run."""

import os
from pathlib import Path

import pytest
from helpers import programs

FOLDER = Path(__file__).parents[1] / "notebooks"
INSTALL = '%pip install -q -e "..[notebook]"'
LONGEST = 25  # lines of a cell: a screen
LARGEST = 1_000_000  # bytes of a notebook

each_notebook = pytest.mark.parametrize(
    "path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem
)


def read(path):
    # Here, as the import takes seconds in every process that collects tests.
    import nbformat

    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    """Returns all code cells except the one that installs."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return [cell for cell in cells if "install" not in cell.metadata.get("tags", [])]


def unwanted(notebook):
    """Returns text printed to stderr, including warnings, and errors raised."""
    return [
        output.get("text") or output.get("evalue")
        for cell in code_cells(notebook)
        for output in cell.outputs
        if output.output_type == "error" or output.get("name") == "stderr"
    ]


def pictures(notebook):
    """Returns the number of outputs that are more than text."""
    kinds = [
        set(output.get("data", {}))
        for cell in code_cells(notebook)
        for output in cell.outputs
    ]
    return sum(bool(kind & {"image/png", "text/html"}) for kind in kinds)


def test_there_are_notebooks():
    assert list(FOLDER.glob("*.ipynb"))


@each_notebook
def test_cells_are_short_and_begin_with_the_install_line(path):
    notebook = read(path)  # warns if it is not valid
    for cell in notebook.cells:
        assert cell.source.count("\n") < LONGEST, cell.source
    install, *others = (cell for cell in notebook.cells if cell.cell_type == "code")
    assert install.source == INSTALL and install.metadata.tags == ["install"]
    assert others == code_cells(notebook)
    assert "fj.configure(x64=True)" in others[0].source
    assert any("assert " in cell.source for cell in others)


@each_notebook
def test_committed_outputs_are_there_clean_and_small(path):
    assert path.stat().st_size <= LARGEST
    notebook = read(path)
    counts = [cell.execution_count for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1))  # one run from top to bottom
    assert pictures(notebook) >= 1
    assert unwanted(notebook) == []


@each_notebook
def test_the_table_of_notebooks_lists_it(path):
    assert f"({path.name})" in (FOLDER / "README.md").read_text()


@pytest.fixture(scope="module")
def kernel():
    """Returns one kernel for all notebooks, as each would import for seconds."""
    from jupyter_client.manager import KernelManager

    manager = KernelManager()
    manager.start_kernel(cwd=FOLDER, env=os.environ | programs())
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.slow
@each_notebook
def test_it_runs(path, kernel):
    import nbformat
    from nbclient import NotebookClient

    notebook = read(path)
    committed = pictures(notebook)
    # The names of other notebooks are forgotten first.
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    client = NotebookClient(
        notebook,
        km=kernel,
        timeout=600,  # of a cell
        skip_cells_with_tag="install",
    )
    client.execute()
    assert unwanted(notebook) == []
    assert pictures(notebook) == committed
