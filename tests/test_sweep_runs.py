"""Runs of a sweep: checkpoints, progress, devices, processes, compilations."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import numpy as np
import pytest
import sweep_batch
import xarray
from sweep_batch import CHUNK, run

import fdof_jax as fj
from fdof_jax.base.checks import is_traced
from fdof_jax.batches import chunks
from fdof_jax.simulation import prescribed

# Checkpoints


@pytest.fixture
def solved(monkeypatch):
    """Returns a list of the chunks solved from here on; traced calls are left out."""
    found = []
    original = chunks._solve

    def recorded(*arguments):
        if not is_traced(arguments):
            found.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(chunks, "_solve", recorded)
    return found


def test_a_checkpoint_spares_finished_chunks(mixed, swept, solved, tmp_path):
    folder = tmp_path / "new" / "folder"
    first = run(mixed, checkpoint=folder)
    saved = sorted(folder.iterdir())
    assert len(saved) == len(solved) > len(first.q) // CHUNK
    assert {file.suffix for file in saved} == {".chunk"}
    solved.clear()

    again = run(mixed, checkpoint=str(folder))
    assert not solved
    assert jax.tree.structure(again) == jax.tree.structure(first)
    for a, b, c in zip(*map(jax.tree.leaves, (again, first, swept))):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)

    saved[2].unlink()
    again = run(mixed, checkpoint=folder)
    assert len(solved) == 1
    assert sorted(folder.iterdir()) == saved
    np.testing.assert_array_equal(again.q, first.q)


def test_a_checkpoint_serves_no_other_sweep(batch, clean, solved, tmp_path):
    linkage, (q, qd), (push,) = batch
    run(batch, checkpoint=tmp_path)
    chunks = len(solved)
    solved.clear()
    moved = linkage, fj.State(q, qd + 1e-9), (push,)
    other = run(moved, checkpoint=tmp_path)
    assert len(solved) == chunks
    assert not np.array_equal(other.q, clean.q)


def test_a_checkpoint_may_be_of_another_chunk(solved, tmp_path):
    """Checks that chunks of 8 members ignore earlier checkpoints of single members."""
    links = jax.tree.map(lambda a: a[:CHUNK], sweep_batch.single_links())
    ones = run(links, checkpoint=tmp_path, chunk=1)
    solved.clear()
    eights = run(links, checkpoint=tmp_path)
    assert solved
    np.testing.assert_allclose(ones.q, eights.q, rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(eights.q, run(links).q)


# Progress, devices, compilations


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


WORKER = """
import os
import sys
import jax
import fdof_jax as fj
fj.configure(x64=True)
address, processes, index, devices, path = sys.argv[1:]
if int(processes) > 1:
    jax.distributed.initialize(address, int(processes), int(index))
import numpy as np
import sweep_batch
assert jax.device_count() == int(devices)
batch = sweep_batch.single_links()
solution = sweep_batch.run(batch, chunk=4)
if hasattr(jax, "set_mesh"):
    mesh = jax.make_mesh((int(devices),), ("lanes",))
    lanes = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("lanes"))
    parts = lambda a: jax.make_array_from_callback(a.shape, lanes, lambda i: a[i])
    even = len(batch[1].q) // int(devices) * int(devices)
    spread = jax.tree.map(lambda a: parts(np.asarray(a)[:even]), batch)
    with jax.set_mesh(mesh):
        same = sweep_batch.run(spread, chunk=4)
        sweep_batch.run(spread, chunk=4, store=os.path.dirname(path) + "/store")
    np.testing.assert_allclose(same.q, solution.q[:even], rtol=1e-8, atol=1e-8)
# Each process has a folder of its own, in which only the first one writes.
for _ in range(2):
    again = sweep_batch.run(batch, chunk=4, checkpoint=path + ".chunks")
    np.testing.assert_array_equal(again.q, solution.q)
steps = solution.stats["num_steps"]
good = sweep_batch.successful(solution)
np.savez(path, q=solution.q, qd=solution.qd, steps=steps, good=good)
"""


def workers(folder, processes, devices):
    """Returns the results of several processes, each of which sees all devices."""
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{port.getsockname()[1]}"
    here = Path(__file__).parent
    env = dict(
        os.environ,
        JAX_PLATFORMS="cpu",
        JAX_NUM_CPU_DEVICES=str(devices // processes),
        PYTHONPATH=os.pathsep.join([str(here), str(here.parent)]),
    )
    started, answers = [], []
    try:
        for index in range(processes):
            path = folder / f"{index}.npz"
            arguments = [address, processes, index, devices, path]
            command = [sys.executable, "-c", WORKER, *map(str, arguments)]
            started.append(
                (path, subprocess.Popen(command, env=env, stderr=subprocess.PIPE))
            )
        for path, process in started:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, errors.decode()[-3000:]
            answers.append(np.load(path))
    finally:
        for _, process in started:
            process.kill()
    return answers


@pytest.mark.slow
def test_more_devices_and_processes_change_nothing(tmp_path):
    """Uses two devices in each of two processes, and inputs spread over them."""
    clean = run(sweep_batch.single_links())
    for answer in workers(tmp_path, processes=2, devices=4):
        assert answer["good"].all()
        np.testing.assert_allclose(answer["q"], clean.q, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(answer["qd"], clean.qd, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(
            answer["steps"], clean.stats["num_steps"], rtol=0, atol=5
        )
    if hasattr(jax, "set_mesh"):
        with xarray.open_zarr(tmp_path / "store") as data:
            even = clean.q[: len(data.q)]
            np.testing.assert_allclose(data.q, even, rtol=1e-8, atol=1e-8)


def test_other_values_need_no_new_trace(batch, clean, monkeypatch):
    calls = []
    original = prescribed.vector_field

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(prescribed, "vector_field", counted)
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
