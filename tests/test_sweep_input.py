"""Malformed arguments of a sweep raise errors that name them."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep_batch import SETTINGS, TS, members

import fdof_jax as fj

# Malformed arguments


def refused(name, **changes):
    linkage, state0, forces = jax.tree.map(lambda a: a[:2], members())
    arguments = dict(linkage=linkage, state0=state0, ts=TS, forces=forces)
    arguments.update(forces_axes=0, **SETTINGS)
    arguments.update(changes)
    with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .+, got .+\.$"):
        fj.sweep(**arguments)


ONE, STATE = jax.tree.map(lambda a: a[0], members()[:2])
TWO, STATES = jax.tree.map(lambda a: a[:2], members()[:2])
INPUTS = "linkage, state0, forces"


class Rows(fj.Element):
    rows: jax.Array

    def __call__(self, t, q, qd, linkage):
        return -qd / len(self.rows)


def test_a_batch_is_expected():
    refused(INPUTS, linkage=ONE, state0=STATE, forces=())
    # Forces without a leading axis are shared.
    refused(INPUTS, linkage=ONE, state0=STATE, forces_axes=None)
    dampers = (jax.vmap(fj.JointDamper)(np.ones(4)),)
    with pytest.raises(ValueError, match=r"none on any \(pass forces_axes=0 if"):
        fj.sweep(ONE, STATE, TS, dampers)
    many = (fj.JointDamper(np.ones(200)),)
    with pytest.raises(ValueError, match="3 joints, as the linkage has, got 200"):
        fj.sweep(TWO, STATES, TS, many)
    with pytest.raises(ValueError, match=r"^linkage: expected one .*\*arms\) stacks"):
        fj.sweep([ONE, ONE], STATES, TS)
    empty = jax.tree.map(lambda a: a[:0], (TWO, STATES))
    refused(INPUTS, linkage=empty[0], state0=empty[1], forces=())


def test_one_size_is_expected():
    three = fj.State(np.zeros((3, 3)), np.zeros(3))
    refused(INPUTS, state0=three, forces=())
    refused(INPUTS, linkage=ONE, state0=three)
    refused(INPUTS, linkage=ONE, state0=fj.State(three.q, np.zeros((2, 3))), forces=())
    damper = (fj.JointDamper([1.0, 2.0, 3.0]),)  # one for all, not one per member
    sizes = r"state0\.q: 2, .*forces\[0\]\.coefficient: 3\.$"
    with pytest.raises(ValueError, match=sizes):
        fj.sweep(TWO, STATES, TS, damper, forces_axes=0)
    rows = (Rows(np.ones(2)),)  # a member's is one number
    with pytest.raises(TypeError, match="^forces, forces_axes: .*forces_axes=0"):
        fj.sweep(TWO, STATES, TS, rows, forces_axes=0)


@pytest.mark.parametrize("field", ["ef", "com", "mass", "gravity"])
def test_linkages_of_another_rank_are_refused(field):
    deeper = eqx.tree_at(
        lambda k: getattr(k, field), TWO, getattr(TWO, field)[None, None]
    )
    refused(rf"linkage\.{field}", linkage=deeper)
    refused("linkage", linkage="RRR")


@pytest.mark.parametrize(
    "value", [1.0, np.zeros(2), np.zeros((1, 2, 3)), "one", [None] * 3], ids=str
)
def test_states_that_are_not_numbers_of_joints_are_refused(value):
    refused(r"state0\.q", state0=fj.State(value, STATES.qd))
    refused(r"state0\.qd", state0=fj.State(STATES.q, value))


@pytest.mark.parametrize(
    "state0",
    [
        None,
        3,
        [STATES.q],
        (STATES.q,) * 3,
        ([[0], [0, 1]], STATES.qd),
        (np.ma.masked_less(STATES.q, 0), STATES.qd),
    ],
    ids=str,
)
def test_what_is_not_a_state_is_refused(state0):
    refused("state0", state0=state0)


@pytest.mark.parametrize("tau", [jnp.zeros(2), jnp.zeros(3) * 1j, None], ids=str)
def test_elements_that_return_no_effort_are_refused(tau):
    refused(r"forces\[0\]", forces=(lambda t, q, qd, linkage: tau,))


@pytest.mark.parametrize("kind", [bool, complex])
def test_states_that_are_not_real_are_refused(kind):
    refused(r"state0\.q", state0=fj.State(np.ones((2, 3), kind), STATES.qd))


@pytest.mark.parametrize(
    "ts", [[], 0.5, [[0, 1]], [1, 0], [0, 0], [0, np.nan], None, "1"], ids=repr
)
def test_times_that_do_not_increase_are_refused(ts):
    refused("ts", ts=ts)


@pytest.mark.parametrize("forces", [None, fj.JointDamper(1.0), (3.0,)], ids=str)
def test_what_is_not_a_tuple_of_elements_is_refused(forces):
    refused("forces", forces=forces)


@pytest.mark.parametrize("axes", [1, -1, True, "0", (0, 0), [0], (1,)], ids=repr)
def test_other_axes_are_refused(axes):
    refused("forces_axes", forces_axes=axes)


@pytest.mark.parametrize(
    "name, values",
    {
        "chunk": [0, -1, 1.5, True, "8"],
        "throw": [1, None, "no"],
        "progress_meter": [None, 3],
        "store": [3, True, ""],
        "shard": [-1, 1, 0.5, None],
        "of": [0, 1.5, True, None],
        "stepsize_controller": ["PID", 1e-6],
        "max_steps": [0, -1, 1.5, "1"],
    }.items(),
)
def test_malformed_options_are_refused(name, values):
    for value in values:
        refused(name, **{name: value})


def test_options_that_contradict_each_other_are_refused(tmp_path):
    refused("store", shard=1, of=2)
    refused("shard", shard=2, of=2, store=tmp_path)


def test_a_misspelt_keyword_is_refused():
    with pytest.raises(TypeError, match=r"sweep\(\) got an unexpected .*'rtoll'"):
        fj.sweep(TWO, STATES, TS, rtoll=1e-6)


def test_what_a_transformation_cannot_do_is_refused(tmp_path):
    def end(q, **keywords):
        return fj.sweep(TWO, fj.State(q, STATES.qd), TS, **keywords).q

    for keywords in (dict(throw=True), dict(store=tmp_path)):
        with pytest.raises(ValueError, match="^throw, store: expected"):
            jax.eval_shape(functools.partial(end, **keywords), STATES.q)
