"""Files of other programs and versions are read, whatever has moved since."""

import dataclasses
import os
import re
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path

import diffrax
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from saved_trees import OWN, SCENES, Colour, Plain, Push, describe, refused, same

import fdof_jax as fj


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.fdof"


def test_classes_of_a_script(path, monkeypatch):
    push = Push(jnp.ones(3), "own")
    monkeypatch.setattr(Push, "__module__", "__main__")
    fj.save(path, push)
    monkeypatch.undo()
    same(fj.load(path, [Push]), push)
    fj.save(path, push)
    monkeypatch.setattr(Push, "__module__", "__main__")
    same(fj.load(path, [Push]), push)
    monkeypatch.setattr(Push, "__module__", "elsewhere")
    refused(path, "saved_trees:Push", [Push])


READER = """
import sys
import fdof_jax as fj
fj.configure(x64=True)
run, scene = fj.load(sys.argv[1])
fj.save(sys.argv[2], (run, scene))
assert type(run).__module__ == "fdof_jax.tuning.result"
"""


def test_another_process_reads_it(path, tmp_path):
    """The other process imports the library's modules while it reads."""
    from fdof_jax.tuning.result import History

    run = History(*range(len(dataclasses.fields(History))))
    fj.save(path, (run, SCENES["fig7"]))
    other = tmp_path / "other"
    arguments = [sys.executable, "-c", READER, path, other]
    subprocess.run(arguments, check=True, env=os.environ, timeout=120)
    same(fj.load(other), (run, SCENES["fig7"]))
    assert other.read_bytes() == path.read_bytes()


def test_members_that_another_version_counts_differently(path):
    fj.save(path, [Colour.red, Colour.green])

    def swap(description):
        for node in description["tree"]:
            node["members"] = {"red": 1, "green": 0}

    describe(path, swap)
    same(fj.load(path, OWN), [Colour.green, Colour.red])
    describe(path, lambda d: d["tree"][0].update(members={"red": 1, "blue": 0}))
    refused(path, "Colour.*blue", OWN)


OF_0_1 = Path(__file__).parent / "saved_by_0.1.fdof"


def equal(a, b, rtol=0.0):
    """Checks equality apart from JAX's weak types, which constructors may change."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=rtol), a, b)


def test_a_file_of_version_0_1():
    """Such a file names the module of each class; later versions have moved classes."""
    tree = fj.load(OF_0_1, OWN)
    equal(tree["scenes"], SCENES)
    # Springs that act both ways have had no side since 0.2; those saved still have 0.
    two_sided = lambda tree: tree["elements"]["spring"].side
    assert two_sided(tree) == 0
    equal(eqx.tree_at(two_sided, tree, None)["elements"], elements.ALL)
    assert tree["functions"] == [fj.sweep, fj.tuning.tip_errors, fj.simulate]
    assert type(tree["tuned"]) is fj.TuneResult
    assert type(tree["optimal"]) is fj.tuning.OptimalMotion
    assert tree["solution"].outcome == "successful"
    travel = fj.references.Travel(2.0, begin=0.5, profile="trapezoidal")
    spline = fj.references.Spline([[0, 0], [1, 0], [1, 1], [0, 1]], closed=True)
    task = fj.TipTask(spline, travel, orientation=0.1)
    equal(tree["references"][7], task, rtol=1e-15)  # the spline is SciPy's solution


def test_an_object_of_a_removed_class_is_a_dictionary(path):
    fj.save(path, {"job": Plain(3)})
    name = {"class": "fdof_jax.tuning_run:Job"}
    describe(path, lambda d: d["tree"]["items"]["job"].update(name))
    assert fj.load(path) == {"job": {"number": 3}}


def test_fields_that_version_0_1_did_not_save(path):
    """Fits that were saved before there was a verdict are not taken for good ones."""
    array = np.zeros(1)
    found = fj.FitResult({}, {}, (), array, (), 0.0, 0.0, True, "", array)
    fj.save(path, found)
    describe(
        path, lambda d: [d["tree"]["fields"].pop(n) for n in ("held_out", "faults")]
    )
    loaded = fj.load(path)
    same(loaded, found)
    assert loaded.held_out == () and not loaded.usable
    report = fj.tuning.GradientReport(array, array, 0.0, *[array] * 3, None, array, [])
    fj.save(path, report)
    added = "switches", "slowest_crossing", "times"
    describe(path, lambda d: [d["tree"]["fields"].pop(n) for n in added])
    same(fj.load(path), report)
    motion = fj.simulation.SampledMotion(*[array] * 4, diffrax.RESULTS.successful, ())
    fj.save(path, motion)
    describe(path, lambda d: [d["tree"]["fields"].pop(n) for n in ("delay", "q_begin")])
    same(fj.load(path), motion)


def test_files_name_no_module(path):
    """Checks that classes can change module while files stay readable."""
    fj.save(path, fj.load(OF_0_1, OWN))
    with zipfile.ZipFile(path) as archive:
        text = archive.read("description.json").decode()
    names = re.findall(r'"(?:class|name)": "([^"]*)"', text)
    assert {name.partition(":")[0] for name in names} == {
        "diffrax",
        "elements",
        "fdof_jax",
    }
