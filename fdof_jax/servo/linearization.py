"""Arms at rest, and linear analysis about them: matrices, loops and modes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from .. import (
    Element,
    Linkage,
    PDController,
    Solution,
    State,
    bias_force,
    forward_dynamics,
)
from ..checks import (
    check_free,
    check_joints,
    check_known,
    check_linkage,
    function,
    instance,
    per_joint,
    real_array,
    real_state,
    refusal,
)
from ..forces import elements_on, naming, present
from ..linkage import joints_of, moving_joints, without_fixed
from ..references import Reference
from ..simulation import PrescribedMotion, accepts_scene

Forces = tuple[Any, ...]  # elements, or callables (t, q, qd, linkage) -> tau

# Explicit Runge-Kutta methods of order 4 in 4 stages damp every damped mode if the step
# size times |eigenvalue| is below this (2.8 for undamped and overdamped modes).
_STABLE = 2.6


class Linearization(NamedTuple):
    """Matrices of d(q, qd)/dt = A (q, qd) + B tau about a state, (2n, 2n) and (2n, n).

    They hold for small changes of positions [m or rad] and efforts [N or N m].
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state joint"]


def _checked(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Returns the forces as elements, which may have no state and hold no joints."""
    check_linkage(linkage)
    acting = elements_on(linkage, forces)
    for index, element in enumerate(acting):
        check_free(name := f"forces[{index}]", element)
        state = jax.eval_shape(element.initial_state, linkage)
        if jax.tree.leaves(state) or isinstance(element, PrescribedMotion):
            expected = "an element without a state of its own and no PrescribedMotion"
            raise refusal(name, expected, element)
    return acting


def _efforts(
    linkage: Linkage, forces: tuple[Element, ...], t: Array, q: Array, qd: Array
) -> Array:
    """Sums the efforts of elements without states [N or N m]."""
    total = jnp.zeros_like(q)
    for index, element in enumerate(forces):
        with naming(name := f"forces[{index}]"):
            state = element.initial_state(linkage)
            effort, _ = element.act(t, q, qd, linkage, state)
        total += real_array(name, effort, q.shape, of="what it returns")
    return total


def equilibrium(
    linkage: Linkage, q: ArrayLike, forces: Forces = (), t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """Computes positions near `q` at which the arm stays at rest under its forces.

    Under a PD controller this is the position held, including the sag.

    **Arguments:** `q`: first guess [m or rad]; `forces`: elements without states; `t`:
    time at which they act [s].

    **Returns:** joint positions (n,), stable or not; NaN if the search finds none, for
    instance from a guess at which actuators are at their limits.

    **Raises:** ValueError for malformed arguments, and for elements that hold joints:
    with friction an arm rests at many positions.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.analysis.equilibrium(arm, [-1.0, 0.1, 0.1]).tolist()  # it hangs
    [-1.571, 0.0, 0.0]
    """
    forces = _checked(linkage, forces)
    return _rest(linkage, forces, per_joint("q", q, linkage), real_array("t", t, ()))


@eqx.filter_jit
def _rest(
    linkage: Linkage, forces: tuple[Element, ...], q: Array | np.ndarray, t: Array
) -> Array:
    q = without_fixed(linkage, q)

    def efforts(q):
        lacking = _lacking(linkage, forces, q, t)
        # A fixed pair is in equilibrium at 0.
        return jnp.where(linkage.fixed, -q, -lacking)

    # Efforts relative to their rounding errors' scale: stiff controllers converge as
    # exactly as soft springs.
    slopes = jnp.abs(jax.jacfwd(efforts)(q))
    size = jax.lax.stop_gradient(slopes @ (1 + jnp.abs(q)) + jnp.abs(efforts(q)) + 1)
    tight = 1e3 * float(jnp.finfo(q.dtype).eps)
    method = optimistix.LevenbergMarquardt(rtol=tight, atol=tight)

    def search(function, q):
        relative = lambda q, _: function(q)
        root = optimistix.root_find(relative, method, q, throw=False)
        good = root.result == optimistix.RESULTS.successful
        return jnp.where(good, root.value, jnp.nan)

    # optimistix alone would differentiate the least squares that the method minimises,
    # which takes second derivatives of the efforts.
    return jax.lax.custom_root(
        lambda q: efforts(q) / size,
        q,
        search,
        lambda slope, change: jnp.linalg.solve(jax.jacfwd(slope)(change), change),
    )


@eqx.filter_jit
def _lacking(
    linkage: Linkage, forces: tuple[Element, ...], q: Array | np.ndarray, t: Array
) -> Array:
    """Efforts that the arm needs beside the forces to stay at rest."""
    q, still = without_fixed(linkage, q), jnp.zeros_like(q)
    acting = _efforts(linkage, forces, t, q, still)
    bias = bias_force(linkage, q, still, present(forces, t))
    return without_fixed(linkage, bias - acting)


def holding_efforts(
    linkage: Linkage, q: ArrayLike, forces: Forces = (), t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """Computes the joint efforts that hold the arm at rest, together with the forces.

    Without forces the efforts balance gravity. Masses of elements are held too.

    **Arguments:** `q`: joint positions [m or rad]; `forces`, `t`: as in `equilibrium`.

    **Returns:** efforts (n,), 0 at fixed pairs [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.analysis.holding_efforts(arm, [0, 0, 0]).tolist()
    [58.86, 29.43, 9.81]
    >>> rope = fj.forces.Tension(fj.Point(0, 3, 1), fj.Point(3, 1), tension=9.81)
    >>> fj.analysis.holding_efforts(arm, [0, 0, 0], (rope,)).tolist()  # lifts the tip
    [29.43, 9.81, 0.0]
    """
    forces = _checked(linkage, forces)
    q, t = per_joint("q", q, linkage), real_array("t", t, ())
    return _lacking(linkage, forces, q, t)


@accepts_scene
def linearize(
    linkage: Linkage, state: State, forces: Forces = (), t: ArrayLike = 0.0
) -> Linearization:
    """Linearises the equations of motion about a state.

    **Arguments:** `state`: joint positions and velocities; `forces`: elements without
    states; `t`: time at which they act [s]. In `linearize(scene, state, t)`, the state
    is by default the scene's start.

    **Returns:** `A` and `B` of d(q, qd)/dt = A (q, qd) + B tau, for small changes. The
    efforts tau act in addition to the forces [N or N m]. Of a force with kinks, the
    slope at the state counts: a controller at its limit has no gains.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> hanging = start._replace(q=np.array([-np.pi / 2, 0, 0]))
    >>> linear = fj.linearize(arm, hanging)
    >>> np.sort(abs(np.linalg.eigvals(linear.A)))[::2].tolist()  # modes [rad/s]
    [2.02, 4.744, 7.855]
    """
    forces = _checked(linkage, forces)
    q, qd = map(jnp.asarray, real_state("state", state, linkage))
    t = real_array("t", t, ())
    return _linearized(linkage, forces, q, qd, t, jnp.zeros_like(q))


@eqx.filter_jit
def _linearized(
    linkage: Linkage,
    forces: tuple[Element, ...],
    q: Array | np.ndarray,
    qd: Array,
    t: Array,
    tau: Array,
) -> Linearization:
    """Linearises the equations under the forces and the efforts `tau`."""

    def rates(y):
        q, qd, tau = (without_fixed(linkage, part) for part in jnp.split(y, 3))
        tau = tau + _efforts(linkage, forces, t, q, qd)
        qdd = forward_dynamics(linkage, q, qd, tau, present(forces, t))
        return jnp.concatenate([qd, qdd])

    slopes = jax.jacfwd(rates)(jnp.concatenate([q, qd, tau]))
    return Linearization(*jnp.split(slopes, [2 * q.size], axis=1))


@eqx.filter_jit
def _each_linearized(
    linkage: Linkage, forces: Forces, rows: tuple[Array, Array, Array]
) -> Float[Array, "time state state"]:
    """Returns A for rows of positions, velocities and times."""

    def at(row):
        q, qd, t = row
        return _linearized(linkage, forces, q, qd, t, jnp.zeros_like(q)).A

    # A loop compiles in two thirds of the time of `jax.vmap`, and runs four times as
    # fast (101 times of Fig 7, one core).
    return jax.lax.map(at, rows)


def _with_references(
    element: Element, changed: Callable[[Callable], Callable]
) -> Element:
    """Returns an element with all its references changed."""

    def of(part: object) -> object:
        if isinstance(part, PDController):  # whose reference may be a plain function
            return eqx.tree_at(lambda pd: pd.reference, part, changed(part.reference))
        return changed(part) if isinstance(part, Reference) else part

    whole = lambda part: isinstance(part, PDController | Reference)
    return jax.tree.map(of, element, is_leaf=whole)


def loop_matrices(
    linkage: Linkage,
    q: ArrayLike,
    controller: Callable,
    forces: Forces = (),
    t: ArrayLike = 0.0,
) -> tuple[Array, Array, Array, Array]:
    """Linearises an arm under a controller about rest at `q`, as matrices.

    **Arguments:** as in `open_loop`, which makes a system of them.

    **Returns:** A, B, C and F (3, state, n) of dy/dt = A y + B tau. The state y is (q,
    qd, the controller's own). The efforts tau [N or N m] add to the controller's, which
    are -C y, and to constant ones that hold the arm at rest. Changes of the reference's
    positions, velocities and accelerations add F times these to dy/dt.

    **Raises:** ValueError for malformed arguments.
    """
    forces = _checked(linkage, forces)
    function("controller", controller, "a force element, a PDController for instance")
    (element,) = elements_on(linkage, (controller,))
    check_free("controller", element)
    if isinstance(element, PrescribedMotion):
        raise refusal("controller", "one that computes efforts", controller)
    q, t = per_joint("q", q, linkage), real_array("t", t, ())
    return _loop_matrices(linkage, element, forces, q, t)


@eqx.filter_jit
def _loop_matrices(
    linkage: Linkage,
    controller: Element,
    forces: tuple[Element, ...],
    q: Array | np.ndarray,
    t: Any,
) -> tuple[Array, Array, Array, Array]:
    own, rebuilt = ravel_pytree(controller.initial_state(linkage))
    n, still = q.size, jnp.zeros_like(q)
    hold = _lacking(linkage, forces, q, t)
    arm = _linearized(linkage, forces, q, still, t, hold)

    def respond(y, change):
        q, qd, own = jnp.split(y, [n, 2 * n])

        def displaced(reference):
            def at(time, linkage):
                position, velocity = map(jnp.asarray, reference(time, linkage))
                by, rate, growth = change
                since = time - t
                position = position + by + since * (rate + since / 2 * growth)
                return position, velocity + rate + since * growth

            return at

        element = _with_references(controller, displaced)
        effort, rate = element.act(t, q, qd, linkage, rebuilt(own))
        return jnp.concatenate([effort, ravel_pytree(rate)[0]])

    y = jnp.concatenate([q, still, own])
    slopes, by_reference = jax.jacfwd(respond, (0, 1))(y, jnp.zeros((3, n)))
    by_reference = by_reference.swapaxes(0, 1)
    A = jnp.pad(arm.A, (0, own.size)).at[2 * n :].set(slopes[n:])
    B = jnp.pad(arm.B, ((0, own.size), (0, 0)))
    F = jnp.pad(by_reference[:, n:], ((0, 0), (2 * n, 0), (0, 0)))
    return A + B @ slopes[:n], B, -slopes[:n], F + B @ by_reference[:, :n]


class Modes(NamedTuple):
    """Eigenvalues of the matrix A along a motion, the fastest last.

    - `eigenvalues`: (time, mode) [1/s], two per moving joint; NaN where the motion is.
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
        """Longest stable step sizes of Runge-Kutta methods of order 4 [s].

        They are 2.6 over the fastest frequency, for any damping.
        """
        with np.errstate(divide="ignore"):
            return _STABLE / self.frequency.max(axis=1)


def closed_loop_modes(linkage: Linkage, forces: Forces, solution: Solution) -> Modes:
    """Computes the eigenvalues of the linearised equations at each time of a motion.

    Each state is analysed as if the arm stayed in it. Along a path that changes as fast
    as the modes, stable eigenvalues do not prove stability. A controller at its limit
    has no gains. The function cannot be used within JAX's transformations.

    **Arguments:** `forces`: elements without states; `solution`: a motion under them.

    **Returns:** `Modes`, with frequencies [rad/s], damping ratios and stable steps [s].

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
    forces = _checked(linkage, forces)
    instance("solution", solution, Solution)
    check_known("solution", linkage, forces, solution)
    if solution.q.ndim != 2:
        expected = "one motion (of a batch, pass one member)"
        raise refusal("solution", expected, solution)
    check_joints("solution", solution, linkage)
    # Without its statistics: solvers differ in them, and need no program each.
    rows = solution.q, solution.qd, solution.ts
    moving = np.array(moving_joints(linkage), int)
    free = np.append(moving, joints_of(linkage) + moving)  # fixed pairs have no modes
    A = np.asarray(_each_linearized(linkage, forces, rows))[:, free[:, None], free]
    finite = np.isfinite(A).all(axis=(1, 2))
    values = np.full(A.shape[:2], np.nan, complex)
    values[finite] = np.linalg.eigvals(A[finite])
    order = np.argsort(np.abs(values), axis=1)
    return Modes(np.take_along_axis(values, order, axis=1))
