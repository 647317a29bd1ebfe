"""Arms, motions and what is read from figures, for tests of pictures and pages."""

from typing import Any

import diffrax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes

from fdof_jax import Linkage, Solution

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def tidy():
    """Checks that every figure is closed and that global settings are unchanged."""
    before = dict(matplotlib.rcParams)
    yield
    plt.close("all")
    assert dict(matplotlib.rcParams) == before


def make_linkage(topology):
    return Linkage(
        topology, length=[0.3, 1, 0.8, 0.6], com=[[0.5, 0.1], [0.4, -0.2], [0.3, 0]],
        mass=[2, 1, 1], inertia=[0.1, 0.1, 0.1], base_angle=0.4,
        locked=[0.2 if kind == "R" else 0.7 for kind in topology],
    )  # fmt: skip


def made_up(ts, q, qd=None) -> Solution:
    """Returns a solution without a solve; figures use only times and joint states."""
    q = jnp.asarray(q, dtype=float)
    qd = jnp.zeros_like(q) if qd is None else jnp.asarray(qd, dtype=float)
    done = diffrax.RESULTS.successful
    return Solution(jnp.asarray(ts, dtype=float), q, qd, {}, done)


def swinging(count=101, end=1.0) -> Solution:
    ts = np.linspace(0, end, count)
    q = np.stack([0.3 + 0.1 * ts, 0.4 + 0.2 * np.sin(ts), 0.5 - 0.3 * ts], axis=1)
    return made_up(ts, q, np.gradient(q, ts, axis=0))


LINKAGE, SOLUTION = make_linkage("RRR"), swinging(5)
Q = np.array([0.3, 0.4, -0.5])


def lines(ax: Axes) -> dict[Any, Any]:
    return {line.get_gid(): line for line in ax.lines if line.get_gid()}


def labels(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def named(ax: Axes, name: str) -> list[Any]:
    return [line for line in ax.lines if line.get_gid() == name]


def same(line, points):
    """Checks the corners of a line (point, 2)."""
    np.testing.assert_allclose(line.get_xydata(), points, atol=1e-12)


def values(ax: Axes) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata()) for line in ax.lines]


def tops(ax: Axes, ts) -> dict[str, np.ndarray]:
    """Returns the upper edge of each band of a stack."""
    edges = {}
    for band in ax.collections:
        x, y = band.get_paths()[0].vertices.T
        edges[band.get_label()] = np.array([y[x == t].max() for t in ts])
    return edges
