"""References for controllers and prescribed motions: in joint space and of the tip."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import instance, real_array, sign
from ..linkage.linkage import Linkage
from ..mechanics.kinematics import plane_angle, solve_joints, unmoved_part, whole_turns
from ..xla.array_namespace import in_numpy, namespace, sine_and_cosine
from .timing import Laps, Travel


class JointMove(eqx.Module):
    """All joints from one position to another, in step.

    **Arguments:** `start`, `end`: joint positions [m or rad]; `travel`: a `Travel`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> move = fj.JointMove([0, 0, 0], [1, 2, 3], fj.Travel(2.0))
    >>> q, qd = move(1.0, arm)
    >>> q.tolist(), qd.tolist()  # halfway, at 15/8 of the mean speed
    ([0.5, 1.0, 1.5], [0.938, 1.875, 2.812])
    """

    start: Float[Array, " joint"]
    end: Float[Array, " joint"]
    travel: Travel

    def __init__(self, start: ArrayLike, end: ArrayLike, travel: Travel):
        self.start = real_array("start", start, (3,))
        self.end = real_array("end", end, (3,))
        instance("travel", travel, Travel)
        self.travel = travel

    @property
    def evaluates_in_numpy(self) -> bool:
        """Whether `assembly` does; a subclass may move in another way."""
        return type(self) is JointMove

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, float]:
        """Joint positions, and 1 for a root: no edge of a reach is near."""
        share = self.travel(t)[..., None]
        return self.start + share * (self.end - self.start), 1.0

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s]."""
        t = real_array("t", t, ())
        positions = lambda t: self.assembly(t, linkage)[0]
        return jax.jvp(positions, (t,), (jnp.ones_like(t),))

    @property
    def jump_ts(self) -> Array:
        """When velocity or acceleration jump [s]."""
        return self.travel.jump_ts


class Path(eqx.Module):
    """A curve of the plane [m]: a subclass has `point`, and says its `middle`.

    >>> import fdof_jax as fj
    >>> import jax.numpy as jnp
    >>> class Parabola(fj.Path):
    ...     middle = jnp.array([-4.0, 2.0])
    ...     def point(self, share):
    ...         return jnp.stack([share - 4.5, 2 + share**2])
    >>> fj.TipTask(Parabola(), fj.Travel(1.0)).tip(0.5).tolist()
    [-4.0, 2.25]
    """

    middle: eqx.AbstractVar[Array]  # (x, y), somewhere in the midst of it [m]

    @abstractmethod
    def point(self, share: Array) -> Array:
        """The point (x, y) at a share of the way, from 0 to 1 or per lap [m]."""


class Line(Path):
    """A straight line.

    **Arguments:** `start`, `end`: points (x, y) [m].

    **Raises:** ValueError for malformed points.

    >>> import fdof_jax as fj
    >>> fj.Line([0, 0], [2, 4]).point(0.25).tolist()
    [0.5, 1.0]
    """

    start: Float[Array, " 2"]
    end: Float[Array, " 2"]

    def __init__(self, start: ArrayLike, end: ArrayLike):
        self.start = real_array("start", start, (2,))
        self.end = real_array("end", end, (2,))

    @property
    def middle(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self.start + self.end) / 2

    def point(self, share):
        share = namespace(self.start, share).asarray(share)
        return self.start + share[..., None] * (self.end - self.start)


class _Closed(Path):
    """A closed curve around a middle, of two sizes, turned by an angle."""

    middle: Float[Array, " 2"]
    sizes: Float[Array, " 2"]
    tilt: Float[Array, ""]

    def __init__(self, middle: ArrayLike, sizes: ArrayLike, *, tilt: ArrayLike = 0.0):
        self.middle = real_array("middle", middle, (2,))
        self.sizes = real_array("sizes", sizes, (2,), minimum=0)
        self.tilt = real_array("tilt", tilt, ())

    def _placed(self, along: Array, across: Array) -> Array:
        sin, cos = sine_and_cosine(self.tilt)
        a, b = self.sizes[0] * along, self.sizes[1] * across
        turned = [a * cos - b * sin, a * sin + b * cos]
        return self.middle + namespace(*turned).stack(turned, axis=-1)


class Ellipse(_Closed):
    """An ellipse, counter-clockwise from the end of its first axis.

    **Arguments:** `middle`: (x, y) [m]; `sizes`: its half axes, not negative [m];
    `tilt`: of the first axis [rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.Ellipse([1, 0], [2, 1]).point(0.25).tolist()  # a quarter of the way round
    [1.0, 1.0]
    """

    def point(self, share):
        sin, cos = sine_and_cosine(2 * np.pi * share)
        return self._placed(cos, sin)


class FigureEight(_Closed):
    """An eight lying on its side, from its crossing.

    **Arguments:** `middle`: its crossing (x, y) [m]; `sizes`: half of its length, and
    half of its height, not negative [m]; `tilt`: of its length [rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> eight = fj.FigureEight([0, 0], [2, 1])
    >>> [eight.point(share).tolist() for share in (0, 0.25, 0.5)]
    [[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]
    """

    def point(self, share):
        sin, cos = sine_and_cosine(2 * np.pi * share)
        return self._placed(sin, 2 * sin * cos)


class Spline(Path):
    """A cubic spline through points, equally spaced in the share of the way.

    **Arguments:** `points`: three or more (x, y) [m]; `closed`: whether it leads from
    the last back to the first. An open one is straight at its ends.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.Spline([[0, 0], [1, 1], [2, 0]]).point(0.5).tolist()
    [1.0, 1.0]
    """

    points: Float[Array, "n 2"]
    bends: Float[Array, "n 2"]  # second derivatives per interval squared
    closed: bool = eqx.field(static=True)

    def __init__(self, points: ArrayLike, *, closed: bool = False):
        self.points = real_array("points", points, (None, 2))
        instance("closed", closed, bool)
        self.closed = closed
        count = len(self.points)
        if count < 3:
            raise ValueError(f"points: expected three or more, got {count}.")
        # The slopes of neighbouring cubics meet: b[k-1] + 4 b[k] + b[k+1] = 6 d2[k].
        rows = np.eye(count)
        matrix = 4 * rows + np.roll(rows, 1, axis=1) + np.roll(rows, -1, axis=1)
        p = in_numpy(self.points)
        xp = namespace(p)
        right = 6 * (xp.roll(p, 1, axis=0) - 2 * p + xp.roll(p, -1, axis=0))
        if not closed:
            ends = np.isin(np.arange(count), [0, count - 1])[:, None]
            matrix = np.where(ends, rows, matrix)
            right = xp.where(ends, 0, right)
        self.bends = jnp.asarray(xp.linalg.solve(matrix, right), dtype=float)

    @property
    def middle(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.points.mean(axis=0)

    def point(self, share):
        xp, count = namespace(self.points, share), len(self.points)
        share = xp.asarray(share)[..., None]
        if self.closed:
            place = xp.mod(share, 1) * count
            first = xp.minimum(xp.floor(place), count - 1)
        else:
            place = share * (count - 1)
            first = xp.clip(xp.floor(place), 0, count - 2)
        b, k = place - first, first[..., 0].astype(int)
        a, after = 1 - b, (k + 1) % count
        bend = (a**3 - a) * self.bends[k] + (b**3 - b) * self.bends[after]
        return a * self.points[k] + b * self.points[after] + bend / 6


class TipTask(eqx.Module):
    """A path of the tip, the last link keeping its angle.

    Called with `(t, linkage)` it gives the joint reference: the closed-form inverse
    kinematics and its exact rate. The wrist (where the last link starts) must not cross
    the half-line from the ground pivot away from the path's middle, where the angle of
    a turning arm would jump: `simulate` checks it.

    **Arguments:**

    - `path`: a `Path`: `Line`, `Ellipse`, `FigureEight`, `Spline` or one's own.
    - `timing`: a `Travel` or `Laps`, or any function of time to the share of the way.
    - `orientation`: th4, the absolute angle of the last link [rad].
    - `branch`: assembly of the arm, 1 or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments; `check`, and with it `simulate`, for
    a path out of the linkage's reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> line = fj.Line([-4, 2], [-3, 2])
    >>> task = fj.TipTask(line, fj.Travel(1.0), orientation=1.5707963)
    >>> q, qd = task(0.5, arm)
    >>> fj.tip_position(arm, q).tolist()
    [-3.5, 2.0]
    """

    path: Path
    timing: Any
    orientation: Float[Array, ""]
    branch: Float[Array, ""]

    def __init__(
        self,
        path: Path,
        timing: Travel | Laps | Any,
        *,
        orientation: ArrayLike = 0.0,
        branch: int = 1,
    ):
        instance("path", path, Path)
        if not callable(timing) or isinstance(timing, type):
            raise ValueError(f"timing: expected a Travel or Laps, got {timing!r}.")
        self.path, self.timing = path, timing
        self.orientation = real_array("orientation", orientation, ())
        self.branch = sign("branch", branch)

    def tip(self, t: ArrayLike) -> Float[Array, " 2"]:
        """The commanded tip position at time `t` [s]: (x, y) [m]."""
        return self.path.point(self.timing(real_array("t", t, ())))

    @property
    def evaluates_in_numpy(self) -> bool:
        """Whether `assembly` does; a subclass may move in another way."""
        return type(self) is TipTask

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, Array]:
        """Joint positions, and the root that is 0 at the edge of the reach."""
        q, root, _ = self._solved(t, linkage)
        return q, root

    def _solved(self, t: Array, linkage: Linkage) -> tuple[Array, Array, Array]:
        """The `assembly`, and the wrist's angle from the direction of the middle."""
        own = not {type(self.path), type(self.timing)} <= _IN_NUMPY
        if own and namespace(t) is np:
            with jax.ensure_compile_time_eval():  # also where others are traced
                points = _points_at(self.path, self.timing, jax.device_put(np.ravel(t)))
            tip: Any = np.asarray(points).reshape(*np.shape(t), 2)
        else:
            tip = self.path.point(self.timing(t))
        unmoved = unmoved_part(linkage, self.orientation)
        wrist, hub = tip - unmoved, in_numpy(self.path.middle) - unmoved
        across = hub[0] * wrist[..., 1] - hub[1] * wrist[..., 0]
        beside = plane_angle(across, wrist @ hub)
        middle = plane_angle(hub[1], hub[0])
        bearing = middle - 2 * np.pi * whole_turns(middle) + beside
        q, root = solve_joints(linkage, wrist, bearing, self.orientation, self.branch)
        return q, root, beside

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s]."""
        t = real_array("t", t, ())
        positions = lambda t: self.assembly(t, linkage)[0]
        return jax.jvp(positions, (t,), (jnp.ones_like(t),))

    @property
    def jump_ts(self) -> Array | None:
        """When the timing says that velocity or acceleration jump [s]."""
        return getattr(self.timing, "jump_ts", None)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raise ValueError where the tip leaves the reach between the times.

        Looked at at 1000 times, or 1000 of one lap; or where the wrist's angle jumps
        between two of them.
        """
        task, arm, ts = in_numpy((self, linkage, ts))
        end = ts[-1]
        if isinstance(self.timing, Laps):  # of which all are alike
            end = min(end, ts[0] + abs(task.timing.period))
        times = np.linspace(ts[0], end, 1000, dtype=ts.dtype)
        q, _, beside = task._solved(times, arm)
        inside = np.isfinite(q).all(axis=1)
        if not inside.all():
            raise ValueError(
                "reference: expected a path within the linkage's reach at orientation "
                f"{task.orientation:g} rad on branch {task.branch:+g}, got one that "
                f"leaves it at {times[inside.argmin()]:g} s."
            )
        hub = in_numpy(task.path.middle) - unmoved_part(arm, task.orientation)
        behind = (np.abs(np.diff(beside)) > np.pi).any()
        if behind or not hub.any():
            raise ValueError(
                "reference: expected a path that does not pass behind the ground "
                "pivot as seen from its middle, got one that does."
            )


# The paths and timings that NumPy evaluates.
_IN_NUMPY = {Line, Ellipse, FigureEight, Spline, Travel, Laps}


@eqx.filter_jit
def _points_at(path: Path, timing: Any, times: Array) -> Array:
    return jax.vmap(lambda t: path.point(timing(t)))(times)
