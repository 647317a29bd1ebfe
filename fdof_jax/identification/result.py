"""Results of identification: parameters, their errors, undetermined directions."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from ..data import Report
from ..tuning.search import Evaluation, Run, held_at_bounds
from .problems import Named, Problem, Unknowns

# A combination is weak if its standard error exceeds this part of its size.
_WEAK = 1.0
# The message doubts the scene if the residuals exceed the noise by this factor.
_DOUBTED = 1.5
# Held-out residuals exceed the noise if they are larger by this factor, as few know
# their noise better, and by so many standard deviations of the comparison.
_KNOWN, _SPREAD = 1.1, 3.0
# Converged: largest change by a further step, in standard errors or in sizes.
_REMAINING = 0.03
_REMAINING_PART = 1e-6
# Least noise assumed of simulated readings, as a part of them.
_ACCURACY = 1e-5
# Readings that change by 2 pi to within so much are angles that wrap [rad].
_NEAR_A_TURN = 1.0
# Part of an undetermined direction above which a parameter belongs to it.
_SHARED = 1e-6


class FitResult(Report):
    """Identified parameters and their standard errors; prints a verdict and a table.

    - `parameters`, `standard_errors`: by name, in the units of `start`. Standard errors
      disregard bounds; they are infinite for parameters that the motion does not
      determine.
    - `names`: name of each number, for instance `mass[0]`.
    - `covariance`: covariance of these numbers (n, n), infinite between parameters of
      which only a combination is determined.
    - `weak`: in words, combinations of parameters that do not affect the motion, or
      whose standard error exceeds their size (the greater of value and scale).
    - `rms`: root mean square of the residuals [as observed].
    - `noise`: root of the weighted sum of squares over the degrees of freedom: relative
      to the given noise [1], or an estimate of it if none is given [as observed].
    - `converged`: whether a further step would change the parameters by less than 3 %
      of their standard errors, or a millionth of their sizes. Parameters that the
      motion does not determine do not count.
    - `message`: why the search stopped, and warnings.
    - `history`: weighted sum of squares over the whole recording, at the start of the
      last search and at each accepted point.
    - `held_out`: rms residual of each recording of `validate` over the noise [1], which
      is given, or else estimated from changes between successive residuals.
    - `faults`: reasons not to use the parameters, in words: no convergence, `weak`
      combinations, no scene with these parameters, residuals above 1.5 times the noise
      (see `held_out`), and held-out residuals above 1.1 times this noise by more than
      three standard deviations.
    """

    parameters: Named
    standard_errors: Named
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    weak: tuple[str, ...]
    rms: float
    noise: float
    converged: bool
    message: str
    history: Float[np.ndarray, " iteration"]
    held_out: tuple[float, ...] = ()
    faults: tuple[str, ...] = ("saved without a verdict",)

    @property
    def usable(self) -> bool:
        """True if no fault is known, which says little without held-out recordings."""
        return not self.faults

    def _verdict(self) -> list[str]:
        known = "; ".join(self.faults)
        tested = "on" if self.held_out else "but not tested on"
        no_fault = f"No fault is known, {tested} held-out recordings."
        return [f"Not to be used: {known}." if known else no_fault]

    def _rows(self) -> list[list[str]]:
        values = np.concatenate([np.ravel(v) for v in self.parameters.values()])
        errors = np.sqrt(np.diag(self.covariance))
        rows = [["", "value", "std error", "relative"]]
        for name, value, error in zip(self.names, values, errors):
            share = f"{100 * error / abs(value):.3g} %" if value else ""
            shown = f"{value:.{_digits(value, error)}g}"
            rows.append([name, shown, f"{error:.3g}", share])
        return rows

    def _remarks(self) -> list[str]:
        lines = [f"rms residual {self.rms:.4g}"]
        for ratio in self.held_out:
            lines.append(f"held-out residuals {ratio:.3g} times the noise")
        verdict = "converged" if self.converged else "not converged"
        if self.converged and np.isinf(np.diag(self.covariance)).any():
            verdict = "converged in what the motion determines, which is not all"
        lines.append(f"{verdict}, {len(self.history) - 1} iterations: {self.message}")
        return [*lines, *self.weak]


def _digits(value: float, error: float) -> int:
    """Returns how many digits to print: two more than the error makes sure."""
    if not (value and 0 < error < np.inf):
        return 5
    return int(np.clip(np.ceil(np.log10(abs(value) / error)) + 2, 3, 10))


def inverse_and_null_space(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A generalised inverse of a semidefinite matrix, and its null space in columns.

    Null directions have a curvature below a thousand rounding errors of the greatest.
    """
    limit = 1e3 * float(jnp.finfo(float).eps)
    diagonal = np.diag(normal)
    # By rounding, unknowns without any effect have a small one.
    silent = diagonal <= limit**2 * diagonal.max()
    unit = np.where(silent, 0, 1 / np.sqrt(np.where(silent, 1, diagonal)))
    values, vectors = np.linalg.eigh(unit[:, None] * normal * unit)
    steep = values > limit * max(values[-1], 1e-300)
    some = vectors[:, steep] * unit[:, None]
    # Unknowns without effect are directions by themselves.
    null = vectors[:, ~steep] * np.where(silent, 1, unit)[:, None]
    return (some / values[steep]) @ some.T, null / np.linalg.norm(null, axis=0)


def _sparse(columns: np.ndarray) -> np.ndarray:
    """Directions that span the same space, in echelon form."""
    if not columns.size:
        return columns.T
    _, rows, order = scipy.linalg.qr(columns.T, pivoting=True)
    rows = scipy.linalg.solve_triangular(rows[:, : len(rows)], rows)
    return rows[:, np.argsort(order)]


def _together(labels: tuple[str, ...], direction: np.ndarray, least: float) -> str:
    """A direction in words: its parts above `least` times the greatest."""
    # The first of equally large parts leads; otherwise rounding would choose the signs.
    leading = np.argmax(np.abs(direction) > 0.99 * np.abs(direction).max())
    parts = direction / direction[leading]
    large = np.flatnonzero(np.abs(parts) > least)
    if len(large) == 1:
        return labels[large[0]]
    changes = [f"{labels[i]} by {parts[i]:+.3g} %" for i in large]
    return f"{', '.join(changes[:-1])} and {changes[-1]} together"


def _in_words(labels, undetermined, covariance) -> tuple[str, ...]:
    """Undetermined directions in words, and weak ones by the relative covariance."""
    words = [
        "Not determined by this motion, which does not change with: "
        f"{_together(labels, row, 1e-3)}."
        for row in _sparse(undetermined)
    ]
    variances, vectors = np.linalg.eigh(covariance)
    for variance, vector in zip(variances[::-1], vectors.T[::-1]):
        if variance > _WEAK**2:
            words.append(
                f"Hardly determined by this motion, to {100 * variance**0.5:.3g} % of "
                f"its size: {_together(labels, vector, 0.05)}."
            )
    return tuple(words)


def _noise_by_changes(run: Run, problems: list[Problem]) -> tuple[float, float]:
    """Estimates the noise from changes between successive residuals of a fit.

    The errors of a model change slowly, so they hardly count. Returns the estimate [as
    observed] and its relative variance.
    """
    facts = {name: values.sum() for name, values in run.best.facts.items()}
    pairs, count = facts["pairs"], max(facts["readings"], 1)
    if not pairs:  # nothing better than all of the residuals
        return (facts["squares"] / count) ** 0.5, 0.5 / count
    # Without noise, residuals are errors of the integration.
    readings = np.concatenate([p.observed[p.weight > 0] for p in problems])
    least = _ACCURACY * np.sqrt(np.mean(readings**2))
    return max(np.sqrt(facts["changes"] / (2 * pairs)), least), 0.75 / pairs


def _wraps(problem: Problem) -> bool:
    """Returns whether successive readings jump by a turn."""
    there = problem.weight > 0
    jumps = np.abs(np.diff(problem.observed, axis=0))
    near = np.abs(jumps - 2 * np.pi) < _NEAR_A_TURN
    return bool((near & there[1:] & there[:-1]).any())


def fit_result(
    run: Run,
    problems: list[Problem],
    unknowns: Unknowns,
    noise_given: bool,
    held_out: Evaluation | None,
) -> FitResult:
    """Judges the end of a run; `held_out` evaluates the recordings of `validate`."""
    _, _, scale, low, high = unknowns
    values = unknowns.numbers(run.z)
    sizes = np.maximum(np.abs(values), scale)
    facts = run.best.facts
    count = max(int(facts["readings"].sum()), len(values) + 1)
    # The loss is a mean over recordings, but a sum is needed. From here on, parameters
    # are relative to their sizes.
    members, relative = len(problems), sizes / scale
    loss = members * run.at.loss
    normal = members * run.at.curvature / 2 * np.outer(relative, relative)
    slope = members * run.at.gradient / 2 * relative
    noise = float(np.sqrt(loss / (count - len(values))))
    variance = 1.0 if noise_given else noise**2
    inverse, undetermined = inverse_and_null_space(normal)
    inverse *= variance
    # Entries along undetermined directions are infinite. Infinities of both signs would
    # add up to NaN, so one projection onto all these directions sets the sign.
    basis, _ = np.linalg.qr(undetermined)
    projection = basis @ basis.T
    infinities = np.copysign(np.inf, projection)
    covariance = np.where(np.abs(projection) > _SHARED, infinities, inverse)
    covariance *= np.outer(sizes, sizes)
    free = ~held_at_bounds(values, slope, low, high)
    step = np.zeros_like(slope)
    if free.any():
        within, _ = inverse_and_null_space(normal[np.ix_(free, free)])
        step[free] = within @ slope[free]
    small = step @ slope <= _REMAINING**2 * variance
    converged = bool(small or np.abs(step).max() <= _REMAINING_PART)

    faults, message = [], [run.reason]
    for name, value, least, most in zip(unknowns.labels, values, low, high):
        if value in (least, most):
            message.append(f"{name} is at its bound")
    usual, uncertain = (1.0, 0.0) if noise_given else _noise_by_changes(run, problems)
    if noise > _DOUBTED * usual:
        faults.append("the residuals exceed the noise")
        message.append(
            f"the residuals are {noise / usual:.3g} times the noise: this scene does "
            "not move as observed with any such parameters"
        )
    parameters = unknowns.named(values)
    try:
        problems[0].scene_at(jax.tree.map(jnp.asarray, parameters))
    except ValueError as error:
        # During the search values were traced, so constructors could not check them.
        faults.append("no scene has these parameters")
        message.append(f"no scene has these parameters ({error}); set bounds")
    if not converged:
        faults.append("the search has not converged")
    # Print directions in parts of the values, unless these are nearly zero.
    parts_of = np.where(np.abs(values) > 1e-3 * sizes, values, sizes)
    undetermined = undetermined * (sizes / parts_of)[:, None]
    weak = _in_words(unknowns.labels, undetermined, inverse)
    if weak:
        faults.append("the motion does not determine all parameters")
    ratios = np.zeros(0)
    if held_out is not None:
        readings = np.maximum(held_out.facts["readings"], 1)
        ratios = np.sqrt(held_out.facts["member_loss"] / readings) / usual
        deviation = np.sqrt(1 / (2 * readings) + uncertain)
        if not (ratios <= _KNOWN + _SPREAD * deviation).all():
            # Their sum of squares grows with the errors of the parameters.
            normal = len(readings) * held_out.curvature / 2
            spread = inverse * np.outer(relative, relative)
            excess = np.sum(normal * spread) / readings.sum()
            faults.append(
                "the held-out residuals exceed the noise "
                f"({np.sqrt(1 + excess / usual**2):.3g} times the noise is expected "
                "from the standard errors alone)"
            )
    if faults and any(map(_wraps, problems)):
        message.append(
            "readings jump by about 2 pi, as angles that wrap, while joints turn on: "
            "numpy.unwrap(observed, axis=0) joins them"
        )
    return FitResult(
        parameters=parameters,
        standard_errors=unknowns.named(np.sqrt(np.diag(covariance))),
        names=unknowns.labels,
        covariance=covariance,
        weak=weak,
        rms=float(np.sqrt(np.sum(facts["squares"]) / count)),
        noise=noise,
        converged=converged,
        message="; ".join(message),
        history=members * np.array([row.loss for row in run.rows]),
        held_out=tuple(ratios.tolist()),
        faults=tuple(faults),
    )
