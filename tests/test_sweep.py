"""A sweep equals jax.vmap(simulate), member by member, or keeps what is asked for."""

import functools
import sys

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from hard.scenes import Breaking
from helpers import random_linkage
from modes import ADJOINT
from sweep_batch import (
    CHUNK,
    FAILED,
    FAST,
    NAN_LATER,
    NAN_START,
    SETTINGS,
    SPENT,
    TS,
    alone,
    run,
    single_links,
    successful,
)  # fmt: skip

import fdof_jax as fj
from fdof_jax.batches import devices
from fdof_jax.steps.looped_dopri8 import LoopedDopri8


def assert_alike(tree, other):
    """Asserts that two trees have equal structures, shapes and types."""
    assert jax.tree.structure(tree) == jax.tree.structure(other)
    for a, b in zip(*map(jax.tree.leaves, (tree, other))):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)


def test_members_equal_single_simulations(batch, clean):
    """Equality of vmap with single motions is in test_one_compilation.py."""
    simulate = lambda linkage, state0, forces: fj.simulate(
        linkage, state0, TS, forces, throw=False, **SETTINGS
    )
    assert_alike(clean, jax.eval_shape(jax.vmap(simulate), *batch))
    assert successful(clean).all()
    for member in range(len(clean.q)):
        single = alone(batch, member)
        np.testing.assert_array_equal(clean.ts[member], single.ts)
        np.testing.assert_allclose(clean.q[member], single.q, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(clean.qd[member], single.qd, rtol=1e-7, atol=1e-7)
        # A batch rounds differently, which may tip a step or two.
        np.testing.assert_allclose(
            clean.stats["num_steps"][member], single.stats["num_steps"], rtol=0, atol=5
        )


# Members that differ from the others


def test_failed_members_have_their_own_results(mixed, swept):
    results = diffrax.RESULTS
    assert np.flatnonzero(~successful(swept)).tolist() == FAILED
    for member, result in (
        (NAN_START, results.nonfinite),
        (NAN_LATER, results.nonfinite),
        (SPENT, results.max_steps_reached),
    ):
        assert jax.tree.map(lambda a, m=member: a[m], swept.result) == result
        if member != NAN_START:  # alone, a start of NaN is refused
            assert alone(mixed, member).result == result
    assert swept.stats["num_steps"][SPENT] == SETTINGS["max_steps"]


def test_failed_members_are_nan_from_there_on(swept, clean):
    assert np.isnan(swept.q[NAN_START]).any(axis=-1).all()
    # No step comes up to 1 s itself.
    early, late = TS < 1, TS > 1
    assert np.isnan(swept.q[NAN_LATER][late]).all()
    assert np.isnan(swept.qd[NAN_LATER][late]).all()
    np.testing.assert_allclose(
        swept.q[NAN_LATER][early], clean.q[NAN_LATER][early], rtol=1e-8, atol=1e-8
    )
    assert np.isnan(swept.q[SPENT][-1]).all()
    assert np.isfinite(swept.q[SPENT][0]).all()


def test_the_others_do_not_notice_and_a_fast_member_is_right(mixed, swept, clean):
    others = np.delete(np.arange(len(clean.q)), [*FAILED, FAST])
    for a, b in ((swept.q, clean.q), (swept.qd, clean.qd)):
        np.testing.assert_allclose(a[others], b[others], rtol=1e-9, atol=1e-9)
    for name in ("num_steps", "num_accepted_steps"):
        np.testing.assert_array_equal(
            swept.stats[name][others], clean.stats[name][others]
        )
    single, steps = alone(mixed, FAST), swept.stats["num_steps"]
    assert steps[FAST] > 2 * steps[others].max()
    assert steps[FAST] == pytest.approx(single.stats["num_steps"], abs=4)
    np.testing.assert_allclose(swept.q[FAST], single.q, rtol=1e-6, atol=1e-6)


# What is kept of members


def end_and_fastest(scene, motion):
    fastest, none = jnp.abs(motion.qd).max(0), motion.q[:0]
    return {"end": motion.q[-1], "fastest": fastest, "none": none}, motion.result


@pytest.mark.slow
def test_a_reduction_sees_each_motion(mixed, swept):
    reduced = run(mixed, reduce=end_and_fastest)
    expected = jax.vmap(lambda motion: end_and_fastest(None, motion))(swept)
    assert_alike(reduced, expected)
    for a, b in zip(*map(jax.tree.leaves, (reduced, expected))):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)
    assert np.isnan(reduced[0]["end"]).any(axis=1).nonzero()[0].tolist() == FAILED


@pytest.mark.slow
def test_a_reduction_sees_each_member():
    def tip_and_work(scene, motion):
        total = fj.joint_efforts(scene, motion).total
        return fj.tip_position(scene.linkage, motion.q[-1]), total, scene.state0.q

    both = two_links()
    tips, efforts, starts = run(both, reduce=tip_and_work)
    np.testing.assert_array_equal(starts, both[1].q)
    for k in range(2):
        member = jax.tree.map(lambda leaf, k=k: leaf[k], both)
        single = alone(both, k)
        tip = fj.tip_position(member[0], single.q[-1])
        np.testing.assert_allclose(tips[k], tip, atol=1e-7)
        wanted = fj.joint_efforts(member[0], member[2], single).total
        np.testing.assert_allclose(efforts[k], wanted, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("reduce", [None, end_and_fastest])
def test_throw_tells_how_many_failed(mixed, reduce):
    with pytest.raises(RuntimeError, match=r"3 of 42 members failed.* member 3\."):
        run(mixed, reduce=reduce, throw=True)


# Under transformations


def two_links():
    return jax.tree.map(lambda leaf: leaf[:2], single_links())


@pytest.mark.slow
def test_it_works_under_transformations(batch):
    def swept(q, **keywords):
        linkage, state0, forces = batch
        return run((linkage, state0._replace(q=q), forces), **keywords)

    end = lambda q: swept(q, reduce=lambda scene, motion: motion.q[-1])
    assert jax.eval_shape(end, batch[1].q).shape == (42, 3)
    assert jax.eval_shape(swept, batch[1].q).ts.shape == (42, len(TS))


def test_traced_values_may_be_out_of_sight(monkeypatch):
    """Functions of the user's hold them, or they have nothing to do with the sweep."""
    sizes = []

    def traced(moving, common, size, chunk):
        sizes.append(size)
        return jnp.ones(size)

    monkeypatch.setattr(sys.modules["fdof_jax.batches.sweep"], "_traced", traced)

    def total(w):
        return w * run(two_links(), reduce=lambda scene, motion: w * motion.q[-1]).sum()

    assert jax.grad(total)(1.0) == 2
    assert jax.vmap(total)(jnp.ones(3)).tolist() == [2, 2, 2]
    assert sizes == [2, 2]


@pytest.mark.slow
def test_failed_members_add_nothing_to_a_gradient():
    """Reverse mode adds all members' cotangents to the shared mass; 0 x NaN is NaN."""
    # Of one link, whose program is the smallest.
    linkage = chains.random_chain("R", np.random.default_rng(1))
    rng = np.random.default_rng(2)
    q, qd = rng.uniform(-1, 1, (2, 4, 1))
    q[1, 0] = np.nan
    breaking = (Breaking(jnp.array([1e9, 1e9, TS[1], 1e9])),)

    def with_mass(mass):
        return eqx.tree_at(lambda k: k.mass, linkage, mass)

    @jax.jit
    @lambda f: jax.value_and_grad(f, has_aux=True)
    def distance(mass):
        solution = fj.sweep(
            with_mass(mass), fj.State(q, qd), TS[:3], breaking, forces_axes=0, chunk=4,
            solver=LoopedDopri8(), adjoint=ADJOINT,
        )  # fmt: skip
        counted = solution.result == diffrax.RESULTS.successful
        end = jnp.where(counted[:, None], solution.q[:, -1], 0)
        return jnp.sum(end**2), solution

    (_, solution), gradient = distance(linkage.mass)
    assert successful(solution).tolist() == [True, False, False, True]
    assert np.isnan(solution.q[1]).any(axis=-1).all()
    assert np.isnan(solution.q[2, -1]).all() and np.isfinite(solution.q[2, 0]).all()

    def difference(h):
        ends = [distance(linkage.mass + s * h)[0][0] for s in (1, -1)]
        return (ends[0] - ends[1]) / 2

    expected = (8 * difference(5e-4) - difference(1e-3)) / 3e-3
    assert np.abs(expected) > 1e-3
    np.testing.assert_allclose(gradient, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_a_failed_member_adds_nothing_to_a_gradient_in_a_held_value():
    linkage, state0, forces = jax.tree.map(lambda leaf: leaf[:3], single_links())
    state0.q[1] = np.nan

    def total(w):
        reduce = lambda scene, motion: w * motion.q[-1]
        return jnp.nansum(run((linkage, state0, forces), reduce=reduce))

    np.testing.assert_allclose(jax.grad(total)(1.0), total(1.0), rtol=1e-6)


@pytest.mark.slow
def test_a_gradient_is_compiled_once():
    linkage, state0, forces = two_links()
    traces = []

    def end(scene, motion):
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


# Shared arrays


def ramp(t, linkage):
    return jnp.ones(3) * t, jnp.ones(3)


def test_a_motion_keeps_its_times_when_their_array_changes(batch):
    ts = TS.copy()
    motion = fj.sweep(*batch[:2], ts, batch[2], forces_axes=0, chunk=CHUNK, **SETTINGS)
    ts[:] = 0
    np.testing.assert_array_equal(motion.ts[0], TS)


@pytest.mark.slow
def test_arrays_without_the_axis_are_shared():
    """Shared arrays include starting velocities, here whole numbers."""
    linkage = random_linkage("RPR", np.random.default_rng(3))
    rng = np.random.default_rng(4)
    starts = rng.uniform(-1, 1, (3, 3))
    damper, shared = fj.JointDamper(1.3), fj.PDController(9.0, 4.0, 50.0, ramp)
    own = [fj.PDController(kp, 4.0, 50.0, ramp) for kp in rng.uniform(0.5, 40, 3)]
    # A function among the arrays, such as this reference, has no axis.
    stacked = jax.tree.map(lambda *a: np.stack(a) if eqx.is_array(a[0]) else a[0], *own)
    solution = fj.sweep(
        linkage,
        fj.State(starts, [0, 0, 1]),
        TS,
        (damper, stacked, shared),
        forces_axes=(None, 0, None),
        **SHORT,
    )
    assert solution.q.shape == (3, len(TS), 3)
    for member, q in enumerate(starts):
        start, forces = fj.State(q, [0, 0, 1]), (damper, own[member], shared)
        single = fj.simulate(linkage, start, TS, forces, **SHORT)
        np.testing.assert_allclose(solution.q[member], single.q, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_an_implicit_solver_finds_its_tolerances():
    linkage = chains.random_chain("R", np.random.default_rng(1))
    start = fj.State(np.array([[0.0], [0.1]]), np.zeros(1))
    steps = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    solution = fj.sweep(
        linkage, start, [0, 0.2], solver=diffrax.Kvaerno5(), stepsize_controller=steps
    )
    alone = fj.simulate(linkage, fj.State(start.q[1], start.qd), [0, 0.2])
    np.testing.assert_allclose(solution.q[1], alone.q, atol=1e-6)


def test_no_members():
    """`vmap` over no members has nothing to raise."""
    linkage, state0, *_ = fj.scenes.fig5()
    motion = lambda q: fj.simulate(linkage, state0._replace(q=q), TS)
    solution = jax.eval_shape(jax.vmap(motion), np.zeros((0, 3)))
    assert solution.q.shape == (0, len(TS), 3)


@pytest.fixture
def guarded():
    """Lets no array reach or leave JAX unasked, in any thread."""
    before = jax.config.jax_transfer_guard
    jax.config.update("jax_transfer_guard", "disallow")
    yield
    jax.config.update("jax_transfer_guard", before)


def test_under_a_transfer_guard(batch, guarded, monkeypatch):
    linkage, state0, *_ = fj.scenes.fig5()
    monkeypatch.setattr(devices, "cores", lambda: 2)
    solution = run(batch)
    motion = fj.simulate(linkage, state0, TS)
    with jax.transfer_guard("allow"):
        assert successful(solution).all() and successful(motion)


def test_what_a_transformation_cannot_do_is_refused(batch, tmp_path):
    linkage, state0, _ = batch
    end = lambda q, **options: fj.sweep(linkage, (q, q), TS, **options).q
    for options in dict(throw=True), dict(store=tmp_path):
        with pytest.raises(ValueError, match="^throw, store: expected"):
            jax.eval_shape(functools.partial(end, **options), state0.q)


def test_what_members_share_is_checked():
    """Warnings are errors in these tests, so that nothing is solved."""
    stops = fj.forces.JointStops([-1, -1, -1], [1, 1, 90])
    states = fj.State(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(UserWarning, match=r"^forces\[0\]\.upper: .* radians, got 90"):
        fj.sweep(fj.scenes.fig5().linkage, states, TS, (stops,))
