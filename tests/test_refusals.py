"""What is malformed is refused by an error that names it, before any computation."""

import re
import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import refusals

import fdof_jax as fj
from fdof_jax.simulation.simulate import check_elements
from fdof_jax.tuning import search
from fdof_jax.tuning.losses import residuals_of

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


def test_what_resists_and_sizes_are_declared_to_be_at_least_zero():
    """The table draws its rows from declarations, and would miss none that goes."""
    for name, (function, _) in CALLABLES.items():
        for field, about in getattr(function, "__dataclass_fields__", {}).items():
            if rules := about.metadata.get("rules"):
                resists = rules["unit"] in refusals.RESISTING.split(", ")
                above = f"{name}.{field}" in refusals.POSITIVE
                least = not above and (resists or field in refusals.SIZES)
                bounds = (rules["above"] == 0, rules["minimum"] == 0)
                assert bounds == (above, least), (name, field)


def test_the_door_checks_what_a_constructor_has_not_seen():
    """Programs, which know no values, ask whether they are possible."""
    check = partial(check_elements, linkage=refusals.ARM, ts=refusals.TS)
    # One program for all of them, of which one is spoilt at a time.
    possible = eqx.filter_jit(lambda parts: jnp.stack([p.possible() for p in parts]))
    sound = refusals.ELEMENTS
    assert possible(sound).all()
    for part, spoilt, words in refusals.past_constructors():
        assert not fault(partial(check, (spoilt,)), words), spoilt
        if "joints" not in words:  # of other numbers of them
            found = possible([spoilt if one is part else one for one in sound])
            assert found.sum() == len(sound) - 1, spoilt


def test_a_program_knows_elements_of_another_chain():
    for words, changes, *_ in refusals.FOREIGN:
        run = lambda q: fj.simulate(refusals.ARM, (q, q), [0, 1], **changes)  # noqa: B023
        assert not fault(partial(jax.eval_shape, run, np.zeros(3)), words), words


@pytest.mark.parametrize("name", [
    pytest.param(n, marks=[pytest.mark.slow] * (n in refusals.SLOW))
    for n in refusals.MORE
])  # fmt: skip
def test_what_no_declaration_tells(name, refuses):
    refuses(name, refusals.MORE[name])


@pytest.mark.parametrize("name", refusals.KNOWN_ALONE)
def test_traced_values_where_known_ones_are_needed(name):
    function, sound = CALLABLES[name]
    assert not fault(
        lambda: eqx.filter_jit(function)(**sound), refusals.KNOWN_ALONE[name]
    )


def test_a_loss_that_is_negative_is_refused(monkeypatch):
    """As its root is not a number, whatever the motion is."""
    loss = lambda scene, motion: -1.0 - motion.q[-1, 0] ** 2

    def evaluated(evaluate, z, *_):
        value = np.sum(residuals_of(loss, refusals.FIG7, refusals.MOTION) ** 2)
        rows = np.full(len(z), value), 0 * z, z[:, None] * z[..., None]
        return search.Evaluation(*rows, {"simulated": np.ones(len(z), bool)})

    monkeypatch.setattr(search, "_evaluate", evaluated)
    call = lambda: fj.tune(refusals.FIG7, loss=loss)
    assert not fault(call, "loss: .*one number that is not negative, with finite deriv")


@pytest.mark.parametrize("kind", [np.float16, ">f8", np.int8, np.uint64])
def test_real_numbers_of_any_type_are_taken(kind):
    ones = np.ones(3).astype(kind)
    arm = refusals.ARM.replace(mass=ones, gravity=ones[0])
    damper, tip = fj.JointDamper(ones), fj.tip_position(arm, ones)
    for found in arm.mass, arm.gravity, damper.coefficient, tip:
        assert found.dtype == float
    assert fj.CircleTask(branch=ones[0]).branch == 1
    fj.inverse_kinematics(refusals.ARM, [-4, 2], 1.6, branch=ones[0])


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


def test_what_cannot_be_loaded(tmp_path):
    path = tmp_path / "tree.json"
    for text, words in refusals.UNREADABLE.items():
        path.write_text(text)
        assert not fault(lambda: fj.load(path), rf"{path}: .*{words}.*\.$"), text
    path.write_bytes(b"\x93NUMPY\xff")
    assert not fault(lambda: fj.load(path), f"{path}: expected JSON, got 'utf-8'")
