"""Unused features cost nothing: lowered operation counts are exact."""

import functools
import re

import diffrax
import jax
import jax.numpy as jnp
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.mechanics.rates import rates
from fdof_jax.simulation.vector_field import Args, schedule_of, vector_field

# Links whose programs are small
ROD = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
RODS, STILL = scenes.double_pendulum().linkage, fj.State([0.3], [0.0])


def cost(kind, function, *arguments):
    found = jax.jit(function).lower(*arguments).cost_analysis()
    assert "bytes accessed" in found  # as in every analysis
    return found.get(kind, 0)  # left out where there are none


flops = functools.partial(cost, "flops")


def test_a_scene_without_elements_costs_the_bare_equations():
    """On CPU sine and cosine are polynomials; a matrix factorisation would be seen."""
    linkage, q = scenes.fig7().linkage, jnp.array([0.3, 2.0, -0.4])
    constants = jax.jit(link_constants)(linkage, q)  # of which joints, is not known
    still, qd, args = zeros(q), tuple(q), Args(linkage, q, constants, ())
    field = lambda t, y, args: vector_field(t, y, args, schedule_of(t, args))
    at = jnp.array(0.1), (still, qd), args
    bare = flops(rates, constants, still, qd, still)
    assert 0 < flops(field, *at) == bare <= 530  # 571 by hand
    assert cost("transcendentals", field, *at) == 0


@pytest.mark.slow
def test_motions_do_not_pay_for_ends_and_jumps_that_they_lack():
    """Programs are as large as before there were conditions, within 2 operations.

    Besides, 36 are of loops for sines and cosines, without which XLA computes those of
    the circle 14 times.
    """
    linkage, state0, forces, *_ = scenes.fig7()
    ts = jnp.linspace(0, 1, 12)

    def motion(q):
        start = fj.State(q, jnp.zeros(3))
        return fj.simulate(linkage, start, ts, forces, throw=False).q

    assert flops(motion, jnp.asarray(state0.q)) <= 22149


def test_joints_that_are_known_to_be_absent_cost_nothing():
    """Also those of an arm that is changed within a transformation."""
    q, arm = jnp.array([0.3, 2.0, -0.4]), scenes.fig5().linkage
    known, asked = link_constants(arm, q), jax.jit(link_constants)(arm, q)
    cost_of = lambda constants: flops(rates, constants, zeros(q), tuple(q), zeros(q))
    assert cost_of(known) <= 416 < cost_of(asked) <= 530
    motion = lambda arm: fj.simulate(arm, fj.State(q, jnp.zeros(3)), [0, 1.0]).q
    known = flops(lambda mass: motion(arm.replace(mass=mass)), arm.mass)
    assert known < flops(motion, arm) - 12 * 80  # at the stages of a step


def inner(equation):
    """Returns the programs in an equation; older versions of JAX do not."""
    parts = jax.tree.leaves(equation.params)
    held = [part for part in parts if isinstance(part, Jaxpr | ClosedJaxpr)]
    return [getattr(part, "jaxpr", part) for part in held]


def test_what_depends_on_time_alone_is_computed_once_a_step():
    """Also where efforts have limits, and where derivatives need short steps."""

    def motion(gain):
        follow = lambda t, linkage: (jnp.sinh(t) * jnp.ones(1), jnp.zeros(1))
        forces = (fj.PDController(gain, 10.0, 100.0, follow),)
        forward = diffrax.ForwardMode()
        return fj.simulate(ROD, STILL, [0, 1.0], forces, adjoint=forward).q

    def count(jaxpr):
        own = sum(equation.primitive.name == "sinh" for equation in jaxpr.eqns)
        parts = (part for equation in jaxpr.eqns for part in inner(equation))
        return own + sum(map(count, parts))

    for function in motion, jax.jacfwd(motion):
        assert count(jax.make_jaxpr(function)(100.0).jaxpr) == 1


def test_a_circles_angles_are_computed_once():
    """XLA on CPU would compute them anew for each number that needs them."""
    at = jax.jit(lambda circle, t, arm: circle(t, arm))
    program = at.lower(fj.CircleTask(), 0.1, scenes.fig7().linkage).compile()
    # The sine's leading coefficient: now, at the start, and for the last link.
    assert program.as_text().count("1.5918129027234826e-10") == 3


def stacked(jaxpr, inside=False):
    """Returns whether the loops of a program stack or concatenate arrays."""
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        within = inside or name == "while"
        if inside and name in ("stack", "concatenate"):
            return True
        if any(stacked(part, within) for part in inner(equation)):
            return True
    return False


def test_the_dynamics_outputs_are_not_stacked():
    """XLA on CPU would compute the equations once per entry of a stacked output.

    A plain function of arrays needs stacked inputs.
    """

    def motion(q, *forces):
        state = fj.State(q, jnp.zeros(2))
        return fj.simulate(RODS, state, [0, 1.0], forces, throw=False).q

    of = lambda force: jax.make_jaxpr(lambda q: motion(q, force))(jnp.zeros(2)).jaxpr
    assert not stacked(of(fj.JointDamper(1.0)))
    assert stacked(of(lambda t, q, qd, linkage: -qd))


@functools.cache
def compiled_solve():
    """Returns the text of the compiled batch solve of Fig 5."""
    linkage, ts = scenes.fig5().linkage, jnp.linspace(0, 1, 12)

    def motion(q):
        return fj.simulate(linkage, fj.State(q, jnp.zeros(3)), ts, throw=False).q

    return jax.jit(jax.vmap(motion)).lower(jnp.zeros((16, 3))).compile().as_text()


@pytest.mark.slow
def test_each_stage_is_one_loop():
    """Checks that no rate, and no end of a step, is computed more than once.

    There are six rates at twelve stages, or three where no interpolation needs the
    velocities, and the conditioning of each joint where steps begin and end. One more
    loop may be that of the interpolation.
    """

    text = compiled_solve()

    def loops(results):
        array = r"f64\[16\](\{0\})?"
        more = rf"(, (/\*index=\d+\*/)?{array}){{{results - 1}}}"
        return len(re.findall(rf"= \({array}{more}\) fusion\(", text))

    assert loops(6) + loops(3) in (12, 13) and loops(9) == 2
    assert loops(18) == 1  # state, error and rounding at the end of a step
    # A second evaluation would repeat the polynomial's leading coefficient.
    assert text.count("1.5918129027234826e-10") <= 3 * 14 + 4


def test_saving_does_not_copy_what_has_been_saved():
    """Checks that (member, time) buffers are written in place."""
    loops, entry = compiled_solve().split("\nENTRY")
    copy = r"= f64\[16,12\]\S* copy\("
    assert re.search(copy, entry)  # each of six starts as a copy of one buffer
    assert not re.search(copy, loops)


def test_steps_do_not_depend_on_how_many_times_are_saved():
    steps = lambda ts: int(fj.simulate(ROD, STILL, ts).stats["num_steps"])
    assert steps([0, 1.0]) == steps(jnp.linspace(0, 1, 101))
