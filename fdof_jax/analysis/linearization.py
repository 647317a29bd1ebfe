"""Linear analysis for control: A and B, modes, equilibria, the regressor."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..checks import callable_tuple, instance, is_traced, real_array
from ..dynamics import forward_dynamics, inverse_dynamics
from ..forces.element import Forces, StatefulElement
from ..forces.points import dot, frames_of
from ..linkage.linkage import Linkage, State, check_linkage, compiled, real_state
from ..simulation.prescribed import prescribed
from ..simulation.solution import Solution

# Explicit Runge-Kutta methods of order 4 in 4 stages damp every mode that is damped if
# the step times |eigenvalue| is below this; undamped and overdamped ones up to 2.8.
_STABLE = 2.6


class Linearization(NamedTuple):
    """d(q, qd)/dt = A (q, qd) + B tau, about a state: (6, 6) and (6, 3).

    For small changes of positions [m or rad], velocities and efforts [N or N m].
    """

    A: Float[Array, "6 6"]
    B: Float[Array, "6 joint"]


def _accelerations(
    linkage: Linkage, forces: Forces, q: Array, qd: Array, tau: Array, t: Array
) -> Array:
    for element in forces:
        tau = tau + element(t, q, qd, linkage)
    return forward_dynamics(linkage, q, qd, tau, forces)


def _check(linkage: Linkage, forces: Forces) -> None:
    check_linkage(linkage)
    callable_tuple("forces", forces)
    stateful = any(isinstance(element, StatefulElement) for element in forces)
    if stateful or prescribed(forces) is not None:
        raise ValueError(
            "forces: expected elements without a state of their own and no "
            f"PrescribedMotion, got {forces!r}."
        )


def linearize(
    linkage: Linkage, forces: Forces, state: State, t: ArrayLike = 0.0
) -> Linearization:
    """The equations of motion to first order about a state, at a time.

    **Arguments:** the linkage; force elements without a state of their own; `state`:
    joint positions and velocities; `t`: the time that the elements are given [s].

    **Returns:** `A` and `B` of d(q, qd)/dt = A (q, qd) + B tau, for small changes; tau
    are efforts in the joints besides those of the forces [N or N m]. Of a force with
    kinks the slope where it is: a controller at its limit has no gains.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> hanging = start._replace(q=np.array([-np.pi / 2, 0, 0]))
    >>> linear = fj.linearize(arm, (), hanging)
    >>> np.sort(abs(np.linalg.eigvals(linear.A)))[::2].tolist()  # modes [rad/s]
    [2.02, 4.744, 7.855]
    """
    _check(linkage, forces)
    q, qd = map(jnp.asarray, real_state("state", state))
    return _linearized(linkage, forces, q, qd, real_array("t", t, ()))


@eqx.filter_jit
def _linearized(
    linkage: Linkage, forces: Forces, q: Array, qd: Array, t: Array
) -> Linearization:
    def rates(y):
        q, qd, tau = jnp.split(y, 3)
        return jnp.concatenate([qd, _accelerations(linkage, forces, q, qd, tau, t)])

    slopes = jax.jacfwd(rates)(jnp.concatenate([q, qd, jnp.zeros_like(q)]))
    return Linearization(slopes[:, :6], slopes[:, 6:])


class Modes(eqx.Module):
    """The eigenvalues of A along a motion, the fastest last.

    - `eigenvalues`: (time, 6) [1/s]; NaN where the motion is.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> modes = fj.closed_loop_modes(arm, forces, motion)
    >>> modes.eigenvalues.shape, float(modes.longest_step[-1])  # [s]
    ((101, 6), 0.022)
    """

    eigenvalues: Complex[np.ndarray, "time 6"]

    @property
    def frequency(self) -> Float[np.ndarray, "time 6"]:
        """Natural frequencies, the eigenvalues' magnitudes [rad/s]."""
        return np.abs(self.eigenvalues)

    @property
    def damping(self) -> Float[np.ndarray, "time 6"]:
        """Damping ratios: 1 or -1 for real eigenvalues, NaN for one of 0."""
        with np.errstate(invalid="ignore"):
            return -np.real(self.eigenvalues) / self.frequency

    @property
    def longest_step(self) -> Float[np.ndarray, " time"]:
        """The longest steps at which a method of Runge-Kutta of order 4 is stable [s].

        By a rule for any damping: 2.6 over the fastest frequency.
        """
        with np.errstate(divide="ignore"):
            return _STABLE / self.frequency.max(axis=1)


def closed_loop_modes(linkage: Linkage, forces: Forces, solution: Solution) -> Modes:
    """Eigenvalues of the linearised equations, at each time of a motion.

    A local picture, of an arm that stays as it is at that time: along a path that
    changes as fast as the modes do, stable eigenvalues do not prove stability. A
    joint whose controller is at its limit shows as one whose gains do not act.

    Computed on the CPU, by NumPy, as XLA has eigenvalues of general matrices there
    only: not for use within JAX's transformations.

    **Arguments:** the linkage; force elements without a state of their own; a solution
    that they took part in.

    **Returns:** `Modes`, with natural frequencies [rad/s], damping ratios and the
    longest step of an explicit method [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> modes = fj.closed_loop_modes(arm, forces, motion)
    >>> modes.frequency[-1].tolist()  # [rad/s]
    [5.943, 5.943, 20.677, 20.677, 118.149, 118.149]
    """
    _check(linkage, forces)
    instance("solution", solution, Solution)
    if is_traced(linkage, forces, solution) or solution.q.ndim != 2:
        raise ValueError(
            "solution: expected one motion, outside of JAX's transformations, got "
            f"positions {solution.q}."
        )
    rows = solution.q, solution.qd, solution.ts
    each = jax.vmap(lambda *row: _linearized(linkage, forces, *row).A)
    A = np.asarray(each(*rows))
    known = np.isfinite(A).all(axis=(1, 2))
    values = np.full(A.shape[:2], np.nan, complex)
    values[known] = np.linalg.eigvals(A[known])
    order = np.argsort(np.abs(values), axis=1)
    return Modes(np.take_along_axis(values, order, axis=1))


def equilibrium(
    linkage: Linkage, forces: Forces, q: ArrayLike, t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """Joint positions near `q` at which the arm stays at rest under its forces.

    An operating point for `linearize`: under a PD controller, the position that it
    holds while the reference stands still, its sag included.

    **Arguments:** the linkage; force elements without a state of their own; `q`: a
    first guess [m or rad]; `t`: the time that the elements are given [s].

    **Returns:** positions (3,); NaN where Levenberg and Marquardt's method finds none,
    from a guess at which actuators are at their limits for instance. It need not be
    stable: see `linearize`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.equilibrium(arm, (), [-1.0, 0.1, 0.1]).tolist()  # it hangs
    [-1.571, 0.0, 0.0]
    """
    _check(linkage, forces)
    return _rest(linkage, forces, real_array("q", q, (3,)), real_array("t", t, ()))


@eqx.filter_jit
def _rest(linkage: Linkage, forces: Forces, q: Array, t: Array) -> Array:
    still = jnp.zeros(3)

    def efforts(q, _):
        total = -inverse_dynamics(linkage, q, still, still, forces)
        for element in forces:
            total = total + element(t, q, still, linkage)
        return total

    # Efforts over what rounds them: stiff controllers are as exact as soft springs.
    slopes = jnp.abs(jax.jacfwd(efforts)(q, None))
    size = jax.lax.stop_gradient(
        slopes @ (1 + jnp.abs(q)) + jnp.abs(efforts(q, None)) + 1
    )
    tight = 1e3 * float(jnp.finfo(q.dtype).eps)
    solver = optimistix.LevenbergMarquardt(rtol=tight, atol=tight)
    relative = lambda q, _: efforts(q, None) / size
    found = optimistix.root_find(relative, solver, q, throw=False)
    good = found.result == optimistix.RESULTS.successful
    # Not by `where`: where none is found the derivative is NaN too.
    return found.value * jnp.where(good, 1, jnp.nan)


def holding_efforts(
    linkage: Linkage, q: ArrayLike, forces: Forces = ()
) -> Float[Array, " joint"]:
    """The joint efforts that hold the arm at rest against gravity [N or N m].

    **Arguments:** the linkage; `q`: joint positions [m or rad]; `forces`: elements
    whose masses are held too.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.holding_efforts(arm, [0, 0, 0]).tolist()
    [58.86, 29.43, 9.81]
    """
    still = jnp.zeros(3)
    return inverse_dynamics(linkage, q, still, still, forces)


def inertial_parameters(linkage: Linkage) -> Float[Array, "link 4"]:
    """Per link: mass [kg], its moments m p, m q [kg m], and inertia about the start.

    In these the dynamics are linear: see `regressor`. The inertia [kg m^2] is about the
    characteristic point of the link.

    **Raises:** ValueError for what is not a linkage.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig3().linkage
    >>> fj.inertial_parameters(arm)[0].tolist()  # m, m p, m q, I about the pivot
    [5.0, 2.5, -5.0, 6.25]
    """
    check_linkage(linkage)
    m, (p, q) = linkage.mass, linkage.com.T
    return jnp.stack([m, m * p, m * q, linkage.inertia + m * (p**2 + q**2)], axis=1)


@compiled(q=(3,), qd=(3,), qdd=(3,))
def regressor(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    qdd: Float[Array, " joint"],
) -> Float[Array, "joint link 4"]:
    """What multiplies the inertial parameters in the inverse dynamics.

    tau = regressor : `inertial_parameters(linkage)`, summed over links and parameters;
    the masses and inertias of the linkage do not count. By Lagrange's equations for one
    parameter at a time.

    Stacked over a motion its rank tells how many combinations of the parameters can be
    identified: nine of the twelve for an RPR arm.

    **Arguments:** the linkage; `q`, `qd`, `qdd`: joint positions, velocities and
    accelerations (3,) [m or rad, and per s and s^2].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import numpy as np
    >>> state = [0.1, 0.2, 0.3], [1, 0, -1], [0.5, 0.5, 0.5]
    >>> np.tensordot(fj.regressor(arm, *state), fj.inertial_parameters(arm), 2).tolist()
    [68.982, 35.32, 11.766]
    >>> fj.inverse_dynamics(arm, *state).tolist()
    [68.982, 35.32, 11.766]
    """

    def parts(q):
        frames = frames_of(linkage, tuple(q))
        start, direction = (jnp.stack(rows[1:]) for rows in frames[:2])
        return start, direction

    def lagrangians(q, qd):
        """Of unit parameters, (3, 4)."""
        (start, along), (velocity, turning) = jax.jvp(parts, (q,), (qd,))
        # d(direction)/dt = i rate direction.
        rate = jnp.imag(turning * jnp.conj(along))
        g = linkage.gravity
        return jnp.stack(
            [
                dot(velocity, velocity) / 2 - g * start.imag,
                dot(velocity, turning) - g * along.imag,
                dot(velocity, 1j * turning) - g * (1j * along).imag,
                rate**2 / 2,
            ],
            axis=1,
        )

    momenta = lambda q, qd: jax.jacfwd(lagrangians, argnums=1)(q, qd)
    _, change = jax.jvp(momenta, (q, qd), (qd, qdd))
    slopes = jax.jacfwd(lagrangians, argnums=0)(q, qd)
    return jnp.moveaxis(change - slopes, -1, 0)
