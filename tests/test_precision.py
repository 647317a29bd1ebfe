"""Single precision: beside double precision, and in a process of its own.

Arms, states, elements and times of two precisions go together, in the wider one.
"""

import itertools
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_elements
from elements import ALL, BAR, FORWARD, HOLDING, START, arm
from helpers import programs
from modes import ADJOINT, LOOPS, jacobian

import fdof_jax as fj

ARM, TS = arm("RPR"), jnp.array([0.0, 0.1])
# At points, in joints, with masses, with a path, and holding
NAMES = "spring", "wrench", "actuator", "gravity", "sticking friction", "taken"
FORCES = tuple((ALL | HOLDING)[name] for name in NAMES)
TIP = fj.CircleTask([0.2, 0.2], 0.05)


def cast(tree, dtype):
    arrays, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda x: x.astype(dtype), arrays), others)


def at_an_instant(linkage, state, forces, ts):
    q, qd = state
    rows = ts, jnp.stack([q, q]), jnp.stack([qd, qd])
    masses = tuple(e.at(ts[1]) for e in forces if hasattr(e, "at"))
    motion = fj.Solution(*rows, {}, diffrax.RESULTS.successful)
    return (
        fj.tip_position(linkage, q),
        fj.inverse_kinematics(linkage, TIP.tip(ts[1]), 0.3),
        fj.energy(linkage, q, qd, masses),
        fj.forward_dynamics(linkage, q, qd, q, masses),
        fj.joint_efforts(linkage, forces, motion),
        fj.joint_reactions(linkage, forces, motion),
        fj.linearize(linkage, state, forces[:2], ts[1]),
    )


PAIRS = list(itertools.product((np.float32, np.float64), repeat=4))


@pytest.mark.parametrize("kinds", PAIRS, ids=lambda k: "-".join(t.__name__ for t in k))
def test_any_precisions_go_together(kinds):
    given = map(cast, (ARM, START, FORCES, TS), kinds)
    shapes = eqx.filter_eval_shape(at_an_instant, *given)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(shapes)} == {"float64"}


@pytest.mark.filterwarnings("ignore:.*double precision")
def test_motions_of_arms_in_single_precision_with_all_kinds_of_elements():
    forces, motion = (*FORCES, ALL["motor"]), partial(fj.simulate, throw=False)
    given = cast(ARM, np.float32), START, TS, forces
    assert eqx.filter_eval_shape(motion, *given).q.dtype == np.float64


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*double precision")
def test_motions_and_derivatives_are_those_of_the_same_numbers_in_double_precision():
    """Derivatives in all modes, of a bar on a spring."""
    short = cast(BAR, np.float32)
    hook, tip = fj.Point(0, 0.3, -0.4), fj.Point(1, 0.5, 0.2)
    spring = fj.SpringDamper(hook, tip, stiffness=30.0, damping=2.0, rest_length=0.4)
    first = jnp.array([0.3])

    def end(q, linkage=short, **options):
        start = fj.State(q, jnp.array([0.5]))
        motion = fj.simulate(linkage, start, TS, (spring,), **options)
        return motion.q[-1].sum(), motion

    forward = partial(end, **FORWARD)
    long = partial(forward, linkage=cast(short, np.float64))
    expected, (_, right) = jacobian(long)(first)
    slopes, (_, found) = jacobian(forward)(first)
    assert found.outcome == "successful" and found.q.dtype == np.float64
    np.testing.assert_allclose(found.q, right.q, rtol=0, atol=1e-14)
    modes = end, partial(end, adjoint=ADJOINT)
    others = [jax.jit(jax.grad(of, has_aux=True), **LOOPS)(first)[0] for of in modes]
    wanted = np.tile(expected[0], (3, 1))
    np.testing.assert_allclose([slopes[0], *others], wanted, atol=1e-9)


def test_an_arm_in_single_precision_is_named():
    short = cast(ARM, np.float32)
    with pytest.warns(
        UserWarning, match=r"^linkage: expected numbers in double .*buil"
    ):
        jax.eval_shape(lambda: fj.simulate(short, START, TS))


# A process of its own, as the tests' process has x64 on


# One process for all tests, because importing takes seconds.
PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
import fdof_jax as fj
from elements import BAR, SLIDE
from helpers import SCENES, load, relative_error, to_joint

assert not jax.config.jax_enable_x64
ordinary = [name for name in SCENES if not name.startswith("hard")]
for name in ordinary:
    scene, r = SCENES[name], load(name)
    masked = fj.paper.masked_accelerations(r.linkage, r.x, r.xd, r.force)
    assert masked.dtype == np.float32
    assert relative_error(masked, scene["acc0"]) <= 1e-5, name
    exact = to_joint(scene, [float(a) for a in scene["acc0_str"]])
    reduced = fj.forward_dynamics(r.linkage, *r.state0, r.tau)
    assert relative_error(reduced, exact) <= 1e-5, name
    times = [s["t"] for s in scene["states"] if s["t"] <= 2]
    solution = fj.simulate(r.linkage, r.state0, [0, *times], r.forces)
    assert solution.q.dtype == np.float32
    for i, state in enumerate(scene["states"][: len(times)], start=1):
        # A step ends at the last time only; states before are interpolated.
        exact = name.startswith("fig") and i == len(times)
        bound = 1e-5 if exact else 1e-4
        x, xd = fj.paper.to_chain(r.linkage, solution.q[i], solution.qd[i])
        assert relative_error(x, state["q"]) <= bound, (name, state["t"])
        assert relative_error(xd, state["v"]) <= bound, (name, state["t"])

# An arm that hangs in damping, at rest; from matrix exponentials
hanging, rest = BAR.replace(base_angle=-np.pi / 2), fj.State([0.0], [0.0])
def end(tau, damping):
    forces = fj.JointDamper(damping), fj.JointEffort(jnp.stack([tau]))
    return fj.simulate(hanging, rest, [0, 2.0], forces).q[-1, 0]
slope = jax.jit(jax.grad(end))
for damping, exact in (1, 0.193616566), (10, 0.127398437), (1000, 0.001989895):
    assert abs(slope(0.0, float(damping)) - exact) <= 1e-5 * exact + 4e-6, damping

# Joints that are held, exactly
motion = fj.simulate(BAR, rest, [0, 10.0], (fj.forces.JointFriction(7.0),))
assert motion.q.tolist() == [[0], [0]] and motion.modes.dtype == np.float32
floor = fj.forces.HardStops(0.0, np.inf, restitution=0.5)
ball = SLIDE.replace(gravity=9.81)
motion = fj.simulate(ball, fj.State([1.0], [0.0]), [0, 2.0], (floor,))
assert motion.q[-1, 0] == 0 and motion.modes[-1, 0] == 2
assert abs(np.nanmax(motion.events.t) - 1.35457) < 1e-3

print("float32 holds on", len(ordinary), "scenes", flush=True)

arm, traced = load("fig3").linkage, jax.jit(fj.inverse_kinematics)
for angle in np.linspace(-3, 3, 20):  # with two links in line
    q = np.float32([angle, 0, 0.3])
    tip = fj.tip_position(arm, q)
    for found in (f(arm, tip, q.sum()) for f in (fj.inverse_kinematics, traced)):
        assert found.dtype == np.float32
        np.testing.assert_allclose(fj.tip_position(arm, found), tip, atol=1e-6)

result = fj.tune(fj.scenes.fig7()._replace(t1=2.0), max_steps=15)
norms = result.history.gradient_norm
assert norms[-1] < 1e-2 * norms[0], norms
assert result.loss < 0.5 * result.history.loss[0]
print("tuned")
"""


def run(program):
    """Returns what a program prints in single precision."""
    tests = dict(
        JAX_ENABLE_X64="0", PYTHONPATH=str(Path(__file__).parent), XLA_FLAGS=""
    )
    options = dict(env=os.environ | tests | programs(), capture_output=True, text=True)
    done = subprocess.run([sys.executable, "-c", program], **options)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_single_precision():
    printed = run(PROGRAM)
    assert "holds on 18 scenes" in printed and "tuned" in printed


ELEMENTS = """
import json
import test_elements
found = test_elements.acts_of_all()
print(json.dumps([found.dtype.name, found.tolist()]))
"""


@pytest.mark.slow
def test_force_elements_in_single_precision():
    """At an instant: motions consist of what elements do there."""
    dtype, single = json.loads(run(ELEMENTS))
    assert dtype == "float32"
    double = test_elements.acts_of_all()
    np.testing.assert_allclose(single, double, rtol=1e-5, atol=1e-4)
