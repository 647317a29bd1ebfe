"""Force elements in pictures are where they act; pixels are not compared."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from elements import ELBOW, HOOK, TIP, WITH_INERTIA, arm
from PIL import Image
from test_drawing import lines, named, swinging, tidy

import fdof_jax as fj
from fdof_jax import drawing

__all__ = ["tidy"]  # the fixture holds here too
ARM, Q = arm("RPR"), np.array([0.3, 0.2, 0.5])


def drawn(*forces):
    return lines(drawing.draw_linkage(ARM, Q, forces=forces))


def strokes(line):
    """Points of each stroke (point, 2); NaN lifts the pen."""
    xy = line.get_xydata()
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    return [part[np.isfinite(part[:, 0])] for part in np.split(xy, gaps)]


def place(point):
    return np.asarray(point.position(ARM, Q))


@pytest.mark.parametrize(
    "kind, values",
    [
        ("spring", dict(stiffness=3.0)),
        ("damper", dict(damping=3.0)),
        ("cable", dict(stiffness=3.0, rest_length=0.2, one_sided="cable")),
        ("cable", dict(stiffness=3.0, rest_length=9.0, one_sided="cable")),
    ],
)
def test_what_is_between_points_joins_them(kind, values):
    xy = drawn(fj.SpringDamper(HOOK, ELBOW, **values))[f"{kind} 0"].get_xydata()
    np.testing.assert_allclose(xy[0], place(HOOK), atol=1e-12)
    np.testing.assert_allclose(xy[-1], place(ELBOW), atol=1e-12)


def test_a_slack_cable_hangs_and_a_bumper_ends_at_its_rest_length():
    ends = np.stack([place(HOOK), place(TIP)])
    for rest, slack in ((0.5, False), (4.0, True)):
        rope = fj.SpringDamper(
            HOOK, TIP, stiffness=1, rest_length=rest, one_sided="cable"
        )
        low = drawn(rope)["cable 0"].get_ydata().min()
        assert (low < ends[:, 1].min() - 0.1) == slack
    bumper = fj.SpringDamper(
        HOOK, TIP, stiffness=1, rest_length=0.5, one_sided="bumper"
    )
    _, plate, *_ = strokes(drawn(bumper)["bumper 0"])
    plate = plate.mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(plate - ends[0]), 0.5, atol=1e-12)


def test_brackets_and_ground_hold_points_beside_links():
    arm = fj.scenes.fig5().linkage  # links of 1 m along x
    off, on = fj.Point(1, 0.5, 0.3), fj.Point(2, 0.5)
    nail = fj.Point(0, 0.5, -1.0)
    ax = drawing.draw_linkage(
        arm, np.zeros(3),
        forces=(fj.forces.Tension(off, on, 1.0), fj.forces.Tension(nail, on, 1.0)),
    )  # fmt: skip
    held, nailed = (strokes(lines(ax)[f"tension {k}"]) for k in (0, 1))
    np.testing.assert_allclose(held[0], [[0.5, 0.3], [1.5, 0]], atol=1e-12)
    np.testing.assert_allclose(held[1], [[0.5, 0], [0.5, 0.3]], atol=1e-12)
    assert len(held) == 2 and len(nailed) == 5
    np.testing.assert_allclose(nailed[1].mean(axis=0), [0.5, -1], atol=1e-12)


def test_a_cylinder_keeps_its_length_in_motion():
    solution = swinging()
    forces = (fj.JointDamper(1.0), WITH_INERTIA["actuator"])
    animation = drawing.animate(ARM, solution, forces=forces, max_frames=3)
    (ax,) = plt.gcf().axes
    lengths = []
    for frame in range(3):
        animation._func(frame)  # type: ignore[attr-defined]
        xy = lines(ax)["cylinder 1"].get_xydata()
        np.testing.assert_allclose(
            xy[-1], ELBOW.position(ARM, solution.q[50 * frame]), atol=1e-12
        )
        lengths.append(np.linalg.norm(xy[2] - xy[1]))
    assert np.ptp(lengths) < 1e-12
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_arrows_are_along_the_forces_and_as_long_as_they_are_large():
    force = lambda t: jnp.array([3.0, 4.0 + t])
    found = drawn(
        fj.Wrench(TIP, force), fj.Wrench(ELBOW, [0.0, -1.0]), fj.Wrench(TIP, moment=2.0)
    )
    first, second = (found[f"wrench {k}"].get_xydata()[:2] for k in (0, 1))
    np.testing.assert_allclose(first[0], place(TIP), atol=1e-12)
    long, short = np.diff(first, axis=0)[0], np.diff(second, axis=0)[0]
    np.testing.assert_allclose(long / np.linalg.norm(long), [0.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(short, [0, -np.linalg.norm(long) / 5], atol=1e-12)
    around = found["wrench 2"].get_xydata()[:41] - place(TIP)
    np.testing.assert_allclose(np.ptp(np.hypot(*around.T)), 0, atol=1e-12)


def test_the_bars_of_stops_are_where_joints_touch_them():
    ends = [[0.1, -0.4, -np.inf], [1.2, 0.2, np.inf]]
    parts = drawn(fj.forces.JointStops(*ends))
    x, y = parts["stops 0"].get_data()
    pin, slide = (parts[name].get_xydata()[0] for name in ("pin 1", "slider 2"))
    bars = [np.array([x[:2], y[:2]]), np.array([x[3:5], y[3:5]])]
    for bar, turn in zip(bars, (0.1, 1.2)):
        middle = bar.mean(axis=1) - pin
        angle = float(ARM.base_angle) + turn
        np.testing.assert_allclose(np.arctan2(*middle[::-1]), angle, atol=1e-12)
    foot = np.mean([x[-2:], y[-2:]], axis=1)  # the upper stop, now touched
    np.testing.assert_allclose(foot, slide, atol=1e-12)


def test_the_path_of_a_controller_is_drawn_once_around():
    circle = fj.CircleTask()
    line = fj.references.Line([-4, 2], [-3, 2])
    there = fj.references.Travel(5.0)  # begins after the configuration drawn
    laps = fj.references.Laps(2.0)
    around = fj.TipTask(fj.references.Ellipse([-4, 2], [0.5, 0.2]), laps)
    gains = dict(kp=1.0, kd=1.0, limit=1.0)
    found = drawn(
        fj.PDController(**gains, reference=circle),
        fj.control.FirstOrderLag(
            fj.PDController(**gains, reference=fj.TipTask(line, there)), 0.1
        ),
        fj.control.PIDController(**gains, ki=1.0, reference=around),
        fj.PDController(**gains, reference=lambda t, linkage: (Q, 0 * Q)),
    )
    commanded = [found[f"commanded {k}"].get_xydata() for k in (0, 1, 2)]
    assert "commanded 3" not in found
    turn = np.abs((commanded[0] - np.asarray(circle.center)) @ [1, 1j])
    np.testing.assert_allclose(turn, circle.radius, rtol=1e-12)
    np.testing.assert_allclose(commanded[0][0], commanded[0][-1], atol=1e-12)
    np.testing.assert_allclose(commanded[1][[0, -1]], [[-4, 2], [-3, 2]], atol=1e-12)
    np.testing.assert_allclose(np.ptp(commanded[2], axis=0), [1, 0.4], rtol=1e-3)


def test_what_has_no_place_is_not_drawn_and_points_elsewhere_are_refused():
    ax = drawing.draw_linkage(ARM, Q, forces=(fj.JointDamper(1.0), lambda *_: 0))
    assert "damper 0" not in lines(ax)
    with pytest.raises(ValueError, match="link: expected 0"):
        drawing.draw_linkage(ARM, Q, forces=(fj.Wrench(fj.Point(5), [1, 0]),))
    with pytest.raises(ValueError, match="^forces: expected"):
        drawing.animate(ARM, swinging(), forces=fj.JointDamper(1.0))  # type: ignore


def test_a_gif_draws_what_moves_over_what_stands(tmp_path, capsys):
    solution = swinging()
    animation = drawing.animate(ARM, solution, until=0.4, max_frames=3)
    path = tmp_path / "motion.gif"
    animation.save(path, dpi=50)
    # One bar, as this is no terminal.
    assert capsys.readouterr().err == f"\rmotion.gif [{30 * '#'}]\n"
    animation.save(tmp_path / "whole.gif", dpi=50, writer="pillow")
    assert plt.gca().get_title() == "t = 0.40 s"
    with Image.open(path) as quick, Image.open(tmp_path / "whole.gif") as whole:
        assert quick.n_frames == whole.n_frames == 3  # type: ignore[attr-defined]
        for frame in range(3):
            quick.seek(frame)
            whole.seek(frame)
            apart = np.asarray(quick.convert("L"), float) - np.asarray(
                whole.convert("L")
            )
            assert np.abs(apart).mean() < 4
    with pytest.raises(ValueError, match="^until: expected"):
        drawing.animate(ARM, solution, until=-1)


def test_a_legend_shows_each_kind_by_its_symbol():
    ax = drawing.draw_linkage(ARM, Q, forces=(fj.SpringDamper(HOOK, TIP, stiffness=1),))
    handles, labels = ax.get_legend_handles_labels()
    assert {"spring", "pin", "slide", "tip", "ground", "link 1"} <= set(labels)
    assert not named(ax, "spring 0")[0].get_label().startswith("spring")
