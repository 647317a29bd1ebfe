"""The modes of differentiation that tests ask for by name, and their compilation."""

from functools import partial

import diffrax
import jax
import numpy as np

from fdof_jax.base.configuration import options_of_loops

# By default `jax.grad` in a few numbers takes tangents. With a checkpoint at each step
# no part of a motion is repeated with other rounding, which could accept other steps.
ADJOINT = diffrax.RecursiveCheckpointAdjoint(checkpoints=1024)

# Programs of derivatives are long: before JAX 0.11 they are compiled as the library
# compiles motions and searches, in less time than by the default of `jax.jit`.
LOOPS = dict(compiler_options=options_of_loops())


def jacobian(function):
    """Returns a function for the Jacobian in forward mode, and the values.

    It takes one direction at a time. `jax.jacfwd` takes all at once, which is traced
    and compiled for half as long again; a second derivative, for twice as long.
    """

    @partial(jax.jit, **LOOPS)
    def along(x, direction, *rest):
        return jax.jvp(lambda x: function(x, *rest), (x,), (direction,))

    def of(x, *rest):
        found = [along(x, axis, *rest) for axis in np.eye(len(x))]
        columns = [column for _, column in found]
        return jax.tree.map(lambda *c: np.stack(c, -1), *columns), found[0][0]

    return of


def hessian(function):
    """Returns a function for second derivatives, the Jacobian and the values."""

    def first(x, direction):
        return jax.jvp(function, (x,), (direction,))

    second = jacobian(first)

    def of(x):
        found = [second(x, axis) for axis in np.eye(len(x))]
        slopes, curves = zip(*(columns for columns, _ in found))
        return np.stack(curves, -1), slopes[0], found[0][1][0]

    return of
