"""Laws of all force elements: energy and derivatives."""

import chains
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.mechanics.equations import zeros
from fdof_jax.simulation.vector_field import Args, applied, initial_own, schedule_of

pytestmark = pytest.mark.slow
ARM = elements.arm("RPR")

# Energy

# Numbers without which elements keep the energy. That of an actuator adds energy: see
# test_points.py.
LOSSES = {"coefficient", "level", "damping"}
BETWEEN = fj.Point(1, 0.4, 0.1), elements.TIP  # of two links that move
MORE = {
    "short spring": fj.SpringDamper(*BETWEEN, stiffness=30.0, damping=0.5),
    "plain stops": elements.PLAIN["stops"].replace(smoothing=None),
}
PASSIVE = {
    name: part
    for name, part in (elements.ALL | MORE).items()
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


@eqx.filter_jit(**LOOPS)
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


@pytest.mark.parametrize("topology", [*fj.TOPOLOGIES, "RFP", "FPR"])
def test_energy_is_kept_but_for_what_dampers_take(topology):
    arm, real = elements.arm(topology), chains.moving(topology)
    rng, lost = np.random.default_rng(0), {}
    for _ in range(4):
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

# Parameters that other limits hide; a payload's velocity counts where it is taken.
IDLE = {"DCMotor.command.limit", "Actuators.upper", "Actuators.effort_lower"}
IDLE |= {"Payload.velocity"}
FORCES = tuple(elements.ALL.values())


def is_number(path, leaf):
    """Returns whether a leaf is an array of parameters; existence factors are not."""
    return eqx.is_inexact_array(leaf) and path[-1] != jax.tree_util.GetAttrKey("ef")


LEAVES, STRUCTURE = jax.tree_util.tree_flatten_with_path(FORCES)
LABELS = [
    type(FORCES[path[0].idx]).__name__ + jax.tree_util.keystr(path[1:])
    for path, leaf in LEAVES
    if is_number(path, leaf)
]


def scaled(factors):
    """Multiplies every number by its array's factor, or shifts it if it is zero."""
    factors, numbers = iter(factors), []
    for path, leaf in LEAVES:
        if is_number(path, leaf):
            factor = next(factors)
            # Infinity stays: its derivative times 0 is not a number.
            finite = jnp.isfinite(leaf)
            number = jnp.where(finite, leaf, 1)
            product = jnp.where(number == 0, factor - 1, number * factor)
            leaf = jnp.where(finite, product, leaf)
        numbers.append(leaf)
    return jax.tree.unflatten(STRUCTURE, numbers)


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


def test_slopes_in_all_numbers_equal_differences():
    """The reverse mode of a motion transposes these: see test_chain_motions.py."""
    states = len(initial_own(Args(ARM, elements.START.q, None, FORCES)))
    labels = [*LABELS, *["q"] * 3, *["qd"] * 3, *["state"] * states]

    def at(t, x):
        factors, q, qd, grown = jnp.split(x, np.cumsum([len(LABELS), 3, 3]))
        return acts(ARM, scaled(factors), t, q, qd, grown)

    # One direction at a time: many at once take longer to compile than to run.
    slope = lambda t, x, e: jax.jvp(lambda x: at(t, x), (x,), (e,))
    both, rng, h = jax.jit(slope, **LOOPS), np.random.default_rng(0), 1e-5
    error, size = np.zeros((2, len(labels)))
    # In each interval of the history, and for most limits on both sides.
    for t in (0.03, 0.07, 0.15, 0.4):
        q = np.asarray(elements.START.q) + rng.uniform(-0.3, 0.3, 3)
        rest = q, rng.uniform(-1, 1, 3), np.full(states, t)
        x = np.concatenate([np.ones(len(LABELS)), *rest])
        for k, e in enumerate(np.eye(x.size)):
            (ahead, _), (behind, _) = both(t, x + h * e, e), both(t, x - h * e, e)
            difference = (np.asarray(ahead) - behind) / (2 * h)
            wrong = np.abs(both(t, x, e)[1] - difference).max()
            error[k] = np.maximum(error[k], wrong)  # NaN if it is
            size[k] = max(size[k], np.abs(difference).max())
    idle = {label for label, s in zip(labels, size) if s < 1e-6}
    assert idle <= IDLE, idle - IDLE
    wrong = {n for n, e, s in zip(labels, error, size) if not e <= 1e-6 * s + 1e-7}
    assert not wrong
