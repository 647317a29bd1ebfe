"""Joints that bounce together come to rest, and energy is accounted for."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS, jacobian

import fdof_jax as fj

GRAVITY = 9.81
BALL = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])


def hits(height, restitution, count):
    """Returns the times at which a ball hits the floor, in closed form."""
    flights = restitution ** jnp.arange(1, count)
    fall = jnp.sqrt(2 * height / GRAVITY)
    return fall * (1 + 2 * jnp.concatenate([jnp.zeros(1), jnp.cumsum(flights)]))


def dropped(height, restitution, ts, **options):
    floor = fj.forces.HardStops(0.0, np.inf, restitution=restitution)
    start = fj.State(jnp.stack([height]), jnp.zeros(1))
    return fj.simulate(BALL, start, ts, (floor,), **options)


@pytest.mark.parametrize("restitution", [1.0, 1 - 1e-12, 0.9])
def test_thirty_bounces_take_what_restitution_tells(restitution):
    """A step that is tried from a bounce on may reach a kilometre below the floor."""
    expected = np.asarray(hits(10.0, restitution, 30))
    between = expected + 0.3 * expected[0] * restitution ** np.arange(1, 31)
    motion = dropped(jnp.array(10.0), restitution, [0, *between])
    np.testing.assert_allclose(motion.events.t[:30], expected, rtol=0, atol=1e-10)
    energy = motion.qd[1:, 0] ** 2 / 2 + GRAVITY * motion.q[1:, 0]
    left = 10 * GRAVITY * restitution ** (2 * np.arange(1, 31))
    np.testing.assert_allclose(energy, left, rtol=1e-11)
    np.testing.assert_allclose(motion.taken[1:], 10 * GRAVITY - left, atol=1e-9)
    assert motion.events.count == 30


@pytest.mark.slow
def test_derivatives_through_a_hundred_bounces():
    """In the height and the restitution, forward and reverse."""

    def end(numbers, t, **options):
        motion = dropped(*numbers, jnp.stack([jnp.zeros_like(t), t]), **options)
        return jnp.concatenate([motion.q[-1], motion.qd[-1]])

    def closed_form(numbers, t, count):
        height, restitution = numbers
        since = t - hits(height, restitution, count)[-1]
        rate = restitution**count * jnp.sqrt(2 * height * GRAVITY)
        return jnp.stack(
            [rate * since - GRAVITY * since**2 / 2, rate - GRAVITY * since]
        )

    weights = jnp.array([0.3, 0.7])
    forward = jacobian(lambda x, t: end(x, t, adjoint=diffrax.ForwardMode()))
    reverse = jax.jit(jax.grad(lambda x, t: weights @ end(x, t)), **LOOPS)
    for count in (21, 105):
        for restitution in (1.0, 0.99):
            numbers = jnp.array([10.0, restitution])
            last, before = hits(*numbers, count + 1)[jnp.array([-1, -2])]
            t = 0.7 * before + 0.3 * last
            slopes = jax.jacfwd(closed_form)(numbers, t, count)
            np.testing.assert_allclose(forward(numbers, t)[0], slopes, rtol=1e-9)
            found = reverse(numbers, t)
            np.testing.assert_allclose(found, weights @ slopes, rtol=1e-9)


@pytest.mark.slow
def test_an_elastic_ball_that_is_laid_down_or_drops_by_nothing_rests():
    for height in (0.0, 1e-12):
        motion = dropped(jnp.array(height), 1.0, [0, 0.5, 1.0])
        assert motion.q[1:, 0].tolist() == [0, 0] and motion.modes[1:, 0].tolist() == [
            2,
            2,
        ]
        assert motion.events.count <= 1 and not (motion.events.t > 1e-6).any()


def arms(count, rng):
    """Arms of two joints in random poses; gravity draws them to their stops."""
    rows = [
        fj.Linkage(
            str(rng.choice(["RR", "PR", "RP"])),
            length=[0, *rng.uniform(0.3, 1.2, 2)],
            com=rng.uniform(-0.3, 0.6, (2, 2)),
            mass=rng.uniform(0.5, 3, 2),
            inertia=rng.uniform(0.05, 0.5, 2),
            base_angle=rng.uniform(-3, 3),
        )
        for _ in range(count)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


@pytest.mark.slow
def test_two_joints_bounce_to_rest():
    linkages = arms(60, np.random.default_rng(0))
    stops = fj.forces.HardStops(-0.5, 0.5, restitution=0.5)

    def motion(arm):
        start = fj.State([0.0, 0.0], [0.0, 0.0])
        return fj.simulate(arm, start, [0, 4.0], (stops,), throw=False)

    def energy(arm, q, qd):
        return sum(fj.energy(arm, q, qd))

    found = jax.vmap(motion)(linkages)
    assert (found.outcome == "successful").all()
    energies = [
        jax.vmap(energy)(linkages, found.q[:, k], found.qd[:, k]) for k in (0, 1)
    ]
    missing = energies[0] - energies[1] - found.taken[:, 1]
    np.testing.assert_allclose(missing, 0, atol=1e-7)
    assert (found.modes[:, 1] > 0).all(axis=1).any()  # both rest


# The end, the start, the stops and their restitution. Three joints hit their stops in
# turn, at times that come ever closer to one instant; three of five throw each other at
# them a hundred times within 1e-3 s.
CASCADES = {
    "RRRFF": (
        1.0, ([0.1884, -0.1111, -0.3649], [2.6621, -1.8042, 0.073]),
        ([-0.8464, -1.4442, -0.6227], [0.8494, 1.2355, 1.0909]),
        [0.432, 0.0574, 0.2778],
    ),
    "RRRRR": (
        4.0,
        ([0.4127555772777217, 0.10663577576717986, 0.2294965609839984,
          0.04362499146542287, 0.4350724237877682],
         [-0.1019495193972042, -1.9037264540263323, 2.829787525711607,
          2.38619061070529, 2.7639893155816297]),
        ([-1.3650253838294104, -0.8621346523419489, -0.8407652751647515,
          -0.6445447869409455, -0.8397591843599618],
         [1.1158174343103087, 1.3086982603139599, 0.6632268532491,
          0.8873668421341108, 0.9412615544639757]),
        [0.49971664577198616, 0.7169891762068814, 0.2931325634466204,
         0.2772967188843861, 0.20989561789761632],
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("topology", CASCADES)
def test_a_cascade_of_blows_is_no_chatter(topology):
    """Fixed pairs without mass complete the shorter arm, for one program."""
    end, start, (lower, upper), restitution = CASCADES[topology]
    n = topology.count("R")
    full = lambda row, rest=0.0: np.append(row, np.full(5 - n, rest))
    arm = fj.Linkage(
        topology, length=[0, *full([0.4] * n)], com=[[0.2, 0.02]] * 5,
        mass=full([1] * n), inertia=full([0.02] * n),
    )  # fmt: skip
    ends = full(lower, -1), full(upper, 1)
    stops = fj.forces.HardStops(*ends, restitution=full(restitution))
    motion = fj.simulate(arm, fj.State(*map(full, start)), [0, end], (stops,))
    energy = [sum(fj.energy(arm, motion.q[k], motion.qd[k])) for k in (0, 1)]
    np.testing.assert_allclose(energy[0] - energy[1], motion.taken[1], atol=1e-8)
    assert motion.events.count > 20


@pytest.mark.slow
def test_a_mass_comes_to_rest_in_however_long_a_motion():
    """The last bounces are brief beside the whole time; they are no chatter."""
    mass = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
    floor = fj.forces.HardStops(0.0, np.inf, restitution=0.97)
    motion = fj.simulate(mass, fj.State([0.1], [0.0]), [0, 1000.0], (floor,))
    ends = np.sqrt(0.2 / 9.81) * (1 + 2 * 0.97 / 0.03)
    assert motion.q[-1, 0] == 0 and motion.modes[-1, 0] == 2
    np.testing.assert_allclose(np.nanmax(motion.events.t), ends, rtol=1e-7)
