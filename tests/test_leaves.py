"""Leaves import the library as a user does, and no more than their names are shown."""

import ast
from pathlib import Path

import pytest
from test_package import FOLDER, LEAVES, NAMESPACES

PUBLIC = {Path(room.__file__): room for room in NAMESPACES}


def imports(path):
    """Yields where each import of the library is from, and the names that are taken.

    For a file or a folder that is taken itself there are no names.
    """
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
                    yield (module, []) if alone else (place, [name])


def leaf_of(place):
    first, *_ = *place.relative_to(FOLDER).parts, ""
    return LEAVES.get(first.removesuffix(".py"))


@pytest.mark.parametrize("leaf", sorted({*LEAVES.values()}))
def test_a_leaf_imports_public_names_alone(leaf):
    files = [path for path in FOLDER.rglob("*.py") if leaf_of(path) == leaf]
    assert files
    for path in files:
        for place, names in imports(path):
            if leaf_of(place) == leaf:
                continue
            file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
            assert file in PUBLIC, (path, file)
            assert {*names} <= {*dir(PUBLIC[file])}, (path, names)


@pytest.mark.parametrize("leaf", sorted({*LEAVES.values()}))
def test_rooms_only_show_names_of_a_leaf(leaf):
    shown = set()
    for path in FOLDER.rglob("*.py"):
        if leaf_of(path) == leaf:
            continue
        for place, names in imports(path):
            if leaf_of(place) == leaf:
                assert path.name == "__init__.py", (path, place)
                assert {*names} <= {*PUBLIC[path].__all__}, (path, names)
                shown.add(place)
    assert shown
