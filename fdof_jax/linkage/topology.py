"""Topologies: which joint of each pair is real, as letters or existence factors."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import instance, is_traced, radians, shown

TOPOLOGIES = ("RRR", "RRP", "RPR", "PRR", "RPP", "PRP", "PPR")
MOST_PAIRS = 8

# (prismatic, revolute) of a pair.
_FACTORS = {"P": (1, 0), "R": (0, 1), "F": (0, 0)}


def real_joints(ef: Array | np.ndarray) -> tuple[Array, ...]:
    """Returns whether each pair turns; the first axis of `ef` has existence factors."""
    return tuple(ef[k] > 0.5 for k in range(1, len(ef), 2))


def check_angles(name: str, values: ArrayLike, ef: ArrayLike) -> None:
    """Warns of known positions of revolute joints that look like degrees."""
    if not is_traced(ef, values):
        radians(name, np.where(real_joints(np.asarray(ef)), values, 0))


def fixed_pairs(ef: Array | np.ndarray) -> tuple[Any, ...]:
    """Returns whether each pair is fixed: both of its joints are fictitious."""
    ef = ef if is_traced(ef) else np.asarray(ef)  # whose entries cost no calls of JAX
    return tuple(ef[k - 1] + ef[k] < 0.5 for k in range(1, len(ef), 2))


def letters(ef: ArrayLike) -> str:
    """Returns known existence factors as a name, such as RPR."""
    pairs = np.asarray(ef).reshape(-1, 2)
    return "".join("R" if turns else "P" if slides else "F" for slides, turns in pairs)


def pairs_of(topology: Any) -> np.ndarray | None:
    """Returns (n, 2) existence factors (prismatic, revolute), or None while traced."""
    expected = (
        f"topology: expected 1 to {MOST_PAIRS} letters R (revolute), P (prismatic) or "
        "F (fixed), or two existence factors of 0 or 1 for each pair of joints"
    )
    if isinstance(topology, str):
        if not 0 < len(topology) <= MOST_PAIRS or set(topology) - set(_FACTORS):
            raise ValueError(f"{expected}, got {shown(topology)}.")
        pairs = np.array([_FACTORS[joint] for joint in topology], dtype=float)
    elif is_traced(topology):
        if jnp.ndim(topology) != 1 or jnp.size(topology) not in _SIZES:
            raise ValueError(f"{expected}, got shape {jnp.shape(topology)}.")
        return None
    else:
        try:
            given = np.asarray(topology)
            ef = given.astype(float) if given.dtype.kind in "biuf" else np.empty(0)
        except (TypeError, ValueError, RuntimeError):  # RuntimeError: a deleted array
            ef = np.empty(0)
        if ef.ndim > 1:
            raise ValueError(
                f"{expected}, got shape {ef.shape}. Make and change the arms of a "
                "batch one by one, within jax.vmap."
            )
        if ef.ndim != 1 or ef.size not in _SIZES or not np.isin(ef, (0, 1)).all():
            raise ValueError(f"{expected}, got {shown(topology)}.")
        pairs = ef.reshape(-1, 2)
    if (pairs.sum(axis=1) > 1).any():
        raise ValueError(
            "topology: expected one real joint at most in each (prismatic, revolute) "
            f"pair of existence factors (equation 4), got "
            f"{shown(pairs.astype(int).tolist())}."
        )
    if not pairs.any():
        raise ValueError("topology: expected a joint that moves, got fixed pairs only.")
    return pairs


_SIZES = range(2, 2 * MOST_PAIRS + 1, 2)


def existence_factors(topology: str) -> Float[Array, " factor"]:
    """Returns the existence factors of a topology, equation (4): EF1, EF2, ...

    Each pair is (prismatic, revolute), with 1 for a real joint and 0 for a fictitious
    one. A fixed pair, F, is (0, 0).

    **Arguments:** `topology`: up to eight letters R, P or F.

    **Raises:** ValueError for any other name.

    >>> import fdof_jax as fj
    >>> fj.existence_factors("RPR").tolist()
    [0.0, 1.0, 1.0, 0.0, 0.0, 1.0]
    """
    instance("topology", topology, str)
    pairs = pairs_of(topology)
    assert pairs is not None  # a name is not traced
    return jnp.asarray(pairs.ravel(), dtype=float)


def names_and_units(ef: Array | np.ndarray) -> tuple[list[str], list[str]]:
    """Returns names and units of joints, both neutral where a batch mixes the kinds."""
    names, units = [], []
    of_members = np.asarray(ef).reshape(-1, ef.shape[-1])
    for k, kinds in enumerate(map(set, zip(*map(letters, of_members)))):
        names.append(f"{min(kinds)}{k + 1}" if len(kinds) == 1 else f"{k + 1}")
        moving = sorted(kinds - {"F"}) or ["R"]
        units.append(" or ".join({"P": "m", "R": "rad"}[kind] for kind in moving))
    return names, units


def common_unit(units: list[str]) -> str:
    return units[0] if len(set(units)) == 1 else "m or rad"


def rate_unit(unit: str) -> str:
    return " or ".join(f"{one}/s" for one in unit.split(" or "))
