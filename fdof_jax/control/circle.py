"""The circle of Fig 7."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, real_array, sign
from ..linkage.linkage import Linkage, check_linkage
from ..mechanics.inverse_kinematics import (
    known_directions,
    plane_angle,
    solve_joints,
    unmoved_part,
    whole_turns,
)
from ..xla.array_namespace import in_numpy, namespace, sine_and_cosine
from .reference import known_reach


class CircleTask(eqx.Module):
    """A circle traced by the tip at constant speed; the last link keeps its angle.

    A call with `(t, linkage)` returns the joint reference, computed by the closed-form
    inverse kinematics and its exact rate. The reference is continuous in time, also
    where the path crosses the negative x axis or winds around the base. At t = 0 it
    equals that of `inverse_kinematics`.

    The circle of Fig 7 is not printed in the paper: the default is our choice. It lies
    inside the reach of the figure's arm and starts 0.25 m from the arm's tip, because
    the text mentions an initial offset.

    **Arguments:**

    - `center`: (x, y) [m].
    - `radius`: not negative [m].
    - `period`: time of one turn, counter-clockwise if positive, not zero [s].
    - `phase`: direction of the starting point as seen from the centre [rad].
    - `orientation`: th4, the absolute angle of the last link [rad].
    - `branch`: assembly of the arm, 1 or -1: see `inverse_kinematics`.

    **Raises:** ValueError for malformed arguments. `check`, and so `simulate`, raises
    it for a circle out of the linkage's reach.

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
        """Returns whether `assembly` runs in NumPy; a subclass may not."""
        return type(self) is CircleTask

    def tip(self, t: ArrayLike) -> Float[Array, " 2"]:
        """The commanded tip position at time `t` [s]: (x, y) [m]."""
        _, cos, sin = _turned(self, real_array("t", t, ()))
        return _on_circle(self, cos, sin)

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, Array]:
        """Joint positions, and the root that is 0 at the edge of the reach."""
        directions = known_directions(linkage, self.orientation)
        unmoved = unmoved_part(linkage, directions)
        hub = self.center - unmoved
        xp = namespace(t, self.phase)
        turned = _turned(self, xp.stack([t, xp.zeros_like(t)]))
        bearing, at_start = _bearing(self, turned, hub)
        bearing = bearing - 2 * np.pi * whole_turns(at_start)
        _, cos, sin = (values[0] for values in turned)
        wrist = _on_circle(self, cos, sin) - unmoved
        return solve_joints(linkage, directions, wrist, bearing, self.branch)

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s]."""
        check_linkage(linkage)
        t = real_array("t", t, ())
        positions = lambda t: self.assembly(t, linkage)[0]
        return jax.jvp(positions, (t,), (jnp.ones_like(t),))

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError if the tip leaves the linkage's reach between the times.

        The constructor's checks are repeated first.
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
        hub = task.center - unmoved_part(arm, known_directions(arm, task.orientation))
        directions = np.array(
            [np.arctan2(hub[1], hub[0]), arm.base_angle,
             task.orientation - arm.locked[2]]
        )  # fmt: skip
        lead = np.concatenate([directions, directions + np.pi]) - task.phase
        extremes = start + (lead / (2 * np.pi) * period - start) % turn
        times = np.linspace(start, min(end, start + turn), 257)
        times = np.append(times, np.minimum(extremes, end))
        if not known_reach(self, linkage, times.astype(ts.dtype)).all():
            raise ValueError(
                "reference: expected a circle within the linkage's reach at "
                f"orientation {task.orientation:g} rad on branch {task.branch:+g}, got "
                f"center {task.center.tolist()} and radius {task.radius:g} m."
            )


# Functions, because each access to a method of an equinox module creates an object.


def _turned(circle: CircleTask, t: Array) -> tuple[Array, Array, Array]:
    """Angle, cosine and sine of the direction from the centre at times `t`."""
    angle = circle.phase + 2 * np.pi * t / circle.period
    sin, cos = sine_and_cosine(angle)
    return angle, cos, sin


def _on_circle(circle: CircleTask, cos: Array, sin: Array) -> Array:
    """Points of the circle, (..., 2)."""
    return circle.center + circle.radius * namespace(cos).stack([cos, sin], axis=-1)


def _bearing(circle: CircleTask, turned: tuple, hub: Array) -> Array:
    """Angle of hub + radius * (cos, sin), without jumps.

    The angle of the larger of the two vectors is continuous. The smaller one adds at
    most a quarter turn, over which the arctangent does not jump.
    """
    angle, cos, sin = turned
    xp, radius = namespace(angle, hub), circle.radius
    along, across = hub[0] * cos + hub[1] * sin, hub[1] * cos - hub[0] * sin
    square = hub[0] ** 2 + hub[1] ** 2
    around = radius**2 > square
    carrier = xp.where(around, angle, plane_angle(hub[1], hub[0]))
    return carrier + plane_angle(
        xp.where(around, across, -radius * across),
        xp.where(around, radius + along, square + radius * along),
    )
