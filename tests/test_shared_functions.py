"""Functions of equal code share a program; what they close over is data."""

import functools
import types
import warnings

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.base.functions import sharing_functions
from fdof_jax.batches import chunks
from fdof_jax.identification import problems
from fdof_jax.simulation import solve
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

TS = np.linspace(0, 0.1, 4)
# One link, whose programs compile faster.
ROD = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
TILTED = fj.State(np.array([0.3]), np.array([0.5]))


@pytest.fixture
def traces(monkeypatch):
    """Counts the calls of a module's function, which are made while JAX traces."""

    def of(module, name):
        counted, function = [], vars(module)[name]

        def counting(*arguments, **keywords):
            counted.append(name)
            return function(*arguments, **keywords)

        monkeypatch.setattr(module, name, counting)
        return counted

    return of


# Functions x -> -k x, made for a k, that share a program


def scaled(k, x):
    return FACTOR * k * x


FACTOR = -1.0


def with_sum(k):
    def force(x):
        total = 0.0

        def add(y):
            nonlocal total
            total += y

        add(-k * x)
        return total

    return force


def of_global(k):
    global RATE
    RATE = k
    return lambda x: -RATE * x


SHARED = {
    "defaults": lambda k: lambda x, k=k, *, scale=k: -k * x + 0 * scale,
    "array": lambda k: (lambda row: lambda x: -row[0] * x)(k * np.ones(2)),
    "helper": lambda k: lambda x: scaled(k, jnp.asarray(x)),
    "nested": lambda k: lambda x: jax.vmap(lambda y: -k * y)(x[None])[0],
    "sum": with_sum,
    "global": of_global,
    "arm": lambda k: (lambda arm: lambda x: -arm.gravity * x)(ROD.replace(gravity=k)),
    "length": lambda k: (lambda n: lambda x: -k * jnp.ones(n)[0] * x)(2),
    "whole number": lambda k: (lambda k: lambda x: -k * x)(int(k)),
}

# Those that have programs of their own


def counting(k):
    def force(x):
        CALLS.append(k)
        return -k * x

    return force


CALLS = []


def by_failure(k):
    def force(x):
        try:
            return -float(k) * x
        except TypeError:  # not of a number, but of a traced array
            return 0 * x

    return force


class Slotted:  # which nothing refers to weakly
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k

    def __call__(self, x):
        return -self.k * x


OWN = {
    "range": lambda k: lambda x: -x * (1 + sum(1 for _ in range(int(k) - 1))),
    "decision": lambda k: lambda x: -k * x if k > 2.5 else x * -k,
    "type": lambda k: lambda x: -k * x if isinstance(k, float) else 0 * x,
    "scalar": lambda k: lambda x: -k * x if np.isscalar(k) else 0 * x,
    "NumPy": lambda k: lambda x: x * np.linalg.norm([k, 0.0]) * -1,
    "object": lambda k: (lambda o: lambda x: -o.k * x)(types.SimpleNamespace(k=k)),
    # JAX would sort the names.
    "order": lambda k: (lambda rates: lambda x: -next(iter(rates.values())) * x)(
        {"slow": k, "fast": 0.0}
    ),
    "name": lambda k: (lambda rates: lambda x: -rates.get(f"{k}", 0.0) * x)(
        {str(k): k}
    ),
    "64 bits": lambda k: (lambda n: lambda x: -(n / 10**30) * x)(int(k) * 10**30),
    "partial": lambda k: functools.partial(lambda k, x: -k * x, k),
    "failure": by_failure,
    "counting": counting,
    "slots": Slotted,
}


@pytest.mark.parametrize("name", SHARED | OWN)
def test_numbers_of_functions_are_right(name):
    make = (SHARED | OWN)[name]
    traced = []

    @eqx.filter_jit
    def run(functions):
        traced.append(name)
        return functions[0](jnp.array(2.0))

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        share = lambda k: float(sharing_functions(run, forces=(make(k),)))
        found = [share(1.0), share(2.0)]
        assert not caught
        found.append(share(3.0))
    assert found == [-2, -4, -6]
    assert CALLS == [1, 2, 3] * (name == "counting")
    CALLS.clear()
    if name in SHARED:
        assert len(traced) == 1 + (name == "length") and not caught
    else:
        (warning,) = caught
        words = str(warning.message)
        assert words.startswith("forces[0]: ")
        assert "Equinox module" in words and warning.filename == __file__


ON_TWO = eqx.filter_jit(lambda function: function(jnp.array(2.0)))


def test_functions_share_only_what_is_equal():
    here = lambda x: jax.vmap(lambda y: -2 * y)(x[None])[0]
    (there,) = (lambda x: jax.vmap(lambda y: -2 * y)(x[None])[0],)  # in another line
    other = lambda x: jax.vmap(lambda y: -3 * y)(x[None])[0]
    for function, value in (here, -4), (there, -4), (other, -6):
        assert float(sharing_functions(ON_TWO, force=function)) == value
    for helper in (jnp.cos, lambda x: 3 * x):
        force = lambda x, helper=helper: helper(x)
        assert float(sharing_functions(ON_TWO, force=force)) == float(helper(2.0))
    for k in (1.0, 2.0):  # one that fails says so itself
        with pytest.raises(TypeError, match="unexpected keyword"):
            sharing_functions(ON_TWO, force=lambda x, k=k: jnp.sin(x, k=k))


def test_what_functions_change_outside_is_changed_and_types_stay():
    calls, last = {"number": 0}, 0

    def in_dict(x):
        calls["number"] += 1
        return -x

    def in_closure(x):
        nonlocal last
        last += 1
        return -x

    for function in (in_dict, in_closure):
        assert float(sharing_functions(ON_TWO, force=function)) == -2
    assert calls == {"number": 1} and last == 1
    # Numbers that are data leave the types of others.
    factor, whole = 2.0, 3
    scaled = lambda x: (factor * x, whole * x)
    for one in (jnp.float32(1), jnp.int32(1), jnp.float16(1)):
        run = eqx.filter_jit(lambda function, one=one: function(one))
        found = sharing_functions(run, function=scaled)
        assert [a.dtype for a in found] == [a.dtype for a in scaled(one)]


# In the library


def drag(k):
    return lambda t, q, qd, linkage: -k * qd


@pytest.mark.slow
def test_motions_sweeps_and_fits_in_a_loop_share_programs(traces):
    damped = {k: fj.simulate(ROD, TILTED, TS, (fj.JointDamper(k),)) for k in (1.0, 4.0)}
    states = fj.State(np.stack([TILTED.q, TILTED.q + 0.1]), TILTED.qd)
    counted = [
        traces(solve, "integrate"), traces(chunks, "solve_motion"),
        traces(problems, "sensitivities"),
    ]  # fmt: skip
    totals = []
    for k, expected in damped.items():
        found = fj.simulate(ROD, TILTED, TS, (drag(k),))
        np.testing.assert_allclose(found.q, expected.q, atol=1e-9)
        total = fj.joint_efforts(ROD, (drag(k),), found).total
        np.testing.assert_allclose(total, -k * found.qd, atol=1e-12)
        end = lambda scene, motion, k=k: k * motion.q[-1]
        looped = LoopedDopri8()  # which compiles faster
        ends = fj.sweep(ROD, states, TS, (drag(k),), reduce=end, solver=looped)
        np.testing.assert_allclose(ends[0], k * expected.q[-1], atol=1e-8)

        def scene_at(parameters, k=k):
            damper = fj.JointDamper(k * parameters["share"])
            return fj.Scene(ROD, TILTED, (damper,), 0.1)

        observe, start = (lambda scene, motion: motion.q), {"share": 0.8}
        fitted = fj.identification.fit(scene_at, start, TS, expected.q, observe=observe)
        np.testing.assert_allclose(fitted.parameters["share"], 1, rtol=1e-6)
        totals.append([len(calls) for calls in counted])
    assert totals[0] == totals[1] and min(totals[0]) > 0


def test_arguments_beside_functions_keep_their_places():
    stiffness, q = 3.0, np.array([0.2])
    spring = lambda t, q, qd, linkage: -stiffness * q
    found = fj.analysis.holding_efforts(ROD, q, (spring,))
    alone = fj.analysis.holding_efforts(ROD, q)
    np.testing.assert_allclose(found, alone + 3 * q, rtol=1e-12)


FIXED = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [FIXED, dict(dt0=None, rtol=1e-6)])
def test_the_number_of_steps_is_data_and_the_last_one_may_reach_the_end(steps, traces):
    def run(**options):
        options |= dict(solver=diffrax.Tsit5(), throw=False) | steps
        return fj.simulate(ROD, TILTED, 10 * TS, **options)

    most = int(run().stats["num_steps"])
    counted = traces(solve, "integrate")
    for allowed in (most + 1, most, most - 1, 1):
        motion = run(max_steps=allowed)
        enough = allowed >= most
        assert motion.outcome == ("successful" if enough else "out of steps")
        assert motion.stats["num_steps"] == min(allowed, most)
        assert motion.stats["max_steps"] == allowed
        assert 0 < motion.stats["time_reached"] <= 1
        assert (motion.stats["time_reached"] == 1) == enough
    assert not counted
