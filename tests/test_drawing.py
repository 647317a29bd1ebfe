"""Pictures show the linkage in its place; pixels are not compared."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fdof_jax import (
    TOPOLOGIES,
    Linkage,
    Solution,
    drawing,
    joint_positions,
    mass_centers,
    scenes,
    tip_position,
)

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def tidy():
    """Checks that every figure is closed and that global settings are unchanged."""
    before = dict(matplotlib.rcParams)
    yield
    plt.close("all")
    assert dict(matplotlib.rcParams) == before


def make_linkage(topology):
    return Linkage(
        topology,
        length=[0.3, 1, 0.8, 0.6],
        com=[[0.5, 0.1], [0.4, -0.2], [0.3, 0]],
        mass=[2, 1, 1],
        inertia=[0.1, 0.1, 0.1],
        locked=[0.2 if kind == "R" else 0.7 for kind in topology],
        base_angle=0.4,
    )


def made_up(ts, q, qd=None) -> Solution:
    """Returns a solution without a solve; figures use only times and joint states."""
    q = jnp.asarray(q, dtype=float)
    qd = jnp.zeros_like(q) if qd is None else jnp.asarray(qd, dtype=float)
    return Solution(jnp.asarray(ts, dtype=float), q, qd, {}, None)  # type: ignore[arg-type]


def swinging(count=101, end=1.0) -> Solution:
    ts = np.linspace(0, end, count)
    q = np.stack([0.3 + 0.1 * ts, 0.4 + 0.2 * np.sin(ts), 0.5 - 0.3 * ts], axis=1)
    return made_up(ts, q, np.gradient(q, ts, axis=0))


def lines(ax: Axes) -> dict[Any, Any]:
    return {line.get_gid(): line for line in ax.lines if line.get_gid()}


def labels(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def named(ax: Axes, name: str) -> list[Any]:
    return [line for line in ax.lines if line.get_gid() == name]


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_linkage_is_drawn_where_kinematics_puts_it(topology):
    linkage, q = make_linkage(topology), np.array([0.3, 0.4, -0.5])
    drawn = lines(drawing.draw_linkage(linkage, q))
    joints, centers = joint_positions(linkage, q), mass_centers(linkage, q)
    ends = [*joints, tip_position(linkage, q)]
    for k, kind in enumerate(topology):
        name, other = ("pin", "slider") if kind == "R" else ("slider", "pin")
        at = drawn[f"{name} {k + 1}"].get_xydata()
        np.testing.assert_allclose(at, [joints[k]], atol=1e-12)
        assert f"{other} {k + 1}" not in drawn
        assert (f"rail {k + 1}" in drawn) == (kind == "P")
        link, bone = drawn[f"link {k + 1}"].get_xydata(), linkage.length[k + 1]
        np.testing.assert_allclose(link[0], joints[k], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(link[1] - link[0]), bone)
        # The fixed offset belongs to the link, the slide to the rail.
        rail = drawn.get(f"rail {k + 2}", drawn[f"link {k + 1}"])
        np.testing.assert_allclose(rail.get_xydata()[-1], ends[k + 1], atol=1e-12)
        dot = drawn[f"mass {k + 1}"].get_xydata()[-1]
        np.testing.assert_allclose(dot, centers[k], atol=1e-12)
    np.testing.assert_allclose(drawn["tip 3"].get_xydata(), [ends[-1]], atol=1e-12)


def test_slides_stand_across_their_link():
    drawn = lines(drawing.draw_linkage(make_linkage("RPR"), [0.3, 0.4, -0.5]))
    along = np.diff(drawn["link 1"].get_xydata(), axis=0)[0]
    rail = np.diff(drawn["rail 2"].get_xydata(), axis=0)[0]
    np.testing.assert_allclose(rail, 0.4 * np.array([-along[1], along[0]]), atol=1e-12)
    turn = drawn["slider 2"]._marker.get_user_transform().get_matrix()
    np.testing.assert_allclose(turn[:2, 0], rail / 0.4, atol=1e-12)


def test_a_slide_is_level_in_the_legend():
    ax = drawing.draw_linkage(make_linkage("RPR"), [0.3, 0.4, -0.5])
    (slide,) = [line for line in ax.lines if line.get_label() == "slide"]
    assert slide.get_xydata().size == 0
    assert not slide._marker.get_user_transform()


def test_a_mass_centre_at_the_tip_hides_nothing():
    ax = drawing.draw_linkage(make_linkage("RRR"), [0.0, 0, 0])
    order = [line.get_gid() for line in ax.lines]
    assert order.index("tip 3") < order.index("mass 3") < order.index("pin 3")


def test_linkage_options():
    ax = plt.subplots()[1]
    linkage = make_linkage("RRP")
    ax.scatter([5], [9])
    same = drawing.draw_linkage(
        linkage, [0, 0, 0.1], ax, color="red", alpha=0.5, mass_centers=False
    )
    assert same is ax
    assert ax.get_xlim()[1] > 5 and ax.get_ylim()[1] > 9  # what was there stays in view
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    assert ax.get_aspect() == 1
    drawn = lines(ax)
    assert not [name for name in drawn if name.startswith("mass")]
    assert {drawn[f"link {n}"].get_color() for n in (1, 2, 3)} == {"red"}
    assert drawn["link 1"].get_alpha() == 0.5


def test_chrono_cyclograph_takes_the_nearest_samples():
    linkage, solution = make_linkage("RPR"), swinging()
    ax = drawing.chrono_cyclograph(linkage, solution, every=0.1, until=0.3)
    tips = named(ax, "tip 3")
    assert len(tips) == 4
    for line, sample in zip(tips, (0, 10, 20, 30)):
        expected = tip_position(linkage, solution.q[sample])
        np.testing.assert_allclose(line.get_xydata(), [expected], atol=1e-12)
    alphas = [line.get_alpha() for line in tips]
    assert alphas == sorted(alphas) and alphas[-1] == 1
    assert len(lines(ax)["tip path"].get_xydata()) == 31
    assert set(labels(ax)) == {
        "ground", "tip path", "link 1", "link 2", "link 3", "pin", "slide", "tip",
    }  # fmt: skip


@pytest.mark.parametrize("until, count", [(None, 11), (5.0, 11), (0.0, 1)])
def test_chrono_cyclograph_ends(until, count):
    ax = drawing.chrono_cyclograph(make_linkage("RRR"), swinging(), until=until)
    assert len(named(ax, "tip 3")) == count


def test_what_a_failed_solve_did_not_reach_is_left_out():
    solution = swinging()
    solution = eqx.tree_at(lambda s: s.q, solution, solution.q.at[51:].set(jnp.nan))
    ax = drawing.chrono_cyclograph(make_linkage("RRR"), solution)
    assert len(named(ax, "tip 3")) == 6


def test_topology_grid_has_a_panel_for_each():
    motions = {name: (make_linkage(name), swinging(11)) for name in TOPOLOGIES}
    fig = drawing.topology_grid(motions, configurations=2)
    assert isinstance(fig, Figure)
    assert [ax.get_title() for ax in fig.axes] == list(TOPOLOGIES)
    assert (fig.get_supxlabel(), fig.get_supylabel()) == ("x [m]", "y [m]")
    for ax in fig.axes:
        assert len(named(ax, "tip 3")) == 2


LINKAGE, SOLUTION = make_linkage("RRR"), swinging(5)
BATCH = made_up(SOLUTION.ts, jnp.stack([SOLUTION.q] * 2))
NOWHERE = made_up(SOLUTION.ts, SOLUTION.q * jnp.nan)


@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_a_straight_arm_has_room_around_it(angle):
    arm = make_linkage("RRR").replace(com=[[0.1, 0]] * 3, base_angle=angle)
    arm = arm.replace(locked=0.0)
    ax = drawing.draw_linkage(arm, [0, 0, 0])
    width, height = np.ptp(ax.dataLim.get_points(), axis=0)
    assert 0.39 < min(width, height) / max(width, height) < 0.41


def test_labels_lie_inside_a_new_figure_as_it_is_saved():
    ts = np.linspace(0, 1, 11)
    motion = made_up(ts, -0.1 - 3.0 * ts[:, None] * [1, 0, 0])
    axes = drawing.chrono_cyclograph(scenes.fig5().linkage, motion)
    axes.figure.draw_without_rendering()  # type: ignore[union-attr]
    assert axes.xaxis.label.get_window_extent().y0 >= 0


@pytest.mark.parametrize(
    "name, call",
    [
        ("linkage", lambda: drawing.draw_linkage("RRR", [0, 0, 0])),  # type: ignore
        ("q", lambda: drawing.draw_linkage(LINKAGE, [0, 0])),
        ("ax", lambda: drawing.draw_linkage(LINKAGE, [0, 0, 0], 3)),  # type: ignore
        ("solution", lambda: drawing.animate(LINKAGE, BATCH)),
        ("solution", lambda: drawing.chrono_cyclograph(LINKAGE, NOWHERE)),
        ("every", lambda: drawing.chrono_cyclograph(LINKAGE, SOLUTION, every=0)),
        ("until", lambda: drawing.chrono_cyclograph(LINKAGE, SOLUTION, until=-1)),
        ("motions", lambda: drawing.topology_grid({})),
        (r"motions\['a'\]", lambda: drawing.topology_grid({"a": SOLUTION})),  # type: ignore
        (r"motions\['a'\]", lambda: drawing.topology_grid({"a": ("RRR", SOLUTION)})),  # type: ignore
        ("configurations", lambda: drawing.topology_grid(
            {"a": (LINKAGE, SOLUTION)}, configurations=1)),
        ("max_frames", lambda: drawing.animate(LINKAGE, SOLUTION, max_frames=0)),
        ("fps", lambda: drawing.animate(LINKAGE, SOLUTION, fps=0)),
        ("speed", lambda: drawing.animate(LINKAGE, SOLUTION, speed=-1)),
        ("motions", lambda: drawing.animate_grid({})),
        ("forces", lambda: drawing.topology_grid(
            {"a": (LINKAGE, SOLUTION)}, forces={"b": ()})),
        ("fps", lambda: drawing.animate_grid({"a": (LINKAGE, SOLUTION)}, fps=-1)),
    ],
)  # fmt: skip
def test_malformed_arguments_are_named(name, call):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call()
    assert not plt.get_fignums()
