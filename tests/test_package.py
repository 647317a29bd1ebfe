"""The package as users import it: names exist, and cost nothing until used."""

import ast
import importlib
import inspect
import json
import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import fdof_jax as fj

FOLDER = Path(fj.__file__).parent
ROOT = Path(__file__).parents[1]


NAMESPACES = [
    fj, fj.analysis, fj.control, fj.data, fj.forces, fj.identification, fj.references,
    fj.tuning,
]  # fmt: skip


@pytest.mark.parametrize("package", NAMESPACES, ids=lambda package: package.__name__)
def test_names(package):
    for name in package.__all__:
        # The first `getattr` finds the name, and keeps it for the second.
        value = getattr(package, name)
        assert value is vars(package)[name]
        assert value.__name__.endswith(name) if callable(value) else value is not None
    assert set(dir(package)) - {"__version__"} == set(package.__all__)
    starred = {}
    exec(f"from {package.__name__} import *", starred)
    assert set(package.__all__) <= set(starred)
    with pytest.raises(
        AttributeError, match=f"{package.__name__!r} has no .* 'simulat'"
    ):
        getattr(package, "simulat")  # noqa: B009


def test_the_top_is_short():
    assert len(dir(fj)) <= 70


def test_help_names_all_that_is_at_the_top():
    named = re.findall(r"\w+", fj.__doc__)
    assert set(dir(fj)) - {"__version__"} <= set(named)


def test_a_name_means_one_thing():
    for room in NAMESPACES[1:]:
        for name in room.__all__:
            for other in NAMESPACES:
                if name in other.__all__:
                    assert getattr(room, name) is getattr(other, name)


def test_pickles_and_import_errors():
    assert pickle.loads(pickle.dumps(fj.simulate)) is fj.simulate
    with pytest.raises(ImportError, match="cannot import name 'simulat'"):
        from fdof_jax import simulat  # noqa: F401


OF_0_1 = json.loads((Path(__file__).parent / "names_of_0.1.json").read_text())

# Both orders of arguments work: see test_tables.py and test_linearization.py.
OTHER_ORDER = "to_pandas", "to_xarray", "linearize", "equilibrium"


@pytest.mark.parametrize("name", OF_0_1)
def test_what_calls_version_0_1_calls_this_one(name):
    """Checks that names and places of arguments are the same; new ones are optional."""
    *module, name_there = name.split(".")
    there = importlib.import_module(".".join(["fdof_jax", *module]))
    with warnings.catch_warnings(record=True, action="always") as warned:
        found = getattr(there, name_there)
    now_in = [room.__name__ for room in NAMESPACES[1:] if name in room.__all__]
    moved = not module and name not in fj.__all__
    message = f"fdof_jax.{name} is now {now_in[0]}.{name}" if moved else None
    assert [str(w.message) for w in warned] == [message] * moved
    assert all(w.filename == __file__ for w in warned)
    if OF_0_1[name] is None or name in OTHER_ORDER:
        return
    before = [word for word in OF_0_1[name].split(", ") if word not in ("", "*")]
    keyword_only = OF_0_1[name].partition("*, ")[2].split(", ")
    now = inspect.signature(found).parameters
    for place, word in enumerate(before):
        parameter = now[word.strip("*=")]
        if word.endswith("="):
            assert parameter.default is not inspect.Parameter.empty, word
        if word not in keyword_only and not word.startswith("**"):
            assert list(now).index(parameter.name) == place
            assert parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD, word
    for parameter in list(now.values())[len(before) :]:
        assert parameter.default is not inspect.Parameter.empty, parameter


ROOMS = {
    "base": 0, "linkage": 1, "mechanics": 2, "forces": 3, "dynamics": 4,
    "references": 4, "control": 5, "steps": 6, "simulation": 7, "batches": 8,
    "analysis": 8, "search": 9, "tuning": 10, "identification": 10, "pictures": 11,
    "data": 11, "scenes": 12, "shell": 13, "__main__": 14, "__init__": 14,
}  # fmt: skip


def test_colours_are_found_beside_the_functions_that_draw():
    assert fj.drawing.SERIES[0] != fj.drawing.BLACK != fj.drawing.GREY


def test_rooms_import_from_those_below_them_only():
    for path in FOLDER.rglob("*.py"):
        module = path.relative_to(FOLDER).with_suffix("").parts
        for line in ast.parse(path.read_text()).body:
            if not isinstance(line, ast.ImportFrom) or not line.level:
                if isinstance(line, ast.Import) and line.names[0].name == "diffrax":
                    assert module[0] in ("steps", "simulation", "batches"), path
                continue
            above = module[: len(module) - line.level]
            room = (*above, *(line.module or line.names[0].name).split("."))[0]
            if room in ("__version__", "__all__"):  # of the package itself
                continue
            assert room == module[0] or ROOMS[room] < ROOMS[module[0]], path


def test_no_name_is_hidden_by_a_module():
    """An imported submodule becomes an attribute of the package."""
    for package in NAMESPACES:
        folder = Path(package.__file__).parent
        for name in {path.stem for path in folder.glob("*")} & set(package.__all__):
            assert inspect.ismodule(getattr(package, name))


def imported(code):
    """Returns the names of all modules that a new process has imported after `code`."""
    command = [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_the_package_imports_no_jax():
    assert not imported("import fdof_jax; fdof_jax.__version__") & {"jax", "numpy"}


def test_an_element_imports_neither_other_elements_nor_simulation():
    modules = imported("import fdof_jax as fj; fj.forces.Tension")
    assert "fdof_jax.forces.between_points" in modules
    assert not modules & {"fdof_jax.forces.actuators", "diffrax"}


def test_simulation_imports_neither_pictures_nor_searches():
    # JAX and diffrax import none of these themselves.
    modules = imported("import fdof_jax as fj; fj.simulate, fj.sweep, fj.scenes")
    assert "diffrax" in modules
    assert not modules & {"matplotlib", "optax", "scipy"}


def test_versions_agree_wherever_they_are_written():
    assert f"\nversion: {fj.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    ruff = re.search(r"ruff-pre-commit\s+rev: v(\S+)", hooks)[1]
    basedpyright = re.search(r"basedpyright==([\d.]+)", hooks)[1]
    assert f'"ruff=={ruff}"' in project
    assert f'"basedpyright=={basedpyright}"' in project


def test_messages_show_values_through_one_function():
    """It keeps them short and free of control codes."""
    allowed = {"__main__.py", "names.py", "linkage.py", "optimal_motion.py"}
    showing = {path.name for path in FOLDER.rglob("*.py") if "!r}" in path.read_text()}
    assert showing == allowed
