"""The circle's joint reference over many turns, and its reach."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)


def arm(topology, **changes):
    arguments = dict(
        length=[0.2, 1.1, 1.3, 0.4], com=[[0.5, 0.1]] * 3, mass=[1, 1, 1],
        inertia=[1, 1, 1], locked=[0.2, 0.7, -0.5], base_angle=0.4,
    )  # fmt: skip
    return fj.Linkage(topology, **arguments | changes)


def circle_of(linkage, **changes):
    """Returns a circle around a bent posture's tip, reachable for its topology."""
    q = [0.8, 1.5, 0.4]
    x, _ = fj.paper.to_chain(linkage, q, [0, 0, 0])
    center = fj.tip_position(linkage, q)
    return fj.CircleTask(center, 0.1, 2.5, phase=0.6, orientation=x[5], **changes)


@jax.jit
def references(task, linkage, times):
    return jax.vmap(lambda t: task(t, linkage))(times)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def commanded(task, t):
    """Returns the commanded tip and its velocity."""
    return jax.jvp(task.tip, (t,), (jnp.ones_like(t),))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def tip_motion(linkage, q, qd):
    """Returns the tip, its velocity and rotation, and the last link's angle."""
    x, _ = fj.paper.to_chain(linkage, q, qd)
    return fj.tip_position(linkage, q), fj.tip_jacobian(linkage, q) @ qd, x[5]


@pytest.mark.parametrize("period", [5.0, -3.0])
def test_the_tip_runs_round_the_circle_at_constant_speed(period):
    center, radius, phase = np.array([1.0, -2.0]), 0.7, 0.3
    task = fj.CircleTask(center, radius, period, phase)
    times = np.array([0, 0.4, 7.3])
    for tip, velocity in zip(*map(np.asarray, commanded(task, times))):
        arm_vector = tip - center
        turn = 2 * np.pi / period
        assert np.hypot(*arm_vector) == pytest.approx(radius)
        np.testing.assert_allclose(
            velocity, turn * np.array([-arm_vector[1], arm_vector[0]]), atol=1e-13
        )
    start = center + radius * np.array([np.cos(phase), np.sin(phase)])
    np.testing.assert_allclose(task.tip(0), start)
    np.testing.assert_allclose(task.tip(3 * period), start)


@pytest.mark.slow
@each_topology
@pytest.mark.parametrize("branch", [1, -1])
def test_the_reference_puts_the_tip_on_the_circle(topology, branch):
    linkage = arm(topology)
    task = circle_of(linkage, branch=branch)
    times = np.linspace(0, 5, 23)
    q, qd = references(task, linkage, times)
    tips, rate, angle = map(np.asarray, tip_motion(linkage, q, qd))
    expected, velocity = commanded(task, times)
    np.testing.assert_allclose(tips, expected, atol=1e-12)
    turns = (angle - np.asarray(task.orientation)) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.full(23, np.round(turns[0])), atol=1e-12)
    # Its rate moves the tip along the circle without turning the last link.
    np.testing.assert_allclose(rate[:, :2], velocity, atol=1e-11)
    np.testing.assert_allclose(rate[:, 2], np.zeros(23), atol=1e-11)
    start = fj.inverse_kinematics(linkage, task.tip(0), task.orientation, branch=branch)
    np.testing.assert_allclose(q[0], start, atol=1e-12)


# Continuity. The arms' wrists see the base at the origin; the hub is the circle's
# centre as the wrist sees it: the tip runs 0.4 m to the right of the wrist.


def wrist_arm(topology):
    """Returns an arm of long reach; the RPR one has its slide through the base."""
    length = [0, 2, 2.5, 0.4] if topology == "RRR" else [0, 0.1, 0.1, 0.4]
    return arm(topology, length=length, locked=0, base_angle=0)


def wrist_circle(hub, radius, **keywords):
    center = np.array(hub) + [0.4, 0]
    return fj.CircleTask(center, radius, orientation=0, **keywords)


CIRCLES = {
    "beside": ([1.8, 0.1], 0.7, 0),
    "across the negative x axis": ([-1.8, 0.1], 0.7, 0),
    "on the negative x axis": ([-1.8, 0.0], 0.7, 0),
    "around the base": ([0.3, -0.2], 1.7, 1),
    "centred on the base": ([0.0, 0.0], 1.7, 1),
}


@pytest.mark.parametrize("topology", ["RRR", "RPR"])
@pytest.mark.parametrize("circle", CIRCLES)
def test_the_reference_never_jumps_and_counts_its_turns(circle, topology):
    hub, radius, winding = CIRCLES[circle]
    linkage = wrist_arm(topology)
    step = 0.005
    times = step * np.arange(1201)  # three turns
    for phase in (0.0, 0.2, -0.2, 2.0, np.pi, -np.pi, 3 * np.pi, 20.0):
        for period in (2.0, -2.0):
            task = wrist_circle(hub, radius, period=period, phase=phase)
            q, qd = map(np.asarray, references(task, linkage, times))
            # No arm at the start of the circle is told to unwind.
            start = fj.inverse_kinematics(linkage, task.tip(0), 0)
            np.testing.assert_allclose(q[0], start, atol=1e-9)
            largest = 1.01 * np.abs(qd).max(axis=0) * step + 1e-12
            assert (np.abs(np.diff(q, axis=0)).max(axis=0) <= largest).all()
            turns = (q[-1] - q[0]) / (2 * np.pi)
            expected = 3 * winding * np.sign(period)
            np.testing.assert_allclose(turns, [expected, 0, -expected], atol=1e-9)


def test_a_start_one_turn_away_unwinds():
    linkage = arm("RPR")
    task = circle_of(linkage)
    controller = fj.PDController(40, 40, np.inf, task)
    q, qd = task(0, linkage)
    turn = jnp.array([2 * np.pi, 0, 0])
    at_rest = controller(0, q, qd, linkage)
    np.testing.assert_allclose(at_rest, np.zeros(3), atol=1e-12)
    for start, effort in (q + turn, -40 * turn), (q - turn, 40 * turn):
        np.testing.assert_allclose(
            controller(0, start, qd, linkage), effort, atol=1e-12
        )


@jax.jit
def reference_derivatives(task, linkage):
    """Returns derivatives in the circle and the linkage, and the tip Jacobian."""

    def positions(task, linkage):
        return task(0.7, linkage)[0]

    return (
        jax.jacrev(positions, argnums=(0, 1))(task, linkage),
        fj.tip_jacobian(linkage, positions(task, linkage)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "hub, radius",
    [
        ([0.0, 0.0], 1.7),  # the bearing of this hub is undefined
        ([0.3, -0.2], 1.7),
        ([-1.8, 0.1], 0.7),
        ([-1.8, 0.1], 0.0),  # a point
    ],
)
def test_the_reference_is_differentiable_in_circle_and_linkage(hub, radius):
    derivatives, jacobian = reference_derivatives(
        wrist_circle(hub, radius), wrist_arm("RRR")
    )
    for leaf in jax.tree.leaves(derivatives):
        assert np.isfinite(leaf).all()
    identity = np.eye(3)[:, :2]  # the tip moves as the centre does
    np.testing.assert_allclose(jacobian @ derivatives[0].center, identity, atol=1e-11)


@pytest.mark.parametrize("begin", [0.0, 1.3])
def test_circles_out_of_reach_are_refused_to_the_edge(begin):
    # The RRR arm reaches 4.5 m; the circle touches that edge at one point.
    linkage, hub = wrist_arm("RRR"), [3.0 * np.cos(1), 3.0 * np.sin(1)]
    ts = np.array([begin, 20.0])
    wrist_circle(hub, 1.5 - 1e-6, phase=0.123).check(linkage, ts)
    with pytest.raises(ValueError, match="^reference: expected .* reach .*, got "):
        wrist_circle(hub, 1.5 + 1e-6, phase=0.123).check(linkage, ts)
