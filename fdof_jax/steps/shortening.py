"""A step size controller that also shortens the step after a kept one."""

import diffrax
import jax.numpy as jnp

from .dopri8 import constant


class Shortening(diffrax.PIDController):
    """An integral controller whose kept steps may make the next one shorter.

    After a step that it keeps, diffrax's controller never takes a shorter one, even if
    the error has come close to the tolerance: the next step is then often rejected. In
    a batch of Fig 5 that is every fifth step.
    """

    safety: float = 0.8  # pyright: ignore[reportIncompatibleVariableOverride]

    def adapt_step_size(self, t0, t1, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        keep, next_t0, next_t1, *rest, state, result = super().adapt_step_size(
            t0, t1, *arguments
        )
        order, _ = arguments[-2:]
        inverse_error, *_ = state  # of a step that is kept; 1 stands for no error
        factor = constant(self.safety * inverse_error ** (self.icoeff / order))
        shorter = (t1 - t0) * jnp.maximum(factor, self.factormin)
        if self.dtmin is not None:
            shorter = jnp.maximum(shorter, self.dtmin)
        shortened = keep & (factor < 1) & (inverse_error != 1)
        next_t1 = jnp.where(shortened, next_t0 + shorter, next_t1)
        return keep, next_t0, next_t1, *rest, state, result
