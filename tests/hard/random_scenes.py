"""Hypothesis strategies: random arms of all topologies, their states and efforts."""

import math
from typing import NamedTuple

import hypothesis.strategies as st

import fdof_jax as fj

from . import oracle


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
TRIPLE = lambda values: st.tuples(values, values, values)
LENGTHS = signed(1e-3, 1e2)
INERTIAS = TRIPLE(st.one_of(st.sampled_from([1.0, 0.0]), sized(1e-6, 1e6)))


class Scene(NamedTuple):
    """An arm, its start and efforts.

    - `junk`: effort on fictitious joints, which must not matter.
    - `pace`: about how far the fastest joint moves [m or rad].
    """

    arm: oracle.Arm
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
    arm = oracle.Arm(
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
