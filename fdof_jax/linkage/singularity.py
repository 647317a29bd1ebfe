"""Detects mass matrices that are singular, always or in some configurations."""

from typing import NamedTuple

import numpy as np

from ..base.user_warnings import warn
from .topology import fixed_pairs, letters, real_joints

# Below this, eigenvalues of a matrix with a diagonal of ones are rounding errors.
_SINGULAR = 1e-14


class Numbers(NamedTuple):
    """The arrays of a linkage, in NumPy."""

    ef: np.ndarray
    length: np.ndarray
    com: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    locked: np.ndarray
    base_angle: np.ndarray
    gravity: np.ndarray


def _frames(linkage: Numbers, q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Computes starts and directions of the links, and mass centres, all as x + iy.

    Unlike `frames` it compiles nothing, and always has double precision.
    """
    revolute = np.stack(real_joints(linkage.ef))
    summed = lambda parts: np.insert(np.cumsum(parts, axis=-1), 0, 0, axis=-1)
    turn = summed(np.where(revolute, q, linkage.locked))
    along = np.exp(1j * (linkage.base_angle + turn))
    slide = np.where(revolute, linkage.locked, q)
    start = summed((linkage.length[:-1] + 1j * slide) * along[..., :-1])
    centre = start[..., 1:] + linkage.com @ [1, 1j] * along[..., 1:]
    return start, along, centre


def _scaled_inertia(linkage: Numbers) -> np.ndarray:
    """Computes mass matrices at five random configurations, scaled (5, n, n).

    The diagonal is 1, or 0 where a joint moves nothing.
    """
    linkage = Numbers(*(a.astype(float) for a in linkage))
    revolute = np.stack(real_joints(linkage.ef))
    sizes = linkage.length, linkage.com, linkage.locked[revolute]
    extent = sum(np.abs(size).sum() for size in sizes)
    n, moves = len(revolute), ~np.stack(fixed_pairs(linkage.ef))
    draws = np.random.default_rng(0).uniform(-1, 1, (5, 2, n))
    q = np.where(revolute, np.pi * draws[:, 0], (extent or 1) * draws[:, 1] * moves)
    start, along, centre = _frames(linkage, q)
    moved = np.tri(n) * moves  # a joint moves only the links beyond it
    arm = centre[:, :, None] - start[:, None, 1:]
    J = moved * np.where(revolute, arm, along[:, None, :-1])
    M = np.einsum("n,cnj,cnk->cjk", linkage.mass, J.conj(), J).real
    M += np.einsum("n,nj,nk->jk", linkage.inertia, moved * revolute, moved * revolute)
    # Eigenvalues, because pivots of an elimination lose accuracy near singularity.
    tiny = np.finfo(float).tiny
    scale = np.sqrt(np.maximum(np.diagonal(M, axis1=1, axis2=2), tiny))
    # Rows of fixed pairs are 0; a 1 leaves the least eigenvalue as it is.
    return M / (scale[:, :, None] * scale[:, None]) + np.diag(~moves)


def check_singularity(linkage: Numbers) -> None:
    """Rejects linkages that are always singular; warns of those that may become so."""
    revolute = np.stack(real_joints(linkage.ef))
    names = letters(linkage.ef)
    scaled = _scaled_inertia(linkage)
    for k in reversed(range(len(names))):
        # Of the joints from k outwards, how far from singular they are.
        least, modes = np.linalg.eigh(scaled[:, k:, k:])
        if least[:, 0].max() <= _SINGULAR:
            kind = "revolute" if revolute[k] else "prismatic"
            if scaled[:, k, k].max() > 0:  # it moves some, but others can undo that
                parts = k + np.flatnonzero(np.abs(modes[:, :, 0]).max(axis=0) > 1e-3)
                joints = " and ".join(str(joint + 1) for joint in parts)
                alike = len(parts) == 2 and not revolute[parts].any()
                line = " along the same line" if alike else ""
                raise ValueError(
                    f"mass, inertia, com: expected joints {joints} of {names} to move "
                    "some inertia whenever they move, got joints that can move against "
                    f"each other{line} and move none, in any configuration: their "
                    "accelerations are undetermined."
                )
            raise ValueError(
                f"mass, inertia, com: expected joint {k + 1} ({kind}) of {names} to "
                f"move some inertia of link {k + 1} or of the links beyond it, got "
                "none in any configuration: its acceleration is undetermined."
            )
    _warn(linkage, revolute)


def _warn(linkage: Numbers, revolute: np.ndarray) -> None:
    """Warns of joints without inertia of their own and of redundant joints."""
    mass, locked = linkage.mass, linkage.locked
    eps, n = 8 * np.finfo(locked.dtype).eps, len(mass)
    start, _, centre = _frames(linkage, np.zeros(n))
    lengths = linkage.length, linkage.com, locked[revolute]
    rounding = eps * sum(np.abs(length).sum() for length in lengths)
    moving = np.flatnonzero(~np.stack(fixed_pairs(linkage.ef)))
    # Joint k moves a rigid body: its link and those fixed to it, up to the next joint.
    for k, following in zip(moving, [*moving[1:], n]):
        body = slice(k, following)
        arm = np.abs(centre - start[k + 1])
        turning = linkage.inertia + mass * np.where(arm > rounding, arm, 0) ** 2
        if (turning if revolute[k] else mass)[body].sum() == 0:
            alone = following == k + 1
            links = f"link {k + 1}" if alone else f"links {k + 1} to {following}"
            warn(
                f"joint {k + 1} moves no inertia of {links}: the mass matrix may be "
                "singular in some configurations."
            )
        if following == n or revolute[k] != revolute[following]:
            continue
        pair = f"joints {k + 1} and {following + 1}"
        if revolute[k]:
            if abs(start[following + 1] - start[k + 1]) <= rounding:
                warn(
                    f"revolute {pair} coincide (no distance between them, the paper's "
                    "rule (i)): one of them is redundant for positioning."
                )
        elif abs(np.sin(locked[body].sum())) < eps:
            warn(
                f"prismatic {pair} are parallel (the paper's rule (ii)): one of them "
                "is redundant for positioning."
            )
