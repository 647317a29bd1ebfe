"""The arms that `Linkage` should reject."""

import random

import numpy as np

import fdof_jax as fj

from . import oracle


def linkage_of(arm: oracle.Arm) -> fj.Linkage | None:
    """Returns the library's linkage, or None if it rejects the arm, rightly."""
    try:
        return fj.Linkage(**arm._asdict())
    except ValueError as error:
        assert str(error).startswith("mass, inertia, com: expected joint")
        # Singular to 13 digits is enough, as `Linkage` computes in float64.
        assert min(conditions(arm)) > 1e13
        return None


def conditions(arm: oracle.Arm) -> list[float]:
    """Returns how near to singular the arm is in some configurations; inf: singular."""
    rng = random.Random(0)
    reach = sum(map(abs, arm.length)) + sum(abs(c) for pair in arm.com for c in pair)
    found = []
    for _ in range(6):
        q = [
            rng.uniform(-3, 3) if j == "R" else rng.uniform(-1, 1) * (reach or 1)
            for j in arm.topology
        ]
        a = oracle.acceleration(arm, q, (0.0,) * 3, (0.0,) * 3)
        size = np.sqrt(oracle.floats(a.matrix[k, k] for k in range(3)))
        singular = a.qdd is None
        scaled = np.inf if singular else np.abs(a.inverse) * np.outer(size, size)
        found.append(np.max(scaled))
    return found
