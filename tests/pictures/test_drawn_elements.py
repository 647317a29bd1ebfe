"""Force elements in pictures are where they act; pixels are not compared."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from elements import ELBOW, HOOK, TIP, WITH_INERTIA, arm
from figures import lines, named, swinging, tidy as tidy

import fdof_jax as fj
from fdof_jax import drawing

ARM, Q = arm("RPR"), np.array([0.3, 0.2, 0.5])
HELD = dict(stiffness=3.0)


def drawn(*forces):
    return lines(drawing.draw_linkage(ARM, Q, forces=forces))


def strokes(line):
    """Points of each stroke (point, 2); NaN lifts the pen."""
    xy = line.get_xydata()
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    return [part[np.isfinite(part[:, 0])] for part in np.split(xy, gaps)]


def place(point):
    return np.asarray(point.position(ARM, Q))


def close(points, expected):
    np.testing.assert_allclose(points, expected, atol=1e-12)


def test_what_is_between_points_joins_them():
    cable = HELD | dict(one_sided="cable")
    for kind, values, hangs in (
        ("spring", HELD, False),
        ("damper", dict(damping=3.0), False),
        ("cable", dict(rest_length=0.5, **cable), False),
        ("cable", dict(rest_length=4.0, **cable), True),
    ):
        xy = drawn(fj.SpringDamper(HOOK, TIP, **values))[f"{kind} 0"].get_xydata()
        ends = np.stack([place(HOOK), place(TIP)])
        close(xy[0], ends[0])
        assert np.isclose(xy, ends[1]).all(axis=1).any()
        assert (np.nanmin(xy[:, 1]) < ends[:, 1].min() - 0.1) == hangs
    bumper = fj.SpringDamper(HOOK, TIP, rest_length=0.5, one_sided="bumper", **HELD)
    _, plate, *_ = strokes(drawn(bumper)["bumper 0"])
    close(np.linalg.norm(plate.mean(axis=0) - place(HOOK)), 0.5)  # its rest length


def test_brackets_and_ground_hold_points_beside_links():
    arm = fj.scenes.fig5().linkage  # links of 1 m along x
    off, on, nail = fj.Point(1, 0.5, 0.3), fj.Point(2, 0.5), fj.Point(0, 0.5, -1.0)
    ropes = [fj.forces.Tension(point, on, 1.0) for point in (off, nail)]
    ax = drawing.draw_linkage(arm, np.zeros(3), forces=(*ropes,))
    held, nailed = (strokes(lines(ax)[f"tension {k}"]) for k in (0, 1))
    close(held, [[[0.5, 0.3], [1.5, 0]], [[0.5, 0], [0.5, 0.3]]])
    assert len(nailed) == 5
    close(nailed[1].mean(axis=0), [0.5, -1])


def test_a_cylinder_keeps_its_length_in_motion():
    solution = swinging()
    forces = (fj.JointDamper(1.0), WITH_INERTIA["actuator"])
    animation = drawing.animate(ARM, solution, forces=forces, max_frames=3)
    (ax,) = plt.gcf().axes
    lengths = []
    for frame in range(3):
        animation._func(frame)  # type: ignore[attr-defined]
        xy = lines(ax)["cylinder 1"].get_xydata()
        close(xy[-1], ELBOW.position(ARM, solution.q[50 * frame]))
        lengths.append(np.linalg.norm(xy[2] - xy[1]))
    assert np.ptp(lengths) < 1e-12
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_arrows_are_along_the_forces_and_as_long_as_they_are_large():
    force = lambda t: jnp.array([3.0, 4.0 + t])
    wrenches = drawn(
        fj.Wrench(TIP, force), fj.Wrench(ELBOW, [0.0, -1.0]), fj.Wrench(TIP, moment=2.0)
    )
    first, second, around = (wrenches[f"wrench {k}"].get_xydata() for k in range(3))
    close(first[0], place(TIP))
    long, short = first[1] - first[0], second[1] - second[0]
    close(long / np.linalg.norm(long), [0.6, 0.8])
    assert 0.1 < np.linalg.norm(long) < 1.0  # the arm is 1.7 m long
    close(short, [0, -np.linalg.norm(long) / 5])
    around = around[:41] - place(TIP)
    close(np.ptp(np.hypot(*around.T)), 0)
    assert (
        around[0] @ [[0, 1], [-1, 0]] @ around[1] > 0
    )  # a positive moment turns to the left


def test_the_bars_of_stops_are_where_joints_touch_them():
    ends = [[0.1, -0.4, -np.inf], [1.2, 0.2, np.inf]]
    parts = drawn(fj.forces.JointStops(*ends))
    low, high, _, across = strokes(parts["stops 0"])
    for bar, turn in ((low, 0.1), (high, 1.2)):
        x, y = bar.mean(axis=0) - parts["pin 1"].get_xydata()[0]
        close(np.arctan2(y, x), float(ARM.base_angle) + turn)
    touch = parts["slider 2"].get_xydata()[0]  # the upper end of the slide
    close(across[-2:].mean(axis=0), touch)


@pytest.mark.slow
def test_the_path_of_a_controller_is_drawn_once_around():
    circle = fj.CircleTask()
    line = fj.references.Line([-4, 2], [-3, 2])
    there = fj.references.Travel(5.0)  # begins after the configuration drawn
    laps = fj.references.Laps(2.0)
    around = fj.TipTask(fj.references.Ellipse([-4, 2], [0.5, 0.2]), laps)
    pd = lambda reference: fj.PDController(1.0, 1.0, 1.0, reference)
    parts = drawn(
        pd(circle),
        fj.control.FirstOrderLag(pd(fj.TipTask(line, there)), 0.1),
        fj.control.PIDController(1.0, 1.0, 1.0, 1.0, around),
        pd(lambda t, linkage: (Q, 0 * Q)),
    )
    first, second, third = (parts[f"commanded {k}"].get_xydata() for k in range(3))
    assert "commanded 3" not in parts
    turn = np.abs((first - np.asarray(circle.center)) @ [1, 1j])
    np.testing.assert_allclose(turn, circle.radius, rtol=1e-12)
    close(first[0], first[-1])
    close(second[[0, -1]], [[-4, 2], [-3, 2]])
    np.testing.assert_allclose(np.ptp(third, axis=0), [1, 0.4], rtol=1e-3)


def test_a_payload_is_drawn_while_it_is_taken():
    later, now = (fj.forces.Payload(TIP, 0.4, begin=t) for t in (0.5, 0.0))
    parts = drawn(later, now, fj.forces.Payload(TIP, 0.4))
    assert "payload 0" not in parts
    for k in (1, 2):
        xy = parts[f"payload {k}"].get_xydata()
        close((xy.min(axis=0) + xy.max(axis=0)) / 2, place(TIP))
    animation = drawing.animate(ARM, swinging(), forces=(later,), max_frames=3)
    (ax,) = plt.gcf().axes
    there = []
    for frame in range(3):
        animation._func(frame)  # type: ignore[attr-defined]
        there.append(np.isfinite(lines(ax)["payload 0"].get_xydata()).all())
    assert there == [False, True, True]
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_what_has_no_place_is_not_drawn_and_points_elsewhere_are_refused():
    hidden = fj.JointDamper(1.0), lambda *_: 0, fj.forces.Brake(1)
    assert drawn(*hidden, fj.forces.JointFriction(1.0)).keys() == drawn().keys()
    with pytest.raises(ValueError, match="link: expected 0"):
        drawn(fj.Wrench(fj.Point(5), [1, 0]))


def test_a_legend_shows_each_kind_by_its_symbol():
    ax = drawing.draw_linkage(ARM, Q, forces=(fj.SpringDamper(HOOK, TIP, **HELD),))
    _, labels = ax.get_legend_handles_labels()
    assert {"spring", "slide", "tip", "link 1"} <= set(labels)
    assert not named(ax, "spring 0")[0].get_label().startswith("spring")
