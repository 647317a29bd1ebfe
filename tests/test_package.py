"""The package as users import it: every name is there, and costs nothing until used."""

import importlib
import inspect
import json
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import fdof_jax as fj

FOLDER = Path(fj.__file__).parent


def test_names():
    for name in fj.__all__:
        module = importlib.import_module(f"fdof_jax.{fj._MODULE_OF[name]}")
        expected = module if name == "scenes" else getattr(module, name)
        # Found by the first `getattr`, kept for the second.
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
    """The same names, and arguments in the same places; what is new is optional."""
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


def test_no_name_is_hidden_by_a_module():
    """An imported submodule becomes an attribute of the package."""
    modules = {path.stem for path in FOLDER.glob("*.py")}
    assert modules & set(fj.__all__) == {"scenes"}


def imported(code):
    """The names of all modules that a new process has imported after `code`."""
    command = [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_the_package_imports_no_jax():
    assert not imported("import fdof_jax; fdof_jax.__version__") & {"jax", "numpy"}


def test_simulation_imports_neither_pictures_nor_searches():
    # Whatever JAX and diffrax need: neither imports one of these today.
    modules = imported("import fdof_jax as fj; fj.simulate, fj.sweep, fj.scenes")
    assert "diffrax" in modules
    assert not modules & {"matplotlib", "optax", "scipy"}
