"""diffrax's `diffeqsolve` without run-time checks, which call back into Python.

JAX 0.10 keeps no program with such calls in its persistent cache, and no version can
export one. diffrax makes them to check that the first step has the right sign, and that
output times increase and lie within the solve. `simulate` ensures this itself, or
reports it in its result. Here both arguments reach diffrax in a form that leaves
nothing to check; checks by a user's own code stay.

Equinox has a switch for all its checks, but one for the whole process. It would also
switch off those of other threads, and those that JAX has traced once for equal shapes.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
from jax import Array

from .step_wrappers import Adaptive


def diffeqsolve(
    *arguments: Any, dt0: Any, saveat: Any, stepsize_controller: Any, **keywords: Any
) -> diffrax.Solution:
    """Calls `diffrax.diffeqsolve` without its checks of `dt0` and of output times."""
    if dt0 is not None:
        adaptive = isinstance(
            stepsize_controller, diffrax.AbstractAdaptiveStepSizeController
        )
        first: Any = _AdaptiveFirstStep if adaptive else _FirstStep
        stepsize_controller = first(stepsize_controller, dt0)
    return diffrax.diffeqsolve(
        *arguments,
        dt0=None,
        saveat=eqx.tree_at(_output_times, saveat, replace_fn=_Times),
        stepsize_controller=stepsize_controller,
        **keywords,
    )


def _output_times(saveat: diffrax.SaveAt) -> list[Array]:
    one = lambda node: isinstance(node, diffrax.SubSaveAt)
    found = [sub.ts for sub in jax.tree.leaves(saveat.subs, is_leaf=one)]
    return [ts for ts in found if ts is not None]


class _Times(eqx.Module):
    """An array of output times of which comparisons as a whole find no fault."""

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
        found = self.values[index]
        return found if found.ndim == 0 else _Times(found)

    def __lt__(self, other):
        return False

    __gt__ = __lt__


class _FirstStep(diffrax.AbstractStepSizeController):
    """A controller that brings its first step size [s]."""

    controller: Any
    dt0: Any

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, inner)

    def init(self, terms, t0, t1, y0, dt0, *rest):
        return self.controller.init(terms, t0, t1, y0, self.dt0, *rest)

    def adapt_step_size(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.adapt_step_size(*arguments)


class _AdaptiveFirstStep(_FirstStep, Adaptive):
    """An adaptive controller that brings its first step size [s]."""

    controller: Any
    dt0: Any
