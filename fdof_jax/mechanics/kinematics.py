"""Forward kinematics: positions and velocities of points of a linkage."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..linkage.frames import frames, plane_vector, plane_vectors
from ..linkage.linkage import Linkage, compiled, without_fixed


def as_points(vectors: Array) -> Array:
    """Returns x + iy as points (..., 2)."""
    return jnp.stack([vectors.real, vectors.imag], axis=-1)


@compiled("q")
def joint_positions(
    linkage: Linkage, q: Float[Array, " joint"]
) -> Float[Array, "joint 2"]:
    """Computes the revolute axis of each joint pair, where the next link starts.

    **Arguments:** `q` [m or rad].

    **Returns:** points (x, y) from the ground pivot (n, 2) [m].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.joint_positions(arm, [0.0, 1.5707963, 0.0]).tolist()
    [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    """
    return as_points(frames(linkage, q).start[1:])


@compiled("q")
def mass_centers(linkage: Linkage, q: Float[Array, " joint"]) -> Float[Array, "link 2"]:
    """Computes the mass centres of the moving links.

    **Arguments:** `q` [m or rad].

    **Returns:** points (x, y) from the ground pivot (n, 2) [m].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.mass_centers(arm, [0.0, 1.5707963, 0.0]).tolist()
    [[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]
    """
    f = frames(linkage, q)
    return as_points(f.start[1:] + plane_vectors(linkage.com) * f.direction[1:])


@compiled("q", "qd")
def mass_center_velocities(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, "link 2"], Float[Array, " link"]]:
    """Computes mass centres' velocities [m/s] and links' angular velocities [rad/s]."""
    _, e, _, slide, revolute = frames(linkage, q)
    turning = jnp.cumsum(jnp.where(revolute, qd, 0))
    rate = jnp.concatenate([jnp.zeros(1), turning])
    # d/dt (A + iB) e: the link turns, and the slide moves across it.
    arm = plane_vector(linkage.length[:-1], slide)
    start = jnp.cumsum(1j * (rate[:-1] * arm + jnp.where(revolute, 0, qd)) * e[:-1])
    offset = plane_vectors(linkage.com)
    return as_points(start + 1j * (turning * offset * e[1:])), turning


@compiled("q")
def tip_position(linkage: Linkage, q: Float[Array, " joint"]) -> Float[Array, " 2"]:
    """Computes the tip's position: the end of the last link's vector A.

    **Arguments:** `q` [m or rad].

    **Returns:** the point (x, y) from the ground pivot [m].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.tip_position(arm, [0.0, 1.5707963, 0.0]).tolist()
    [1.0, 2.0]
    """
    return as_points(frames(linkage, q).tip(linkage))


@compiled("q")
def tip_jacobian(
    linkage: Linkage, q: Float[Array, " joint"]
) -> Float[Array, "3 joint"]:
    """Computes the derivative of the tip's x, y and orientation in `q`.

    **Arguments:** `q` [m or rad].

    **Returns:** rows x, y [m] and orientation [rad], per m or rad of each joint (3, n).

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.tip_jacobian(arm, [0.0, 0.0, 0.0]).tolist()  # stretched: no motion along x
    [[0.0, 0.0, 0.0], [3.0, 2.0, 1.0], [1.0, 1.0, 1.0]]
    """
    f = frames(linkage, q)
    columns = f.tip(linkage) - f.start[1:]
    columns = 1j * jnp.where(f.revolute, columns, f.direction[:-1])
    columns = without_fixed(linkage, columns)
    return jnp.stack([columns.real, columns.imag, jnp.where(f.revolute, 1.0, 0.0)])
