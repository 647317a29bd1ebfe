"""Leaves import the library as a user does, and no more than their names are shown."""

import ast
import functools
from pathlib import Path

import pytest
from test_package import FOLDER, LEAVES, NAMESPACES

PUBLIC = {Path(room.__file__): {*dir(room)} for room in NAMESPACES}


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
                shown.add(file)
    assert taken and shown
