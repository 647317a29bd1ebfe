"""Value and gradient of a tracking loss: cost over the forward solve, and error.

The RPR arm of Fig 7 follows its circle for 4 s, at the limits of its efforts at first;
the loss is the mean squared distance of the tip, as a function of the logarithms of the
six gains. The error of a gradient is the norm of its difference from that at a
tolerance of 1e-12, over the norm; in a batch it is that of the worst member.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import fdof_jax as fj

from .measure import Case, measure

HORIZON = 4.0
TOLERANCE, TIGHT = 1e-8, 1e-12
SPREAD = 0.2  # of the logarithms in a batch
SCENE = fj.scenes.fig7()
(PD,) = SCENE.forces


def loss(options: dict, p: Array, horizon: Any, tolerance: Any, longest: Any) -> Array:
    """Returns the loss; `longest` bounds the steps where the tolerance does not."""
    ts, factor = jnp.linspace(0, 1, 201) * horizon, jnp.exp(p)
    pd = PD.replace(kp=PD.kp * factor[:3], kd=PD.kd * factor[3:])
    motion = fj.simulate(
        SCENE.linkage, SCENE.state0, ts, (pd,), rtol=tolerance, atol=tolerance,
        max_step=longest, throw=False, **options,
    )  # fmt: skip
    tip = jax.vmap(fj.tip_position, (None, 0))(SCENE.linkage, motion.q)
    return jnp.mean(jnp.sum((tip - jax.vmap(PD.reference.tip)(ts)) ** 2, axis=1))


def _forward(function: Callable) -> Callable:
    """Returns a function to value and gradient: one tangent per parameter."""

    def value_and_gradient(p, *settings):
        twice = lambda p: (function(p, *settings),) * 2
        return jax.jacfwd(twice, has_aux=True)(p)[::-1]

    return value_and_gradient


MODES: dict[str, tuple[Callable, dict]] = {
    "none": (lambda function: function, {}),
    "forward": (_forward, {"adjoint": diffrax.ForwardMode()}),
    "reverse": (jax.value_and_grad, {}),
}


def compiled(mode: str) -> Callable:
    """Compiles a function of p (possibly a batch), horizon, tolerance, longest step."""
    transform, options = MODES[mode]
    function = transform(partial(loss, options))

    @jax.jit
    def run(p, horizon, tolerance, longest):
        one = lambda p: function(p, horizon, tolerance, longest)
        return one(p) if p.ndim == 1 else jax.vmap(one)(p)

    return run


def parameters(batch: int) -> Array:
    p = np.random.default_rng(4).uniform(-SPREAD, SPREAD, (batch, 6))
    return jnp.asarray(p[0] if batch == 1 else p)


def _judge(exact: np.ndarray, result: Any) -> dict:
    difference = np.linalg.norm(np.asarray(result[1]) - exact, axis=-1)
    return {"error": float((difference / np.linalg.norm(exact, axis=-1)).max())}


def run(quick: bool) -> Iterator[dict]:
    for batch in (1, 8) if quick else (1, 256):
        runs, p = {mode: compiled(mode) for mode in MODES}, parameters(batch)
        exact = runs["forward"](p, HORIZON, TIGHT, HORIZON / 1000)[1]
        judges = {mode: partial(_judge, np.asarray(exact)) for mode in MODES}
        judges["none"] = lambda result: {"error": None}
        prepared = [
            Case(
                "fdof_jax" if mode == "none" else f"fdof_jax, {mode} mode",
                TOLERANCE,
                partial(run, p, HORIZON, TOLERANCE, np.inf),
                judges[mode],
            )
            for mode, run in runs.items()
        ]
        yield from measure(
            "gradients", prepared, budget=1 if quick else 8, ratio_to="fdof_jax",
            problem="Fig 7, six gains", batch=batch,
        )  # fmt: skip
