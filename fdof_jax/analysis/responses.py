"""Tests of a controller on its arm: steps and sines of the reference, per joint."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..base.checks import check_known, real_array, refusal
from ..base.report import Report
from ..control.drives import commanding
from ..control.pd import PDController
from ..forces.element import Element, Forces, OwnStates, StatefulElement, elements_on
from ..linkage.coordinates import State
from ..linkage.fields import Values, field
from ..linkage.linkage import (
    Linkage,
    check_linkage,
    joint_names,
    moving_joints,
    per_joint,
)
from ..references.reference import Reference
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .linearization import holding_efforts
from .loops import BANDWIDTH, Loop, bandwidth, loops_of, margins
from .measures import SETTLED, relative_demands, step_measures

# Samples of a response: at least so many, so that most arms share a program, and one
# for each part of a radian of the fastest mode, between which cubics are exact to 1e-5.
_LEAST, _MOST, _TURN = 1000, 2**20, 0.25
# Frequencies of the sines over the bandwidth of the linearised loop. Small sines pass
# -3 dB between the two that are added, also beside the narrow peaks of other joints.
_FREQUENCIES = np.sort([*np.geomspace(0.1, 2.5, 12), 0.98, 1.02])
_PERIODS = 2  # in which a sine is measured
# An arm comes to rest in this many time constants of its slowest mode, for at most so
# many times the duration of a response.
_DECAYED, _LONGEST = 30, 50
# A slow joint may take as long to settle as a fast one takes for so many steps.
_STEPS = 2**20


class Probe(Reference):
    """A reference that swings from the start, or stands."""

    center: Values = field(unit="m or rad")
    amplitude: Values = field(unit="m or rad")
    frequency: Values = field((), unit="rad/s")

    def __call__(self, t: Any, linkage: Linkage) -> tuple[Array, Array]:
        angle, rate = self.frequency * t, self.frequency * self.amplitude
        return self.center + self.amplitude * jnp.sin(angle), rate * jnp.cos(angle)


class StepAndSine(Report):
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
    - `saturated`: share of the samples after the step at which the actuator is at its
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
        numbers = ([f"{value:.4g}" for value in row] for row in zip(*columns))
        rows = [[name, *row] for name, row in zip(self.joints, numbers)]
        return [header, units, *rows]


def step_and_sine(
    linkage: Linkage,
    q: ArrayLike,
    controller: Callable,
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
            step  overshoot    rise  settling  bandwidth     at limit
        [m, rad]        [%]     [s]       [s]    [rad/s]  [% of time]
    R1       0.5      5.161  0.2743    0.7649      7.822          2.2
    P2       0.5      4.115  0.1168    0.3365      24.37          0.5
    R3       0.5      3.018  0.1198    0.3513      28.07            0
    """
    check_linkage(linkage)
    q = per_joint("q", q, linkage)
    n = q.size
    step = real_array("step", step, (n,), above=0, broadcast=True, unit="m or rad")
    duration = real_array("duration", duration, (), above=0, unit="s")
    if not isinstance(pd := commanding(controller), PDController):
        expected = "a PDController, or a drive that holds one"
        raise refusal("controller", expected, controller)
    check_known("q", linkage, controller, forces, q, step, duration)
    (element,) = elements_on(linkage, (controller,))
    names, moving = joint_names(linkage), moving_joints(linkage)
    heights, t0, still = np.asarray(step), float(duration), np.zeros(n)

    def with_probe(
        center: ArrayLike, amplitude: ArrayLike = still, frequency: float = 1
    ) -> Element:
        """Returns the controller with a probe for its reference."""
        probe = Probe(center, amplitude, frequency)
        return eqx.tree_at(lambda part: commanding(part).reference, element, probe)

    def motion(
        acting: Element, start: State, own: OwnStates | None, ts: np.ndarray
    ) -> Solution:
        keywords: Any = dict(own0=own, throw=False, max_steps=_STEPS)
        return simulate(linkage, start, ts, (acting, *forces), **keywords)

    def loops_at(here: ArrayLike) -> tuple[tuple[Loop, ...], np.ndarray, np.ndarray]:
        """Returns the joints' loops, the poles when closed, and the bandwidths."""
        loops, responses = zip(*loops_of(linkage, here, with_probe(q), forces))
        return loops, responses[0].poles(), np.array(list(map(bandwidth, responses)))

    loops, poles, bandwidths = loops_at(q)
    if np.isnan(bandwidths).any():
        expected = "one with which each joint follows its reference at q"
        raise refusal("controller", expected, controller)
    start, own = State(q, jnp.asarray(still)), None
    if (decay := -np.real(poles).max()) > 0:
        if isinstance(element, StatefulElement):
            own = (element.initial_state(linkage),)
        # As many times as of most answers, so that one program serves both.
        ts = np.linspace(0, min(_DECAYED / decay, _LONGEST * t0), _LEAST)
        sag = motion(with_probe(q), start, own, ts)
        if np.isfinite([sag.q[-1], sag.qd[-1]]).all():
            start = State(sag.q[-1], sag.qd[-1])
            own = own and jax.tree.map(lambda rows: rows[-1], sag.own)
        loops, poles, bandwidths = loops_at(start.q)
    if np.isnan(bandwidths).any():  # at a limit, a controller has no gains
        needed = np.asarray(holding_efforts(linkage, q, forces)).round(6).tolist()
        raise ValueError(
            "controller: expected limits within which the arm comes to rest near q, "
            f"got {pd.limit.tolist()}; to be held there it needs efforts of {needed} "
            "(`holding_efforts`), and more to be caught as it sags."
        )
    since = np.linspace(0, t0, samples_of(t0, np.abs(poles).max()))
    rows = []
    # One after the other: a batch takes three times as long to compile.
    for k, loop, scale in zip(moving, loops, bandwidths):
        height = heights * np.eye(n)[k]
        acting = with_probe(q + height)
        run = motion(acting, start, own, since)
        change = np.asarray(run.q[:, k] - run.q[0, k]) / heights[k]
        rate = np.asarray(run.qd[:, k]) / heights[k]
        measures = step_measures(since, change, rate, change[-1])
        demand = relative_demands(commanding(acting), linkage, run)[:, k]
        if np.isinf(scale):  # the arm follows all sines
            scale = margins(loop).crossover
        frequency, gain = scale * _FREQUENCIES, []
        for w in frequency:
            ts = t0 + 2 * np.pi / w * _PERIODS * np.arange(_LEAST - 1) / (_LEAST - 1)
            run = motion(with_probe(q, height, w), start, own, np.append(0, ts))
            harmonic = np.mean(run.q[1:, k] * np.exp(-1j * w * ts))
            gain.append(2j * harmonic / heights[k])
        width = _bandwidth(frequency, np.array(gain), change[-1])
        at_limit = np.mean(np.abs(demand) > 1)
        rows.append((*measures, width, at_limit, change, frequency, gain))
    overshoot, rise_time, settling_time, *others = map(np.array, zip(*rows))
    widths, at_limit, response, frequency, gain = others
    return StepAndSine(
        joints=tuple(names[k] for k in moving),
        step=heights[moving],
        overshoot=overshoot,
        rise_time=rise_time,
        settling_time=np.where(settling_time <= SETTLED * t0, settling_time, np.nan),
        bandwidth=widths,
        saturated=np.where(np.isnan(overshoot), np.nan, at_limit),
        ts=since,
        response=response,
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


def _bandwidth(frequency: np.ndarray, gain: np.ndarray, final: float) -> float:
    """Returns the first frequency at which |gain| is 3 dB below the final value."""
    level = np.log(np.abs(gain / final))
    if not np.isfinite(level).all() or level[0] < np.log(BANDWIDTH):
        return np.nan
    curve = scipy.interpolate.CubicSpline(np.log(frequency), level)
    crossings = curve.solve(np.log(BANDWIDTH), extrapolate=False)
    return float(np.exp(crossings[0])) if crossings.size else np.nan
