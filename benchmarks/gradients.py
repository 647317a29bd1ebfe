"""Value and gradient of a tracking loss: cost over the forward solve, and error.

The RPR arm of Fig 7 follows its circle; the loss is the mean squared distance of the
tip. The paper's controller saturates at first, which costs a gradient digits: the six
gains are measured with its limits and without. Parameters are factors of gains (as
logarithms) and torques, so the entries of a gradient are of one kind. The error of a
gradient is the norm of its difference from that at a tolerance of 1e-12, over the norm;
in a batch it is that of the worst member.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import fdof_jax as fj

from .measure import Case, measure
from .problems import controller

PROTOCOL = "gradients"
HORIZON = 4.0
TOLERANCE, TIGHT = 1e-8, 1e-12
SCENE = fj.scenes.fig7()
PD = SCENE.forces[0]
WINDOWS, SAMPLES = 8, 500


class WayPoints(eqx.Module):
    """PD controllers of eight way-points, each active for an eighth of the time."""

    kp: Array  # (window, joint)
    kd: Array
    target: Array  # (window, joint)
    horizon: Array

    def __call__(self, t, q, qd, linkage):
        window = jnp.clip(jnp.floor(t / self.horizon * WINDOWS), 0, WINDOWS - 1)
        k = window.astype(int)
        return self.kp[k] * (self.target[k] - q) - self.kd[k] * qd


class TorqueProfile(eqx.Module):
    """A torque of the first joint, linear between equidistant samples."""

    samples: Array
    horizon: Array

    def __call__(self, t, q, qd, linkage):
        place = t / self.horizon * (SAMPLES - 1)
        k = jnp.clip(jnp.floor(place), 0, SAMPLES - 2).astype(int)
        part = place - k
        torque = self.samples[k] * (1 - part) + self.samples[k + 1] * part
        return torque * jnp.array([1.0, 0.0, 0.0])


def limited_gains(p: Array, horizon: Array) -> tuple:
    """Returns the controller for six parameters: log factors of kp and kd."""
    factor = jnp.exp(p)
    pair = PD.kp * factor[:3], PD.kd * factor[3:]
    return (eqx.tree_at(lambda pd: (pd.kp, pd.kd), PD, pair),)


def gains(p: Array, horizon: Array) -> tuple:
    """Returns the controller for the same six parameters, without effort limits."""
    (pd,) = limited_gains(p, horizon)
    return (eqx.tree_at(lambda pd: pd.limit, pd, jnp.full(3, jnp.inf)),)


def way_point_gains(p: Array, horizon: Array) -> tuple:
    """Returns controllers for 48 parameters, six for each way-point."""
    factor = jnp.exp(p).reshape(2, WINDOWS, 3)
    ends = (jnp.arange(WINDOWS) + 1) / WINDOWS * horizon
    target = jax.vmap(lambda t: PD.reference(t, SCENE.linkage)[0])(ends)
    # Softer than the paper's: its slide would ring at 100 rad/s after every jump.
    kp, kd = jnp.array([1500.0, 2000.0, 800.0]), jnp.array([300.0, 200.0, 50.0])
    return (WayPoints(kp * factor[0], kd * factor[1], target, horizon),)


def torque_profile(p: Array, horizon: Array) -> tuple:
    """Returns the unlimited controller and a torque profile [N m], 500 parameters."""
    return *gains(jnp.zeros(6), horizon), TorqueProfile(p, horizon)


class Problem(NamedTuple):
    name: str
    parameters: int
    forces: Callable[[Array, Array], tuple]
    spread: float  # of a batch's random parameters


PROBLEMS = (
    Problem("gains", 6, gains, 0.2),
    Problem("gains, limited", 6, limited_gains, 0.2),
    Problem("way-points", 48, way_point_gains, 0.2),
    Problem("torque profile", 500, torque_profile, 10.0),
)


def _loss(problem, adjoint, p, horizon, tolerance, longest):
    """Returns the loss; `longest` bounds the steps where the tolerance does not."""
    ts = jnp.linspace(0, 1, 201) * horizon
    steps = eqx.tree_at(
        lambda c: c.dtmax, controller(tolerance), longest, is_leaf=lambda x: x is None
    )
    motion = fj.simulate(
        SCENE.linkage,
        SCENE.state0,
        ts,
        problem.forces(p, horizon),
        stepsize_controller=steps,
        throw=False,
        **({} if adjoint is None else {"adjoint": adjoint}),
    )
    tip = jax.vmap(fj.tip_position, (None, 0))(SCENE.linkage, motion.q)
    return jnp.mean(jnp.sum((tip - jax.vmap(PD.reference.tip)(ts)) ** 2, axis=1))


def value(problem: Problem) -> Callable:
    return partial(_loss, problem, None)


def forward(problem: Problem) -> Callable:
    """Returns a function to value and gradient: one tangent per parameter."""
    loss = partial(_loss, problem, diffrax.ForwardMode())

    def value_and_gradient(p, *settings):
        def along(tangent):
            return jax.jvp(lambda p: loss(p, *settings), (p,), (tangent,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(problem.parameters))

    return value_and_gradient


def reverse(problem: Problem) -> Callable:
    """Returns a function to value and gradient: checkpointed reverse mode."""
    return jax.value_and_grad(partial(_loss, problem, None))


MODES = {"none": value, "forward": forward, "reverse": reverse}


def compiled(problem: Problem, mode: str) -> Callable:
    """Compiles a function of p (possibly a batch), horizon and tolerance."""
    function = MODES[mode](problem)

    @jax.jit
    def run(p, horizon, tolerance, longest=jnp.inf):
        settings = horizon, tolerance, longest
        if p.ndim == 1:
            return function(p, *settings)
        return jax.vmap(lambda p: function(p, *settings))(p)

    return run


def parameters(problem: Problem, batch: int) -> Array:
    """Returns random parameters; a profile is smooth, as from a planner."""
    rng = np.random.default_rng(4)
    if problem.parameters == SAMPLES:
        modes = np.sin(np.pi * np.outer(np.arange(1, 6), np.linspace(0, 1, SAMPLES)))
        p = rng.uniform(-1, 1, (batch, 5)) @ modes
    else:
        p = rng.uniform(-1, 1, (batch, problem.parameters))
    return jnp.asarray(problem.spread * (p[0] if batch == 1 else p))


def _judge(exact: np.ndarray, result: Any) -> dict:
    gradient = np.asarray(result[1])
    difference = np.linalg.norm(gradient - exact, axis=-1)
    return {"error": float((difference / np.linalg.norm(exact, axis=-1)).max())}


def measure_modes(
    problem: Problem,
    runs: dict,
    batch: int,
    budget: float,
    horizon: float,
    tolerance: float,
    longest: float,
) -> list[dict]:
    """Measures one group: the forward solve alone, and the modes relative to it."""
    p = parameters(problem, batch)
    exactly = runs["forward" if problem.parameters == 6 else "reverse"]
    exact = np.asarray(exactly(p, horizon, TIGHT, horizon / 1000)[1])
    prepared = [
        Case(
            "fdof_jax" if mode == "none" else f"fdof_jax, {mode} mode",
            tolerance,
            partial(run, p, horizon, tolerance, longest),
            (lambda result: {"error": None})
            if mode == "none"
            else partial(_judge, exact),
            "tolerance",
            {"gradient_mode": mode},
        )
        for mode, run in runs.items()
    ]
    return measure(
        PROTOCOL,
        prepared,
        budget=budget,
        ratio_to="fdof_jax",
        equal_error=False,
        problem=problem.name,
        batch=batch,
        parameters=problem.parameters,
        horizon=horizon,
        longest_step=longest,
    )


def _grid(problem: Problem, batch: int) -> list[tuple[float, float, float]]:
    """Returns (horizon, tolerance, longest step), all for six parameters of one arm."""
    if problem.parameters > 6:
        points = [(1.0, TOLERANCE, np.inf)]  # 4 s of 256 would take minutes
        if problem.parameters == SAMPLES:
            # A step across several samples uses few of them, without an effect on the
            # motion: the gradient is wrong by tenths unless the steps are bounded.
            bounded = (1.0, TOLERANCE, 1.0 / SAMPLES)
            points = [*points, bounded] if batch == 1 else [bounded]
        return points
    points = [(HORIZON, TOLERANCE, np.inf)]
    if batch == 1:
        points += [(HORIZON, t, np.inf) for t in (1e-4, 1e-6, 1e-10)]
    if batch == 1 and problem.name == "gains":
        points += [(horizon, TOLERANCE, np.inf) for horizon in (1.0, 2.0, 8.0)]
    return points


def run(quick: bool) -> Iterator[dict]:
    for problem in PROBLEMS[:1] if quick else PROBLEMS:
        for batch in (1, 8) if quick else (1, 256):
            few = problem.parameters * batch <= 2000  # more tangents take minutes too
            modes = MODES if few else ("none", "reverse")
            runs = {mode: compiled(problem, mode) for mode in modes}
            for point in _grid(problem, batch):
                budget = 1 if quick else 3
                yield from measure_modes(problem, runs, batch, budget, *point)
