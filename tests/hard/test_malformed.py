"""Scene 30: malformed values that no call can check, because they are traced.

Errors that calls raise, for every function and argument, are in tests/refusals.py;
locked velocities are in tests/test_linkage.py.
"""

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import Hold

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

NAN, INF = np.nan, np.inf
ARM = fj.scenes.double_pendulum().linkage
PD = fj.PDController(1.0, 1.0, 1.0, Hold(np.array([0.5, 0.3])))
GOOD = dict(
    ef=[0, 1, 0, 1], mass=[1, 1], length=[0, 1, 1], q=[0.1, 0.2], qd=[0, 0],
    ts=[0, 0.2, 0.5, 0.7, 1], kp=[10, 10], limit=[10, 10],
)  # fmt: skip
WRONG = dict(
    ef=[[1, 1, 0, 1], [0] * 4, [NAN, NAN, 0, 1]],
    mass=[[1, NAN], [1, -1], [-1, 1]],
    length=[[0, NAN, 1], [0, INF, 1]],
    q=[[NAN, 0], [0, INF]],
    qd=[[NAN, 0], [0, INF]],
    ts=[
        [0, 0.5, 0.2, 0.7, 1], [1, 0.7, 0.5, 0.2, 0], [0] * 5, [0, 0.2, NAN, 0.7, 1],
        [0, 0.2, 0.5, 0.7, INF],
    ],
    kp=[[1, NAN], [1, -1]],
    limit=[[10, NAN], [10, -10]],
)  # fmt: skip


@jax.jit
def motion_of(ef, mass, length, q, qd, ts, kp, limit):
    arm = eqx.tree_at(lambda a: (a.ef, a.mass, a.length), ARM, (ef, mass, length))
    pd = eqx.tree_at(lambda pd: (pd.kp, pd.limit), PD, (kp, limit))
    # Faster to compile than the solver of batches, which test_batches.py gives NaN.
    options = dict(solver=LoopedDopri8(), max_steps=2000, throw=False)
    return fj.simulate(arm, fj.State(q, qd), ts, (pd,), **options)


def motion(**changes):
    arrays = {name: np.array(v, float) for name, v in (GOOD | changes).items()}
    return motion_of(**arrays)


@pytest.mark.parametrize("name", WRONG)
def test_traced_values_that_no_door_sees(name):
    """Nothing can be raised for one member of a batch; its result reports the fault."""
    assert motion().outcome == "successful"
    expected = ["not finite", "ill-conditioned"]
    if name == "ts":
        expected += ["out of steps", "tolerance out of reach", "solver failed"]
    for value in WRONG[name]:
        found = motion(**{name: value})
        assert found.outcome in expected, value
        assert np.isnan(found.q[-1]).all(), value
