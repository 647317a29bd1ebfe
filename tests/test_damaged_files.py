"""Files of JSON that are damaged or large, or name other classes."""

import contextlib
import sys
import tracemalloc
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import AT, element, of
from test_files import OWN, Pair, Push, path as path

import fdof_jax as fj


def refused(path, words, classes=OWN):
    """Checks that the error message names the file and the fault."""
    with pytest.raises(ValueError, match=rf"(?s)^{path}: .*{words}.*\.$"):
        fj.load(path, classes)


def test_an_older_file_stays(path):
    fj.save(path, "older")
    before = path.read_bytes()
    with pytest.raises(ValueError, match="^tree: expected"):
        fj.save(path, object())
    assert path.read_bytes() == before and [*path.parent.iterdir()] == [path]


OTHERS = """os.system os:system subprocess.Popen eval object Solution Args
Frozen Values Any Array fdof_jax drawing forces.JointDamper __class__ History.__class__
LoopedDopri8 Unheard jointdamper""".split()


def test_no_other_class_is_made(path):
    pictures = "fdof_jax.pictures.drawing" in sys.modules
    words = f"{AT}: expected a class of fdof_jax, or one of load"
    for name in OTHERS:
        path.write_text(element(name, '{"command": "touch made"}'))
        refused(path, f"{words}.*got '{name}'")
    assert pictures == ("fdof_jax.pictures.drawing" in sys.modules)


def test_classes_of_a_user(path):
    fj.save(path, (Push(1.0, "a"),))
    for classes in ((), (Pair,), (Push, type("Push", (), {}))):
        refused(path, r"tree\[0\]: .*classes=\(MyElement,\).*got 'Push'", classes)
    assert eqx.tree_equal(fj.load(path, [Push]), (Push(1.0, "a"),))
    for value in (Push, "Push", (3,), (Push(1.0, "a"),), None):
        with pytest.raises(ValueError, match="^classes: expected a tuple of classes"):
            fj.load(path, value)


def test_a_file_cut_or_changed_anywhere(path):
    """A change that is no error is another file as a person might have written it."""
    fj.save(path, fj.PDController([1, 2, 3], 0.5, np.inf, fj.CircleTask()))
    content = path.read_bytes()
    cuts = [content[:length] for length in range(len(content) - 1)]
    flips = [content[:i] + bytes([content[i] ^ flip]) + content[i + 1 :]
             for i in range(len(content)) for flip in (0x01, 0x10, 0xFF)]  # fmt: skip
    for case, damaged in enumerate(cuts + flips):
        path.write_bytes(damaged)
        try:
            fj.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert case >= len(cuts)


NUMBERS = ", ".join(["[1.5, 2]"] * 20_000)
LARGE = {
    "lists": "[" + "[]," * 20_000 + "0]",
    "dicts": '["x"' + ',{"dict":{}}' * 9_000 + "]",
    "a long text among numbers": "[" + "1," * 50_000 + f'"{"x" * 100_000}"]',
    "wide letters": '"' + "x" * 200_000 + '\U0001f600"',
    "a rectangle but for its end": f"[{NUMBERS}, 1]",
    "numbers": f"[{NUMBERS}]",
    "spline": f'{{"Spline": {{"points": [{NUMBERS}]}}}}',
    "history": f'{{"EffortHistory": {{"ts": [{NUMBERS}], "tau": [{NUMBERS}]}}}}',
    "names": f'{{"{"x" * 200_000}": {{}}}}',
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_the_memory_is_bounded_by_the_size(name, path):
    path.write_text(of(f'"value": {LARGE[name]}'))
    tracemalloc.start()
    with contextlib.suppress(ValueError):
        fj.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60 * path.stat().st_size + 2e6


def test_other_failures_are_raised_as_they_are(path, monkeypatch):
    fj.save(path, jnp.zeros(4))
    for failure in (RuntimeError("x"), MemoryError("x"), OSError("x")):
        monkeypatch.setattr(jax, "device_put", Mock(side_effect=failure))
        with pytest.raises(type(failure), match="^x$"):
            fj.load(path)
