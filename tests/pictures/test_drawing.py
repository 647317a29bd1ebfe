"""Pictures show arms, what acts on them and motions in their place, not pixels."""

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from elements import ELBOW, HOOK, TIP, WITH_INERTIA, arm
from figures import (
    LINKAGE,
    Q,
    labels,
    lines,
    made_up,
    make_linkage,
    named,
    same,
    swinging,
    tidy as tidy,
)
from matplotlib.colors import to_rgb
from PIL import Image
from test_guides import DOCS, run

import fdof_jax as fj
from fdof_jax import drawing

ARM, AT = arm("RPR"), np.array([0.3, 0.2, 0.5])


def close(points, expected):
    np.testing.assert_allclose(points, expected, atol=1e-12)


@pytest.mark.slow
def test_examples_of_the_guide_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(DOCS / "pictures.md")
    for name in ("motion.html", "gains.html", "arm.png", "arm.gif", "arms.gif"):
        assert (tmp_path / name).stat().st_size > 1000
    np.testing.assert_array_equal(names["table"]["P2 [m]"], names["motion"].q[:, 1])
    assert names["data"].sizes["time"] == 2001


# Arms


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_linkage_is_drawn_where_kinematics_puts_it(topology):
    linkage = make_linkage(topology)
    ax = drawing.draw_linkage(linkage, Q)
    drawn, starts = lines(ax), fj.joint_positions(linkage, Q)
    ends = [*starts, fj.tip_position(linkage, Q)]
    for k, kind in enumerate(topology, start=1):
        name, other = ("pin", "slider") if kind == "R" else ("slider", "pin")
        same(drawn[f"{name} {k}"], [starts[k - 1]])
        assert f"{other} {k}" not in drawn and (f"rail {k}" in drawn) == (kind == "P")
        link = drawn[f"link {k}"].get_xydata()
        close(link[0], starts[k - 1])
        close(np.linalg.norm(link[1] - link[0]), linkage.length[k])
        # The fixed offset belongs to the link, the slide to the rail.
        rail = drawn.get(f"rail {k + 1}", drawn[f"link {k}"])
        close(rail.get_xydata()[-1], ends[k])
        if kind == "P":  # the carriage stands across
            turn = drawn[f"slider {k}"]._marker.get_user_transform().get_matrix()
            along = np.diff(drawn[f"rail {k}"].get_xydata(), axis=0)[0]
            close(turn[0, 0] * along[1], turn[1, 0] * along[0])
        close(drawn[f"mass {k}"].get_xydata()[-1], fj.mass_centers(linkage, Q)[k - 1])
    same(drawn["tip 3"], ends[-1:])
    # What lies on something else hides nothing: mass centres under the tip and pins.
    order = [line.get_gid().split()[0] for line in ax.lines if line.get_gid()]
    assert order.index("mass") < order.index("tip") < len(order) - 3


def test_options_of_a_linkage_and_what_has_no_place():
    ax = plt.subplots()[1]
    ax.scatter([5], [9])
    style = dict(color="red", alpha=0.5, mass_centers=False)
    drawn = lines(drawing.draw_linkage(make_linkage("RRP"), Q, ax, **style))
    assert ax.get_xlim()[1] > 5 and ax.get_ylim()[1] > 9  # what was there stays in view
    assert ax.get_aspect() == 1 and ax.get_xlabel() == "x [m]" and "mass 1" not in drawn
    assert (drawn["link 1"].get_color(), drawn["link 1"].get_alpha()) == ("red", 0.5)
    hidden = fj.JointDamper(1.0), lambda *_: 0, fj.forces.Brake(1)
    assert drawn_with(*hidden).keys() == drawn_with().keys()
    with pytest.raises(ValueError, match="link: expected 0"):
        drawn_with(fj.Wrench(fj.Point(5), [1, 0]))


def test_chrono_cyclograph_takes_the_nearest_samples():
    linkage, solution = make_linkage("RPR"), swinging()
    ax = drawing.chrono_cyclograph(linkage, solution, every=0.1, until=0.3)
    last_links, samples = named(ax, "link 3"), [0, 10, 20, 30]
    for line, sample in zip(last_links, samples, strict=True):
        close(line.get_xydata()[-1], fj.tip_position(linkage, solution.q[sample]))
    brightness = [sum(to_rgb(line.get_color())) for line in last_links]
    assert brightness == sorted(brightness, reverse=True)
    assert len(named(ax, "tip 3")) == 1  # only the last configuration is whole
    path = lines(ax)["tip path"]
    assert len(path.get_xydata()) == 31 and path.get_markevery() == samples
    assert set(labels(ax)) == {"link 1", "link 2", "link 3", "slide", "tip"}
    # What a failed solve did not reach is left out.
    failed = eqx.tree_at(lambda s: s.q, solution, solution.q.at[51:].set(jnp.nan))
    for motion, until, count in (
        (solution, 5.0, 11),
        (solution, 0, 1),
        (failed, None, 6),
    ):
        ax = drawing.chrono_cyclograph(LINKAGE, motion, until=until)
        assert len(named(ax, "link 3")) == count


def test_times_and_labels_have_a_place_of_their_own():
    linkage, ts = fj.scenes.fig5().linkage, np.linspace(0, 1, 11)
    motion = made_up(ts, -0.1 - 3.0 * ts[:, None] * [1, 0, 0])
    ax = drawing.chrono_cyclograph(linkage, motion)
    ax.figure.draw_without_rendering()
    assert ax.xaxis.label.get_window_extent().y0 >= 0
    texts = [text for text in ax.texts if text.get_gid() == "time"]
    assert [text.get_text() for text in texts][::5] == ["1 s", "0 s"]
    drawn = [line.get_path().transformed(ax.transData) for line in ax.lines]
    for text in texts:
        box = text.get_window_extent()
        assert not any(path.intersects_bbox(box, filled=False) for path in drawn)
        k = round(10 * float(text.get_text()[:-2]))
        close(text.xy, fj.tip_position(linkage, motion.q[k]))
    # The limits that equal scales need have longer ticks than those before.
    moved = made_up(ts, Q + ts[:, None] * [0.3, -0.8, 0.7])
    animation = drawing.animate(LINKAGE, moved)
    plt.gcf().canvas.draw()
    assert plt.gcf().axes[0].yaxis.label.get_window_extent().x0 >= 0
    del animation  # which warns unless it was drawn


# Elements


def drawn_with(*forces, arm=ARM, at=AT):
    return lines(drawing.draw_linkage(arm, at, forces=forces))


def strokes(line):
    """Points of each stroke (point, 2); NaN lifts the pen."""
    xy = line.get_xydata()
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    return [part[np.isfinite(part[:, 0])] for part in np.split(xy, gaps)]


def place(point):
    return np.asarray(point.position(ARM, AT))


def test_what_is_between_points_joins_them():
    """Brackets and ground hold points beside links."""
    joins = lambda **values: fj.SpringDamper(HOOK, TIP, **values)
    cable, ends = dict(stiffness=3.0, one_sided="cable"), [place(HOOK), place(TIP)]
    for kind, part, hangs in (
        ("spring", joins(stiffness=3.0), False), ("damper", joins(damping=3.0), False),
        ("cable", joins(rest_length=0.5, **cable), False),
        ("cable", joins(rest_length=4.0, **cable), True),
    ):  # fmt: skip
        xy = drawn_with(part)[f"{kind} 0"].get_xydata()
        close(xy[0], ends[0])
        assert np.isclose(xy, ends[1]).all(axis=1).any()
        assert (np.nanmin(xy[:, 1]) < np.min(ends, axis=0)[1] - 0.1) == hangs
    bumper = joins(stiffness=3.0, rest_length=0.5, one_sided="bumper")
    _, plate, *_ = strokes(drawn_with(bumper)["bumper 0"])
    close(np.linalg.norm(plate.mean(axis=0) - place(HOOK)), 0.5)  # its rest length
    links = fj.scenes.fig5().linkage  # of 1 m along x
    off, on, nail = fj.Point(1, 0.5, 0.3), fj.Point(2, 0.5), fj.Point(0, 0.5, -1.0)
    ropes = tuple(fj.forces.Tension(point, on, 1.0) for point in (off, nail))
    drawn = drawn_with(*ropes, arm=links, at=np.zeros(3))
    close(strokes(drawn["tension 0"]), [[[0.5, 0.3], [1.5, 0]], [[0.5, 0], [0.5, 0.3]]])
    close(strokes(drawn["tension 1"])[1].mean(axis=0), [0.5, -1])


def test_arrows_are_along_the_forces_and_as_long_as_they_are_large():
    force = lambda t: jnp.array([3.0, 4.0 + t])
    pushes = drawn_with(
        fj.Wrench(TIP, force), fj.Wrench(ELBOW, [0.0, -1.0]), fj.Wrench(TIP, moment=2.0)
    )
    first, second, around = (pushes[f"wrench {k}"].get_xydata() for k in range(3))
    close(first[0], place(TIP))
    long, short = first[1] - first[0], second[1] - second[0]
    close(long / np.linalg.norm(long), [0.6, 0.8])
    assert 0.1 < np.linalg.norm(long) < 1.0  # the arm is 1.7 m long
    close(short, [0, -np.linalg.norm(long) / 5])
    around = around[:41] - place(TIP)
    close(np.ptp(np.hypot(*around.T)), 0)
    assert np.cross([*around[0], 0], [*around[1], 0])[2] > 0  # turns to the left


def test_the_bars_of_stops_are_where_joints_touch_them():
    parts = drawn_with(fj.forces.JointStops([0.1, -0.4, -np.inf], [1.2, 0.2, np.inf]))
    low, high, _, across = strokes(parts["stops 0"])
    for bar, turn in ((low, 0.1), (high, 1.2)):
        x, y = bar.mean(axis=0) - parts["pin 1"].get_xydata()[0]
        close(np.arctan2(y, x), float(ARM.base_angle) + turn)
    touch = parts["slider 2"].get_xydata()[0]  # the upper end of the slide
    close(across[-2:].mean(axis=0), touch)


@pytest.mark.slow
def test_the_path_of_a_controller_is_drawn_once_around():
    pd = lambda reference: fj.PDController(1.0, 1.0, 1.0, reference)
    there = fj.references.Travel(5.0)  # begins after the configuration drawn
    line = fj.TipTask(fj.references.Line([-4, 2], [-3, 2]), there)
    circle, plain = fj.CircleTask(), pd(lambda t, linkage: (AT, 0 * AT))
    parts = drawn_with(pd(circle), fj.control.FirstOrderLag(pd(line), 0.1), plain)
    first, second = (parts[f"commanded {k}"].get_xydata() for k in range(2))
    assert "commanded 2" not in parts
    turn = np.abs((first - np.asarray(circle.center)) @ [1, 1j])
    np.testing.assert_allclose(turn, circle.radius, rtol=1e-12)
    close(first[0], first[-1])
    close(second[[0, -1]], [[-4, 2], [-3, 2]])


def test_elements_move_with_the_arm_and_a_payload_comes():
    """A cylinder keeps its length."""
    later, now = (fj.forces.Payload(TIP, 0.4, begin=t) for t in (0.5, 0.0))
    parts, solution = drawn_with(later, now), swinging()
    assert "payload 0" not in parts
    xy = parts["payload 1"].get_xydata()
    close((xy.min(axis=0) + xy.max(axis=0)) / 2, place(TIP))
    forces = later, WITH_INERTIA["actuator"]
    animation = drawing.animate(ARM, solution, forces=forces, max_frames=3)
    (ax,), lengths, there = plt.gcf().axes, [], []
    for frame in range(3):
        animation._func(frame)  # type: ignore[attr-defined]
        xy = lines(ax)["cylinder 1"].get_xydata()
        close(xy[-1], ELBOW.position(ARM, solution.q[50 * frame]))
        lengths.append(np.linalg.norm(xy[2] - xy[1]))
        there.append(np.isfinite(lines(ax)["payload 0"].get_xydata()).all())
    assert np.ptp(lengths) < 1e-12 and there == [False, True, True]
    animation._draw_was_started = True  # type: ignore[attr-defined]


# Motions


def test_a_gif_holds_each_frame_until_the_end(tmp_path, capsys):
    """It is drawn over what stands still; matplotlib draws all of each frame."""
    solution, path = swinging(), tmp_path / "motion.gif"
    animation = drawing.animate(ARM, solution, until=0.4, max_frames=3)
    animation.save(path, dpi=50)
    # One bar, as this is no terminal.
    assert capsys.readouterr().err == f"\rmotion.gif [{30 * '#'}]\n"
    animation.save(path.with_name("whole.gif"), dpi=50, writer="pillow")
    with Image.open(path) as quick, Image.open(path.with_name("whole.gif")) as whole:
        assert quick.n_frames == whole.n_frames == 3  # type: ignore[attr-defined]
        apart = []
        for frame in range(3):
            quick.seek(frame)
            whole.seek(frame)
            pair = [np.asarray(image.convert("L"), float) for image in (quick, whole)]
            apart.append(np.abs(pair[0] - pair[1]).mean())
    assert max(apart) < min(4, 1.3 * apart[0])  # other colours, but no former frame
    assert plt.gcf().axes[0].get_title() == "t = 0.40 s"


def test_a_grid_moves_together_with_the_forces_of_its_titles():
    spring = fj.SpringDamper(fj.Point(0, 1, 1), fj.Point(3, 0.6), stiffness=1)
    short, forces = (make_linkage("PRR"), swinging(51, 0.5)), {"short": (spring,)}
    pairs = {"long": (LINKAGE, swinging()), "short": short}
    for speed, frames in ((1.0, 26), (2.0, 14)):
        animation = drawing.animate_grid(pairs, speed=speed)
        assert len(list(animation.new_frame_seq())) == frames
        animation._draw_was_started = True  # type: ignore[attr-defined]
    animation = drawing.animate_grid(pairs, forces=forces, max_frames=5)
    animation._draw_was_started = True  # type: ignore[attr-defined]
    figure = plt.gcf()
    # The short motion has ended at the last frame.
    for frame, samples in ((1, (25, 25)), (4, (100, 50))):
        animation._func(frame)  # type: ignore[attr-defined]
        assert figure.get_suptitle() == f"t = {frame / 4:.2f} s"
        for ax, (linkage, motion), i in zip(figure.axes, pairs.values(), samples):
            tip = np.asarray(fj.tip_position(linkage, motion.q[i]))
            same(lines(ax)["tip 3"], [tip])
            assert len(lines(ax)["tip path"].get_xydata()) == i + 1
        corners = np.asarray(lines(figure.axes[1])["spring 0"].get_xydata())
        assert np.isclose(corners, tip).all(axis=1).any()
    grid = drawing.topology_grid(pairs, forces=forces, configurations=2)
    for panels in (figure, grid):
        assert [ax.get_title() for ax in panels.axes] == ["long", "short"]
        assert ["spring 0" in lines(ax) for ax in panels.axes] == [False, True]
    assert {len(named(ax, "link 3")) for ax in grid.axes} == {2}


def test_a_notebook_plays_an_animation_once_with_the_limits_of_its_panels(caplog):
    """Checks that the notebook does not also show the animation's still figure."""
    pairs = {t: (make_linkage(t), swinging()) for t in ("RRR", "PRR", "PPR")}
    animation = drawing.animate_grid(pairs, fps=2)
    axes = plt.gcf().axes
    before = [ax.axis() for ax in axes]
    html = animation._repr_html_()  # type: ignore[attr-defined]
    assert html.count("data:image/png") == 3 and "<script" in html
    assert not plt.get_fignums() and [ax.axis() for ax in axes] == before
    assert caplog.text == ""  # matplotlib complains of limits that it cannot keep
