"""The package as users import it: what the names are, and what their import costs."""

import ast
import functools
import graphlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mutants import MUTANTS

import fdof_jax as fj

# Folders and files that import from public rooms alone, as a user does: see
# test_leaves.py. Each has its leaf, of one or several of them.
ALONE = "mjcf", "pictures", "scenes", "servo", "tuning", "viewer"
LEAVES = {name: name for name in ALONE}
LEAVES |= {"identification": "tuning", "__main__": "scenes"}  # search; figures
FOLDER = Path(fj.__file__).parent
ROOT = Path(__file__).parents[1]


NAMESPACES = [
    fj, fj.analysis, fj.checks, fj.control, fj.data, fj.forces, fj.identification,
    fj.linkage, fj.paper, fj.references, fj.simulation, fj.tuning,
]  # fmt: skip


@pytest.mark.parametrize("package", NAMESPACES, ids=lambda package: package.__name__)
def test_names(package):
    modules = {path.stem for path in Path(package.__file__).parent.glob("*")}
    for name in package.__all__:
        value = getattr(package, name)
        assert value.__name__.endswith(name) if callable(value) else value is not None
        # An imported submodule becomes an attribute, which would hide another one.
        assert name not in modules or inspect.ismodule(value)
    assert set(dir(package)) - {"__version__"} == set(package.__all__)
    starred = {}
    exec(f"from {package.__name__} import *", starred)
    assert set(package.__all__) <= set(starred)
    with pytest.raises(AttributeError, match=f"{package.__name__!r} has no .* 'simul'"):
        package.simul  # noqa: B018


def test_the_top_is_short_and_its_help_names_all():
    assert len(fj.__all__) <= 60
    assert set(dir(fj)) - {"__version__"} <= set(re.findall(r"\w+", fj.__doc__))


def test_a_name_means_one_thing():
    meanings = {}
    for room in NAMESPACES:
        for name in room.__all__:
            meanings.setdefault(name, set()).add(getattr(room, name))
    # The paper has its own, in chain coordinates.
    several = {name for name, values in meanings.items() if len(values) > 1}
    assert several == {"mass_matrix", "bias_force"} < set(fj.paper.__all__)


ROOMS = {
    "base": 0, "linkage": 1, "paper": 2, "mechanics": 2, "forces": 3, "dynamics": 4,
    "references": 4, "control": 5, "steps": 6, "simulation": 7, "batches": 8,
    "analysis": 8, "checks": 10, "data": 10, "drawing": 10, "__init__": 11,
}  # fmt: skip


def leaf_of(place):
    first, *_ = *place.relative_to(FOLDER).parts, ""
    return LEAVES.get(first.removesuffix(".py"))


@functools.cache
def imports(path):
    """Returns the file of each import of the library, and its names, if not itself."""
    found = []
    for line in ast.walk(ast.parse(path.read_text())):
        if isinstance(line, ast.Import):
            assert not any(n.name.startswith("fdof_jax") for n in line.names), path
        elif isinstance(line, ast.ImportFrom):
            module = line.module or ""
            assert not module.startswith("fdof_jax"), path
            if line.level:
                place = path.parents[line.level - 1].joinpath(*module.split("."))
                for name in (name.name for name in line.names):
                    module = place / name
                    alone = module.is_dir() or module.with_suffix(".py").exists()
                    source, names = (module, set()) if alone else (place, {name})
                    inside = source / "__init__.py" if source.is_dir() else ""
                    found.append((Path(inside or f"{source}.py"), names))
    return found


def test_rooms_import_from_those_below_them_only():
    room_of = lambda path: path.relative_to(FOLDER).with_suffix("").parts[0]
    for path in FOLDER.rglob("*.py"):
        room, others = room_of(path), {room_of(file) for file, _ in imports(path)}
        if room not in LEAVES:
            for other in others - {room, *LEAVES}:
                assert ROOMS[other] < ROOMS[room], path
        if re.search("^import diffrax", path.read_text(), re.M):
            assert room in ("steps", "simulation", "batches"), path


def test_no_modules_import_each_other():
    """Not within functions either, nor for their types; rooms show names of leaves."""
    graph = {
        path: {
            file for file, _ in imports(path)
            if file != path and (leaf_of(path) or not leaf_of(file))
        }
        for path in FOLDER.rglob("*.py")
    }  # fmt: skip
    assert sum(map(len, graph.values())) > 500
    graphlib.TopologicalSorter(graph).prepare()  # raises for a circle


IMPORT = """
import sys, warnings
import jax
from jax._src.xla_bridge import backends_are_initialized
before = dict(jax.config.values)
import fdof_jax as fj
print(*sys.modules)
assert not backends_are_initialized() and jax.config.values == before
fj.configure(x64=True)
assert fj.JointDamper(1.0).coefficient.dtype == "float64"
warnings.simplefilter("ignore")
fj.plotting
assert "matplotlib" in sys.modules
"""


def test_the_import_takes_what_simulation_needs_and_starts_and_sets_nothing():
    """JAX starts its devices at the first array, which `configure` must precede."""
    command = [sys.executable, "-W", "error", "-c", IMPORT]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    modules = set(run.stdout.split())
    assert "diffrax" in modules
    # JAX and diffrax import none of these themselves.
    assert not modules & {
        "control", "fdof_jax.viewer", "IPython", "matplotlib", "mujoco", "optax",
        "pandas", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "xarray",
        "zarr",
    }  # fmt: skip


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
    allowed = {"__init__.py", "linkage.py"}
    showing = {path.name for path in FOLDER.rglob("*.py") if "!r}" in path.read_text()}
    assert showing == allowed


def test_each_fault_of_mutants_has_its_place():
    """`python tests/mutants.py` takes an hour: a name that changed shows here."""
    for name, mutant in MUTANTS.items():
        assert (FOLDER / mutant.file).read_text().count(mutant.old) == 1, name
        file, _, test = mutant.check.partition("::")
        found = (
            not test or f"def {test.partition('[')[0]}(" in (ROOT / file).read_text()
        )
        assert found, name
