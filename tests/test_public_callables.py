"""Every public callable refuses wrong arguments by an error that is meant.

Each argument in turn is replaced by values of many kinds, as they are and traced, while
the others are right where the table knows them by name.
"""

import inspect
import warnings
from functools import partial

import diffrax
import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import search

ROOMS = (
    fj, fj.analysis, fj.control, fj.data, fj.forces, fj.identification, fj.linkage,
    fj.references, fj.tuning,
)  # fmt: skip
# JAX raises the last one for integers that no array holds.
MEANT = ValueError, TypeError, ImportError, RuntimeError, OverflowError
LEFT_OUT = {"configure"}  # it changes the whole process
FIG7, TS, ROWS = fj.scenes.fig7(), np.linspace(0, 1, 5), np.zeros((5, 3))
STATS = {"num_steps": np.array(3), "time_reached": np.array(1.0)}
MOTION = fj.Solution(TS, ROWS, ROWS, STATS, diffrax.RESULTS.successful)
TASK, ZERO, CHAIN = fj.CircleTask(), np.zeros(3), np.zeros(6)
RIGHT = dict(
    linkage=FIG7.linkage, state0=FIG7.state0, scene=FIG7, solution=MOTION, ts=TS,
    forces=(), q=ZERO, qd=ZERO, qdd=ZERO, tau=ZERO, x=CHAIN, xd=CHAIN, force=CHAIN,
    t=0.0, topology="RRR", tip=np.ones(2), orientation=0.0, reference=TASK, task=TASK,
    controller=FIG7.forces[0], point=fj.Point(1, 0.5), members=2,
)  # fmt: skip
WRONG = [
    None, 3, -1.5, b"x", [], {}, (), object(), FIG7, MOTION, FIG7.linkage, len, 1j,
    np.zeros((2, 0)), np.zeros(7), np.array(["a"]), float("nan"), [[1], [1, 2]], 10**30,
]  # fmt: skip
TRACED = [
    jax.ShapeDtypeStruct(shape, dtype)
    for shape in ((), (7,), (2, 3, 3), (0,))
    for dtype in (float, int, complex, bool)
]


def parameters():
    """Yields each parameter of each public callable, with a call that sets it alone."""
    names = {
        getattr(room, name): name
        for room in reversed(ROOMS)  # the first room's name stands
        for name in set(dir(room)) - LEFT_OUT
    }
    for function in sorted(filter(callable, names), key=names.__getitem__):
        given = inspect.signature(function).parameters.values()
        named = [p for p in given if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
        right = {p.name: RIGHT.get(p.name) for p in named if p.default is p.empty}
        for p in named:
            call = lambda wrong, f=function, r=right, n=p.name: f(**r | {n: wrong})
            yield names[function], p.name, call


def unlike_a_refusal(calls):
    """Returns the calls that raise an error of another kind."""
    found = []
    for name, parameter, wrong, call in calls:
        try:
            with warnings.catch_warnings(action="ignore"):
                call()
        except MEANT:
            pass
        except Exception as error:
            found.append(f"{name}({parameter}={wrong!r}): {error!r}")
    return found


@pytest.mark.slow
def test_values(monkeypatch):
    def accepted(*arguments):
        raise RuntimeError("The value was not refused, and the search begins.")

    # Searches take most of the time, and have tests of their own.
    monkeypatch.setattr(search, "_evaluate", accepted)
    assert not unlike_a_refusal(
        (name, parameter, wrong, partial(call, wrong))
        for name, parameter, call in parameters()
        for wrong in WRONG
        if wrong is not RIGHT.get(parameter)
    )


@pytest.mark.slow
def test_traced_values():
    """Of a batch, whose tracers hold those of a program."""
    wrong = [jax.ShapeDtypeStruct((2, *a.shape), a.dtype) for a in TRACED]
    found = []
    for name, parameter, call in parameters():

        def refuse(*values, known=(name, parameter), call=call):
            calls = [
                (*known, a, partial(call, value)) for a, value in zip(wrong, values)
            ]
            found.extend(unlike_a_refusal(calls))

        # One trace for all values, as a trace takes longer than most calls.
        jax.eval_shape(jax.vmap(refuse), *wrong)
    assert not found
