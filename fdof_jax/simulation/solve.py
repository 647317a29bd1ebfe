"""Solves a motion: of one arm at a prompt, in a batch, with derivatives."""

import dataclasses
import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import concrete, is_traced
from ..base.configuration import options_of_loops
from ..base.functions import sharing_functions
from ..forces.added_inertia import inertial
from ..forces.element import ForeignElement
from ..steps.derivative_control import TangentJudge
from ..steps.tolerances import at_tolerances, with_pid
from ..steps.unrolled_dopri8 import UnrolledDopri8
from .integrate import Inputs, Settings, integrate
from .jacobian import along_each
from .prescribed import prescribed
from .solution import Solution

# All plain calls with at most this many output times share one program.
_FEWEST_TIMES = 2048


def solve(inputs: Inputs, keywords: Settings) -> tuple[Solution, bool | None]:
    """Computes a motion, and whether it succeeded: None within transformations."""
    # JAX traces even constants inside `jax.jit`, where a jitted function of our own
    # would only be traced once more.
    if is_traced(jax.device_put(np.zeros(()))):
        known = concrete(inputs.linkage.ef)
        # Within `vmap` even a tracer may hold a NumPy array, which rules of derivatives
        # refuse in JAX 0.10.
        arrays = jax.Array, np.ndarray, np.generic
        inputs = jax.tree.map(
            lambda x: jax.device_put(x) if isinstance(x, arrays) else x, inputs
        )
        if known is not None:
            inputs = inputs._replace(known_ef=tuple(known.tolist()))
        return _solve(inputs, keywords), None
    one = None if is_traced(inputs, keywords) else _solve_one(inputs, keywords)
    return one or (_solve_compiled(inputs, keywords), None)


def padded(rows: PyTree) -> PyTree:
    """Returns arrays (time, ...) with their last row repeated up to a power of two."""

    def longer(row: ArrayLike) -> np.ndarray:
        array = np.asarray(row)
        count = len(array)
        size = max(_FEWEST_TIMES, 1 << (count - 1).bit_length())
        others = ((0, 0),) * (array.ndim - 1)
        return np.pad(array, ((0, size - count), *others), mode="edge")

    return jax.tree.map(longer, rows)


def cut(rows: PyTree, count: int) -> PyTree:
    """Returns the first `count` rows of arrays (time, ...)."""
    # JAX slices and jnp.asarray would compile a program for each new shape.
    return jax.device_put(jax.tree.map(lambda row: np.asarray(row)[:count], rows))


@jax.transfer_guard("allow")  # the padded times are in NumPy
def _solve_one(inputs: Inputs, keywords: Settings) -> tuple[Solution, bool] | None:
    """Computes a motion from concrete inputs, and whether it succeeded.

    Returns None if a force element holds a traced value.
    """
    ts, keywords = inputs.ts, _of_any_tolerance(keywords)
    if (most := keywords["max_steps"]) is not None:
        # As data, of which programs know none.
        keywords |= {"max_steps": np.int32(most)}

    def run(forces):
        if is_traced(forces):  # by the closure of a function
            return None, None
        longer = inputs._replace(ts=padded(ts), forces=forces)
        # Another function's closure may hold one too, and JAX refuses options then.
        functions = any(map(callable, jax.tree.leaves(forces)))
        solve = _with_functions if functions else _without_functions
        return solve(longer, keywords)

    solution, succeeded = sharing_functions(run, forces=inputs.forces)
    if solution is None or is_traced(solution):
        return None
    # What has a row for each time.
    names = "q", "qd", "own", "modes", "taken", "tau"
    rows = {name: vars(solution)[name] for name in names} | {"ts": ts}
    rows = cut(rows, len(ts))
    stats = solution.stats | {"max_steps": most}
    solution = dataclasses.replace(solution, stats=stats, **rows)
    return solution, bool(succeeded)


def _of_any_tolerance(keywords):
    """Returns the keywords with tolerances as arrays, which programs do not contain."""
    controller = keywords["stepsize_controller"]
    dtype = jnp.result_type(float)
    if controller is not None:
        controller = with_pid(lambda pid: _in_arrays(pid, dtype), controller)
    elif keywords["solver"] is None:  # else which default it gets depends on it
        controller = _default_in_arrays(dtype)
    return keywords | {"stepsize_controller": controller}


def _in_arrays(pid: diffrax.PIDController, dtype: np.dtype) -> diffrax.PIDController:
    if eqx.is_array(pid.rtol) and eqx.is_array(pid.atol):
        return pid
    rtol, atol = (np.asarray(t, dtype) for t in (pid.rtol, pid.atol))
    return dataclasses.replace(pid, rtol=rtol, atol=atol)


@functools.cache
def _default_in_arrays(dtype: np.dtype) -> Any:
    return with_pid(lambda pid: _in_arrays(pid, dtype), at_tolerances(None, None))


def _solve_padded(inputs: Inputs, keywords) -> tuple[Solution, Array]:
    # The steps are those of the same call with forward-mode derivatives.
    derivatives = isinstance(keywords["adjoint"], diffrax.ForwardMode)
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    solution = integrate(inputs, keywords, derivatives, plain=True)
    return solution, solution.result == diffrax.RESULTS.successful


_with_functions = eqx.filter_jit(_solve_padded)
_without_functions = eqx.filter_jit(
    _solve_padded,
    compiler_options=options_of_loops(),  # pyright: ignore[reportCallIssue]
)


@eqx.filter_custom_vjp
def _integrate_reversibly(inputs: Inputs, keywords) -> Solution:
    """Integrates a motion that `jax.grad` may differentiate.

    Unrolled stages serve the plain solve alone, because they compile differently with
    derivatives: the backward pass must reproduce the same bits.
    """
    # The plain solve needs no loops for reverse mode, which take longer to compile.
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    if keywords["solver"] is None:
        # Thirteen unrolled copies of these equations would take minutes to compile.
        many = inertial(inputs.forces) or prescribed(inputs.forces)
        keywords["solver"] = diffrax.Dopri8() if many else UnrolledDopri8()
    return integrate(inputs, keywords)


# Up to so many numbers, tangents cost no more than the adjoint equations (one arm or
# 256), and compile in half the time.
_FEW = 12


def _few(moving, adjoint) -> bool:
    """Returns whether tangents in these numbers serve better than the adjoint.

    A given number of checkpoints asks for the adjoint.
    """
    leaves = jax.tree.leaves(moving)
    real = all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    few = sum(leaf.size for leaf in leaves) <= _FEW
    return real and few and adjoint.checkpoints is None


def _with_tangents(motion, moving):
    """Returns what `motion` returns and the states' tangents in each number."""
    start, whole = ravel_pytree(moving)
    # Along changes of each number by itself, tangents have the size of the motion.
    # What may be a rounding error says nothing about the size of changes.
    tiny = jnp.abs(start) < jnp.finfo(start.dtype).eps ** 0.5
    sizes = jnp.where(tiny, 1, jnp.abs(start))
    shifted = lambda numbers: motion(whole(numbers))
    states, tangents, solution = along_each(shifted, start, jnp.diag(sizes))
    by_size = lambda rows: rows / sizes.reshape(-1, *[1] * (rows.ndim - 1))
    tangents = jax.tree.map(by_size, tangents)
    return states, tangents, solution


@_integrate_reversibly.def_fwd
def _integrate_reversibly_fwd(perturbed, inputs, keywords):
    moving, fixed = eqx.partition(inputs, perturbed)
    few = _few(moving, keywords["adjoint"])
    if few:
        keywords = keywords | {"adjoint": diffrax.ForwardMode()}

    judge = TangentJudge() if few else None

    def motion(moving):
        inputs = eqx.combine(moving, fixed)
        solution = integrate(inputs, keywords, derivatives=True, tangents=judge)
        return solution.states, solution

    if few:
        states, tangents, solution = _with_tangents(motion, moving)
        return solution, (tangents, states)
    states, pull_back, solution = eqx.filter_vjp(motion, moving, has_aux=True)
    return solution, (pull_back, states)


@_integrate_reversibly.def_bwd
def _integrate_reversibly_bwd(residuals, cotangent, perturbed, inputs, keywords):
    slopes, states = residuals
    wanted = eqx.combine(cotangent.states, jax.tree.map(jnp.zeros_like, states))
    moving = eqx.filter(inputs, perturbed)
    if not _few(moving, keywords["adjoint"]):
        (gradient,) = slopes(wanted)
        return gradient
    start, whole = ravel_pytree(moving)

    def part(weight: Array, tangent: Array) -> Array:
        weight, tangent = weight.reshape(1, -1), tangent.reshape(len(start), -1)
        # States that were not reached are NaN and constant. A weight of 0 must not pick
        # up a tangent that is not finite.
        unused = (weight == 0) | (tangent == 0)
        return jnp.where(unused, 0, weight * tangent).sum(axis=1)

    parts = jax.tree.leaves(jax.tree.map(part, wanted, slopes))
    return whole(jnp.sum(jnp.stack(parts), axis=0))


def _opened(inputs: Inputs) -> Inputs:
    """Returns the inputs, with the closures of plain functions as leaves."""
    arguments = inputs.ts[0], *inputs.state0, inputs.linkage
    foreign = lambda node: isinstance(node, ForeignElement)
    forces = jax.tree.map(
        lambda node: node.opened(*arguments) if foreign(node) else node,
        inputs.forces,
        is_leaf=foreign,
    )
    return inputs._replace(forces=forces)


def _solve(inputs: Inputs, keywords) -> Solution:
    inputs = _opened(inputs)
    if isinstance(keywords["adjoint"], diffrax.RecursiveCheckpointAdjoint):
        return _integrate_reversibly(inputs, keywords)
    solution = integrate(inputs, keywords, derivatives=True)
    if not isinstance(keywords["adjoint"], diffrax.ForwardMode):
        return solution
    # JAX notices reverse mode only after this call, and would name its loop alone.
    return eqx.internal.nondifferentiable_backward(
        solution,
        msg="reverse-mode differentiation of simulate needs its default adjoint; "
        "diffrax.ForwardMode() serves jax.jvp and jax.jacfwd alone.",
    )


_solve_compiled = eqx.filter_jit(_solve)
