from pathlib import Path

import pytest


def pytest_collection_modifyitems(items):
    """All but the fuzzer is slow: most scenes compile programs of their own."""
    for item in items:
        if item.path.parent == Path(__file__).parent and item.path.stem != "test_fuzz":
            item.add_marker(pytest.mark.slow)
