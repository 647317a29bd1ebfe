"""Checks of the gradient that gain tuning follows."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ..analysis.linearization import Modes, closed_loop_modes, depends_on_state_alone
from ..analysis.measures import relative_demands
from ..base.configuration import options_of_loops
from ..base.known_values import in_numpy
from ..base.report import Report
from ..linkage.linkage import joint_names
from ..references.reference import reference_of
from ..search import check_motion
from ..simulation.jacobian import Sensitivities, jacobian_of
from ..simulation.prescribed import PrescribedMotion
from ..simulation.scene import Scene, is_number
from ..simulation.simulate import simulate
from ..simulation.solution import Solution, remarks_on_derivatives
from .losses import (
    SAMPLES,
    Loss,
    check_tuned,
    controller_of,
    gains_of,
    joint_errors,
    tip_errors,
    with_factors,
)

_HORIZONS = 10
# The step of the differences in the log-gains. The error of the extrapolated
# differences is of fourth order in it; their noise is that of the loss over the step.
_STEP = 1e-2
# An explicit method of order 8 is stable for steps of some 4 times the time scale of a
# mode; beyond so many steps an implicit one is faster.
_STABLE, _MANY_STEPS = 4.0, 1e4
_OF_TIME = 1e-3  # the step in a time, at most, as a share of the run


class GradientReport(Report):
    """The gradient of the mean squared tip error [m^2] at a scene's gains.

    Derivatives are in the logarithms of kp and kd (2, n). The error is that of this
    scene alone, without prices of effort, even if it was tuned for an ensemble or with
    prices. A report prints itself in words.

    - `gradient`: the gradient as `tune` computes it.
    - `differences`: central differences of `simulate` at its default tolerance.
    - `error`: norm of `gradient - differences` over the norm of `differences`.
    - `horizons`, `gradient_norm`: times [s], and the norm of the gradient of the error
      over the run up to each of them.
    - `saturated`: share of the time that each actuator spends at its limit (n,).
    - `modes`: closed-loop eigenvalues along the path, at 101 times; None with elements
      that have a state of their own or prescribe a motion.
    - `at_limit`: whether any actuator is at its limit, and so does not control its
      joint, at each of these times (101,).
    - `switches`, `slowest_crossing`: how often an element switches to another branch of
      its formula, and the least speed of a switching function at or near its zero, as
      in `Solution` (infinite if none came near): near 0, a contact grazes.
    - `times`: the derivatives of the error [m^2/s] in the times that elements and
      references declare as single numbers, such as the `begin` of a `Travel`: pairs of
      the derivative and of differences, by name. Prescribed motions are left out.
    - `warnings`: what to beware of, in words.
    """

    gradient: Float[np.ndarray, "2 joint"]
    differences: Float[np.ndarray, "2 joint"]
    error: float
    horizons: Float[np.ndarray, " horizon"]
    gradient_norm: Float[np.ndarray, " horizon"]
    saturated: Float[np.ndarray, " joint"]
    modes: Modes | None
    at_limit: Bool[np.ndarray, " time"]
    warnings: list[str]
    switches: int = 0
    slowest_crossing: float = np.inf
    times: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def _verdict(self) -> list[str]:
        size = np.linalg.norm(self.gradient)
        return [
            f"gradient against differences: {self.error:.1e} of its norm {size:.3g}"
        ]

    def _rows(self) -> list[list[str]]:
        horizons = [f"{t:.3g} s" for t in self.horizons]
        norms = [f"{norm:.2g}" for norm in self.gradient_norm]
        return [["up to", *horizons], ["norm of the gradient", *norms]]

    def _remarks(self) -> list[str]:
        lines = []
        if self.modes is not None:
            frequency, damping = self.modes.frequency, self.modes.damping
            lines.append(
                f"natural frequencies along the path: {frequency.min():.3g} to "
                f"{frequency.max():.3g} rad/s, steps of an explicit method up to "
                f"{1e3 * self.modes.longest_step.min():.3g} ms"
            )
            for when, times in (("within", ~self.at_limit), ("at", self.at_limit)):
                if times.any():
                    lines.append(
                        f"least damping ratio while actuators are {when} their limits: "
                        f"{np.nanmin(damping[times]):.2g}"
                    )
        if self.switches:
            lines.append(
                f"{self.switches} switches between branches of formulas, the slowest "
                f"crossing at {self.slowest_crossing:.2g} (near 0 it grazes)"
            )
        for name, (slope, difference) in self.times.items():
            lines.append(
                f"derivative in {name}: {slope:.3g} m^2/s, by differences "
                f"{difference:.3g}"
            )
        return lines + self.warnings


def _times(scene: Scene) -> dict[str, Array]:
    """The single numbers that the scene's elements declare in seconds, by name."""
    times = {}

    def collect(part: object, place: str) -> None:
        # The start is bound to a prescribed motion, and would have to change with it.
        if not isinstance(part, eqx.Module) or isinstance(part, PrescribedMotion):
            return
        for declared in dataclasses.fields(part):
            value, name = vars(part)[declared.name], f"{place}.{declared.name}"
            rules = declared.metadata.get("rules", {"unit": ""})
            if rules["unit"] == "s" and rules["shape"] == ():
                times[name] = value
            else:
                collect(value, name)

    for index, element in enumerate(scene.forces):
        collect(element, f"forces[{index}]")
    return times


def _scene_at(scene: Scene, z: Array | np.ndarray) -> Scene:
    """The scene with gains by factors exp(z); the last of `z` are its times."""
    logs, times = jnp.split(jnp.asarray(z), [gains_of(scene).size])
    scene = with_factors(scene, logs)
    where = lambda scene: list(_times(scene).values())
    return eqx.tree_at(where, scene, list(times)) if len(times) else scene


def _errors(scene: Scene) -> Loss:
    """The loss: the tip's error, or that of the joints if nothing leads the tip."""
    led = reference_of(controller_of(scene).reference).tip is not None
    return tip_errors if led else joint_errors


@eqx.filter_jit(compiler_options=options_of_loops())  # pyright: ignore[reportCallIssue]
def _tangents(scene: Scene, z: Any) -> tuple[Sensitivities, Array]:
    """Residuals with their derivatives in `z`, and relative demands."""
    ts = jnp.linspace(0, scene.t1, SAMPLES)
    found = jacobian_of(lambda z: _scene_at(scene, z), _errors(scene), z, ts)
    controller = controller_of(scene)
    return found, relative_demands(controller, scene.linkage, found.solution)


def _motion(scene: Scene) -> Solution:
    """The motion by a plain call of `simulate`."""
    return simulate(scene, np.linspace(0, float(scene.t1), SAMPLES), throw=False)


def _slopes(scene: Scene, z: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Derivatives of the mean squared error by extrapolated differences."""

    def loss(z: np.ndarray) -> float:
        trial = _scene_at(scene, z)
        return float(np.sum(np.square(_errors(scene)(trial, _motion(trial)))))

    rise = lambda h: loss(z + h) - loss(z - h)
    changes = np.diag(steps)
    return np.array([8 * rise(h / 2) - rise(h) for h in changes]) / (6 * steps)


def gradient_report(scene: Scene) -> GradientReport:
    """Compares the gradient of the tip error in the PD gains with differences.

    **Arguments:** `scene`: must hold exactly one `PDController`. If its reference has
    no `tip`, the errors of joints count in place of that of the tip, as in
    `joint_errors`.

    **Returns:** a `GradientReport`.

    **Raises:** ValueError as `tune`.
    """
    check_tuned("scene", scene, joint_errors)  # which needs no tip
    t1 = float(scene.t1)
    as_array = lambda leaf: jnp.asarray(leaf) if is_number(leaf) else leaf
    scene = jax.tree.map(as_array, scene._replace(t1=t1))
    gains, moments = gains_of(scene), _times(scene)
    values = np.array(list(moments.values()), float)
    count, z = gains.size, np.append(np.zeros(gains.size), values)
    found, demands = in_numpy(_tangents(scene, z))
    residuals, solution = found.residuals, found.solution
    if not np.isfinite(residuals).all():
        check_motion("scene", scene, [0.0, t1])
    # Short parts of the run may be given in times, and are not stepped over.
    steps = np.where(values == 0, np.inf, _STEP * np.abs(values))
    steps = np.append(np.full(count, _STEP), np.minimum(steps, _OF_TIME * t1))
    slopes = _slopes(scene, z, steps)
    along = 2 * np.cumsum(residuals[:, None] * found.jacobian, axis=0)
    both = np.stack([along[-1], slopes])
    gradient, differences = both[:, :count].reshape(2, *gains.shape)
    times = dict(zip(moments, map(tuple, both[:, count:].T.tolist())))
    along = along[:, :count]
    size = np.linalg.norm(differences)
    error = float(np.linalg.norm(gradient - differences) / size) if size > 0 else 0.0
    # The error up to a time is the mean over that time, not over the whole run.
    until = np.linspace(0, SAMPLES - 1, _HORIZONS + 1).astype(int)[1:]
    each = residuals.size // SAMPLES
    norms = np.linalg.norm(along[each * (until + 1) - 1], axis=1)
    norms *= SAMPLES / (until + 1)
    few = jax.tree.map(lambda a: a[::10] if np.ndim(a) else a, solution)
    at_limit = np.abs(demands) > 1
    saturated = np.mean(at_limit, axis=0)
    modes, stiff = None, []
    if depends_on_state_alone(scene.linkage, scene.forces):
        modes = closed_loop_modes(scene.linkage, scene.forces, few)
        stiff = _stiffness(modes, t1)
    stats = _motion(scene).stats
    warnings = _remarks_on_gains(scene, gradient, saturated)
    if not error < 1e-3:
        warnings.append(
            "gradient and differences disagree: the loss may not be smooth here, or "
            "chaotic over this horizon"
        )
    warnings += stiff + remarks_on_derivatives(stats)
    pace = np.sum(residuals**2) / t1
    for name, (slope, difference) in times.items():
        if not abs(slope - difference) < 1e-3 * max(abs(difference), pace):
            warnings.append(
                f"derivative and differences in {name} disagree: the loss may not be "
                "smooth there"
            )
    return GradientReport(
        gradient=gradient,
        differences=differences,
        error=error,
        horizons=np.asarray(solution.ts)[until],
        gradient_norm=norms,
        saturated=saturated,
        modes=modes,
        at_limit=at_limit.any(axis=1)[::10],
        switches=int(stats.get("num_switches", 0)),
        slowest_crossing=float(stats.get("slowest_crossing", np.inf)),
        times=times,
        warnings=warnings,
    )


def _stiffness(modes: Modes, t1: float) -> list[str]:
    """Warns of modes that are fast for a run up to `t1`."""
    fastest = np.nanmax(modes.frequency)
    steps = fastest * t1 / _STABLE
    if not steps > _MANY_STEPS:
        return []
    return [
        f"a mode of {fastest:.3g} rad/s takes some {steps:,.0f} steps of an explicit "
        "method: an implicit solver is faster (solver=diffrax.Kvaerno5())"
    ]


def _remarks_on_gains(scene: Scene, gradient, saturated) -> list[str]:
    words = []
    for k, (name, share) in enumerate(zip(joint_names(scene.linkage), saturated)):
        if share == 1 and not gradient[:, k].any():
            words.append(
                f"{name} is at its limit throughout: the gradient in its gains is "
                "zero, and tuning cannot change them"
            )
        elif share > 0:
            words.append(
                f"{name} is at its limit for {100 * share:.3g} % of the time, in which "
                "its gains have no effect"
            )
    return words
