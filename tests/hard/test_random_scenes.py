"""Random arms and states: no silent errors, hangs or crashes.

Ill-conditioned arms are judged by the effect of rounding alone: the oracle computes the
bounds at the scene, from the sizes of the terms that a computation adds up. More and
other scenes: `RANDOM_SCENES=10000 pytest -m slow tests/hard/test_random_scenes.py`.
"""

import math
import os
import random
from typing import NamedTuple

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import fdof_jax as fj
from hard import oracle
from hard.oracle import EPS, Arm, floats

# Arms that may be singular somewhere.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
MORE = os.environ.get("RANDOM_SCENES")
UNRESOLVED = 0.1  # lost digits above which first-order bounds of rounding mean nothing
ZERO = (0.0, 0.0, 0.0)
TRIPLE = lambda values: st.tuples(values, values, values)

# Random arms of all topologies, their states and efforts


def sized(low: float, high: float) -> st.SearchStrategy:
    """Returns a strategy of positive numbers, uniform in their logarithm."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda e: 10.0**e)


def signed(low: float, high: float) -> st.SearchStrategy:
    size = sized(low, high)
    return st.one_of(st.sampled_from([0.0, 1.0]), size, size.map(lambda v: -v))


def or_zero(values: st.SearchStrategy) -> st.SearchStrategy:
    return st.one_of(st.just((0.0,) * 3), TRIPLE(values))


# Near and at the angles where directions align, and after many turns.
ANGLES = st.one_of(
    st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 2]),
    st.floats(-4, 4),
    st.builds(
        lambda k, d: k * math.pi / 2 + d, st.integers(-2, 2), signed(1e-12, 1e-2)
    ),
    signed(10, 1e7),
)
LENGTHS = signed(1e-3, 1e2)
INERTIAS = TRIPLE(st.one_of(st.sampled_from([1.0, 0.0]), sized(1e-6, 1e6)))


class Scene(NamedTuple):
    """An arm, its start and efforts.

    - `junk`: effort on fictitious joints, which must not matter.
    - `pace`: about how far the fastest joint moves [m or rad].
    """

    arm: Arm
    q: tuple
    qd: tuple = (0.0, 0.0, 0.0)
    tau: tuple = (0.0, 0.0, 0.0)
    junk: float = 0.0
    damping: tuple = (0.0, 0.0, 0.0)
    pace: float = 1.0
    t0: float = 0.0


@st.composite
def scenes(draw) -> Scene:
    topology = draw(st.sampled_from(fj.TOPOLOGIES))
    arm = Arm(
        topology,
        length=draw(st.tuples(*[LENGTHS] * 4)),
        com=draw(TRIPLE(st.tuples(LENGTHS, LENGTHS))),
        mass=draw(INERTIAS),
        inertia=draw(INERTIAS),
        locked=tuple(draw(LENGTHS if j == "R" else ANGLES) for j in topology),
        base_angle=draw(ANGLES),
        gravity=draw(st.one_of(st.sampled_from([9.81, 0.0]), signed(1e-3, 1e3))),
    )
    return Scene(
        arm,
        q=tuple(draw(ANGLES if j == "R" else LENGTHS) for j in topology),
        qd=draw(or_zero(signed(1e-3, 1e4))),
        tau=draw(or_zero(signed(1e-3, 1e6))),
        junk=draw(signed(1, 1e6)),
        damping=draw(or_zero(st.one_of(st.just(0.0), sized(1e-3, 1e3)))),
        pace=draw(sized(1e-2, 30)),
        t0=draw(st.sampled_from([0.0, -3.0, 100.0])),
    )


# Those that `Linkage` should reject


def linkage_of(arm: Arm) -> fj.Linkage | None:
    """Returns the library's linkage, or None if it rejects the arm, rightly."""
    try:
        return fj.Linkage(**arm._asdict())
    except ValueError as error:
        assert str(error).startswith("mass, inertia, com: expected joint")
        # Singular to 13 digits is enough, as `Linkage` computes in float64.
        assert min(conditions(arm)) > 1e13
        return None


def conditions(arm: Arm) -> list[float]:
    """Returns how near to singular the arm is in some configurations; inf: singular."""
    rng = random.Random(0)
    reach = sum(map(abs, arm.length)) + sum(abs(c) for pair in arm.com for c in pair)
    found = []
    for _ in range(6):
        sizes = [3 if j == "R" else reach or 1 for j in arm.topology]
        q = [rng.uniform(-size, size) for size in sizes]
        a = oracle.acceleration(arm, q, (0.0,) * 3, (0.0,) * 3)
        size = np.sqrt(floats(a.matrix[k, k] for k in range(3)))
        singular = a.qdd is None
        scaled = np.inf if singular else np.abs(a.inverse) * np.outer(size, size)
        found.append(np.max(scaled))
    return found


# Laws


def rounding(a):
    """Returns the relative rounding error of a sum of terms."""
    # An absolute angle is right to an ulp of the angles that it is the sum of.
    return oracle.ROUNDINGS * EPS * (1 + a.angles)


def resolution(a):
    """Returns the relative rounding error of an acceleration, to first order.

    Every entry of M is wrong by some roundings of the product of its joints' levers.
    The relative error of M^-1 is that times M^-1 scaled by the levers.
    """
    if a.qdd is None:
        return np.inf
    return rounding(a) * (np.abs(a.inverse) * np.outer(a.levers, a.levers)).max()


def check_accelerations(scene):
    arm = scene.arm
    linkage = linkage_of(arm)
    if linkage is None:
        return
    exact = oracle.acceleration(arm, scene.q, scene.qd, scene.tau)
    if exact.qdd is None:
        assert min(conditions(arm)) < np.inf
    ratios = np.asarray(fj.analysis.inertia_ratios(linkage, scene.q))
    if resolution(exact) < 1e-3:
        right = [1 / float(exact.matrix[k, k] * exact.inverse[k, k]) for k in range(3)]
        np.testing.assert_allclose(ratios, right, rtol=0, atol=1e-3)
    told = ratios.min() < 1e-9
    reduced = fj.forward_dynamics(linkage, scene.q, scene.qd, scene.tau)
    judge(np.asarray(reduced), exact, told)

    x, xd = map(np.asarray, fj.paper.to_chain(linkage, scene.q, scene.qd))
    exact = oracle.acceleration_of_chain(arm, x.tolist(), xd.tolist(), scene.tau)
    turns, junk = np.array([joint == "R" for joint in arm.topology]), [scene.junk] * 3
    force = np.where(turns, (junk, scene.tau), (scene.tau, junk)).T.ravel()
    xdd = np.asarray(fj.paper.masked_accelerations(linkage, x, xd, force))
    with np.errstate(invalid="ignore"):  # where they are infinite
        slide, turn = xdd[0::2], np.diff(xdd[1::2], prepend=0)
    if np.isfinite(xdd).all():
        # The terms may cancel, so the accelerations by each of them count too.
        size = max(*exact.efforts / exact.levers**2, np.abs(xdd).max())
        still = np.abs(np.where(turns, slide, turn))
        assert (still <= oracle.ROUNDINGS * EPS * size).all()
    # The absolute angular accelerations carry their own rounding.
    spread = EPS * np.abs(xdd[1::2]).max()
    judge(np.where(turns, turn, slide), exact, told, spread)


def judge(value, a, told, spread=0.0):
    """Checks accelerations within rounding, or that a large error was reported."""
    if resolution(a) < UNRESOLVED:
        # |M^-1| (|terms of tau - bias| + |terms of M| |qdd|): the bound holds for every
        # computation whose sums consist of these terms.
        terms = a.efforts + a.levers * (a.levers @ np.abs(floats(a.qdd)))
        bound = rounding(a) * np.abs(a.inverse) @ terms + 1e-300
        error = floats(oracle.mp.mpf(float(v)) - x for v, x in zip(value, a.qdd))
        assert (np.abs(error) <= bound + spread).all(), (value, a)
    elif not told and np.isfinite(value).all():
        assert a.qdd is not None, value
        # In the norm of the levers, which makes joints comparable.
        right = floats(a.qdd)
        size = (a.levers * np.abs(right)).max()
        assert (a.levers * np.abs(value - right)).max() <= 0.1 * size + 1e-300


TOLERANCE = 1e-11  # the default of simulate, relative and absolute
INTERPOLATED = 30  # times the error of steps, at most, between them
OUTCOMES = (
    "successful", "out of steps", "tolerance out of reach", "ill-conditioned",
    "not finite",
)  # fmt: skip


def check_motion(scene):
    linkage = linkage_of(scene.arm)
    if linkage is None:
        return
    a = oracle.acceleration(scene.arm, scene.q, scene.qd, scene.tau)
    rate = np.abs(scene.qd).max() + np.abs(floats(a.qdd or ZERO)).max() ** 0.5
    ts = scene.t0 + np.clip(scene.pace / (rate or 1), 1e-8, 1e2) * np.linspace(0, 1, 5)
    forces = fj.JointEffort(scene.tau), fj.JointDamper(scene.damping)
    start = fj.State(scene.q, scene.qd)
    motion = fj.simulate(linkage, start, ts, forces, max_steps=4096, throw=False)
    states = np.concatenate([motion.q, motion.qd], axis=1)
    finite = np.isfinite(states).all(axis=1)
    steps = int(motion.stats["num_steps"])
    assert motion.outcome in OUTCOMES
    # No motion needs so many first steps, from 1 ms down by factors of five.
    assert steps <= 100 or motion.stats["num_accepted_steps"]
    if motion.outcome == "successful":
        assert finite.all()
    else:
        assert (finite | np.isnan(states).all(axis=1)).all()
        np.testing.assert_array_equal(finite, ts <= motion.stats["time_reached"])
    # Processors that flush subnormal numbers to zero may do so.
    tiny = np.finfo(float).tiny
    np.testing.assert_allclose(states[0], np.ravel(start), rtol=0, atol=tiny)
    check_energy(scene, ts[finite], states[finite], ts[-1], steps)


def check_energy(scene, ts, states, end, steps):
    """Checks the energy less the work of constant efforts; damping may reduce it.

    The bound allows each step an error of the tolerance in every coordinate, times
    `INTERPOLATED` between steps, and each evaluation its roundings. The derivatives
    of the energy, whose sizes are `levers` and `efforts`, give the effect on it.
    """
    first = oracle.energy(scene.arm, scene.q, scene.qd)
    bound, last = 0.0, 0.0
    for t, (q, qd) in zip(ts[1:], states[1:].reshape(-1, 2, 3)):
        state = q.tolist(), qd.tolist()
        a = oracle.acceleration(scene.arm, *state, scene.tau, digits=30)
        rate, moved = np.abs(qd), np.abs(q - scene.q)
        momentum = a.levers @ rate
        carried = a.levers @ np.abs(floats(a.qdd or ZERO))
        by_tolerance = a.levers @ (1 + rate) * momentum + a.efforts @ (1 + moved)
        by_rounding = a.efforts @ np.abs(q) + momentum**2
        by_rounding += rate @ (a.efforts + a.levers * carried) * (ts[-1] - ts[0])
        by_steps = TOLERANCE * steps * by_tolerance + rounding(a) * by_rounding
        bound = max(bound, by_steps)
        between = TOLERANCE * INTERPOLATED * by_tolerance if t < end else 0.0
        with oracle.mpmath.workdps(30):
            work = np.dot(scene.tau, q - scene.q)
            change = float(oracle.energy(scene.arm, *state) - first - work)
        gain = change - last if any(scene.damping) else abs(change)
        last = change
        assert gain <= bound + between + 1e-300, (t, steps)


def rods(topology, **changes):
    usual = dict(
        length=(0.0, 1.0, 1.0, 1.0), com=((0.5, 0.0),) * 3, mass=(1.0,) * 3,
        inertia=(1.0,) * 3, locked=ZERO, base_angle=0.0, gravity=9.81,
    )  # fmt: skip
    return Arm(topology, **usual | changes)


FOUND = [
    # Gaussian elimination of badly scaled rows moved fictitious joints.
    Scene(
        rods("RPR", length=(0.0,) * 4, com=((0.0, 0.0),) * 3, inertia=(1.0, 1.0, 1e3)),
        q=(math.pi / 2, 10**1.5, 0.0), tau=(0.0, 0.0, 1e4),
    ),
    # Two pivot ratios of 1e-8 lose 16 digits together; each alone indicates 8.
    Scene(
        rods("PRR", length=(0.0, 0.3, 1.0, 1.0), inertia=ZERO,
             com=((0.0, 0.0), (0.0, 0.0), (1.0, 0.0)), mass=(1e-8, 0.0, 1.0),
             base_angle=-1.5),
        q=(0.2, 1.4, 1e-4), qd=(0.1, 0.2, 0.3), tau=(1.0, 2.0, 3.0),
    ),
    # A joint without any inertia: its ratio was 0 / 0, which was not reported.
    Scene(
        rods("RRP", length=(-53.251838798845725, 1.0, 0.0, 1.0000000001399305),
             com=((0.0, -1.0), (1.0, -1.0), (1.0, 0.0)), mass=(1.0, 0.0, 1.0),
             inertia=(1.0, 0.0, 0.0), locked=(0.0, 0.0, -math.pi / 2),
             base_angle=-math.pi, gravity=1.0),
        q=(-79.43282347242814, -1e-12, 1.0),
    ),
    # Singular at the start: the outcome must name this, not the step size.
    Scene(
        rods("PRP", length=(-1.0, 1.0, 0.4, 1.0), mass=(0.0, 0.0, 1.0),
             inertia=(0.0, 0.002, 0.008),
             com=((0.0, -16.0), (-1.7, 0.02), (0.0, 0.01))),
        q=(1.0, 1e-12, 3.0), qd=(1.0, 0.0, 0.0), tau=(-1.0, 1.0, 0.0),
    ),
    # A coordinate that overflowed to infinity made the next step NaN, for ever.
    Scene(
        rods("RRR", mass=(1.0, 1.0, 0.0), inertia=(1.0, 1.0, 1e-3), gravity=0.0),
        q=ZERO, tau=(0.0, 1.0, 0.0), damping=(0.0, 0.0, 1e6),
    ),
]  # fmt: skip


@pytest.mark.parametrize("check", [check_accelerations, check_motion])
def test_whatever_is_drawn_is_right_or_named(check):
    drawn = hypothesis.given(scenes())(check)
    for scene in FOUND:
        drawn = hypothesis.example(scene)(drawn)
    hypothesis.settings(
        max_examples=int(MORE or 80),
        deadline=None,
        database=None,
        derandomize=MORE is None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )(drawn)()
