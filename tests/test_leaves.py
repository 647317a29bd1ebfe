"""Leaves import the library as a user does, and no more than their names are shown."""

from pathlib import Path

import pytest
from test_package import FOLDER, LEAVES, NAMESPACES, imports, leaf_of

PUBLIC = {Path(room.__file__): {*dir(room)} for room in NAMESPACES}


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
