"""Loops of a controller about a configuration, as systems of python-control."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import Linkage
from ..checks import check_known, instance, one_of
from ..linkage import joint_names, moving_joints
from .linearization import loop_matrices

if TYPE_CHECKING:
    import control

Loop = Any  # a `control.StateSpace`, whose own types are too wide

_LARGEST_MARGIN = 1e6  # factors beyond belong to zeros at infinity or poles at rest
_EXACT = 1e-8  # to this part a peak is known
_BANDWIDTH = 10 ** (-3 / 20)  # -3 dB


def open_loop(
    linkage: Linkage,
    q: ArrayLike,
    controller: Callable,
    joint: int,
    forces: tuple = (),
    t: ArrayLike = 0.0,
) -> "control.StateSpace":
    """Breaks the loop of a controller at one joint's effort, about rest at `q`.

    The controller keeps acting in the other joints. At its limit it has no gains, so
    place `q` near its reference.

    **Arguments:**

    - `q`: joint positions [m or rad].
    - `controller`: a force element, for instance a `PDController`, or a drive that
      holds one.
    - `joint`: number of the joint, from 1.
    - `forces`: further elements, without states.
    - `t`: time at which controller and forces act [s].

    **Returns:** the loop L(s) as a `control.StateSpace`, for `margins` or
    `control.bode_plot`. Its state holds positions [m or rad], velocities and the
    controller's own state. `loop.feedback()` closes the loop again.

    **Raises:** ValueError for malformed arguments and within JAX's transformations.

    >>> import fdof_jax as fj
    >>> arm, _, (pd,), _ = fj.scenes.fig7()
    >>> q, _ = pd.reference(0.0, arm)
    >>> loop = fj.analysis.open_loop(arm, q, pd, joint=1)
    >>> complex(loop(5.278j))  # at 5.278 rad/s, where |L| = 1
    (-0.962-0.273j)
    """
    return _loop_of(linkage, q, controller, joint, forces, t)[0]


def closed_loop(
    linkage: Linkage,
    q: ArrayLike,
    controller: Callable,
    joint: int,
    forces: tuple = (),
    t: ArrayLike = 0.0,
) -> "control.StateSpace":
    """Linearises how a joint follows its reference, about rest at `q`.

    Only this joint's reference changes, with its velocity and acceleration. The
    response is L / (1 + L) only if the controller acts on the error and its rate alone.

    **Arguments:** as in `open_loop`.

    **Returns:** the response T(s) of the joint's position to its reference as a
    `control.StateSpace`, for `bandwidth` or `control.step_response`. T is 0 for a plain
    function, whose reference is unknown.

    **Raises:** ValueError as `open_loop`.

    >>> import fdof_jax as fj
    >>> arm, _, (pd,), _ = fj.scenes.fig7()
    >>> q, _ = pd.reference(0.0, arm)
    >>> response = fj.analysis.closed_loop(arm, q, pd, joint=1)
    >>> float(response.poles().real.max())  # its slowest mode decays [1/s]
    -0.735
    >>> fj.analysis.bandwidth(response)
    8.103
    """
    return _loop_of(linkage, q, controller, joint, forces, t)[1]


def _loop_of(
    linkage: Linkage,
    q: ArrayLike,
    controller: Callable,
    joint: int,
    forces: tuple,
    t: ArrayLike,
) -> tuple[Loop, Loop]:
    """Returns the loop of a joint, and its response to its reference."""
    import control

    check_known("q", linkage, controller, forces, q, t)
    moving, joints = moving_joints(linkage), len(linkage.topology)
    k = one_of("joint", joint, [k + 1 for k in moving]) - 1
    matrices = loop_matrices(linkage, q, controller, forces, t)
    A, B, C, F = (np.asarray(matrix, float) for matrix in matrices)
    # Left out are states of fixed pairs, and those of the controller that act on no
    # joint, such as an integral of a fixed pair, or that nothing changes.
    paths = np.linalg.matrix_power((A != 0) + np.eye(len(A)), len(A)) > 0
    both = [*moving, *(joints + k for k in moving)]  # positions and velocities
    driven = paths[:, both].any(axis=1) | (paths @ F.any(axis=(0, 2)))
    states = np.flatnonzero(paths[both].any(axis=0) & driven)
    A, B, C, F = A[np.ix_(states, states)], B[states], C[:, states], F[:, states]
    # Rates and accelerations of the reference act as s and s^2 times its positions; of
    # s (s I - A)^-1 = I + A (s I - A)^-1 the first part reaches no position at once.
    position, rate, acceleration = F
    position = position + A @ (rate + A @ acceleration)
    column, row, name = B[:, [k]], C[[k]], joint_names(linkage)[k]
    loop = control.ss(A + column @ row, column, row, 0, name=f"loop of {name}")
    at_joint = (states == k).astype(float)[None]
    through = at_joint @ A @ acceleration[:, [k]]
    following = A, position[:, [k]], at_joint, through
    return loop, control.ss(*following, name=f"response of {name}")


class Margins(NamedTuple):
    """Distances of a loop from instability.

    - `gain`: the factor nearest to 1 that makes the loop unstable. If it is below 1,
      the arm falls when the gains are too low.
    - `phase`, `delay`: least change of phase [rad] and least delay [s] that make it
      unstable.
    - `modulus`: least distance m = |1 + L| over all frequencies. The loop stays stable
      for factors from 1 / (1 + m) to 1 / (1 - m), and the phase margin is at least 2
      arcsin(m / 2).
    - `crossover`: frequency of the phase margin, where |L| = 1 [rad/s].
    """

    gain: float
    phase: float
    delay: float
    modulus: float
    crossover: float


def margins(loop: "control.StateSpace") -> Margins:
    """Computes the margins of an open loop.

    **Arguments:** `loop`: the result of `open_loop`.

    **Returns:** `Margins` [1, rad, s, 1, rad/s], NaN if the closed loop is unstable.
    Where no change makes it unstable, margins are infinite and the modulus is 1.

    **Raises:** ValueError if `loop` is not a `control.StateSpace`.

    >>> import fdof_jax as fj
    >>> arm, _, (pd,), _ = fj.scenes.fig7()
    >>> q, _ = pd.reference(0.0, arm)
    >>> fj.analysis.margins(fj.analysis.open_loop(arm, q, pd, joint=1))
    Margins(gain=0.026, phase=0.277, delay=0.052, modulus=0.276, crossover=5.278)
    """
    import control

    instance("loop", loop, control.StateSpace)
    closed: Loop = loop.feedback()
    if closed.poles().real.max() >= 0:
        return Margins(*[np.nan] * 5)
    slower, unit = _slower(loop, closed)
    with np.errstate(all="ignore"):  # infinite at poles
        gains, phases, _, _, crossings, _ = control.stability_margins(slower, True)
    gains = gains[(gains > 1 / _LARGEST_MARGIN) & (gains < _LARGEST_MARGIN)]
    phases, crossings = np.deg2rad(phases), crossings * unit
    at_crossings = zip(phases, crossings)
    nearest = min(at_crossings, key=lambda row: abs(row[0]), default=(np.inf, np.nan))
    return Margins(
        gain=float(np.exp(min(np.log(gains), key=abs, default=np.inf))),
        phase=float(nearest[0]),
        delay=float(min(phases % (2 * np.pi) / crossings, default=np.inf)),
        modulus=_modulus_margin(slower),
        crossover=float(nearest[1]),
    )


def bandwidth(response: "control.StateSpace") -> float:
    """Computes the frequency at which a joint's response has dropped by 3 dB.

    **Arguments:** `response`: the result of `closed_loop`.

    **Returns:** the least frequency at which |T| = 0.708 |T(0)| [rad/s]: infinite if
    the joint follows at all frequencies, as under computed torque with an exact model;
    NaN if it does not follow at rest.

    **Raises:** ValueError if `response` is not a `control.StateSpace`.
    """
    import control

    instance("response", response, control.StateSpace)
    level = _BANDWIDTH * float(np.abs(response.dcgain()))
    if not 0 < level < np.inf:
        return np.nan
    # `control.bandwidth` looks at 1000 frequencies, and misses dips beside the lightly
    # damped modes of other joints: 20.3 for 6.18 rad/s at a damping ratio of 5e-4.
    slower, unit = _slower(response, response)
    return unit * min(_crossings(slower / level), default=np.inf)


def _slower(system: Loop, closed: Loop) -> tuple[Loop, float]:
    """Returns a system in units of time in which the closed loop's poles are around 1.

    Also returns the factor: the geometric mean of the poles' magnitudes [rad/s].
    """
    import control

    # Polynomials of python-control else overflow: 11 of 58 loops of eight joints with
    # lags raised `LinAlgError`.
    rates = np.abs(closed.poles())
    unit = float(np.exp(np.log(rates[rates > 0]).mean()))
    return control.ss(system.A / unit, system.B / unit, system.C, system.D), unit


def _crossings(system: "control.StateSpace") -> list[float]:
    """Returns the frequencies above 0 at which the magnitude is 1, in order."""
    import control

    with np.errstate(all="ignore"):
        return control.stability_margins(system, True)[4].tolist()


def _modulus_margin(loop: Loop) -> float:
    """Returns the least |1 + L| of a loop that is stable when closed."""
    import control

    sensitivity: Loop = control.feedback(1, loop)
    size = lambda w: np.abs(sensitivity(1j * w))
    poles = sensitivity.poles()
    tried = np.append(np.abs(poles), np.abs(poles.imag))
    # Each pass looks between the frequencies at which 1 / |1 + L| passes its largest
    # value so far (Bruinsma and Steinbuch, 1990). Of 780 random loops of three joints
    # none was wrong by more than 1e-5; `control.norm` was wrong for 195 of them, and
    # `control.stability_margins` missed the minimum of 3 in 429.
    largest, peak = 0.0, size(tried).max(initial=1.0)  # 1 at infinity
    while peak > largest * (1 + _EXACT):
        largest = float(peak)
        ends = np.array([0.0, *_crossings(sensitivity / (largest * (1 + _EXACT)))])
        peak = size((ends[1:] + ends[:-1]) / 2).max(initial=0.0)
    return 1 / largest
