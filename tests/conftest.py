import os
from pathlib import Path

import jax
import pytest
import sweep_batch

# Most of the tests' time is compilation, which XLA's older code generator shortens by a
# quarter. Programs of `test_float32` are compiled as XLA does by default.
FLAGS = os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = f"{FLAGS} --xla_cpu_use_fusion_emitters=false".strip()

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

HARD = Path(__file__).parent / "hard"
# Scripts that need more than the tests do.
collect_ignore_glob = ["hard/make_*.py"]


# Sweeps that several files look at.


@pytest.fixture(scope="session")
def batch():
    return sweep_batch.members()


@pytest.fixture(scope="session")
def clean(batch):
    return sweep_batch.run(batch)


@pytest.fixture(scope="session")
def mixed(batch):
    return sweep_batch.with_failures(batch)


@pytest.fixture(scope="session")
def swept(mixed):
    return sweep_batch.run(mixed)


def pytest_collection_modifyitems(items):
    """The hard scenes are slow, as most compile programs of their own."""
    for item in items:
        if item.path.parent == HARD and item.path.stem != "test_fuzz":
            item.add_marker(pytest.mark.slow)
