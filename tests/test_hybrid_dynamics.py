"""Prescribed motion: closed forms, balances and jumps of the velocity."""

from functools import partial

import equinox as eqx
import held_scenes as held
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT, Swing
from held_scenes import LATER, NEVER, Row
from helpers import random_linkage
from modes import LOOPS
from scipy.integrate import simpson, solve_ivp

import fdof_jax as fj
from fdof_jax.simulation import PrescribedMotion

pytestmark = pytest.mark.slow
# A cart that slides along x and carries a pendulum: link 3 turns with link 4.
LENGTH, MASS, INERTIA, G = 0.8, 1.5, 0.2, 9.81
with pytest.warns(UserWarning, match="joints 2 and 3 coincide"):
    CART = fj.Linkage(
        "PRR", length=[0, 0, 0, LENGTH], com=[[0, 0], [0, 0], [LENGTH, 0]],
        mass=[2, 0, MASS], inertia=[1, INERTIA, 0], locked=[0, 0, 0],
        base_angle=-np.pi / 2, gravity=G,
    )  # fmt: skip
ROTOR = MASS * LENGTH**2 + INERTIA
REST = fj.State(np.zeros(3), np.zeros(3))
NONE = fj.JointEffort(np.zeros(3))
AMPLITUDE = jnp.array([0.3, 0.2, 0.4])
PULSE = 6.0  # [rad/s]


class Moved(fj.references.Reference):
    """The first joint is accelerated or shaken, and at a time given a rate."""

    acceleration: fj.Values = fj.field((), unit="m/s^2", default=0.0)
    shake: fj.Values = fj.field((), unit="m", default=0.0)
    phase: fj.Values = fj.field((), unit="rad", default=0.0)
    rate: fj.Values = fj.field((), unit="m/s", default=0.0)
    begin: fj.Values = fj.field((), unit="s", default=0.0)

    @property
    def jump_ts(self):
        return self.begin[None]

    def __call__(self, t, linkage):
        after, angle = jnp.maximum(t - self.begin, 0), PULSE * t + self.phase
        x = self.acceleration * t**2 / 2 + self.rate * after
        x += self.shake * (jnp.sin(angle) - jnp.sin(self.phase))
        speed = self.acceleration * t + PULSE * self.shake * jnp.cos(angle)
        speed += jnp.where(t >= self.begin, self.rate, 0)
        along = jnp.eye(linkage.mass.size)[0]
        return x * along, speed * along


class Hidden(Moved):
    """It declares no jump."""

    jump_ts = None


def pushed(joints=(1, 3), **moves):
    return PrescribedMotion(joints, Moved(**moves))


def pendulum(angle, rate, acceleration, ts):
    """Returns the motion of a pendulum whose pivot accelerates along x."""

    def rates(t, y):
        drive = G * np.sin(y[0]) + acceleration * np.cos(y[0])
        return y[1], -MASS * LENGTH * drive / ROTOR

    options = dict(rtol=1e-12, atol=1e-13)
    angle, rate = solve_ivp(
        rates, (0, ts[-1]), [angle, rate], "DOP853", ts, **options
    ).y
    return angle, rate, rates(0.0, (angle, rate))[1]


@pytest.mark.parametrize("speed, acceleration", [(0, 0), (0, 4.0), (0.6, 0)])
def test_a_pendulum_on_a_cart(speed, acceleration):
    """A first speed is a blow, which keeps the momentum about the pendulum's pivot."""
    moving, ts = pushed(acceleration=acceleration, rate=speed), np.linspace(0, 3, 13)
    start = fj.State([0, 0.4, 0], [0, 0.2, 0])
    motion = fj.simulate(CART, start, ts, (moving,))
    after = 0.2 - MASS * LENGTH * np.cos(0.4) * speed / ROTOR
    angle, rate, turning = pendulum(0.4, after, acceleration, ts)
    found = motion.q[:, 1], motion.qd[:, 1]
    np.testing.assert_allclose(found, [angle, rate], atol=1e-9)
    place = speed * ts + acceleration * ts**2 / 2
    np.testing.assert_allclose(motion.q[:, 0], place, atol=1e-12)
    np.testing.assert_allclose(motion.qd[:, 0], speed + acceleration * ts)
    np.testing.assert_array_equal(motion.q[:, 2], 0)
    # The effort, too, is that after the blow: it moves all mass centres.
    along_x = MASS * LENGTH * (np.cos(angle) * turning - np.sin(angle) * rate**2)
    effort = fj.joint_efforts(CART, (moving,), motion).total[:, 0]
    expected = along_x + (2 + MASS) * acceleration
    np.testing.assert_allclose(effort, expected, atol=1e-7)
    if speed:
        sampled = fj.simulate_sampled(CART, start, NONE, 0.25, 12, (moving,))
        np.testing.assert_allclose(sampled.qd, motion.qd, atol=1e-9)


@pytest.mark.parametrize("moving", [Moved, Hidden])
def test_a_jump_of_the_velocity_on_the_way(moving):
    """Whether it is declared or not."""
    kicked = PrescribedMotion((1, 3), moving(rate=0.6, begin=1.0))
    motion = fj.simulate(CART, fj.State([0, 0.4, 0], [0, 0.2, 0]), [0, 3], (kicked,))
    (_, angle), (_, rate), _ = pendulum(0.4, 0.2, 0.0, [0.0, 1.0])
    after = rate - MASS * LENGTH * np.cos(angle) * 0.6 / ROTOR
    angle, rate, _ = pendulum(angle, after, 0.0, [0.0, 2.0])
    np.testing.assert_allclose(motion.q[-1], [1.2, angle[-1], 0], atol=1e-9)
    np.testing.assert_allclose(motion.qd[-1], [0.6, rate[-1], 0], atol=1e-9)


def swinging(topology, joints, forces=()):
    n, linkage = len(topology), random_linkage(topology, np.random.default_rng(3))
    motion = PrescribedMotion(joints, Swing(AMPLITUDE[:n]))
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


def test_starts_beside_the_reference_and_singular_equations_are_told():
    motion = PrescribedMotion((1, 3), Hidden())
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
    ended = fj.simulate(heavy, start, [0, 0.1], (pushed(1),), throw=False)
    assert str(ended.outcome) == "ill-conditioned"


def test_gradients_equal_differences():
    """In what shakes a cart, in a blow and its time, and in an element's number."""
    linkage = random_linkage("PR", np.random.default_rng(3))
    start, weights = fj.State(jnp.zeros(2), jnp.ones(2)), np.array([1.0, -2.0])

    @partial(jax.jit, **LOOPS)
    @jax.value_and_grad
    def both(p):
        shake, rate, begin, damping = p
        moving = pushed(1, shake=shake, rate=rate, begin=begin)
        forces = moving, fj.JointDamper(damping)
        return weights @ fj.simulate(linkage, start, [0, 0.5], forces).q[-1]

    p = jnp.array([0.1, 0.9, 0.2, 0.5])
    _, slope = both(p)
    wanted = [(both(p + h)[0] - both(p - h)[0]) / 2e-4 for h in 1e-4 * np.eye(4)]
    np.testing.assert_allclose(slope, wanted, atol=1e-6 * np.abs(slope).max())


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


def test_a_motion_that_cannot_begin_reaches_no_time():
    """The square of the pendulum's rate after the blow is no number."""
    blow = (pushed(rate=1e308),)
    motion = fj.simulate(CART, REST, [0, 0.5, 1], blow, throw=False)
    assert motion.outcome == "not finite" and motion.stats["time_reached"] == 0


# Joints that are held beside it: a load on a table


with pytest.warns(UserWarning, match="parallel"):
    TABLE = fj.Linkage(
        "PP", length=[0, 0, 0], com=[[0, 0], [0, 0]], mass=[5, 2], inertia=[1, 1],
        locked=[0, 0], base_angle=0.0, gravity=0.0,
    )  # fmt: skip
LOAD, BACK = 2.0, 0.5  # mass [kg], restitution


def on_table(
    *, qd=0.0, level=0.0, stop=-np.inf, brake=(NEVER, LATER),
    taken=NEVER, **moves,
):  # fmt: skip
    """Returns a scene with all that may hold the load, most of which does nothing."""
    reference = Moved(**dict(begin=NEVER) | moves)
    forces = (
        PrescribedMotion(1, reference),
        fj.forces.JointFriction(level * jnp.array([0.0, 1.0])),
        fj.forces.HardStops(jnp.array([-np.inf, stop]), np.inf, restitution=BACK),
        fj.forces.Brake(2, *brake),
        fj.forces.Payload(fj.Point(2), 2.0, begin=taken),
    )
    _, rates = reference(0.0, TABLE)
    start = fj.State(jnp.zeros(2), jnp.stack([rates[0], qd]))
    return jax.tree.map(jnp.asarray, fj.Scene(TABLE, start, forces, 0.0))


PULLED = lambda a, level: on_table(acceleration=a, level=level)
KICKED = lambda rate, begin, level: on_table(rate=rate, begin=begin, level=level)


def slipped(rate, begin, level):
    """The load slides back by m v^2 / (2 f), for a time m v / f."""
    energy = LOAD * rate**2 / 2
    t = jnp.stack([begin, begin + LOAD * rate / level])
    return dict(q=[-energy / level], modes=[1.0], taken=[energy], t=t)


def shakes(half_periods, amplitude=0.1):
    """Returns a row: the load's rate is a triangle that turns where it is the table's.

    It slips by 4 A sqrt(1 - (pi f / (2 m A w^2))^2) in each period.
    """
    share = lambda level: jnp.pi * level / (2 * LOAD * amplitude * PULSE**2)

    def shaken(level):
        phase = -jnp.arccos(-share(level))
        return on_table(shake=amplitude, phase=phase, level=level)

    def exact(level):
        half = 2 * amplitude * jnp.sqrt(1 - share(level) ** 2)
        return dict(q=[-half * (half_periods % 2)], taken=[level * half * half_periods])

    return Row(shaken, (3.0,), [0, half_periods * np.pi / PULSE], exact)


def fallen(room, acceleration):
    """A load bounces off a stop as a ball that falls, by the table's acceleration."""
    blow = jnp.sqrt(2 * room / acceleration)
    back, since = acceleration * blow * BACK, 1 - blow
    q = -room + back * since - acceleration * since**2 / 2
    return dict(q=[q], qd=[back - acceleration * since], t=[blow])


ROWS = {
    "friction takes a load along": Row(
        PULLED, (1.49, 3.0), [0, 2.0],
        lambda *_: dict(q=[0.0], qd=[0.0], modes=[1.0], taken=[0.0]), [],
    ),
    "friction lets a load slip": Row(
        PULLED, (1.6, 3.0), [0, 2.0],
        lambda a, f: dict(q=[f - 2 * a], qd=[f - 2 * a], taken=[f * (2 * a - f)]),
    ),
    "a kicked table slips under its load": Row(
        KICKED, (0.9, 0.3, 4.0), [0, 2.0], slipped, ["slips", "sticks"]
    ),
    "a kicked table still slips": Row(
        KICKED, (0.9, 0.3, 4.0), [0, 0.6],
        lambda v, t, f: dict(q=[f * (0.6 - t) ** 2 / (2 * LOAD) - v * (0.6 - t)]),
    ),
    "half a period of a shaken table": shakes(1),
    "three periods of a shaken table": shakes(6),
    "a load bounces off the stop of an accelerated table": Row(
        lambda room, a: on_table(acceleration=a, stop=-room), (0.8, 3.0), [0, 1.0],
        fallen,
    ),
    "a load bounces off the stop of a kicked table": Row(
        lambda v, t, room: on_table(rate=v, begin=t, stop=-room), (0.9, 0.3, 0.18),
        [0, 2.0], lambda v, t, room: dict(
            q=[BACK * (v * (2 - t) - room) - room], qd=[BACK * v], t=[t + room / v]
        ),
    ),
    "a braked load moves with the table, and is left behind no more": Row(
        lambda t, qd: on_table(rate=0.9, begin=0.3, brake=(t, 1.5), qd=qd), (0.2, 0.1),
        [0, 2.0], lambda t, qd: dict(q=[qd * t], qd=[0.0], taken=[LOAD * qd**2 / 2]),
        ["is braked", "is let go"],
    ),
    "a payload beside it takes momentum of the load alone": Row(
        lambda v, t: on_table(rate=v, begin=0.3, taken=t), (0.9, 0.6), [0, 2.0],
        lambda v, t: dict(q=[-1.7 * v], qd=[-v]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_a_load_on_a_table(name):
    held.check_motion(ROWS[name], name)


def test_derivatives_of_all_these():
    held.check_derivatives(ROWS)


@pytest.mark.parametrize("acceleration, slip", [(1.49, 0.0), (1.6, -0.1)])
def test_efforts_of_friction_and_of_what_moves_the_table(acceleration, slip):
    scene, ts = PULLED(acceleration, 3.0), np.linspace(0, 2, 3)
    motion = fj.simulate(scene, ts)
    np.testing.assert_allclose(motion.q[:, 0], acceleration * ts**2 / 2, atol=1e-12)
    efforts, taken = fj.joint_efforts(scene, motion), LOAD * (acceleration + slip)
    np.testing.assert_allclose(efforts.elements[1, 1, 1], taken, atol=1e-9)
    total = 5 * acceleration + taken
    np.testing.assert_allclose(efforts.total[1, 0], total, atol=1e-9)
