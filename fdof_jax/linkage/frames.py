"""Forward kinematics: where the links start, and along which directions they run."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import check_known, real_numbers
from ..base.known_values import in_numpy
from ..base.trigonometry import sincos
from .linkage import Linkage, check_linkage, joints_of, without_fixed
from .topology import real_joints

Rows = Any  # arrays of JAX or NumPy, or lists of scalars

# Vectors of the plane are complex numbers x + iy. A product with exp(i th) turns them
# by th, a product with i by 90 degrees.


def plane_vector(x: Array, y: Array) -> Array:
    """Returns x + iy, in the wider precision of the two."""
    return jax.lax.complex(*(part.astype(jnp.result_type(x, y)) for part in (x, y)))


def plane_vectors(points: Array) -> Array:
    """Returns x + iy of points (..., 2)."""
    return plane_vector(points[..., 0], points[..., 1])


def unit_vector(angle: Array) -> Array:
    """Returns exp(i angle)."""
    sin, cos = sincos(angle)
    return plane_vector(cos, sin)


def dot(a: Array, b: Array) -> Array:
    return a.real * b.real + a.imag * b.imag


def cross(a: Array, b: Array) -> Array:
    return a.real * b.imag - a.imag * b.real


def length_of(vector: Array) -> Array:
    """Computes a vector's length, with derivative 0 for the zero vector."""
    square = dot(vector, vector)
    meet = square == 0
    return jnp.where(meet, 0, jnp.sqrt(jnp.where(meet, 1, square)))


class Frames(NamedTuple):
    """The ground (0) and the moving links (1 to n), along the last axis of each array.

    - `start`: characteristic points x + iy (..., n + 1) [m].
    - `direction`: unit vectors along the links (..., n + 1).
    - `angle`: absolute angles (..., n + 1) [rad].
    - `slide`: B_k of the joints (..., n) [m].
    - `revolute`: whether each joint is revolute (..., n).
    """

    start: Rows
    direction: Rows
    angle: Rows
    slide: Rows
    revolute: Rows

    def tip(self, linkage: Linkage) -> Rows:
        """Returns the end of the last link's vector A [m]."""
        return self.start[..., -1] + linkage.length[-1] * self.direction[..., -1]


def frames(linkage: Linkage, q: Array) -> Frames:
    """Computes the frames at joint positions (n,), 0 at fixed pairs."""
    revolute = jnp.stack(real_joints(linkage.ef))
    slide = jnp.where(revolute, linkage.locked, q)
    turn = jnp.cumsum(jnp.where(revolute, q, linkage.locked))
    angle = jnp.append(linkage.base_angle, linkage.base_angle + turn)
    direction = unit_vector(angle)
    # The length A runs along a link, the slide B across it.
    steps = plane_vector(linkage.length[:-1], slide) * direction[:-1]
    return Frames(jnp.append(0, jnp.cumsum(steps)), direction, angle, slide, revolute)


def link_frames(linkage: Linkage, q: ArrayLike) -> Frames:
    """Computes where the links are along a motion.

    **Arguments:** `linkage`; `q`: joint positions (time, n) [m or rad].

    **Returns:** `Frames` in NumPy, with times along the first axis.

    **Raises:** ValueError for malformed arguments and within JAX's transformations.
    """
    check_linkage(linkage)
    check_known("q", linkage, q)
    q = without_fixed(linkage, real_numbers("q", q, (None, joints_of(linkage))))
    count, n = q.shape
    # Powers of two: each number of rows needs a program.
    rows = np.resize(q, (1 << count.bit_length(), n))
    found = in_numpy(_frames_of_each(linkage, rows))
    return jax.tree.map(lambda leaf: leaf[:count], found)


@jax.jit
def _frames_of_each(linkage: Linkage, q: Array) -> Frames:
    return jax.vmap(frames, (None, 0))(linkage, q)


def scalar_frames(linkage: Linkage, q: tuple[Array, ...] | Array) -> Frames:
    """Computes the frames as lists of scalars, which fuse with the equations."""
    # A sweep with a spring takes 1.3 times as long with the arrays of `frames`.
    revolute = real_joints(linkage.ef)
    angle, slide, direction = [linkage.base_angle], [], []
    start = [jnp.zeros((), complex)]
    for k, turns in enumerate(revolute):
        direction.append(unit_vector(angle[k]))
        slide.append(jnp.where(turns, linkage.locked[k], q[k]))
        step = plane_vector(linkage.length[k], slide[k])
        start.append(start[k] + step * direction[k])
        angle.append(angle[k] + jnp.where(turns, q[k], linkage.locked[k]))
    direction.append(unit_vector(angle[-1]))
    return Frames(start, direction, angle, slide, revolute)
