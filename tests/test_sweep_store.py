"""A store keeps the results of a sweep in a Zarr group, in blocks, for any workers."""

import functools
import os
import re
import subprocess
import sys
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweep_batch
import xarray
from helpers import programs
from sweep_batch import FAILED, SETTINGS, TS, read, run, single_links

import fdof_jax as fj
from fdof_jax.base.whole_files import folder_path
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
    sizes = []
    original = store.in_chunks

    def recorded(job, **keywords):
        sizes.append(job.size)
        return original(job, **keywords)

    monkeypatch.setattr(store, "in_chunks", recorded)
    return sizes


def end(scene, motion):
    new, none = jnp.array(True), motion.q[:0]
    return {"end": motion.q[-1], "result": motion.result, "is new": new, "none": none}


def test_xarray_opens_it(stored, swept):
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


def test_it_is_solved_once(mixed, stored, undisturbed, solved):
    run(mixed, store=str(stored))
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


DAMAGES = {
    "empty": lambda data: b"",
    "cut": lambda data: data[:-1],
    "longer": lambda data: data + b"0",
    "flipped": lambda data: data[:-1] + bytes([data[-1] ^ 1]),
    "halved": lambda data: data[::2],
}
FILES = ["q/c/2/0/0", "outcome/c/2", "failed/c/2", "qd/zarr.json", "time/c/0"]


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_named_and_solved_again(mixed, stored, undisturbed, solved, damage):
    for name in (*FILES, "zarr.json"):
        (stored / name).write_bytes(DAMAGES[damage](undisturbed[name]))
        with pytest.warns(RuntimeWarning, match=re.escape(name)) as warned:
            run(mixed, store=stored)
        assert {w.filename for w in warned} == {sweep_batch.__file__}
        assert read(stored) == undisturbed
    assert solved == [BLOCK] * 3


def test_files_that_are_missing(mixed, stored, undisturbed, solved):
    (stored / "q/c/4/0/0").unlink()
    with pytest.warns(RuntimeWarning, match="block 4, got q/c/4/0/0 missing;"):
        run(mixed, store=stored)
    (stored / "failed/c/3").unlink()  # as of a block that was not finished
    run(mixed, store=stored)
    (stored / "digests/1").unlink()
    with pytest.warns(RuntimeWarning, match="block 1, got digests/1 missing;"):
        run(mixed, store=stored)
    assert len(solved) == 3 and read(stored) == undisturbed


@pytest.mark.parametrize("name", ["q/c/{}/0/0", "failed/c/{}"])
def test_files_that_changed_places(mixed, stored, undisturbed, solved, name):
    files = [name.format(block) for block in (0, 4)]
    for file, other in zip(files, reversed(files)):
        (stored / file).write_bytes(undisturbed[other])
    with pytest.warns(RuntimeWarning, match="block [04], got digests/[04] of other"):
        run(mixed, store=stored)
    assert solved == [BLOCK] * 2 and read(stored) == undisturbed


@pytest.mark.parametrize("name", ["q/c/2/0/0", "failed/c/2", "qd/zarr.json"])
def test_a_folder_in_the_place_of_a_file(mixed, stored, solved, name):
    (stored / name).unlink()
    (stored / name).mkdir()
    with pytest.raises(ValueError, match=f"^store: expected a file .* folder .*{name}"):
        run(mixed, store=stored)
    assert not solved


@pytest.mark.parametrize("written", [0, 1, 12, 20, 30, 50])
def test_a_run_that_ends_early(
    mixed, undisturbed, solved, tmp_path, monkeypatch, written
):
    original, count = os.replace, []

    def stop(*names):
        count.append(names)
        if len(count) > written:
            raise OSError("the disk is full")
        original(*names)

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(OSError, match="the disk is full"):
        run(mixed, store=tmp_path)
    monkeypatch.setattr(os, "replace", original)
    run(mixed, store=tmp_path)
    assert read(tmp_path) == undisturbed
    assert len(solved) <= BLOCKS + 1


@pytest.mark.slow
def test_another_sweep_needs_another_folder(mixed, stored, undisturbed):
    linkage, state0, forces = mixed
    moved = linkage, state0._replace(q=state0.q + 1e-9), forces
    for batch, options, what in (
        (moved, {}, "sweep"),
        (mixed, dict(chunk=4), "chunk"),
        (mixed, dict(max_steps=1499), "sweep"),
        (mixed, dict(reduce=end), "sweep"),
    ):
        with pytest.raises(
            ValueError, match=f"^store: expected .*{re.escape(str(stored))}.*{what}"
        ):
            run(batch, store=stored, **options)
    assert read(stored) == undisturbed


def job_of(members):
    moving, shared, size = batch_of(*members, 0)
    return Job(moving, Common(shared, jnp.asarray(TS), {}, end), size, 8, [])


def test_what_others_wrote_is_refused_and_kept(mixed, tmp_path):
    data = xarray.Dataset({"q": ("member", np.arange(5.0))})
    contents = {
        "three": lambda folder: data.to_zarr(folder, zarr_format=3, consolidated=False),
        "two": lambda folder: data.to_zarr(folder, zarr_format=2),
        "list": lambda folder: (folder / "zarr.json").write_text("[]"),
        "folder": lambda folder: (folder / "zarr.json").mkdir(),
        "notes": lambda folder: (folder / "notes.txt").write_text("mine"),
        "killed": lambda folder: (folder / "zarr.1.partial").write_text("{"),
        "damaged": lambda folder: (folder / "zarr.json").write_text("[" * 100_000),
    }
    arguments = job_of(mixed), {"q": np.zeros(3)}, "digest"
    for name, write in contents.items():
        folder = tmp_path / name
        folder.mkdir()
        write(folder)
        before = read(folder)
        if name == "killed":
            store.Store(folder, *arguments)
        elif name == "damaged":
            with pytest.warns(RuntimeWarning, match=f"in {folder / 'zarr.json'}"):
                store.Store(folder, *arguments)
        else:
            with pytest.raises(ValueError, match="^store: expected a (new|file)"):
                store.Store(folder, *arguments)
            assert read(folder) == before


@pytest.mark.slow
def test_only_what_is_asked_for(mixed, swept, tmp_path):
    run(mixed, store=tmp_path, reduce=end)
    with xarray.open_zarr(tmp_path) as data:
        assert {*data} == {"end", "result", "is_new", "none", "failed"}
        assert data.none.shape == (42, 0, 3)
        assert data.end.dims == ("member", "end_1")
        np.testing.assert_allclose(data.end, swept.q[:, -1], rtol=1e-6, atol=1e-6)
        assert np.flatnonzero(data.result).tolist() == FAILED
    with pytest.raises(RuntimeError, match="3 of 42 members failed.* member 3"):
        run(mixed, store=tmp_path, reduce=end, throw=True)


def test_names_of_parts_differ_in_letters(mixed, tmp_path):
    q = np.zeros(3)
    for like in ({"a b": q, "a.b": q}, {"a": q, "A": q}, {"Failed": q}):
        with pytest.raises(ValueError, match="^reduce: expected .*name"):
            store.Store(tmp_path, job_of(mixed), like, "digest")


def test_zarr_is_asked_for(mixed, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"zarr .* 'fdof_jax\[data\]'"):
        run(mixed, store=tmp_path)


def test_what_cannot_be_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("kept")
    linkage, states = fj.scenes.fig5().linkage, fj.State(np.zeros((2, 3)), np.zeros(3))
    # Refused before anything is traced
    monkeypatch.setattr(sys.modules["fdof_jax.batches.sweep"], "outline", None)
    for value, words in (
        ("", "a folder, got ''"),
        ("file", "can be written, got 'file': File exists"),
        ("file/below", "can be written, got 'file/below': Not a directory"),
        ("a\0b", "a folder, got"),
        ("s3://bucket/x", "a folder on this machine, no address, got"),
        (Path("s3://bucket/x"), "a folder on this machine, no address, got"),
    ):
        with pytest.raises(ValueError, match=f"^store: expected .*{words}"):
            fj.sweep(linkage, states, [0, 1], store=value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert folder_path("store", "~/kept") == tmp_path / "kept"
    assert (tmp_path / "kept").is_dir()


# The digest of a sweep names what its functions compute, and all numbers in them.


@functools.cache
def two_links():
    return jax.tree.map(lambda leaf: leaf[:2], single_links())


def digest(reduce=lambda scene, motion: motion.q, force=lambda t, q, qd, linkage: q):
    linkage, state0, _ = two_links()
    batch = batch_of(linkage, state0, (force,), None)
    settings = dict(SETTINGS, dt0=1e-3, adjoint=diffrax.RecursiveCheckpointAdjoint())
    common = Common(batch.shared, jnp.asarray(TS), settings, reduce)
    return store.outline(batch.moving, common)[1]


def times(factor):
    return lambda t, q, qd, linkage: factor * q


@pytest.mark.slow
def test_it_names_what_functions_compute():
    assert digest(force=times(2.0)) == digest(force=times(2.0))
    assert digest(force=times(2.0)) != digest(force=times(3.0))
    two, three = jnp.full(1, 2.0), jnp.full(1, 3.0)
    assert digest(force=times(two)) != digest(force=times(three))
    assert digest() != digest(lambda scene, motion: motion.q + 1)


def in_scan(distance):
    jitted = jax.jit(lambda far, _: (distance(far), None))
    return lambda q: jax.lax.scan(jitted, q, None, length=2)[0]


@pytest.mark.slow
@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit, in_scan])
def test_arrays_within_compiled_functions_count(jit):
    def distance(target):
        return jit(lambda q: q - target)

    def reduction(target):
        return lambda scene, motion: distance(target)(motion.q[-1])

    def force(target):
        return lambda t, q, qd, linkage: distance(target)(q)

    far, near = np.full(1, 5.0), np.zeros(1)
    pairs = (near, near), (far, near), (near, far)
    assert len({digest(reduction(a), force(b)) for a, b in pairs}) == 3


def test_functions_that_only_python_can_call_are_refused(tmp_path):
    """They have no digest. Checks and prints change no result."""

    def called(t, q, qd, linkage):
        return jax.pure_callback(np.sin, q, q, vmap_method="sequential")

    def checked(scene, motion):
        jax.debug.print("{}", motion.q[0])
        return eqx.error_if(motion.q, motion.q > 1, "far")

    assert digest(checked) == digest(checked)
    linkage, state0, _ = two_links()
    with pytest.raises(ValueError, match="^store: expected .*only Python.*sin"):
        fj.sweep(linkage, state0, TS, (called,), store=tmp_path, **SETTINGS)
    assert not any(tmp_path.iterdir())


# With one core, as each thread has a stack of its own. The first sweep compiles.
LIMITED = """
import os
import resource
import sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import fdof_jax as fj
from chains import random_chain
from sweep_batch import SETTINGS
linkage, ts = random_chain("R", np.random.default_rng(1)), np.linspace(0, 0.1, 3200)
def run(members, **keywords):
    q = np.linspace(-1, 1, members)[:, None]
    return fj.sweep(linkage, fj.State(q, 0 * q), ts, chunk=128, **SETTINGS, **keywords)
stores = sys.argv[1:]
run(256, **({"store": stores[0]} if stores else {}))
with open("/proc/self/status") as status:
    (used,) = (line.split()[1] for line in status if line.startswith("VmData"))
most = 1024 * int(used) + 240 * 2**20
resource.setrlimit(resource.RLIMIT_DATA, (most, most))
try:
    run(6400, **({"store": stores[1]} if stores else {}))
except MemoryError:
    print("MemoryError")
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_results_beyond_the_memory_go_to_a_store(tmp_path):
    """Its results are 330 MB, and 240 MB are left."""

    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent)])
    environment = os.environ | programs() | {"PYTHONPATH": path}

    def printed(*stores):
        command = [sys.executable, "-c", LIMITED, *map(str, stores)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    assert printed() == "MemoryError\n"
    assert printed(tmp_path / "few", tmp_path / "all") == ""
    with xarray.open_zarr(tmp_path / "all") as data:
        assert data.q.nbytes + data.qd.nbytes > 320e6
        assert not data.failed.any()
        np.testing.assert_allclose(data.q[:, 0, 0], np.linspace(-1, 1, 6400))


@pytest.mark.slow
def test_each_member_is_in_its_own_row_in_whatever_order_they_are_solved(
    tmp_path, monkeypatch
):
    """Chunks whose first and last rows are as far apart as if all were in order, too.

    The fastest members are expected to take longest, and solved first.
    """
    monkeypatch.setattr(store, "_CHUNKS", 16)
    orders = [0, 5, 2, 1, 3, 4], [3, 0, 5, 2, 1, 4], [5, 0, 3, 4, 2, 1]
    arm = fj.scenes.double_pendulum().linkage
    for number, order in enumerate(orders):
        speeds = np.zeros((6, 2))
        speeds[order, 0] = np.arange(9, 3, -1)
        start = fj.State(np.zeros((6, 2)), speeds)
        one = functools.partial(fj.sweep, arm, start, [0, 0.3], chunk=3)
        with xarray.open_zarr(one(store=tmp_path / str(number))) as stored:
            np.testing.assert_array_equal(stored.qd[:, 0], speeds)
            np.testing.assert_array_equal(stored.q, one().q)
