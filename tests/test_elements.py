"""Laws of all force elements: energy, derivatives, batches, bounds and costs."""

import dataclasses
from functools import cache

import chains
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
from fdof_jax.simulation.simulate import check_elements
from fdof_jax.simulation.vector_field import (
    Args,
    applied,
    initial_own,
    schedule_of,
    vector_field,
)

ARM = elements.arm("RPR")
EVERY = elements.ALL | elements.HOLDING

# Energy

# Numbers without which elements keep the energy. That of an actuator adds energy: see
# test_actuators.py.
LOSSES = {"coefficient", "level", "damping"}
BETWEEN = fj.Point(1, 0.4, 0.1), elements.TIP  # of two links that move
SHORT_SPRING = fj.SpringDamper(*BETWEEN, stiffness=30.0, damping=0.5)
PASSIVE = {
    name: part
    for name, part in (elements.ALL | {"short spring": SHORT_SPRING}).items()
    if part.potential_energy is not None or LOSSES & set(part.arguments())
}
PASSIVE["actuator"] = PASSIVE["actuator"].replace(force=0.0)
STORING = [
    name
    for name, part in PASSIVE.items()
    if part.potential_energy is not None and name not in elements.WITH_INERTIA
]


def with_losses(part, factor):
    given = part.arguments().items()
    return part.replace(**{name: factor * v for name, v in given if name in LOSSES})


@eqx.filter_jit
def balance(linkage, parts, q, qd, tau):
    """Returns powers of the elements, and what the arm and all of them gain."""
    forces = tuple(parts.values())
    efforts = {name: part(0.1, q, qd, linkage) for name, part in parts.items()}
    total = tau + sum(efforts.values())
    qdd = fj.forward_dynamics(linkage, q, qd, total, forces)
    energy = lambda q, qd: sum(fj.energy(linkage, q, qd, forces))
    stored = lambda q: {
        name: parts[name].potential_energy(q, linkage) for name in STORING
    }
    matrix = fj.mass_matrix(linkage, q, forces)
    return dict(
        power={name: effort @ qd for name, effort in efforts.items()},
        storing=jax.jvp(stored, (q,), (qd,))[1],
        gain=jax.jvp(energy, (q, qd), (qd, qdd))[1] - tau @ qd,
        total=total,
        inverse=fj.inverse_dynamics(linkage, q, qd, qdd, forces),
        matrix=matrix,
        product=matrix @ qdd + fj.bias_force(linkage, q, qd, forces),
    )


@pytest.mark.slow
@pytest.mark.parametrize("topology", [*fj.TOPOLOGIES, "RFP", "FPR"])
def test_energy_is_kept_but_for_what_dampers_take(topology):
    arm, real = elements.arm(topology), chains.moving(topology)
    rng, lost = np.random.default_rng(0), {}
    for _ in range(8):
        state = np.where(real, rng.uniform(-1, 1, (3, 3)), 0)
        for factor in (0.0, 1.0):
            parts = {name: with_losses(e, factor) for name, e in PASSIVE.items()}
            found = jax.tree.map(np.asarray, balance(arm, parts, *state))
            for name in ("inverse", "product"):
                expected = np.where(real, found["total"], 0)
                np.testing.assert_allclose(found[name], expected, atol=1e-10)
            np.testing.assert_array_equal(found["matrix"], found["matrix"].T)
            assert np.linalg.eigvalsh(found["matrix"]).min() > 0
            loss = {
                name: found["storing"].get(name, 0) + power
                for name, power in found["power"].items()
            }
            np.testing.assert_allclose(found["gain"], sum(loss.values()), atol=1e-10)
            for name, value in loss.items():
                assert value < 1e-12 and (factor or abs(value) < 1e-12), name
                lost[name] = min(lost.get(name, 0), value)
    for name, part in PASSIVE.items():
        assert (lost[name] < -1e-6) == bool(LOSSES & set(part.arguments())), name


# Derivatives


def is_number(path, leaf):
    """Returns whether a leaf is an array of parameters; existence factors are not."""
    return eqx.is_inexact_array(leaf) and path[-1] != jax.tree_util.GetAttrKey("ef")


# Parameters that other limits hide.
IDLE = {"DCMotor.command.limit", "Actuators.upper", "Actuators.effort_lower"}
IDLE |= {"Payload.velocity"}  # before it is taken


def scaled(forces, factors):
    """Multiplies every number by its array's factor, or shifts it if it is zero."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(forces)
    factors = iter(factors)
    numbers = []
    for path, leaf in leaves:
        if is_number(path, leaf):
            factor = next(factors)
            # Infinity stays: its derivative times 0 is not a number.
            finite = jnp.isfinite(leaf)
            number = jnp.where(finite, leaf, 1)
            product = jnp.where(number == 0, factor - 1, number * factor)
            leaf = jnp.where(finite, product, leaf)
        numbers.append(leaf)
    return jax.tree.unflatten(structure, numbers)


def names(forces):
    leaves, _ = jax.tree_util.tree_flatten_with_path(forces)
    return [
        type(forces[path[0].idx]).__name__ + jax.tree_util.keystr(path[1:])
        for path, leaf in leaves
        if is_number(path, leaf)
    ]


FORCES = tuple(elements.ALL.values())
LABELS = [*names(FORCES), *["q"] * 3, *["qd"] * 3]


def acts(linkage, forces, t, q, qd, grown):
    """Returns the elements' actions at a moment, in grown states, and first states."""
    args = Args(linkage, q, None, forces)
    own = jnp.stack(initial_own(args))
    y = zeros(q), tuple(qd), tuple(own + grown * jnp.cos(jnp.arange(own.size)))
    found = applied(t, y, args, schedule_of(t, args))
    leaves = jax.tree.leaves((found.tau, found.own_rates, found.added, own))
    return jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])


def acts_of_all():
    """Returns what all elements do at a moment, by one program."""
    forces = jax.tree.map(jnp.asarray, FORCES)
    start = map(jnp.asarray, elements.START)
    return jax.jit(acts, **LOOPS)(ARM, forces, jnp.array(0.1), *start, 0.1)


def acts_at(t, x):
    """Returns the same by factors of all numbers, positions, velocities and states."""
    factors, q, qd, grown = jnp.split(x, np.cumsum([len(LABELS) - 6, 3, 3]))
    return acts(ARM, scaled(FORCES, factors), t, q, qd, grown)


def differences(value, x, h=1e-5):
    """Returns central differences, by columns."""
    ends = [(value(x + h * e), value(x - h * e)) for e in np.eye(x.size)]
    return np.stack([(np.asarray(a) - b) / (2 * h) for a, b in ends], axis=1)


def check_slopes(labels, slopes, expected):
    """Checks the slopes; all parameters act except those that a limit disables."""
    size = np.abs(expected).max(axis=0)
    idle = {label for label, s in zip(labels, size) if s < 1e-6}
    assert idle <= IDLE, idle - IDLE
    error = np.abs(slopes - expected).max(axis=0)
    wrong = {n for n, e, s in zip(labels, error, size) if not e <= 1e-6 * s + 1e-7}
    assert not wrong


@pytest.fixture(scope="module")
def instants():
    """Returns times, numbers and differences of what all elements do there."""
    # One direction at a time: many at once take longer to compile than to run.
    slope = lambda t, x, e: jax.jvp(lambda x: acts_at(t, x), (x,), (e,))
    both, rng, found = jax.jit(slope, **LOOPS), np.random.default_rng(0), []
    states = len(initial_own(Args(ARM, elements.START.q, None, FORCES)))
    # In each interval of the history, and for most limits on both sides.
    for t in (0.03, 0.07, 0.15, 0.4):
        q = np.asarray(elements.START.q) + rng.uniform(-0.3, 0.3, 3)
        rest = q, rng.uniform(-1, 1, 3), np.full(states, t)
        x = np.concatenate([np.ones(len(LABELS) - 6), *rest])
        still = np.zeros(x.size)
        value = lambda x, t=t, still=still: both(t, x, still)[0]
        slopes = np.stack([both(t, x, e)[1] for e in np.eye(x.size)], axis=1)
        found.append((t, x, slopes, differences(value, x)))
    return found


def labels_of(x):
    return [*LABELS, *["state"] * (x.size - len(LABELS))]


@pytest.mark.slow
def test_slopes_in_all_numbers_equal_differences(instants):
    _, xs, *rows = zip(*instants)
    check_slopes(labels_of(xs[0]), *map(np.concatenate, rows))


@pytest.mark.slow
def test_reverse_mode_gives_the_same_slopes(instants):
    """The reverse mode of a motion consists of these: see test_chain_motions.py."""

    def pulled_back(t, x, weights):
        return jax.vjp(lambda x: acts_at(t, x), x)[1](weights)[0]

    rng, pull_back = np.random.default_rng(0), jax.jit(pulled_back, **LOOPS)
    for t, x, slopes, _ in instants:
        weights = rng.normal(size=len(slopes))
        expected = weights @ slopes
        scale = 1e-9 * np.abs(slopes).max(axis=0) + 1e-9
        error = np.abs(pull_back(t, x, weights) - expected)
        assert not {n for n, e, s in zip(labels_of(x), error, scale) if not e <= s}


@pytest.mark.slow
def test_gradients_of_a_motion_equal_differences():
    """Forward mode, with the states and masses that motions carry along."""
    forces = tuple(elements.ALL[name] for name in ("motor with PID", "actuator"))
    # Fixed steps make differences exact.
    steps = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=5e-3)
    options = dict(solver=diffrax.Bosh3(), adjoint=diffrax.ForwardMode(), **steps)

    def end(p):
        parts = scaled(forces, p)
        motion = fj.simulate(ARM, elements.START, [0, 0.15], parts, **options)
        return jnp.concatenate([motion.q[-1], motion.qd[-1]])

    both = jax.jit(lambda p, e: jax.jvp(end, (p,), (e,)), **LOOPS)
    ones = np.ones(len(names(forces)))
    slopes = np.stack([both(ones, e)[1] for e in np.eye(ones.size)], axis=1)
    value = lambda p: both(p, np.zeros(ones.size))[0]
    check_slopes(names(forces), slopes, differences(value, ones))


@pytest.mark.slow
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
        forces = eqx.tree_at(lambda f: f[place].model, FORCES, linkage)
        return acts(linkage, forces, jnp.array(0.1), *elements.START, 0.1)

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *arms)
    together, single = jax.jit(jax.vmap(acting))(stacked), jax.jit(acting)
    alone = [single(linkage) for linkage in arms]
    np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-9)
    assert len(traces) == 2
    # Efforts differ between topologies.
    assert len({row.tobytes() for row in np.asarray(alone).round(6)}) == len(arms)


# Bounds


def bounded(element):
    """Returns the names of the arrays that a value of -1 is out of bounds for."""
    for declared in dataclasses.fields(element):
        rules = declared.metadata.get("rules", {})
        low = rules.get("minimum") is not None or rules.get("above") is not None
        if low and getattr(element, declared.name) is not None:
            yield declared.name


@pytest.mark.parametrize("name", EVERY)
def test_values_that_no_constructor_saw_are_told_where_they_are(name):
    element, ts = EVERY[name], jnp.array([0.0, 0.1])
    within = {"computed torque": "model.mass", "motor with PID": "command.pd.kd"}
    places = [*bounded(element), *([within[name]] if name in within else [])]
    possible = jax.jit(lambda e: e.possible())
    assert possible(element)
    for place in places:
        where = lambda e, place=place: eval(f"e.{place}")
        spoilt = eqx.tree_at(where, element, -1 - where(element))
        with pytest.raises(ValueError, match=rf"^(forces\[0\]\.)?{place}.*: expected"):
            check_elements((spoilt,), ARM, ts)
        assert not possible(spoilt), place


# Costs


def field_flops(*forces):
    q, t = elements.START.q, jnp.array(0.1)
    args = Args(ARM, q, link_constants(ARM, q), forces)
    y = zeros(q), tuple(elements.START.qd), initial_own(args)
    return flops(lambda t, y, a: vector_field(t, y, a, schedule_of(t, a)), t, y, args)


bare = cache(field_flops)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_an_element_costs_its_own(name):
    """Besides adding its efforts, and six entries of the mass matrix if it has any."""
    element, at = EVERY[name], (jnp.array(0.1), *elements.START, ARM)
    state = element.initial_state(ARM)
    own = 6 + flops(lambda e, *a: e.act(*a), element, *at, state)
    if isinstance(element, fj.forces.InertialElement):
        added = lambda arm, e, *a: added_inertia(arm, (e,), *a)
        own += 9 + flops(added, ARM, element, *elements.START)
    if name == "taken":  # whether it is
        own += flops(lambda e, t: e.at(t), element, at[0])
    assert 0 <= field_flops(element) - bare() <= own
