"""Tuning of PD gains by gradients through the simulation."""

import time
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .control import PDController, saturated, tip_deviation
from .linkage import check_linkage
from .scenes import Scene
from .simulation import simulate
from .solution import Solution
from .step_control import adaptive
from .validation import callable_tuple, instance, one_of, real_array, whole_number

_SAMPLES = 1001
# Stop where the projected gradient has fallen to this part of its start, or where the
# loss falls by less than this part of itself: its noise is that of the tolerance.
_GRADIENT_DECREASE = 1e-5
_LOSS_DECREASE = 1e-7
# The part of its start that the projected gradient must have fallen to for a stop for
# another reason to count as convergence.
_CONVERGED = 1e-3

Loss = Callable[[Scene, Solution], Array]


class History(eqx.Module):
    """What a tuning run did; entry 0 is the start, one more per accepted iteration.

    - `loss`: mean squared tip error [m^2] with the default loss.
    - `gradient_norm`: norm of the gradient in the logarithms of the gains, without the
      components that a bound holds back.
    - `gains`: kp and kd, in joint order [N/m or N m/rad, N s/m or N m s/rad].
    - `saturated`: share of the time that each actuator spends at its limit.
    - `wall_time`: since the start of the run, compilation included [s].
    """

    loss: Float[np.ndarray, " iteration"]
    gradient_norm: Float[np.ndarray, " iteration"]
    gains: Float[np.ndarray, "iteration 2 joint"]
    saturated: Float[np.ndarray, "iteration joint"]
    wall_time: Float[np.ndarray, " iteration"]


class TuneResult(eqx.Module):
    """A tuned scene and how it was reached.

    - `scene`: the scene with its tuned gains.
    - `loss`: its loss [m^2 with the default loss].
    - `history`: the iterations, see `History`.
    - `lower`, `upper`: the bounds of kp and kd (2, 3).
    - `converged`: whether the projected gradient has fallen to a thousandth.
    - `message`: why the run stopped, in words.
    """

    scene: Scene
    loss: float
    history: History
    lower: Float[np.ndarray, "2 joint"]
    upper: Float[np.ndarray, "2 joint"]
    converged: bool
    message: str


def tip_errors(scene: Scene, solution: Solution) -> Float[Array, " residual"]:
    """Tip error at each output time, scaled so that the squares add up to their mean.

    **Arguments:** a scene whose PD controller tracks a task with a `tip`, and its
    solution.

    **Returns:** x and y components [m], each over the root of the number of times.
    """
    task: Any = _controller(scene)[1].reference
    deviation = tip_deviation(scene.linkage, task, solution)
    return deviation.reshape(-1) / solution.ts.size**0.5


def _controller(scene: Scene) -> tuple[int, PDController]:
    found = [(i, f) for i, f in enumerate(scene.forces) if isinstance(f, PDController)]
    if len(found) != 1:
        raise ValueError(
            "scene: expected exactly one PDController among its forces, got "
            f"{len(found)}."
        )
    return found[0]


def _with_gains(scene: Scene, gains: Array) -> Scene:
    index, controller = _controller(scene)
    controller = eqx.tree_at(lambda c: (c.kp, c.kd), controller, (gains[0], gains[1]))
    forces = (*scene.forces[:index], controller, *scene.forces[index + 1 :])
    return scene._replace(forces=forces)


@eqx.filter_jit
def _evaluate(
    log_gains: Array, tuned: Array, scene: Scene, loss: Loss
) -> tuple[Array, Array, Array, Array]:
    """Residuals, their Jacobian in the log-gains, saturated shares, and the result."""

    def residuals(log_gains):
        # A gain of zero has no logarithm: it stays zero.
        trial = _with_gains(scene, jnp.where(tuned, jnp.exp(log_gains), 0))
        solution = simulate(
            trial.linkage,
            trial.state0,
            jnp.linspace(0, trial.t1, _SAMPLES),
            trial.forces,
            stepsize_controller=adaptive(1e-8, 1e-5),
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        at_limit = saturated(_controller(trial)[1], trial.linkage, solution)
        value = jnp.asarray(loss(trial, solution))
        # The square of a scalar loss's root is the loss.
        value = value.reshape(-1) if value.ndim else jnp.sqrt(value)[None]
        return value, (value, jnp.mean(at_limit, axis=0))

    jacobian, (value, share) = jax.jacfwd(residuals, has_aux=True)(log_gains)
    return value, jacobian.reshape(value.size, -1), share, jnp.sum(value**2)


def tune(
    scene: Scene,
    *,
    factor: float = 4.0,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    loss: Loss = tip_errors,
    method: str = "gauss-newton",
    max_steps: int = 50,
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),
) -> TuneResult:
    """Gains of a scene's PD controller that make its loss small, within bounds.

    The unknowns are the logarithms of kp and kd; gains of zero stay zero. The
    derivatives are exact (forward mode through the adaptive solve, at a tolerance of
    1e-8 in float64 and 1e-5 in float32). A second call with other numbers compiles
    nothing.

    **Arguments:**

    - `scene`: holds exactly one `PDController`.
    - `factor`: the gains stay within this factor of their start, above 1.
    - `bounds`: instead of `factor`, the least and the greatest kp and kd: two arrays
      (2, 3), first row kp, second kd [N/m or N m/rad, N s/m or N m s/rad].
    - `loss`: `(scene, solution) -> residuals`, an array whose sum of squares is made
      small, or a scalar that is made small itself and is never negative (for which
      Gauss-Newton has little to go by). By default `tip_errors`: the mean squared tip
      error over [0, t1].
    - `method`: "gauss-newton" (Levenberg-Marquardt with an active set for the bounds)
      or "adam" (optax, clipped to the bounds).
    - `max_steps`: the greatest number of evaluations after the first.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** a `TuneResult`, which says why it stopped.

    **Raises:** ValueError for malformed arguments, and if the scene cannot be simulated
    from its start.
    """
    instance("scene", scene, Scene)
    check_linkage(scene.linkage)
    t1 = real_array("scene.t1", scene.t1, (), above=0)
    callable_tuple("scene.forces", scene.forces)
    controller = _controller(scene)[1]
    one_of("method", method, ("gauss-newton", "adam"))
    max_steps = whole_number("max_steps", max_steps, 1)
    instance("progress_meter", progress_meter, diffrax.AbstractProgressMeter)
    if not callable(loss):
        raise ValueError(f"loss: expected a callable, got {loss!r}.")
    if loss is tip_errors and not hasattr(controller.reference, "tip"):
        raise ValueError(
            "loss: expected one of your own, because the reference has no `tip` for "
            f"the default tip error, got {controller.reference!r}."
        )
    factor_ = float(real_array("factor", factor, (), above=1))
    controller.check(scene.linkage, jnp.stack([jnp.zeros_like(t1), t1]))
    start = np.stack([np.asarray(controller.kp), np.asarray(controller.kd)])
    if bounds is None:
        lower, upper = start / factor_, start * factor_
    else:
        if not isinstance(bounds, tuple | list) or len(bounds) != 2:
            raise ValueError(f"bounds: expected (lower, upper), got {bounds!r}.")
        lower, upper = (
            np.asarray(real_array(f"bounds[{i}]", b, (2, 3), minimum=0))
            for i, b in enumerate(bounds)
        )
        if not ((lower <= start) & (start <= upper)).all():
            raise ValueError(
                "bounds: expected the scene's gains between them, got "
                f"{lower.tolist()} and {upper.tolist()} around {start.tolist()}."
            )
    tuned = start > 0
    if (lower[tuned] == 0).any():
        raise ValueError("bounds: expected positive least gains, got 0.")
    low, high, z = (
        np.log(np.where(tuned, a, 1)).ravel() for a in (lower, upper, start)
    )

    scene = jax.tree.map(
        lambda a: jnp.asarray(a, dtype=float) if eqx.is_array_like(a) else a, scene
    )
    began = time.perf_counter()
    rows: list[tuple[Any, ...]] = []

    def evaluate(z: np.ndarray):
        values = _evaluate(
            jnp.asarray(z).reshape(2, 3), jnp.asarray(tuned), scene, loss
        )
        return tuple(np.asarray(v) for v in values)

    def projected(z: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        held = ((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0))
        return np.where(held | ~tuned.ravel(), 0, gradient)

    def record(z, gradient, value, share):
        gains = np.where(tuned, np.exp(z).reshape(2, 3), 0)
        norm = np.linalg.norm(projected(z, gradient))
        rows.append((value, norm, gains, share, time.perf_counter() - began, z))

    residuals, jacobian, share, value = evaluate(z)
    if not (np.isfinite(value) and np.isfinite(jacobian).all()):
        raise ValueError(
            f"scene: expected one that can be simulated up to t1 = {float(t1):g} s, "
            f"got a loss of {float(value):g} or a gradient that is not finite."
        )
    gradient = 2 * jacobian.T @ residuals
    record(z, gradient, value, share)

    damping = 1e-3
    optimiser = optax.adam(0.05)
    optimiser_state = optimiser.init(jnp.asarray(z))
    reason = f"stopped after {max_steps} evaluations"
    meter_state = progress_meter.init()
    for step in range(1, max_steps + 1):
        if rows[-1][1] <= _GRADIENT_DECREASE * rows[0][1]:
            reason = "the projected gradient vanishes"
            break
        if method == "adam":
            update, optimiser_state = optimiser.update(
                jnp.asarray(gradient), optimiser_state
            )
            trial = np.clip(z + np.asarray(update), low, high)
        else:
            step_ = _bounded_step(jacobian, gradient / 2, damping, low - z, high - z)
            trial = z + step_
        new = evaluate(trial)
        meter_state = progress_meter.step(meter_state, jnp.asarray(step / max_steps))
        finite = np.isfinite(new[1]).all() and np.isfinite(new[3])
        if method == "gauss-newton" and not (finite and new[3] < value):
            damping *= 8
            if damping > 1e8:
                reason = "no step decreases the loss any further"
                break
            continue
        if not finite:
            reason = "a step led to gains with which the simulation fails"
            break
        decrease = (value - new[3]) / value
        z, (residuals, jacobian, share, value) = trial, new
        gradient = 2 * jacobian.T @ residuals
        damping = max(damping / 4, 1e-9)
        record(z, gradient, value, share)
        if method == "gauss-newton" and decrease < _LOSS_DECREASE:
            reason = "the loss decreases no further"
            break
    progress_meter.close(meter_state)
    # Adam's last iterate need not be its best: what is said is said of the best.
    value, norm, gains, _, _, z = min(rows, key=lambda row: row[0])
    columns = list(zip(*rows))[:5]
    return TuneResult(
        scene=_with_gains(scene, jnp.asarray(gains)),
        loss=float(value),
        history=History(*(np.asarray(column) for column in columns)),
        lower=lower,
        upper=upper,
        converged=bool(0 < rows[0][1] and norm <= _CONVERGED * rows[0][1]),
        message=_message(reason, rows, z, low, high, tuned.ravel()),
    )


def _message(reason, rows, z, low, high, tuned) -> str:
    """The reason, and what a reader might take for convergence but is not."""
    _, norm, _, share, *_ = rows[0]
    if norm == 0 and share.min() == 1:
        return "the gradient is zero because every actuator is at its limit throughout"
    if norm == 0:
        return "the gradient is zero at the start"
    held = int(np.sum(tuned & ((z <= low) | (z >= high))))
    return f"{reason}; {held} of {int(tuned.sum())} gains are at a bound"


def _bounded_step(
    jacobian: np.ndarray,
    half_gradient: np.ndarray,
    damping: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """The Levenberg-Marquardt step inside a box.

    Components that leave the box are set to its side one round at a time, the others
    solved anew; a component that starts on a side and is drawn outwards stays there.
    """
    normal = jacobian.T @ jacobian
    normal += damping * np.diag(np.diag(normal) + 1e-12 * np.trace(normal) + 1e-300)
    step = np.zeros_like(low)
    free = ~(((low >= 0) & (half_gradient > 0)) | ((high <= 0) & (half_gradient < 0)))
    while free.any():
        fixed = half_gradient + normal[:, ~free] @ step[~free]
        step[free] = -np.linalg.solve(normal[np.ix_(free, free)], fixed[free])
        outside = free & ((step < low) | (step > high))
        if not outside.any():
            break
        step[outside] = np.clip(step, low, high)[outside]
        free &= ~outside
    return step
