"""References: profiles of motions, tip paths, circles by inverse kinematics, reach."""

import chains
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import fdof_jax as fj
from fdof_jax.references import Ellipse, FigureEight, Laps, Line, Spline, Travel
from fdof_jax.references.timing import PROFILES

ARM = fj.Linkage(
    "RRR", length=[0, 1, 1, 0.3], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[0.1] * 3
)
POINTS = np.array([[1.2, 0.3], [1.4, 0.6], [1.1, 0.9], [0.8, 0.5]])
RING = Ellipse([0.5, 0], [1.2, 1.2])  # round the pivot


@eqx.filter_jit
def seen(task, arm, t):
    """Returns joints, their rates, tips and commanded tips, and their derivatives."""

    def at(t):
        q, qd = task(t, arm)
        return q, qd, fj.tip_position(arm, q), task.path.point(task.timing(t))

    return jax.jvp(at, (t,), (1.0,))


@pytest.mark.slow
@pytest.mark.parametrize(
    "topology, path, timing",
    [
        ("RRR", Spline(POINTS), Travel(2.0)),
        ("RRR", FigureEight([1.1, 0.4], [0.4, 0.2], tilt=-0.2), Laps(2.0)),
        *((name, None, Laps(2.0)) for name in ("RR", "RP", "PR", "RFP")),
    ],
)
def test_the_tip_is_on_the_path(topology, path, timing):
    """Also of two joints, whose task commands no orientation."""
    arm, orientation = ARM, 0.2
    if path is None:
        n, orientation = len(topology), None
        arm = chains.random_chain(topology, np.random.default_rng(10))
        arm = arm.replace(length=np.linspace(0.4, 1, n + 1))
        path = Ellipse(fj.tip_position(arm, np.full(n, 1.5)), [0.02, 0.01])
    for branch in (1.0, -1.0):
        task = fj.TipTask(path, timing, orientation=orientation, branch=branch)
        for t in jnp.array([0.05, 0.9, 1.7]):  # data of one program
            (q, qd, tip, point), (rate, _, velocity, commanded) = seen(task, arm, t)
            np.testing.assert_allclose(tip, point, atol=1e-12)
            np.testing.assert_allclose(qd, rate, atol=1e-12)
            np.testing.assert_allclose(velocity, commanded, atol=1e-11)
            if orientation:
                np.testing.assert_allclose(np.sum(q), orientation, rtol=1e-6)


def test_a_tilt_is_counter_clockwise():
    for closed, first in (Ellipse, 0.0), (FigureEight, 0.25):
        path = closed([1, 0], [2, 1], tilt=np.pi / 2)
        np.testing.assert_allclose(path.point(first), [1, 2], atol=1e-15)


@pytest.mark.parametrize("kind", ["natural", "periodic"])
def test_a_spline_is_scipy_s(kind):
    closed, shares = kind == "periodic", np.linspace(0, 1, 41)
    points = np.vstack([POINTS, POINTS[: int(closed)]])
    exact = CubicSpline(np.linspace(0, 1, len(points)), points, bc_type=kind)
    found = jax.jit(jax.vmap(Spline(POINTS, closed=closed).point))(shares)
    np.testing.assert_allclose(found, exact(shares), atol=1e-13)


# Circles


@pytest.mark.parametrize("period", [5.0, -3.0])
def test_a_circle_is_an_ellipse(period):
    """Its joints, their rates and its tip; the ellipse counts no turns."""
    arm = fj.scenes.fig7().linkage
    circle, laps = fj.CircleTask(period=period), Laps(period, phase=0.5)
    task = fj.TipTask(Ellipse([-4, 2], [0.75, 0.75]), laps, orientation=np.pi / 2)
    for t in (0.0, 1.3, 4.0, 11.0):
        np.testing.assert_allclose(circle.tip(t), task.tip(t), atol=1e-14)
        for a, b in zip(task(t, arm), circle(t, arm)):
            np.testing.assert_allclose(a, b, atol=1e-12)


# These arms see the base at the origin; the hub is the circle's centre as the wrist
# sees it: the tip runs 0.4 m to the right of the wrist.
LENGTHS = {"RRR": [0, 2, 2.5, 0.4], "RPR": [0, 0.1, 0.1, 0.4]}
WRIST_ARMS = {
    name: ARM.replace(topology=name, length=LENGTHS[name]) for name in LENGTHS
}


def wrist_circle(hub, radius, **keywords):
    return fj.CircleTask(np.array(hub) + [0.4, 0], radius, orientation=0, **keywords)


CIRCLES = {
    "beside": ([1.8, 0.1], 0.7, 0),
    "across the negative x axis": ([-1.8, 0.1], 0.7, 0),
    "on the negative x axis": ([-1.8, 0.0], 0.7, 0),
    "around the base": ([0.3, -0.2], 1.7, 1),
    "centred on the base": ([0.0, 0.0], 1.7, 1),
}


@jax.jit
def along(task, arm, times):
    return jax.vmap(lambda t: task(t, arm))(times)


@pytest.mark.parametrize("topology", WRIST_ARMS)
@pytest.mark.parametrize("circle", CIRCLES)
def test_the_reference_never_jumps_and_counts_its_turns(circle, topology):
    (hub, radius, winding), arm = CIRCLES[circle], WRIST_ARMS[topology]
    step = 0.005
    times = step * np.arange(1201)  # three turns
    for phase in (0.0, 0.2, -0.2, 2.0, np.pi, -np.pi, 3 * np.pi, 20.0):
        for period in (2.0, -2.0):
            task = wrist_circle(hub, radius, period=period, phase=phase)
            q, qd = map(np.asarray, along(task, arm, times))
            # No arm at the start of the circle is told to unwind.
            start = fj.inverse_kinematics(arm, task.tip(0), 0)
            np.testing.assert_allclose(q[0], start, atol=1e-9)
            largest = 1.01 * np.abs(qd).max(axis=0) * step + 1e-12
            assert (np.abs(np.diff(q, axis=0)).max(axis=0) <= largest).all()
            turns = (q[-1] - q[0]) / (2 * np.pi)
            expected = 3 * winding * np.sign(period)
            np.testing.assert_allclose(turns, [expected, 0, -expected], atol=1e-9)


@jax.jit
def solved(arm, circle, ts):
    """Returns where inverse kinematics find the joints."""

    def at(t):
        tip = circle.tip(t), circle.orientation
        q = fj.inverse_kinematics(arm, *tip, branch=circle.branch)
        return jnp.isfinite(q).all()

    return jax.vmap(at)(ts)


@pytest.mark.slow
@pytest.mark.parametrize("topology", [*fj.TOPOLOGIES, "RFRR"])
def test_a_circle_is_reachable_where_inverse_kinematics_find_the_joints(topology):
    arm, some = chains.random_chain(topology, np.random.default_rng(0)), 0
    ts = np.linspace(0, 3, 61)
    for seed in range(12):
        random = np.random.default_rng(seed)
        center, (radius, phase, angle) = random.normal(size=2), random.uniform(size=3)
        circle = fj.CircleTask(center, radius, 2.0, phase, angle, (-1) ** seed)
        within = solved(arm, circle, ts)
        found = fj.references.reachable(arm, circle, ts)
        np.testing.assert_array_equal(found, within)
        some += within.any() and not within.all()
    assert some or topology.count("P") == 2  # of which none is out of reach


# Checks of the reach


def test_margins_of_the_reach_and_their_derivatives():
    line = Line([2.5, 0], [3.5, 0])  # the last link points along it
    task, ts = fj.TipTask(line, Travel(1.0)), [0.0, 0.5, 1.0]
    margin_of = lambda arm: fj.references.reach_margin(arm, task, ts)
    margin = lambda length: margin_of(ARM.replace(length=length))
    lengths = jnp.array([0.0, 1.0, 1.2, 0.8])
    np.testing.assert_allclose(margin(lengths), [0.5, 0, -0.5], atol=1e-15)
    slopes = jax.jit(jax.jacfwd(margin))(lengths)
    np.testing.assert_allclose(slopes, np.ones((3, 4)), atol=1e-15)
    # Two slides reach everywhere.
    slides = ARM.replace(topology="RPP", locked=[0, 0.5, 0])
    np.testing.assert_array_equal(margin_of(slides), np.inf)


class Ramp(eqx.Module):
    """A timing of a user's own."""

    begin: float

    def __call__(self, t):
        return jnp.clip(t - self.begin, 0, 1)


class Swinging(fj.references.Path):
    """A path to and fro along a wide arc: two laps are as good as many."""

    middle = jnp.array([0.4, 0.0])

    def point(self, share):
        angle = 2 * jnp.sin(2 * jnp.pi * share)
        return self.middle + 1.2 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def spline_of_many_points():
    """One of its points is behind the pivot, between points that are not."""
    points = np.tile([1.0, 0.0], (3000, 1))
    points[::2, 1] = 0.1
    points[1801:1805] = [[0.5, 1.0], [-1.0, 0.5], [-1.0, -0.5], [0.5, -1.0]]
    return Spline(points)


BEHIND, BEYOND = "behind the ground pivot", "within the linkage's reach"
EDGE = np.nextafter(2.3, 3)  # 2 m beside 0.3 m, in floating point
MOMENT = Spline([[1, 0], [2.5, 0], [1, 0.1]])  # out of reach for a moment


@pytest.mark.slow
@pytest.mark.parametrize(
    "path, timing, bad, good, words",
    [
        (RING, Laps(-2.0), [0, 5], [0, 0.2], BEHIND),
        (spline_of_many_points(), Travel(1.0), [0, 1], [0, 0.3], BEHIND),
        # So few samples of a run would leave none or two within the second.
        (RING, Ramp(np.array(0.7)), [0, 3e4], [0, 0.7], BEHIND),
        (MOMENT, Travel(1.0, begin=0.7), [0, 3e4], [0, 0.7], BEYOND),
        (Line([1, 0], [1, 0.5]), Laps(2.0), [0, 1], None, "closed path for `Laps`"),
        (Line([1, 0], [4, 0]), Travel(2.0), [0, 2], [0, 0.1], BEYOND),
        # The joints' velocities are not finite where they begin at the edge.
        (Line([EDGE, 0], [1, 1]), Travel(1.0), [0, 1], [0.1, 1], "leaves it at 0 s"),
        (Swinging(), Laps(1.0), None, [0, 400], None),
    ],
)
def test_paths_are_checked_over_the_time_of_the_run(path, timing, bad, good, words):
    """By an error, also within transformations; where they are traced, as data."""
    task = fj.TipTask(path, timing)
    within = lambda ts: fj.references.reachable(ARM, task, ts).all()
    fits = jax.jit(lambda ts: task.fits(ARM, ts) & within(ts))
    if bad is not None:
        bad = np.array(bad, float)
        with pytest.raises(ValueError, match=words):
            jax.jit(lambda x: task.check(ARM, bad))(1.0)
        assert words == BEYOND or not fits(bad)
    if good is not None:
        good = np.array(good, float)
        task.check(ARM, good)
        assert fits(good)


def test_a_line_beside_the_negative_x_axis_and_one_out_of_reach():
    """Rounding adds no turn; what a task commands is refused or NaN."""
    for side in (1e-13, -1e-13):
        line = Line([-1.3, side], [-1.5, side])
        q, _ = fj.TipTask(line, Travel(1.0), orientation=np.pi)(0.5, ARM)
        np.testing.assert_allclose(q.sum(), np.pi, rtol=1e-6)
        assert q[0] > 0
    task = fj.TipTask(Line([1, 1], [9, 9]), lambda t: t, branch=-1)
    words = r"^t: .* 0 rad on branch -1.* got 1 s, .*\[9, 9\] m, beyond it by [0-9.]+ m"
    with pytest.raises(ValueError, match=words):
        task(1.0, ARM)
    assert np.isnan(jax.jit(lambda t: task(t, ARM))(1.0)).any()


@pytest.mark.parametrize("at, phase", [(1.2, np.pi / 256), (1.4, 0.123)])
def test_circles_are_refused_for_their_nearest_or_farthest_point_alone(at, phase):
    """The wrist comes within 0.4 m of the base, or the tip 1.6 m away."""
    arm = ARM.replace(length=[0, 1, 0.6, 0.3])
    circle = lambda radius: fj.CircleTask([at, 0], radius, 5.0, phase, 0.0)
    for begin in (0.0, 1.3):
        ts = np.array([begin, begin + 5])
        circle(0.5 - 1e-7).check(arm, ts)
        with pytest.raises(ValueError, match="^reference: expected a circle within"):
            circle(0.5 + 1e-7).check(arm, ts)


# Profiles of point-to-point motions, and the shock against residual vibration


@jax.jit
def _derivatives(travel, times):
    rate = jax.grad(travel)
    return [jax.vmap(f)(times) for f in (travel, rate, jax.grad(rate))]


def derivatives(travel, times=np.linspace(0, 3, 1201)):
    """Returns the way, its rate and its second derivative."""
    return map(np.asarray, _derivatives(travel, times))


# The largest speed and acceleration, in units of the way per duration, and squared.
LARGEST = {
    "harmonic": (np.pi / 2, np.pi**2 / 2),
    "cycloidal": (2.0, 2 * np.pi),
    "quintic": (15 / 8, 10 / np.sqrt(3)),
    "trapezoidal": (4 / 3, 16 / 3),
}


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_leads_from_start_to_end_and_rests_there(profile):
    """Steps end where its acceleration jumps; a quintic's does not."""
    travel, times = Travel(2.0, begin=0.5, profile=profile), np.linspace(0, 3, 1201)
    way, rate, second = derivatives(travel, times)
    before, after = times < 0.5, times >= 2.5
    assert (way[before] == 0).all() and (way[after] == 1).all()
    assert (rate[before] == 0).all() and (rate[after] == 0).all()
    assert abs(rate[200]) < 1e-16 and (np.diff(way[200:1001]) > 0).all()
    np.testing.assert_allclose(way[200:1001] + way[1000:199:-1], 1, atol=1e-14)
    speed, acceleration = LARGEST[profile]
    assert rate.max() == pytest.approx(speed / 2, rel=1e-3)
    assert np.abs(second).max() == pytest.approx(acceleration / 4, rel=1e-2)
    inside = [1.0, 2.0] if profile == "trapezoidal" else []
    np.testing.assert_allclose(travel.jump_ts, [0.5, *inside, 2.5], rtol=1e-15)
    jumps = times[1:][np.abs(np.diff(second)) > 0.3]
    expected = travel.jump_ts if profile in ("harmonic", "trapezoidal") else []
    np.testing.assert_allclose(jumps, expected, atol=0.003)


@pytest.mark.parametrize("frequency", [2.0, 7.0])
def test_the_shock_takes_the_load_s_frequency_out(frequency):
    """A load on a spring follows x'' + w^2 x = -a; its integral is in closed form.

    The velocity then jumps at both ends.
    """
    plain = Travel(1.5, profile="harmonic")
    turn = frequency * 1.5
    content = np.cos(turn / 2) / (1 - (turn / np.pi) ** 2)
    shock = content / (content - np.sin(turn / 2) / (turn / 2))
    times = (np.arange(20_000) + 0.5) * 1.5 / 20_000
    wave, residual = np.exp(1j * frequency * times), []
    for travel in (plain, plain.replace(shock=shock)):
        way, rate, _ = derivatives(
            travel, np.append(times, [0, -1e-9, 1.5, 1.5 - 1e-9])
        )
        residual.append(abs(np.mean(rate[:-4] * wave)))
    assert residual[0] > 1e-3 and residual[1] < 1e-8
    np.testing.assert_allclose(rate[-4:], [shock / 1.5, 0, 0, shock / 1.5], atol=1e-8)
    assert way[-2] == 1
