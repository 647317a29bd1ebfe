"""Detects mass matrices that are singular, always or in some configurations."""

import warnings
from typing import TYPE_CHECKING

import jax
import numpy as np

from .frames import frames
from .topology import real_joints

if TYPE_CHECKING:
    from .linkage import Linkage

# Below this, eigenvalues of a matrix with a diagonal of ones are rounding errors.
_SINGULAR = 1e-14


def _least_inertia(linkage: "Linkage", configurations: int) -> np.ndarray:
    """Measures how far from singular the joints from k outwards are.

    Returns, at random configurations, the least eigenvalue of the joints' block of the
    3x3 mass matrix (configurations, 3). Scaling to a diagonal of ones makes it free of
    units and sizes. NumPy avoids compilation in the constructor.
    """
    linkage = jax.tree.map(lambda a: np.asarray(a, dtype=float), linkage)
    com, mass, inertia = linkage.com, linkage.mass, linkage.inertia
    revolute = np.stack(real_joints(linkage.ef))
    ratios = np.empty((configurations, 3))
    random = np.random.default_rng(0)
    sizes = linkage.length, com, linkage.locked[revolute]
    reach = sum(np.abs(size).sum() for size in sizes)
    for row in ratios:
        turn = random.uniform(-np.pi, np.pi, 3)
        slide = (reach or 1) * random.uniform(-1, 1, 3)
        start, along, *_ = frames(linkage, np.where(revolute, turn, slide))
        M = np.zeros((3, 3))
        for n in range(3):
            centre = start[n + 1] + (com[n, 0] + 1j * com[n, 1]) * along[n + 1]
            J = 1j * np.where(revolute, centre - start[1:], along[:3])
            J[n + 1 :] = 0
            turns = np.where(revolute, 1.0, 0.0)
            turns[n + 1 :] = 0
            M += mass[n] * np.real(np.outer(J.conj(), J)) + inertia[n] * np.outer(
                turns, turns
            )
        # Eigenvalues, because pivots of an elimination lose accuracy near singularity.
        scale = np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
        scaled = M / np.outer(scale, scale)
        for k in range(3):
            row[k] = np.linalg.eigvalsh(scaled[k:, k:])[0]
    return ratios


def check_singularity(linkage: "Linkage") -> None:
    """Rejects linkages that are always singular; warns of those that may become so."""
    revolute = np.stack(real_joints(np.asarray(linkage.ef)))
    names = "".join("R" if r else "P" for r in revolute)
    best = _least_inertia(linkage, configurations=5).max(axis=0)
    for k in (2, 1, 0):
        if best[k] <= _SINGULAR:
            kind = "revolute" if revolute[k] else "prismatic"
            raise ValueError(
                f"mass, inertia, com: expected joint {k + 1} ({kind}) of {names} to "
                f"move some inertia of moving link {k + 1} (m{k + 2}, I{k + 2}, "
                f"p{k + 2}, q{k + 2}) or of the links beyond it, got none in any "
                "configuration: its acceleration is undetermined."
            )
    mass, inertia = np.asarray(linkage.mass), np.asarray(linkage.inertia)
    own = np.where(
        revolute, inertia + mass * (np.asarray(linkage.com) ** 2).sum(axis=1), mass
    )
    locked, length = np.asarray(linkage.locked), np.asarray(linkage.length)
    for k in np.flatnonzero(own == 0):
        warnings.warn(
            f"moving link {k + 1} carries no inertia of its own about joint {k + 1}: "
            "the mass matrix may be singular in some configurations.",
            stacklevel=5,
        )
    for k in (1, 2):
        if revolute[k - 1] and revolute[k] and np.hypot(length[k], locked[k]) == 0:
            warnings.warn(
                f"revolute joints {k} and {k + 1} coincide (moving link {k} has no "
                "length, the paper's rule (i)): one of them is redundant for "
                "positioning.",
                stacklevel=5,
            )
        if (
            not revolute[k - 1]
            and not revolute[k]
            and abs(np.sin(locked[k - 1])) < 8 * np.finfo(locked.dtype).eps
        ):
            warnings.warn(
                f"prismatic joints {k} and {k + 1} are parallel (the paper's rule "
                "(ii)): one of them is redundant for positioning.",
                stacklevel=5,
            )
