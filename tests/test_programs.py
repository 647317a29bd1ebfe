"""Compiled programs: when another is needed, how one fails, where they are kept."""

import functools
import itertools
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, FORWARD, SHORT
from helpers import programs
from jax import export
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

import fdof_jax as fj

ARM, START, *_ = fj.scenes.fig5()
TS = np.linspace(0, 0.1, 4)
TILTED = fj.State(jnp.array([0.3]), jnp.array([0.5]))


# Exported and serialised


def states(q0, mass, ts):
    linkage = eqx.tree_at(lambda arm: arm.mass, BAR, mass)
    motion = fj.simulate(linkage, fj.State(q0, TILTED.qd), ts, throw=False)
    return motion.q, motion.qd


ARGUMENTS = TILTED.q, BAR.mass, jnp.asarray(TS)


@functools.cache
def lowered():
    return jax.jit(states).lower(*ARGUMENTS)


def test_a_program_that_raises_nothing_calls_nothing():
    text = lowered().as_text()
    assert "while" in text and "callback" not in text


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    dict(solver=diffrax.Kvaerno5()),
    dict(solver=diffrax.Tsit5(), stepsize_controller=diffrax.ConstantStepSize()),
    dict(dt0=None, **FORWARD),
])  # fmt: skip
def test_programs_of_other_steps_call_nothing(options):
    moved = lambda q: fj.simulate(BAR, fj.State(q, q), TS, throw=False, **options).q
    text = str(jax.make_jaxpr(moved)(TILTED.q))
    assert "while" in text and "callback" not in text


@pytest.fixture
def uncached():
    """Turns JAX's persistent cache off: its programs cannot be serialised again."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


@pytest.mark.slow
def test_a_program_is_exported_and_serialised(uncached):
    compiled = lowered().compile()
    expected = compiled(*ARGUMENTS)
    assert np.isfinite(expected).all()

    exported = export.export(jax.jit(states))(*ARGUMENTS)
    there = export.deserialize(exported.serialize())
    np.testing.assert_array_equal(there.call(*ARGUMENTS), expected)
    parts = serialize_executable.serialize(compiled)
    loaded = serialize_executable.deserialize_and_load(*parts)
    np.testing.assert_array_equal(loaded(*ARGUMENTS), expected)


# Errors within a user's own jit


@functools.cache
def raising():
    def ends(q0, ts, mass, coefficient):
        scene = BAR, fj.State(q0, TILTED.qd), ts, (fj.JointDamper(1.0),)
        places = lambda scene: (scene[0].mass, scene[3][0].coefficient)
        scene = eqx.tree_at(places, scene, (mass, coefficient))
        # This solver compiles faster than the default.
        return fj.simulate(*scene, solver=diffrax.Dopri8(), max_steps=32).q[-1]

    return jax.jit(ends)


INCREASING = "ts: expected finite, increasing times"
FINITE = "state0: expected finite numbers"
ACCEPTED = "linkage: expected values that its constructor"


@pytest.mark.slow
@pytest.mark.parametrize("name, value, words", [
    ("ts", [0, 0.1, 0.05, 0.2], INCREASING),
    ("ts", [0, 0.1, 0.1, 0.2], INCREASING),
    ("ts", [0, 0.1, np.nan, 0.2], INCREASING),
    ("ts", [0, 0.1, 0.2, np.inf], INCREASING),
    ("q0", [np.nan], FINITE),
    ("q0", [np.inf], FINITE),
    ("mass", [-1], ACCEPTED),
    ("mass", [np.nan], ACCEPTED),
    ("coefficient", [-1], r"forces\[0\] \(JointDamper\): expected values that its"),
    ("ts", [0, 1, 2, 50], "max_steps"),
])  # fmt: skip
def test_failures_under_jit_name_the_argument(name, value, words):
    sound = dict(q0=TILTED.q, ts=TS, mass=BAR.mass, coefficient=[1])
    ends = lambda **values: raising()(*(jnp.asarray(v, float) for v in values.values()))
    assert np.isfinite(ends(**sound)).all()
    with pytest.raises(Exception, match=words):
        ends(**(sound | {name: value})).block_until_ready()


class Fragile(eqx.Module):
    """A user's own element, which checks values at run time."""

    strength: jax.Array

    def __call__(self, t, q, qd, linkage):
        tau = -self.strength * qd
        return eqx.error_if(tau, abs(qd[0]) > 1e-3, "it broke")


def broken(strength):
    return fj.simulate(BAR, TILTED, TS, (Fragile(strength),), **SHORT).q


@pytest.mark.slow
@pytest.mark.parametrize("call", [broken, jax.jit(broken)], ids=["plain", "jit"])
def test_run_time_checks_of_an_own_element_stay(call):
    with pytest.raises(Exception, match="it broke"):
        jax.block_until_ready(call(jnp.array(1.0)))


def decay(size, **options):
    """A user's own solve, traced anew for each size."""
    term = diffrax.ODETerm(lambda t, y, args: -y)
    start = jnp.ones(size)
    return diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.1, start, **options)


def test_a_motion_leaves_later_checks_on():
    """JAX traces a check once for equal shapes, as those of the padded times."""
    fj.simulate(ARM, START, TS)
    times = jnp.linspace(0, 1, 512).at[2].set(0.9)
    with pytest.raises(Exception, match="must be increasing"):
        decay(2, saveat=diffrax.SaveAt(ts=times))


@pytest.mark.slow
def test_motions_traced_in_threads_leave_checks_on():
    def motion(count):
        times = jnp.linspace(0, 0.1, count)
        simulated = lambda q: fj.simulate(ARM, fj.State(q, START.qd), times).q
        return jax.eval_shape(simulated, START.q)

    def stopped(size):
        with pytest.raises(Exception, match="maximum number of solver steps"):
            decay(size, max_steps=3)

    with ThreadPoolExecutor(2) as threads:
        traced = [threads.submit(motion, count) for count in range(20, 44)]
        sizes = itertools.count(3)
        while not all(one.done() for one in traced):
            stopped(next(sizes))
    assert {one.result().shape[1] for one in traced} == {3} and next(sizes) > 5
    stopped(next(sizes))


# New numbers, no new program


SCRIPT = """
import json
import diffrax
import jax
import numpy as np
import fdof_jax as fj

fj.configure(x64=True)
programs = []
def listen(event, duration, **details):
    if event == "/jax/core/compile/backend_compile_duration":
        programs.append(details.get("fun_name"))
jax.monitoring.register_event_duration_secs_listener(listen)

arm, start, forces, _ = fj.scenes.fig7()
(pd,) = forces
more, heavy = pd.replace(kp=pd.kp * 2, kd=pd.kd * 2), arm.replace(mass=arm.mass * 2)
scenes = fj.scenes.circle_scenes().values()
def steps(tolerance):
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    return dict(stepsize_controller=control)
programs.clear()

def compiled(linkage, state0, ts, forces, **options):
    before = len(programs)
    motion = fj.simulate(linkage, state0, ts, forces, **options)
    assert motion.q.shape == (len(ts), 3) and motion.outcome == "successful"
    assert fj.joint_efforts(linkage, forces, motion).total.shape == (len(ts), 3)
    return programs[before:]

print(json.dumps({
    "first": compiled(arm, start, np.linspace(0, 0.1, 101), forces),
    "times": [compiled(arm, start, np.linspace(0, 0.1, n), forces)
              for n in (2, 3, 50, 500, 2048)],
    "durations": [compiled(arm, start, np.linspace(0, t1, 7), forces)
                  for t1 in (0.05, 0.2)],
    "gains": compiled(arm, start, np.linspace(0, 0.1, 5), (more,)),
    "tolerances": [compiled(arm, start, [0, 0.1], forces, **options)
                   for options in (dict(rtol=1e-8, atol=1e-9), dict(rtol=1e-7))],
    "own controllers": [compiled(arm, start, [0, 0.1], forces, **steps(tolerance))
                        for tolerance in (1e-6, 1e-7)],
    "masses": compiled(heavy, start, np.linspace(0, 0.1, 5), forces),
    "topologies": [compiled(scene.linkage, scene.state0, [0, 0.1], scene.forces)
                   for scene in scenes],
}))
"""


def test_new_numbers_compile_nothing():
    """Runs in a new process, as this one may have compiled the programs already."""
    options = dict(env=os.environ | programs(), capture_output=True, text=True)
    done = subprocess.run([sys.executable, "-c", SCRIPT], **options)
    assert done.returncode == 0, done.stderr
    compiled = json.loads(done.stdout)
    # Without the event the test would count nothing.
    own, *again = compiled.pop("own controllers")
    for names in (compiled.pop("first"), own):
        assert any("_solve_padded" in name for name in names)
    assert again == [[]]
    again = dict(times=[[]] * 5, durations=[[]] * 2, tolerances=[[]] * 2)
    assert compiled == again | dict(gains=[], masses=[], topologies=[[]] * 7)
