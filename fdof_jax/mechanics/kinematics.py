"""Forward kinematics: positions and velocities of points of a linkage."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..linkage.coordinates import real_joints, to_chain
from ..linkage.linkage import Linkage, compiled
from ..xla.array_namespace import namespace, plane_vector, sine_and_cosine

# Vectors of the plane are complex numbers here: multiplying by exp(i th) turns them,
# multiplying by i turns them by 90 degrees. Inverse kinematics also calls these helpers
# with NumPy arrays, and for many points at once, with shapes such as (..., 2).


def unit_vectors(angle: Array) -> Array:
    sin, cos = sine_and_cosine(angle)
    return plane_vector(cos, sin)


def as_points(points: Array) -> Array:
    return namespace(points).stack([points.real, points.imag], axis=-1)


def _chain(linkage: Linkage, q: Array) -> tuple[Array, Array, Array]:
    """Computes slides B1..B3, directions e_1..e_4 and starts of the moving links."""
    x, _ = to_chain(linkage, q, jnp.zeros(3))
    e = unit_vectors(jnp.concatenate([linkage.base_angle[None], x[1::2]]))
    steps = jax.lax.complex(linkage.length[:3], x[0::2]) * e[:3]
    return x[0::2], e, jnp.cumsum(steps)


@compiled(q=(3,))
def joint_positions(
    linkage: Linkage, q: Float[Array, " joint"]
) -> Float[Array, "joint 2"]:
    """Computes the revolute axis of each joint pair, where the next link starts.

    **Arguments:** `q`: joint positions [m or rad].

    **Returns:** one point (x, y) per joint [m], from the ground pivot.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.joint_positions(arm, [0.0, 1.5707963, 0.0]).tolist()
    [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    """
    return as_points(_chain(linkage, q)[2])


@compiled(q=(3,))
def mass_centers(linkage: Linkage, q: Float[Array, " joint"]) -> Float[Array, "link 2"]:
    """Computes the mass centres of the moving links.

    **Arguments:** `q`: joint positions [m or rad].

    **Returns:** one point (x, y) per moving link [m], from the ground pivot.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.mass_centers(arm, [0.0, 1.5707963, 0.0]).tolist()
    [[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]
    """
    _, e, start = _chain(linkage, q)
    offset = jax.lax.complex(linkage.com[:, 0], linkage.com[:, 1])
    return as_points(start + offset * e[1:])


@compiled(q=(3,), qd=(3,))
def mass_center_velocities(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, "link 2"], Float[Array, " link"]]:
    """Computes velocities of the mass centres and angular velocities of the links.

    **Arguments:** `q`: joint positions [m or rad]; `qd`: rates [m/s or rad/s].

    **Returns:** one velocity (x, y) [m/s] and one angular velocity [rad/s] per link.
    """
    slide, e, _ = _chain(linkage, q)
    _, xd = to_chain(linkage, q, qd)
    rate = jnp.concatenate([jnp.zeros(1), xd[1::2]])
    # d/dt (A + iB) e: the link turns, and the slide moves across it.
    arm = jax.lax.complex(linkage.length[:3], slide)
    start = jnp.cumsum(1j * (rate[:3] * arm + xd[0::2]) * e[:3])
    offset = jax.lax.complex(linkage.com[:, 0], linkage.com[:, 1])
    return as_points(start + 1j * (rate[1:] * offset * e[1:])), rate[1:]


@compiled(q=(3,))
def tip_position(linkage: Linkage, q: Float[Array, " joint"]) -> Float[Array, " 2"]:
    """Computes the tip's position: the end of the last link's vector A4.

    **Arguments:** `q`: joint positions [m or rad].

    **Returns:** the point (x, y) [m], from the ground pivot.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.tip_position(arm, [0.0, 1.5707963, 0.0]).tolist()
    [1.0, 2.0]
    """
    _, e, start = _chain(linkage, q)
    return as_points(start[2] + linkage.length[3] * e[3])


@compiled(q=(3,))
def tip_jacobian(
    linkage: Linkage, q: Float[Array, " joint"]
) -> Float[Array, "3 joint"]:
    """Computes the derivative of the tip's x, y and orientation in `q`.

    **Arguments:** `q`: joint positions [m or rad].

    **Returns:** rows x, y [m or 1] and orientation [rad] per joint [m or rad].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.tip_jacobian(arm, [0.0, 0.0, 0.0]).tolist()  # stretched: no motion along x
    [[0.0, 0.0, 0.0], [3.0, 2.0, 1.0], [1.0, 1.0, 1.0]]
    """
    _, e, start = _chain(linkage, q)
    tip = start[2] + linkage.length[3] * e[3]
    revolute = jnp.stack(real_joints(linkage.ef))
    columns = jnp.where(revolute, 1j * (tip - start), 1j * e[:3])
    return jnp.stack([columns.real, columns.imag, jnp.where(revolute, 1.0, 0.0)])
