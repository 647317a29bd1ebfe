"""What is malformed is refused by an error that names it, before any computation."""

import contextlib
import re
import warnings
from functools import partial

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import refusals

import fdof_jax as fj
from fdof_jax.tuning import search

# JAX raises the last one for integers that no array holds.
MEANT = ValueError, TypeError, ImportError, RuntimeError, OSError, OverflowError
TRACED = [
    jax.ShapeDtypeStruct((2, *shape), dtype)
    for shape in ((), (7,), (2, 3, 3), (0,))
    for dtype in (float, bool)
]
CALLABLES = refusals.callables()


def fault(call, words, error=ValueError):
    """Returns what is wrong with the refusal by a call, or None."""
    try:
        with warnings.catch_warnings(action="ignore"):
            call()
    except error as raised:
        said = str(raised)
        short = len(said) < 600 and all(map(str.isprintable, said))
        return None if short and re.match(f"(?s){words}", said) else said[:600]
    except Exception as raised:
        return repr(raised)[:600]
    return "accepted"


@pytest.fixture
def searching(monkeypatch):
    """Lets searches raise, as they take long, and have tests of their own."""

    def begins(*arguments):
        raise RuntimeError("The value is accepted, and a search begins.")

    monkeypatch.setattr(search, "_evaluate", begins)


@pytest.fixture
def refuses(monkeypatch, tmp_path):
    """Returns a function that asserts refusals, none of which may leave anything."""
    monkeypatch.chdir(tmp_path)
    plt.close("all")  # figures of other tests

    def check(name, rows):
        function, sound = CALLABLES[name]
        found = [
            (changes, words, wrong)
            for words, changes, *error in rows
            if (wrong := fault(partial(function, **sound | changes), words, *error))
        ]
        assert not found
        assert not plt.get_fignums() and not [*tmp_path.iterdir()]

    return check


@pytest.mark.parametrize("name", sorted(CALLABLES))
def test_wrong_values(name, refuses, searching):
    rows = (
        (rf"([^:]*\b)?{place}\b[^:]*: expected .+{words}.*, got .+\.$", {place: value})
        for place, value, words in refusals.refused_values(name, *CALLABLES[name])
    )
    refuses(name, rows)


@pytest.mark.parametrize("bound", refusals.BOUNDS)
def test_bounds_are_declared(bound):
    """The table draws its rows from declarations, and would miss none that goes."""
    found = {
        f"{name}.{field}"
        for name, (function, _) in CALLABLES.items()
        for field, about in getattr(function, "__dataclass_fields__", {}).items()
        if about.metadata.get("rules", {}).get(bound) == 0
    }
    assert found == {*refusals.BOUNDS[bound]}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (n in refusals.SLOW))
        for n in refusals.MORE
    ],
)
def test_what_no_declaration_tells(name, refuses):
    refuses(name, refusals.MORE[name])


@pytest.mark.parametrize("name", refusals.KNOWN_ALONE)
def test_traced_values_where_known_ones_are_needed(name):
    function, sound = CALLABLES[name]
    assert not fault(
        lambda: eqx.filter_jit(function)(**sound), refusals.KNOWN_ALONE[name]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CALLABLES))
def test_other_errors_are_meant(name, searching, monkeypatch, tmp_path):
    """Of values that may be right, and of traced ones, as of a batch."""
    monkeypatch.chdir(tmp_path)
    function, sound = CALLABLES[name]

    def call_each(*values):
        for place in (p.name for p in refusals.arguments(function)):
            for value in values:
                with contextlib.suppress(*MEANT), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    function(**sound | {place: value})

    call_each(*refusals.DOUBTFUL)
    # One trace for all values, as a trace takes longer than most calls.
    jax.eval_shape(jax.vmap(call_each), *TRACED)


@pytest.mark.parametrize("kind", [np.float16, np.float32, ">f8", np.int8, np.uint64])
def test_real_numbers_of_any_type_are_taken(kind):
    ones = np.ones(3).astype(kind)
    arm = refusals.ARM.replace(
        mass=ones, gravity=ones[0], com=np.ones((3, 2)).astype(kind)
    )
    for found in (
        arm.mass, arm.gravity, arm.com, fj.JointDamper(ones).coefficient,
        fj.inverse_dynamics(arm, ones, ones, ones), fj.tip_position(arm, ones),
    ):  # fmt: skip
        assert found.dtype == float


@pytest.mark.parametrize("hold", [list, tuple, lambda x: [fj.State(x, x)]])
def test_little_is_formatted(hold):
    formatted = []

    class Noted:
        def __repr__(self):
            formatted.append(self)
            return "Noted"

    many = hold([Noted() for _ in range(100_000)])
    assert not fault(lambda: fj.Wrench(many), "point: expected a Point, got ")
    assert 0 < len(formatted) <= 400


# Files of JSON


def test_what_cannot_be_loaded(tmp_path):
    path = tmp_path / "tree.json"
    for text, words in refusals.UNREADABLE.items():
        path.write_text(text)
        assert not fault(lambda: fj.load(path), rf"{path}: .*{words}.*\.$"), text
    with path.open("wb") as file:
        np.savez(file, q=np.ones(3))
    assert not fault(lambda: fj.load(path), f"{path}: expected JSON, got 'utf-8'")
