"""Leaves import the library as a user does, and no more than their names are shown."""

import ast
import functools
from pathlib import Path

import pytest
from test_package import FOLDER, LEAVES, NAMESPACES

PUBLIC = {Path(room.__file__): {*room.__all__} for room in NAMESPACES}


def leaf_of(place):
    return LEAVES.get((*place.relative_to(FOLDER).parts, "")[0])


@functools.cache
def imports(path):
    """Returns the file of each import of the library, and its names."""
    found = []
    for line in ast.walk(ast.parse(path.read_text())):
        if isinstance(line, ast.Import):
            assert not any(n.name.startswith("fdof_jax") for n in line.names), path
        elif isinstance(line, ast.ImportFrom):
            module = line.module or ""
            assert not module.startswith("fdof_jax"), path
            if line.level:
                place = path.parents[line.level - 1].joinpath(*module.split("."))
                file = place / "__init__.py" if place.is_dir() else f"{place}.py"
                found.append((Path(file), {name.name for name in line.names}))
    return found


@pytest.mark.parametrize("leaf", sorted({*LEAVES.values()}))
def test_a_leaf_imports_public_names_and_rooms_only_show_its_own(leaf):
    taken, shown = set(), set()
    for path in FOLDER.rglob("*.py"):
        within = leaf_of(path) == leaf
        for file, names in imports(path):
            if within == (leaf_of(file) == leaf):
                continue
            if within:
                assert names <= PUBLIC[file], (path, file)
                taken |= names
            else:
                assert path.name == "__init__.py" and names <= PUBLIC[path], path
                shown |= names
    assert taken and shown
