"""Pictures show the linkage in its place; pixels are not compared."""

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
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

import fdof_jax as fj
from fdof_jax import TOPOLOGIES, drawing


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_linkage_is_drawn_where_kinematics_puts_it(topology):
    linkage = make_linkage(topology)
    ax = drawing.draw_linkage(linkage, Q)
    drawn, starts = lines(ax), fj.joint_positions(linkage, Q)
    ends = [*starts, fj.tip_position(linkage, Q)]
    for k, kind in enumerate(topology, start=1):
        name, other = ("pin", "slider") if kind == "R" else ("slider", "pin")
        same(drawn[f"{name} {k}"], [starts[k - 1]])
        assert f"{other} {k}" not in drawn
        assert (f"rail {k}" in drawn) == (kind == "P")
        link = drawn[f"link {k}"].get_xydata()
        np.testing.assert_allclose(link[0], starts[k - 1], atol=1e-12)
        size = np.linalg.norm(link[1] - link[0])
        np.testing.assert_allclose(size, linkage.length[k])
        # The fixed offset belongs to the link, the slide to the rail.
        rail = drawn.get(f"rail {k + 1}", drawn[f"link {k}"]).get_xydata()
        np.testing.assert_allclose(rail[-1], ends[k], atol=1e-12)
        dot = drawn[f"mass {k}"].get_xydata()[-1]
        center = fj.mass_centers(linkage, Q)[k - 1]
        np.testing.assert_allclose(dot, center, atol=1e-12)
    same(drawn["tip 3"], ends[-1:])
    # What lies on something else hides nothing: mass centres under the tip and pins.
    order = [line.get_gid().split()[0] for line in ax.lines if line.get_gid()]
    assert order.index("mass") < order.index("tip") < len(order) - 3


def test_slides_stand_across_their_link_and_level_in_the_legend():
    ax = drawing.draw_linkage(make_linkage("RPR"), Q)
    drawn = lines(ax)
    along = np.diff(drawn["link 1"].get_xydata(), axis=0)[0]
    rail = np.diff(drawn["rail 2"].get_xydata(), axis=0)[0]
    np.testing.assert_allclose(rail, 0.4 * np.array([-along[1], along[0]]), atol=1e-12)
    turn = drawn["slider 2"]._marker.get_user_transform().get_matrix()
    np.testing.assert_allclose(turn[:2, 0], rail / 0.4, atol=1e-12)
    (slide,) = [line for line in ax.lines if line.get_label() == "slide"]
    assert slide.get_xydata().size == 0
    assert not slide._marker.get_user_transform()


def test_linkage_options():
    ax = plt.subplots()[1]
    ax.scatter([5], [9])
    style = dict(color="red", alpha=0.5, mass_centers=False)
    assert drawing.draw_linkage(make_linkage("RRP"), Q, ax, **style) is ax
    assert ax.get_xlim()[1] > 5 and ax.get_ylim()[1] > 9  # what was there stays in view
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    assert ax.get_aspect() == 1
    drawn = lines(ax)
    assert not [name for name in drawn if name.startswith("mass")]
    assert {drawn[f"link {n}"].get_color() for n in (1, 2, 3)} == {"red"}
    assert drawn["link 1"].get_alpha() == 0.5


def test_chrono_cyclograph_writes_times_beside_tips():
    arm, start, *_ = fj.scenes.fig5()
    ts = np.linspace(0, 1.5, 151)
    motion = fj.simulate(arm, start, ts)
    ax = drawing.chrono_cyclograph(arm, motion)
    texts = [text for text in ax.texts if text.get_gid() == "time"]
    shown = [text.get_text() for text in texts]
    assert shown == ["1.5 s", "1.2 s", "0.9 s", "0.6 s", "0.3 s", "0 s"]
    plt.gcf().draw_without_rendering()
    drawn = [line.get_path().transformed(ax.transData) for line in ax.lines]
    for text in texts:
        box = text.get_window_extent()
        assert not any(path.intersects_bbox(box, filled=False) for path in drawn)
        k = np.abs(ts - float(text.get_text()[:-2])).argmin()
        np.testing.assert_allclose(text.xy, fj.tip_position(arm, motion.q[k]))


def test_chrono_cyclograph_takes_the_nearest_samples():
    linkage, solution = make_linkage("RPR"), swinging()
    ax = drawing.chrono_cyclograph(linkage, solution, every=0.1, until=0.3)
    last_links, samples = named(ax, "link 3"), [0, 10, 20, 30]
    for line, sample in zip(last_links, samples, strict=True):
        tip = fj.tip_position(linkage, solution.q[sample])
        np.testing.assert_allclose(line.get_xydata()[-1], tip, atol=1e-12)
    brightness = [sum(to_rgb(line.get_color())) for line in last_links]
    assert brightness == sorted(brightness, reverse=True)
    assert len(named(ax, "tip 3")) == 1  # only the last configuration is whole
    path = lines(ax)["tip path"]
    assert len(path.get_xydata()) == 31 and path.get_markevery() == samples
    assert set(labels(ax)) == {"link 1", "link 2", "link 3", "slide", "tip"}
    # What a failed solve did not reach is left out.
    failed = eqx.tree_at(lambda s: s.q, solution, solution.q.at[51:].set(jnp.nan))
    for motion, until, count in (
        (solution, None, 11),
        (solution, 5.0, 11),
        (solution, 0.0, 1),
        (failed, None, 6),
    ):
        ax = drawing.chrono_cyclograph(LINKAGE, motion, until=until)
        assert len(named(ax, "link 3")) == count


def test_topology_grid_has_a_panel_for_each():
    motions = {name: (make_linkage(name), swinging(11)) for name in TOPOLOGIES}
    fig = drawing.topology_grid(motions, configurations=2)
    assert [ax.get_title() for ax in fig.axes] == list(TOPOLOGIES)
    assert (fig.get_supxlabel(), fig.get_supylabel()) == ("x [m]", "y [m]")
    assert {len(named(ax, "link 3")) for ax in fig.axes} == {2}


@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_a_straight_arm_has_room_around_it(angle):
    arm = LINKAGE.replace(com=[[0.1, 0]] * 3, base_angle=angle, locked=0.0)
    ax = drawing.draw_linkage(arm, [0, 0, 0])
    width, height = np.ptp(ax.dataLim.get_points(), axis=0)
    assert 0.39 < min(width, height) / max(width, height) < 0.41


def test_labels_lie_inside_a_new_figure_as_it_is_saved():
    ts = np.linspace(0, 1, 11)
    motion = made_up(ts, -0.1 - 3.0 * ts[:, None] * [1, 0, 0])
    axes = drawing.chrono_cyclograph(fj.scenes.fig5().linkage, motion)
    axes.figure.draw_without_rendering()  # type: ignore[union-attr]
    assert axes.xaxis.label.get_window_extent().y0 >= 0
    # The limits that equal scales need have longer ticks than those before.
    drawing.animate(LINKAGE, made_up(ts, Q + ts[:, None] * [0.3, -0.8, 0.7]))
    figure = plt.gcf()
    figure.draw_without_rendering()
    assert figure.axes[0].yaxis.label.get_window_extent().x0 >= 0
