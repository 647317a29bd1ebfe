"""References of controllers, and whether an arm can reach them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..base.array_namespace import in_numpy, namespace
from ..base.checks import function, is_traced, known, real_array, refusal, shown
from ..linkage.fields import Foreign, Part, default, optional
from ..linkage.linkage import Linkage, check_linkage, joints_of

EXPECTED = "a callable (t, linkage) -> (q, qd), for instance CircleTask()"


class Reference(Part):
    """A motion of the joints to follow: called as `(t, linkage) -> (q, qd)`.

    Positions and velocities have shape (n,) [m or rad; m/s or rad/s]. Wherever a
    reference is expected, other callables are accepted, such as plain functions. A
    subclass implements `__call__`, or `assembly`; all else has a default:

    - `assembly(t, linkage)`: positions, and a root that is 0 at the edge of the reach.
      The velocities are the exact rates of the positions.
    - `jump_ts`: times at which the motion jumps; steps end there [s].
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

    def assembly(self, t: Any, linkage: Linkage) -> tuple[Any, Any]:
        """Positions (n,) [m or rad], and a root that is 0 at the edge of the reach."""
        raise NotImplementedError  # found at construction

    def __call__(
        self, t: ArrayLike, linkage: Linkage
    ) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
        """Joint positions [m or rad] and velocities [m/s or rad/s] at time `t` [s]."""
        check_linkage(linkage)
        arguments = self, real_array("t", t, ()), linkage
        at_once = known(*arguments)
        return (_with_rates_at_once if at_once else _with_rates)(*arguments)


def _with_rates(
    reference: Reference, t: Array, linkage: Linkage
) -> tuple[Array, Array]:
    shape = (joints_of(linkage),)
    positions = lambda t: jnp.broadcast_to(reference.assembly(t, linkage)[0], shape)
    return jax.jvp(positions, (t,), (jnp.ones_like(t),))


# One program for known arguments, instead of one for each of a hundred operations.
_with_rates_at_once = eqx.filter_jit(_with_rates)


class ForeignReference(Foreign, Reference):
    """A callable `(t, linkage) -> (q, qd)` of another kind, as a reference."""

    tip = optional("tip")
    period = optional("period")


def reference_of(value: Any) -> Reference:
    """Returns a callable as a reference, or raises ValueError."""
    if isinstance(value, Reference):
        return value
    if isinstance(value, Part):  # a force element or a path
        raise refusal("reference", EXPECTED, value)
    return ForeignReference(function("reference", value, EXPECTED))


def reference_motion(reference: Any, t: Array, linkage: Linkage) -> tuple[Array, Array]:
    """Positions and velocities of a reference, checked to be two arrays (n,)."""
    motion = reference(t, linkage)
    if not isinstance(motion, tuple) or len(motion) != 2:
        raise ValueError(
            f"reference: expected it to return (q_ref, qd_ref), got {shown(motion)}."
        )
    n = joints_of(linkage)
    q_ref, qd_ref = (
        real_array("reference", part, (n,), broadcast=True, of=f"{n} joints")
        for part in motion
    )
    return q_ref, qd_ref


def runs_in_numpy(*parts: Any) -> bool:
    """Returns whether all parts are this room's own; users' need not run in NumPy."""
    return all(type(part).__module__.startswith(f"{__package__}.") for part in parts)


def known_assembly(
    reference: Any, linkage: Linkage, times: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Evaluates the `assembly` of a reference in NumPy, at known times."""
    reference, linkage = in_numpy((reference, linkage))
    return reference.assembly(np.asarray(times), linkage)


def positions_at(reference: Any, t: Array, linkage: Linkage) -> Any:
    """Positions of a reference, by NumPy if it can and nothing is traced."""
    if runs_in_numpy(reference) and not is_traced(reference, t, linkage):
        return known_assembly(reference, linkage, t)[0]
    return reference_motion(reference, t, linkage)[0]


def known_reach(reference: Any, linkage: Linkage, times: ArrayLike) -> np.ndarray:
    """Computes `reachable` for known values."""
    if runs_in_numpy(reference):
        q, root = known_assembly(reference, linkage, times)
        return np.isfinite(q).all(axis=1) & (root != 0)
    with jax.ensure_compile_time_eval():  # also within transformations
        return np.asarray(_finite(reference, linkage, times))


@eqx.filter_jit
def _finite(reference: Any, linkage: Linkage, times: ArrayLike) -> Array:
    motion = jax.vmap(lambda t: reference_motion(reference, t, linkage))(times)
    return jnp.isfinite(jnp.concatenate(motion, axis=1)).all(axis=1)


def reachable(linkage: Linkage, reference: Any, ts: ArrayLike) -> Bool[Array, " time"]:
    """Returns whether a linkage can reach the reference at each time.

    A `TipTask` that passes behind the pivot between the first and the last time, so
    that joints would jump, is out of reach at all times.

    **Arguments:** `linkage`; `reference`: for instance a `CircleTask` or `TipTask`;
    `ts`: times (time,) [s].

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
    arguments = reference, linkage, ts
    if is_traced(arguments):
        return _finite(*arguments) & _fits(*arguments)
    near = known_reach(*arguments)
    return jax.device_put(near & _fits(*in_numpy(arguments)))


def _fits(reference: Any, linkage: Linkage, ts: Any) -> Any:
    """Returns whether a reference fits from the first to the last of the times."""
    if not isinstance(reference, Part) or not len(ts):
        return True
    return reference.fits(linkage, namespace(ts).sort(ts))
