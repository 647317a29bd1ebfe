"""Reach and ellipses against closed forms, ranks and dynamics; pixels do not count."""

import re
from itertools import product

import jax
import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from test_drawing import Q, labels, lines, make_linkage, named, tidy as tidy

import fdof_jax as fj
from fdof_jax import drawing
from fdof_jax.analysis.reach import curves, ranges_of, reached_cells

JACOBIANS = jax.jit(jax.vmap(fj.tip_jacobian, in_axes=(None, 0)))


def chain(lengths, topology=None, **more):
    n = len(lengths)
    return fj.Linkage(
        topology or "R" * n, length=[0, *lengths], com=[[0.1, 0]] * n, mass=[1] * n,
        inertia=[0.1] * n, **more,
    )  # fmt: skip


def ends(topology, turn):
    high = np.where([kind == "R" for kind in topology], turn, 0.6)
    return -0.8 * high, high


@pytest.mark.slow
@pytest.mark.parametrize("turn", [np.inf, 1.5])
@pytest.mark.parametrize("orientation", [None, 0.8])
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_curves_are_singular_and_hold_all_configurations(topology, orientation, turn):
    """Checks ranks on the curves, and that no configuration is beyond them."""
    linkage, rows = make_linkage(topology), 2 if orientation is None else 3
    turning = [kind == "R" for kind in topology]
    turns = lambda q: np.where(turning, q, linkage.locked).sum(axis=1)
    ranges = ranges_of(linkage, *ends(topology, turn), orientation)
    bounds = list(curves(ranges))
    assert len(bounds) > 0
    for q, singular in bounds:
        q = q[np.isfinite(q).all(axis=1)]
        assert (q >= ranges.lower - 1e-8).all() and (q <= ranges.upper + 1e-8).all()
        stands = (q.min(axis=0) == q.max(axis=0)) & (not singular)
        stands &= np.isclose(q[0], ranges.lower) | np.isclose(q[0], ranges.upper)
        J = np.asarray(JACOBIANS(linkage, q))[:, :rows] * ~stands
        assert np.linalg.svd(J, compute_uv=False)[:, -1].max() < 1e-7
        if orientation is not None:
            off = linkage.base_angle + turns(q) - orientation
            np.testing.assert_allclose(np.exp(1j * off), 1, atol=1e-9)
    cells = reached_cells(ranges, [q for q, _ in bounds])
    random = np.random.default_rng(1)
    q = random.uniform(ranges.lower, ranges.upper, (5000, 3))
    if orientation is not None:  # a joint that turns makes up for the others
        q[:, topology.rindex("R")] += orientation - linkage.base_angle - turns(q)
        q = ranges.within(q)
        q = q[np.isfinite(q).all(axis=1)]
    assert len(q) > 50
    # An edge may cut off a corner of a cell.
    near = binary_dilation(cells.reached)
    assert near[cells.at(ranges.tips(q))].all()


def distinct(values):
    """Returns finite values in ascending order, each once."""
    return np.unique(values[np.isfinite(values)].round(9))


def filled(ax):
    """Returns the filled area [m^2]."""
    (image,) = ax.images
    x0, x1, y0, y1 = image.get_extent()
    mask = ~np.ma.getmaskarray(image.get_array())
    return mask.mean() * (x1 - x0) * (y1 - y0)


@pytest.mark.parametrize("lengths", [(1, 0.4, 0.2), (0.5, 0.4, 0.3), (1, 0.3)])
def test_the_reach_of_links_that_turn_is_a_ring(lengths):
    ax = drawing.workspace(chain(lengths))
    longest, total = max(lengths), sum(lengths)
    inner = max(0, 2 * longest - total)
    np.testing.assert_allclose(filled(ax), np.pi * (total**2 - inner**2), rtol=0.02)
    radii = np.hypot(*lines(ax)["singular"].get_data())
    signs = np.array([*product([1, -1], repeat=len(lengths))])
    np.testing.assert_allclose(distinct(radii), distinct(np.abs(signs @ lengths)))
    assert "edge" not in lines(ax)


def test_the_reach_with_a_commanded_angle():
    ax = drawing.workspace(chain((1, 0.4, 0.2)), orientation=np.pi / 2)
    x, y = lines(ax)["singular"].get_data()  # the last link stands up
    np.testing.assert_allclose(distinct(np.hypot(x, y - 0.2)), [0.6, 1.4])
    np.testing.assert_allclose(filled(ax), np.pi * (1.4**2 - 0.6**2), rtol=0.02)
    with pytest.raises(ValueError, match="^orientation: expected .* tip can move"):
        drawing.workspace(chain((1, 0.4, 0.2)), -0.1, 0.1, orientation=1.0)
    with pytest.raises(ValueError, match="^orientation: expected None"):
        two = chain((1, 0.4), "PP", locked=[1.2, 0])
        drawing.workspace(two, 0, 1, orientation=1.0)


def test_the_reach_of_slides_is_a_parallelogram():
    """Slides run along y and, turned by `locked`, along another direction."""
    arm = chain((0.5, 0.2), "PP", locked=[1.2, 0])
    ax = drawing.workspace(arm, [0, 0], [1.0, 2.0])
    np.testing.assert_allclose(filled(ax), 2 * np.sin(1.2), rtol=0.02)
    arm = chain((0.5, 1.0), "PR", base_angle=-np.pi / 2)  # the first runs along x
    ax = drawing.workspace(arm, [0, -np.inf], [3.0, np.inf])
    np.testing.assert_allclose(filled(ax), np.pi + 2 * 3, rtol=0.02)
    x, y = lines(ax)["singular"].get_data()
    np.testing.assert_allclose(distinct(y + 0 * x), [-1.5, 0.5])  # link 1 hangs down
    np.testing.assert_allclose([np.nanmin(x), np.nanmax(x)], [0, 3], atol=1e-12)


def test_the_reach_of_limited_joints_is_as_wide_as_their_ranges():
    """One joint of a stretched arm sweeps a sector; the other opens it to the side."""
    ax = drawing.workspace(chain((1.0, 1.0)), [0, 0], [1.0, 2.0])
    # The sector between the stretched and the bent arm.
    outer, inner = 2.0, np.abs(1 + np.exp(2j))
    np.testing.assert_allclose(filled(ax), (outer**2 - inner**2) / 2, rtol=0.02)
    x, y = lines(ax)["singular"].get_data()
    np.testing.assert_allclose(distinct(np.hypot(x, y)), 2)
    angles = distinct(np.arctan2(y, x))
    np.testing.assert_allclose(angles[[0, -1]], [0, 1], atol=1e-9)


def test_fixed_pairs_do_not_move():
    arm = chain((0.5, 0.5, 0.4), "RFR", locked=[0, 0, 0])
    ax = drawing.workspace(arm)
    np.testing.assert_allclose(filled(ax), np.pi * (1.4**2 - 0.6**2), rtol=0.02)
    drawing.force_ellipses(arm, [[0.3, 9.0, 0.5]], 1.0)
    drawing.inertia_ellipses(arm, [[0.3, 9.0, 0.5]])


def ellipse(ax, k, tip):
    """Returns the vectors (point, 2) of an ellipse, in its units."""
    (scale,) = re.findall(r", 1 m: ([\d.e+-]+)", " ".join(labels(ax)))
    return float(scale) * (lines(ax)[f"ellipse {k}"].get_xydata() - np.asarray(tip))


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_forces_of_an_ellipse_take_the_efforts(topology):
    linkage, limit = make_linkage(topology), np.array([30.0, 20.0, 10.0])
    path = Q + np.linspace(0, 0.4, 4)[:, None]
    ax = drawing.force_ellipses(linkage, path, limit)
    for k, q in enumerate(path):
        J = np.asarray(fj.tip_jacobian(linkage, q))[:2]
        force = ellipse(ax, k, fj.tip_position(linkage, q))
        np.testing.assert_allclose(np.linalg.norm(force @ J / limit, axis=1), 1)
        sizes = np.linalg.svd(J / limit, compute_uv=False)
        # 72 corners come within 0.2 % of the ends of the axes.
        most = np.linalg.norm(force, axis=1).max()
        np.testing.assert_allclose(most, 1 / sizes[-1], rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_forces_accelerate_the_tip_to_the_ellipse(topology):
    linkage = make_linkage(topology)
    extra = fj.LinearActuator(fj.Point(0, 1), fj.Point(1, 0.5), mass=[1.0, 2.0])
    for forces in ((), (extra,)):
        ax = drawing.inertia_ellipses(linkage, [Q], forces=forces)
        J, rest = np.asarray(fj.tip_jacobian(linkage, Q))[:2], np.zeros(3)
        held = fj.bias_force(linkage, Q, rest, forces)
        answers = [
            J @ fj.forward_dynamics(linkage, Q, rest, held + J.T @ push, forces)
            for push in np.eye(2)
        ]
        drawn = ellipse(ax, 0, fj.tip_position(linkage, Q))
        back = np.linalg.solve(np.stack(answers, axis=1), drawn.T)
        np.testing.assert_allclose(np.linalg.norm(back, axis=0), 1)


def test_a_stretched_arm_holds_any_force_along_itself():
    arm = chain((1.0, 1.0))
    path = [[0.2, 0.0], [0.2, 0.9], [0.2, 1.1]]
    ax = drawing.force_ellipses(arm, path, 5.0)
    tip = np.asarray(fj.tip_position(arm, path[0]))
    # Cut at a quarter of the arm's extent, open at its ends and dashed.
    x, y = (lines(ax)["ellipse 0"].get_xydata() - tip).T
    along = np.cos(0.2) * x + np.sin(0.2) * y
    np.testing.assert_allclose(along[[0, 36]], [-tip[0] / 4, tip[0] / 4], rtol=1e-6)
    np.testing.assert_allclose(np.tan(0.2), (y[36] - y[0]) / (x[36] - x[0]))
    assert np.isnan(x[37]) and np.isfinite(np.delete(x, 37)).all()
    assert lines(ax)["ellipse 0"].get_linestyle() == "--"
    assert lines(ax)["ellipse 1"].get_linestyle() == "-"
    parts = {"pin", "link 1", "tip path", "ground", "longer, cut here"}
    assert set(labels(ax)) >= parts
    flat = drawing.inertia_ellipses(arm, path[:1])
    along = ellipse(flat, 0, tip) @ [np.cos(0.2), np.sin(0.2)]
    np.testing.assert_allclose(along, 0, atol=1e-12)
    assert len(named(flat, "link 2")) == 1
    assert drawing.workspace(arm, ax=ax) is ax
