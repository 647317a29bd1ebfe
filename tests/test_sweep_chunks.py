"""How a sweep cuts its members into chunks, and what it compiles for them."""

import sys

import diffrax
import jax
import numpy as np
import pytest
from sweep_batch import SETTINGS, TS, run, successful

import fdof_jax as fj
from fdof_jax.base import configuration
from fdof_jax.batches import chunk_programs, chunks, forecast
from fdof_jax.batches.batch_axes import batch_of

LANES = 64  # enough for a slow member to be stopped
PENDULUM = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])


@pytest.fixture
def solved(monkeypatch):
    """Returns a list of the starts of the chunks in each call from here on."""
    found = []
    original = chunks._solve

    def recorded(program, count, chosen, moving, arrays):
        found.append([np.asarray(leaf) for leaf in moving])
        return original(program, count, chosen, moving, arrays)

    monkeypatch.setattr(chunks, "_solve", recorded)
    return found


def pendulums(speeds):
    """Returns pendulums that start level, at these speeds."""
    qd = np.reshape(speeds, (-1, 1))
    return PENDULUM, fj.State(np.zeros_like(qd), qd)


def swept(speeds, **keywords):
    return fj.sweep(*pendulums(speeds), TS, **{**SETTINGS, **keywords})


def test_small_batches_of_many_sizes_share_a_program(solved):
    speeds = np.linspace(0, 1, 8)
    swept(speeds)
    before = chunk_programs.compiled.cache_info().misses
    for size in (2, 5, 7):
        assert swept(speeds[:size]).q.shape == (size, len(TS), 1)
    assert chunk_programs.compiled.cache_info().misses == before
    assert [len(q) for q, _ in solved] == [8] * 4


def test_a_batch_of_one_chunk_needs_no_forecast(monkeypatch):
    monkeypatch.setattr(chunks, "work_of_chunks", None)
    assert successful(swept(np.linspace(0, 1, 8))).all()


@pytest.mark.parametrize(
    "cores, calls",
    [
        (1, [[11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0]]),
        (2, [[11, 10, 9, 8, 3, 2, 1, 0], [7, 6, 5, 4]]),
    ],
)
def test_members_are_shared_out_by_their_forecast(solved, monkeypatch, cores, calls):
    """Each core gets one call for chunks of members that take about equally long."""
    monkeypatch.setattr(chunks, "_cores", lambda: cores)
    speeds = 3 * np.array([0.0, 9, 1, 8, 2, 7, 3, 6, 4, 5, 10, 11])
    motion = swept(speeds, chunk=4)
    np.testing.assert_array_equal(motion.qd[:, 0, 0], speeds)
    found = [set(qd[:, 0] / 3) for _, qd in solved]
    assert sorted(map(sorted, found)) == sorted(map(sorted, calls))


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


def test_long_records_are_solved_chunk_by_chunk(solved, monkeypatch):
    """So do runs that show their progress; a call of many chunks needs more memory."""
    monkeypatch.setattr(chunks, "_cores", lambda: 1)
    speeds, both = np.linspace(0, 1, 8), dict(chunk=4)
    seen = diffrax.TextProgressMeter()
    swept(speeds, **both)
    swept(speeds, **both, progress_meter=seen)
    monkeypatch.setattr(chunks, "_STATES", 4 * len(TS))
    swept(speeds, **both)
    assert [len(q) for q, _ in solved] == [32, 32, 32, 4, 4]


def test_cores_change_nothing(batch, monkeypatch):
    """Chunks are the same ones, whatever the number of threads that send them."""
    motions = []
    for cores in (1, 3):
        monkeypatch.setattr(chunks, "_cores", lambda cores=cores: cores)
        motions.append(run(batch))
    for a, b in zip(*map(jax.tree.leaves, motions)):
        np.testing.assert_array_equal(a, b)


def test_only_chunks_that_nothing_keeps_depend_on_the_cores(monkeypatch, tmp_path):
    sizes = {}
    for cores in (1, 2):
        monkeypatch.setattr(chunks, "_cores", lambda cores=cores: cores)
        sizes[cores] = [chunks.usual_chunk(anywhere=same) for same in (False, True)]
    assert sizes == {1: [128, 128], 2: [256, 128]}
    asked = []

    def usual_chunk(anywhere):
        asked.append(anywhere)
        return 8

    module = sys.modules["fdof_jax.batches.sweep"]
    monkeypatch.setattr(module, "usual_chunk", usual_chunk)
    speeds = np.linspace(0, 1, 8)
    for keywords in ({}, {"checkpoint": tmp_path / "a"}, {"store": tmp_path / "b"}):
        swept(speeds, **keywords)
    assert asked == [False, True, True]


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


def test_members_out_of_steps_are_not_solved_again(solved):
    motion = swept(np.linspace(0, 1, LANES), max_steps=3)
    assert len(solved) == 1
    assert not successful(motion).any()
    assert (motion.stats["num_steps"] == 3).all()


def test_times_in_common_are_not_copied():
    times = swept(np.linspace(0, 1, 8)).ts
    assert times.strides[0] == 0
    np.testing.assert_array_equal(times, np.tile(TS, (8, 1)))


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(configuration, "_WIDE", {"xla_cpu_no_such_option": 1})
    assert configuration.wide_vectors.__wrapped__() == {}


def test_the_forecast_follows_the_steps(batch, clean):
    steps = np.asarray(clean.stats["num_steps"])
    moving, shared = batch_of(*batch, 0).split()
    found = forecast.expected_work(jax.numpy.asarray(TS), moving, shared)
    assert np.corrcoef(found, steps)[0, 1] > 0.75


def test_one_forecast_serves_batches_of_all_sizes():
    misses = lambda: chunk_programs.work_of_chunks.cache_info().misses
    before = misses()
    swept(np.linspace(0, 1, 11), chunk=3)
    assert misses() == before + 1
    swept(np.linspace(0, 1, 40), chunk=3)  # of more than one block
    swept(np.linspace(0, 1, 11), chunk=3, reduce=lambda motion: motion.q[-1])
    assert misses() == before + 1
