"""The modes of differentiation that tests ask for by name, and their compilation."""

import diffrax
import jax

from fdof_jax.base.configuration import options_of_loops

# By default `jax.grad` in a few numbers takes tangents. With a checkpoint at each step
# no part of a motion is repeated with other rounding, which could accept other steps.
ADJOINT = diffrax.RecursiveCheckpointAdjoint(checkpoints=1024)

# Programs of derivatives are long: before JAX 0.11 they are compiled as the library
# compiles motions and searches, in less time than by the default of `jax.jit`.
LOOPS = dict(compiler_options=options_of_loops())


def twice(function):
    """Returns a program for second derivatives, and a pair: first ones, and values.

    All are by forward mode, in one compilation.
    """

    def first(x):
        values = function(x)
        return values, values

    def second(x):
        slopes, values = jax.jacfwd(first, has_aux=True)(x)
        return slopes, (slopes, values)

    return jax.jit(jax.jacfwd(second, has_aux=True), **LOOPS)
