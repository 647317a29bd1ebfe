"""Tests of a controller on its arm: steps and sines of the reference, per joint."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..base.checks import is_traced, real_array, refusal
from ..base.html_table import html_table
from ..forces.element import Forces, elements_on, of_full_size
from ..linkage.coordinates import State
from ..linkage.linkage import (
    Linkage,
    check_linkage,
    joint_names,
    moving_joints,
    per_joint,
)
from .equilibria import holding_efforts
from .loops import BANDWIDTH, open_loop
from .probes import Probe, answer, at_rest, commanding, following

# Samples of a response: at least so many, so that most arms share a program, and one
# for each part of a radian of the fastest mode, between which cubics are exact to 1e-5.
_LEAST, _MOST, _TURN = 1000, 2**20, 0.25
BAND = 0.02  # around the final value, in which a response has settled
_SETTLED = 0.9  # part of the duration before which it has to
# Frequencies of the sines over the bandwidth of the linearised loop. Small sines pass
# -3 dB between the two that are added, also beside the narrow peaks of other joints.
_FREQUENCIES = np.sort([*np.geomspace(0.1, 2.5, 12), 0.98, 1.02])
_PERIODS = 2  # in which a sine is measured
# An arm comes to rest in this many time constants of its slowest mode, for at most so
# many times the duration of a response.
_DECAYED, _LONGEST = 30, 50


class StepAndSine(eqx.Module):
    """Answers of each joint to steps and sines of its reference; prints itself.

    - `joints`: names of the tested joints, for instance R1.
    - `step`: height of the steps, and amplitude of the sines (joint,) [m or rad].
    - `overshoot`: greatest excess of a step response over its final value, as a share
      of the final change (joint,).
    - `rise_time`: from 10 to 90 % of the final change (joint,) [s].
    - `settling_time`: after which the response stays within 2 % of the final change
      (joint,) [s]; NaN if that is in the last tenth of the test or never.
    - `bandwidth`: frequency at which the response to a sine is 3 dB below the final
      response to the step (joint,) [rad/s]; NaN if outside of the tested ones.
    - `saturated`: share of the time after the step that the actuator spends at its
      limit (joint,).
    - `ts`, `response`: times since the step (time,) [s], and the change of the joint's
      position over the height of its step (joint, time).
    - `frequency`, `gain`: frequencies of the sines [rad/s], and the first harmonics of
      the response over those of the reference, (joint, frequency).
    """

    joints: tuple[str, ...]
    step: Float[np.ndarray, " joint"]
    overshoot: Float[np.ndarray, " joint"]
    rise_time: Float[np.ndarray, " joint"]
    settling_time: Float[np.ndarray, " joint"]
    bandwidth: Float[np.ndarray, " joint"]
    saturated: Float[np.ndarray, " joint"]
    ts: Float[np.ndarray, " time"]
    response: Float[np.ndarray, "joint time"]
    frequency: Float[np.ndarray, "joint frequency"]
    gain: Complex[np.ndarray, "joint frequency"]

    def _rows(self) -> list[list[str]]:
        header = ["", "step", "overshoot", "rise", "settling", "bandwidth", "at limit"]
        units = ["", "[m, rad]", "[%]", "[s]", "[s]", "[rad/s]", "[% of time]"]
        columns = (
            self.step, 100 * self.overshoot, self.rise_time, self.settling_time,
            self.bandwidth, 100 * self.saturated,
        )  # fmt: skip
        rows = zip(self.joints, *columns)
        return [header, units] + [
            [name, *(f"{value:.4g}" for value in values)] for name, *values in rows
        ]

    def __str__(self) -> str:
        rows = (f"{a:4}" + "".join(f"{b:>12}" for b in row) for a, *row in self._rows())
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        header, *rows = self._rows()
        return html_table(rows, header)


def step_and_sine(
    linkage: Linkage,
    q: ArrayLike,
    controller: Any,
    forces: Forces = (),
    *,
    step: ArrayLike,
    duration: ArrayLike,
) -> StepAndSine:
    """Simulates a step and sines of the reference of each joint, one after the other.

    The reference rests at `q`, and the arm where it sags to under the controller. The
    reference of one joint then steps, without a velocity, and the response is recorded
    for the `duration`. Sines of the reference, with their velocities, have the same
    time to build up. Their frequencies are 0.1 to 2.5 times the bandwidth of the
    linearised loop, or its crossover where the arm follows all sines. Small steps show
    the linear behaviour, large ones the limits. Responses are sampled as finely as the
    fastest mode asks for, a thousand times at least.

    **Arguments:**

    - `linkage`, `q`: the arm and its joint positions [m or rad].
    - `controller`: a `PDController`, `GravityFeedforward` or `ComputedTorque`, or a
      drive that holds one; its own reference is not used.
    - `forces`: further elements, without a state of their own.
    - `step`: one per joint or one for all, positive [m or rad].
    - `duration`: time for a response to settle [s].

    **Returns:** a `StepAndSine`, NaN where a motion fails, and with a bandwidth of NaN
    where an arm follows all sines, as with `ComputedTorque` within its limits. NumPy
    analyses the motions, so the function cannot be used within JAX's transformations.

    **Raises:** ValueError for malformed arguments, if a joint does not follow its
    reference at `q`, or where the arm comes to rest: its limits may be too low; and for
    a duration of more than a quarter of a million radians of the fastest mode.

    >>> import fdof_jax as fj
    >>> arm, _, (pd,), _ = fj.scenes.fig7()
    >>> q, _ = pd.reference(0.0, arm)
    >>> kp, kd = fj.control.gains_from_frequency(arm, q, [8, 20, 20], 0.7)
    >>> pd = fj.PDController(kp, kd, pd.limit, pd.reference)
    >>> print(fj.analysis.step_and_sine(arm, q, pd, step=0.5, duration=2.0))
                step   overshoot        rise    settling   bandwidth    at limit
            [m, rad]         [%]         [s]         [s]     [rad/s] [% of time]
    R1           0.5       5.161      0.2743      0.7649       7.822       2.145
    P2           0.5       4.115      0.1168      0.3365       24.37      0.4195
    R3           0.5       3.018      0.1198      0.3513       28.07           0
    """
    check_linkage(linkage)
    q = per_joint("q", q, linkage)
    n = q.size
    step = real_array("step", step, (n,), above=0, broadcast=True, unit="m or rad")
    duration = real_array("duration", duration, (), above=0, unit="s")
    if (pd := commanding(controller)) is None:
        expected = "a PDController, or a drive that holds one"
        raise refusal("controller", expected, controller)
    if is_traced(linkage, controller, forces, q, step, duration):
        raise ValueError("q: expected known values, outside of JAX's transformations.")
    (element,) = of_full_size(linkage, elements_on(linkage, (controller,)))
    zero = jnp.zeros(n)
    resting = following(element, Probe(q, zero, 0.0, zero, 1.0))
    names, moving = joint_names(linkage), moving_joints(linkage)

    def loops_at(q):
        return [open_loop(linkage, q, resting, k + 1, forces) for k in moving]

    loops = loops_at(q)
    if np.isnan([loop.bandwidth for loop in loops]).any():
        expected = "one with which each joint follows its reference at q"
        raise refusal("controller", expected, controller)
    start = State(q, zero), None
    if loops[0].slowest_decay > 0:
        time = min(_DECAYED / loops[0].slowest_decay, _LONGEST * float(duration))
        start = at_rest(linkage, resting, forces, q, time)
        loops = loops_at(start[0].q)
    bandwidths = np.array([loop.bandwidth for loop in loops])
    if np.isnan(bandwidths).any():  # at a limit, a controller has no gains
        needed = np.asarray(holding_efforts(linkage, q, forces)).round(6).tolist()
        raise ValueError(
            "controller: expected limits within which the arm comes to rest near q, "
            f"got {pd.limit.tolist()}; to be held there it needs efforts of {needed} "
            "(`holding_efforts`), and more to be caught as it sags."
        )
    crossovers = [loop.crossover for loop in loops]  # where an arm follows all sines
    scale = np.where(np.isinf(bandwidths), crossovers, bandwidths)
    frequency = scale[:, None] * _FREQUENCIES
    t0 = float(duration)
    since = np.linspace(0, t0, samples_of(t0, loops[0].fastest))
    steps, gain = [], np.zeros(frequency.shape, complex)
    # One after the other: a batch takes three times as long to compile.
    for row, k in enumerate(moving):
        height, none = np.asarray(step) * np.eye(n)[k], np.zeros(n)

        def moved(probe, times, k=k):
            ts = np.append(0, t0 + times)
            found = answer(linkage, element, forces, start, probe, ts)
            return [np.asarray(part)[1:, k] for part in found]

        steps.append(moved(Probe(q, height, t0, none, 1.0), since))
        for column, w in enumerate(frequency[row]):
            times = 2 * np.pi / w * _PERIODS * np.arange(_LEAST) / _LEAST
            position, *_ = moved(Probe(q, none, t0, height, w), times)
            phase = np.exp(-1j * w * (t0 + times))
            gain[row, column] = 2j * np.mean(position * phase) / height[k]
    step = np.asarray(step)[moving]
    positions, rates, demands = (np.stack(part) for part in zip(*steps))
    changes = (positions - positions[:, :1]) / step[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        final = changes[:, -1:]
        shares = changes / final, rates / (step[:, None] * final)
    rows = [step_measures(since, *row) for row in zip(*shares)]
    overshoot, rise_time, settling_time = np.array(rows).T
    settled = settling_time <= _SETTLED * t0
    saturated = np.array(list(map(share_beyond, demands)))
    failed = np.isnan(changes).any(axis=1)
    return StepAndSine(
        joints=tuple(names[k] for k in moving),
        step=step,
        overshoot=overshoot,
        rise_time=rise_time,
        settling_time=np.where(settled, settling_time, np.nan),
        bandwidth=np.array(list(map(_bandwidth, frequency, gain, changes[:, -1]))),
        saturated=np.where(failed, np.nan, saturated),
        ts=since,
        response=changes,
        frequency=frequency,
        gain=gain,
    )


def samples_of(duration: float, fastest: float) -> int:
    """Returns how many samples of a response resolve the fastest mode [rad/s]."""
    count = duration * fastest / _TURN
    if not count < _MOST:
        raise ValueError(
            f"duration: expected at most {_MOST * _TURN / fastest:.3g} s for modes as "
            f"fast as {fastest:.3g} rad/s, got {duration:g} s."
        )
    return max(int(count), _LEAST)


def step_measures(
    ts: np.ndarray, part: np.ndarray, speed: np.ndarray
) -> tuple[float, float, float]:
    """Measures a response as a part of its step, with its rate of change.

    Returns the overshoot, the rise time (NaN if 90 % is not reached), and the time
    after which the response is settled (NaN if it is not at the end).
    """
    if not np.isfinite([part, speed]).all():
        return np.nan, np.nan, np.nan
    curve = scipy.interpolate.CubicHermiteSpline(ts, part, speed)

    def passing(level: float) -> np.ndarray:
        """Returns when the response passes a level."""
        found = curve.solve(level, extrapolate=False)
        return found[np.isfinite(found)]  # NaN follows a part on the level

    turns = curve.derivative().roots(extrapolate=False)
    most = curve(turns[np.isfinite(turns)]).max(initial=part.max())
    low, high = passing(0.1), passing(0.9)
    rise = high[0] - low[0] if high.size and low.size else np.nan
    settled = np.append(passing(1 - BAND), passing(1 + BAND)).max(initial=0.0)
    inside = np.abs(part[-1] - 1) <= BAND
    return max(most - 1, 0.0), rise, settled if inside else np.nan


def share_beyond(demand: np.ndarray) -> float:
    """Returns the share of the time at which samples, and lines between, exceed 1."""
    above = np.abs(demand) - 1
    before, after = above[:-1], above[1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # equal or infinite
        share = np.maximum(before, after) / np.abs(after - before)
    share = np.clip(np.nan_to_num(share), 0, 1)
    return float(np.mean(np.where((before > 0) & (after > 0), 1, share)))


def _bandwidth(frequency: np.ndarray, gain: np.ndarray, final: float) -> float:
    """Returns the first frequency at which |gain| is 3 dB below the final value."""
    level = np.log(np.abs(gain / final))
    if not np.isfinite(level).all() or level[0] < np.log(BANDWIDTH):
        return np.nan
    curve = scipy.interpolate.CubicSpline(np.log(frequency), level)
    found = curve.solve(np.log(BANDWIDTH), extrapolate=False)
    return float(np.exp(found[0])) if found.size else np.nan
