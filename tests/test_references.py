"""References: tip paths by inverse kinematics, and moves in joint space."""

import re

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from scipy.interpolate import CubicSpline

import fdof_jax as fj

LINKAGE = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
)
ARM = fj.Linkage(
    "RRR", length=[0, 1, 1, 0.3], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[0.1] * 3
)
SLIDING = fj.scenes.fig7().linkage
POINTS = np.array([[1.2, 0.3], [1.4, 0.6], [1.1, 0.9], [0.8, 0.5]])
PATHS = {
    "line": fj.references.Line([1.2, -0.4], [0.9, 0.8]),
    "ellipse": fj.references.Ellipse([1.1, 0.4], [0.4, 0.2], tilt=0.3),
    "eight": fj.references.FigureEight([1.1, 0.4], [0.4, 0.2], tilt=-0.2),
    "spline": fj.references.Spline(POINTS),
    "closed spline": fj.references.Spline(POINTS, closed=True),
}
TS = np.linspace(0, 3, 61)
TIMINGS = {"travel": fj.references.Travel(2.0), "laps": fj.references.Laps(2.0)}


@eqx.filter_jit
def seen(path, timing, branch, ts):
    """Returns a task's joint positions and tips; one program serves each path."""
    task = fj.TipTask(path, timing, orientation=0.2, branch=branch)

    def at(t):
        q, qd = task(t, ARM)
        return (q, qd), fj.tip_position(ARM, q), path.point(timing(t))

    return jax.vmap(at)(ts)


@pytest.mark.slow
@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("branch", [1, -1])
def test_the_tip_is_on_the_path(path, timing, branch):
    ts = np.linspace(0.05, 1.95, 8)
    at = lambda ts: seen(PATHS[path], TIMINGS[timing], np.array(branch), ts)
    (q, qd), tip, point = at(ts)
    np.testing.assert_allclose(tip, point, atol=1e-12)
    np.testing.assert_allclose(np.sum(q, axis=1), 0.2, rtol=1e-6)
    ahead, behind = (np.asarray(at(ts + h)[0][0]) for h in (1e-6, -1e-6))
    np.testing.assert_allclose(qd, (ahead - behind) / 2e-6, atol=1e-6)


def test_a_tilt_is_counter_clockwise():
    for closed, first in (
        (fj.references.Ellipse, 0.0),
        (fj.references.FigureEight, 0.25),
    ):
        path = closed([1, 0], [2, 1], tilt=np.pi / 2)
        np.testing.assert_allclose(path.point(first), [1, 2], atol=1e-15)


def test_rounding_beside_the_negative_x_axis_adds_no_turn():
    for side in (1e-13, -1e-13):
        line = fj.references.Line([-1.3, side], [-1.5, side])
        q, _ = fj.TipTask(line, fj.references.Travel(1.0), orientation=np.pi)(0.5, ARM)
        np.testing.assert_allclose(q.sum(), np.pi, rtol=1e-6)
        assert q[0] > 0


def test_the_circle_as_an_ellipse_is_fig_7_s():
    circle = fj.CircleTask()
    ellipse = fj.references.Ellipse([-4, 2], [0.75, 0.75])
    task = fj.TipTask(
        ellipse, fj.references.Laps(5.0, phase=0.5), orientation=np.pi / 2
    )
    for t in (0.0, 1.3, 4.0, 11.0):
        for a, b in zip(task(t, SLIDING), circle(t, SLIDING)):
            np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("closed", [False, True])
def test_a_spline_is_scipy_s(closed):
    path = fj.references.Spline(POINTS, closed=closed)
    knots = np.linspace(0, 1, 5 if closed else 4)
    points = np.vstack([POINTS, POINTS[:1]]) if closed else POINTS
    exact = CubicSpline(knots, points, bc_type="periodic" if closed else "natural")
    shares = np.linspace(0, 1, 41)
    found = jax.jit(jax.vmap(path.point))(shares)
    np.testing.assert_allclose(found, exact(shares), atol=1e-13)


def test_a_joint_move():
    move = fj.references.JointMove(
        [0, 1, 2], [1, 1, 0], fj.references.Travel(2.0, profile="cycloidal")
    )
    q, qd = move(1.0, ARM)
    np.testing.assert_allclose(q, [0.5, 1, 1], atol=1e-15)
    np.testing.assert_allclose(qd, [1, 0, -2], atol=1e-14)
    np.testing.assert_allclose(move.jump_ts, [0, 2])


def test_a_task_without_an_orientation_needs_an_arm_of_two_joints():
    line = fj.references.Line([1, 0], [1, 1])
    task = fj.TipTask(line, fj.references.Travel(2.0), orientation=None)
    with pytest.raises(ValueError, match="linkage: expected 2 joints .* got 3"):
        task(0.0, ARM)


RING = fj.references.Ellipse([0.5, 0], [1.2, 1.2])  # round the pivot


class Ramp(eqx.Module):
    """A timing of a user's own."""

    begin: float

    def __call__(self, t):
        return jnp.clip(t - self.begin, 0, 1)


@eqx.filter_jit
def reached(task, ts):
    return fj.references.reachable(ARM, task, ts)


@pytest.mark.slow
@pytest.mark.parametrize("begin, end", [(0.0, 1.0), (0.0, 400.0), (0.7, 3e4)])
def test_a_short_travel_is_checked_in_runs_of_any_length(begin, end):
    """So few samples of a run would leave none or two within the second."""
    ts = jnp.array([0.0, end + begin])
    for timing in fj.references.Travel(1.0, begin=begin), Ramp(np.array(begin)):
        ring = fj.TipTask(RING, timing)
        with pytest.raises(ValueError, match="behind the ground pivot"):
            ring.check(ARM, ts)
        assert not reached(ring, ts).any()
        # Its most distant point is out of reach for a moment.
        line = fj.references.Spline([[1, 0], [2.5, 0], [1, 0.1]])
        with pytest.raises(ValueError, match="within the linkage's reach") as raised:
            fj.TipTask(line, timing).check(ARM, ts)
        words = str(raised.value).split()
        when = float(words[words.index("s,") - 1])
        assert begin < when < begin + 1
        assert "beyond it by at most" in str(raised.value)
        beside = fj.TipTask(fj.references.Ellipse([1.3, 0], [0.4, 0.4]), timing)
        beside.check(ARM, ts)
        assert reached(beside, ts).all()


def test_known_references_are_checked_within_transformations():
    line = fj.references.Line([1, 0], [4, 0])
    task, circle = fj.TipTask(line, TIMINGS["travel"]), fj.CircleTask([9.0, 9.0])
    ts = jnp.array([0.0, 2.0])

    @jax.jit
    def inside(x):
        for reference in task, circle:
            with pytest.raises(ValueError, match="within the linkage's reach"):
                reference.check(ARM, ts)
        return x

    inside(1.0)


@pytest.mark.filterwarnings("ignore:prismatic joints 2 and 3")
@pytest.mark.slow
def test_margins_of_the_reach_and_their_derivatives():
    line = fj.references.Line([2.5, 0], [3.5, 0])  # the last link points along it
    task, ts = fj.TipTask(line, fj.references.Travel(1.0)), [0.0, 0.5, 1.0]

    def margin(length):
        return fj.references.reach_margin(ARM.replace(length=length), task, ts)

    lengths = jnp.array([0.0, 1.0, 1.2, 0.8])
    np.testing.assert_allclose(margin(lengths), [0.5, 0, -0.5], atol=1e-15)
    slopes = jax.jit(jax.jacfwd(margin))(lengths)
    np.testing.assert_allclose(slopes, np.ones((3, 4)), atol=1e-15)
    # Two slides reach everywhere, unless they are parallel.
    for locked, found in ([0, 0.5, 0], np.inf), ([0, 0, 0], -np.inf):
        slides = ARM.replace(topology="RPP", locked=locked)
        got = fj.references.reach_margin(slides, task, ts)
        np.testing.assert_array_equal(got, [found] * 3)

    def at(center):
        """The margin at a point, for an arm whose first joint is at the origin."""
        arm = fj.scenes.double_pendulum().linkage.replace(length=[0.0, 1.0, 0.6])
        point = fj.references.Ellipse(center, [0, 0])
        lap = fj.references.Laps(period=1.0)
        task = fj.TipTask(point, lap, orientation=None)
        return fj.references.reach_margin(arm, task, [0.0])[0]

    assert at(jnp.zeros(2)) == pytest.approx(-0.4)
    np.testing.assert_array_equal(jax.grad(at)(jnp.zeros(2)), 0)


def test_only_the_part_of_a_travel_within_the_run_is_checked():
    ring = fj.TipTask(RING, fj.references.Travel(1.0, profile="harmonic"))
    ring.check(ARM, jnp.array([0.0, 0.4]))
    ring.check(ARM, jnp.array([5.0, 9.0]))
    with pytest.raises(ValueError, match="behind the ground pivot"):
        ring.check(ARM, jnp.array([0.4, 0.6]))


def test_a_spline_of_many_points_is_checked_between_all():
    """One of its points is behind the pivot, between points that are not."""
    points = np.tile([1.0, 0.0], (3000, 1))
    points[::2, 1] = 0.1
    points[1801:1805] = [[0.5, 1.0], [-1.0, 0.5], [-1.0, -0.5], [0.5, -1.0]]
    task = fj.TipTask(fj.references.Spline(points), fj.references.Travel(1.0))
    with pytest.raises(ValueError, match="behind the ground pivot"):
        task.check(ARM, jnp.array([0.0, 1.0]))


@pytest.mark.slow
def test_a_path_behind_the_pivot_or_left_by_laps_fails_where_it_is_traced():
    """Its joints would jump by a turn, which the motion would follow."""

    @jax.jit
    def outcomes(x, size):
        def of(path):
            task = fj.TipTask(path, fj.references.Laps(-2.0))
            forces = (fj.PDController(10.0, 1.0, 100.0, task),)
            start = fj.State(np.zeros(3), np.zeros(3))
            ts = [0, 0.1, 2]
            motion = fj.simulate(ARM, start, ts, forces, throw=False, **SHORT)
            return motion.result, fj.references.reachable(ARM, task, [0.0, 2.0])

        line = fj.references.Line([1, 0], [1 + x, 0.5])
        return of(fj.references.Ellipse([x, 0], [size, size])), of(line)

    cases = (0.5, 1.2, "nonfinite"), (1.3, 0.4, "successful")
    for x, size, expected in cases:
        (ring, seen), (line, beyond) = outcomes(x, size)
        assert ring == getattr(diffrax.RESULTS, expected)
        assert line == diffrax.RESULTS.nonfinite
        assert seen.all() == (x == 1.3) and not beyond.any()


def test_laps_need_a_closed_path():
    line = fj.references.Line([1, 0], [1, 0.5])
    task = fj.TipTask(line, fj.references.Laps(2.0))
    with pytest.raises(ValueError, match="a closed path for `Laps`, .* ends 0.5 m"):
        task.check(ARM, jnp.array([0.0, 1.0]))


def test_backward_laps_are_checked_over_a_whole_lap():
    ring = fj.TipTask(
        fj.references.Ellipse([0.5, 0], [1.2, 1.2]), fj.references.Laps(-2.0)
    )
    with pytest.raises(ValueError, match="behind the ground pivot"):
        ring.check(ARM, jnp.array([0.0, 5.0]))
    ring.check(ARM, jnp.array([0.0, 0.2]))
    times, fits = ([0.0, 0.2], [0.0, 5.0]), jax.jit(lambda ts: ring.fits(ARM, ts))
    assert [bool(fits(np.array(ts))) for ts in times] == [True, False]


class Swinging(fj.references.Path):
    """A path to and fro along a wide arc, checked lap by lap."""

    @property
    def middle(self):
        return jnp.array([0.4, 0.0])

    def point(self, share):
        angle = 2 * jnp.sin(2 * jnp.pi * share)
        return self.middle + 1.2 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def test_a_path_without_middle_is_refused():
    class Nowhere(fj.references.Path):
        def point(self, share):
            return jnp.stack([share, share])

    with pytest.raises(ValueError, match="^path: expected a Path that .*`middle`.*got"):
        fj.TipTask(Nowhere(), fj.references.Laps(1.0))


def test_many_laps_are_as_good_as_one():
    task = fj.TipTask(Swinging(), fj.references.Laps(1.0))
    for end in (1.0, 400.0):
        task.check(ARM, jnp.array([0.0, end]))


_reachable = jax.jit(fj.references.reachable)


@jax.jit
def followed(arm, circle, ts):
    """Returns whether inverse kinematics find joints, and the tip's errors in reach."""

    def at(t):
        place, (q, _) = circle.tip(t), circle(t, arm)
        error = fj.tip_position(arm, q) - place
        q = fj.inverse_kinematics(arm, place, circle.orientation, branch=circle.branch)
        within = jnp.isfinite(q).all()
        return within, jnp.where(within, error, 0)

    return jax.vmap(at)(ts)


@pytest.mark.slow
@pytest.mark.parametrize("topology", [*fj.TOPOLOGIES, "RFRR"])
def test_a_circle_is_reachable_where_inverse_kinematics_find_the_joints(topology):
    arm = chains.random_chain(topology, np.random.default_rng(0))
    some = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        center, (radius, phase, angle) = random.normal(size=2), random.uniform(size=3)
        circle = fj.CircleTask(center, radius, 2.0, phase, angle, (-1) ** seed)
        within, errors = followed(arm, circle, TS)
        np.testing.assert_allclose(errors, 0, atol=1e-12)
        for reachable in fj.references.reachable, _reachable:
            np.testing.assert_array_equal(reachable(arm, circle, TS), within)
        some += within.any() and not within.all()
    assert some or topology.count("P") == 2  # of which none is out of reach


# Refused


def test_branches_are_plus_or_minus_one_in_numbers_of_any_kind():
    solve = lambda side: fj.inverse_kinematics(LINKAGE, [1, 1], 0.0, branch=side)
    for branch in (0, 2, -1.5, "1", None, True, np.nan, [1]):
        for call in solve, lambda side: fj.CircleTask(branch=side):
            with pytest.raises(ValueError, match="^branch: expected .+, got .+"):
                call(branch)
    for branch in (1, -1.0, np.int64(-1), np.float32(1), jnp.array(1)):
        assert fj.CircleTask(branch=branch).branch == float(branch)
        solve(branch)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, words",
    [
        (fj.CircleTask([9, 9], radius=0, orientation=0.5), "at orientation 0.5 rad on"),
        (
            fj.TipTask(fj.references.Line([1, 1], [9, 9]), lambda t: t, branch=-1),
            "at orientation 0 rad on branch -1",
        ),
    ],
    ids=["circle", "line"],
)
def test_what_a_task_commands_out_of_reach_is_refused_or_nan(task, words):
    arm = LINKAGE
    place = re.escape("[9, 9] m, beyond it by ")
    message = (
        f"^t: expected .* reach {words}.*, got 1 s, at which .* {place}[0-9.]+ m.$"
    )
    with pytest.raises(ValueError, match=message):
        task(1.0, arm)
    assert np.isnan(jax.jit(lambda t: task(t, arm))(1.0)).any()


def test_paths_that_begin_at_the_edge_of_the_reach_are_refused():
    """The joints' velocities are not finite there."""
    line, travel = fj.references.Line([3, 0], [1, 1]), fj.references.Travel(1.0)
    with pytest.raises(ValueError, match="reference: .* that leaves it at 0 s"):
        fj.TipTask(line, travel).check(LINKAGE, np.array([0.0, 1.0]))
    touching = fj.CircleTask([1.0, 0], 2.0, 2.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="reference: expected a circle within"):
        touching.check(LINKAGE, np.linspace(0, 3, 61))
    assert not fj.references.reachable(LINKAGE, touching, [0.0, 0.5])[0]


def test_circles_are_refused_for_their_nearest_point_alone():
    arm = LINKAGE.replace(length=[0, 1, 0.6, 0.3], com=[[0, 0]] * 3)
    ts = np.array([0.0, 5.0])
    # The wrist comes within 0.4 m of the base, between samples of the circle.
    circle = lambda radius: fj.CircleTask([1.2, 0], radius, 5.0, np.pi / 256, 0.0)
    circle(0.5 - 1e-7).check(arm, ts)
    with pytest.raises(ValueError, match="reference: expected a circle within"):
        circle(0.5 + 1e-7).check(arm, ts)
