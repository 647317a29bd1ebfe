"""Joints that are held for a while: laws, modes, events, batches."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest
from elements import SHORT, START, arm
from held_scenes import derivative_errors, law_errors, reverse
from modes import LOOPS, hessian
from scipy.linalg import expm

import fdof_jax as fj
from fdof_jax.forces import Brake, HardStops, JointFriction, Payload

inf = np.inf
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
SLIDE = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0.0)
REST = fj.State([0.0], [0.0])
LOAD = 9.81 * 0.5  # of the bar, level
NEVER = Brake(1, 9.0)  # after all motions that have it


def run(linkage, state0, ts, *forces, **options):
    return fj.simulate(linkage, state0, ts, forces, **options)


# Friction


def test_friction_above_the_load_holds_to_the_last_bit():
    friction = JointFriction(1.5 * LOAD, static=1.5 * LOAD)
    motion = run(BAR, REST, [0, 5, 10.0], friction)
    np.testing.assert_array_equal(motion.q, 0)
    np.testing.assert_array_equal(motion.modes, 1)
    assert motion.events.count == 0


@pytest.mark.slow
def test_static_friction_holds_what_has_come_to_rest_only():
    """It is above the load, which sliding friction is not: at rest the bar stays."""
    friction = JointFriction(0.9 * LOAD, static=1.1 * LOAD)
    assert run(BAR, REST, [0, 1.0], friction).q[-1, 0] == 0
    falling = run(BAR, fj.State([0.0], [-0.1]), [0, 0.1], friction)
    assert falling.q[-1, 0] < -0.01


@pytest.mark.slow
def test_a_sprung_slide_stops_short_and_derivatives_tell_where():
    """13 half swings, each shorter by 4 cm; forward mode is in docs/held.py."""
    ts, spring = np.linspace(0, 6, 7), fj.forces.JointSpring(100.0)

    def end(numbers):
        start, level = numbers
        state0 = fj.State(jnp.stack([start]), jnp.zeros(1))
        motion = run(SLIDE, state0, ts, JointFriction(level), spring)
        return motion.q[-1, 0], motion.events.t[0]

    numbers = jnp.array([0.51, 2.0])
    ends = lambda numbers: (jnp.stack(end(numbers)),) * 2
    reverse = jax.jit(jax.jacrev(ends, has_aux=True), **LOOPS)
    slopes, (x, t) = reverse(numbers)
    np.testing.assert_allclose([x, t], [0.01, 1.3 * np.pi], rtol=0, atol=1e-9)
    np.testing.assert_allclose(slopes, [[-1, 0.26], [0, 0]], atol=1e-8)


@pytest.mark.slow
def test_tiny_arms_stick_slip_and_saturate_as_large_ones():
    """Efforts of 1e-12 N m, or of 1e12, are found as exactly as those of 1 N m."""
    ts = np.linspace(0, 1.5, 16)

    def motion(size):
        bar = BAR.replace(mass=[size], inertia=[size / 12])
        target = fj.references.Step(-1.3, 0.4, begin=0.2)
        pd = fj.PDController(60 * size, 8 * size, 8 * size, target)
        friction = JointFriction(0.8 * size, static=2 * size)
        return run(bar, fj.State([-1.3], [0.0]), ts, friction, pd)

    wanted = motion(1.0)
    assert wanted.stats["num_switches"] > 2 and wanted.events.count == 2
    for size in (1e-12, 1e12):
        found = motion(size)
        np.testing.assert_allclose(found.q, wanted.q, atol=1e-9)
        np.testing.assert_allclose(found.events.t, wanted.events.t, atol=1e-9)

    def way(size):
        target = fj.references.Step(0.0, 0.4 * size, begin=0.2)
        pd = fj.PDController(60.0, 8.0, 8 * size, target)
        friction = JointFriction(0.8 * size, static=2 * size)
        tolerances = dict(rtol=1e-11, atol=1e-11 * size)
        return run(SLIDE, REST, ts, friction, pd, **tolerances).q / size

    # Rates of friction have no unit of their own.
    np.testing.assert_allclose(way(1e-6), way(1.0), atol=1e-7)


@pytest.mark.slow
def test_a_kink_where_friction_turns_leaves_derivatives_on_both_sides():
    """The limit of a motor has kinks at rest, where the friction jumps."""
    pd = fj.PDController(60.0, 2.0, 20.0, fj.references.SetPoint([-0.5]))
    motor = fj.control.SpeedLimit(pd, 20.0, 15.0)
    motion = run(BAR, fj.State([0.3], [0.7]), [0, 1.5], motor, JointFriction(0.3))
    assert motion.stats["num_switches"] > 6 and motion.stats["one_sided"] == 0


@pytest.mark.slow
def test_a_mass_on_a_belt_sticks_and_slips_for_a_hundred_periods():
    """As seen from the belt, the spring's other end moves."""
    pull = lambda t, q, qd, linkage: -100 * (q + 0.1 * t)
    period = 0.2 + 0.47123889803846897
    ts = np.linspace(0, 100 * period, 11)
    motion = run(SLIDE, REST, ts, JointFriction(2.0, static=3.0), pull)
    t, kind = np.asarray(motion.events.t), np.asarray(motion.events.kind)
    assert motion.events.count == 199 and len(t) == 64
    np.testing.assert_allclose(t[2:] - t[:-2], period, rtol=0, atol=1e-10)
    sticks = np.diff(t)[kind[:-1] == 0]  # until it slips
    np.testing.assert_allclose(sticks, 0.2, rtol=0, atol=1e-10)


# Stops


def test_a_mass_bounces_to_rest_at_a_known_time():
    """The times of endlessly many bounces add up to it."""
    drop = SLIDE.replace(gravity=9.81)
    floor = HardStops(0.0, inf, restitution=0.5)

    def rests(height, **options):
        start = fj.State(jnp.stack([height]), jnp.zeros(1))
        motion = run(drop, start, [0, 2.0], floor, **options)
        last = motion.events.count.astype(int) - 1
        return motion.events.t[last], motion

    forward = lambda h: rests(h, adjoint=diffrax.ForwardMode())
    slope, motion = jax.jit(jax.jacfwd(forward, has_aux=True), **LOOPS)(1.0)
    time, _ = rests(jnp.array(1.0))
    np.testing.assert_allclose(time, 1.3545709229571927, rtol=0, atol=1e-9)
    np.testing.assert_allclose(slope, 0.6772854614785964, rtol=0, atol=1e-9)
    assert motion.q[-1, 0] == 0 and motion.modes[-1, 0] == 2
    effort = fj.joint_efforts(drop, (floor,), motion).total[-1, 0]
    np.testing.assert_allclose(effort, 9.81, rtol=1e-15)
    np.testing.assert_allclose(motion.taken[-1], 9.81, rtol=1e-9)


@pytest.mark.slow
def test_second_derivatives_through_a_blow():
    drop = SLIDE.replace(gravity=9.81)

    def height(numbers):
        start, restitution = numbers
        state0 = fj.State(jnp.stack([start]), jnp.zeros(1))
        floor = HardStops(0.0, inf, restitution=restitution)
        forward = diffrax.ForwardMode()
        return run(drop, state0, [0, 0.6], floor, adjoint=forward).q[-1, 0]

    def closed_form(numbers):
        start, restitution = numbers
        hit = jnp.sqrt(2 * start / 9.81)
        left = 0.6 - hit
        return 9.81 * left * (restitution * hit - left / 2)

    at = jnp.array([1, 0.5])
    curves, *_ = hessian(height)(at)
    exact = jax.hessian(closed_form)(at)
    np.testing.assert_allclose(curves, exact, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_start_on_a_stop_that_is_left_has_its_own_derivatives():
    drop = SLIDE.replace(gravity=9.81)

    def thrown(numbers):
        start, floor, rate = numbers
        state0 = fj.State(start[None], rate[None])
        stops = HardStops(floor, inf)
        return run(drop, state0, [0, 0.3], stops, adjoint=diffrax.ForwardMode()).q[
            -1, 0
        ]

    slopes = jax.jit(jax.jacfwd(thrown), **LOOPS)(jnp.array([0.2, 0.2, 2.0]))
    np.testing.assert_allclose(slopes, [1, 0, 0.3], rtol=0, atol=1e-11)


def stopped(linkage, start, ts, stops, *, brake=NEVER, stiffness=0.0, effort=0.0):
    """Returns a motion between stops; what does not act lets all share a program."""
    spring = fj.forces.JointSpring(stiffness, rest=-1.0)
    return run(linkage, start, ts, stops, brake, spring, fj.JointEffort(effort))


@pytest.mark.slow
@pytest.mark.parametrize(
    "stiffness, event", [(0.0, "rests on its stop"), (9.0, "is stopped")]
)
def test_a_blow_without_restitution_is_no_bounce(stiffness, event):
    """A spring pulls the slide away from the stop at once, or nothing does."""
    start = fj.State([0.0], [9.0])
    motion = stopped(
        SLIDE, start, [0, 0.3], HardStops(-inf, 1.0), stiffness=stiffness, effort=0.1
    )
    assert motion.events.table["event"].tolist() == [event]
    assert motion.qd[-1, 0] <= 0


def test_a_start_outside_of_stops_is_refused():
    stops = HardStops(-1.0, 1.0)
    with pytest.raises(ValueError, match="^state0.q: expected .* between the hard"):
        run(BAR, fj.State([1.5], [0.0]), [0, 1.0], stops)
    motion = run(BAR, fj.State([1.5], [0.0]), [0, 1.0], stops, throw=False)
    assert motion.outcome == "not finite"
    assert motion.events.count == 0 and np.isnan(motion.events.t).all()


@pytest.mark.slow
def test_a_fixed_pair_has_no_stops():
    """Its position is 0, which need not lie within a range that others have."""
    start = fj.State([0.7, 0.0], [0.0, 0.0])
    stops = HardStops(0.5, 1.0, restitution=0.5)
    linkage = PAIR.replace(topology="RF", gravity=9.81)
    motion = run(linkage, start, [0, 1.0], stops, NEVER)
    assert motion.outcome == "successful" and 0.5 <= motion.q[-1, 0] <= 0.7


# Brakes and payloads

PAIR = fj.Linkage(
    "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[1 / 12] * 2,
    gravity=0.0,
)  # fmt: skip
MOVING = fj.State([0.3, 0.8], [1.0, 2.0])
ANYWHERE = HardStops(-inf, inf, restitution=0.5)  # for one program


@pytest.mark.slow
@pytest.mark.parametrize("begin", [-1.0, 0.0])
def test_a_brake_that_acts_already_holds_from_the_start(begin):
    motion = run(PAIR, MOVING, [0, 1.0], ANYWHERE, Brake(2, begin))
    expected = [1.5768759984566454, 0]
    np.testing.assert_allclose(motion.qd, [expected] * 2, rtol=1e-12)
    energy = fj.energy(PAIR, *MOVING)[0]
    np.testing.assert_allclose(
        fj.energy(PAIR, motion.q[-1], motion.qd[-1])[0] + motion.taken,
        energy,
        rtol=1e-9,
    )


@pytest.mark.slow
def test_a_brake_holds_to_the_last_bit():
    """The compensated sum carries rounding errors of the steps before."""
    for begin in np.linspace(0.25, 0.75, 11):
        motion = run(PAIR, MOVING, np.linspace(0, 1, 41), ANYWHERE, Brake(2, begin))
        # In NumPy, as in JAX each number of rows is another program.
        ts, q, qd = map(np.asarray, (motion.ts, motion.q, motion.qd))
        np.testing.assert_array_equal(qd[ts > begin, 1], 0)
        assert np.ptp(q[ts > begin, 1]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("lagged", ["the controller", "a force beside it"])
def test_states_of_drives_go_on_while_a_brake_holds(lagged):
    """The integral and the lag of a slide, by matrix exponentials."""
    kp, ki, kd, lag, goal = 40.0, 30.0, 12.0, 0.05, 0.5
    pid = fj.control.PIDController(kp, ki, kd, inf, fj.references.SetPoint([goal]))
    within = lagged == "the controller"
    effort = [-kp, -kd, 1, 0, kp * goal]  # by position, rate, integral, lag and 1
    behind, whole = (effort, [0, 0, 0, 1, 0]) if within else ([0, 0, 0, 0, 3], effort)
    moving = np.zeros((5, 5))
    moving[0, 1], moving[1] = 1, np.add(whole, [0, 0, 0, not within, 0])
    moving[2, [0, 4]], moving[3] = [-ki, ki * goal], behind
    moving[3] = (moving[3] - np.eye(5)[3]) / lag
    held = moving * [[0], [0], [1], [1], [1]]
    stopped = np.diag([1, 0, 1, 1, 1])
    end = expm(0.4 * moving) @ [0.2, 0.3, 0, 0, 1]
    end = expm(0.3 * moving) @ expm(0.1 * held) @ stopped @ end
    lag_of = fj.control.FirstOrderLag
    drives = (lag_of(pid, lag),) if within else (pid, lag_of(fj.JointEffort(3.0), lag))
    motion = run(SLIDE, fj.State([0.2], [0.3]), [0, 0.8], *drives, Brake(1, 0.4, 0.5))
    own = [leaf[-1, 0] for leaf in jax.tree.leaves(motion.own)]
    np.testing.assert_allclose(motion.q[-1, 0], end[0], atol=1e-9)
    np.testing.assert_allclose(motion.qd[-1, 0], end[1], atol=1e-9)
    np.testing.assert_allclose(np.sort(own), np.sort(end[2:4]), atol=1e-8)


@pytest.mark.slow
def test_a_brake_that_lets_go_at_a_stop_leaves_the_joint_there():
    stops = HardStops(-0.5, 0.5)
    motion = stopped(BAR, REST, [0, 0.9, 1.2, 2.0], stops, brake=Brake(1, 1.0, 1.5))
    assert motion.modes[:, 0].tolist() == [0, 2, 4, 2]
    assert motion.q[1:, 0].tolist() == [-0.5] * 3 and motion.events.count == 3


@pytest.mark.slow
def test_reactions_count_a_payload_while_it_is_there():
    load = Payload(fj.Point(1, 1.0), 2.0, begin=0.2, end=0.6)
    forces = load, JointFriction(100.0)
    motion = run(BAR, REST, [0, 0.4, 1.0], *forces)
    reactions = fj.joint_reactions(BAR, forces, motion)
    right = [[0, 9.81 * m, 9.81 * (0.5 + m - 1)] for m in (1, 3, 1)]
    np.testing.assert_allclose(reactions[:, 0], right, atol=1e-12)


@pytest.mark.slow
def test_a_payload_of_all_time_is_a_link_of_more_mass():
    load = Payload(fj.Point(3, 0.3, 0.05), 0.7)
    heavy = arm("RPR")
    mass, com, inertia = 1.7, heavy.com[2], heavy.inertia[2]
    center = (com + 0.7 * jnp.array([0.3, 0.05])) / mass
    inertia += jnp.sum((com - center) ** 2)
    inertia += 0.7 * jnp.sum((jnp.array([0.3, 0.05]) - center) ** 2)
    heavy = heavy.replace(
        mass=heavy.mass.at[2].set(mass), com=heavy.com.at[2].set(center),
        inertia=heavy.inertia.at[2].set(inertia),
    )  # fmt: skip
    ts = np.linspace(0, 0.5, 6)
    found = run(arm("RPR"), START, ts, load, **SHORT)
    np.testing.assert_allclose(found.q, run(heavy, START, ts, **SHORT).q, atol=1e-12)
    assert found.modes is None


# Batches, tables, costs


@pytest.mark.slow
def test_a_batch_has_derivatives_in_what_its_members_share():
    drop, heights = SLIDE.replace(gravity=9.81), jnp.array([0.4, 0.5])

    def rebounds(restitution):
        def rate(height):
            floor = HardStops(0.0, inf, restitution=restitution)
            start, forward = fj.State(height[None], jnp.zeros(1)), diffrax.ForwardMode()
            return run(drop, start, [0, 0.4], floor, adjoint=forward).qd[-1, 0]

        return jax.vmap(rate)(heights)

    slopes = jax.jit(jax.jacfwd(rebounds), **LOOPS)(0.5)
    np.testing.assert_allclose(slopes, jnp.sqrt(2 * 9.81 * heights), rtol=1e-9)


@pytest.mark.slow
def test_modes_and_topologies_share_one_program_in_a_batch():
    """Members equal single motions."""
    arms = [arm(topology) for topology in ("RRR", "RPR", "PRR", "RPP")]
    batch = jax.tree.map(lambda *rows: jnp.stack(rows), *arms)
    starts = fj.State(jnp.tile(START.q, (4, 1)), jnp.tile(START.qd, (4, 1)))
    forces = (
        JointFriction([2.0, 9.0, 0.5], static=[2.5, 9.5, 0.6]),
        HardStops(-0.6, [0.6, 0.3, 0.7], restitution=0.3),
        Brake(3, 0.3, 0.6),
    )
    ts = np.linspace(0, 1.5, 7)
    single = lambda linkage, q, qd: run(linkage, fj.State(q, qd), ts, *forces)
    swept = fj.sweep(batch, starts, ts, forces)
    for k, linkage in enumerate(arms):
        alone = single(linkage, START.q, START.qd)
        np.testing.assert_allclose(swept.q[k], alone.q, atol=1e-9)
        np.testing.assert_array_equal(swept.modes[k], alone.modes)
        assert swept.events.count[k] == alone.events.count
    assert len(np.unique(np.asarray(swept.modes))) == 5
    table = pandas.DataFrame(swept.events.table)
    assert [*table.columns] == ["motion", "t [s]", "joint", "event"]
    assert len(table) == swept.events.count.sum()
    frame = fj.to_pandas(arms[0], alone)
    np.testing.assert_array_equal(frame["taken [J]"], alone.taken)
    assert set(frame["R3 held by"]) <= {
        "free",
        "friction",
        "brake",
        "upper stop",
        "lower stop",
    }


@pytest.mark.slow
@pytest.mark.parametrize("joint", [2, 3])
def test_an_arm_with_one_of_two_slides_held_keeps_its_energy(joint):
    """By the program of the single motions above."""
    linkage = fj.Linkage(
        "RPP", length=[0, 0.3, 1.2, 0.6], com=[[0, 0.5], [0.2, 0.1], [0.4, -0.3]],
        mass=[2.3, 1.4, 0.7], inertia=[0.3, 0.5, 0.1], locked=[0.3, -0.4, 0.5],
        base_angle=1.3,
    )  # fmt: skip
    start, zeros = fj.State([0.3, -0.2, 0.1], [1.0, 0.5, 0.0]), np.zeros(3)
    free = JointFriction(zeros, static=zeros), HardStops(-inf, zeros + inf)
    # From the start on: the first row is after the blow.
    motion = run(linkage, start, np.linspace(0, 1, 101), *free, Brake(joint))
    energy = jax.vmap(lambda q, qd: sum(fj.energy(linkage, q, qd)))(motion.q, motion.qd)
    np.testing.assert_allclose(energy[1:], energy[1], rtol=0, atol=1e-8)
    assert np.ptp(motion.q[:, joint - 1]) == 0


@pytest.mark.slow
def test_blows_at_the_start_are_events():
    arm, forces = fj.scenes.double_pendulum().linkage, (ANYWHERE, Brake(1, begin=-1))
    motion = run(arm, fj.State([0.3, 0.0], [2.0, 1.0]), [0, 0.1], *forces)
    assert motion.events.table["event"].tolist() == ["is braked"]
    assert motion.qd[0, 0] == 0 and motion.taken[0] > 0
    still = run(arm, fj.State([0.3, 0.0], [0.0, 1.0]), [0, 0.1], *forces)
    assert still.events.count == 0


# Laws, in scenes at random


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5, 8, 10, 12, 17, 22, 28])  # of four joints
def test_laws_of_random_scenes(seed):
    """The books of energy close, held joints stand still, efforts stay in bounds."""
    errors = law_errors(seed)
    assert max(errors.values()) <= 1, errors


@pytest.mark.slow
@pytest.mark.parametrize("seed", [37, 112, 142, 243, 336, 350])  # of two joints
def test_derivatives_in_random_scenes(seed):
    """In reverse mode they equal extrapolated differences of tight solves."""
    errors = derivative_errors(seed, reverse)
    assert max(errors.values()) <= 1, errors
