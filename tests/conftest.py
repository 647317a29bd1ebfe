from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

HARD = Path(__file__).parent / "hard"
# Scripts that need more than the tests do.
collect_ignore_glob = ["hard/make_*.py"]


def pytest_collection_modifyitems(items):
    """The hard scenes are slow, as most compile programs of their own."""
    for item in items:
        if item.path.parent == HARD and item.path.stem != "test_fuzz":
            item.add_marker(pytest.mark.slow)
