"""Ellipses against closed forms, ranks and dynamics; pixels do not count."""

import re
from functools import partial

import numpy as np
import pytest
from test_drawing import Q, labels, lines, make_linkage, named, tidy as tidy

import fdof_jax as fj
from fdof_jax import drawing


def chain(lengths, topology=None, **more):
    n = len(lengths)
    return fj.Linkage(
        topology or "R" * n, length=[0, *lengths], com=[[0.1, 0]] * n, mass=[1] * n,
        inertia=[0.1] * n, **more,
    )  # fmt: skip


def test_fixed_pairs_do_not_move():
    arm = chain((0.5, 0.5, 0.4), "RFR", locked=[0, 0, 0])
    for draw in (partial(drawing.force_ellipses, limit=1.0), drawing.inertia_ellipses):
        first, other = (
            lines(draw(arm, [[0.3, fixed, 0.5]]))["ellipse 0"].get_xydata()
            for fixed in (0.0, 9.0)
        )
        np.testing.assert_array_equal(first, other)


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
    assert drawing.inertia_ellipses(arm, path, ax) is ax
