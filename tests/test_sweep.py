"""A sweep equals jax.vmap(simulate), member by member: its chunks and its programs."""

import contextlib
import functools
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from elements import SHORT
from hard.scenes import Breaking
from jax.experimental.compilation_cache import compilation_cache
from modes import ADJOINT, LOOPS
from scipy.integrate import solve_ivp
from sweep_batch import CHUNK, FAILED, FAST, SETTINGS, TS, alone, run

import fdof_jax as fj
from fdof_jax.base import configuration
from fdof_jax.batches import chunks, devices

LANES = 64  # enough for a slow member to be stopped
PENDULUM = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
DAMPER = fj.JointDamper(1.0)


def pendulums(speeds):
    """Returns pendulums that start level, at these speeds."""
    qd = np.reshape(speeds, (-1, 1))
    return PENDULUM, fj.State(np.zeros_like(qd), qd)


def sweep_of(speeds, **keywords):
    return fj.sweep(*pendulums(speeds), TS, **{**SETTINGS, **keywords})


def integrated(speed):
    """Returns a pendulum's positions by SciPy."""
    rates = lambda t, y: (y[1], -0.5 * 9.81 / 0.35 * np.cos(y[0]))
    options = dict(method="DOP853", rtol=1e-12, atol=1e-12, t_eval=TS)
    return solve_ivp(rates, (0, TS[-1]), (0, speed), **options).y[0]


@contextlib.contextmanager
def setting(name, value):
    """Has another setting of JAX in all threads for a while."""
    before = getattr(jax.config, name)
    jax.config.update(name, value)
    yield
    jax.config.update(name, before)


@pytest.fixture
def solved(monkeypatch):
    """Returns a list of the members in each chunk from here on."""
    found, original = [], chunks.solve

    def recorded(program, moving, shared):
        if len(moving[0]) != chunks._FORECASTS:
            found.append(moving)
        return original(program, moving, shared)

    monkeypatch.setattr(chunks, "solve", recorded)
    return found


@pytest.fixture
def traces(monkeypatch):
    """Returns a list of the traces of motions, and of forecasts, from here on."""
    found = []
    for name in ("solve_motion", "forward_dynamics"):

        def counted(*arguments, name=name, original=vars(chunks)[name]):
            found.append(name)
            return original(*arguments)

        monkeypatch.setattr(chunks, name, counted)
    return found


def assert_alike(tree, other):
    """Asserts that two trees have equal structures, shapes and types."""
    assert jax.tree.structure(tree) == jax.tree.structure(other)
    for a, b in zip(*map(jax.tree.leaves, (tree, other))):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)


# Members


def test_members_equal_single_simulations(batch, clean):
    """Equality of vmap with single motions is in test_one_compilation.py."""
    single = jax.vmap(functools.partial(alone, jax.tree.map(jnp.asarray, batch)))
    assert_alike(clean, jax.eval_shape(single, jnp.arange(len(clean.q))))
    assert (clean.outcome == "successful").all()
    for member in range(len(clean.q)):
        single = alone(batch, member)
        np.testing.assert_array_equal(clean.ts[member], single.ts)
        np.testing.assert_allclose(clean.q[member], single.q, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(clean.qd[member], single.qd, rtol=1e-7, atol=1e-7)
        # A batch rounds differently, which may tip a step or two.
        steps = clean.stats["num_steps"][member]
        np.testing.assert_allclose(steps, single.stats["num_steps"], rtol=0, atol=5)


def test_members_that_fail_harm_no_other(mixed, swept, clean):
    nan_start, nan_later, spent = FAILED
    expected = np.full(len(clean.q), "successful", object)
    expected[FAILED] = "not finite", "not finite", "out of steps"
    np.testing.assert_array_equal(swept.outcome, expected)
    with pytest.raises(RuntimeError, match=r"3 of 42 members failed.* member 3\."):
        run(mixed, throw=True)
    for member in (nan_later, spent):  # alone, a start of NaN is refused
        assert alone(mixed, member).outcome == expected[member]
    assert np.isnan(swept.q[nan_start]).all() and np.isnan(swept.q[spent][-1]).all()
    # No step comes up to 1 s itself.
    for found, sound in ((swept.q, clean.q), (swept.qd, clean.qd)):
        found, sound = found[nan_later], sound[nan_later]
        assert np.isnan(found[TS > 1]).all()
        np.testing.assert_allclose(found[TS < 1], sound[TS < 1], rtol=1e-8, atol=1e-8)
    others = np.delete(np.arange(len(clean.q)), [*FAILED, FAST])
    np.testing.assert_allclose(swept.q[others], clean.q[others], rtol=1e-9, atol=1e-9)
    steps, before = swept.stats["num_steps"], clean.stats["num_steps"]
    np.testing.assert_array_equal(steps[others], before[others])
    assert steps[spent] == SETTINGS["max_steps"]
    assert steps[FAST] > 2 * steps[others].max()
    fast = alone(mixed, FAST).q
    np.testing.assert_allclose(swept.q[FAST], fast, rtol=1e-6, atol=1e-6)


def figures_of(scene, motion):
    total = fj.joint_efforts(scene, motion).total
    tip = fj.tip_position(scene.linkage, motion.q[-1])
    start, none = scene.state0.q, motion.q[:0]
    return {"total": total, "tip": tip, "start": start, "none": none}, motion.result


@pytest.mark.slow
def test_a_reduction_sees_each_member_and_its_motion(mixed, swept):
    reduced = run(mixed, reduce=figures_of)

    @jax.jit
    @jax.vmap
    def expected(linkage, state0, forces, motion):
        return figures_of(fj.Scene(linkage, state0, forces, TS[-1]), motion)

    expected = expected(*mixed, swept)
    assert_alike(reduced, expected)
    for a, b in zip(*map(jax.tree.leaves, (reduced, expected))):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)


def ramp(t, linkage):
    return jnp.ones(1) * t, jnp.ones(1)


@pytest.mark.slow
def test_arrays_without_the_axis_are_shared():
    """Shared arrays include starting velocities, here whole numbers, and times."""
    q, kp = np.random.default_rng(4).uniform(0.5, 1, (2, 3, 1))
    pd, ts = fj.PDController(9.0, 4.0, 50.0, ramp), TS.copy()
    # A function among the arrays, such as this reference, has no axis.
    own = jax.tree.map(lambda a: np.stack([a] * 3) if eqx.is_array(a) else a, pd)
    forces = DAMPER, eqx.tree_at(lambda pd: pd.kp, own, kp), pd
    axes = None, 0, None
    motion = fj.sweep(PENDULUM, fj.State(q, [1]), ts, forces, forces_axes=axes, **SHORT)
    ts[:] = 0  # the motion keeps its own, once for all members
    assert motion.ts.strides[0] == 0
    np.testing.assert_array_equal(motion.ts, np.tile(TS, (3, 1)))
    for member in range(3):
        one = DAMPER, pd.replace(kp=kp[member]), pd
        single = fj.simulate(PENDULUM, fj.State(q[member], [1]), TS, one, **SHORT)
        np.testing.assert_allclose(motion.q[member], single.q, rtol=1e-8, atol=1e-8)


# Under transformations


@pytest.mark.slow
def test_failed_members_add_nothing_to_a_gradient():
    """Reverse mode adds all members' cotangents to the shared mass; 0 x NaN is NaN."""
    q, qd = np.random.default_rng(2).uniform(-1, 1, (2, 4, 1))
    q[1, 0] = np.nan
    breaking = (Breaking(jnp.array([1e9, 1e9, TS[1], 1e9])),)

    def distance(mass, factor):
        arm = eqx.tree_at(lambda arm: arm.mass, PENDULUM, mass)
        ends = fj.sweep(
            arm, fj.State(q, qd), TS[:3], breaking, forces_axes=0, chunk=4,
            adjoint=ADJOINT, **SHORT,
            # A function may hold a traced value, too.
            reduce=lambda scene, motion: factor * motion.q[-1, 0],
        )  # fmt: skip
        return jnp.nansum(ends**2), ends

    slope = jax.jit(jax.value_and_grad(distance, (0, 1), has_aux=True), **LOOPS)
    mass = PENDULUM.mass
    (value, ends), (of_mass, of_factor) = slope(mass, 1.0)
    assert np.isnan(ends).tolist() == [False, True, True, False]

    def difference(h):
        above, below = (slope(mass + s * h, 1.0)[0][0] for s in (1, -1))
        return (above - below) / 2

    expected = (8 * difference(5e-4) - difference(1e-3)) / 3e-3
    assert np.abs(expected) > 1e-3
    np.testing.assert_allclose(of_mass, [expected], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(of_factor, 2 * value, rtol=1e-12)


def test_what_a_transformation_cannot_do_is_refused(batch, tmp_path):
    linkage, state0, _ = batch
    end = lambda q, **options: fj.sweep(linkage, (q, q), TS, **options).q
    for options in dict(throw=True), dict(store=tmp_path):
        with pytest.raises(ValueError, match="^throw, store: expected"):
            jax.eval_shape(functools.partial(end, **options), state0.q)


# Chunks


@pytest.mark.slow
def test_small_batches_share_a_program_and_need_no_forecast(solved, monkeypatch):
    monkeypatch.setattr(chunks, "expected_work", None)
    speeds = np.linspace(0, 1, 8)
    first = sweep_of(speeds)
    before = devices.compiled.cache_info().misses
    for size in (2, 5, 7):
        assert sweep_of(speeds[:size]).q.shape == (size, len(TS), 1)
    assert devices.compiled.cache_info().misses == before
    assert [len(q) for q, _ in solved] == [8] * 4
    # It has the equations of one joint: its existence factors are not given to it.
    assert [len(moving) for moving in solved] == [2] * 4
    exact = [integrated(speed) for speed in speeds]
    np.testing.assert_allclose(first.q[..., 0], exact, atol=1e-9)


@pytest.mark.slow
def test_members_are_sorted_by_a_forecast_that_serves_all_sizes(
    solved, traces, monkeypatch
):
    monkeypatch.setattr(devices, "cores", lambda: 1)
    speeds = 3 * np.array([0.0, 9, 1, 8, 2, 7, 3, 6, 4, 5, 10, 11])
    motion = sweep_of(speeds, chunk=4)
    np.testing.assert_array_equal(motion.qd[:, 0, 0], speeds)
    found = [sorted(qd[:, 0] / 3) for _, qd in solved]
    assert found == [[8, 9, 10, 11], [4, 5, 6, 7], [0, 1, 2, 3]]
    before = len(traces)
    sweep_of(np.linspace(0, 1, 40), chunk=4)
    assert len(traces) == before > 0
    # Starts of any type are solved in double precision, by the same program.
    arm, starts = pendulums(speeds)
    for kinds in ((np.float32, np.float32), (np.float32, float), (float, int)):
        starts = fj.State(*(a.astype(kind) for a, kind in zip(starts, kinds)))
        again = fj.sweep(arm, starts, TS, chunk=4, **SETTINGS)
        assert_alike(again, motion)
        np.testing.assert_array_equal(again.q, motion.q)
    assert len(traces) == before


@pytest.mark.slow
def test_a_slow_member_is_stopped_and_solved_alone(solved):
    speeds = np.linspace(0, 1, LANES)
    speeds[20] = 60
    motion = sweep_of(speeds)
    assert [len(q) for q, _ in solved] == [LANES, 1]
    np.testing.assert_array_equal(solved[1][1], [[60]])
    assert (motion.outcome == "successful").all()
    steps = np.asarray(motion.stats["num_steps"])
    assert steps[20] > 3 * np.delete(steps, 20).max()
    for member in (20, 21):
        exact = integrated(speeds[member])
        np.testing.assert_allclose(motion.q[member, :, 0], exact, rtol=1e-6, atol=1e-6)


class Recorder(diffrax.NoProgressMeter):
    seen: list

    def step(self, state, progress):
        self.seen.append(float(progress))
        return state


def test_progress_rises_to_one_and_other_values_need_no_new_trace(mixed, swept, traces):
    recorder = Recorder([])
    linkage, (q, qd), forces = mixed
    other = run((linkage, fj.State(q + 0.1, qd), forces), progress_meter=recorder)
    assert not np.array_equal(other.q[1], swept.q[1])
    assert 0 <= recorder.seen[0] < 1 and recorder.seen[-1] == 1
    assert len(recorder.seen) >= len(q) // CHUNK and (np.diff(recorder.seen) >= 0).all()
    run(jax.tree.map(lambda a: a[:11], mixed))  # nor do fewer members
    assert not traces


# Cores, devices and precision


def test_cores_change_nothing(batch, clean, monkeypatch):
    """Chunks are the same ones, whatever the number of threads that send them.

    No array may reach or leave JAX unasked, in any thread.
    """
    for cores in (1, 3):
        monkeypatch.setattr(devices, "cores", lambda cores=cores: cores)
        with setting("jax_transfer_guard", "disallow"):
            motions, motion = run(batch), fj.simulate(PENDULUM, ([0.0], [0.0]), TS)
        assert motion.outcome == "successful"
        for a, b in zip(*map(jax.tree.leaves, (motions, clean))):
            np.testing.assert_array_equal(a, b)


class Mixed(fj.Element):
    """A damper whose numbers are of any type."""

    coefficient: Any
    doubled: Any

    def __call__(self, t, q, qd, linkage):
        return -self.coefficient * (1 + self.doubled) * qd


@pytest.mark.slow
def test_threads_compute_in_the_precision_that_is_asked_for(monkeypatch):
    """Numbers are NumPy's, of which some differ between members."""
    monkeypatch.setattr(devices, "cores", lambda: 2)
    arm, starts = pendulums(np.linspace(0, 1, 40))
    mixed = Mixed(np.repeat([0.5, 1.0], 20), np.int64(1))
    solve = functools.partial(fj.sweep, arm, starts, TS, chunk=20, **SHORT)
    with setting("jax_enable_x64", False):
        single = solve((mixed,), forces_axes=(Mixed(0, None),))
        with jax.enable_x64(True):
            double = solve((fj.JointDamper(2.0),))
    assert (single.q.dtype, double.q.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose(single.q[20:], double.q[20:], atol=1e-4)


@pytest.mark.slow
def test_cores_take_copies_of_a_program_unless_it_calls_python(monkeypatch):
    monkeypatch.setattr(devices, "cores", lambda: 2)
    kind = jax.ShapeDtypeStruct((1,), float)
    call = lambda qd: jax.pure_callback(
        np.negative, kind, qd, vmap_method="expand_dims"
    )
    drag = lambda t, q, qd, linkage: call(qd)
    solve = functools.partial(fj.sweep, *pendulums(np.linspace(0, 1, 40)), TS)
    devices.compiled.cache_clear()  # other tests solve the same scene
    misses, motions = [0], []
    # Those of a folder of programs cannot be copied.
    with setting("jax_compilation_cache_dir", None):
        compilation_cache.reset_cache()
        for element in drag, DAMPER:
            motions.append(solve((element,), chunk=20, **SHORT).q)
            misses.append(devices.compiled.cache_info().misses)
    compilation_cache.reset_cache()
    assert np.diff(misses).tolist() == [3, 2]  # the forecast is of one chunk
    np.testing.assert_allclose(*motions, atol=1e-12)


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(configuration, "_WIDE", {"xla_cpu_no_such_option": 1})
    assert configuration.wide_vectors.__wrapped__() == {}


WORKER = """
import sys
import jax
import numpy as np
import fdof_jax as fj
fj.configure(x64=True)
address, index, folder = sys.argv[1:]
jax.distributed.initialize(address, 2, int(index))
import sweep_batch
from elements import SHORT
assert (jax.device_count(), jax.local_device_count()) == (4, 2)
batch = sweep_batch.members()
options = SHORT | dict(chunk=4)
motion = sweep_batch.run(batch, **options)
sweep_batch.run(batch, store=folder + "/store", shard=int(index), of=2, **options)
if hasattr(jax, "set_mesh"):
    lanes = jax.sharding.PartitionSpec("lanes")
    mesh = jax.sharding.Mesh(jax.local_devices(), ("lanes",))
    spread = jax.device_put(batch, jax.sharding.NamedSharding(mesh, lanes))
    with jax.set_mesh(mesh):
        same = sweep_batch.run(spread, **options)
    np.testing.assert_array_equal(same.q, motion.q)
np.savez(f"{folder}/{index}.npz", q=motion.q, qd=motion.qd)
"""


@pytest.mark.slow
def test_more_devices_and_processes_change_nothing(batch, tmp_path):
    """Uses two devices in each of two processes, and inputs spread over them."""
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{port.getsockname()[1]}"
    here = Path(__file__).parent
    places = os.pathsep.join([str(here), str(here.parent)])
    own = dict(JAX_PLATFORMS="cpu", JAX_NUM_CPU_DEVICES="2", PYTHONPATH=places)

    def work(index):
        command = [sys.executable, "-c", WORKER, address, str(index), str(tmp_path)]
        options = dict(env=os.environ | own, capture_output=True, text=True)
        return subprocess.run(command, **options, timeout=600)

    with ThreadPoolExecutor(2) as pool:
        for done in pool.map(work, range(2)):
            assert done.returncode == 0, done.stderr[-3000:]
    expected = run(batch, **SHORT)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    for index in range(2):
        answer = np.load(tmp_path / f"{index}.npz")
        close(answer["q"], expected.q)
        close(answer["qd"], expected.qd)
    with xarray.open_zarr(tmp_path / "store") as data:
        assert not data.failed.any()
        close(data.q, expected.q)
