"""One joint that is held for a while: closed forms and derivatives.

Scenes are data, which share a program.
"""

import held_scenes as held
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, FORWARD, SLIDE
from held_scenes import LATER, NEVER, Row
from modes import hessian, jacobian
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import fdof_jax as fj
from fdof_jax.forces import Brake, HardStops, JointFriction, Payload, stribeck

inf, G = np.inf, 9.81
DROP, WHEEL = SLIDE.replace(gravity=G), BAR.replace(gravity=0.0)
BLOCK = DROP.replace(base_angle=0.3 - np.pi / 2)  # on a slope of 0.3 rad
WEIGHT = G * np.sin(0.3)
LOAD = G / 2  # of the bar, level
REST = fj.State([0.0], [0.0])


def one_joint(
    linkage, q=0.0, qd=0.0, *, level=0.0, static=None, stops=(-inf, inf),
    restitution=0.0, brake=(NEVER, LATER), load=0.0, carried=(NEVER, LATER),
    gains=(0.0, 0.0), limit=inf, target=(0.0, 0.0, NEVER), effort=0.0,
):  # fmt: skip
    """Returns a scene with all elements, most of which do nothing."""
    *places, step = target
    target, both = fj.references.Step(*places, begin=step), jnp.ones((2, 1))
    static = level if static is None else static
    forces = (
        JointFriction(level * both, static=static * both),
        HardStops(*stops, restitution=restitution),
        Brake(1, *brake),
        Payload(fj.Point(1, 1.0), load, begin=carried[0], end=carried[1]),
        fj.PDController(*gains, limit, target),
        fj.JointEffort(effort),
    )
    start = fj.State(jnp.reshape(q, 1), jnp.reshape(qd, 1))
    return jax.tree.map(jnp.asarray, fj.Scene(linkage, start, forces, 0.0))


def hits(height, restitution, count):
    """Returns the times at which a ball hits the floor."""
    flights = restitution ** jnp.arange(1, count)
    fall = jnp.sqrt(2 * height / G)
    return fall * (1 + 2 * jnp.concatenate([jnp.zeros(1), jnp.cumsum(flights)]))


def ball(height, restitution):
    return one_joint(DROP, height, stops=(0.0, inf), restitution=restitution)


def bounced(height, restitution, count):
    """Returns a row that ends after so many bounces."""
    last, before = hits(height, restitution, count + 1)[jnp.array([-1, -2])]
    t = 0.7 * float(before) + 0.3 * float(last)

    def exact(height, restitution):
        times, left = hits(height, restitution, count), restitution**count
        since, qd = t - times[-1], left * jnp.sqrt(2 * height * G)
        of_last = dict(q=[qd * since - G * since**2 / 2], qd=[qd - G * since])
        taken = G * height * (1 - left**2)
        return of_last | dict(taken=[taken], t=times[-64:])

    return Row(ball, (height, restitution), [0, t], exact)


def rests(height, e):
    """Infinitely many bounces last a finite time."""
    end = jnp.sqrt(2 * height / G) * (1 + e) / (1 - e)
    return dict(last=end, q=[0.0], modes=[2.0], taken=[G * height])


def turned(v, up, down):
    """A block goes up against one friction, and comes down against another."""
    top, height = v / (WEIGHT + up), v**2 / 2 / (WEIGHT + up)
    q = height - (WEIGHT - down) * (1 - top) ** 2 / 2
    return dict(q=[q], taken=[up * height + down * (height - q)])


SLOPE = lambda v, up, down: one_joint(BLOCK, 0.0, v, level=jnp.array([[up], [down]]))
RUBS = lambda rate, load: one_joint(SLIDE, 0.0, rate, level=1, static=2, effort=load)
THROWN = lambda q, floor, qd: one_joint(DROP, q, qd, stops=(floor, inf))
DIFFERENTIABLE = {
    "friction holds its load": Row(
        lambda level: one_joint(BAR, level=level), (1.5 * LOAD,), [0, 10.0],
        lambda level: dict(q=[0.0], qd=[0.0], modes=[1.0], taken=[0.0]), [],
    ),
    "a rate that counts as zero is held": Row(
        RUBS, (1e-14, 1.5), [0, 2.0], lambda *_: dict(q=[0.0], qd=[0.0])
    ),
    "a rate that counts as zero slides off": Row(
        RUBS, (1e-14, 2.5), [0, 2.0],
        lambda rate, load: dict(q=[2 * rate + 2 * load - 2], qd=[rate + 2 * load - 2]),
    ),
    "a start on a stop that is left": Row(
        THROWN, (0.2, 0.2, 2.0), [0, 0.3],
        lambda q, floor, qd: dict(q=[q + 0.3 * qd - G * 0.3**2 / 2]),
    ),
    "a ball bounces to rest": Row(ball, (1.0, 0.5), [0, 2.0], rests),
    "21 elastic bounces": bounced(10.0, 1.0, 21),
    "105 bounces": bounced(10.0, 0.99, 105),
    # A declared jump carries the sides of a limit over their zeros.
    "a step from one limit of a motor to the other": Row(
        lambda t: one_joint(SLIDE, gains=(100, 0), limit=10, target=(1, -1, t)), (0.2,),
        [0, 0.5],
        lambda t: dict(q=[5 * t**2 + 10 * t * (0.5 - t) - 5 * (0.5 - t) ** 2]),
    ),
    "a brake for a while": Row(
        lambda qd, *brake: one_joint(SLIDE, 0.0, qd, brake=brake, effort=2.0),
        (0.5, 0.4, 2.0), [0, 3.0],
        lambda qd, t, end: dict(
            q=[qd * t + t**2 + (3 - end) ** 2], qd=[6 - 2 * end],
            taken=[(qd + 2 * t) ** 2 / 2],
        ), ["is braked", "is let go"],
    ),
    "a payload for a while": Row(
        lambda load, *at: one_joint(WHEEL, 0.0, 2.0, load=load, carried=at),
        (1.5, 0.4, 0.8), [0, 1.0],
        lambda m, t, _: dict(  # to let it go changes no rate
            q=[2 * t + 2 / (1 + 3 * m) * (1 - t)], qd=[2 / (1 + 3 * m)],
            taken=[2 / 3 - 2 / 3 / (1 + 3 * m)],
        ),
    ),
    "a block goes up against 4 N, turns, and comes down against 1 N": Row(
        SLOPE, (2.0, 4.0, 1.0), [0, 1.0], turned
    ),
    "a block that still goes up": Row(
        SLOPE, (2.0, 4.0, 1.0), [0, 0.1], lambda v, up, _: dict(
            q=[v * 0.1 - (WEIGHT + up) * 0.005],
            taken=[up * (v * 0.1 - (WEIGHT + up) * 0.005)],
        ),
    ),
}  # fmt: skip


# A block without a speed, on a slope or level, under a push uphill
PUSHED = lambda linkage, up, down, push, q: Row(
    lambda: one_joint(linkage, level=jnp.array([[up], [down]]), effort=push), (),
    [0, 1.0], lambda: dict(q=[q]),
)  # fmt: skip
BLOW = dict(stops=(-inf, 1.0), target=(-1.0, -1.0, NEVER), effort=0.1)
ROWS = DIFFERENTIABLE | {
    "static friction holds what has come to rest": Row(
        lambda: one_joint(BAR, level=0.9 * LOAD, static=1.1 * LOAD), (), [0, 1.0],
        lambda: dict(q=[0.0]), [],
    ),
    "an elastic ball that is laid down": Row(
        lambda: ball(0.0, 1.0), (), [0, 0.5], lambda: dict(q=[0.0], modes=[2.0]), []
    ),
    "an elastic ball that drops by nothing": Row(
        lambda: ball(1e-12, 1.0), (), [0, 0.5, 1.0],
        lambda: dict(q=[0.0, 0.0], modes=[2.0, 2.0]),
    ),
    # A step that is tried from a bounce on may reach a kilometre below the floor.
    "30 nearly elastic bounces": bounced(10.0, 1 - 1e-12, 30),
    "the last bounces are brief beside the whole time": Row(
        ball, (0.1, 0.97), [0, 1000.0], rests
    ),
    "a blow without restitution, and a rest": Row(
        lambda: one_joint(SLIDE, 0.0, 9.0, **BLOW), (), [0, 0.3],
        events=["rests on its stop"],
    ),
    "a blow without restitution, and a pull away": Row(
        lambda: one_joint(SLIDE, 0.0, 9.0, gains=(9.0, 0.0), **BLOW), (), [0, 0.3],
        events=["is stopped"],
    ),
    "a brake that acts already": Row(
        lambda: one_joint(SLIDE, 0.0, 2.0, brake=(-1.0, LATER)), (), [0, 0.5],
        lambda: dict(q=[0.0], modes=[4.0], taken=[2.0]), ["is braked"],
    ),
    "a brake that acts already on a joint at rest": Row(
        lambda: one_joint(SLIDE, brake=(0.0, LATER)), (), [0, 0.5],
        lambda: dict(q=[0.0], modes=[4.0], taken=[0.0]), [],
    ),
    "a brake that lets go at a stop": Row(
        lambda: one_joint(BAR, stops=(-0.5, 0.5), brake=(1.0, 1.5)), (),
        [0, 0.9, 1.2, 2.0],
        lambda: dict(q=[-0.5] * 3, modes=[2.0, 4.0, 2.0]),
        ["rests on its stop", "is braked", "rests on its stop"],
    ),
    "a block that is held on the way down": PUSHED(BLOCK, 1.0, WEIGHT + 0.1, 0.0, 0.0),
    "a block that a push as large takes along": PUSHED(
        BLOCK, 1.0, WEIGHT + 0.1, 2 * WEIGHT, (WEIGHT - 1) / 2
    ),
    "a push against no friction": PUSHED(SLIDE, 0.0, 3.0, 1.0, 0.5),
    "a push against friction": PUSHED(SLIDE, 3.0, 0.0, 1.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_one_joint_moves_as_closed_forms_say(name):
    held.check_motion(ROWS[name], name)


@pytest.mark.slow
def test_a_batch_has_the_derivatives_of_closed_forms():
    held.check_derivatives(DIFFERENTIABLE)


def test_tiny_arms_stick_slip_and_saturate_as_large_ones():
    """Efforts of 1e-12 N m, or of 1e12, are found as exactly as those of 1 N m."""

    def motion(linkage, q=0.0, effort=1.0, size=1.0):
        masses = {k: effort * vars(linkage)[k] for k in ("mass", "inertia")}
        scene = one_joint(
            linkage.replace(**masses), q, level=0.8 * effort * size,
            static=2 * effort * size, gains=(60 * effort, 8 * effort),
            limit=8 * effort * size, target=(q, 0.4 * size, 0.2),
        )  # fmt: skip
        tolerances = dict(rtol=1e-11, atol=1e-11 * size)
        return fj.simulate(scene, np.linspace(0, 1.5, 16), **tolerances)

    wanted = motion(BAR, -1.3)
    assert wanted.stats["num_switches"] > 2 and wanted.events.count == 2
    for effort in (1e-12, 1e12):
        found = motion(BAR, -1.3, effort)
        np.testing.assert_allclose(found.q, wanted.q, atol=1e-9)
        np.testing.assert_allclose(found.events.t, wanted.events.t, atol=1e-9)
    # Rates of friction have no unit of their own.
    short, whole = motion(SLIDE, size=1e-6), motion(SLIDE)
    np.testing.assert_allclose(short.q / 1e-6, whole.q, atol=1e-7)


@pytest.mark.slow
def test_a_kink_where_friction_turns_leaves_derivatives_on_both_sides():
    """The limit of a motor has kinks at rest, where the friction jumps."""
    pd = fj.PDController(60.0, 2.0, 20.0, fj.references.SetPoint([-0.5]))
    forces = fj.control.SpeedLimit(pd, 20.0, 15.0), JointFriction(0.3)
    motion = fj.simulate(BAR, fj.State([0.3], [0.7]), [0, 1.5], forces)
    assert motion.stats["num_switches"] > 6 and motion.stats["one_sided"] == 0


def test_a_start_outside_of_stops_is_refused():
    scene = one_joint(BAR, 1.5, stops=(-1.0, 1.0))
    with pytest.raises(ValueError, match="^state0.q: expected .* between the hard"):
        fj.simulate(scene, [0, 1.0])
    motion = fj.simulate(scene, [0, 1.0], throw=False)
    assert motion.outcome == "not finite"
    assert motion.events.count == 0 and np.isnan(motion.events.t).all()


def test_reactions_count_a_payload_while_it_is_there():
    scene = one_joint(BAR, level=100.0, load=2.0, carried=(0.2, 0.6))
    reactions = fj.joint_reactions(scene, fj.simulate(scene, [0, 0.4, 1.0]))
    right = [[0, G * m, G * (0.5 + m - 1)] for m in (1, 3, 1)]
    np.testing.assert_allclose(reactions[:, 0], right, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_of_slides_that_bounce_off_a_stop_and_come_to_rest():
    """In a batch, in the restitution that all share and in the friction of each."""

    def ends(numbers):
        restitution, *levels = numbers
        stops = HardStops(-inf, 1.0, restitution=restitution)

        def end(level):
            forces, start = (JointFriction(level), stops), fj.State([0.0], [3.0])
            return fj.simulate(SLIDE, start, [0, 9.0], forces, **FORWARD).q[-1, 0]

        return jax.vmap(end)(jnp.stack(levels))

    def exact(numbers):
        restitution, levels = numbers[0], numbers[1:]
        return 1 - restitution**2 * (9 - 2 * levels) / (2 * levels)

    at = jnp.array([0.5, 1.2, 1.0])
    curves, slopes, places = hessian(ends)(at)
    np.testing.assert_allclose(places, exact(at), rtol=0, atol=1e-9)
    np.testing.assert_allclose(slopes, jax.jacfwd(exact)(at), rtol=0, atol=1e-9)
    np.testing.assert_allclose(curves, jax.hessian(exact)(at), rtol=0, atol=1e-8)


def test_efforts_of_friction_that_has_a_level_in_each_direction():
    scene = SLOPE(2.0, 4.0, 1.0)
    efforts = fj.joint_efforts(scene, fj.simulate(scene, [0, 0.1, 1.0]))
    np.testing.assert_allclose(efforts.total[:, 0], [-4, -4, 1], rtol=0, atol=1e-12)


# Friction of functions


def scipy_times(coulomb, static, speed, stiffness, pace, end):
    """Returns the times at which a dragged slide slips and sticks, in turn."""

    def rates(t, y):
        fall = (static - coulomb) * np.exp(-((y[1] / speed) ** 2))
        return y[1], stiffness * (pace * t - y[0]) - coulomb - fall

    rests = lambda t, y: y[1]
    rests.terminal, rests.direction = True, -1
    x, times = 0.0, []
    while (slips := (x + static / stiffness) / pace) < end:
        found = solve_ivp(
            rates, (slips, slips + 2), (x, 0.0), "DOP853", events=rests,
            rtol=1e-12, atol=1e-14, first_step=1e-6,
        )  # fmt: skip
        x = found.y_events[0][0][0]
        times += [slips, found.t_events[0][0]]
    return np.array(times)


@pytest.mark.slow
def test_a_dragged_slide_sticks_and_slips_as_scipy_has_it():
    """Its derivatives are differences; a held slide at q slips at a known time."""

    def dragged(numbers):
        *friction, stiffness, pace = numbers
        drag = lambda t, q, qd, linkage: stiffness * (pace * t - q)
        forces, ts = (JointFriction(stribeck(*friction)), drag), [0, 0.9, 7.5]
        options = dict(rtol=1e-12, atol=1e-12) | FORWARD
        motion = fj.simulate(SLIDE, REST, ts, forces, **options)
        return motion.events.t, motion.q[1:, 0], motion.taken[-1]

    numbers = np.array([2.0, 3.0, 0.05, 100.0, 0.1])
    _, static, _, stiffness, pace = numbers
    both = jacobian(dragged)
    (of_times, of_places, _), (times, places, taken) = both(numbers)
    right = scipy_times(*numbers, 7.5)
    assert len(right) == np.isfinite(times).sum() == 20
    np.testing.assert_allclose(times[:20], right, rtol=0, atol=1e-9)
    assert taken < 1e-20  # functions are not counted
    np.testing.assert_allclose(times[2], (places[0] + static / stiffness) / pace)
    wanted = of_places[0] + [0, 1 / stiffness, 0, -static / stiffness**2, -times[2]]
    np.testing.assert_allclose(of_times[2], wanted / pace, rtol=1e-8)
    for k, step in enumerate(1e-5 * numbers * np.eye(5)):
        after, before = (both(numbers + sign * step)[1] for sign in (1, -1))
        for slopes, *ends in zip((of_times[:2], of_places), after, before):
            wanted = np.subtract(*(end[:2] for end in ends)) / (2 * step[k])
            np.testing.assert_allclose(slopes[:, k], wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("change", [-2.0, 0.5])
def test_friction_that_becomes_what_it_cannot_be_ends_a_motion(change):
    """Negative, or above the static friction."""
    friction = JointFriction(lambda t, q, qd, linkage: 1 + change * t, static=1.2)
    start = fj.State([0.0], [9.0])
    motion = fj.simulate(SLIDE, start, [0, 1.0], (friction,), throw=False)
    assert motion.outcome == "not finite"
    assert 0.15 < motion.stats["time_reached"] < 0.51


def test_friction_of_a_function_is_written_to_files(tmp_path):
    friction = JointFriction(stribeck([2.0], 3.0, 0.1), static=[[4.0], [5.0]])
    fj.save(tmp_path / "friction.json", friction)
    assert repr(fj.load(tmp_path / "friction.json")) == repr(friction)


@pytest.mark.slow
def test_states_of_drives_go_on_while_a_brake_holds():
    """An integral and the lags of a controller and of a force, by exponentials."""
    kp, ki, kd, lag, goal = 40.0, 30.0, 12.0, 0.05, 0.5
    pid = fj.control.PIDController(kp, ki, kd, inf, fj.references.SetPoint([goal]))
    lagged = fj.control.FirstOrderLag
    drives = lagged(pid, lag), lagged(fj.JointEffort(3.0), lag)
    # By position, rate, integral, both lags and 1
    moving = np.zeros((6, 6))
    moving[0, 1], moving[1, 3:5], moving[2, [0, 5]] = 1, 1, [-ki, ki * goal]
    moving[3, [0, 1, 2, 3, 5]] = np.array([-kp, -kd, 1, -1, kp * goal]) / lag
    moving[4, [4, 5]] = np.array([-1, 3]) / lag
    braked = moving * [[0], [0], [1], [1], [1], [1]]
    end = expm(0.4 * moving) @ [0.2, 0.3, 0, 0, 0, 1]
    end = expm(0.1 * braked) @ np.diag([1, 0, 1, 1, 1, 1]) @ end
    *end, _ = expm(0.3 * moving) @ end
    forces = *drives, Brake(1, 0.4, 0.5)
    motion = fj.simulate(SLIDE, fj.State([0.2], [0.3]), [0, 0.8], forces)
    own = [leaf[-1, 0] for leaf in jax.tree.leaves(motion.own)]
    np.testing.assert_allclose([motion.q[-1, 0], motion.qd[-1, 0]], end[:2], atol=1e-9)
    np.testing.assert_allclose(np.sort(own), np.sort(end[2:]), atol=1e-8)
