"""Scene 30: malformed values that no call can check, because they are traced.

Errors that calls raise, for every function and argument, are in tests/refusals.py;
locked velocities are in tests/test_linkage.py.
"""

import functools

import equinox as eqx
import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
from hard.scenes import START, TARGET, arm

NAN, INF = np.nan, np.inf
# From NumPy: JAX's arrays full of a plain number would take programs of their own.
GOOD = dict(
    ef=np.asarray(fj.existence_factors("RRR")),
    mass=np.ones(3),
    length=np.array([0.0, 1, 1, 1]),
    q=START.q,
    qd=np.zeros(3),
    ts=np.linspace(0, 1, 5),
    kp=np.full(3, 10.0),
    limit=np.full(3, 10.0),
)


def simulate(ef, mass, length, q, qd, ts, kp, limit, **options):
    linkage = eqx.tree_at(lambda a: (a.ef, a.mass, a.length), arm(), (ef, mass, length))
    controller = fj.PDController(1.0, 1.0, 1.0, TARGET)
    forces = (eqx.tree_at(lambda c: (c.kp, c.limit), controller, (kp, limit)),)
    start = fj.State(q, qd)
    options = dict(throw=False) | options
    return fj.simulate(linkage, start, ts, forces, **options)


# Faster to compile than the solver of batches, which test_bad_members.py gives NaN.
traced = jax.jit(functools.partial(simulate, max_steps=2000, solver=LoopedDopri8()))


CASES = {
    "q nan": ("q", [NAN, 0, 0]),
    "q inf": ("q", [0, INF, 0]),
    "qd nan": ("qd", [NAN, 0, 0]),
    "qd inf": ("qd", [0, INF, 0]),
    "mass nan": ("mass", [1, 1, NAN]),
    "mass of the tip negative": ("mass", [1, 1, -1]),
    "mass of the base negative": ("mass", [-1, 1, 1]),
    "length nan": ("length", [0, NAN, 1, 1]),
    "length inf": ("length", [0, 1, INF, 1]),
    "kp nan": ("kp", [1, NAN, 1]),
    "kp negative": ("kp", [1, -1, 1]),
    "limit nan": ("limit", [10, NAN, 10]),
    "limit negative": ("limit", [10, -10, 10]),
    "both joints of a pair": ("ef", [0, 1, 1, 1, 0, 1]),
    "no joint at all": ("ef", [0] * 6),
    "ef nan": ("ef", [0, 1, NAN, NAN, 0, 1]),
    "ts not increasing": ("ts", [0, 0.5, 0.2, 0.7, 1]),
    "ts decreasing": ("ts", [1, 0.7, 0.5, 0.2, 0]),
    "ts equal": ("ts", [0, 0, 0, 0, 0]),
    "ts nan": ("ts", [0, 0.2, NAN, 0.7, 1]),
    "ts inf": ("ts", [0, 0.2, 0.5, 0.7, INF]),
}


@pytest.mark.parametrize("name, value", CASES.values(), ids=CASES)
def test_traced_values_that_no_door_sees(name, value):
    """Nothing can be raised for one member of a batch; its result reports the fault."""
    solution = traced(**GOOD | {name: np.asarray(value, float)})
    expected = ["not finite", "ill-conditioned"]
    if name == "ts":
        expected += ["out of steps", "tolerance out of reach", "solver failed"]
    assert solution.outcome in expected
    assert np.isnan(solution.q[-1]).all()


def test_the_good_ones_do_not_fail():
    solution = traced(**GOOD)
    assert solution.outcome == "successful"
    exact = simulate(**GOOD)
    # The plain call has a program of its own, which rounds differently. Beside the kink
    # of a saturation that changes steps, whose tolerance is 1e-11.
    np.testing.assert_allclose(solution.q, exact.q, rtol=0, atol=3e-11)
