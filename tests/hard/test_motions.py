"""Scenes 1 to 16, 21 and 22: motions that are hard to compute, and their derivatives.

Nearly all are one program, called with other numbers.
"""

import diffrax
import numpy as np
import pytest

import fdof_jax as fj
from hard import scenes as hard

TWO_LINKS = fj.scenes.two_link_circle()
HANGING = np.array([-np.pi / 2, 0, 0])
REST = hard.free(hard.arm(), HANGING, np.linspace(0, 10, 21), q=HANGING)
SWING = hard.free(hard.arm(), HANGING + [0.1, 0, 0], np.linspace(0, 1e3, 21))


def two_link_circle():
    """The reference is under its efforts; this is under the controller."""
    scene, (arm, start, forces, _) = hard.load("two-link-circle"), TWO_LINKS
    np.testing.assert_allclose(start.q, scene.state0.q, atol=1e-15)
    return scene._replace(linkage=arm, state0=start, forces=forces)


# A scene, by default that of the files, and its largest error [m or rad], and `last` at
# its end; its largest change of energy, `drift`; its most steps, five times those of
# heyoka; `lost`, the least relative error of its accelerations by rounding.
MOTIONS = {
    # Without moments of inertia nothing keeps the mass matrix from being singular.
    "fig5": dict(tolerance=1e-10, error=1e-6, drift=1e-8),
    # An error of 1e-16 at the start becomes 1e-7 or more at the end.
    "fig5 to 15 s": dict(
        scene=lambda: hard.fig5([0, *np.linspace(5.5, 15, 20)]),
        tolerance=1e-13, error=1e-6,
    ),
    # Condition numbers of 2e5 to 2e11: rounding errors of the rates exceed the
    # tolerance by up to 1e7, and no step is short enough to meet it.
    "heavy-tip-1e3": dict(error=1e-8, steps=5 * 1130, lost=1e3 * 2.0**-52),
    "heavy-tip-1e6": dict(error=1e-6, steps=5 * 2503, lost=1e6 * 2.0**-52),
    "heavy-tip-1e9": dict(error=1e-3, steps=5 * 3837, lost=1e9 * 2.0**-52),
    # One fast light body must not disturb two slow heavy ones.
    "light-tip-1e-6": dict(error=1e-6),
    "light-tip-1e-9": dict(error=1e-8),
    # Singular in the paper's form, and joints that do the same.
    "turn-slide-RPR": dict(error=1e-9),
    "parallel-axes-PPR": dict(error=1e-9),
    "parallel-axes-RPP": dict(error=1e-9),
    # Rounding of the centrifugal forces moves the slides by 7e-6 m.
    "near-parallel-PPR": dict(error=1e-8, steps=5 * 21),
    "near-parallel-RPP": dict(error=1e-6, steps=5 * 43),
    # The lever arm of all that hangs on the slide changes its sign.
    "driven-through-0-RPR": dict(error=1e-9),
    # Coriolis terms of 1e6 cancel. Errors of the fast tip on slow links grow 9.5e5
    # times, and the tolerances are relative to 1000 rad/s.
    "spin": dict(error=1e-6, drift=1e-8, steps=100_000),
    "spin-of-the-tip": dict(tolerance=1e-14, error=1e-6, drift=1e-8, steps=100_000),
    # Every term is 0, apart from the rounding of pi/2.
    "at rest": dict(scene=lambda: REST, error=1e-12),
    # Errors of each step add up, and the time itself is rounded.
    "a small swing for 1000 s": dict(scene=lambda: SWING, drift=1e-10),
    # Chains of two joints at the default tolerance: ten times the errors that were
    # found. The double pendulum multiplies errors by 5000.
    "double-pendulum": dict(tolerance=None, error=2e-8),
    "cart-pole": dict(tolerance=None, error=5e-10, last=3e-11),
    "two-link circle": dict(
        scene=two_link_circle, tolerance=None, error=2e-10, last=1e-12
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::UserWarning")  # of parallel slides
@pytest.mark.parametrize("name", MOTIONS)
def test_motions_equal_the_reference(name):
    laws = dict(scene=lambda: hard.load(name), tolerance=1e-12) | MOTIONS[name]
    scene = laws["scene"]()
    tolerance = laws["tolerance"]
    motion = hard.simulate(scene, tolerance and hard.controller(tolerance))
    if "error" in laws:
        assert hard.error(motion, scene) <= laws["error"]
    if "last" in laws:
        assert np.abs(motion.q[-1] - scene.q[-1]).max() <= laws["last"]
    if "drift" in laws:
        assert hard.drift(scene.linkage, motion.q, motion.qd) <= laws["drift"]
    assert motion.stats["num_steps"] <= laws.get("steps", np.inf)
    if "lost" in laws:
        assert laws["lost"] < motion.stats["accuracy"] < 30 * laws["lost"]


def test_rounding_does_not_shorten_steps():
    """With a tip of a million tonnes it determines the error that is estimated."""
    scene = hard.load("heavy-tip-1e9")
    motion = hard.simulate(scene, hard.DEFAULT, rtol=1e-13, atol=1e-13)
    assert hard.error(motion, scene) <= 1e-3
    assert motion.stats["num_steps"] < 10_000


def test_energy_of_chaos_to_60_s():
    """The states are wrong after 25 s, but their energy is not."""
    scene = hard.fig5(np.linspace(0, 60, 21))
    motion = hard.simulate(scene, hard.DEFAULT)
    assert hard.drift(scene.linkage, motion.q, motion.qd) <= 1e-6


def test_automatic_first_step():
    """The start has only powers 2, 6, 10.. of time; one derivative is not enough."""
    scene = hard.fig5([0, 1.5, 2])
    assert hard.error(hard.simulate(scene, dt0=None), scene) <= 1e-8


def test_another_solver_is_as_exact_and_is_stopped_too():
    scene = hard.load("heavy-tip-1e6")
    by_another = dict(solver=diffrax.Dopri8(), throw=False)
    motion = hard.simulate(scene, **by_another)
    assert hard.error(motion, scene) <= 1e-6
    assert motion.stats["num_steps"] <= 100_000
    heavy = scene._replace(linkage=hard.arm(mass=[1, 1, 1e12]))
    # Accelerations that are no number, which diffrax itself would reject for ever.
    burst = scene._replace(forces=(fj.JointEffort(np.full(3, 1e308)), scene.forces[1]))
    for scene, outcome in ((heavy, "ill-conditioned"), (burst, "not finite")):
        for options in (by_another, dict(throw=False)):
            motion = hard.simulate(scene, **options)
            assert motion.outcome == outcome
            assert motion.stats["num_steps"] < 200


def test_running_out_of_steps_is_told():
    """The state that was reached looks like any other."""
    scene = hard.free(hard.arm(), hard.START.q, np.linspace(0, 5, 26))
    short = hard.simulate(scene, max_steps=50, throw=False)
    assert short.outcome == "out of steps"
    reached = short.stats["time_reached"]
    assert 0 < reached < 5
    finite = np.isfinite(short.q).all(axis=1) & np.isfinite(short.qd).all(axis=1)
    np.testing.assert_array_equal(finite, scene.ts <= reached)
    whole = hard.simulate(scene)
    np.testing.assert_allclose(short.q[finite], whole.q[finite], atol=1e-8)


# Chaos makes errors grow by 2.4e4 as derivatives do, so that much of a tolerance of
# 1e-11 is left undetermined.
@pytest.mark.parametrize("name, argument, bound", [
    ("fig5", "q0", 1e-11 * 2.4e4),
    ("fig5", "mass", 1e-5),
    ("fig5", "length", 1e-5),
    ("driven-through-0-RPR", "q0", 1e-6),
])  # fmt: skip
def test_derivatives_equal_the_reference(name, argument, bound):
    found = dict(zip(("q0", "mass", "length"), hard.slopes(hard.load(name))))
    exact = hard.REFERENCE[name][f"dq_d{argument}"]
    assert hard.largest_error(found[argument], exact) <= bound


def test_derivatives_at_rest():
    """Not even a loose tolerance passes over an oscillation that does not move."""
    found, *_ = hard.slopes(REST, tolerance=1e-8)
    assert hard.largest_error(found, hard.linear_motion(10.0)) <= 1e-6


def test_derivatives_of_a_heavy_tip():
    """Over 0.1 s in which nothing grows, against differences over 1e-3 rad."""
    scene = hard.load("heavy-tip-1e6")._replace(ts=np.linspace(0, 0.1, 21))

    def difference(h):
        starts = (fj.State(scene.state0.q + s, np.zeros(3)) for s in (h, -h))
        above, below = (hard.simulate(scene._replace(state0=s)).q[-1] for s in starts)
        return (above - below) / (2 * h)

    slope = hard.slopes(scene)[0].sum(axis=1)
    exact = (4 * difference(5e-4) - difference(1e-3)) / 3
    assert hard.largest_error(slope, exact) <= 1e-5


@pytest.mark.parametrize("topology", ["RRR", "RPR"])
def test_sizes_and_units_do_not_matter(topology):
    """An absolute tolerance of 1e-11 m is 1e-8 of an arm of 1 mm, and near rounding for
    one of 1 km. The defaults serve both."""
    ts = np.linspace(0, 5, 11)
    motion = lambda arm, q, ts: hard.simulate(hard.free(arm, q, ts), hard.DEFAULT)
    usual = motion(hard.arm(topology), hard.START.q, ts)
    unit = np.array([0.0 if joint == "R" else 1.0 for joint in topology])
    for size, mass, gravity in ((1e-3, 1e-3, 9.81), (1e3, 1e9, 9.81), (1e3, 1e3, 9810)):
        links = {key: np.multiply(hard.USUAL[key], size) for key in ("length", "com")}
        links |= dict(mass=[mass] * 3, inertia=[mass * size**2 / 12] * 3)
        arm, time = hard.arm(topology, gravity=gravity, **links), size * 9.81 / gravity
        found = motion(arm, hard.START.q * size**unit, ts * time**0.5)
        assert np.abs(found.q / size ** unit[None] - usual.q).max() <= 5e-10, size
        steps = found.stats["num_steps"] / usual.stats["num_steps"]
        assert 0.5 < steps < 2, size


@pytest.mark.parametrize("turns", [[1e8, 0, 0], [1e6, 1e6, 1e6]])
def test_turns_do_not_matter(turns):
    """The result keeps the turns, so that a position is rounded: by up to 6e-8 rad."""
    offset = hard.START.q + 2 * np.pi * np.array(turns)
    kept = hard.without_turns(offset)
    ts = np.linspace(0, 5, 11)
    scenes = (hard.free(hard.arm(), q, ts) for q in (kept, offset))
    plain, far = (hard.simulate(scene, hard.DEFAULT) for scene in scenes)
    error = np.abs((far.q - offset[None]) - (plain.q - kept[None])).max(axis=0)
    assert (error <= np.maximum(1e-9, np.spacing(np.abs(offset)))).all()
    assert np.abs(far.qd - plain.qd).max() <= 1e-9 * np.abs(plain.qd).max()
    steps = int(plain.stats["num_steps"])
    assert abs(int(far.stats["num_steps"]) - steps) <= 0.01 * steps
