"""Ellipses of a tip's forces and inertia along a path."""

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..dynamics import mass_matrix
from ..forces.element import Forces
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..mechanics.kinematics import tip_jacobian
from .arms import Geometry, draw_motion, geometry
from .axes import SERIES, legend, plane_axes, xy


def force_ellipses(
    linkage: Linkage, q: ArrayLike, limit: ArrayLike, ax: Axes | None = None
) -> Axes:
    """Draws the forces that the tip can exert, standing, as ellipses along a path.

    An ellipse holds the forces that joint efforts can balance whose shares of the
    limits have a sum of squares of 1; gravity is left out. The legend gives the scale.
    Near a singular configuration an ellipse may be far longer than the arm: beyond a
    quarter of the arm's size it is cut, dashed and open at its ends.

    **Arguments:** `q`: joint positions along the path (configurations, n) [m or rad];
    `limit`: greatest efforts, one per joint or one for all, positive [N or N m].

    **Returns:** the axes, with the arm at the first and the last configuration. The
    `gid` of an ellipse is "ellipse 0", "ellipse 1", ...
    """
    g, J, _ = _path(linkage, q)
    most = real_array(
        "limit", limit, (joints_of(linkage),),
        above=0, finite=False, broadcast=True, unit="N or N m",
    )  # fmt: skip
    # Efforts J^T F; the axes of the ellipse are those of the singular values.
    _, sizes, axes = np.linalg.svd(np.swapaxes(J, 1, 2) / np.asarray(most)[:, None])
    with np.errstate(divide="ignore"):
        return _ellipses(g, 1 / sizes, np.swapaxes(axes, 1, 2), "force", " N", ax)


def inertia_ellipses(
    linkage: Linkage, q: ArrayLike, ax: Axes | None = None, *, forces: Forces = ()
) -> Axes:
    """Draws how easily forces move the tip, as ellipses along a path.

    A force of 1 N in some direction accelerates the tip, from rest and beside gravity,
    to a point of the ellipse. The semi-axes are the reciprocals of the masses that the
    tip seems to have along them [1/kg]. In a singular configuration the ellipse is a
    line. The legend gives the scale.

    **Arguments:** `q`: joint positions along the path (configurations, n) [m or rad];
    `forces`: elements, of which those with masses count.

    **Returns:** the axes, as in `force_ellipses`.
    """
    g, J, positions = _path(linkage, q)
    M = np.asarray(jax.vmap(lambda q: mass_matrix(linkage, q, forces))(positions))
    mobility = J @ np.linalg.solve(M, np.swapaxes(J, 1, 2))
    sizes, axes = np.linalg.eigh(mobility)
    return _ellipses(g, sizes, axes, "inertia", "/kg", ax)


def _path(linkage: Linkage, q: ArrayLike) -> tuple[Geometry, np.ndarray, np.ndarray]:
    """The arm along a path, its tip's Jacobians (time, 2, n), and `q` (time, n)."""
    check_linkage(linkage)
    n = joints_of(linkage)
    positions = np.asarray(real_array("q", q, (None, n), of=f"{n} joints"))
    if not len(positions):
        raise ValueError("q: expected one configuration or more, got none.")
    J = jax.vmap(lambda q: tip_jacobian(linkage, q))(positions)
    return geometry(linkage, positions), np.asarray(J)[:, :2], positions


def _ellipses(
    g: Geometry, sizes: np.ndarray, axes: np.ndarray, what: str, unit: str, ax: Any
) -> Axes:
    """Draws ellipses with semi-axes `sizes` (time, 2) along the columns of `axes`.

    Those of neighbours overlap little.
    """
    extent = g.extent
    typical = np.median(sizes.max(axis=1))
    if not np.isfinite(typical) or typical == 0:
        typical = 1.0
    apart = np.median(np.abs(np.diff(g.tip))) if len(g.tip) > 1 else extent
    length = np.clip(0.6 * apart, 0.03 * extent, 0.1 * extent)
    # Units per metre of the picture: 1, 2 or 5 times a power of ten.
    digit, power = f"{typical / length:.0e}".split("e")
    scale = float(f"{max(d for d in (1, 2, 5) if d <= int(digit))}e{power}")
    semi = sizes / scale
    around = g.tip[:, None] + np.stack(
        [_ellipse(*row, extent / 4) for row in zip(semi, axes[:, 0] + 1j * axes[:, 1])]
    )
    ax = plane_axes(ax, np.append(g.all_points, around))
    draw_motion(ax, g, np.unique([0, len(sizes) - 1]), mass_centers=False)
    for k, points in enumerate(around):
        style = dict(color=SERIES[4], lw=1, label=f"{what}, 1 m: {scale:g}{unit}")
        if (semi[k] > extent / 4).any():
            style |= dict(ls=(0, (3, 2)), label="longer, cut here")
        ax.plot(*xy(points), gid=f"ellipse {k}", **style)
    legend(ax)
    return ax


def _ellipse(semi: np.ndarray, axes: np.ndarray, most: float) -> np.ndarray:
    """Points x + iy of an ellipse; beyond `most` along an axis it is cut.

    `semi`: its semi-axes (2,) [m], which may be infinite; `axes`: their directions. NaN
    lifts the pen between the two halves of a cut one.
    """
    short, long = np.sort(semi)
    # Both halves go from end to end; steps are fine where the ellipse is round.
    u = np.sin(np.pi / 2 * np.linspace(-1, 1, 37)) * min(long, most)
    rise = np.sqrt(np.maximum(1 - (u / long) ** 2, 0)) if long > 0 else 0
    v = min(short, most) * rise
    turn = [np.nan if long > most else u[-1]]
    halves = np.concatenate([u + 1j * v, turn, u[::-1] - 1j * v[::-1]])
    across, along = axes[np.argsort(semi)]
    return np.real(halves) * along + np.imag(halves) * across
