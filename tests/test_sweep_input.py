"""Malformed arguments of a sweep raise errors that name them."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep_batch import SETTINGS, TS, members

import fdof_jax as fj
from fdof_jax.batches import chunks

ONE, STATE = jax.tree.map(lambda a: a[0], members()[:2])
TWO, STATES, FORCES = jax.tree.map(lambda a: a[:2], members())
Q, QD = STATES
THREE = fj.State(np.zeros((3, 3)), np.zeros(3))
EMPTY = jax.tree.map(lambda a: a[:0], (TWO, STATES))


class Rows(fj.Element):
    rows: jax.Array

    def __call__(self, t, q, qd, linkage):
        return -qd / len(self.rows)


@dataclasses.dataclass
class Unhashable:
    def __call__(self, *arguments):
        return arguments[0]


def of(name):
    """Returns the linkages with one more axis of a field."""
    place = lambda linkage: getattr(linkage, name)
    return eqx.tree_at(place, TWO, place(TWO)[None, None])


def efforts(tau):
    return dict(forces=(lambda t, q, qd, linkage: tau,))


INPUTS = "linkage, state0, forces"
# Names in messages, and the arguments that are refused.
REFUSALS = [
    (INPUTS, dict(linkage=ONE, state0=STATE, forces=())),
    # Forces without a leading axis are shared.
    (INPUTS, dict(linkage=ONE, state0=STATE, forces_axes=None)),
    (INPUTS, dict(linkage=EMPTY[0], state0=EMPTY[1], forces=())),
    (INPUTS, dict(state0=THREE, forces=())),
    (INPUTS, dict(linkage=ONE, state0=THREE)),
    (INPUTS, dict(linkage=ONE, state0=(THREE.q, np.zeros((2, 3))), forces=())),
    *((rf"linkage\.{n}", dict(linkage=of(n))) for n in ("ef", "com", "mass")),
    (r"linkage\.gravity", dict(linkage=of("gravity"))),
    ("linkage", dict(linkage="RRR")),
    *(
        (rf"state0\.{name}", dict(state0=STATES._replace(**{name: value})))
        for name in ("q", "qd")
        for value in (1.0, np.zeros(2), np.zeros((1, 2, 3)), "one", [None] * 3)
    ),
    *(
        (r"state0\.q", dict(state0=(np.ones((2, 3), kind), QD)))
        for kind in (bool, complex)
    ),
    *(
        ("state0", dict(state0=state0))
        for state0 in (None, 3, [Q], (Q,) * 3, ([[0], [0, 1]], QD))
    ),
    ("state0", dict(state0=(np.ma.masked_less(Q, 0), QD))),
    *(
        ("ts", dict(ts=ts))
        for ts in ([], 0.5, [[0, 1]], [1, 0], [0, 0], [0, np.nan], None, "1")
    ),
    *(("forces", dict(forces=f)) for f in (None, fj.JointDamper(1.0), (3.0,))),
    ("forces", dict(forces=(Unhashable(),))),
    *((r"forces\[0\]", efforts(tau)) for tau in (np.zeros(2), np.zeros(3) * 1j, None)),
    *(
        ("forces_axes", dict(forces_axes=axes))
        for axes in (1, -1, True, "0", (0, 0), [0], (1,))
    ),
    *(
        ("reduce", dict(reduce=reduce))
        for reduce in (
            3,
            "q",
            fj.Solution,
            Unhashable(),
            lambda motion: motion.q,
            lambda scene, motion: (1.0, "q"),
        )  # fmt: skip
    ),
    *(
        (name, {name: value})
        for name, values in {
            "chunk": [0, -1, 1.5, True, "8"],
            "throw": [1, None, "no"],
            "progress_meter": [None, 3],
            "store": [3, True, ""],
            "shard": [-1, 1, 0.5, None],
            "of": [0, 1.5, True, None],
            "stepsize_controller": ["PID", 1e-6],
            "max_steps": [0, -1, 1.5, "1"],
            "dt0": [jnp.array(-1), 0.0, np.ma.masked_array([1.0, 2.0], [0, 1])],
            "solver": ["dopri", np.array("")],
        }.items()
        for value in values
    ),
    # Options that contradict each other
    ("store", dict(shard=1, of=2)),
    ("shard", dict(shard=2, of=2, store="folder")),
]


@pytest.mark.slow
@pytest.mark.parametrize("name", dict(REFUSALS))
def test_malformed_arguments_are_refused(name):
    sound = dict(linkage=TWO, state0=STATES, ts=TS, forces=FORCES, forces_axes=0)
    for _, changes in (row for row in REFUSALS if row[0] == name):
        with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .+, got .+\.$"):
            fj.sweep(**(sound | SETTINGS | changes))


def test_messages_say_what_to_do():
    three = (fj.JointDamper([1.0, 2.0, 3.0]),)  # one for all, not one per member
    dampers = (jax.vmap(fj.JointDamper)(np.ones(4)),)
    many = (fj.JointDamper(np.ones(200)),)
    rows = (Rows(np.ones(2)),)  # a member's is one number
    of_two = TWO, STATES, TS
    for arguments, axes, error, words in (
        (
            (ONE, STATE, TS, dampers),
            None,
            ValueError,
            r"none on any \(pass forces_axes",
        ),
        ((*of_two, many), None, ValueError, "3 joints, as the linkage has, got 200"),
        (([ONE, ONE], STATES, TS), None, ValueError, r"^linkage: .*\*arms\) stacks"),
        ((*of_two, three), 0, ValueError, r"state0\.q: 2, .*\[0\]\.coefficient: 3\.$"),
        ((*of_two, rows), 0, TypeError, "^forces, forces_axes: .*forces_axes=0"),
    ):
        with pytest.raises(error, match=words):
            fj.sweep(*arguments, forces_axes=axes)
    with pytest.raises(TypeError, match=r"sweep\(\) got an unexpected .*'rtoll'"):
        fj.sweep(TWO, STATES, TS, rtoll=1e-6)


def test_a_reduction_returns_numbers():
    for value in (jax.random.key(0), np.array("q")):
        with pytest.raises(ValueError, match="^reduce: expected a .* returns numbers"):
            chunks._check_value((1.0, True, value))


def test_what_a_transformation_cannot_do_is_refused(tmp_path):
    def end(q, **keywords):
        return fj.sweep(TWO, fj.State(q, QD), TS, **keywords).q

    for keywords in (dict(throw=True), dict(store=tmp_path)):
        with pytest.raises(ValueError, match="^throw, store: expected"):
            jax.eval_shape(functools.partial(end, **keywords), Q)


def test_what_members_share_is_checked():
    """Warnings are errors in these tests, so that nothing is solved."""
    stops = fj.forces.JointStops([-1, -1, -1], [1, 1, 90])
    arm = fj.scenes.fig5().linkage
    with pytest.raises(UserWarning, match=r"^forces\[0\]\.upper: .* radians, got 90"):
        fj.sweep(arm, STATES, TS, (stops,))
