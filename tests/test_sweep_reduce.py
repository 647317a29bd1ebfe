"""A reduced sweep keeps of each member what a function of its motion returns."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep_batch import FAILED, run, single_links

import fdof_jax as fj
from fdof_jax.batches import chunk_programs


def end_and_fastest(motion):
    fastest, none = jnp.abs(motion.qd).max(0), motion.q[:0]
    return {"end": motion.q[-1], "fastest": fastest, "none": none}, motion.result


@pytest.fixture(scope="module")
def reduced(mixed):
    return run(mixed, reduce=end_and_fastest)


def test_it_equals_what_the_function_makes_of_the_motions(reduced, swept):
    expected = jax.vmap(end_and_fastest)(swept)
    assert jax.tree.structure(reduced) == jax.tree.structure(expected)
    for a, b in zip(*map(jax.tree.leaves, (reduced, expected))):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)
    assert np.isnan(reduced[0]["end"]).any(axis=1).nonzero()[0].tolist() == FAILED


def test_failures_are_counted(mixed, reduced):
    with pytest.raises(RuntimeError, match=r"3 of 42 members failed.* member 3\."):
        run(mixed, reduce=end_and_fastest, throw=True)


@dataclasses.dataclass
class Unhashable:
    def __call__(self, motion):
        return motion.q


def test_what_is_no_reduction_is_refused(batch):
    for wrong in (3, "q", fj.Solution):
        with pytest.raises(ValueError, match="^reduce: expected a callable, got "):
            run(batch, reduce=wrong)
    with pytest.raises(ValueError, match="^reduce: expected what can be hashed"):
        run(batch, reduce=Unhashable())
    with pytest.raises(ValueError, match="^reduce: expected a function .*, got 'q'"):
        run(batch, reduce=lambda motion: (motion.q, "q"))
    for wrong in (jax.random.key(0), np.array("q")):
        with pytest.raises(ValueError, match="^reduce: expected a .* returns numbers"):
            chunk_programs._check_kept((1.0, True, wrong))


def test_it_works_under_transformations(batch):
    def end(q):
        linkage, state0, forces = batch
        moved = linkage, state0._replace(q=q), forces
        return run(moved, reduce=lambda motion: motion.q[-1])

    assert jax.eval_shape(end, batch[1].q).shape == (42, 3)


def two_links():
    return jax.tree.map(lambda leaf: leaf[:2], single_links())


def test_traced_values_may_be_out_of_sight(monkeypatch):
    """Functions of the user's hold them, or they have nothing to do with the sweep."""
    batches = []

    def traced(batch, *_):
        batches.append(batch)
        return jnp.ones(batch.size)

    monkeypatch.setattr(sys.modules["fdof_jax.batches.sweep"], "_traced", traced)

    def total(w):
        return w * run(two_links(), reduce=lambda motion: w * motion.q[-1]).sum()

    assert jax.grad(total)(1.0) == 2
    assert jax.vmap(total)(jnp.ones(3)).tolist() == [2, 2, 2]
    assert len(batches) == 2


@pytest.mark.slow
def test_a_failed_member_adds_nothing_to_a_gradient_in_a_held_value():
    linkage, state0, forces = jax.tree.map(lambda leaf: leaf[:3], single_links())
    state0.q[1] = np.nan

    def total(w):
        reduce = lambda motion: w * motion.q[-1]
        return jnp.nansum(run((linkage, state0, forces), reduce=reduce))

    np.testing.assert_allclose(jax.grad(total)(1.0), total(1.0), rtol=1e-6)


@pytest.mark.slow
def test_a_gradient_is_compiled_once():
    linkage, state0, forces = two_links()
    traces = []

    def end(motion):
        traces.append(motion)
        return motion.q[-1]

    def ends(q):
        moved = linkage, state0._replace(q=q), forces
        return run(moved, reduce=end).sum()

    first = jax.grad(ends)(state0.q)
    assert traces
    traces.clear()
    second = jax.grad(ends)(state0.q)
    assert not traces
    np.testing.assert_array_equal(first, second)
