"""Prescribed motion: closed forms, balances and jumps of the velocity."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT, Swing
from helpers import random_linkage
from modes import LOOPS, jacobian
from scipy.integrate import simpson, solve_ivp

import fdof_jax as fj

# A cart that slides along x and carries a pendulum: link 3 turns with link 4.
LENGTH, MASS, INERTIA, G = 0.8, 1.5, 0.2, 9.81
with pytest.warns(UserWarning, match="joints 2 and 3 coincide"):
    CART = fj.Linkage(
        "PRR", length=[0, 0, 0, LENGTH], com=[[0, 0], [0, 0], [LENGTH, 0]],
        mass=[2, 0, MASS], inertia=[1, INERTIA, 0], locked=[0, 0, 0],
        base_angle=-np.pi / 2, gravity=G,
    )  # fmt: skip
FORWARD = diffrax.ForwardMode()
ROTOR = MASS * LENGTH**2 + INERTIA
REST = fj.State(np.zeros(3), np.zeros(3))
NONE = fj.JointEffort(np.zeros(3))
AMPLITUDE = jnp.array([0.3, 0.2, 0.4])


class Push(fj.references.Reference):
    """The cart starts with a velocity and accelerates at a constant rate."""

    velocity: fj.Values = fj.field((), unit="m/s")
    acceleration: fj.Values = fj.field((), unit="m/s^2")

    def __call__(self, t, linkage):
        x = self.velocity * t + self.acceleration * t**2 / 2
        rate = self.velocity + self.acceleration * t
        along = jnp.array([1.0, 0.0, 0.0])
        return x * along, rate * along


def pushed(velocity, acceleration=0.0, joints=(1, 3)):
    return fj.simulation.PrescribedMotion(joints, Push(velocity, acceleration))


def pendulum(angle, rate, acceleration, ts):
    """Returns the motion of a pendulum whose pivot accelerates along x."""

    def field(t, y):
        drive = G * np.sin(y[0]) + acceleration * np.cos(y[0])
        return y[1], -MASS * LENGTH * drive / ROTOR

    options = dict(rtol=1e-12, atol=1e-13)
    return solve_ivp(field, (0, ts[-1]), [angle, rate], "DOP853", ts, **options).y


@pytest.mark.slow
@pytest.mark.parametrize("acceleration", [0.0, 4.0])
def test_a_pendulum_on_a_cart_that_accelerates(acceleration):
    moving = pushed(0.0, acceleration)
    ts = np.linspace(0, 3, 13)
    solution = fj.simulate(CART, fj.State([0, 0.7, 0], np.zeros(3)), ts, (moving,))
    angle, rate = pendulum(0.7, 0.0, acceleration, ts)
    found = solution.q[:, 1], solution.qd[:, 1]
    np.testing.assert_allclose(found, [angle, rate], atol=1e-9)
    np.testing.assert_allclose(solution.q[:, 0], acceleration * ts**2 / 2, atol=1e-12)
    np.testing.assert_array_equal(solution.q[:, 2], 0)


@pytest.mark.slow
def test_a_jump_of_the_velocity_is_a_blow():
    """Checks that the pendulum's momentum about its pivot does not change."""
    moving = pushed(0.6)
    ts = np.linspace(0, 1, 6)
    start = fj.State([0, 0.4, 0], [0, 0.2, 0])
    solution = fj.simulate(CART, start, ts, (moving,))
    after = 0.2 - MASS * LENGTH * np.cos(0.4) * 0.6 / ROTOR
    angle, rate = pendulum(0.4, after, 0.0, ts)
    found = solution.q[:, 1], solution.qd[:, 1]
    np.testing.assert_allclose(found, [angle, rate], atol=1e-9)
    np.testing.assert_allclose(solution.qd[:, 0], 0.6)
    # The effort, too, is that after the blow: it moves the pendulum's mass centre.
    turning = -MASS * LENGTH * G * np.sin(angle) / ROTOR
    along_x = MASS * LENGTH * (np.cos(angle) * turning - np.sin(angle) * rate**2)
    effort = fj.joint_efforts(CART, (moving,), solution).total[:, 0]
    np.testing.assert_allclose(effort, along_x, atol=1e-7)
    sampled = fj.simulate_sampled(CART, start, NONE, 0.2, 5, (moving,))
    np.testing.assert_allclose(sampled.qd, solution.qd, atol=1e-9)


def swinging(topology, joints, forces=()):
    n, linkage = len(topology), random_linkage(topology, np.random.default_rng(3))
    motion = fj.simulation.PrescribedMotion(joints, Swing(AMPLITUDE[:n]))
    q, qd = motion.reference(0.0, linkage)
    effort = fj.JointEffort([1.0, -2.0, 0.7][:n])
    forces = (motion, fj.JointDamper(0.5), effort, *forces)
    return linkage, fj.State(q, qd), forces


@eqx.filter_jit
def along(linkage, forces, solution, efforts):
    """Returns accelerations under efforts, the prescribed ones, and the energy."""

    def at(t, q, qd, tau):
        qdd = fj.forward_dynamics(linkage, q, qd, tau, forces)
        demanded = jax.jacfwd(lambda t: forces[0].reference(t, linkage)[1])(t)
        return qdd, demanded, sum(fj.energy(linkage, q, qd, forces))

    return jax.vmap(at)(solution.ts, solution.q, solution.qd, efforts)


@pytest.mark.slow
@pytest.mark.parametrize("joints", [1, 2, 3, (1, 2), (1, 2, 3)], ids=str)
@pytest.mark.parametrize("topology", ["RRR", "RPR", "PRP"])
def test_efforts_make_the_motion_and_do_its_work(topology, joints):
    armature = fj.forces.Armature(0.3)
    linkage, start, forces = swinging(topology, joints, (armature,))
    ts = np.linspace(0, 1, 101)
    solution = fj.simulate(linkage, start, ts, forces)
    efforts = fj.joint_efforts(linkage, forces, solution)
    moved = np.asarray(forces[0].prescribes(linkage))
    assert (np.asarray(efforts.elements[0])[:, ~moved] == 0).all()
    # Under these efforts the prescribed joints accelerate as they should.
    qdd, demanded, energy = along(linkage, forces, solution, efforts.total)
    np.testing.assert_allclose(qdd[:, moved], demanded[:, moved], atol=1e-9)
    # The energy changes by their work.
    power = np.sum(np.asarray(efforts.total) * np.asarray(solution.qd), axis=1)
    work = simpson(power, x=ts)
    np.testing.assert_allclose(energy[-1] - energy[0], work, atol=1e-6 * np.ptp(power))


@pytest.mark.slow
def test_the_motor_moves_a_payload_while_it_is_there():
    forces = pushed(0.0, 2.0, (1, 2, 3)), fj.forces.Payload(fj.Point(1), 3.0, end=0.35)
    ts = np.linspace(0, 1, 11)
    motion = fj.simulate(CART, REST, ts, forces)
    effort = fj.joint_efforts(CART, forces, motion).elements[0, :, 0]
    moved = 2 + MASS + np.where(ts < 0.35, 3, 0)
    np.testing.assert_allclose(effort, 2 * moved, rtol=1e-12)


@pytest.mark.slow
def test_starts_beside_the_reference_and_singular_equations_are_told():
    motion = pushed(0.0)
    starts = fj.State(np.array([[0.0, 0.1, 0], [0.2, 0.1, 0]]), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"state0\.q: expected \[0.0, .*prescribed"):
        fj.simulate(CART, fj.State(starts.q[1], np.zeros(3)), [0, 1], (motion,))
    swept = fj.sweep(CART, starts, [0, 0.1], (motion,), **SHORT)
    assert swept.outcome.tolist() == ["successful", "not finite"]
    with pytest.raises(ValueError, match="^outcome: expected .* compare `result`"):
        jax.eval_shape(lambda solution: solution.outcome, swept)
    # Two stretched links with a heavy tip; the prescribed slide is well-conditioned.
    heavy = fj.Linkage(
        "PRR", length=[0, 0, 1, 1], com=[[0, 0], [0.5, 0], [1, 0]], mass=[1, 1, 1e12],
        inertia=[1, 0.1, 0], gravity=0,
    )  # fmt: skip
    start = fj.State(np.array([0, 0.3, 0.0]), np.zeros(3))
    slide = pushed(0.0, joints=1)
    ended = fj.simulate(heavy, start, [0, 0.1], (slide,), throw=False)
    assert str(ended.outcome) == "ill-conditioned"


@pytest.mark.slow
def test_gradients_equal_differences():
    linkage, start, (motion, *others) = swinging("PR", 1)
    weights = np.array([1.0, -2.0])

    @partial(jax.jit, **LOOPS)
    @jax.value_and_grad
    def both(p):
        reference = Swing(AMPLITUDE[:2] * p[0])
        q, qd = reference(0.0, linkage)
        state0 = fj.State(jnp.where(motion.prescribes(linkage), q, start.q), start.qd)
        forces = fj.simulation.PrescribedMotion(1, reference), fj.JointDamper(p[1])
        return weights @ fj.simulate(linkage, state0, [0, 0.5], forces).q[-1]

    p = jnp.array([1.0, 0.5])
    _, slope = both(p)
    wanted = [(both(p + h)[0] - both(p - h)[0]) / 2e-4 for h in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(slope, wanted, atol=1e-6 * np.abs(slope).max())


@pytest.mark.slow
def test_topologies_are_batched():
    """A rotor's inertia beside them takes the batch through the looped solver."""
    rotor = (fj.forces.Armature(np.array([0.3, 0.2])),)
    names = "RR", "RP", "PR", "PP"
    members = [fj.Scene(*swinging(name, 2, rotor), 0.3) for name in names]
    options = dict(forces_axes=0, **SHORT)
    swept = fj.sweep(fj.tuning.stacked(members), [0, 0.3], **options)
    for k, member in enumerate(members):
        alone = fj.simulate(member, [0, 0.3], **SHORT)
        np.testing.assert_allclose(swept.q[k], alone.q, atol=1e-9)


HOLD = pushed(0.0)


class Jerk(fj.references.Reference):
    """The cart starts at an infinite rate."""

    def __call__(self, t, linkage):
        along = jnp.array([1.0, 0.0, 0.0])
        return jnp.sqrt(t) * along, along / (2 * jnp.sqrt(t))


@pytest.mark.slow
def test_a_motion_that_cannot_begin_reaches_no_time():
    jerk = HOLD.replace(reference=Jerk())
    motion = fj.simulate(CART, REST, [0, 0.5, 1], (jerk,), throw=False)
    assert motion.outcome == "not finite" and motion.stats["time_reached"] == 0


# Joints that are held beside it: a load on a table


with pytest.warns(UserWarning, match="parallel"):
    TABLE = fj.Linkage(
        "PP", length=[0, 0, 0], com=[[0, 0], [0, 0]], mass=[5, 2], inertia=[1, 1],
        locked=[0, 0], base_angle=0.0, gravity=0.0,
    )  # fmt: skip
LOAD = 2.0


class Kick(fj.references.Reference):
    """The table stands still, and moves at a constant rate from a time on."""

    rate: fj.Values = fj.field((), unit="m/s")
    begin: fj.Values = fj.field((), unit="s")

    @property
    def jump_ts(self):
        return self.begin[None]

    def __call__(self, t, linkage):
        moves, along = t >= self.begin, jnp.array([1.0, 0.0])
        x = jnp.where(moves, self.rate * (t - self.begin), 0)
        return x * along, jnp.where(moves, self.rate, 0) * along


class Accelerated(Push):
    def __call__(self, t, linkage):
        x, rate = super().__call__(t, linkage)
        return x[:2], rate[:2]


def on_table(*forces, reference, joints=1, qd=(0.0, 0.0), ts=(0.0, 1.0, 2.0), **more):
    moving = fj.simulation.PrescribedMotion(joints, reference)
    start = fj.State(np.zeros(2), jnp.array([*qd]))
    return fj.simulate(TABLE, start, jnp.asarray(ts), (moving, *forces), **more)


@pytest.mark.slow
def test_friction_takes_a_load_along_or_lets_it_slip():
    friction = fj.forces.JointFriction([0.0, 3.0])
    for acceleration, slip in ((1.49, 0.0), (1.6, -0.1)):  # it holds 1.5 m/s^2
        motion = on_table(friction, reference=Accelerated(0.0, acceleration))
        ts = motion.ts
        np.testing.assert_allclose(motion.q[:, 0], acceleration * ts**2 / 2, atol=1e-12)
        np.testing.assert_allclose(motion.q[:, 1], slip * ts**2 / 2, atol=1e-12)
        forces = (
            fj.simulation.PrescribedMotion(1, Accelerated(0.0, acceleration)),
            friction,
        )
        efforts = fj.joint_efforts(TABLE, forces, motion)
        taken = LOAD * (acceleration + slip)
        np.testing.assert_allclose(efforts.elements[1, 1, 1], taken, atol=1e-9)
        np.testing.assert_allclose(
            efforts.total[1, 0], 5 * acceleration + taken, atol=1e-9
        )


@pytest.mark.slow
def test_a_kicked_table_slips_under_its_load():
    """The load slides back by m v^2 / (2 f) from the kick on, for a time m v / f."""

    def end(x, ts, **options):
        rate, begin, level = x
        friction = fj.forces.JointFriction(level * jnp.array([0.0, 1.0]))
        motion = on_table(friction, reference=Kick(rate, begin), ts=ts, **options)
        return motion.q[-1, 1], motion

    x, ts = jnp.array([0.9, 0.3, 4.0]), np.array([0.0, 1.0, 2.0])
    forwards = jacobian(partial(end, adjoint=FORWARD))
    (forward, _), (_, motion) = forwards(x, ts)
    assert motion.events.table["event"].tolist() == ["slips", "sticks"]
    np.testing.assert_allclose(motion.events.table["t [s]"], [0.3, 0.75], atol=1e-12)
    np.testing.assert_allclose(motion.q[1:, 1], -LOAD * 0.9**2 / 8, atol=1e-12)
    np.testing.assert_allclose(motion.taken[-1], LOAD * 0.9**2 / 2, atol=1e-11)
    right = -LOAD * np.array([0.9 / 4, 0, -(0.9**2) / (2 * 4**2)])
    np.testing.assert_allclose(forward, right, atol=1e-9)
    reverse, _ = jax.jit(jax.grad(end, has_aux=True), **LOOPS)(x, ts)
    np.testing.assert_allclose(reverse, right, atol=1e-9)
    slides = lambda t: -0.9 * t + 4 * t**2 / (2 * LOAD)  # since the kick
    (forward, _), (_, during) = forwards(x, np.array([0.0, 0.5, 0.6]))
    np.testing.assert_allclose(during.q[-1, 1], slides(0.3), atol=1e-12)
    np.testing.assert_allclose(
        forward, [-0.3, 0.9 - 4 * 0.3 / LOAD, 0.045 / LOAD], atol=1e-9
    )


SHAKE, PULSE = 0.1, 6.0  # amplitude [m], rad/s


class Shaken(fj.references.Reference):
    phase: fj.Values = fj.field((), unit="rad")

    def __call__(self, t, linkage):
        along, angle = jnp.array([1.0, 0.0]), PULSE * t + self.phase
        x = SHAKE * (jnp.sin(angle) - jnp.sin(self.phase))
        return x * along, SHAKE * PULSE * jnp.cos(angle) * along


@pytest.mark.slow
def test_a_load_slips_on_a_table_that_moves_sinusoidally():
    """Its rate is a triangle; it turns where that of the table is as large.

    It slips by 4 A sqrt(1 - (pi f / (2 m A w^2))^2) in each period.
    """
    period = 2 * np.pi / PULSE
    share = lambda level: np.pi * level / (2 * LOAD * SHAKE * PULSE**2)

    def slipped(level):
        phase = -jnp.arccos(-share(level))
        friction = fj.forces.JointFriction(level * jnp.array([0.0, 1.0]))
        motion = on_table(
            friction, reference=Shaken(phase), qd=(SHAKE * PULSE * jnp.cos(phase), 0.0),
            ts=(0, period / 2, period, 3 * period), adjoint=FORWARD,
        )  # fmt: skip
        return motion.taken[1:] / level, motion

    right = lambda level: (
        4 * SHAKE * jnp.sqrt(1 - share(level) ** 2) * jnp.array([0.5, 1, 3])
    )
    at = lambda level: jax.jvp(slipped, (level,), (1.0,), has_aux=True)
    distance, slope, motion = jax.jit(at, **LOOPS)(3.0)
    np.testing.assert_allclose(distance, right(3.0), rtol=0, atol=1e-9)
    back = [-right(3.0)[0], 0, 0]
    np.testing.assert_allclose(motion.q[1:, 1], back, rtol=0, atol=1e-9)
    np.testing.assert_allclose(slope, jax.jacfwd(right)(3.0), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_stops_and_brakes_beside_a_kicked_table():
    never = np.array(9.0)  # after the end

    def kicked(qd=0.0, stop=-np.inf, braked=never, taken=never):
        """Returns a motion beside what holds; what does not act shares the program."""
        upper = np.where(np.isfinite(stop), 1.0, np.inf)
        stops = fj.forces.HardStops([-np.inf, stop], [np.inf, upper], restitution=0.5)
        brake = fj.forces.Brake(2, begin=braked, end=braked + 1.3)
        payload = fj.forces.Payload(fj.Point(2), 2.0, begin=taken)
        forces = stops, brake, payload
        return on_table(*forces, reference=Kick(0.9, 0.3), qd=(0.0, qd))

    motion = kicked(stop=-0.18)
    # It comes to the stop 0.2 s after the kick, and bounces off at half the rate.
    np.testing.assert_allclose(motion.events.table["t [s]"], [0.5], atol=1e-12)
    bounced = -0.18 + 0.45 * (np.array([1.0, 2.0]) - 0.5)
    np.testing.assert_allclose(motion.q[1:, 1], bounced, atol=1e-11)
    # A braked load moves with the table, and is left behind no more than it was.
    motion = kicked(qd=0.1, braked=0.2)
    np.testing.assert_allclose(motion.q[:, 1], [0, 0.02, 0.02], atol=1e-12)
    assert not motion.qd[1:, 1].any()
    # A payload beside it takes momentum of the load alone.
    np.testing.assert_allclose(kicked(taken=0.6).qd[1:, 1], -0.9, atol=1e-12)


@pytest.mark.slow
def test_a_load_bounces_off_the_stop_of_an_accelerated_table():
    """As a ball that falls, by the acceleration of the table."""

    def bounced(x):
        room, acceleration = x
        stop = fj.forces.HardStops(
            -room * np.array([np.inf, 1]), np.inf, restitution=0.5
        )
        table = Accelerated(0.0, acceleration)
        motion = on_table(stop, reference=table, ts=(0.0, 1.0), adjoint=FORWARD)
        return jnp.stack([motion.q[-1, 1], motion.qd[-1, 1], motion.events.t[0]])

    def exact(x):
        room, acceleration = x
        blow = jnp.sqrt(2 * room / acceleration)
        back, since = acceleration * blow / 2, 1 - blow
        q = -room + back * since - acceleration * since**2 / 2
        return jnp.stack([q, back - acceleration * since, blow])

    x = jnp.array([0.8, 3.0])
    np.testing.assert_allclose(bounced(x), exact(x), atol=1e-11)
    found = jax.jit(jax.jacfwd(bounced), **LOOPS)(x)
    np.testing.assert_allclose(found, jax.jacfwd(exact)(x), atol=1e-9)


def test_stops_and_brakes_of_prescribed_joints_are_refused():
    for element in (fj.forces.HardStops(-1, 1), fj.forces.Brake(1, begin=0, end=1)):
        with pytest.raises(ValueError, match="a joint whose motion is prescribed"):
            on_table(element, reference=Kick(0.9, 0.3))


@pytest.mark.slow
def test_a_jump_of_the_velocity_that_is_not_declared_is_found():
    class Hidden(Kick):
        jump_ts = None

    motion = on_table(reference=Hidden(0.9, 0.3))
    slid = -0.9 * (np.array([1.0, 2.0]) - 0.3)
    np.testing.assert_allclose(motion.q[1:, 1], slid, atol=1e-9)
