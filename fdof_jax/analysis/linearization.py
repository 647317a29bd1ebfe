"""Linear analysis for control: matrices of the arm and its loops, modes of motions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..base.checks import instance, is_traced, real_array, shown
from ..control.pd import PDController
from ..dynamics import bias_force, forward_dynamics, mass_matrix
from ..forces.element import Element, Forces, elements_on, of_full_size
from ..linkage.coordinates import State, real_state
from ..linkage.linkage import (
    Linkage,
    check_linkage,
    joints_of,
    moving_joints,
    without_fixed,
)
from ..linkage.topology import fixed_pairs
from ..references.reference import Reference, reference_motion
from ..simulation.field import element_effort, stateful
from ..simulation.prescribed import prescribed
from ..simulation.sampled import check_joints
from ..simulation.scene import accepts_scene
from ..simulation.solution import Solution

# Explicit Runge-Kutta methods of order 4 in 4 stages damp every damped mode if the step
# size times |eigenvalue| is below this (2.8 for undamped and overdamped modes).
_STABLE = 2.6


class Linearization(NamedTuple):
    """Matrices of d(q, qd)/dt = A (q, qd) + B tau about a state, (2n, 2n) and (2n, n).

    They hold for small changes of positions [m or rad], velocities and efforts
    [N or N m].
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state joint"]


def depends_on_state_alone(forces: tuple[Element, ...]) -> bool:
    """Returns whether no element has a state of its own or prescribes a motion."""
    return not stateful(forces) and prescribed(forces) is None


def checked(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Returns the forces as elements, which may have no state."""
    check_linkage(linkage)
    found = elements_on(linkage, forces)
    if depends_on_state_alone(found):
        return of_full_size(linkage, found)
    raise ValueError(
        "forces: expected elements without a state of their own and no "
        f"PrescribedMotion, got {shown(forces)}."
    )


def total_effort(
    linkage: Linkage, forces: tuple[Element, ...], t: Array, q: Array, qd: Array
) -> Array:
    """Computes the sum of the efforts of elements without a state [N or N m]."""
    rows = enumerate(forces)
    efforts = (element_effort(k, e, t, q, qd, linkage, ())[0] for k, e in rows)
    return sum(efforts, jnp.zeros_like(q))


@accepts_scene
def linearize(
    linkage: Linkage, state: State, forces: Forces = (), t: ArrayLike = 0.0
) -> Linearization:
    """Linearises the equations of motion about a state, at a time.

    **Arguments:** `linkage`; `state`: joint positions and velocities; `forces`:
    elements without a state of their own; `t`: time at which they are evaluated [s]. A
    `Scene` may stand for linkage and forces: `linearize(scene, state, t)`. By default
    the state is then the scene's start.

    **Returns:** `A` and `B` of d(q, qd)/dt = A (q, qd) + B tau, for small changes. The
    efforts tau act in the joints in addition to the forces [N or N m]. For a force with
    kinks, the slope at the state counts: a controller at its limit has no gains.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> hanging = start._replace(q=np.array([-np.pi / 2, 0, 0]))
    >>> linear = fj.linearize(arm, hanging)
    >>> np.sort(abs(np.linalg.eigvals(linear.A)))[::2].tolist()  # modes [rad/s]
    [2.02, 4.744, 7.855]
    """
    forces = checked(linkage, forces)
    q, qd = map(jnp.asarray, real_state("state", state, linkage))
    return _linearized(linkage, forces, q, qd, real_array("t", t, ()))


@eqx.filter_jit
def _linearized(
    linkage: Linkage, forces: tuple[Element, ...], q: Array, qd: Array, t: Array
) -> Linearization:
    def rates(y):
        q, qd, tau = (without_fixed(linkage, part) for part in jnp.split(y, 3))
        tau = tau + total_effort(linkage, forces, t, q, qd)
        return jnp.concatenate([qd, forward_dynamics(linkage, q, qd, tau, forces)])

    slopes = jax.jacfwd(rates)(jnp.concatenate([q, qd, jnp.zeros_like(q)]))
    return Linearization(*jnp.split(slopes, [2 * q.size], axis=1))


@eqx.filter_jit
def _each_linearized(
    linkage: Linkage, forces: Forces, *rows: Array
) -> Float[Array, "time state state"]:
    """Returns A for rows of positions, velocities and times."""
    # A loop compiles in two thirds of the time of `jax.vmap`, and runs four times as
    # fast (101 times of Fig 7, one core).
    return jax.lax.map(lambda row: _linearized(linkage, forces, *row).A, rows)


def _with_references(element: Element, changed: Callable[[Any], Any]) -> Element:
    """Returns an element with its references changed, also those of commands."""

    def of(part: Any) -> Any:
        if isinstance(part, PDController):  # whose reference may be a plain function
            return eqx.tree_at(lambda pd: pd.reference, part, changed(part.reference))
        return changed(part) if isinstance(part, Reference) else part

    held = lambda part: isinstance(part, PDController | Reference)
    return jax.tree.map(of, element, is_leaf=held)


@eqx.filter_jit
def loop_matrices(
    linkage: Linkage, controller: Element, forces: tuple[Element, ...], q: Array, t: Any
) -> tuple[Array, Array, Array, Array]:
    """Linearises an arm under a controller about rest at `q`: A, B, C and F.

    The state y is (q, qd, the controller's own): dy/dt = A y + B tau with efforts tau
    added to the controller's, which are -C y. Constant efforts hold the arm at rest.
    Changes of the reference's positions, velocities and accelerations at the time add
    F (3, state, n) to dy/dt.
    """
    own, rebuilt = ravel_pytree(controller.initial_state(linkage))
    n, still = q.size, jnp.zeros_like(q)
    inverse = jnp.linalg.inv(mass_matrix(linkage, q, forces))
    inverse = jnp.where(jnp.stack(fixed_pairs(linkage.ef)), 0, inverse)
    B = jnp.concatenate([jnp.zeros((n, n)), inverse, jnp.zeros((own.size, n))])

    def acting(y):
        q, qd, _ = jnp.split(y, [n, 2 * n])
        weight = bias_force(linkage, q, still, forces)
        return total_effort(linkage, forces, t, q, qd) - weight

    def respond(y, change):
        q, qd, own = jnp.split(y, [n, 2 * n])

        def moved(reference):
            def at(time, linkage):
                position, velocity = reference_motion(reference, time, linkage)
                by, rate, growth = change
                since = time - t
                position = position + by + since * (rate + since / 2 * growth)
                return position, velocity + rate + since * growth

            return at

        led = _with_references(controller, moved)
        effort, rate = led.act(t, q, qd, linkage, rebuilt(own))
        return jnp.concatenate([effort, ravel_pytree(rate)[0]])

    # At rest neither M^-1, multiplied by no effort, nor Coriolis forces have a slope.
    y = jnp.concatenate([q, still, own])
    alone = jax.jacfwd(acting)(y)
    slopes, by_reference = jax.jacfwd(respond, (0, 1))(y, jnp.zeros((3, n)))
    efforts, rates = slopes[:n], slopes[n:]
    moved = jnp.concatenate([jnp.eye(n, len(y), n), jnp.zeros((n, len(y))), rates])
    F = jnp.concatenate([jnp.zeros((3, 2 * n, n)), by_reference[n:].swapaxes(0, 1)], 1)
    F = F + B @ by_reference[:n].swapaxes(0, 1)
    return moved + B @ (alone + efforts), B, -efforts, F


class Modes(NamedTuple):
    """Eigenvalues of the matrix A along a motion, the fastest last.

    - `eigenvalues`: (time, mode) [1/s], two for each joint that moves; NaN where the
      motion is NaN.
    """

    eigenvalues: Complex[np.ndarray, "time mode"]

    @property
    def frequency(self) -> Float[np.ndarray, "time mode"]:
        """Natural frequencies, the eigenvalues' magnitudes [rad/s]."""
        return np.abs(self.eigenvalues)

    @property
    def damping(self) -> Float[np.ndarray, "time mode"]:
        """Damping ratios: 1 or -1 for real eigenvalues, NaN for zero."""
        with np.errstate(invalid="ignore"):
            return -np.real(self.eigenvalues) / self.frequency

    @property
    def longest_step(self) -> Float[np.ndarray, " time"]:
        """Longest step sizes at which a Runge-Kutta method of order 4 is stable [s].

        The rule holds for any damping: 2.6 over the fastest frequency.
        """
        with np.errstate(divide="ignore"):
            return _STABLE / self.frequency.max(axis=1)


def closed_loop_modes(linkage: Linkage, forces: Forces, solution: Solution) -> Modes:
    """Computes the eigenvalues of the linearised equations at each time of a motion.

    Each state is analysed as if the arm stayed in it. Along a path that changes as fast
    as the modes, stable eigenvalues do not prove stability. While a controller is at
    its limit, the gains of that joint do not act.

    NumPy computes the eigenvalues on the CPU, as XLA has those of general matrices only
    there. The function cannot be used within JAX's transformations.

    **Arguments:** `linkage`; `forces`: elements without a state of their own;
    `solution`: a motion under these forces.

    **Returns:** `Modes`, with natural frequencies [rad/s], damping ratios and the
    longest step size of an explicit method [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> modes = fj.analysis.closed_loop_modes(arm, forces, motion)
    >>> modes.frequency[-1].tolist()  # [rad/s]
    [5.943, 5.943, 20.677, 20.677, 118.149, 118.149]
    >>> float(modes.longest_step[-1])  # [s]
    0.022
    """
    forces = checked(linkage, forces)
    instance("solution", solution, Solution)
    if is_traced(linkage, forces, solution) or solution.q.ndim != 2:
        raise ValueError(
            "solution: expected one motion, outside of JAX's transformations, got "
            f"positions {solution.q}."
        )
    check_joints("solution", solution, linkage)
    # Without its statistics: solvers differ in them, and need no program each.
    rows = solution.q, solution.qd, solution.ts
    moving = np.array(moving_joints(linkage), int)
    kept = np.append(moving, joints_of(linkage) + moving)  # fixed pairs have no modes
    A = np.asarray(_each_linearized(linkage, forces, *rows))[:, kept[:, None], kept]
    known = np.isfinite(A).all(axis=(1, 2))
    values = np.full(A.shape[:2], np.nan, complex)
    values[known] = np.linalg.eigvals(A[known])
    order = np.argsort(np.abs(values), axis=1)
    return Modes(np.take_along_axis(values, order, axis=1))
