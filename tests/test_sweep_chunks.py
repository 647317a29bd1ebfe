"""Chunks of a sweep, the devices that solve them, and the programs compiled."""

import dataclasses
import functools
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np
import pytest
import xarray
from jax.experimental.compilation_cache import compilation_cache
from sweep_batch import CHUNK, SETTINGS, TS, run, single_links, successful

import fdof_jax as fj
from fdof_jax.base import configuration
from fdof_jax.batches import chunks, devices
from fdof_jax.batches.batch_axes import batch_of
from fdof_jax.simulation import formulation

LANES = 64  # enough for a slow member to be stopped
PENDULUM = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
DAMPER = fj.JointDamper(1.0)


@pytest.fixture
def solved(monkeypatch):
    """Returns a list of the starts in each chunk from here on."""
    starts = []
    original = chunks.solve

    def recorded(program, moving, shared):
        if len(moving[0]) != chunks._FORECASTS:
            starts.append(moving)
        return original(program, moving, shared)

    monkeypatch.setattr(chunks, "solve", recorded)
    return starts


def pendulums(speeds):
    """Returns pendulums that start level, at these speeds."""
    qd = np.reshape(speeds, (-1, 1))
    return PENDULUM, fj.State(np.zeros_like(qd), qd)


def swept(speeds, **keywords):
    return fj.sweep(*pendulums(speeds), TS, **{**SETTINGS, **keywords})


@pytest.mark.slow
def test_small_batches_share_a_program_and_need_no_forecast(solved, monkeypatch):
    monkeypatch.setattr(chunks, "expected_work", None)
    speeds = np.linspace(0, 1, 8)
    motion = swept(speeds)
    # Times in common are not copied.
    assert successful(motion).all() and motion.ts.strides[0] == 0
    np.testing.assert_array_equal(motion.ts, np.tile(TS, (8, 1)))
    before = devices.compiled.cache_info().misses
    for size in (2, 5, 7):
        assert swept(speeds[:size]).q.shape == (size, len(TS), 1)
    assert devices.compiled.cache_info().misses == before
    assert [len(q) for q, _ in solved] == [8] * 4


@pytest.mark.slow
def test_a_batch_of_one_kind_has_the_equations_of_that_kind_alone(monkeypatch):
    """Its existence factors are no numbers that the program is given."""
    given, original = [], chunks.solve

    def recorded(program, *arguments):
        given.append([np.shape(a) for a in jax.tree.leaves(arguments)])
        return original(program, *arguments)

    monkeypatch.setattr(chunks, "solve", recorded)
    scene = fj.scenes.double_pendulum()
    arm, many = scene.linkage, fj.State(*(np.tile(x, (8, 1)) for x in scene.state0))
    kinds = eqx.tree_at(lambda arm: arm.ef, arm, np.tile(arm.ef, (8, 1)))
    one, any_kind = (
        fj.sweep(linkage, many, TS, scene.forces, **SETTINGS)
        for linkage in (arm, kinds)
    )
    np.testing.assert_allclose(one.q, any_kind.q, atol=1e-12)
    assert (4,) not in given[0] and (8, 4) in given[1]


@pytest.mark.slow
def test_members_are_sorted_by_their_forecast(solved, monkeypatch):
    monkeypatch.setattr(devices, "cores", lambda: 1)
    speeds = 3 * np.array([0.0, 9, 1, 8, 2, 7, 3, 6, 4, 5, 10, 11])
    motion = swept(speeds, chunk=4)
    np.testing.assert_array_equal(motion.qd[:, 0, 0], speeds)
    found = [sorted(qd[:, 0] / 3) for _, qd in solved]
    assert found == [[8, 9, 10, 11], [4, 5, 6, 7], [0, 1, 2, 3]]


def forecast(moving, shared):
    common = chunks.Common(shared, jax.numpy.asarray(TS), {}, None)
    return chunks.expected_work(common, moving)


@pytest.mark.slow
def test_the_forecast_follows_the_steps(batch, clean):
    steps = np.asarray(clean.stats["num_steps"])
    moving, shared, _ = batch_of(*batch, 0)
    found = forecast(moving, shared)
    assert np.corrcoef(found, steps)[0, 1] > 0.75


def test_the_forecast_of_arms_that_friction_stops_is_their_energy():
    speeds = np.linspace(0, 3, 7)
    arm, starts = pendulums(speeds)
    moving, shared, _ = batch_of(arm, starts, (fj.forces.JointFriction(0.5),), None)
    found = forecast(moving, shared)
    inertia = float(fj.mass_matrix(arm, [0.0])[0, 0])
    np.testing.assert_allclose(found - found[0], inertia * speeds**2 / 2, atol=1e-12)


@pytest.mark.slow
def test_one_forecast_serves_batches_of_all_sizes(monkeypatch):
    traces = []
    original = chunks.forward_dynamics

    def counted(*arguments):
        traces.append(1)
        return original(*arguments)

    monkeypatch.setattr(chunks, "forward_dynamics", counted)
    monkeypatch.setattr(chunks, "_FORECASTS", 16)
    swept(np.linspace(0, 1, 11), chunk=3)
    before = len(traces)
    swept(np.linspace(0, 1, 40), chunk=3)
    assert len(traces) == before > 0


@pytest.mark.parametrize(
    "kinds", [(np.float32,) * 2, (np.float32, float), (float, int)]
)
def test_starts_of_any_type_are_solved_in_double_precision(kinds):
    speeds = np.arange(12.0)  # exact in all types
    linkage, starts = pendulums(speeds)
    starts = fj.State(*(a.astype(kind) for a, kind in zip(starts, kinds)))
    motion = fj.sweep(linkage, starts, TS, chunk=4, **SETTINGS)
    expected = swept(speeds, chunk=4)
    for a, b in zip(*map(jax.tree.leaves, (motion, expected)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_cores_change_nothing(batch, clean, monkeypatch):
    """Chunks are the same ones, whatever the number of threads that send them."""
    for cores in (1, 3):
        monkeypatch.setattr(devices, "cores", lambda cores=cores: cores)
        motion = run(batch)
        for a, b in zip(*map(jax.tree.leaves, (motion, clean))):
            np.testing.assert_array_equal(a, b)


@pytest.fixture
def single_precision():
    """Has threads compute in single precision unless they ask for double."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


class Mixed(fj.Element):
    """A damper whose numbers are of any type."""

    coefficient: Any
    doubled: Any

    def __call__(self, t, q, qd, linkage):
        return -self.coefficient * (1 + self.doubled) * qd


@pytest.mark.slow
def test_numbers_of_any_type_are_taken_in_single_precision(single_precision):
    """NumPy's, of which some differ between members."""
    linkage, starts = pendulums(np.linspace(0, 1, 40))
    mixed = Mixed(np.repeat([0.5, 1.0], 20), np.int64(1))
    axes = (Mixed(0, None),)
    motion = fj.sweep(linkage, starts, TS, (mixed,), forces_axes=axes, chunk=20)
    alone = fj.sweep(linkage, starts, TS, (fj.JointDamper(2.0),), chunk=40)
    assert motion.q.dtype == np.float32 and successful(motion).all()
    np.testing.assert_allclose(motion.q[20:], alone.q[20:], atol=1e-4)


def test_cores_compute_in_the_precision_of_one_thread(monkeypatch, single_precision):
    monkeypatch.setattr(devices, "cores", lambda: 2)
    with jax.enable_x64(True):
        motion = swept(np.linspace(0, 1, 40), chunk=20)
    assert motion.q.dtype == np.float64 and successful(motion).all()


@pytest.fixture
def no_folder():
    """Has JAX keep no programs in the folder of the tests."""
    folder = jax.config.jax_compilation_cache_dir
    fj.configure(cache=False)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)
    compilation_cache.reset_cache()


@pytest.mark.slow
def test_cores_take_copies_of_a_program_unless_it_calls_python(no_folder, monkeypatch):
    monkeypatch.setattr(devices, "cores", lambda: 2)
    before = devices.compiled.cache_info().misses
    kind = jax.ShapeDtypeStruct((1,), float)
    call = lambda qd: jax.pure_callback(
        np.negative, kind, qd, vmap_method="expand_dims"
    )
    drag = lambda t, q, qd, linkage: call(qd)
    linkage, start = pendulums(np.linspace(0, 1, 40))
    options = dict(forces=(drag,), chunk=20, **SETTINGS)
    motion = fj.sweep(linkage, start, TS[:2], **options)
    # The forecast is of one chunk.
    assert devices.compiled.cache_info().misses == before + 1 + 2
    damped = fj.sweep(linkage, start, TS[:2], **options | dict(forces=(DAMPER,)))
    assert devices.compiled.cache_info().misses == before + 3 + 2
    np.testing.assert_allclose(motion.q, damped.q, atol=1e-12)


@pytest.mark.slow
def test_a_slow_member_is_stopped_and_solved_alone(solved):
    speeds = np.linspace(0, 1, LANES)
    speeds[20] = 60
    motion = swept(speeds)
    assert [len(q) for q, _ in solved] == [LANES, 1]
    np.testing.assert_array_equal(solved[1][1], [[60]])
    assert successful(motion).all()
    steps = np.asarray(motion.stats["num_steps"])
    assert steps[20] > 3 * np.delete(steps, 20).max()
    linkage, (q, qd) = pendulums(speeds)
    for member in (20, 21):
        alone = fj.simulate(linkage, fj.State(q[member], qd[member]), TS, **SETTINGS)
        np.testing.assert_allclose(motion.q[member], alone.q, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_members_out_of_steps_are_not_solved_again(solved):
    motion = swept(np.linspace(0, 1, LANES), max_steps=3)
    assert len(solved) == 1
    assert not successful(motion).any()
    assert (motion.stats["num_steps"] == 3).all()


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(configuration, "_WIDE", {"xla_cpu_no_such_option": 1})
    assert configuration.wide_vectors.__wrapped__() == {}


class Recorder(diffrax.NoProgressMeter):
    seen: list

    def step(self, state, progress):
        self.seen.append(float(progress))
        return state


def test_progress_rises_to_one(mixed):
    recorder = Recorder([])
    run(mixed, progress_meter=recorder)
    assert len(recorder.seen) >= len(mixed[1].q) // CHUNK
    assert 0 <= recorder.seen[0] < 1 and recorder.seen[-1] == 1
    assert (np.diff(recorder.seen) >= 0).all()


def test_other_values_need_no_new_trace(batch, clean, monkeypatch):
    calls = []
    free = formulation._term(False, False, False)

    def counted(*arguments):
        calls.append(1)
        return free.vector_field(*arguments)

    term = dataclasses.replace(free, vector_field=counted)
    monkeypatch.setattr(formulation, "_term", lambda *kind: term)
    linkage, (q, qd), forces = batch
    other = run((linkage, fj.State(q + 0.1, qd), forces))
    assert not calls
    assert not np.array_equal(other.q, clean.q)
    # Fewer members need no compilation either; a new number of times needs one.
    run(jax.tree.map(lambda a: a[:11], batch))
    assert not calls
    linkage, state0, forces = jax.tree.map(lambda a: a[0], batch)
    ts = np.linspace(0, 1, 4001)  # as many as in no other test
    jax.eval_shape(lambda q: fj.simulate(linkage, fj.State(q, q), ts), state0.q)
    assert calls


WORKER = """
import sys
import jax
import fdof_jax as fj
fj.configure(x64=True)
address, index, folder = sys.argv[1:]
jax.distributed.initialize(address, 2, int(index))
import numpy as np
import sweep_batch
assert (jax.device_count(), jax.local_device_count()) == (4, 2)
batch = sweep_batch.single_links()
solution = sweep_batch.run(batch, chunk=4)
sweep_batch.run(batch, chunk=4, store=folder + "/store", shard=int(index), of=2)
if hasattr(jax, "set_mesh"):
    lanes = jax.sharding.PartitionSpec("lanes")
    mesh = jax.sharding.Mesh(jax.local_devices(), ("lanes",))
    spread = jax.device_put(batch, jax.sharding.NamedSharding(mesh, lanes))
    with jax.set_mesh(mesh):
        same = sweep_batch.run(spread, chunk=4)
    np.testing.assert_array_equal(same.q, solution.q)
steps = solution.stats["num_steps"]
good = sweep_batch.successful(solution)
np.savez(f"{folder}/{index}.npz", q=solution.q, qd=solution.qd, steps=steps, good=good)
"""


@pytest.mark.slow
def test_more_devices_and_processes_change_nothing(tmp_path):
    """Uses two devices in each of two processes, and inputs spread over them."""
    clean = run(single_links())
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{port.getsockname()[1]}"
    here = Path(__file__).parent
    environment = os.environ | dict(
        JAX_PLATFORMS="cpu",
        JAX_NUM_CPU_DEVICES="2",
        PYTHONPATH=os.pathsep.join([str(here), str(here.parent)]),
    )
    workers = []
    try:
        for index in range(2):
            command = [sys.executable, "-c", WORKER, address, str(index), str(tmp_path)]
            pipe = subprocess.PIPE
            workers.append(subprocess.Popen(command, env=environment, stderr=pipe))
        for worker in workers:
            _, errors = worker.communicate(timeout=300)
            assert worker.returncode == 0, errors.decode()[-3000:]
    finally:
        for worker in workers:
            worker.kill()
    close = functools.partial(np.testing.assert_allclose, rtol=1e-8, atol=1e-8)
    for index in range(2):
        answer = np.load(tmp_path / f"{index}.npz")
        assert answer["good"].all()
        close(answer["q"], clean.q)
        close(answer["qd"], clean.qd, rtol=1e-7, atol=1e-7)
        close(answer["steps"], clean.stats["num_steps"], rtol=0, atol=5)
    with xarray.open_zarr(tmp_path / "store") as data:
        assert not data.failed.any()
        close(data.q, clean.q)
