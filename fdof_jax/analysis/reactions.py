"""Bearing reactions, and the inertial parameters in which efforts are linear."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..base.checks import shown
from ..dynamics import forward_dynamics, inverse_dynamics
from ..forces.added_inertia import present
from ..forces.element import Forces, elements
from ..linkage.frames import cross, frames, plane_vectors
from ..linkage.linkage import Linkage, check_linkage, compiled
from ..mechanics.kinematics import joint_positions, mass_center_velocities, mass_centers
from ..simulation.efforts import acting_in, joint_efforts
from ..simulation.scene import accepts_scene
from ..simulation.solution import Solution


def _loads(
    linkage: Linkage, forces: Forces, t: Array, q: Array, qd: Array, qdd: Array
) -> tuple[Array, Array]:
    """Forces on the ground and the links, and moments about the ground pivot."""
    parts = frames(linkage, q)
    force, moment = jnp.zeros(q.size + 1, complex), jnp.zeros(q.size + 1)
    for index, element in enumerate(forces):
        loads = element.loads_on_points(t, q, qd, qdd, linkage)
        if loads is None:
            raise ValueError(
                f"forces[{index}]: expected a method `loads` that returns the loads of "
                f"its masses on points of links, got none in {shown(element)}."
            )
        for load in loads:
            about_pivot = load.moment + cross(load.point.place(parts), load.vector())
            force = force.at[load.point.link].add(load.vector())
            moment = moment.at[load.point.link].add(about_pivot)
    return force, moment


@accepts_scene
def joint_reactions(
    linkage: Linkage, forces: Forces, solution: Solution
) -> Float[Array, "time joint 3"]:
    """Computes force and moment of each joint's bearing on the next link over time.

    In a joint's free direction, the reaction is the effort of dampers, controllers,
    drives, armatures and whatever holds the joint. Loads on points act on the links.

    **Arguments:** `linkage` and `forces` of the solution, or a `Scene` in their place.
    The forces of `simulate_sampled` are `(control, *forces)`.

    **Returns:** force (x, y) [N] and moment [N m] on the moving link, at its
    characteristic point (see `joint_positions`). The previous link gets the opposite.

    **Raises:** ValueError for malformed arguments, and for an element that moves masses
    but has no method `loads`.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> fj.joint_reactions(arm, (), motion)[:2, 0, :2].tolist()  # in free fall at first
    [[0.0, 0.0], [-0.043, 0.0]]
    """
    forces = elements("forces", forces)
    efforts = joint_efforts(linkage, forces, solution)
    rows = solution.ts, solution.q, solution.qd, efforts.total
    rows = tuple(jnp.asarray(row, float) for row in rows)  # some may be in float32
    return _reactions(linkage, acting_in(solution, forces), rows)


@eqx.filter_jit
def _reactions(
    linkage: Linkage, forces: Forces, rows: tuple[Array, ...]
) -> Float[Array, "time joint 3"]:
    def at(t, q, qd, tau):
        acting = present(forces, t)
        qdd = forward_dynamics(linkage, q, qd, tau, acting)
        motion = lambda q, qd: mass_center_velocities(linkage, q, qd)
        _, (acceleration, spin_up) = jax.jvp(motion, (q, qd), (qd, qdd))
        needed = linkage.mass * (plane_vectors(acceleration) + 1j * linkage.gravity)
        center = plane_vectors(mass_centers(linkage, q))
        joint = plane_vectors(joint_positions(linkage, q))
        turning = linkage.inertia * spin_up + cross(center, needed)
        force, moment = _loads(linkage, acting, t, q, qd, qdd)
        # Each joint carries all links beyond it.
        beyond = lambda rows: jnp.cumsum(rows[::-1])[::-1]
        carried, about_pivot = beyond(needed - force[1:]), beyond(turning - moment[1:])
        about = about_pivot - cross(joint, carried)
        return jnp.stack([carried.real, carried.imag, about], axis=1)

    # A loop compiles in three quarters of the time of `jax.vmap`. Without elements it
    # takes half as long again (3 ms for 10,001 times), with them less than half.
    return jax.lax.map(lambda row: at(*row), rows)


def inertial_parameters(linkage: Linkage) -> Float[Array, "link 4"]:
    """Computes mass [kg], moments m p, m q [kg m] and inertia [kg m^2] of each link.

    The inertia is about the link's characteristic point. The dynamics are linear in
    these parameters: see `regressor`.

    **Raises:** ValueError if `linkage` is not a linkage.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig3().linkage
    >>> p = fj.analysis.inertial_parameters(arm)
    >>> p[0].tolist()  # m, m p, m q, I about the pivot
    [5.0, 2.5, -5.0, 6.25]
    """
    check_linkage(linkage)
    m, (p, q) = linkage.mass, linkage.com.T
    return jnp.stack([m, m * p, m * q, linkage.inertia + m * (p**2 + q**2)], axis=1)


@compiled("q", "qd", "qdd")
def regressor(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    qdd: Float[Array, " joint"],
) -> Float[Array, "joint link 4"]:
    """Computes the coefficients of the inertial parameters in the inverse dynamics.

    The efforts are tau = regressor : `inertial_parameters(linkage)`, summed over links
    and parameters. The rank of regressors stacked over a motion is the number of
    parameter combinations that can be identified: nine of twelve for an RPR arm.

    **Arguments:** `linkage`, whose masses and inertias do not matter; `q`, `qd`, `qdd`:
    joint positions, velocities and accelerations (n,) [m or rad, and per s and s^2].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import numpy as np
    >>> state = [0.1, 0.2, 0.3], [1, 0, -1], [0.5, 0.5, 0.5]
    >>> p = fj.analysis.inertial_parameters(arm)
    >>> np.tensordot(fj.analysis.regressor(arm, *state), p, 2).tolist()
    [68.982, 35.32, 11.766]
    >>> fj.inverse_dynamics(arm, *state).tolist()
    [68.982, 35.32, 11.766]
    """

    def efforts(parameters):
        mass, moments, inertia = jnp.split(parameters, [1, 3], axis=1)
        com = moments / mass
        about_center = inertia[:, 0] - mass[:, 0] * jnp.sum(com**2, axis=1)
        bodies = mass[:, 0], com, about_center
        arm = eqx.tree_at(lambda arm: (arm.mass, arm.com, arm.inertia), linkage, bodies)
        return inverse_dynamics(arm, q, qd, qdd)

    # The efforts are linear in the parameters, so any values serve.
    return jax.jacfwd(efforts)(jnp.tile(jnp.array([1.0, 0.0, 0.0, 1.0]), (q.size, 1)))
