"""References along paths of the tip, and moves of the joints."""

from abc import abstractmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.array_namespace import in_numpy, namespace, plane_vectors
from ..base.checks import JOINT, is_traced, real_array
from ..linkage.fields import Condition, Values, called, default, field, of_kind
from ..linkage.frames import cross, dot
from ..linkage.linkage import Linkage
from ..mechanics.inverse_kinematics import (
    arm_of,
    known_directions,
    plane_angle,
    solve_joints,
    unmoved_part,
    whole_turns,
)
from .paths import Path, Spline, points_at
from .reference import Reference, runs_in_numpy
from .timing import Laps, Travel, times_of_moves

# Times at which a path is checked, and those of each cubic of a long spline.
_TIMES, _OF_CUBIC = 1000, 10
_CLOSED = 1e-3  # laps that end as near to their start are closed [m]


class JointMove(Reference):
    """A move of all joints from one position to another, in step.

    **Arguments:** `start`, `end`: joint positions [m or rad]; `travel`: a `Travel`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> move = fj.references.JointMove([0, 0, 0], [1, 2, 3], fj.references.Travel(2.0))
    >>> q, qd = move(1.0, arm)
    >>> q.tolist(), qd.tolist()  # halfway, at 15/8 of the mean speed
    ([0.5, 1.0, 1.5], [0.938, 1.875, 2.812])
    """

    start: Values = field((JOINT,), unit="m or rad")
    end: Values = field((JOINT,), unit="m or rad")
    travel: Travel = of_kind(Travel)

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, float]:
        """Joint positions, and 1 as the root: a joint move has no edge of a reach."""
        share = self.travel(t)[..., None]
        return self.start + share * (self.end - self.start), 1.0


def angle_between(a: Array, b: Array) -> Array:
    """Computes the angle from the vector `a` to `b`, in [-pi, pi]."""
    return plane_angle(cross(a, b), dot(a, b))


class TipReference(Reference):
    """A motion of the tip on which the last link keeps its angle."""

    orientation = default(lambda self: 0.0)
    branch = default(lambda self: 1.0)

    def conditions(self):
        yield Condition(abs(self.branch) == 1, "branch", "1 or -1", (self.branch,))

    @abstractmethod
    def wrist_seen(self, t: Array, base: Array) -> tuple[Array, Array]:
        """Returns vectors x + iy from the first joint to the wrist, and their angles.

        `base`: the rest of the vector to the tip. The angles are continuous in time.
        """

    def assembly(self, t, linkage):
        arm, placed = arm_of(linkage, self.orientation is not None)
        directions = known_directions(arm, self.direction)
        seen = self.wrist_seen(t, unmoved_part(arm, directions))
        q, root = solve_joints(arm, directions, *seen, self.branch)
        return placed(q), root

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s].

        Out of reach, or for an arm with another number of joints, raises ValueError for
        known arguments and returns NaN for traced ones. At the edge of the reach the
        velocities are not finite.
        """
        motion = super().__call__(t, linkage)
        if not (is_traced(motion) or np.isfinite(motion).all()):
            arm_of(linkage, self.orientation is not None)  # another number of joints
            tip = np.round(self.tip(t), 6)
            raise ValueError(
                f"t: expected a time at which the tip is within {self._reach()}, got "
                f"{np.asarray(t):g} s, at which it is at {tip.tolist()} m."
            )
        return motion

    def _reach(self) -> str:
        """Names the reach in messages."""
        commanded = self.orientation is not None
        at = f" at orientation {self.direction:g} rad" if commanded else ""
        return f"the linkage's reach{at} on branch {self.branch:+g}"

    @property
    def direction(self) -> Any:
        """The last link's absolute angle, or 0 where none is commanded [rad]."""
        return 0.0 if self.orientation is None else self.orientation


class TipTask(TipReference):
    """A path of the tip on which the last link keeps its angle.

    A call with `(t, linkage)` returns the joint reference, computed by the closed-form
    inverse kinematics and its exact rate. The wrist (where the last link starts) must
    not cross the half-line from the ground pivot away from the path's middle, where the
    angle of a turning arm would jump; `simulate` checks this.

    **Arguments:**

    - `path`: a `Path`: `Line`, `Ellipse`, `FigureEight`, `Spline` or your own subclass.
    - `timing`: a `Travel` or `Laps`, or any function from time to the share of the way.
    - `orientation`: the absolute angle of the last link [rad], th4 in the paper; None
      for an arm of two joints, whose last link turns as it must.
    - `branch`: assembly of the arm, 1 or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments. `check`, and so `simulate`, raises
    it for a path out of the linkage's reach, and a call where the tip is out of it.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> line = fj.references.Line([-4, 2], [-3, 2])
    >>> task = fj.TipTask(line, fj.references.Travel(1.0), orientation=1.5707963)
    >>> q, qd = task(0.5, arm)
    >>> fj.tip_position(arm, q).tolist()
    [-3.5, 2.0]
    """

    path: Path = of_kind(Path)
    timing: Any = called("a Travel or Laps")
    orientation: Any = field((), unit="rad", optional=True, default=0.0, kw_only=True)
    branch: Values = field((), unit="", default=1, kw_only=True)

    def conditions(self):
        yield from super().conditions()
        known, expected = self.path.middle is not None, "a Path that defines `middle`"
        yield Condition(known, "path", f"{expected}, a point (x, y)", (self.path,))

    def tip(self, t: ArrayLike) -> Float[Array, " 2"]:
        """The commanded tip position at time `t` [s]: (x, y) [m]."""
        return self.path.point(self.timing(real_array("t", t, ())))

    def wrist_seen(self, t, base):
        """The wrist and its angle, as the angle from the path's middle and its own."""
        if namespace(t) is np and not runs_in_numpy(self.path, self.timing):
            with jax.ensure_compile_time_eval():  # also within transformations
                points = points_at(self.path, self.timing, jax.device_put(np.ravel(t)))
            tip: Any = np.asarray(points).reshape(*np.shape(t), 2)
        else:
            tip = self.path.point(self.timing(t))
        wrist = plane_vectors(tip) - base
        hub = plane_vectors(in_numpy(self.path.middle)) - base
        middle = plane_angle(hub.imag, hub.real)
        middle = middle - 2 * np.pi * whole_turns(middle)
        return wrist, middle + angle_between(hub, wrist)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError if the tip leaves the reach or the wrist's angle jumps.

        Both are checked at 1000 times or more between `ts[0]` and `ts[-1]`: those of
        a `Travel`, at most one lap of `Laps`. For a timing of another kind, they are
        1000 times of all of the run, and as many at which the share of the way changes
        between these. The path of `Laps` has to be closed.
        """
        super().check(linkage, ts)
        task, arm, ts = in_numpy((self, linkage, ts))
        three, directions, base = task._placed(arm)
        times = task._times(ts)
        wrist, bearing = task.wrist_seen(times, base)
        q, root = solve_joints(three, directions, wrist, bearing, task.branch)
        inside = np.isfinite(q).all(axis=1) & (root != 0)
        if not inside.all():
            raise ValueError(
                f"reference: expected a path within {task._reach()}, got one that "
                f"leaves it at {times[inside.argmin()]:g} s."
            )
        if not task._ahead(bearing, base):
            raise ValueError(
                "reference: expected a path that does not pass behind the ground "
                "pivot as seen from its middle, got one that does."
            )
        gap = task._gap(lambda t: task.wrist_seen(t, base)[0], ts)
        if gap > _CLOSED:
            raise ValueError(
                "reference: expected a closed path for `Laps`, got one that ends "
                f"{gap:g} m from its start."
            )

    def fits(self, linkage, ts):
        _, _, base = self._placed(linkage)
        seen, times = lambda t: self.wrist_seen(t, base), self._times(ts)
        each = seen if namespace(times) is np else jax.vmap(seen)
        _, bearing = each(times)
        closed = self._gap(lambda t: seen(t)[0], ts) <= _CLOSED
        return super().fits(linkage, ts) & self._ahead(bearing, base) & closed

    def _placed(self, linkage: Linkage) -> tuple[Any, Any, Array]:
        """Returns the arm, its known directions, and what a wrist lacks to the tip."""
        arm, _ = arm_of(linkage, self.orientation is not None)
        directions = known_directions(arm, self.direction)
        return arm, directions, unmoved_part(arm, directions)

    def _times(self, ts: Array) -> Any:
        """Returns times between the first and the last at which the path is checked."""
        timing, xp, count = self.timing, namespace(self, ts), _TIMES
        begin, end = ts[0], ts[-1]
        if isinstance(timing, Laps):  # all laps are alike
            end = xp.minimum(end, begin + abs(timing.period))
        if type(timing) is Travel:  # it rests before and after
            travel = timing.begin, timing.begin + timing.duration
            begin, end = (xp.clip(t, begin, end) for t in travel)
        if isinstance(self.path, Spline):
            count = max(count, _OF_CUBIC * len(self.path.points))
        times = xp.linspace(begin, end, count, dtype=ts.dtype)
        if runs_in_numpy(timing):
            return times
        if xp is jnp:
            return times_of_moves(timing, times)
        with jax.ensure_compile_time_eval():
            return np.asarray(times_of_moves(timing, jax.device_put(times)))

    def _ahead(self, bearing: Array, base: Array) -> Any:
        """Returns whether the wrist never passes behind the ground pivot."""
        jumps = abs(namespace(bearing).diff(bearing)) > np.pi
        return ~jumps.any() & (plane_vectors(in_numpy(self.path.middle)) != base)

    def _gap(self, wrist: Any, ts: Array) -> Any:
        """Returns how far a lap ends from its start [m], 0 without laps."""
        if not isinstance(self.timing, Laps):
            return 0.0
        return abs(wrist(ts[0] + self.timing.period) - wrist(ts[0]))
