"""Unused features cost nothing: lowered operation counts are exact."""

import functools
import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from elements import Hold
from jax.extend.core import ClosedJaxpr, Jaxpr

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.base.checks import is_traced
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.mechanics.rates import rates
from fdof_jax.simulation.arrays import _packed
from fdof_jax.simulation.vector_field import Args, schedule_of, vector_field


def cost(kind, function, *arguments):
    found = jax.jit(function).lower(*arguments).cost_analysis()
    assert "bytes accessed" in found  # as in every analysis
    return found.get(kind, 0)  # left out where there are none


flops = functools.partial(cost, "flops")
transcendentals = functools.partial(cost, "transcendentals")


def field_arguments(forces):
    linkage = scenes.fig7().linkage
    q = jnp.array([0.3, 2.0, -0.4])
    constants = jax.jit(link_constants)(linkage, q)  # of which joints, is not known
    args = Args(linkage, q, constants, forces)
    return jnp.array(0.1), (zeros(q), tuple(q)), args


def field(t, y, args):
    return vector_field(t, y, args, schedule_of(t, args))


def field_flops(*forces):
    return flops(field, *field_arguments(forces))


def element_flops(element):
    linkage = scenes.fig7().linkage
    q = jnp.array([0.3, 2.0, -0.4])
    return flops(lambda e, *a: e(*a), element, jnp.array(0.1), q, q, linkage)


def test_a_scene_without_elements_costs_the_bare_equations():
    """On CPU sine and cosine are polynomials; a matrix factorisation would be seen."""
    t, (delta, qd), args = field_arguments(())
    bare = flops(rates, args.constants, delta, qd, delta)
    assert 0 < field_flops() == bare <= 530  # 571 by hand
    assert transcendentals(field, t, (delta, qd), args) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name, most", [("fig5", 8242), ("fig7", 22113)])
def test_motions_do_not_pay_for_ends_and_jumps_that_they_lack(name, most):
    """Programs are as large as before there were conditions, within 2 operations."""
    linkage, state0, forces, *_ = getattr(scenes, name)()
    ts = jnp.linspace(0, 1, 12)

    def motion(q):
        start = fj.State(q, jnp.zeros(3))
        return fj.simulate(linkage, start, ts, forces, throw=False).q

    assert flops(motion, jnp.asarray(state0.q)) <= most


def test_joints_that_are_known_to_be_absent_cost_nothing():
    q, arm = jnp.array([0.3, 2.0, -0.4]), scenes.fig5().linkage
    known, asked = link_constants(arm, q), jax.jit(link_constants)(arm, q)
    of_known, of_any = (
        flops(rates, c, zeros(q), tuple(q), zeros(q)) for c in (known, asked)
    )
    assert of_known <= 416 < of_any <= 530


def test_constants_of_known_joints_have_no_flags():
    known = link_constants(scenes.fig7().linkage, jnp.zeros(3))
    packed = _packed(known)
    assert packed.flags.size == 0 and eqx.tree_equal(packed.scalars(), known)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.filterwarnings("ignore:linkage. expected numbers in double precision")
def test_elements_see_known_existence_factors_in_the_precision_of_motions(dtype):
    class Looking(fj.forces.StatefulElement):
        def initial_state(self, linkage):
            seen.append(linkage.ef)
            return linkage.ef.at[0].set(0.5)[:1]

        def __call__(self, t, q, qd, linkage, state):
            return -state * qd, -state

    def motion(mass):
        one = eqx.tree_at(lambda arm: arm.mass, arm, mass)
        return fj.simulate(one, state0, [0, 1.0], (Looking(),), throw=False).q

    seen, (arm, state0, *_) = [], scenes.fig5()
    arm = jax.tree.map(lambda leaf: leaf.astype(dtype), arm)
    jax.eval_shape(motion, arm.mass)
    assert {ef.dtype for ef in seen} == {jnp.dtype(float)}  # that of the motion
    assert any(not is_traced(ef) for ef in seen)


def test_a_program_contains_existence_factors_that_are_known():
    """Also those of an arm that is changed within a transformation."""
    arm, state0 = scenes.fig5().linkage, fj.State([0.1, 0.2, 0.3], jnp.zeros(3))
    motion = lambda arm: fj.simulate(arm, state0, [0, 1.0]).q
    known = flops(lambda mass: motion(arm.replace(mass=mass)), arm.mass)
    assert known < flops(motion, arm) - 12 * 80  # at the stages of a step


@pytest.mark.parametrize(
    "element",
    [
        fj.JointDamper(2.0),
        fj.JointEffort([1.0, 2.0, 3.0]),
        fj.forces.EffortHistory([0.0, 0.2], [[1, 2, 3], [3, 2, 1]]),
        scenes.fig7().forces[0],
    ],
    ids=["damper", "effort", "history", "PD circle"],
)
def test_an_element_adds_its_own_cost_and_three_additions(element):
    """At most three additions: inputs that an element does not read cost nothing."""
    own = element_flops(element)
    assert own <= field_flops(element) - field_flops() <= own + 3
    damper = fj.JointDamper(1.0)
    both = field_flops(damper, element) - field_flops()
    assert both <= element_flops(damper) + own + 6


def test_a_model_costs_only_the_controllers_that_have_one():
    """PD control costs two errors, two gains, a sum and the limit at each joint."""
    gains = 9.0, 3.0, 10.0, Hold(jnp.ones(3))
    plain, held, computed = (
        element_flops(kind(*gains))
        for kind in (
            fj.PDController,
            fj.control.GravityFeedforward,
            fj.control.ComputedTorque,
        )
    )
    assert plain == 36 < held <= 351 and computed <= 850


def inner(equation):
    """Returns the programs in an equation; older versions of JAX do not."""
    parts = jax.tree.leaves(equation.params)
    held = [part for part in parts if isinstance(part, Jaxpr | ClosedJaxpr)]
    return [getattr(part, "jaxpr", part) for part in held]


@pytest.mark.parametrize("derivatives", [False, True])
def test_what_depends_on_time_alone_is_computed_once_a_step(derivatives):
    """Also where efforts have limits, and where derivatives need short steps."""
    scene = scenes.fig7()

    def motion(gain):
        follow = lambda t, linkage: (jnp.sinh(t) * jnp.ones(3), jnp.zeros(3))
        pd = fj.PDController(gain, 10.0, [100.0, 30.0, 40.0], follow)
        forward = diffrax.ForwardMode()
        return fj.simulate(*scene[:2], [0, 1.0], (pd,), adjoint=forward).q

    def count(jaxpr):
        own = sum(equation.primitive.name == "sinh" for equation in jaxpr.eqns)
        parts = (part for equation in jaxpr.eqns for part in inner(equation))
        return own + sum(map(count, parts))

    motion = jax.jacfwd(motion) if derivatives else motion
    assert count(jax.make_jaxpr(motion)(100.0).jaxpr) == 1


def stacked_in_loops(forces):
    """Returns whether the loops of a solve stack or concatenate arrays."""
    linkage = scenes.fig5().linkage

    def motion(q):
        state = fj.State(q, jnp.zeros(3))
        return fj.simulate(linkage, state, [0, 1.0], forces, throw=False).q

    def found(jaxpr, inside):
        names = {"stack", "concatenate"} if inside else set()
        return any(
            equation.primitive.name in names
            or any(
                found(part, inside or equation.primitive.name == "while")
                for part in inner(equation)
            )
            for equation in jaxpr.eqns
        )

    return found(jax.make_jaxpr(motion)(jnp.zeros(3)).jaxpr, False)


def test_the_dynamics_outputs_are_not_stacked():
    """XLA on CPU would compute the equations once per entry of a stacked output.

    A plain function of arrays needs stacked inputs.
    """
    assert not stacked_in_loops((fj.JointDamper(1.0),))
    assert stacked_in_loops((lambda t, q, qd, linkage: -qd,))


@pytest.fixture(scope="module")
def compiled_solve():
    """Returns the text of the compiled batch solve of Fig 5."""
    linkage, ts = scenes.fig5().linkage, jnp.linspace(0, 1, 12)

    def motion(q):
        state = fj.State(q, jnp.zeros(3))
        return fj.simulate(linkage, state, ts, throw=False).q

    return jax.jit(jax.vmap(motion)).lower(jnp.zeros((16, 3))).compile().as_text()


@pytest.mark.slow
def test_each_stage_is_one_loop(compiled_solve):
    """Checks that no rate, and no end of a step, is computed more than once.

    There are six rates at twelve stages, or three where no interpolation needs the
    velocities, and the conditioning of each joint where steps begin and end. One more
    loop may be that of the interpolation.
    """

    def loops(results):
        array = r"f64\[16\](\{0\})?"
        more = rf"(, (/\*index=\d+\*/)?{array}){{{results - 1}}}"
        return len(re.findall(rf"= \({array}{more}\) fusion\(", compiled_solve))

    assert loops(6) + loops(3) in (12, 13) and loops(9) == 2
    assert loops(18) == 1  # state, error and rounding at the end of a step
    # A second evaluation would repeat the polynomial's leading coefficient.
    assert compiled_solve.count("1.5918129027234826e-10") <= 3 * 14 + 4


def test_saving_does_not_copy_what_has_been_saved(compiled_solve):
    """Checks that (member, time) buffers are written in place."""
    loops, entry = compiled_solve.split("\nENTRY")
    copy = r"= f64\[16,12\]\S* copy\("
    assert re.search(copy, entry)  # each of six starts as a copy of one buffer
    assert not re.search(copy, loops)


def test_steps_do_not_depend_on_how_many_times_are_saved():
    scene = scenes.fig5()
    steps = [
        int(fj.simulate(scene.linkage, scene.state0, ts).stats["num_steps"])
        for ts in ([0, 1.0], jnp.linspace(0, 1, 12), jnp.linspace(0, 1, 101))
    ]
    assert steps[0] == steps[1] == steps[2]
