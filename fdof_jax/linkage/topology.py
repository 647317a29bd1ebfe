"""The seven topologies and their existence factors."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ..checks import instance, is_traced

TOPOLOGIES = ("RRR", "RRP", "RPR", "PRR", "RPP", "PRP", "PPR")


def real_joints(ef: Any) -> tuple[Any, ...]:
    """Returns whether the real joint of each pair is revolute.

    The first axis of `ef` holds the existence factors.
    """
    return tuple(ef[k] > 0.5 for k in range(1, len(ef), 2))


def fixed_pairs(ef: Any) -> tuple[Any, ...]:
    """Returns whether both joints of each pair are fictitious, so that it is fixed."""
    return tuple(ef[k - 1] + ef[k] < 0.5 for k in range(1, len(ef), 2))


def pairs_of(topology: Any) -> np.ndarray | None:
    """Returns (3, 2) existence factors (prismatic, revolute), or None while traced."""
    if isinstance(topology, str):
        if topology not in TOPOLOGIES:
            detail = ""
            if topology == "PPP":
                detail = " (PPP cannot orient its last link: the paper excludes it)"
            raise ValueError(
                f"topology: expected one of {', '.join(TOPOLOGIES)}, "
                f"got {topology!r}{detail}."
            )
        return np.array([[j == "P", j == "R"] for j in topology], dtype=float)
    if is_traced(topology):
        if jnp.shape(topology) != (6,):
            raise ValueError(
                "topology: expected a name or 6 existence factors, got shape "
                f"{jnp.shape(topology)}."
            )
        return None
    try:
        given = np.asarray(topology)
        ef = given.astype(float) if given.dtype.kind in "biuf" else np.empty(0)
    except (TypeError, ValueError):
        ef = np.empty(0)
    if ef.shape != (6,) or not np.isin(ef, (0, 1)).all():
        raise ValueError(
            f"topology: expected one of {', '.join(TOPOLOGIES)} or six existence "
            f"factors of 0 or 1, got {topology!r}."
        )
    pairs = ef.reshape(3, 2)
    if not (pairs.sum(axis=1) == 1).all():
        raise ValueError(
            "topology: expected exactly one real joint in each (prismatic, revolute) "
            f"pair of existence factors (equation 4), got {ef.astype(int).tolist()}."
        )
    if pairs[:, 0].all():
        raise ValueError(
            "topology: expected at least one revolute joint, got PPP, which cannot "
            "orient its last link."
        )
    return pairs


def existence_factors(topology: str) -> Float[Array, " 6"]:
    """Returns the existence factors EF1..EF6 of a topology, equation (4).

    Each pair is (prismatic, revolute), with 1 for a real joint and 0 for a fictitious
    one: "RPR" gives 0, 1, 1, 0, 0, 1.

    **Arguments:** `topology`: one of `TOPOLOGIES`.

    **Raises:** ValueError for any other name.

    >>> import fdof_jax as fj
    >>> fj.existence_factors("RPR").tolist()
    [0.0, 1.0, 1.0, 0.0, 0.0, 1.0]
    """
    instance("topology", topology, str)
    pairs = pairs_of(topology)
    assert pairs is not None  # a name is not traced
    return jnp.asarray(pairs.reshape(6), dtype=float)
