"""Forward and inverse dynamics and energies in joint coordinates."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from .forces.added_inertia import added_energy, added_inertia, energetic_on, inertial_on
from .forces.element import Forces
from .linkage.linkage import Linkage, compiled
from .mechanics.equations import Constants, equations, link_constants, zeros
from .mechanics.kinematics import mass_center_velocities, mass_centers
from .mechanics.rates import losses, rates
from .mechanics.solve import divided, with_added


@compiled("q", "qd", "tau", forces=inertial_on)
def forward_dynamics(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    tau: Float[Array, " joint"],
    forces: Forces = (),
) -> Float[Array, " joint"]:
    """Computes joint accelerations under joint efforts: (14), reduced.

    They equal those of the paper's masked equations (17)-(27), which are singular in
    more cases, such as a massless revolute tip.

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s], `tau` [N or N m]; `forces`:
    elements, of which only masses count. Include their efforts in `tau`.

    **Returns:** `qdd` [m/s^2 or rad/s^2].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.forward_dynamics(arm, [0, 0, 0], [0, 0, 0], tau=[0, 0, 0]).tolist()  # let go
    [-9.81, 9.81, 0.0]
    """
    matrix, bias = added_inertia(linkage, forces, q, qd)
    constants = link_constants(linkage, q)
    _, qdd = rates(constants, zeros(q), tuple(qd), tuple(tau - bias), matrix)
    return jnp.stack(qdd)


@compiled("q", forces=inertial_on)
def inertia_ratios(
    linkage: Linkage, q: Float[Array, " joint"], forces: Forces = ()
) -> Float[Array, " joint"]:
    """Computes how well each joint's acceleration is determined, in (0, 1].

    The ratio 1 / (M_kk (M^-1)_kk) is the inertia of a joint with the others free, over
    that with the others locked. Accelerations lose about -log10 of the least ratio in
    digits; `simulate` stops below 1e-11, in float32 below 1e-5. The ratio is zero where
    the mass matrix is not positive definite, and infinite at fixed pairs.

    **Arguments:** `q` [m or rad]; `forces`: elements, of which only masses count.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> float(fj.analysis.inertia_ratios(arm, [0, 0, 0]).min())  # a digit is lost
    0.04
    """
    matrix, _ = added_inertia(linkage, forces, q, jnp.zeros_like(q))
    return 1 / jnp.stack(losses(divided, link_constants(linkage, q), zeros(q), matrix))


@compiled("q", "qd", "qdd", forces=inertial_on)
def inverse_dynamics(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    qdd: Float[Array, " joint"],
    forces: Forces = (),
) -> Float[Array, " joint"]:
    """Computes joint efforts for given joint accelerations, from (14) reduced.

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s], `qdd` [m/s^2 or rad/s^2];
    `forces`: elements, of which only masses count.

    **Returns:** `tau` [N or N m], the sum of the efforts of all elements.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.inverse_dynamics(arm, [0, 0, 0], [0, 0, 0], [0, 0, 0]).tolist()  # held level
    [58.86, 29.43, 9.81]
    """
    matrix, bias = mass_and_bias(linkage, forces, q, qd)
    return matrix @ qdd + bias  # 0 at fixed pairs, as `qdd` and the bias are


@compiled("q", forces=inertial_on)
def mass_matrix(
    linkage: Linkage, q: Float[Array, " joint"], forces: Forces = ()
) -> Float[Array, "joint joint"]:
    """Computes the joint mass matrix M, in M qdd + bias = tau.

    M is (8)-(13) projected on the real joints: symmetric, and positive definite unless
    the arm is singular.

    **Arguments:** `q` [m or rad]; `forces`: elements, of which only masses count.

    **Returns:** M (n, n) [kg, kg m or kg m^2]; at fixed pairs, rows of the identity.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.mass_matrix(arm, [0, 0, 0]).tolist()  # 1 kg each at 1, 2 and 3 m
    [[14.0, 8.0, 3.0], [8.0, 5.0, 2.0], [3.0, 2.0, 1.0]]
    """
    matrix, _ = mass_and_bias(linkage, forces, q, jnp.zeros_like(q))
    # Some versions of XLA compute equal entries twice, and round them differently.
    row, column = np.indices(matrix.shape)
    return matrix[np.minimum(row, column), np.maximum(row, column)]


@compiled("q", "qd", forces=inertial_on)
def bias_force(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    forces: Forces = (),
) -> Float[Array, " joint"]:
    """Computes the bias: gravity, centrifugal and Coriolis forces on the joints.

    In M qdd + bias = tau, it is minus phi of (14), projected on the real joints.

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s]; `forces`: elements, of which
    only masses count.

    **Returns:** the bias [N or N m].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.bias_force(arm, [0, 0, 0], [0, 0, 0]).tolist()  # at rest: gravity
    [58.86, 29.43, 9.81]
    """
    return mass_and_bias(linkage, forces, q, qd)[1]


def mass_and_bias(
    linkage: Linkage,
    forces: Forces,
    q: Array,
    qd: Array,
    start: tuple[Array, Constants] | None = None,
) -> tuple[Array, Array]:
    """Computes the mass matrix and the bias, with the masses of elements.

    `start`: joint positions and the constants of the equations there, if known.
    """
    q0, constants = start or (q, link_constants(linkage, q))
    m = equations(constants, tuple(q - q0), tuple(qd))
    bias = jnp.stack(m.bias)
    added, more = added_inertia(linkage, forces, q, qd)
    m, bias = with_added(added, m), bias + more
    joints = range(len(m.bias))
    matrix = [[m.mass[min(i, j)][abs(i - j)] for j in joints] for i in joints]
    moves = ~linkage.fixed
    matrix = jnp.where(jnp.outer(moves, moves), jnp.array(matrix), jnp.eye(len(moves)))
    return matrix, jnp.where(moves, bias, 0)


@compiled("q", "qd")
def link_energies(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, " link"], Float[Array, " link"]]:
    """Computes the kinetic and potential energy of each moving link, (6) and (7).

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s].

    **Returns:** two arrays (n,) [J]; the potential is zero at the ground pivot's
    height.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> kinetic, potential = fj.link_energies(arm, [0, 0, 0], [1.0, 0, 0])
    >>> kinetic.tolist(), potential.tolist()
    ([0.5, 2.0, 4.5], [0.0, 0.0, 0.0])
    """
    velocity, rate = mass_center_velocities(linkage, q, qd)
    kinetic = linkage.mass * jnp.sum(velocity**2, axis=1) + linkage.inertia * rate**2
    height = mass_centers(linkage, q)[:, 1]
    return kinetic / 2, linkage.mass * linkage.gravity * height


@compiled("q", "qd", forces=energetic_on)
def energy(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    forces: Forces = (),
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Computes the kinetic and potential energy of the linkage, (6) and (7).

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s]; `forces`: elements, of which
    masses, springs, stops and constant tensions add energy.

    **Returns:** two numbers [J]; the potential is zero at the ground pivot's height.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> kinetic, potential = fj.energy(arm, [-1.5707963, 0, 0], [0, 0, 0])
    >>> float(potential)  # 1 kg each hangs at 1, 2 and 3 m
    -58.86
    """
    kinetic, potential = link_energies(linkage, q, qd)
    more_kinetic, more_potential = added_energy(linkage, forces, q, qd)
    return jnp.sum(kinetic) + more_kinetic, jnp.sum(potential) + more_potential
