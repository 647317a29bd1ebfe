"""Recordings with their scenes, and their misfit at given parameters."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import function, shown
from ..search.bounded import Evaluation, Run
from ..search.lanes import check_scene, sum_of_squares
from ..simulation.scene import Scene, stacked
from ..simulation.sensitivities import sensitivities
from ..simulation.solution import Solution
from .recordings import observations
from .unknowns import Shapes, Unknowns, named

SceneAt = Callable[[dict[str, Array]], Scene]
Observe = Callable[[Scene, Solution], Array]

_TOLERANCE = 1e-7  # of the derivatives, and of the dense output
_ACCURACY = 1e-5  # of simulated readings at that tolerance, at least


class Problem(NamedTuple):
    """A recording, its scene and observation; `weight` is 0 where a sample is missing.

    The parameters, of the given shapes, are `scale` times the unknowns.
    """

    scene_at: SceneAt
    observe: Observe
    shapes: Shapes
    scale: Any
    ts: Any
    observed: Any
    weight: Any


def lane(z: Array, problem: Problem) -> Evaluation:
    """Evaluates a recording's weighted sum of squares and its derivatives in `z`."""
    weight = problem.weight

    def scene_at(z):
        return problem.scene_at(named(problem.shapes, problem.scale * z))

    def residuals(scene, solution):
        seen = jnp.asarray(problem.observe(scene, solution))
        if seen.shape != problem.observed.shape:
            raise ValueError(
                "observed: expected the shape of what `observe` returns, "
                f"{seen.shape}, got {problem.observed.shape}."
            )
        misfit = jnp.where(weight > 0, seen - problem.observed, 0)
        return (weight * misfit).reshape(-1)

    found = sensitivities(scene_at, residuals, z, problem.ts, _TOLERANCE)
    unweighted = found.residuals / jnp.where(weight > 0, weight, 1).reshape(-1)
    change = jnp.diff(found.residuals.reshape(weight.shape), axis=0)
    # What is always read as it must be, as the encoder of a fixed pair, has no noise.
    misfit = jnp.abs(unweighted.reshape(weight.shape))
    rounding = 8 * jnp.finfo(misfit.dtype).eps * jnp.abs(problem.observed)
    noisy = (misfit > rounding).any(axis=0, keepdims=True)
    return sum_of_squares(
        found,
        squares=jnp.sum(unweighted**2),
        changes=jnp.sum(jnp.where(_successive(weight), change, 0) ** 2),
        readings=jnp.sum(noisy & (weight > 0)),
        pairs=jnp.sum(noisy & _successive(weight)),
    )


def _successive(weight: Any) -> Any:
    """Returns where a reading and the next one are both there."""
    return (weight[1:] > 0) & (weight[:-1] > 0)


def noise_by_changes(run: Run, problems: list[Problem]) -> tuple[float, float]:
    """Estimates the noise from changes between successive residuals of a fit.

    The errors of a model change slowly, so that they hardly count. Returns the estimate
    [as observed], and its relative variance.
    """
    facts = {name: values.sum() for name, values in run.best.facts.items()}
    pairs, count = facts["pairs"], max(facts["readings"], 1)
    readings = np.concatenate([p.observed[p.weight > 0] for p in problems])
    if not pairs:  # nothing better than all of the residuals
        return (facts["squares"] / count) ** 0.5, 0.5 / count
    # Without noise, residuals are errors of the integration.
    least = _ACCURACY * np.sqrt(np.mean(readings**2))
    noise = np.sqrt(facts["changes"] / (2 * pairs))
    return max(noise, least), 0.75 / pairs


def _check_scene_at(
    name: str, scene_at: SceneAt, parameters: dict[str, Array], ts: Array
) -> None:
    try:
        scene = scene_at(parameters)
    except KeyError as error:
        raise ValueError(
            f"start: expected a value for {error}, which {name} may use, got "
            f"{shown(list(parameters))}."
        ) from error
    check_scene(f"{name}(...)", scene, ts)


def listed(name: str, scene_at: Any, observed: Any) -> tuple[Sequence[Any], Any]:
    """Returns the scenes and their recordings, of which there may be one, as lists."""
    if not isinstance(scene_at, list | tuple):
        return [scene_at], [observed]
    if not scene_at or np.shape(observed)[:1] != (len(scene_at),):
        raise ValueError(
            f"{name}: expected a recording for each of the scenes (one at least), got "
            f"shape {np.shape(observed)} for {len(scene_at)}."
        )
    return scene_at, observed


def problems_of(
    names: tuple[str, str],
    scenes_at: Sequence[Any],
    observed: Any,
    unknowns: Unknowns,
    ts: Array,
    observe: Observe,
    noise: Any,
) -> list[Problem]:
    """Checks scenes and their recordings, arguments of the given names."""
    readings, weights = observations(names[1], observed, noise, ts)
    for scene_at in scenes_at:
        function(names[0], scene_at)
    function("observe", observe)
    stacked(scenes_at, names[0])  # raises unless all are alike
    first = jax.tree.map(jnp.asarray, named(unknowns.shapes, unknowns.start))
    for scene_at in scenes_at:
        _check_scene_at(names[0], scene_at, first, ts)
    return [
        Problem(scene_at, observe, unknowns.shapes, unknowns.scale, ts, *row)
        for scene_at, *row in zip(scenes_at, readings, weights)
    ]
