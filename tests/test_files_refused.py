"""Files of JSON: what cannot be saved or loaded is refused by name and place."""

import contextlib
import dataclasses
import os
import sys
import tracemalloc
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_files import ARM, OWN, SCENE, Pair, Plain, Push, path as path

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

# What cannot be saved


deleted = jnp.ones(3) + 1
deleted.delete()
TS = np.linspace(0, 1, 3)
MOTION = fj.Solution(TS, np.ones((3, 3)), np.ones((3, 3)), {}, None)
ALIKE = type("JointDamper", (eqx.Module,), {})()
WORDS = [
    dataclasses.make_dataclass(name, ["a"], namespace={"__module__": "own"})(1.0)
    for name in ("fdof_jax", "value", "tuple", "dict")
]
NETWORK = eqx.nn.MLP(6, 3, 8, 1, key=jax.random.key(0))
UNSAVED = {
    "lambda": (lambda t, linkage: (t, t), "equinox.Module .* got <function"),
    "function": (fj.simulate, "equinox.Module .* got <function simulate"),
    "method": (Push(1.0, "").__call__, "bound method"),
    "class": (Push, "class .*Push"),
    "object": (object(), "object"),
    "bytes": (b"abc", "b'abc'"),
    "keys": ({1: 2}, r"dicts with text keys, .* got \{1: 2\}"),
    "the text of a number": ("inf", "'inf'"),
    "complex": (np.array([1j]), "real numbers"),
    "objects": (np.array([None]), "real numbers"),
    "texts": (np.array(["a"]), "real numbers"),
    "structured": (np.zeros(2, [("a", "f8")]), "real numbers"),
    "masked": (np.ma.zeros(2), "real numbers.*masked"),
    "empty": (np.zeros((0, 3)), "at least one"),
    "deleted": (deleted, "real numbers"),
    "random key": (jax.random.key(3), "real numbers"),
    "motion": (MOTION, "to_xarray .* got Solution"),
    "class within the library": (LoopedDopri8(), "public class, .*LoopedDopri8"),
    "class of a public name": (ALIKE, "another name, .*JointDamper"),
    **{f"class {type(w).__name__}": (w, "of another name") for w in WORDS},
    "whole": (2**64, "at most 64 bits, got 18446744073709551616"),
    "long": (-(10**5000), "at most 64 bits, got a value of type int"),
    "impossible": (eqx.tree_at(lambda a: a.mass, ARM, -ARM.mass), "mass: .* at least"),
    "network": (NETWORK, "equinox.tree_serialise_leaves .*dtype, key"),
    "batch": (
        jax.tree.map(lambda a: jnp.stack([a, a]), ARM),
        "equinox.tree_serialise_leaves .*; topology: .*2, 6",
    ),
    "without a value": (object.__new__(Plain), "number"),
}  # fmt: skip


def test_what_cannot_be_saved(path):
    fj.save(path, "older")
    before = path.read_bytes()
    for value, words in UNSAVED.values():
        function = callable(value) and not isinstance(value, type)
        holder = fj.PDController(1, 1, 1, value) if function else Pair(1.0, value)
        scene = SCENE._replace(forces=(fj.JointDamper(1.0), holder))
        place = rf"tree\.forces\[1\]\.{'reference' if function else 'right'}"
        with pytest.raises(ValueError, match=rf"(?s)^{place}: expected .*{words}.*\.$"):
            fj.save(path, scene)
        with pytest.raises(ValueError, match=r"^tree\['a'\]\[0\]\['b'\]: expected"):
            fj.save(path, {"a": [{"b": value}]})
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_trees_without_end_and_traced_values_cannot_be_saved(path):
    endless = []
    endless.append(endless)
    with pytest.raises(ValueError, match="^tree: expected .*without end"):
        fj.save(path, endless)
    scene = lambda x: SCENE._replace(forces=(fj.JointDamper(x),))
    place = r"tree\.forces\[0\]\.coefficient"
    with pytest.raises(ValueError, match=rf"^{place}: expected .*outside of jit"):
        jax.jit(lambda x: fj.save(path, scene(x)))(1.0)
    assert not path.exists()


# What cannot be loaded


def refused(path, words, classes=OWN):
    """Checks that the error message names the file and the fault."""
    with pytest.raises(ValueError, match=rf"(?s)^{path}: .*{words}.*\.$"):
        fj.load(path, classes)


def of(text):
    return f'{{"fdof_jax": "0.2", {text}}}'


def element(name, arguments):
    return of(f'"value": ["x", {{"{name}": {arguments}}}]')


AT = r"tree\[1\]"
UNREADABLE = {
    # No JSON, or that of other programs
    "": "expected JSON, got .*line 1",
    "q,qd\n1,2\n": "expected JSON",
    of('"value": 1') + "{}": "expected JSON, got Extra data",
    of('"value": NaN'): 'expected JSON, got NaN, which is no number \\("inf"',
    of('"value": -Infinity'): "expected JSON, got -Infinity",
    of('"value": 1e999'): "expected JSON, got 1e999",
    of(f'"value": {"9" * 5000}'): "expected JSON, got .*4300 digits",
    of('"dict": {"a": 1, "a": 2}'): "name twice in one object, of .*'a', 'a'",
    "[" * 100_000: "expected less nesting",
    '{"a":' * 100_000: "expected less nesting",
    "[]": "version of the library, .* got None",
    '{"asset": {"version": "2.0"}}': "version of the library, .* got None",
    '{"fdof_jax": 0.2, "value": 1}': "version of the library, .* got 0.2",
    '{"fdof_jax": "new", "value": 1}': "version of the library, .* got 'new'",
    '{"fdof_jax": "0.99.1", "Unheard": {}}': "or an older version, got '0.99.1'",
    '{"fdof_jax": "7.0", "value": 1}': "or an older version, got '7.0'",
    # Objects
    '{"fdof_jax": "0.2"}': r"tree: expected an object by its name alone, got \[\]",
    of('"State": {}, "Scene": {}'): r"its name alone, got \['State', 'Scene'\]",
    of('"value": {"value": 1}'): "tree.value: expected named arguments, got 1",
    of('"value": 1, "Scene": {}'): r"its name alone, got \['value', 'Scene'\]",
    of('"tuple": {}'): "tree: expected a class of .*got 'tuple'",
    of('"batch": [1]'): "tree.batch: expected named arguments, got .*1",
    element("JointDamper", "[1]"): rf"{AT}.JointDamper: expected named .* got \[1\]",
    element("JointDamper", "{}"): f"{AT}: expected the arguments .*'coefficient'",
    element("JointDamper", '{"gain": 1}'): f"{AT}: expected the arguments .*'gain'",
    element("State", '{"q": [1]}'): f"{AT}: expected the arguments of State.*'qd'",
    element("JointDamper", '{"coefficient": -1}'): f"{AT}.coefficient: .*at least 0",
    element("JointDamper", '{"coefficient": "nan"}'): f"{AT}.coefficient: .*got nan",
    element("JointDamper", '{"coefficient": "1"}'): f"{AT}.coefficient: .*got '1'",
    element("JointDamper", '{"coefficient": true}'): f"{AT}.coefficient: .*got True",
    element("JointDamper", '{"coefficient": null}'): f"{AT}.coefficient: .*got None",
    element("JointStops", '{"lower": 1, "upper": 0}'): f"{AT}.lower: .*less than upper",
    element("PDController", '{"kp": 1, "kd": 1, "limit": 1, "reference": 3}'): (
        f"{AT}.reference: expected a callable"
    ),
    element("Wrench", '{"point": {"Point": {"link": 9}}}'): f"{AT}.point.link: .*got 9",
    element("SpringDamper", '{"a": 1, "b": 2}'): f"{AT}.a: expected a Point",
    element("Travel", '{"duration": 1, "profile": "os"}'): f"{AT}.profile: .*got 'os'",
    element("PrescribedMotion", '{"joints": [1.5], "reference": 3}'): f"{AT}.joints: ",
    element("Element", "{}"): f"{AT}: expected the arguments .*abstract",
    # Arrays
    of('"value": [1, [2]]'): "tree: expected numbers in lists of one length",
    of('"value": [[1, 2], [3]]'): "tree: expected numbers in lists of one length",
    of('"value": [1, "x"]'): r"tree: expected numbers .*got \[1, 'x'\]",
    of('"value": [1, null]'): r"tree: expected numbers .*got \[1, None\]",
    of(f'"value": [1, {2**70}]'): "tree: expected numbers .* 64 bits",
    of(f'"value": [{2**63}, -1]'): "tree: expected numbers .* 64 bits",
    of(f'"value": [{2**63}, 0.5]'): "tree: expected numbers .* 64 bits",
    of('"value": ["x", [1, {"Scene": {}}]]'): rf"{AT}: expected numbers",
    of(f'"value": {"[" * 99}1{"]" * 99}'): "tree: expected numbers",
}


def test_what_cannot_be_loaded(path):
    for text, words in UNREADABLE.items():
        path.write_text(text)
        refused(path, words)
    with path.open("wb") as file:
        np.savez(file, q=np.ones(3))
    refused(path, "expected JSON, got 'utf-8'")


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
