"""Animations show each time in its place, in files and in notebooks."""

import subprocess

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figures import LINKAGE, lines, make_linkage, same, swinging, tidy as tidy
from matplotlib.animation import writers
from PIL import Image

from fdof_jax import Point, SpringDamper, drawing, tip_position

ARM = make_linkage("RPR")


@pytest.mark.parametrize(
    "kind, writer", [("gif", None), ("mp4", "ffmpeg"), ("html", "html")]
)
def test_files_hold_each_frame_until_the_end(kind, writer, tmp_path, capsys):
    if writer and not writers.is_available(writer):
        pytest.skip(f"{kind} needs {writer}, a program that is not installed here")
    solution, path = swinging(), tmp_path / f"motion.{kind}"
    animation = drawing.animate(ARM, solution, until=0.4, max_frames=3)
    animation.save(path, dpi=50, **(dict(writer=writer) if writer else {}))
    if kind == "mp4":
        command = ["ffmpeg", "-loglevel", "error", "-i", path, tmp_path / "%d.png"]
        subprocess.run(command, check=True, timeout=60)
        assert len(list(tmp_path.glob("*.png"))) == 3
    elif kind == "html":
        assert "motion_frames/frame" in path.read_text()
        assert len(list((tmp_path / "motion_frames").glob("frame*.png"))) == 3
    else:
        # One bar, as this is no terminal.
        assert capsys.readouterr().err == f"\rmotion.gif [{30 * '#'}]\n"
        drawn_over_what_stands(path, animation)
    (ax,) = plt.gcf().axes
    assert ax.get_title() == "t = 0.40 s"
    same(lines(ax)["tip 3"], [tip_position(ARM, solution.q[40])])
    left, right, bottom, top = ax.axis()
    tips = lines(ax)["tip path"].get_xydata()
    assert ((tips > [left, bottom]) & (tips < [right, top])).all() and len(tips) == 41


def drawn_over_what_stands(path, animation):
    """Compares a GIF, frame by frame, with one that draws all of each frame."""
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


def test_a_grid_moves_together_with_the_forces_of_its_titles():
    spring = SpringDamper(Point(0, 1, 1), Point(3, 0.6), stiffness=1, damping=0)
    pairs = {
        "long": (LINKAGE, swinging()),
        "short": (make_linkage("PRR"), swinging(51, 0.5)),
    }
    forces = {"short": (spring,)}
    animation = drawing.animate_grid(pairs, forces=forces, max_frames=5)
    assert list(animation.new_frame_seq()) == [0, 1, 2, 3, 4]
    figure = plt.gcf()
    assert [ax.get_title() for ax in figure.axes] == ["long", "short"]
    # The short motion has ended at the last frame.
    for frame, samples in ((1, (25, 25)), (4, (100, 50))):
        animation._func(frame)  # type: ignore[attr-defined]
        assert figure.get_suptitle() == f"t = {frame / 4:.2f} s"
        for ax, (arm, motion), i in zip(figure.axes, pairs.values(), samples):
            tip = np.asarray(tip_position(arm, motion.q[i]))
            same(lines(ax)["tip 3"], [tip])
            assert len(lines(ax)["tip path"].get_xydata()) == i + 1
        corners = np.asarray(lines(figure.axes[1])["spring 0"].get_xydata())
        assert np.isclose(corners, tip).all(axis=1).any()
    for panels in (figure, drawing.topology_grid(pairs, forces=forces)):
        assert ["spring 0" in lines(ax) for ax in panels.axes] == [False, True]
    given = plt.figure()
    other = drawing.animate_grid({"long": pairs["long"]}, given, max_frames=1)
    assert len(given.axes) == 1
    for unseen in (animation, other):
        unseen._draw_was_started = True  # type: ignore[attr-defined]


@pytest.mark.parametrize("speed, frames", [(1.0, 26), (0.5, 51), (2.0, 14)])
def test_animation_keeps_time(speed, frames):
    ax = plt.subplots()[1]
    animation = drawing.animate(LINKAGE, swinging(), ax, speed=speed)
    assert len(list(animation.new_frame_seq())) == frames
    animation._draw_was_started = True  # type: ignore[attr-defined]


def test_a_notebook_plays_an_animation_once_with_the_limits_of_its_panels(caplog):
    """Checks that the notebook does not also show the animation's still figure."""
    pairs = {t: (make_linkage(t), swinging()) for t in ("RRR", "PRR", "PPR")}
    animation = drawing.animate_grid(pairs, fps=2)
    axes = plt.gcf().axes
    before = [ax.axis() for ax in axes]
    html = animation._repr_html_()  # type: ignore[attr-defined]
    assert html.count("data:image/png") == 3 and "<script" in html
    assert not plt.get_fignums()
    assert [ax.axis() for ax in axes] == before
    assert caplog.text == ""  # matplotlib complains of limits that it cannot keep
