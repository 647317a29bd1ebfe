"""Workers that are killed at random moments leave a store like an undisturbed one."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from chains import random_chain
from sweep_batch import read

import fdof_jax as fj
from fdof_jax.batches import store
from fdof_jax.batches.batch_axes import batch_of
from fdof_jax.batches.chunks import Common, Job, Outcome

KILLS, WORKERS, BLOCKS = 20, 3, 1500


def made(job, on_device):
    """Stands for solving, during which a kill leaves nothing behind."""
    _, (q, _), _ = job.moving
    return Outcome({"q": q * np.arange(100)}, None, q[:, 0] > 0.5)


def fill(folder, shard, begun):
    """Writes every third block of a store, each of one member."""
    fj.configure(x64=True)
    store._CHUNKS, store.in_chunks = 1, made
    q, ts = np.linspace(0, 1, BLOCKS)[:, None], jnp.zeros(1)
    linkage = random_chain("R", np.random.default_rng(1))
    batch = batch_of(linkage, fj.State(q, q), (), None)
    common = Common(batch.shared, ts, {}, lambda motion: motion)
    job = Job(batch.moving, common, batch.size, 1, [])
    group = store.Store(folder, job, {"q": np.zeros(100)}, "digest")
    blocks = range(shard, group.count, WORKERS)
    begun.set()
    store.in_store(group, blocks, job, diffrax.NoProgressMeter())


@pytest.mark.slow
def test_twenty_kills_at_random_moments(tmp_path, monkeypatch):
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent)])
    monkeypatch.setenv("PYTHONPATH", path)  # of the process that imports this module
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])

    def start(folder, shard):
        folder.mkdir(exist_ok=True)
        begun = context.Event()
        worker = context.Process(target=fill, args=(folder, shard, begun))
        worker.start()
        assert begun.wait(100)
        return worker

    rng, kills = np.random.default_rng(7), 0
    workers = [start(shared, shard) for shard in range(WORKERS)]
    try:
        while kills < KILLS:
            time.sleep(rng.uniform(0, 0.1))
            shard = rng.integers(WORKERS)
            workers[shard].kill()
            workers[shard].join()
            if workers[shard].exitcode == -signal.SIGKILL:
                kills += 1
            else:  # it had ended, and is to write its blocks again
                for block in range(shard, BLOCKS, WORKERS):
                    (shared / f"failed/c/{block}").unlink()
            workers[shard] = start(shared, shard)
        workers += [start(alone, shard) for shard in range(WORKERS)]
        for worker in workers:
            worker.join()
            assert worker.exitcode == 0
    finally:
        for worker in workers:
            worker.kill()
    found, undisturbed = read(shared), read(alone)
    assert len(undisturbed) > 2 * BLOCKS
    assert {name: found[name] for name in undisturbed} == undisturbed
    others = found.keys() - undisturbed.keys()
    assert all(name.endswith((".partial", ".part")) for name in others)
