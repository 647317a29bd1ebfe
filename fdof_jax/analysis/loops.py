"""Loops of a controller about a configuration: frequency response and margins."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..base.checks import is_traced, one_of, real_array, refusal
from ..base.html_table import html_table
from ..forces.element import Forces, elements_on, of_full_size
from ..linkage.linkage import (
    Linkage,
    check_linkage,
    joint_names,
    moving_joints,
    per_joint,
)
from ..simulation.prescribed import prescribed
from .linearization import checked, closed_loop
from .transfer import Transfer

# A response counts as real if its imaginary part is below this part of it.
_REAL = 1e-6
# Gain margins beyond this are zeros at infinity or poles at rest, rounded.
_LARGEST_MARGIN = 1e6
BANDWIDTH = 10 ** (-3 / 20)  # -3 dB


class OpenLoop(eqx.Module):
    """The loop of a controller, broken at one joint's effort; prints its margins.

    The loop's transfer function is L(s) = C (s I - A)^-1 B. Where the loop is closed
    again, the eigenvalues are those of A - B C, and the joint's position follows its
    reference by T(s) = G (s I - A + B C)^-1 F + D. That is L / (1 + L) only where the
    controller acts on nothing but the error and its rate.

    - `A`, `B`, `C`: matrices (state, state), (state,) and (state,). The state holds
      positions [m or rad], velocities and the controller's own state.
    - `F`, `G`, `D`: matrices (state,), (state,) and (); 0 for a controller without a
      reference that is known, such as a plain function.
    - `joint`: the joint's name, for instance R1.
    - `stable`: whether all modes of the closed loop decay, none at less than
      `slowest_decay` [1/s].
    - `crossover`: frequency of the phase margin, at which |L| = 1 [rad/s].
    - `phase_margin`, `delay_margin`: least change of the phase [rad], and least delay
      [s], that make the closed loop unstable.
    - `gain_margin`: factor on the loop, the nearest to 1, that makes it unstable.
    - `modulus_margin`: least distance |1 + L| at all frequencies.
    - `bandwidth`: frequency above which the joint follows its reference by 3 dB less
      than at rest, |T| = 0.708 |T(0)| [rad/s]; infinite if it always follows.

    The four margins are NaN unless `stable`. Where L is zero, no change makes the
    closed loop unstable: the margins are infinite, that of the modulus 1.
    """

    A: Float[np.ndarray, "state state"]
    B: Float[np.ndarray, " state"]
    C: Float[np.ndarray, " state"]
    F: Float[np.ndarray, " state"]
    G: Float[np.ndarray, " state"]
    D: float
    joint: str

    def __call__(self, frequency: ArrayLike) -> Complex[np.ndarray, "..."]:
        """The frequency response L(i frequency), at frequencies [rad/s]."""
        return self._loop(frequency)

    @property
    def _loop(self) -> Transfer:
        return Transfer(self.A, self.B, self.C)

    @property
    def _closed(self) -> np.ndarray:
        return self.A - np.outer(self.B, self.C)

    @property
    def slowest_decay(self) -> float:
        """Rate at which the closed loop's slowest mode decays [1/s]."""
        return -float(np.real(np.linalg.eigvals(self._closed)).max())

    @property
    def fastest(self) -> float:
        """Magnitude of the closed loop's fastest mode [rad/s]."""
        return float(np.abs(np.linalg.eigvals(self._closed)).max())

    @property
    def stable(self) -> bool:
        """True if all modes of the closed loop decay; otherwise it has no margins."""
        return self.slowest_decay > 0

    @property
    def _crossing(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies at which |L| = 1, and the phase margins there."""
        found = self._loop.crossings(1.0)
        return found, np.angle(-self(found))

    @property
    def crossover(self) -> float:
        """Frequency of the phase margin, at which |L| = 1 [rad/s]; NaN if none."""
        found, margins = self._crossing
        return float(found[np.abs(margins).argmin()]) if found.size else np.nan

    @property
    def phase_margin(self) -> float:
        """Least change of the phase that makes the closed loop unstable [rad].

        Infinite if |L| is nowhere 1, NaN unless `stable`.
        """
        if not self.stable:
            return np.nan
        _, margins = self._crossing
        return float(min(margins, key=abs)) if margins.size else np.inf

    @property
    def delay_margin(self) -> float:
        """Least delay within the loop that makes the closed loop unstable [s].

        Infinite if none does, NaN unless `stable`.
        """
        if not self.stable:
            return np.nan
        found, margins = self._crossing
        return float(np.min(margins % (2 * np.pi) / found, initial=np.inf))

    @property
    def gain_margin(self) -> float:
        """Factor on the loop, the nearest to 1, that makes the closed loop unstable.

        A factor below 1 belongs to an arm that falls if the gains are too low. Infinite
        if no factor makes it unstable, NaN unless `stable`.
        """
        if not self.stable:
            return np.nan
        # An undamped arm's response is real at all frequencies.
        values = self(np.append(self._loop.real_at(), self._crossing[0]))
        at_rest = np.real(Transfer(self._closed, self.B, self.C)(0.0))
        if _REAL < abs(1 - at_rest) < np.inf:  # otherwise L(0) is infinite
            values = np.append(values, at_rest / (1 - at_rest))
        real = np.abs(np.imag(values)) <= _REAL * np.abs(values)
        factors = -1 / np.real(values[real & (np.real(values) < 0)])
        distances = np.abs(np.log(factors))
        found = distances < np.log(_LARGEST_MARGIN)
        return float(factors[distances.argmin()]) if found.any() else np.inf

    @property
    def modulus_margin(self) -> float:
        """Least distance |1 + L| from instability, at all frequencies.

        With m this distance, the loop stays stable for factors from 1 / (1 + m) to
        1 / (1 - m), and the phase margin is at least 2 arcsin(m / 2). NaN unless
        `stable`.
        """
        if not self.stable:
            return np.nan
        return 1 / Transfer(self._closed, self.B, -self.C, 1.0).peak()

    @property
    def bandwidth(self) -> float:
        """Frequency above which the joint follows by 3 dB less than at rest [rad/s].

        It is infinite if the joint follows at all frequencies, as with computed torque
        and an exact model. NaN if the joint does not follow at rest, or if no reference
        is known.
        """
        response = Transfer(self._closed, self.F, self.G, self.D)
        level = BANDWIDTH * float(np.abs(response(0.0)))
        if not 0 < level < np.inf:
            return np.nan
        return float(min(response.crossings(level), default=np.inf))

    def _rows(self) -> list[tuple[str, str]]:
        state = "stable" if self.stable else "not stable, so it has no margins"
        rows = [("closed loop", state)]
        if not self(1.0):
            return [*rows, ("controller", "no response: at its limit, or no gains")]
        if not self.stable:
            return rows
        return [
            *rows,
            ("crossover", f"{self.crossover:.4g} rad/s"),
            ("phase margin", f"{np.rad2deg(self.phase_margin):.4g} degrees"),
            ("delay margin", f"{1e3 * self.delay_margin:.4g} ms"),
            ("gain margin", f"{self.gain_margin:.4g}"),
            ("modulus margin", f"{self.modulus_margin:.4g}"),
            ("bandwidth", f"{self.bandwidth:.4g} rad/s"),
        ][: -1 if np.isnan(self.bandwidth) else None]

    def __str__(self) -> str:
        rows = [f"  {label:16}{value}" for label, value in self._rows()]
        return "\n".join([f"loop of {self.joint}", *rows])

    def _repr_html_(self) -> str:
        return html_table(self._rows(), ("loop of", self.joint))


def open_loop(
    linkage: Linkage,
    q: ArrayLike,
    controller: Any,
    joint: int,
    forces: Forces = (),
    t: ArrayLike = 0.0,
) -> OpenLoop:
    """Breaks the loop of a controller at one joint's effort, about a configuration.

    The controller's efforts in the other joints stay. The arm is at rest at `q`, where
    constant efforts hold it. For a controller with kinks, the slope there counts: at
    its limit it has no gains, so place `q` near its reference.

    **Arguments:**

    - `linkage`, `q`: the arm and its joint positions [m or rad].
    - `controller`: a force element, for instance a `PDController`, a `PIDController`,
      or a drive that holds one.
    - `joint`: number of the joint, from 1.
    - `forces`: further elements, without a state of their own.
    - `t`: time at which controller and forces are evaluated [s].

    **Returns:** an `OpenLoop`. NumPy analyses it, so the function cannot be used within
    JAX's transformations.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm, _, (pd,), _ = fj.scenes.fig7()
    >>> q, _ = pd.reference(0.0, arm)
    >>> print(fj.analysis.open_loop(arm, q, pd, joint=1))
    loop of R1
      closed loop     stable
      crossover       5.278 rad/s
      phase margin    15.86 degrees
      delay margin    52.45 ms
      gain margin     0.02625
      modulus margin  0.276
      bandwidth       8.103 rad/s
    """
    check_linkage(linkage)
    names, moving = joint_names(linkage), moving_joints(linkage)
    index = one_of("joint", joint, [k + 1 for k in moving]) - 1
    forces = checked(linkage, forces)
    if not callable(controller) or isinstance(controller, type):
        expected = "a force element, a PDController for instance"
        raise refusal("controller", expected, controller)
    (element,) = of_full_size(linkage, elements_on(linkage, (controller,)))
    if prescribed((element,)) is not None:
        raise refusal("controller", "one that computes efforts", controller)
    q, t = per_joint("q", q, linkage), real_array("t", t, ())
    if is_traced(linkage, element, forces, q, t):
        raise ValueError("q: expected known values, outside of JAX's transformations.")
    A, B, C, F = (
        np.asarray(part, float) for part in closed_loop(linkage, element, forces, q, t)
    )
    kept = np.array(_kept(A, len(names), moving))
    A, B, C, F = A[np.ix_(kept, kept)], B[kept, index], C[index, kept], F[:, kept]
    # Rates and accelerations of the reference act as s and s^2 times its positions; of
    # s (s I - A)^-1 = I + A (s I - A)^-1 the first part reaches no position at once.
    acting = F[0, :, index] + A @ (F[1, :, index] + A @ F[2, :, index])
    position = (kept == index).astype(float)
    through = float(position @ A @ F[2, :, index])
    return OpenLoop(A + np.outer(B, C), B, C, acting, position, through, names[index])


def _kept(A: np.ndarray, n: int, moving: list[int]) -> list[int]:
    """Returns the states of the loops of a closed loop's matrix.

    Left out are those of fixed pairs, which stand still, and those of the controller
    that act on no joint, such as an integral of a fixed pair, or that never change, as
    an integral without a gain.
    """
    joints = [*moving, *(n + k for k in moving)]
    acting: list[int] = []
    own = list(range(2 * n, len(A)))
    while found := [k for k in own if A[np.ix_(joints + acting, [k])].any()]:
        acting += found
        own = [k for k in own if k not in found]
    while still := [k for k in acting if not A[k, joints + acting].any()]:
        acting = [k for k in acting if k not in still]
    return joints + sorted(acting)
