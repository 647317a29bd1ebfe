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

ARM, START, *_ = fj.scenes.fig5()
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


# Of a function called on 2


def damping(k):
    return lambda x: -k * x


def by_default(k):
    return lambda x, k=k, *, scale=k: -k * x + 0 * scale


def with_array(k):
    row = k * np.ones(2)
    return lambda x: -row[0] * x


def scaled(k, x):
    return FACTOR * k * x


FACTOR = -1.0


def with_helper(k):
    return lambda x: scaled(k, jnp.asarray(x))


def nested(k):
    return lambda x: jax.vmap(lambda y: -k * y)(x[None])[0]


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


def of_arm(k):
    arm = ARM.replace(gravity=k)
    return lambda x: -arm.gravity * x


def of_whole_number(k):
    k = int(k)
    return lambda x: -k * x


def with_length(k):
    n = 2
    return lambda x: -k * jnp.ones(n)[0] * x


def by_range(k):
    n = int(k) - 1
    return lambda x: -x * (1 + sum(1 for _ in range(n)))


def chosen(k):
    def force(x):
        if k > 2.5:  # decided in Python
            return -k * x
        return x * -k

    return force


def in_numpy(k):
    return lambda x: x * np.linalg.norm([k, 0.0]) * -1


def of_object(k):
    held = types.SimpleNamespace(k=k)
    return lambda x: -held.k * x


def counting(k):
    def force(x):
        CALLS.append(k)
        return -k * x

    return force


CALLS = []


def in_order(k):
    rates = {"slow": k, "fast": 0.0}  # JAX would sort the names
    return lambda x: -next(iter(rates.values())) * x


def by_type(k):
    return lambda x: -k * x if isinstance(k, float) else 0 * x


def by_failure(k):
    def force(x):
        try:
            return -float(k) * x
        except TypeError:  # not of a number, but of a traced array
            return 0 * x

    return force


def by_kind(k):
    return lambda x: -k * x if np.isscalar(k) else 0 * x


def by_name(k):
    rates = {str(k): k}
    return lambda x: -rates.get(f"{k}", 0.0) * x


def beyond_64_bits(k):
    whole = int(k) * 10**30
    return lambda x: -(whole / 10**30) * x


class Slotted:  # which nothing refers to weakly
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k

    def __call__(self, x):
        return -self.k * x


def partial(k):
    return functools.partial(lambda k, x: -k * x, k)


SHARED = [
    damping, by_default, with_array, with_helper, nested, of_global, of_arm,
    of_whole_number, with_length, with_sum,
]  # fmt: skip
OWN = [
    beyond_64_bits, by_failure, by_kind, by_name, by_range, by_type, chosen, counting,
    in_numpy, in_order, of_object, partial, Slotted,
]  # fmt: skip


@pytest.mark.parametrize("make", SHARED + OWN)
def test_numbers_of_functions_are_right(make):
    traced = []

    @eqx.filter_jit
    def run(functions):
        traced.append(make)
        return functions[0](jnp.array(2.0))

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        share = lambda k: float(sharing_functions(run, forces=(make(k),)))
        found = [share(1.0), share(2.0)]
        assert not caught
        found.append(share(3.0))
    assert found == [-2, -4, -6]
    assert CALLS == [1, 2, 3] * (make is counting)
    CALLS.clear()
    if make in SHARED:
        assert len(traced) == 1 + (make is with_length) and not caught
    else:
        (warning,) = caught
        words = str(warning.message)
        assert words.startswith("forces[0]: ") and make.__name__ in words
        assert "Equinox module" in words and warning.filename == __file__


def test_it_does_not_matter_where_a_function_stands():
    traced = []

    @eqx.filter_jit
    def run(functions):
        traced.append(functions)
        return functions[0](jnp.array(2.0))

    here = lambda x: jax.vmap(lambda y: -2 * y)(x[None])[0]
    (there,) = (lambda x: jax.vmap(lambda y: -2 * y)(x[None])[0],)
    other = lambda x: jax.vmap(lambda y: -3 * y)(x[None])[0]
    found = [float(sharing_functions(run, forces=(f,))) for f in (here, there, other)]
    assert found == [-4, -4, -6] and len(traced) == 2


def test_what_functions_change_outside_is_changed():
    run = eqx.filter_jit(lambda functions: functions[0](jnp.array(2.0)))
    calls, last = {"number": 0}, 0

    def in_dict(x):
        calls["number"] += 1
        return -x

    def in_closure(x):
        nonlocal last
        last += 1
        return -x

    for function in (in_dict, in_closure):
        assert float(sharing_functions(run, forces=(function,))) == -2
    assert calls == {"number": 1} and last == 1


def test_numbers_that_are_data_leave_the_types_of_others():
    factor, whole = 2.0, 3
    scaled = lambda x: (factor * x, whole * x)
    for one in (jnp.float32(1), jnp.int32(1), jnp.float16(1)):
        run = eqx.filter_jit(lambda function, one=one: function(one))
        found = sharing_functions(run, function=scaled)
        assert [a.dtype for a in found] == [a.dtype for a in scaled(one)]


def test_functions_of_equal_code_that_call_others_share_nothing():
    run = eqx.filter_jit(lambda function: function(jnp.array(2.0)))
    for helper in (jnp.cos, lambda x: 3 * x):
        force = lambda x, helper=helper: helper(x)
        assert float(sharing_functions(run, force=force)) == float(helper(2.0))


def test_a_function_that_fails_says_so_itself():
    run = eqx.filter_jit(lambda function: function(jnp.array(2.0)))
    for k in (1.0, 2.0):
        with pytest.raises(TypeError, match="unexpected keyword"):
            sharing_functions(run, force=lambda x, k=k: jnp.sin(x, k=k))


# In the library


def drag(k):
    return lambda t, q, qd, linkage: -k * qd


@pytest.mark.slow
def test_motions_in_a_loop_share_a_program(traces):
    counted = traces(solve, "integrate")
    for k in (1.0, 4.0):
        found = fj.simulate(ROD, TILTED, TS, (drag(k),))
        expected = fj.simulate(ROD, TILTED, TS, (fj.JointDamper(k),))
        np.testing.assert_allclose(found.q, expected.q, atol=1e-9)
        total = fj.joint_efforts(ROD, (drag(k),), found).total
        np.testing.assert_allclose(total, -k * found.qd, atol=1e-12)
    assert len(counted) <= 2


def test_arguments_beside_functions_keep_their_places():
    q, spring = np.array([0.1, -0.2, 0.3]), lambda t, q, qd, linkage: -stiffness * q
    stiffness = 3.0
    found = fj.analysis.holding_efforts(ARM, q, (spring,))
    alone = fj.analysis.holding_efforts(ARM, q)
    np.testing.assert_allclose(found, alone + 3 * q, rtol=1e-12)


def test_the_number_of_steps_is_data(traces):
    most = int(fj.simulate(ARM, START, TS).stats["num_steps"])
    counted = traces(solve, "integrate")
    for allowed in (most + 1, most):
        motion = fj.simulate(ARM, START, TS, max_steps=allowed)
        assert motion.stats["num_steps"] == most
        assert motion.stats["max_steps"] == allowed
    for allowed in (most - 1, 1):
        motion = fj.simulate(ARM, START, TS, max_steps=allowed, throw=False)
        assert motion.outcome == "out of steps"
        assert motion.stats["num_steps"] == allowed
        assert 0 < motion.stats["time_reached"] < TS[-1]
    assert not counted


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps",
    [
        dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01),
        dict(dt0=None, rtol=1e-6),
    ],
)
def test_the_last_allowed_step_may_reach_the_end(steps):
    run = lambda **options: fj.simulate(
        ROD, TILTED, 10 * TS, solver=diffrax.Tsit5(), throw=False, **steps, **options
    )
    most, allowed = int(run().stats["num_steps"]), lambda n: run(max_steps=n)
    assert allowed(most).outcome == "successful"
    assert allowed(most - 1).outcome == "out of steps"


@pytest.mark.slow
def test_sweeps_in_a_loop_share_a_program(traces):
    counted, starts = traces(chunks, "solve_motion"), []
    for k in (1.0, 4.0):
        states = fj.State(np.stack([TILTED.q, TILTED.q + 0.1]), TILTED.qd)
        ends = fj.sweep(
            ROD,
            states,
            TS,
            (drag(k),),
            reduce=lambda scene, motion, k=k: k * motion.q[-1],
        )
        one = fj.simulate(ROD, TILTED, TS, (fj.JointDamper(k),))
        np.testing.assert_allclose(ends[0], k * one.q[-1], atol=1e-8)
        starts.append(len(counted))
    assert starts[0] == starts[1] > 0


@pytest.mark.slow
def test_fits_in_a_loop_share_a_program(traces):
    motion = fj.simulate(ROD, TILTED, TS, (fj.JointDamper(2.0),))
    counted, totals = traces(problems, "sensitivities"), []
    for k in (2.0, 4.0):

        def scene_at(parameters, k=k):
            damper = fj.JointDamper(k * parameters["share"])
            return fj.Scene(ROD, TILTED, (damper,), 0.1)

        found = fj.identification.fit(
            scene_at, {"share": 0.8}, TS, motion.q, observe=lambda scene, m: m.q
        )
        np.testing.assert_allclose(found.parameters["share"], 2 / k, rtol=1e-6)
        totals.append(len(counted))
    assert totals[0] == totals[1] > 0
