"""The arms that `Linkage` should reject."""

import math
import random

import fdof_jax as fj

from . import oracle
from .fuzz_report import Failure


def linkage_of(arm: oracle.Arm) -> fj.Linkage | None:
    """Returns the library's linkage, or None if it rejects the arm as singular."""
    try:
        return fj.Linkage(**arm._asdict())
    except ValueError as error:
        if not str(error).startswith("mass, inertia, com: expected joint"):
            raise Failure(f"refused for another reason: {error}") from error
        return None


def never_determined(arm: oracle.Arm) -> str | None:
    """Returns why the arm is singular in every configuration, or None if it is not.

    Singular to 13 digits is enough, as `Linkage` computes in float64.
    """
    rng = random.Random(0)
    reach = sum(map(abs, arm.length)) + sum(abs(c) for pair in arm.com for c in pair)
    limits = [3 if joint == "R" else reach or 1 for joint in arm.topology]
    draw = lambda: [rng.uniform(-limit, limit) for limit in limits]
    found = [oracle.acceleration(arm, draw(), (0.0,) * 3, (0.0,) * 3) for _ in range(6)]
    if all(a.qdd is None for a in found):
        return "refused: always singular"
    if all(a.qdd is None or _scaled_inverse(a) > 1e13 for a in found):
        return "refused: singular to 13 digits"
    return None


def _scaled_inverse(a: oracle.Acceleration) -> float:
    size = [math.sqrt(a.matrix[k][k]) for k in range(3)]
    return max(
        abs(a.inverse[i][j]) * size[i] * size[j] for i in range(3) for j in range(3)
    )


def refusal(arm: oracle.Arm) -> str:
    reason = never_determined(arm)
    if reason is None:
        raise Failure("refused, though every joint moves inertia somewhere")
    return reason
