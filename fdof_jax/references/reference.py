"""References of controllers, and whether an arm can reach them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..base.checks import function, known, real_array, refusal
from ..base.known_values import at_once
from ..linkage.fields import Foreign, Part, default, optional
from ..linkage.linkage import Linkage, check_linkage, joints_of

EXPECTED = "a callable (t, linkage) -> (q, qd), for instance CircleTask()"


class Reference(Part):
    """A motion of the joints to follow: called as `(t, linkage) -> (q, qd)`.

    Positions and velocities have shape (n,) [m or rad; m/s or rad/s]. Plain functions
    are accepted wherever a reference is expected. A subclass implements `__call__`, or
    `assembly`; all else has a default:

    - `assembly(t, linkage)`: positions, and a root that is 0 at the edge of the reach.
      The velocities are then the exact rates of the positions.
    - `jump_ts`: one or several times [s] at which the motion jumps; steps end there.
    - `check(linkage, ts)`: raises ValueError if the arm cannot follow.
    - `tip(t)`: the commanded position of the tip (2,) [m]; by default None.
    - `period`: the time of one turn [s]; by default None.

    >>> import fdof_jax as fj
    >>> import jax.numpy as jnp
    >>> class Stand(fj.references.Reference):
    ...     target: fj.Values = fj.field(unit="m or rad")
    ...     def __call__(self, t, linkage):
    ...         return self.target, 0 * self.target
    >>> stand = fj.PDController(kp=100, kd=10, limit=30, reference=Stand(0.5))
    """

    tip = default(lambda self: None)
    period = default(lambda self: None)

    def __check_init__(self):
        kind = type(self)
        if (kind.__call__, kind.assembly) == (Reference.__call__, Reference.assembly):
            raise TypeError(
                f"{kind.__name__}: expected a method `__call__` or `assembly`, got "
                "neither."
            )

    def assembly(self, t: Array, linkage: Linkage) -> tuple[Array, Array | float]:
        raise NotImplementedError  # not reached: a class with neither is refused

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        check_linkage(linkage)
        arguments = self, real_array("t", t, ()), linkage
        # Functions may hold traced values, which no program at once could have.
        motion = _with_rates_at_once if known(*arguments) else _with_rates
        return motion(*arguments)


def _with_rates(
    reference: Reference, t: Array, linkage: Linkage
) -> tuple[Array, Array]:
    shape = (joints_of(linkage),)
    positions = lambda t: jnp.broadcast_to(reference.assembly(t, linkage)[0], shape)
    return jax.jvp(positions, (t,), (jnp.ones_like(t),))


_with_rates_at_once = at_once(_with_rates)


class ForeignReference(Foreign, Reference):
    """A callable `(t, linkage) -> (q, qd)` of another kind, as a reference."""

    tip = optional("tip")
    period = optional("period")


def reference_of(value: Callable) -> Reference:
    """Returns a callable as a `Reference`, with the methods that a plain one lacks.

    **Arguments:** `value`: any callable `(t, linkage) -> (q, qd)` [m or rad, and per
    second].

    **Raises:** ValueError for anything else.

    >>> import fdof_jax as fj
    >>> still = lambda t, linkage: (0 * linkage.mass, 0 * linkage.mass)
    >>> fj.references.reference_of(still).tip is None  # it commands joints alone
    True
    """
    if isinstance(value, Reference):
        return value
    if isinstance(value, Part):  # a force element or a path
        raise refusal("reference", EXPECTED, value)
    return ForeignReference(function("reference", value, EXPECTED))


def reference_motion(
    reference: Callable, t: Array, linkage: Linkage
) -> tuple[Array, Array]:
    """Returns a reference's positions and velocities, checked to be two arrays (n,)."""
    motion = reference(t, linkage)
    if not isinstance(motion, tuple) or len(motion) != 2:
        raise refusal("reference", "it to return (q_ref, qd_ref)", motion)
    n = joints_of(linkage)
    q_ref, qd_ref = (
        real_array("reference", part, (n,), broadcast=True, of=f"{n} joints")
        for part in motion
    )
    return q_ref, qd_ref


@at_once
def reach(reference: Callable, linkage: Linkage, times: Array) -> Array:
    """Returns whether positions and velocities are finite at each time."""
    motion = lambda t: jnp.concatenate(reference_motion(reference, t, linkage))
    # A loop compiles in three quarters of the time of `jax.vmap`.
    return jax.lax.map(lambda t: jnp.isfinite(motion(t)).all(), times)


def reachable(
    linkage: Linkage, reference: Callable, ts: ArrayLike
) -> Bool[Array, " time"]:
    """Returns whether a linkage can reach the reference at each time.

    A `TipTask` that passes behind the pivot between the first and the last time is out
    of reach at all times: joints would jump there.

    **Arguments:** `linkage`; `reference`: such as a `TipTask`; `ts`: times (time,) [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> circle = fj.CircleTask(center=[-1, 2], radius=0.75)  # too near the base
    >>> fj.references.reachable(arm, circle, [0.0, 1.875, 2.5]).tolist()
    [True, False, True]
    """
    check_linkage(linkage)
    ts = real_array("ts", ts, (None,))
    reference_of(reference)  # refuses what is none
    near = reach(reference, linkage, ts)
    if isinstance(reference, Part) and len(ts):
        near = near & _fits(reference, linkage, ts)
    return near


@at_once
def _fits(reference: Reference, linkage: Linkage, ts: Array) -> Array:
    return jnp.asarray(reference.fits(linkage, jnp.sort(ts)))
