"""A sweep whose results exceed the memory is finished by a store."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from helpers import programs

# With one core, as each thread has a stack of its own. The first sweep compiles.
WORKER = """
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
        command = [sys.executable, "-c", WORKER, *map(str, stores)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    assert printed() == "MemoryError\n"
    assert printed(tmp_path / "few", tmp_path / "all") == ""
    with xarray.open_zarr(tmp_path / "all") as data:
        assert data.q.nbytes + data.qd.nbytes > 320e6
        assert not data.failed.any()
        np.testing.assert_allclose(data.q[:, 0, 0], np.linspace(-1, 1, 6400))
