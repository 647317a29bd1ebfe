"""diffrax's `diffeqsolve` without run-time checks, which call back into Python.

JAX 0.10 keeps no program with such calls in its persistent cache, and no version can
export one. diffrax makes them to check that the first step has the right sign, and that
output times increase and lie within the solve. `simulate` ensures this itself, or
reports it in its result. Here both arguments reach diffrax in a form that leaves
nothing to check; checks by a user's own code stay.

Equinox can switch off its checks for the whole process only: also those of other
threads, and those in functions that JAX traces meanwhile and then keeps.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from .controllers import Adaptive, Judging, giving_up


def diffeqsolve(
    *arguments: Any,
    dt0: Array | float | None,
    saveat: diffrax.SaveAt,
    stepsize_controller: diffrax.AbstractStepSizeController,
    max_steps: Any,  # int | Array | None
    **keywords: Any,
) -> diffrax.Solution:
    """Calls `diffrax.diffeqsolve` without its checks of `dt0` and of output times.

    `max_steps` may also be an array; new values then need no new program.
    """
    adaptive = isinstance(stepsize_controller, Judging)
    frame: Any = _FramedAdaptive if adaptive else _Framed
    counted = max_steps is not None and not isinstance(max_steps, int)
    solution = diffrax.diffeqsolve(
        *arguments,
        dt0=None,
        saveat=eqx.tree_at(_output_times, saveat, replace_fn=_Times),
        stepsize_controller=frame(
            stepsize_controller, dt0, max_steps if counted else None
        ),
        max_steps=None if counted else max_steps,
        **keywords,
    )
    if not (counted and saveat.controller_state):
        return solution
    assert solution.controller_state is not None
    state, *_ = solution.controller_state
    return eqx.tree_at(lambda s: s.controller_state, solution, state)


def _output_times(saveat: diffrax.SaveAt) -> list[Array]:
    one = lambda node: isinstance(node, diffrax.SubSaveAt)
    times = [sub.ts for sub in jax.tree.leaves(saveat.subs, is_leaf=one)]
    return [ts for ts in times if ts is not None]


class _Times(eqx.Module):
    """Output times whose comparisons as a whole are false: diffrax finds no fault."""

    values: Array

    @property
    def dtype(self):
        return self.values.dtype

    def astype(self, dtype):
        return _Times(self.values.astype(dtype))

    def __len__(self):
        return len(self.values)

    def __mul__(self, direction):
        return _Times(self.values * direction)

    def __getitem__(self, index):
        entry = self.values[index]
        return entry if entry.ndim == 0 else _Times(entry)

    def __lt__(self, other):
        return False

    __gt__ = __lt__


class _Framed(diffrax.AbstractStepSizeController):
    """A controller with its own first step size [s] and greatest number of steps."""

    controller: Any
    dt0: Array | float | None
    most: Array | None

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, inner)

    def init(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        *before, _, args, func, order = arguments
        first, state = self.controller.init(*before, self.dt0, args, func, order)
        if self.most is None:
            return first, state
        _, _, end, *_ = arguments
        return first, (state, jnp.zeros((), jnp.int32), jax.lax.stop_gradient(end))

    def adapt_step_size(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        if self.most is None:
            return self.controller.adapt_step_size(*arguments)
        *arguments, (state, count, end) = arguments
        *step, state, result = self.controller.adapt_step_size(*arguments, state)
        _, start, *_ = step
        count = count + 1
        spent = (count >= self.most) & (start < end)
        result = giving_up(result, spent, diffrax.RESULTS.max_steps_reached)
        return *step, (state, count, end), result


class _FramedAdaptive(_Framed, Adaptive):  # pyright: ignore[reportIncompatibleMethodOverride]
    """As `_Framed`, of an adaptive controller."""
