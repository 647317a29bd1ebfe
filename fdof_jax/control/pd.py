"""Joint control of the third example (Fig 7): saturated PD and the circle it tracks."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..checks import concrete, is_traced, real_array, sign
from ..forces.element import ScalarElement
from ..linkage.linkage import Linkage, check_linkage
from ..mechanics.kinematics import (
    plane_angle,
    solve_joints,
    tip_position,
    unmoved_part,
    whole_turns,
)
from ..xla.array_namespace import in_numpy, namespace, sine_and_cosine

if TYPE_CHECKING:
    from ..simulation.solution import Solution

Reference = Callable[[Array, Linkage], tuple[Array, Array]]


def checked_reference(value: Any) -> Any:
    """`value` if it can be called as a reference, else ValueError."""
    if not callable(value) or isinstance(value, type):
        raise ValueError(
            "reference: expected a callable (t, linkage) -> (q, qd), for instance "
            f"CircleTask(), got {value!r}."
        )
    return value


def reference_motion(
    reference: Reference, t: Array, linkage: Linkage
) -> tuple[Array, Array]:
    """What a reference returns, refused unless it is positions and velocities (3,)."""
    motion = reference(t, linkage)
    if not isinstance(motion, tuple) or len(motion) != 2:
        raise ValueError(
            f"reference: expected it to return (q_ref, qd_ref), got {motion!r}."
        )
    q_ref, qd_ref = (real_array("reference", m, (3,)) for m in motion)
    return q_ref, qd_ref


class PDController(ScalarElement):
    """Saturated PD control of the joints, as in Fig 7: a force element.

    The effort is kp * (q_ref - q) + kd * (qd_ref - qd), clipped to +-limit as a whole.
    The position error is never wrapped: a start one turn away unwinds. The derivative
    of an effort beyond its limit is zero, and that of one just at it is not.

    **Arguments:** all in joint order, one per joint or one for all.

    - `kp`: proportional gains, not negative [N/m or N m/rad].
    - `kd`: gains of the error rate, not negative [N s/m or N m s/rad].
    - `limit`: largest effort [N or N m], may be infinite.
    - `reference`: a pytree called as `(t, linkage) -> (q_ref, qd_ref)`.

    **Raises:** ValueError for malformed or negative gains and limits, and for a
    reference that cannot be called.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> task = fj.CircleTask()
    >>> pd = fj.PDController(kp=100, kd=10, limit=30, reference=task)
    >>> q, qd = task(0.0, arm)
    >>> pd(0.0, q - 0.2, qd, arm).tolist(), pd(0.0, q - 0.5, qd, arm).tolist()
    ([20.0, 20.0, 20.0], [30.0, 30.0, 30.0])
    """

    kp: Float[Array, " joint"]
    kd: Float[Array, " joint"]
    limit: Float[Array, " joint"]
    reference: Reference

    # Units of kp and kd by the kind of joint.
    gain_units: ClassVar = {"R": ("N m/rad", "N m s/rad"), "P": ("N/m", "N s/m")}

    def __init__(
        self,
        kp: ArrayLike,
        kd: ArrayLike,
        limit: ArrayLike,
        reference: Reference,
    ):
        self.kp = real_array("kp", kp, (3,), minimum=0, broadcast=True)
        self.kd = real_array("kd", kd, (3,), minimum=0, broadcast=True)
        self.limit = real_array(
            "limit", limit, (3,), minimum=0, finite=False, broadcast=True
        )
        self.reference = checked_reference(reference)

    def schedule(self, t: Array, linkage: Linkage) -> tuple[Any, ...]:
        """The reference motion, which does not depend on the state: (q_ref, qd_ref)."""
        return reference_motion(self.reference, t, linkage)

    def respond(self, scheduled, q, qd, linkage):
        # The derivative of jnp.clip at the limit is the mean of both sides'.
        return tuple(
            jnp.where(jnp.abs(effort) <= limit, effort, jnp.clip(effort, -limit, limit))
            for effort, limit in zip(
                self.unlimited(scheduled, q, qd, linkage), self.limit
            )
        )

    def unlimited(
        self, scheduled: Any, q: Any, qd: Any, linkage: Linkage
    ) -> tuple[Array, ...]:
        """The efforts before they are limited; a subclass adds to them."""
        return tuple(
            kp * (position - q) + kd * (velocity - qd)
            for kp, kd, position, velocity, q, qd in zip(
                self.kp, self.kd, *scheduled, q, qd
            )
        )

    def demand(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """The effort before it is limited, (3,) [N or N m]."""
        return jnp.stack(self.unlimited(self.schedule(t, linkage), q, qd, linkage))

    @property
    def jump_ts(self) -> Array | None:
        """The times at which the reference says that it jumps, if it does."""
        return getattr(self.reference, "jump_ts", None)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """The constructor's check again, then the reference's own, if it has one."""
        # `equinox.tree_at` asks no constructor.
        PDController(self.kp, self.kd, self.limit, self.reference)
        check_reference: Any = getattr(self.reference, "check", None)
        if check_reference is not None:
            check_reference(linkage, ts)

    def possible(self) -> Array:
        """Whether gains and limits are not negative."""
        return ((self.kp >= 0) & (self.kd >= 0) & (self.limit >= 0)).all()


class CircleTask(eqx.Module):
    """A circle traced by the tip at constant speed, the last link keeping its angle.

    Called with `(t, linkage)` it gives the joint reference: the closed-form inverse
    kinematics and its exact rate. The reference is continuous in time, also where the
    path crosses the negative x axis or winds around the base; at t = 0 it is that of
    `inverse_kinematics`.

    Fig 7 does not print its circle: the default is our choice. It lies inside the reach
    of the figure's arm and starts 0.25 m from the arm's tip, because the text speaks
    of an initial offset.

    **Arguments:**

    - `center`: (x, y) [m].
    - `radius`: not negative [m].
    - `period`: time of one turn, counter-clockwise if positive, not zero [s].
    - `phase`: direction of the starting point as seen from the centre [rad].
    - `orientation`: th4, the absolute angle of the last link [rad].
    - `branch`: assembly of the arm, 1 or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments; `check`, and with it `simulate`, for
    a circle out of the linkage's reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> circle = fj.CircleTask(center=[-4, 2], radius=0.75, period=5)
    >>> q, qd = circle(0.0, arm)
    >>> circle.tip(0.0).tolist(), fj.tip_position(arm, q).tolist()
    ([-4.75, 2.0], [-4.75, 2.0])
    """

    center: Float[Array, " 2"]
    radius: Float[Array, ""]
    period: Float[Array, ""]
    phase: Float[Array, ""]
    orientation: Float[Array, ""]
    branch: Float[Array, ""]

    def __init__(
        self,
        center: ArrayLike = (-4.0, 2.0),
        radius: ArrayLike = 0.75,
        period: ArrayLike = 5.0,
        phase: ArrayLike = np.pi,
        orientation: ArrayLike = np.pi / 2,
        branch: int = 1,
    ):
        self.center = real_array("center", center, (2,))
        self.radius = real_array("radius", radius, (), minimum=0)
        self.period = real_array("period", period, ())
        if (given := concrete(self.period)) is not None and given == 0:
            raise ValueError("period: expected a time other than 0 s, got 0.")
        self.phase = real_array("phase", phase, ())
        self.orientation = real_array("orientation", orientation, ())
        self.branch = sign("branch", branch)

    @property
    def evaluates_in_numpy(self) -> bool:
        """Whether `assembly` does; a subclass may move along another curve."""
        return type(self) is CircleTask

    def tip(self, t: ArrayLike) -> Float[Array, " 2"]:
        """The commanded tip position at time `t` [s]: (x, y) [m]."""
        return _on_circle(self, real_array("t", t, ()))

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, Array]:
        """Joint positions, and the root that is 0 at the edge of the reach."""
        unmoved = unmoved_part(linkage, self.orientation)
        wrist, hub = _on_circle(self, t) - unmoved, self.center - unmoved
        turns = whole_turns(_bearing(self, 0.0, hub))
        bearing = _bearing(self, t, hub) - 2 * np.pi * turns
        return solve_joints(linkage, wrist, bearing, self.orientation, self.branch)

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s]."""
        check_linkage(linkage)
        t = real_array("t", t, ())
        positions = lambda t: self.assembly(t, linkage)[0]
        return jax.jvp(positions, (t,), (jnp.ones_like(t),))

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raise ValueError if the tip leaves the linkage's reach between the times.

        Or for values that the constructor refuses.
        """
        CircleTask(
            self.center, self.radius, self.period, self.phase, self.orientation,
            int(self.branch),
        )  # fmt: skip
        task, arm, ts = in_numpy((self, linkage, ts))
        start, end, period = float(ts[0]), float(ts[-1]), float(task.period)
        turn = abs(period)
        # The reach ends first where the wrist is nearest to or farthest from the base,
        # or along a direction that the ground or the last link fixes.
        hub = task.center - unmoved_part(arm, task.orientation)
        directions = np.array(
            [np.arctan2(hub[1], hub[0]), arm.base_angle,
             task.orientation - arm.locked[2]]
        )  # fmt: skip
        lead = np.concatenate([directions, directions + np.pi]) - task.phase
        extremes = start + (lead / (2 * np.pi) * period - start) % turn
        times = np.linspace(start, min(end, start + turn), 257)
        times = np.append(times, np.minimum(extremes, end))
        if not _known_reach(self, linkage, times.astype(ts.dtype)).all():
            raise ValueError(
                "reference: expected a circle within the linkage's reach at "
                f"orientation {task.orientation:g} rad on branch {task.branch:+g}, got "
                f"center {task.center.tolist()} and radius {task.radius:g} m."
            )


# Functions, because a call of a module's method makes an object each time.


def _turned(circle: CircleTask, t: Array | float) -> tuple[Array, Array, Array]:
    """Direction from the centre: its angle, cosine and sine."""
    angle = circle.phase + 2 * np.pi * t / circle.period
    sin, cos = sine_and_cosine(angle)
    return angle, cos, sin


def _on_circle(circle: CircleTask, t: Array) -> Array:
    """Points of the circle, (..., 2)."""
    _, cos, sin = _turned(circle, t)
    return circle.center + circle.radius * namespace(cos).stack([cos, sin], axis=-1)


def _bearing(circle: CircleTask, t: Array | float, hub: Array) -> Array:
    """Angle of hub + radius * (cos, sin)(turned) without jumps.

    The larger of the two vectors carries the angle; the smaller one adds less than
    a quarter turn, for which the arctangent has no jump.
    """
    turned, cos, sin = _turned(circle, t)
    xp, radius = namespace(turned, hub), circle.radius
    along, across = hub[0] * cos + hub[1] * sin, hub[1] * cos - hub[0] * sin
    square = hub[0] ** 2 + hub[1] ** 2
    around = radius**2 > square
    carrier = xp.where(around, turned, plane_angle(hub[1], hub[0]))
    return carrier + plane_angle(
        xp.where(around, across, -radius * across),
        xp.where(around, radius + along, square + radius * along),
    )


def known_assembly(
    reference: Any, linkage: Linkage, times: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """The `assembly` of a reference that evaluates in NumPy, at known times."""
    reference, linkage = in_numpy((reference, linkage))
    return reference.assembly(np.asarray(times), linkage)


def positions_at(reference: Any, t: Array, linkage: Linkage) -> Any:
    """Positions of a reference: by NumPy if they are known and it can."""
    numpy = getattr(reference, "evaluates_in_numpy", False)
    if numpy and not is_traced(reference, t, linkage):
        return known_assembly(reference, linkage, t)[0]
    return reference_motion(reference, t, linkage)[0]


def _known_reach(reference: Any, linkage: Linkage, times: ArrayLike) -> np.ndarray:
    """`reachable` of known values."""
    if getattr(reference, "evaluates_in_numpy", False):
        q, root = known_assembly(reference, linkage, times)
        return np.isfinite(q).all(axis=1) & (root != 0)
    with jax.ensure_compile_time_eval():  # also where others are traced
        return np.asarray(_finite(reference, linkage, times))


@eqx.filter_jit
def _finite(reference: Reference, linkage: Linkage, times: ArrayLike) -> Array:
    motion = jax.vmap(lambda t: reference(t, linkage))(times)
    return jnp.isfinite(jnp.concatenate(motion, axis=1)).all(axis=1)


def reachable(
    linkage: Linkage, reference: Reference, ts: ArrayLike
) -> Bool[Array, " time"]:
    """Whether a linkage can be where a reference wants it, at each time.

    **Arguments:** the linkage; `reference`: a `CircleTask` or `TipTask` for instance;
    `ts`: times (time,) [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> circle = fj.CircleTask(center=[-1, 2], radius=0.75)  # too near the base
    >>> fj.reachable(arm, circle, [0.0, 1.875, 2.5]).tolist()
    [True, False, True]
    """
    check_linkage(linkage)
    ts = real_array("ts", ts, (None,))
    arguments = checked_reference(reference), linkage, ts
    if is_traced(arguments):
        return _finite(*arguments)
    return jax.device_put(_known_reach(*arguments))


@eqx.filter_jit
def saturated(
    controller: PDController, linkage: Linkage, solution: "Solution"
) -> Bool[Array, "time joint"]:
    """Whether each actuator is at its limit, along a motion.

    **Arguments:** a controller, and a solution that it took part in.
    """
    demand = jax.vmap(controller.demand, in_axes=(0, 0, 0, None))(
        solution.ts, solution.q, solution.qd, linkage
    )
    return jnp.abs(demand) > controller.limit[None]


@eqx.filter_jit
def tip_deviation(
    linkage: Linkage, task: CircleTask, solution: "Solution"
) -> Float[Array, "time 2"]:
    """From the commanded to the actual tip along a motion [m].

    **Arguments:** a linkage, the task (anything with `tip(t)`), and a solution.
    """
    actual = jax.vmap(tip_position, in_axes=(None, 0))(linkage, solution.q)
    return actual - jax.vmap(task.tip)(solution.ts)
