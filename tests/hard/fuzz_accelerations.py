"""Accelerations of random arms, against 50 digits and bounds of rounding."""

import math

import numpy as np

import fdof_jax as fj

from . import oracle
from .fuzz_report import Failure, Report
from .oracle import EPS, ROUNDINGS
from .random_scenes import Scene
from .refusals import linkage_of, never_determined, refusal

# Above this share of lost digits first-order bounds of rounding mean nothing.
UNRESOLVED = 0.1


def resolution(a: oracle.Acceleration) -> float:
    """Returns the relative rounding error of the acceleration, to first order.

    Every entry of M is wrong by some roundings of the product of its joints'
    levers. The relative error of M^-1 is that times M^-1 scaled by the levers:
    about eps / min rho if no lengths cancel, and eps / (rho_1 rho_2) at worst.
    """
    if a.qdd is None:
        return math.inf
    scaled = max(
        abs(a.inverse[i][j]) * a.levers[i] * a.levers[j]
        for i in range(3)
        for j in range(3)
    )
    return ROUNDINGS * EPS * (1 + a.angles) * scaled


def rounding_bound(a: oracle.Acceleration) -> list[float]:
    """|M^-1| (|terms of tau - bias| + |terms of M| |qdd|) eps times some roundings.

    The bound holds for every computation whose sums consist of these terms, for
    instance the solution of a positive definite system without pivoting. An
    absolute angle is right to an ulp of the angles that it is the sum of, hence
    `angles`.
    """
    assert a.qdd is not None
    carried = sum(s * abs(float(x)) for s, x in zip(a.levers, a.qdd))
    terms = [f + s * carried for f, s in zip(a.efforts, a.levers)]
    return [
        ROUNDINGS * EPS * (1 + a.angles) * sum(abs(m) * t for m, t in zip(row, terms))
        + 1e-300
        for row in a.inverse
    ]


def check_accelerations(scene: Scene, report: Report) -> str:
    arm = scene.arm
    linkage = linkage_of(arm)
    if linkage is None:
        return refusal(arm)
    exact = oracle.acceleration(arm, scene.q, scene.qd, scene.tau)
    if min(exact.rho) == 0 and never_determined(arm) == "refused: always singular":
        raise Failure("accepted, though singular in all configurations")
    reduced = np.asarray(fj.forward_dynamics(linkage, scene.q, scene.qd, scene.tau))
    told = _told_ill_conditioned(linkage, scene, exact)
    outcome = _judge("reduced", reduced, exact, told, scene, report)

    x, xd = (
        np.asarray(v).tolist() for v in fj.paper.to_chain(linkage, scene.q, scene.qd)
    )
    exact = oracle.acceleration_of_chain(arm, x, xd, scene.tau)
    force = []
    for joint, tau in zip(arm.topology, scene.tau):
        force += [scene.junk, tau] if joint == "R" else [tau, scene.junk]
    xdd = np.asarray(fj.paper.masked_accelerations(linkage, x, xd, force))
    slide, turn = xdd[0::2], np.diff(xdd[1::2], prepend=0)
    real = [joint == "R" for joint in arm.topology]
    if np.isfinite(xdd).all():
        still = np.where(real, slide, turn)
        # The terms may cancel, so the accelerations by each of them count too.
        terms = [f / s**2 for f, s in zip(exact.efforts, exact.levers)]
        size = max(*terms, np.abs(xdd).max())
        if (np.abs(still) > ROUNDINGS * EPS * size).any():
            raise Failure(f"masked: fictitious joints accelerate by {still}")
    masked = np.where(real, turn, slide)
    # The absolute angular accelerations carry their own rounding.
    spread = EPS * np.abs(xdd[1::2]).max()
    _judge("masked", masked, exact, told, scene, report, spread)
    return outcome


def _told_ill_conditioned(linkage, scene: Scene, exact) -> bool:
    """Returns whether `inertia_ratios` reports the arm; checks their own error."""
    ratios = np.asarray(fj.analysis.inertia_ratios(linkage, scene.q))
    if exact.qdd is not None and resolution(exact) < 1e-3:
        expected = [
            float(1 / (exact.matrix[k][k] * exact.inverse[k][k])) for k in range(3)
        ]
        if not np.abs(ratios - expected).max() <= 1e-3:
            raise Failure(f"inertia_ratios: {ratios}, not {expected}")
    return bool(ratios.min() < 1e-9)


def _judge(name, value, exact, told, scene, report, spread=0.0) -> str:
    lost = resolution(exact)
    if lost >= UNRESOLVED:
        # The bound means nothing, but a large error must have been reported.
        if told:
            return "unresolved by float64, told"
        if not np.isfinite(value).all():
            return "unresolved by float64, not finite"
        wrong = _relative_error(value, exact)
        if wrong > 0.1:
            raise Failure(
                f"{name}: wrong by {wrong:.1g} of its size and nobody says so, rho "
                f"{exact.rho}: {value}"
            )
        return "unresolved by float64, right to 10 %"
    for got, right, bound in zip(value, exact.qdd, rounding_bound(exact)):
        if not math.isfinite(got):
            raise Failure(f"{name}: {value} instead of {list(map(float, exact.qdd))}")
        error = float(abs(oracle.mp.mpf(float(got)) - right))
        report.note(f"{name} acceleration / bound", error / (bound + spread), scene)
        if error > bound + spread:
            raise Failure(
                f"{name}: {value} instead of {list(map(float, exact.qdd))}, error "
                f"{error:.3g} for a bound of {bound + spread:.3g}, rho {exact.rho}"
            )
    return "right"


def _relative_error(value, exact: oracle.Acceleration) -> float:
    """Returns the error in the norm of the levers, which makes joints comparable."""
    if exact.qdd is None:
        return math.inf
    pairs = list(zip(exact.levers, value, map(float, exact.qdd)))
    return max(s * abs(a - b) for s, a, b in pairs) / (
        max(s * abs(b) for s, _, b in pairs) + 1e-300
    )
