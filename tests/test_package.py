"""The package as users import it: names exist, and cost nothing until used."""

import ast
import importlib
import inspect
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fdof_jax as fj

FOLDER = Path(fj.__file__).parent
ROOT = Path(__file__).parents[1]


def test_names():
    for name in fj.__all__:
        module = ".".join(filter(None, ["fdof_jax", fj._MODULE_OF[name]]))
        there = {}
        exec(f"from {module} import {name}", there)
        expected = there[name]
        # The first `getattr` finds the name, and keeps it for the second.
        assert getattr(fj, name) is vars(fj)[name] is expected
    assert dir(fj) == sorted([*fj.__all__, "__version__"])
    starred = {}
    exec("from fdof_jax import *", starred)
    assert set(fj.__all__) <= set(starred)
    assert pickle.loads(pickle.dumps(fj.simulate)) is fj.simulate
    with pytest.raises(AttributeError, match="'fdof_jax' has no attribute 'simulat'"):
        getattr(fj, "simulat")  # noqa: B009
    with pytest.raises(ImportError, match="cannot import name 'simulat'"):
        from fdof_jax import simulat  # noqa: F401


OF_0_1 = json.loads((Path(__file__).parent / "names_of_0.1.json").read_text())


@pytest.mark.parametrize("name", OF_0_1)
def test_what_calls_version_0_1_calls_this_one(name):
    """Checks that names and places of arguments are the same; new ones are optional."""
    *module, name_there = name.split(".")
    found = getattr(
        importlib.import_module(".".join(["fdof_jax", *module])), name_there
    )
    if OF_0_1[name] is None:
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
    "checks": 0, "xla": 0, "linkage": 1, "mechanics": 2, "forces": 3, "dynamics": 4,
    "control": 4, "simulation": 5, "analysis": 6, "search": 7, "tuning": 8,
    "identification": 8, "pictures": 9, "data": 9, "scenes": 10, "shell": 11,
    "__main__": 12,
}  # fmt: skip


def test_colours_are_found_beside_the_functions_that_draw():
    assert fj.drawing.SERIES[0] != fj.drawing.BLACK != fj.drawing.GREY


def test_rooms_import_from_those_below_them_only():
    for path in FOLDER.rglob("*.py"):
        module = path.relative_to(FOLDER).with_suffix("").parts
        for line in ast.parse(path.read_text()).body:
            if not isinstance(line, ast.ImportFrom) or not line.level:
                if isinstance(line, ast.Import) and line.names[0].name == "diffrax":
                    assert module[0] in ("simulation", "data"), path
                continue
            above = module[: len(module) - line.level]
            room = (*above, *(line.module or line.names[0].name).split("."))[0]
            if room in ("__version__", "__all__"):  # of the package itself
                continue
            assert room == module[0] or ROOMS[room] < ROOMS[module[0]], path


def test_no_name_is_hidden_by_a_module():
    """An imported submodule becomes an attribute of the package."""
    modules = {path.stem for path in FOLDER.glob("*")}
    assert modules & set(fj.__all__) == {"scenes"}


def imported(code):
    """Returns the names of all modules that a new process has imported after `code`."""
    command = [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_the_package_imports_no_jax():
    assert not imported("import fdof_jax; fdof_jax.__version__") & {"jax", "numpy"}


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
