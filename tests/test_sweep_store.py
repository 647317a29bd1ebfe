"""A store keeps the results of a sweep in a Zarr group, in blocks, for any workers."""

import functools
import os
import re
import sys
import tracemalloc
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep_batch
import xarray
from sweep_batch import FAILED, SETTINGS, TS, read, run

import fdof_jax as fj
from fdof_jax.batches import store
from fdof_jax.batches.batch_axes import batch_of
from fdof_jax.batches.chunks import Common, Job

BLOCKS, BLOCK = 6, 7  # members


@pytest.fixture(scope="module", autouse=True)
def small_blocks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "_CHUNKS", 1)
        yield


@pytest.fixture(scope="module")
def undisturbed(mixed, small_blocks, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run(mixed, store=folder) == folder
    return read(folder)


@pytest.fixture
def stored(undisturbed, tmp_path):
    """Returns a copy of the undisturbed store."""
    for name, data in undisturbed.items():
        path = tmp_path / "copy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return tmp_path / "copy"


@pytest.fixture
def solved(monkeypatch):
    """Returns a list of the sizes of the blocks that are solved from here on."""
    sizes, original = [], store.in_chunks

    def recorded(job, **keywords):
        sizes.append(job.size)
        return original(job, **keywords)

    monkeypatch.setattr(store, "in_chunks", recorded)
    return sizes


def test_xarray_opens_it(mixed, stored, swept, undisturbed, solved):
    with xarray.open_zarr(stored) as data:
        assert data.q.dims == data.qd.dims == ("member", "time", "joint")
        assert (data.q.units, data.qd.units) == ("m or rad", "m/s or rad/s")
        assert (data.time.units, data.time_reached.units) == ("s", "s")
        np.testing.assert_array_equal(data.time, TS)
        assert "ts" not in data  # as all members have their times in common
        assert data.attrs["versions"]["fdof_jax"] == fj.__version__
        assert np.flatnonzero(data.failed).tolist() == FAILED
        words = np.array(data.outcome.flag_meanings.split())[data.outcome]
        assert [word.replace("_", " ") for word in words] == swept.outcome.tolist()
        for name in ("q", "qd"):
            found, expected = data[name].to_numpy(), getattr(swept, name)
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(data.num_steps, swept.stats["num_steps"], atol=5)
    run(mixed, store=str(stored))  # solves nothing again
    assert not solved and read(stored) == undisturbed


def test_shards_in_any_order(mixed, undisturbed, solved, tmp_path):
    for shard in (2, 0, 1):
        run(mixed, store=tmp_path, shard=shard, of=3)
        if shard == 0:
            with xarray.open_zarr(tmp_path) as data:  # -1 is not solved yet
                missing = np.flatnonzero(data.outcome == -1) // BLOCK
                assert set(missing) == {1, 4} and data.failed[BLOCK]
    run(mixed, store=tmp_path, shard=7, of=8)  # more workers than blocks
    assert len(solved) == BLOCKS and read(tmp_path) == undisturbed


# Rows: the files, what takes the place of their bytes, the warning, and how many blocks
# are solved again. Files that are exchanged take each other's bytes.
CUT, EMPTY = lambda data: data[:-1], lambda data: b""
FLIPPED = lambda data: data[:-1] + bytes([data[-1] ^ 1])
Q0, Q4, FAILED0, FAILED4 = "q/c/0/0/0", "q/c/4/0/0", "failed/c/0", "failed/c/4"
DAMAGES = [
    *(([name], change, re.escape(name), blocks) for name, change, blocks in (
        (Q4, FLIPPED, 1), ("outcome/c/2", CUT, 1), (FAILED4, EMPTY, 1),
        ("qd/zarr.json", FLIPPED, 0), ("time/c/0", CUT, 0), ("zarr.json", EMPTY, 0),
        ("zarr.json", FLIPPED, 0))),
    ([Q4], None, f"block 4, got {Q4} missing;", 1),
    ([FAILED4], None, None, 1),  # as of a block that was not finished
    (["digests/1"], None, "block 1, got digests/1 missing;", 1),
    *(([one, two], "exchanged", "block [04], got digests/[04] of other", 2)
      for one, two in ((Q0, Q4), (FAILED0, FAILED4))),
]  # fmt: skip


@pytest.mark.slow
def test_damage_is_named_and_solved_again(mixed, stored, undisturbed, solved):
    for files, change, words, blocks in DAMAGES:
        solved.clear()
        for file, other in zip(files, reversed(files)):
            if change is None:
                (stored / file).unlink()
            else:
                data = undisturbed[other]
                (stored / file).write_bytes(data if len(files) > 1 else change(data))
        if words is None:
            run(mixed, store=stored)
        else:
            with pytest.warns(RuntimeWarning, match=words) as warned:
                run(mixed, store=stored)
            assert {w.filename for w in warned} == {sweep_batch.__file__}
        assert solved == [BLOCK] * blocks, files
        assert read(stored) == undisturbed


@pytest.mark.parametrize("name", ["q/c/2/0/0", "failed/c/2", "qd/zarr.json"])
def test_a_folder_in_the_place_of_a_file(mixed, stored, solved, name):
    (stored / name).unlink()
    (stored / name).mkdir()
    with pytest.raises(ValueError, match=f"^store: expected a file .* folder .*{name}"):
        run(mixed, store=stored)
    assert not solved


@pytest.mark.parametrize("written", [0, 12, 30])
def test_a_run_that_ends_early(mixed, undisturbed, solved, tmp_path, written):
    replace, left = os.replace, iter(range(written))

    def until_full(*names):
        if next(left, None) is None:
            raise OSError("the disk is full")
        replace(*names)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", until_full)
        with pytest.raises(OSError, match="the disk is full"):
            run(mixed, store=tmp_path)
    # As a process leaves them that is killed
    for folder in [tmp_path, *filter(Path.is_dir, tmp_path.rglob("*"))]:
        (folder / "0.1.partial").write_text("{")
    run(mixed, store=tmp_path)
    found = read(tmp_path)
    assert {name: found[name] for name in undisturbed} == undisturbed
    assert len(solved) <= BLOCKS + 1


def end(scene, motion):
    new, none = jnp.array(True), motion.q[:0]
    return {"end": motion.q[-1], "result": motion.result, "is new": new, "none": none}


@pytest.mark.slow
def test_only_what_is_asked_for(mixed, stored, undisturbed, swept, tmp_path):
    folder = tmp_path / "reduced"
    with pytest.raises(RuntimeError, match="3 of 42 members failed.* member 3"):
        run(mixed, store=folder, reduce=end, throw=True)
    with xarray.open_zarr(folder) as data:
        assert {*data} == {"end", "result", "is_new", "none", "failed"}
        assert data.none.shape == (42, 0, 1)
        assert data.end.dims == ("member", "end_1")
        np.testing.assert_allclose(data.end, swept.q[:, -1], rtol=1e-6, atol=1e-6)
        assert np.flatnonzero(data.result).tolist() == FAILED
    # Another sweep needs another folder
    linkage, state0, forces = mixed
    moved = linkage, state0._replace(q=state0.q + 1e-9), forces
    for batch, options, what in (
        (moved, {}, "sweep"),
        (mixed, dict(chunk=4), "chunk"),
        (mixed, dict(max_steps=1499), "sweep"),
        (mixed, dict(reduce=end), "sweep"),
    ):
        words = f"^store: expected .*{re.escape(str(stored))}.*{what}"
        with pytest.raises(ValueError, match=words):
            run(batch, store=stored, **options)
    assert read(stored) == undisturbed


def opened(members, folder, like):
    moving, shared, size = batch_of(*members, 0)
    job = Job(moving, Common(shared, jnp.asarray(TS), {}, end), size, 8, [])
    return store.Store(folder, job, like, "digest")


def test_what_others_wrote_is_refused_and_kept(mixed, tmp_path):
    like, others = {"q": np.zeros(3)}, tmp_path / "others"
    xarray.Dataset({"q": ("member", np.arange(5.0))}).to_zarr(
        others, zarr_format=3, consolidated=False
    )
    for name in ("notes.txt", "zarr.json"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text("[]")
    for folder in others, tmp_path / "notes.txt", tmp_path / "zarr.json":
        before = read(folder)
        with pytest.raises(ValueError, match="^store: expected a new folder or one of"):
            opened(mixed, folder, like)
        assert read(folder) == before
    folder = tmp_path / "killed"
    folder.mkdir()
    (folder / "zarr.1.partial").write_text("{")
    opened(mixed, folder, like)
    (folder / "zarr.json").write_text("[" * 100_000)
    with pytest.warns(RuntimeWarning, match=f"in {folder / 'zarr.json'}"):
        opened(mixed, folder, like)


def test_refusals_come_before_anything_is_traced(mixed, tmp_path, monkeypatch):
    q = np.zeros(3)
    for like in ({"a b": q, "a.b": q}, {"a": q, "A": q}, {"Failed": q}):
        with pytest.raises(ValueError, match="^reduce: expected .*name"):
            opened(mixed, tmp_path, like)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("kept")
    with monkeypatch.context() as patch:
        patch.setattr("fdof_jax.batches.sweep.outline", None)
        for value in ("", "file", "file/below", Path("s3://bucket/x")):
            with pytest.raises(ValueError, match="^store: expected a folder.* got"):
                run(mixed, store=value)
    assert [*tmp_path.iterdir()] == [tmp_path / "file"]
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"zarr .* 'fdof_jax\[data\]'"):
        run(mixed, store=tmp_path)


# The digest of a sweep names what its functions compute, and all numbers in them.


def digest(reduce=lambda scene, motion: motion.q, force=lambda t, q, qd, linkage: q):
    linkage, state0, _ = jax.tree.map(lambda leaf: leaf[:2], sweep_batch.members())
    batch = batch_of(linkage, state0, (force,), None)
    settings = dict(SETTINGS, dt0=1e-3, adjoint=diffrax.RecursiveCheckpointAdjoint())
    common = Common(batch.shared, jnp.asarray(TS), settings, reduce)
    return store.outline(batch.moving, common)[1]


def times(factor):
    return lambda t, q, qd, linkage: factor * q


def in_scan(distance):
    jitted = jax.jit(lambda far, _: (distance(far), None))
    return lambda q: jax.lax.scan(jitted, q, None, length=2)[0]


@pytest.mark.slow
def test_it_names_what_functions_compute():
    two = jnp.full(1, 2.0)
    digests = {digest(force=times(k)) for k in (2.0, 3.0, two, two + 1)}
    assert len(digests) == 4 and digest(force=times(2.0)) in digests
    # Arrays within compiled functions count
    for jit in (eqx.filter_jit, in_scan):
        found = set()
        for target in np.zeros(1), np.full(1, 5.0):
            away = jit(lambda q, target=target: q - target)
            found.add(digest(lambda scene, motion, away=away: away(motion.q[-1])))
            found.add(digest(force=lambda t, q, qd, linkage, away=away: away(q)))
        assert len(found) == 4


def test_functions_that_only_python_can_call_are_refused(tmp_path):
    """They have no digest. Checks and prints change no result."""

    def called(t, q, qd, linkage):
        return jax.pure_callback(np.sin, q, q, vmap_method="sequential")

    def checked(scene, motion):
        jax.debug.print("{}", motion.q[0])
        return eqx.error_if(motion.q, motion.q > 1, "far")

    assert digest(checked) == digest(checked)
    linkage, state0, _ = sweep_batch.members()
    with pytest.raises(ValueError, match="^store: expected .*only Python.*sin"):
        fj.sweep(linkage, state0, TS, (called,), store=tmp_path, **SETTINGS)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_each_member_is_in_its_own_row_and_few_are_held_in_memory(
    tmp_path, monkeypatch
):
    """The fastest members are expected to take longest, and solved first.

    Chunks whose first and last rows are as far apart as if all were in order, too.
    """
    arm = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
    folders, ts = map(tmp_path.joinpath, "abcd"), np.linspace(0, 0.3, 5000)
    sweep = functools.partial(fj.sweep, arm, ts=ts, chunk=3, **SETTINGS)
    monkeypatch.setattr(store, "_CHUNKS", 16)
    for order in ([0, 5, 2, 1, 3, 4], [3, 0, 5, 2, 1, 4], [5, 0, 3, 4, 2, 1]):
        speeds = np.zeros((6, 1))
        speeds[order, 0] = np.arange(9, 3, -1)
        start = fj.State(0 * speeds, speeds)
        with xarray.open_zarr(sweep(start, store=next(folders))) as stored:
            np.testing.assert_array_equal(stored.qd[:, 0], speeds)
            np.testing.assert_array_equal(stored.q, sweep(start).q)
    speeds = np.linspace(3, 9, 600)[:, None]
    tracemalloc.start()
    with xarray.open_zarr(sweep((0 * speeds, speeds), store=next(folders))) as stored:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        np.testing.assert_array_equal(stored.qd[:, 0], speeds)
        assert peak < (stored.q.nbytes + stored.qd.nbytes) / 2
