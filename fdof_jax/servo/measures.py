"""Measures of a motion under a controller, against its reference."""

from typing import Any

import jax
import numpy as np
import scipy
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .. import Linkage, PDController, Solution, joint_efforts
from ..checks import check_joints, check_known, check_linkage, real_array, refusal
from ..control import Drive, controller_in
from ..data import Report
from ..forces import StatefulElement, elements_on
from ..linkage import joint_names, moving_joints

_BAND = 0.02  # around the final value, in which a response has settled
_SETTLED = 0.9  # part of the duration before which it has to
_STANDS = 1e-9  # changes of a reference that are less are none [m or rad]


class Response(Report):
    """Measures of how joints followed their reference; prints itself.

    Overshoot, rise and settling refer to the last position, which a load or friction
    may keep away from the reference. They are NaN for joints whose reference moves
    meanwhile (then `step` is too), or was reached from the start.

    - `joints`: names of the moving joints.
    - `step`: from the first position to the final reference (joint,) [m or rad].
    - `overshoot`: greatest excess over the last position, as a share of the change to
      it (joint,).
    - `rise_time`: time from 10 to 90 % of that change (joint,) [s].
    - `settling_time`: time after which the joint stays within 2 % of that change
      (joint,) [s]; NaN if it settles in the last tenth of the time or never.
    - `steady_error`: last position less the reference (joint,) [m or rad].
    - `largest_error`, `rms_error`: over all samples (joint,) [m or rad].
    - `saturated`: share of samples with the actuator at its limit (joint,).
    """

    joints: tuple[str, ...]
    step: Float[np.ndarray, " joint"]
    overshoot: Float[np.ndarray, " joint"]
    rise_time: Float[np.ndarray, " joint"]
    settling_time: Float[np.ndarray, " joint"]
    steady_error: Float[np.ndarray, " joint"]
    largest_error: Float[np.ndarray, " joint"]
    rms_error: Float[np.ndarray, " joint"]
    saturated: Float[np.ndarray, " joint"]

    def _rows(self) -> list[list[str]]:
        header = ["", "step", "overshoot", "rise", "settling", "steady error",
                  "largest error", "rms error", "at limit"]  # fmt: skip
        length = "[m, rad]"
        units = ["", length, "[%]", "[s]", "[s]", *[length] * 3, "[% of time]"]
        overshoot = np.round(100 * self.overshoot, 3)
        columns = (
            self.step, overshoot, self.rise_time, self.settling_time,
            self.steady_error, self.largest_error, self.rms_error, 100 * self.saturated,
        )  # fmt: skip
        numbers = ([f"{value:.4g}" for value in row] for row in zip(*columns))
        rows = [[name, *row] for name, row in zip(self.joints, numbers)]
        return [header, units, *rows]

    def _remarks(self) -> list[str]:
        rows = zip(self.joints, self.step, self.overshoot, self.steady_error)
        lines = []
        for name, step, overshoot, error in rows:
            if np.isnan(step):
                lines.append(f"{name}: no step, as its reference moves meanwhile")
            elif np.isnan(overshoot):
                lines.append(f"{name}: no step, as it begins at its reference")
            elif abs(error) > _BAND * abs(step):
                share = 100 * abs(error / step)
                lines.append(
                    f"{name} ends {share:.2g} % of its step away from the reference; "
                    "overshoot, rise and settling are those about where it ends"
                )
        return lines


def response(
    linkage: Linkage, forces: tuple, solution: Solution, *, since: ArrayLike = -np.inf
) -> Response:
    """Measures how a motion followed the reference of its controller.

    **Arguments:**

    - `solution`: one motion, with ten samples or more in the fastest swing.
    - `forces`: those of the solution; for `simulate_sampled`, `(control, *forces)`. One
      of them is a `PDController`, `PIDController`, `GravityFeedforward` or
      `ComputedTorque`, or a drive that holds one.
    - `since`: time from which the motion counts, such as that of a step [s]; by default
      all of it counts.

    **Raises:** ValueError for malformed arguments, for a motion that failed, and within
    JAX's transformations.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> step = fj.references.Step([-1.0, 0.4], [-0.8, 0.4], begin=0.2)
    >>> pd = fj.control.GravityFeedforward(100.0, 20.0, 30.0, step)
    >>> start = fj.State([-1.0, 0.4], [0, 0])
    >>> motion = fj.simulate(arm, start, np.linspace(0, 2, 201), (pd,))
    >>> found = fj.analysis.response(arm, (pd,), motion, since=0.2)
    >>> found.joints, found.step.tolist()
    (('R1', 'R2'), [0.2, 0.0])
    >>> for share_or_time in (found.overshoot, found.rise_time, found.settling_time):
    ...     print(f"{share_or_time[0]:.3f}")
    0.086
    0.322
    0.987
    """
    check_linkage(linkage)
    check_known("solution", linkage, forces, solution, since)
    check_joints("solution", solution, linkage)
    if np.ndim(solution.q) != 2:
        expected = "one motion (of a batch, pass one member)"
        raise refusal("solution", expected, solution)
    controller, efforts = _controller(linkage, forces, solution)
    ts, last = np.asarray(solution.ts), float(solution.ts[-1])
    begin = max(float(real_array("since", since, (), finite=False, unit="s")), ts[0])
    if not begin < last:
        raise refusal("since", f"a time before the last sample, at {last:g} s", since)
    if not np.isfinite(solution.q).all():
        expected = "a motion that reached its end"
        raise refusal("solution", expected, solution.outcome.tolist())
    moving, names = moving_joints(linkage), joint_names(linkage)
    tables = solution.q, solution.qd, efforts
    q, qd, efforts = (np.asarray(table)[:, moving] for table in tables)
    path = scipy.interpolate.CubicHermiteSpline(ts, q, qd)
    efforts = efforts[ts >= begin]
    ts = np.append(begin, ts[ts > begin])
    q, qd = path(ts), path(ts, 1)
    wanted = jax.vmap(lambda t: controller.schedule(t, linkage)[0])(ts)
    wanted = np.asarray(wanted)[:, moving]
    error, step = q - wanted, wanted[-1] - q[0]
    still = np.ptp(wanted[1:], axis=0) < _STANDS
    stands = still & (np.abs(step) > _STANDS)
    measures = [
        step_measures(ts - begin, change, rate, change[-1])
        if steps else (np.nan, np.nan, np.nan)
        for change, rate, steps in zip((q - q[0]).T, qd.T, stands)
    ]  # fmt: skip
    overshoot, rise_time, settled = np.transpose(measures)
    limits = np.asarray(controller.limit)[moving]
    return Response(
        joints=tuple(names[k] for k in moving),
        step=np.where(still, step, np.nan),
        overshoot=overshoot,
        rise_time=rise_time,
        settling_time=np.where(settled <= _SETTLED * (last - begin), settled, np.nan),
        steady_error=error[-1],
        largest_error=np.abs(error).max(axis=0),
        rms_error=np.sqrt(np.mean(error**2, axis=0)),
        saturated=np.mean((np.abs(efforts) >= limits) & (efforts != 0), axis=0),
    )


def _controller(
    linkage: Linkage, forces: tuple, solution: Solution
) -> tuple[PDController, Array]:
    """Returns the controller among elements and in drives, and its efforts."""
    efforts = joint_efforts(linkage, forces, solution).elements
    given = elements_on(linkage, forces)
    found = [(k, c) for k, e in enumerate(given) if (c := controller_in(e)) is not None]
    if len(found) != 1:
        expected = "one controller with a reference, or one drive that holds one"
        raise refusal("forces", expected, forces)
    ((k, controller),) = found
    acts: Any = given[k]
    sampled = int(solution.acting is not None)  # the first, which then has no state
    if k < sampled or not isinstance(acts, Drive):
        return controller, efforts[k]
    state = solution.own[sum(isinstance(e, StatefulElement) for e in given[sampled:k])]
    while isinstance(acts, Drive):
        acts, state = acts.command, state.command
    effort = lambda t, q, qd, state: acts.act(t, q, qd, linkage, state)[0]
    return controller, jax.vmap(effort)(solution.ts, solution.q, solution.qd, state)


def step_measures(
    ts: ArrayLike, change: ArrayLike, rate: ArrayLike, final: ArrayLike
) -> tuple[float, float, float]:
    """Measures any response to a step, such as the tip's, from its samples.

    **Arguments:** `ts`: times since the step (time,) [s]; `change`: the response less
    its first value (time,); `rate`: its derivative (time,); `final`: the intended
    change.

    **Returns:** overshoot, as a share of the final change; rise time [s], NaN if 90 %
    is not reached; settling time to 2 % [s], NaN if the response does not settle. All
    are NaN if `final` is 0 or numbers are not finite.

    **Raises:** ValueError for malformed arguments.
    """
    import control

    ts = np.asarray(real_array("ts", ts, (None,)), float)
    if ts.size < 2 or (np.diff(ts) <= 0).any():
        raise refusal("ts", "two or more increasing times", ts)
    change, rate, final = map(np.asarray, (change, rate, final))
    for name, values in dict(change=change, rate=rate, final=final).items():
        shape = () if name == "final" else ts.shape
        if values.shape != shape or values.dtype.kind not in "iuf":
            raise refusal(name, f"real numbers of shape {shape}", values)
    if not final or not np.isfinite([*change, *rate, final]).all():
        return np.nan, np.nan, np.nan
    # `step_info` measures to the nearest sample: within 3e-4 of a time with these.
    fine = np.union1d(ts, np.geomspace(ts[1] / 100, ts[-1], 2**16))
    part = scipy.interpolate.CubicHermiteSpline(ts, change, rate)(fine) / final
    rises = part.max() >= 0.9  # else `step_info` raises IndexError
    limits = (0.1, 0.9) if rises else (-np.inf, -np.inf)
    info: Any = control.step_info(
        part, fine, None, 1.0, SettlingTimeThreshold=_BAND, RiseTimeLimits=limits
    )
    rise_time = info["RiseTime"] if rises else np.nan
    return info["Overshoot"] / 100, rise_time, info["SettlingTime"]
