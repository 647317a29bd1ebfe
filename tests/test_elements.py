"""Properties of all force elements: gradients, batches and costs."""

from functools import partial

import diffrax
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS
from test_costs import flops

import fdof_jax as fj
from fdof_jax.forces.added_inertia import added_inertia
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.simulation.field import (
    Args,
    applied,
    initial_own,
    schedule_of,
    vector_field,
)

ARM = elements.arm("RPR")


def is_number(path, leaf):
    """Returns whether a leaf is an array of parameters; existence factors are not."""
    return eqx.is_inexact_array(leaf) and path[-1] != jax.tree_util.GetAttrKey("ef")


# Parameters that other limits hide.
IDLE = {"DCMotor.command.limit"}


def scaled(forces, factors):
    """Multiplies every number by its array's factor, or shifts it if it is zero."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(forces)
    factors = iter(factors)
    moved = []
    for path, leaf in leaves:
        if is_number(path, leaf):
            factor = next(factors)
            # Infinity stays: its derivative times 0 is not a number.
            finite = jnp.isfinite(leaf)
            number = jnp.where(finite, leaf, 1)
            changed = jnp.where(number == 0, factor - 1, number * factor)
            leaf = jnp.where(finite, changed, leaf)
        moved.append(leaf)
    return jax.tree.unflatten(structure, moved)


def names(forces):
    leaves, _ = jax.tree_util.tree_flatten_with_path(forces)
    return [
        type(forces[path[0].idx]).__name__ + jax.tree_util.keystr(path[1:])
        for path, leaf in leaves
        if is_number(path, leaf)
    ]


def end(linkage, forces, adjoint=diffrax.ForwardMode()):
    """Returns the end of a short motion; its fixed steps make differences exact."""
    return fj.simulate(
        linkage,
        elements.START,
        [0, 0.15],
        forces,
        solver=diffrax.Bosh3(),
        stepsize_controller=diffrax.ConstantStepSize(),
        dt0=5e-3,
        adjoint=adjoint,
    )


def state_of(solution):
    return jnp.concatenate([solution.q[-1], solution.qd[-1]])


def all_acts(linkage, forces, t, q, qd, grown):
    """Returns the elements' actions at a moment, in grown states, and first states."""
    args = Args(linkage, q, None, forces)
    own = jnp.stack(initial_own(args))
    y = zeros(q), tuple(qd), tuple(own + grown * jnp.cos(jnp.arange(own.size)))
    found = applied(t, y, args, schedule_of(t, args))
    leaves = jax.tree.leaves((found, own))
    return jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])


def acts_of_all():
    """Returns what all elements do at a moment, by one program."""
    forces = jax.tree.map(jnp.asarray, tuple(elements.ALL.values()))
    start = map(jnp.asarray, elements.START)
    return jax.jit(all_acts, **LOOPS)(ARM, forces, jnp.array(0.1), *start, 0.1)


def slopes_and_differences(both, ones):
    """Returns derivatives and differences by columns, from one compiled program."""
    h, still = 1e-5, jnp.zeros_like(ones)
    slopes, differences = [], []
    for e in np.eye(len(ones)):
        slopes.append(both(ones, e)[1])
        ends = [np.asarray(both(ones + s * h * e, still)[0]) for s in (1, -1)]
        differences.append((ends[0] - ends[1]) / (2 * h))
    return np.stack(slopes, axis=1), np.stack(differences, axis=1)


def check_slopes(forces, slopes, differences):
    """Checks the slopes; all parameters act except those that a limit disables."""
    size = np.abs(differences).max(axis=0)
    idle = {n for n, s in zip(names(forces), size) if s < 1e-6}
    assert idle <= IDLE, idle - IDLE
    error = np.abs(slopes - differences).max(axis=0)
    wrong = {
        n for n, e, s in zip(names(forces), error, size) if not e <= 1e-6 * s + 1e-8
    }
    assert not wrong


def test_slopes_in_all_parameters_equal_differences():
    limited = fj.control.SpeedLimit(elements.PD, stall=[1.0, 3.0, 0.5], no_load=4.0)
    forces = tuple((elements.ALL | {"speed limit": limited}).values())

    def acting(p, *at):
        return all_acts(ARM, scaled(forces, p), *at)

    # One direction at a time: many at once take longer to compile than to run.
    slope = lambda p, e, *at: jax.jvp(lambda p: acting(p, *at), (p,), (e,))
    both = jax.jit(slope, **LOOPS)
    rng = np.random.default_rng(0)
    found = []
    # In each interval of the history, and for most limits on both sides.
    for t in (0.03, 0.07, 0.15, 0.4):
        q = np.asarray(elements.START.q) + rng.uniform(-0.3, 0.3, 3)
        at = np.array(t), q, rng.uniform(-1, 1, 3), np.array(t)
        ones = jnp.ones(len(names(forces)))
        found.append(slopes_and_differences(lambda *a, at=at: both(*a, *at), ones))
    check_slopes(forces, *(np.concatenate(rows) for rows in zip(*found)))


def test_gradients_of_a_motion_equal_differences():
    """Forward mode, with the states and masses that motions carry along."""
    chosen = ("motor with PID", "actuator")
    forces = tuple(elements.ALL[name] for name in chosen)
    motion = lambda p: state_of(end(ARM, scaled(forces, p)))
    both = jax.jit(lambda p, e: jax.jvp(motion, (p,), (e,)), **LOOPS)
    ones = jnp.ones(len(names(forces)))
    check_slopes(forces, *slopes_and_differences(both, ones))


# Programs of seven elements are compiled in half the time of one with all.
@pytest.mark.slow
@pytest.mark.parametrize("kinds", np.array_split(list(elements.ALL), 3), ids=" ".join)
def test_reverse_mode_at_an_instant_equals_differences(kinds):
    """In all parameters, positions, velocities and own states, of what is integrated.

    The reverse mode of a motion consists of these derivatives: see
    test_chain_motions.py.
    """
    forces = tuple(elements.ALL[kind] for kind in kinds)
    labels = names(forces)
    ends = np.cumsum([len(labels), 3, 3, len(initial_own(arguments(forces)))])

    def found(t, x):
        factors, *parts = jnp.split(x, ends[:-1])
        y, args = tuple(map(tuple, parts)), arguments(scaled(forces, factors))
        return jnp.stack(jax.tree.leaves((field(t, y, args), initial_own(args))))

    @partial(jax.jit, **LOOPS)
    def both(x, t, weights):
        values, pull_back = jax.vjp(lambda x: found(t, x), x)
        return values, *pull_back(weights)

    value = lambda *at: np.asarray(both(*at)[0])
    rng, h, size = np.random.default_rng(0), 1e-5, 0
    for t in (0.02, 0.07, 0.15, 0.25):  # between the times of the history
        moving = rng.uniform(-0.3, 0.3, ends[-1] - len(labels))
        x = np.concatenate([np.ones(len(labels)), moving])
        weights = rng.normal(size=jax.eval_shape(found, t, x).size)
        columns = [
            (value(x + h * e, t, weights) - value(x - h * e, t, weights)) / (2 * h)
            for e in np.eye(x.size)
        ]
        differences = np.stack(columns, axis=1)
        error = np.abs(both(x, t, weights)[1] - weights @ differences)
        largest = np.abs(differences).max(axis=0)
        wrong = np.flatnonzero(~(error <= 1e-6 * largest + 1e-7))
        assert not wrong.size, [(*labels, *ends)[min(i, len(labels))] for i in wrong]
        size = np.maximum(size, largest)
    # All parameters act except those that a limit disables.
    idle = {n for n, s in zip(labels, size) if s < 1e-6}
    assert idle <= IDLE, idle - IDLE


def test_one_program_for_all_topologies():
    """Checks that elements act in a batch of all arms as on each arm alone.

    For motions in a batch, also with states of elements, see
    test_one_compilation.py and test_drives.py.
    """
    place = list(elements.ALL).index("computed torque")
    arms = [elements.arm(topology) for topology in fj.TOPOLOGIES]
    traces = []

    def acting(linkage):
        traces.append(1)
        # A model of another topology would be rejected.
        forces = tuple(elements.ALL.values())
        forces = eqx.tree_at(lambda f: f[place].model, forces, linkage)
        return all_acts(linkage, forces, jnp.array(0.1), *elements.START, 0.1)

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *arms)
    together, single = jax.jit(jax.vmap(acting))(stacked), jax.jit(acting)
    alone = [single(linkage) for linkage in arms]
    np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-9)
    assert len(traces) == 2
    # Efforts differ between topologies.
    assert len({row.tobytes() for row in np.asarray(alone).round(6)}) == len(arms)


SPOILT = {
    "gravity": lambda e: e.kd,
    "computed torque": lambda e: e.model.mass,
    "spring": lambda e: e.stiffness,
    "stops": lambda e: e.smoothing,
    "friction": lambda e: e.level,
    "PID": lambda e: e.ki,
    "lag": lambda e: e.time_constant,
    "motor": lambda e: e.command.kp,
    "speed limit": lambda e: e.stall,
    "armature": lambda e: e.inertia,
    "actuator": lambda e: e.mass,
}


@pytest.mark.parametrize("name", SPOILT)
def test_negative_values_that_no_constructor_saw_are_told(name):
    element = elements.ALL[name]
    spoilt = eqx.tree_at(SPOILT[name], element, -1 - SPOILT[name](element))
    with pytest.raises(ValueError, match=r"^(forces\[0\]\.\w+|model\.).*: expected"):
        fj.simulate(ARM, elements.START, [0, 0.1], (spoilt,))
    assert element.possible() and not jax.jit(lambda e: e.possible())(spoilt)


# Costs


def field(t, y, args):
    return vector_field(t, y, args, schedule_of(t, args))


def arguments(forces):
    q = elements.START.q
    return Args(ARM, q, link_constants(ARM, q), forces)


def field_flops(*forces):
    q, t = elements.START.q, jnp.array(0.1)
    args = arguments(forces)
    y = zeros(q), tuple(elements.START.qd), initial_own(args)
    return flops(field, t, y, args)


@pytest.fixture(scope="module")
def bare():
    return field_flops()


@pytest.mark.parametrize("name", elements.PLAIN)
def test_a_plain_element_costs_its_own(name, bare):
    element = elements.PLAIN[name]
    own = flops(lambda e, *a: e(*a), element, jnp.array(0.1), *elements.START, ARM)
    assert 0 <= field_flops(element) - bare <= own + 6


@pytest.mark.parametrize("name", elements.WITH_STATE)
def test_an_element_with_state_costs_its_own(name, bare):
    element = elements.WITH_STATE[name]
    state = element.initial_state(ARM)
    own = flops(
        lambda e, *a: e(*a), element, jnp.array(0.1), *elements.START, ARM, state
    )
    assert 0 < field_flops(element) - bare <= own + 6


@pytest.mark.parametrize("name", elements.WITH_INERTIA)
def test_an_element_with_inertia_costs_its_own(name, bare):
    """Adding to the entries of the mass matrix costs six sums more."""
    element = elements.WITH_INERTIA[name]
    own = flops(lambda e, *a: e(*a), element, jnp.array(0.1), *elements.START, ARM)
    own += flops(
        lambda arm, e, *a: added_inertia(arm, (e,), *a), ARM, element, *elements.START
    )
    assert 0 < field_flops(element) - bare <= own + 15
