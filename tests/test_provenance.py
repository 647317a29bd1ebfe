"""The digest of a sweep names what its functions compute, and all numbers in them."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep_batch import SETTINGS, TS, single_links

import fdof_jax as fj
from fdof_jax.batches.batch_axes import batch_of
from fdof_jax.batches.provenance import outline


@functools.cache
def two_links():
    return jax.tree.map(lambda leaf: leaf[:2], single_links())


def digest(reduce=lambda motion: motion.q, force=lambda t, q, qd, linkage: q):
    linkage, state0, _ = two_links()
    batch = batch_of(linkage, state0, (force,), None)
    settings = dict(SETTINGS, dt0=1e-3, adjoint=diffrax.RecursiveCheckpointAdjoint())
    return outline(batch, jnp.asarray(TS), settings, reduce)[1]


def times(factor):
    return lambda t, q, qd, linkage: factor * q


def test_it_names_what_functions_compute():
    assert digest(force=times(2.0)) == digest(force=times(2.0))
    assert digest(force=times(2.0)) != digest(force=times(3.0))
    two, three = jnp.full(1, 2.0), jnp.full(1, 3.0)
    assert digest(force=times(two)) != digest(force=times(three))
    assert digest() != digest(lambda motion: motion.q + 1)


def in_scan(distance):
    jitted = jax.jit(lambda far, _: (distance(far), None))
    return lambda q: jax.lax.scan(jitted, q, None, length=2)[0]


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit, in_scan])
def test_arrays_within_compiled_functions_count(jit):
    def distance(target):
        return jit(lambda q: q - target)

    def reduction(target):
        return lambda motion: distance(target)(motion.q[-1])

    def force(target):
        return lambda t, q, qd, linkage: distance(target)(q)

    far, near = np.full(1, 5.0), np.zeros(1)
    pairs = (near, near), (far, near), (near, far)
    assert len({digest(reduction(a), force(b)) for a, b in pairs}) == 3


def test_functions_that_only_python_can_call_are_refused(tmp_path):
    """They have no digest. Checks and prints change no result."""

    def called(t, q, qd, linkage):
        return jax.pure_callback(np.sin, q, q, vmap_method="sequential")

    def checked(motion):
        jax.debug.print("{}", motion.q[0])
        return eqx.error_if(motion.q, motion.q > 1, "far")

    assert digest(checked) == digest(checked)
    linkage, state0, _ = two_links()
    for keywords in (dict(checkpoint=tmp_path), dict(store=tmp_path)):
        with pytest.raises(
            ValueError, match="^checkpoint, store: expected .*only Python.*sin"
        ):
            fj.sweep(linkage, state0, TS, (called,), **keywords, **SETTINGS)
    assert not any(tmp_path.iterdir())
