"""Animations show each time in its place, in files and in notebooks."""

import subprocess

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.animation import writers
from PIL import Image
from test_drawing import lines, made_up, make_linkage, swinging, tidy as tidy

from fdof_jax import Point, SpringDamper, drawing, tip_position


@pytest.mark.parametrize(
    "kind, writer", [("gif", "pillow"), ("mp4", "ffmpeg"), ("html", "html")]
)
def test_animation_is_capped_and_moves(kind, writer, tmp_path):
    if not writers.is_available(writer):
        pytest.skip(f"{kind} needs {writer}, a program that is not installed here")
    linkage, solution = make_linkage("RPR"), swinging()
    animation = drawing.animate(linkage, solution, max_frames=3)
    path = tmp_path / f"motion.{kind}"
    animation.save(path, writer=writer, dpi=40)
    assert frames_in(path) == 3
    assert list(animation.new_frame_seq()) == [0, 1, 2]
    (ax,) = plt.gcf().axes
    assert ax.get_title() == "t = 1.00 s"
    drawn = lines(ax)
    left, right, bottom, top = ax.axis()
    path = drawn["tip path"].get_xydata()
    assert ((path > [left, bottom]) & (path < [right, top])).all()
    expected = tip_position(linkage, solution.q[-1])
    np.testing.assert_allclose(drawn["tip 3"].get_xydata(), [expected], atol=1e-12)
    assert len(path) == 101


def frames_in(path) -> int:
    if path.suffix == ".gif":
        return Image.open(path).n_frames  # type: ignore[attr-defined]
    if path.suffix == ".html":
        assert "motion_frames/frame" in path.read_text()
        return len(list((path.parent / "motion_frames").glob("frame*.png")))
    command = ["ffmpeg", "-loglevel", "error", "-i", path, path.parent / "%d.png"]
    subprocess.run(command, check=True, timeout=60)
    return len(list(path.parent.glob("*.png")))


def test_grid_of_animations_moves_together():
    first, second = (
        (make_linkage("RRR"), swinging()),
        (make_linkage("PRR"), swinging(51, 0.5)),
    )
    animation = drawing.animate_grid({"long": first, "short": second}, max_frames=5)
    assert list(animation.new_frame_seq()) == [0, 1, 2, 3, 4]
    figure = plt.gcf()
    long, short = figure.axes
    assert [long.get_title(), short.get_title()] == ["long", "short"]
    for frame, sample, other in ((1, 25, 25), (4, 100, 50)):  # the short one has ended
        animation._func(frame)  # type: ignore[attr-defined]
        assert figure.get_suptitle() == f"t = {frame / 4:.2f} s"
        for ax, (linkage, solution), i in (
            (long, first, sample),
            (short, second, other),
        ):
            expected = tip_position(linkage, solution.q[i])
            tip, path = lines(ax)["tip 3"], lines(ax)["tip path"]
            np.testing.assert_allclose(tip.get_xydata(), [expected], atol=1e-12)
            assert len(path.get_xydata()) == i + 1
    animation._draw_was_started = True  # type: ignore[attr-defined]
    given = plt.figure()
    other = drawing.animate_grid({"long": first}, given, max_frames=1)
    assert len(given.axes) == 1
    other._draw_was_started = True  # type: ignore[attr-defined]


def test_panels_of_a_grid_have_the_forces_of_their_titles():
    pairs = {t: (make_linkage(t), swinging(11)) for t in ("RRR", "PPR")}
    spring = SpringDamper(Point(0, 1, 1), Point(3, 0.6), stiffness=1, damping=0)
    animation = drawing.animate_grid(pairs, forces={"PPR": (spring,)}, max_frames=2)
    figures = plt.gcf(), drawing.topology_grid(pairs, forces={"PPR": (spring,)})
    for figure in figures:
        assert ["spring 0" in lines(ax) for ax in figure.axes] == [False, True]
    animation._func(1)  # type: ignore[attr-defined]
    tip = np.asarray(tip_position(*pairs["PPR"][:1], pairs["PPR"][1].q[-1]))
    vertices = np.asarray(lines(figures[0].axes[1])["spring 0"].get_xydata())
    assert np.isclose(vertices, tip).all(axis=1).any()
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_a_notebook_plays_an_animation_once():
    """Checks that the notebook does not also show the animation's still figure."""
    animation = drawing.animate(make_linkage("RRR"), swinging(), max_frames=2)
    html = animation._repr_html_()  # type: ignore[attr-defined]
    assert html.count("data:image/png") == 2 and "<script" in html
    assert not plt.get_fignums()


@pytest.mark.parametrize("speed, frames", [(1.0, 26), (0.5, 51), (2.0, 14)])
def test_animation_keeps_time(speed, frames):
    ax = plt.subplots()[1]
    animation = drawing.animate(make_linkage("RRR"), swinging(), ax, speed=speed)
    assert len(list(animation.new_frame_seq())) == frames
    html = animation.to_jshtml(embed_frames=True) if speed == 2 else ""
    assert (html.count("data:image/png") >= frames) == (speed == 2)
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_animated_panels_keep_their_limits_silently(caplog):
    solution = swinging()
    pairs = {t: (make_linkage(t), solution) for t in ("RRR", "PRR", "PPR")}
    animation = drawing.animate_grid(pairs, fps=2)
    axes = plt.gcf().axes
    before = [(ax.get_xlim(), ax.get_ylim()) for ax in axes]
    animation.to_jshtml()
    assert [(ax.get_xlim(), ax.get_ylim()) for ax in axes] == before
    assert caplog.text == ""  # matplotlib complains of limits that it cannot keep


def test_labels_of_an_animation_lie_inside_its_figure():
    ts = np.linspace(0, 1, 101)
    # The limits that equal scales need have longer ticks than those before.
    q = [-0.4, -1.2, -1.6] + ts[:, None] * [0.3, -0.8, 0.7]
    solution = made_up(ts, q, np.gradient(q, ts, axis=0))
    drawing.animate(make_linkage("RRR"), solution)
    figure = plt.gcf()
    figure.draw_without_rendering()
    assert figure.axes[0].yaxis.label.get_window_extent().x0 >= 0
