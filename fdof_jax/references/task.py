"""References along paths of the tip or on a circle, and moves of the joints."""

from abc import abstractmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import JOINT, is_traced, real_array, refusal
from ..base.known_values import at_once, in_numpy
from ..base.trigonometry import plane_angle, sincos
from ..linkage.fields import Condition, Values, called, default, field, of_kind
from ..linkage.frames import cross, dot, plane_vector, plane_vectors
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..mechanics.inverse_kinematics import (
    arm_of,
    beyond,
    check_moving_joints,
    solve_joints,
    whole_turns,
)
from .paths import Path, Spline
from .reference import Reference, reach
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
        """Returns positions, and 1: the reach has no edge."""
        return self.start + self.travel(t) * (self.end - self.start), 1.0


class SetPoint(Reference):
    """A constant set point: positions to hold, and optionally velocities.

    **Arguments:** one per joint, or one for all.

    - `q`: positions [m or rad].
    - `qd`: velocities for servos that take both, by default 0 [m/s or rad/s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> hold = fj.PDController(100, 10, 30, fj.references.SetPoint([0.1, 0.2, 0.3]))
    >>> hold(0.0, [0, 0, 0], [0, 0, 0], arm).tolist()
    [10.0, 20.0, 30.0]
    """

    q: Values = field(unit="m or rad")
    qd: Values = field(unit="m/s or rad/s", default=0.0)

    def __call__(self, t, linkage):
        joints = (joints_of(linkage),)
        return jnp.broadcast_to(self.q, joints), jnp.broadcast_to(self.qd, joints)


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
        """Returns the vector x + iy from the first joint to the wrist, and its angle.

        The angle is continuous in time. `base`: the rest of the vector to the tip.
        """

    def assembly(self, t, linkage):
        return self.solved(t, linkage)[:2]

    def solved(self, t: Array, linkage: Linkage) -> tuple[Array, Array, Array]:
        """Returns what `solve_joints` does."""
        arm = arm_of(linkage, self.orientation)
        return solve_joints(arm, *self.wrist_seen(t, arm.base), self.branch)

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Returns positions and velocities at time `t` [s].

        Out of reach, known arguments raise ValueError and traced ones return NaN.
        Velocities are not finite at the edge.
        """
        motion = super().__call__(t, linkage)
        if not (is_traced(motion) or np.isfinite(motion).all()):
            check_moving_joints(linkage, self.orientation is not None)
            tip = ", ".join(f"{x:.6g}" for x in self.tip(t))
            raise ValueError(
                f"t: expected a time at which the tip is within {self._reach()}, got "
                f"{np.asarray(t):g} s, at which it is at [{tip}] m"
                f"{self._beyond(linkage, t)}."
            )
        return motion

    def _reach(self) -> str:
        commanded = self.orientation is not None
        at = f" at orientation {self.orientation:g} rad" if commanded else ""
        return f"the linkage's reach{at} on branch {self.branch:+g}"

    def _beyond(self, linkage: Linkage, times: ArrayLike) -> str:
        """Says in messages how far the tip is out of reach at the times."""
        return beyond(_missing(self, linkage, np.atleast_1d(times)))


@at_once
def _missing(reference: TipReference, linkage: Linkage, times: Array) -> Array:
    return jax.vmap(lambda t: reference.solved(t, linkage)[2])(times)


def reach_margin(
    linkage: Linkage, task: TipReference, ts: ArrayLike
) -> Float[Array, " time"]:
    """Computes how far the tip is within the reach at the task's orientation [m].

    Out of reach, the margin is minus the distance from it. With two slides the reach
    has no edge: the margin is infinite, or -inf if they are parallel.

    **Arguments:** `linkage`; `task`: a `CircleTask` or a `TipTask`; `ts`: times (time,)
    [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> circle = fj.CircleTask(center=[-1, 2], radius=0.75)  # too near the base
    >>> fj.references.reach_margin(arm, circle, [0.0, 1.875, 2.5]).round(3).tolist()
    [1.016, -0.336, 0.031]
    """
    check_linkage(linkage)
    if not isinstance(task, TipReference):
        raise refusal("task", "a CircleTask or a TipTask", task)
    check_moving_joints(linkage, task.orientation is not None)
    return -_missing(task, linkage, real_array("ts", ts, (None,)))


class TipTask(TipReference):
    """A path of the tip on which the last link keeps its angle.

    A call with `(t, linkage)` returns the joint reference and its exact rate. The start
    of the last link must not pass behind the ground pivot as seen from the path's
    middle: a joint's angle would jump there.

    **Arguments:**

    - `path`: a `Path`, such as a `Line`.
    - `timing`: a `Travel` or `Laps`, or any function from time to the share of the way.
    - `orientation`: th4, the absolute angle of the last link [rad]; by default 0, None
      for an arm of two joints.
    - `branch`: assembly of the arm, 1 (default) or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments; in `simulate` and `check`, for a
    path out of reach or behind the pivot; in a call, for a tip out of reach.

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
        """Returns the commanded tip position (x, y) [m] at time `t` [s]."""
        return _tip(self, real_array("t", t, ()))

    def wrist_seen(self, t, base):
        """Returns the wrist and its angle, counted from that of the path's middle."""
        wrist = plane_vectors(self.path.point(self.timing(t))) - base
        hub = plane_vectors(self.path.middle) - base
        middle = plane_angle(hub.imag, hub.real)
        middle = middle - 2 * np.pi * whole_turns(middle)
        return wrist, middle + angle_between(hub, wrist)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError if the tip leaves the reach or the wrist's angle jumps.

        Both are checked at 1000 times or more between `ts[0]` and `ts[-1]`. The path of
        `Laps` has to be closed.
        """
        super().check(linkage, ts)
        check_moving_joints(linkage, self.orientation is not None)
        times, within, ahead, gap = in_numpy(_survey(self, linkage, ts))
        if not within.all():
            raise ValueError(
                f"reference: expected a path within {self._reach()}, got one that "
                f"leaves it at {times[within.argmin()]:g} s"
                f"{self._beyond(linkage, times)}."
            )
        if not ahead:
            raise ValueError(
                "reference: expected a path that does not pass behind the ground "
                "pivot as seen from its middle, got one that does."
            )
        if gap > _CLOSED:
            raise ValueError(
                "reference: expected a closed path for `Laps`, got one that ends "
                f"{gap:g} m from its start."
            )

    def fits(self, linkage, ts):
        ahead, gap = _way(self, linkage, _times(self, ts))
        return super().fits(linkage, ts) & ahead & (gap <= _CLOSED)


@at_once
def _tip(task: TipTask, t: Array) -> Array:
    return task.path.point(task.timing(t))


def _times(task: TipTask, ts: Array) -> Array:
    """Returns the times between the first and the last at which the path is checked."""
    timing, count = task.timing, _TIMES
    begin, end = ts[0], ts[-1]
    if isinstance(timing, Laps):  # all laps are alike
        end = jnp.minimum(end, begin + abs(timing.period))
    if type(timing) is Travel:  # it rests before and after
        travel = timing.begin, timing.begin + timing.duration
        begin, end = (jnp.clip(t, begin, end) for t in travel)
    if isinstance(task.path, Spline):
        count = max(count, _OF_CUBIC * len(task.path.points))
    times = jnp.linspace(begin, end, count)
    if type(timing) in (Laps, Travel):
        return times
    return times_of_moves(timing, times)


@at_once
def _survey(task: TipTask, linkage: Linkage, ts: Array) -> tuple[Array, ...]:
    """Returns times, whether the tip is within reach at each, and the `_way`."""
    times = _times(task, ts)
    return times, reach(task, linkage, times), *_way(task, linkage, times)


def _way(task: TipTask, linkage: Linkage, times: Array) -> tuple[Array, Array]:
    """Returns whether the wrist never passes behind the pivot, and a lap's gap [m]."""
    gap = jnp.zeros(())
    base = arm_of(linkage, task.orientation).base
    wrist = lambda t: task.wrist_seen(t, base)
    _, bearing = jax.vmap(wrist)(times)
    jumps = abs(jnp.diff(bearing)) > np.pi
    ahead = ~jumps.any() & (plane_vectors(task.path.middle) != base)
    if isinstance(task.timing, Laps):
        gap = abs(wrist(times[0] + task.timing.period)[0] - wrist(times[0])[0])
    return ahead, gap


class CircleTask(TipReference):
    """A circle traced by the tip at constant speed; the last link keeps its angle.

    A call with `(t, linkage)` returns the joint reference and its exact rate,
    continuous in time even if the circle winds around the base, as no `TipTask` may. At
    t = 0 it equals `inverse_kinematics`. The paper does not print the circle of Fig 7:
    the default is our choice.

    **Arguments:**

    - `center`: (x, y) [m].
    - `radius`: not negative [m].
    - `period`: time of one turn, counter-clockwise if positive, not zero [s].
    - `phase`: direction of the starting point from the centre [rad]; by default pi.
    - `orientation`: th4, the absolute angle of the last link [rad]; by default pi/2.
    - `branch`: assembly of the arm, 1 (default) or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments; in `simulate` and `check`, for a
    circle out of reach; in a call, for a tip out of reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> circle = fj.CircleTask(center=[-4, 2], radius=0.75, period=5)
    >>> q, qd = circle(0.0, arm)
    >>> circle.tip(0.0).tolist(), fj.tip_position(arm, q).tolist()
    ([-4.75, 2.0], [-4.75, 2.0])
    """

    center: Values = field((2,), unit="m", default=(-4.0, 2.0))
    radius: Values = field((), unit="m", minimum=0, default=0.75)
    period: Values = field((), unit="s", default=5.0)
    phase: Values = field((), unit="rad", default=np.pi)
    orientation: Values = field((), unit="rad", default=np.pi / 2)
    branch: Values = field((), unit="", default=1)

    def conditions(self):
        yield from super().conditions()
        yield Condition(self.period != 0, "period", "not zero", (self.period,))

    def tip(self, t: ArrayLike) -> Float[Array, " 2"]:
        """Returns the commanded tip position (x, y) [m] at time `t` [s]."""
        return _circle_tip(self, real_array("t", t, ()))

    def wrist_seen(self, t, base):
        """Returns the wrist and its angle, which starts within a turn."""
        # Two calls: in a motion, XLA computes what is the same in all steps once.
        _, first = self._unwound(jnp.zeros_like(t), base)
        wrist, bearing = self._unwound(t, base)
        return wrist, bearing - 2 * np.pi * whole_turns(first)

    def _unwound(self, t: Array, base: Array) -> tuple[Array, Array]:
        """Returns the wrist and its angle, to any number of turns."""
        hub, (angle, ray) = plane_vector(*self.center) - base, _ray(self, t)
        # The angle of the larger vector, to the centre or from there, is continuous.
        # The smaller one adds at most a quarter turn.
        around = self.radius**2 > dot(hub, hub)
        larger = jnp.where(around, ray, hub)
        angle = jnp.where(around, angle, plane_angle(hub.imag, hub.real))
        wrist = hub + ray
        return wrist, angle + angle_between(larger, wrist)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError if the tip leaves the linkage's reach between the times."""
        check_moving_joints(linkage, oriented=True)
        times, within = in_numpy(_circle_survey(self, linkage, ts))
        if not within.all():
            raise ValueError(
                f"reference: expected a circle within {self._reach()}, got center "
                f"{self.center.tolist()} and radius {self.radius:g} m"
                f"{self._beyond(linkage, times)}."
            )


# A function, because each access to a method of an equinox module creates an object.
def _ray(circle: CircleTask, t: Array) -> tuple[Array, Array]:
    """Returns the angle and the vector from the centre to the tip."""
    angle = circle.phase + 2 * np.pi * t / circle.period
    sin, cos = sincos(angle)
    return angle, plane_vector(circle.radius * cos, circle.radius * sin)


@at_once
def _circle_tip(circle: CircleTask, t: Array) -> Array:
    _, ray = _ray(circle, t)
    return circle.center + jnp.stack([ray.real, ray.imag])


@at_once
def _circle_survey(
    circle: CircleTask, linkage: Linkage, ts: Array
) -> tuple[Array, Array]:
    """Returns times of one turn, at most of the run, and whether each is in reach."""
    begin, turn = ts[0], abs(circle.period)
    arm = arm_of(linkage, circle.orientation)
    hub = plane_vector(*circle.center) - arm.base
    # The reach ends first where the wrist is nearest to or farthest from the base, or
    # along a direction that the ground or the last link fixes.
    fixed = arm.angle[0], circle.orientation - arm.locked[2]
    directions = jnp.stack([jnp.angle(hub), *fixed])
    lead = jnp.append(directions, directions + np.pi) - circle.phase
    extremes = begin + (lead / (2 * np.pi) * circle.period - begin) % turn
    times = jnp.linspace(begin, jnp.minimum(ts[-1], begin + turn), 257)
    times = jnp.append(times, jnp.minimum(extremes, ts[-1]))
    return times, reach(circle, linkage, times)
