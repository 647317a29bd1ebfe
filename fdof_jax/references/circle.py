"""The circle of Fig 7: no `TipTask`, as its path may wind around the base."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.array_namespace import in_numpy, namespace, plane_vector, sine_and_cosine
from ..base.checks import real_array
from ..linkage.fields import Condition, Values, field
from ..linkage.frames import dot
from ..linkage.linkage import Linkage
from ..mechanics.inverse_kinematics import (
    arm_of,
    known_directions,
    plane_angle,
    unmoved_part,
    whole_turns,
)
from .reference import known_reach
from .task import TipReference, angle_between


class CircleTask(TipReference):
    """A circle traced by the tip at constant speed; the last link keeps its angle.

    A call with `(t, linkage)` returns the joint reference, computed by the closed-form
    inverse kinematics and its exact rate. The reference is continuous in time, also
    where the path winds around the base, which no `TipTask` may do. At t = 0 it equals
    that of `inverse_kinematics`.

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
    it for a circle out of the linkage's reach, and a call where the tip is out of it.

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
        """The commanded tip position at time `t` [s]: (x, y) [m]."""
        _, ray = _ray(self, real_array("t", t, ()))
        return self.center + jnp.stack([ray.real, ray.imag])

    def wrist_seen(self, t, base):
        """The wrist and its angle, which starts within a turn.

        The angle of the larger vector, to the centre or from there, is continuous. The
        smaller one adds at most a quarter turn.
        """
        xp, hub = namespace(t, self.phase), plane_vector(*self.center) - base
        angle, ray = _ray(self, xp.stack([t, xp.zeros_like(t)]))
        around = self.radius**2 > dot(hub, hub)
        larger = xp.where(around, ray, hub)
        angle = xp.where(around, angle, plane_angle(hub.imag, hub.real))
        wrist = hub + ray
        bearing = angle + angle_between(larger, wrist)
        return wrist[0], bearing[0] - 2 * np.pi * whole_turns(bearing[1])

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError if the tip leaves the linkage's reach between the times."""
        task, arm, ts = in_numpy((self, linkage, ts))
        start, end, period = float(ts[0]), float(ts[-1]), float(task.period)
        turn = abs(period)
        # The reach ends first where the wrist is nearest to or farthest from the base,
        # or along a direction that the ground or the last link fixes.
        three, _ = arm_of(arm)
        base = unmoved_part(three, known_directions(three, task.orientation))
        hub = plane_vector(*task.center) - base
        directions = np.array(
            [np.angle(hub), three.base_angle, task.orientation - three.angle[2]]
        )
        lead = np.concatenate([directions, directions + np.pi]) - task.phase
        extremes = start + (lead / (2 * np.pi) * period - start) % turn
        times = np.linspace(start, min(end, start + turn), 257)
        times = np.append(times, np.minimum(extremes, end))
        if not known_reach(self, linkage, times.astype(ts.dtype)).all():
            raise ValueError(
                f"reference: expected a circle within {task._reach()}, got center "
                f"{task.center.tolist()} and radius {task.radius:g} m."
            )


# A function, because each access to a method of an equinox module creates an object.
def _ray(circle: CircleTask, t: Array) -> tuple[Array, Array]:
    """Angle and vector from the centre to the tip."""
    angle = circle.phase + 2 * np.pi * t / circle.period
    sin, cos = sine_and_cosine(angle)
    return angle, plane_vector(circle.radius * cos, circle.radius * sin)
