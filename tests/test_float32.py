"""Single precision, in a process of its own, as the tests' process has x64 on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import test_elements
from helpers import programs

# One process for all tests, because importing takes seconds.
PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
import fdof_jax as fj
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
bar = dict(length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
hanging, rest = fj.Linkage("R", base_angle=-np.pi / 2, **bar), fj.State([0.0], [0.0])
def end(tau, damping):
    forces = fj.JointDamper(damping), fj.JointEffort(jnp.stack([tau]))
    return fj.simulate(hanging, rest, [0, 2.0], forces).q[-1, 0]
slope = jax.jit(jax.grad(end))
for damping, exact in (1, 0.193616566), (10, 0.127398437), (1000, 0.001989895):
    assert abs(slope(0.0, float(damping)) - exact) <= 1e-5 * exact + 4e-6, damping

# Joints that are held, exactly
level = fj.Linkage("R", **bar)
motion = fj.simulate(level, rest, [0, 10.0], (fj.forces.JointFriction(7.0),))
assert motion.q.tolist() == [[0], [0]] and motion.modes.dtype == np.float32
mass = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
floor = fj.forces.HardStops(0.0, np.inf, restitution=0.5)
motion = fj.simulate(mass, fj.State([1.0], [0.0]), [0, 2.0], (floor,))
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
    environment = os.environ | {
        "JAX_ENABLE_X64": "0",
        "PYTHONPATH": str(Path(__file__).parent),
        "XLA_FLAGS": "",
        **programs(),
    }
    return subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def done():
    return run(PROGRAM)


@pytest.mark.slow
@pytest.mark.parametrize("words", ["holds on 18 scenes", "tuned"])
def test_single_precision(words, done):
    assert words in done.stdout, done.stderr[-3000:]


ELEMENTS = """
import json
import test_elements
found = test_elements.acts_of_all()
print(json.dumps([found.dtype.name, found.tolist()]))
"""


@pytest.mark.slow
def test_force_elements_in_single_precision():
    """At an instant: motions consist of what elements do there."""
    result = run(ELEMENTS)
    assert result.returncode == 0, result.stderr[-3000:]
    dtype, single = json.loads(result.stdout)
    assert dtype == "float32"
    double = test_elements.acts_of_all()
    np.testing.assert_allclose(single, double, rtol=1e-5, atol=1e-4)
