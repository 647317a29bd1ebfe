"""Joint coordinates and the paper's chain coordinates."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.array_namespace import in_numpy, namespace
from ..base.checks import concrete, real_array, shown
from .linkage import Linkage, compiled, per_joint
from .topology import letters, pairs_of, real_joints


class State(NamedTuple):
    """Joint positions and velocities; a bare pytree that functions check on use.

    - `q`: the slide B_k [m] of a prismatic joint or the relative angle th_{k+1} - th_k
      [rad] of a revolute joint, in joint order (n,). Ignored at fixed pairs.
    - `qd`: the rates of `q` (n,).

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> start = fj.State(q=[0.5, 0, 0], qd=[0, 0, 0])
    >>> fj.tip_position(arm, start.q).tolist()
    [2.633, 1.438]
    """

    q: ArrayLike
    qd: ArrayLike


def real_state(name: str, value: Any, linkage: Linkage) -> State:
    """Returns `value` as a state of the linkage's joints, or raises ValueError."""
    try:
        q, qd = value
    except (TypeError, ValueError):
        raise ValueError(
            f"{name}: expected a State(q, qd), got {shown(value)}."
        ) from None
    parts = ("q", q), ("qd", qd)
    return State(*(per_joint(f"{name}.{part}", row, linkage) for part, row in parts))


@compiled("q", "qd")
def to_chain(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, " chain"], Float[Array, " chain"]]:
    """Computes chain coordinates (B1, th2, B2, th3, ...) and their rates.

    Angles are absolute, as in the paper; fictitious joints stand at `linkage.locked`.

    **Arguments:** `q`, `qd`: joint positions [m or rad] and velocities.

    **Returns:** `x` [m, rad] and `xd` [m/s, rad/s].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> x, xd = fj.to_chain(arm, [0.5, 2.5, 0.0], [1.0, 0.0, 0.0])
    >>> x.tolist(), xd.tolist()  # a slide keeps its angle
    ([0.0, 0.5, 2.5, 2.071, 0.0, 2.071], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    """
    revolute = jnp.stack(real_joints(linkage.ef))
    slide = jnp.where(revolute, linkage.locked, q)
    turn = jnp.where(revolute, q, linkage.locked)
    x = jnp.stack([slide, linkage.base_angle + jnp.cumsum(turn)], axis=1)
    xd = jnp.stack(
        [jnp.where(revolute, 0, qd), jnp.cumsum(jnp.where(revolute, qd, 0))], axis=1
    )
    return x.ravel(), xd.ravel()


def from_chain(
    topology: str | ArrayLike, x: ArrayLike, xd: ArrayLike, base_angle: ArrayLike = 0.0
) -> tuple[Float[Array, " joint"], State]:
    """Computes locked positions and joint state from the paper's chain coordinates.

    **Arguments:**

    - `topology`: as for `Linkage`, without fixed pairs.
    - `x`, `xd`: (B1, th2, B2, th3, ...), absolute angles [m, rad], and rates.
    - `base_angle`: th1 [rad].

    **Returns:** `locked` for `Linkage`, and the `State`.

    **Raises:** ValueError for malformed input and for velocities that would move a
    fictitious joint. The paper's method stops only accelerations, so the joint would
    drift.

    >>> import fdof_jax as fj
    >>> locked, state = fj.from_chain("RPR", [0, 1.5, 2.5, 2.5, 0, 2], [0] * 6)
    >>> locked.tolist(), state.q.tolist()
    ([0.0, 1.0, 0.0], [1.5, 2.5, -0.5])
    """
    pairs = pairs_of(topology)
    if pairs is not None and not pairs.any(axis=1).all():
        raise ValueError(
            "topology: expected no fixed pair with chain coordinates, got "
            f"{letters(pairs)}."
        )
    ef = jnp.asarray(topology) if pairs is None else pairs.ravel()
    given = (
        real_array("x", x, (ef.size,)),
        real_array("xd", xd, (ef.size,)),
        real_array("base_angle", base_angle, ()),
    )
    chain, chain_rate, ground = in_numpy(given)
    xp = namespace(ef, chain, chain_rate, ground)
    revolute = xp.stack(real_joints(ef))
    slide, turn = chain[0::2], xp.diff(chain[1::2], prepend=ground)
    slide_rate, turn_rate = chain_rate[0::2], xp.diff(chain_rate[1::2], prepend=0)
    held = concrete(xp.where(revolute, slide_rate, turn_rate))
    if held is not None and pairs is not None:
        # Differences of absolute rates carry rounding errors.
        scale = np.abs(np.asarray(chain_rate)).max()
        for k in np.flatnonzero(np.abs(held) > 8 * np.finfo(held.dtype).eps * scale):
            rate = (
                f"B{k + 1} rate 0"
                if pairs[k, 1]
                else (f"th{k + 2} rate equal to th{k + 1} rate" if k else "th2 rate 0")
            )
            raise ValueError(
                f"xd: expected {rate}, because that joint is fictitious, got a "
                f"difference of {held[k]:g}."
            )
    locked = jnp.asarray(xp.where(revolute, slide, turn), dtype=float)
    q = jnp.asarray(xp.where(revolute, turn, slide), dtype=float)
    qd = jnp.asarray(xp.where(revolute, turn_rate, slide_rate), dtype=float)
    return locked, State(q, qd)
