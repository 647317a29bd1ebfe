"""Loops of a controller about a configuration: frequency response and margins."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigvals
from scipy.optimize import minimize_scalar

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

# A frequency counts as a crossing if the response there is on the curve to this part.
_ON_CURVE = 1e-6
# Gain margins beyond this are zeros at infinity or poles at rest, rounded.
_LARGEST_MARGIN = 1e6
BANDWIDTH = 10 ** (-3 / 20)  # -3 dB


class OpenLoop(eqx.Module):
    """The loop of a controller, broken at one joint's effort; prints its margins.

    The loop's transfer function is L(s) = C (s I - A)^-1 B. Where the loop is closed
    again, the eigenvalues are those of A - B C.

    - `A`, `B`, `C`: matrices (state, state), (state,) and (state,). The state holds
      positions [m or rad], velocities and the controller's own state.
    - `joint`: the joint's name, for instance R1.
    - `stable`: whether all modes of the closed loop decay, none at less than
      `slowest_decay` [1/s].
    - `crossover`: frequency of the phase margin, at which |L| = 1 [rad/s].
    - `phase_margin`, `delay_margin`: least change of the phase [rad], and least delay
      [s], that make the closed loop unstable.
    - `gain_margin`: factor on the loop, the nearest to 1, that makes it unstable.
    - `modulus_margin`: least distance |1 + L| at all frequencies.
    - `bandwidth`: frequency above which the joint follows its reference by 3 dB less
      than at rest [rad/s].

    The four margins are NaN unless `stable`. Where L is zero, no change makes the
    closed loop unstable: the margins are infinite, that of the modulus 1.
    """

    A: Float[np.ndarray, "state state"]
    B: Float[np.ndarray, " state"]
    C: Float[np.ndarray, " state"]
    joint: str

    def __call__(self, frequency: ArrayLike) -> Complex[np.ndarray, "..."]:
        """The frequency response L(i frequency), at frequencies [rad/s]."""
        return _response(self.A, self.B, self.C, frequency)

    @property
    def _closed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.A - np.outer(self.B, self.C), self.B, self.C

    @property
    def slowest_decay(self) -> float:
        """Rate at which the closed loop's slowest mode decays [1/s]."""
        return -float(np.real(np.linalg.eigvals(self._closed[0])).max())

    @property
    def stable(self) -> bool:
        """True if all modes of the closed loop decay; otherwise it has no margins."""
        return self.slowest_decay > 0

    @property
    def _crossing(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies at which |L| = 1, and the phase margins there."""
        found = _frequencies_of(self.A, self.B, self.C, 1.0)
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
        # L(s) - L(-s) is zero where L is real.
        states = 2 * len(self.A)
        pencil = np.zeros((states + 1, states + 1))
        pencil[:-1, :-1] = block_diag(self.A, -self.A)
        pencil[:-1, -1] = np.tile(_balanced(self.B, self.C)[0], 2)
        pencil[-1, :-1] = np.tile(_balanced(self.B, self.C)[1], 2)
        zeros = eigvals(pencil, np.diag([1.0] * states + [0.0]))
        found = np.abs(np.imag(zeros[np.isfinite(zeros)]))
        # An undamped arm's response is real at all frequencies.
        values = self(np.concatenate([found[found > 0], self._crossing[0]]))
        at_rest = np.real(_response(*self._closed, 0.0))
        if _ON_CURVE < abs(1 - at_rest) < np.inf:  # otherwise L(0) is infinite
            values = np.append(values, at_rest / (1 - at_rest))
        real = np.abs(np.imag(values)) <= _ON_CURVE * np.abs(values)
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
        A, B, C = self._closed
        distance = lambda w: 1 / np.abs(1 - _response(A, B, C, w))
        rates = np.abs(np.linalg.eigvals(A))
        grid = np.geomspace(rates.min() / 100 + 1e-9, rates.max() * 100, 2000)
        least = int(distance(grid).argmin())
        ends = grid[max(least - 1, 0)], grid[min(least + 1, len(grid) - 1)]
        refined = minimize_scalar(distance, bounds=ends, method="bounded").fun
        return float(min(refined, 1.0))

    @property
    def bandwidth(self) -> float:
        """Frequency above which the joint follows by 3 dB less than at rest [rad/s].

        The response to the reference is L / (1 + L); NaN if the joint does not follow
        at rest.
        """
        closed = self._closed
        level = BANDWIDTH * float(np.abs(_response(*closed, 0.0)))
        return float(min(_frequencies_of(*closed, level), default=np.nan))

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
        ]

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
    A, B, C = map(np.asarray, closed_loop(linkage, element, forces, q, t))
    # Without the states of fixed pairs, which stand still, and those of the controller
    # that never change, as an integral without a gain, or act on nothing.
    n = len(names)
    own = [k for k in range(2 * n, len(A)) if A[k].any() and A[:, k].any()]
    kept = np.array([*moving, *(n + k for k in moving), *own])
    b, c = B[kept, index], C[index, kept]
    return OpenLoop(A[np.ix_(kept, kept)] + np.outer(b, c), b, c, names[index])


def _response(A: Any, B: Any, C: Any, frequency: ArrayLike) -> np.ndarray:
    """Computes C (i frequency - A)^-1 B; infinite at undamped modes."""
    unit = np.eye(len(A))
    at = np.asarray(frequency, float)[..., None, None] * 1j * unit - A
    undamped = np.linalg.det(at) == 0
    at = np.where(undamped[..., None, None], unit, at)
    values = (np.linalg.solve(at, B[:, None]) * C[:, None]).sum(axis=(-2, -1))
    return np.where(undamped, np.inf, values)


def _balanced(B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moves a factor between B and C that makes them equally large."""
    factor = np.sqrt(np.linalg.norm(C) / np.linalg.norm(B)) if C.any() else 1.0
    return B * factor, C / (factor or 1.0)


def _frequencies_of(A: Any, B: Any, C: Any, level: float) -> np.ndarray:
    """Finds the frequencies at which |C (i w - A)^-1 B| is a level, above 0.

    They are the imaginary eigenvalues of a Hamiltonian matrix (Boyd, Balakrishnan and
    Kabamba, 1989).
    """
    if not 0 < level < np.inf or not C.any():
        return np.zeros(0)
    b, c = (part / np.sqrt(level) for part in _balanced(B, C))
    matrix = np.block([[A, np.outer(b, b)], [-np.outer(c, c), -A.T]])
    found = np.imag(np.linalg.eigvals(matrix))
    found = np.unique(found[found > 0])
    error = np.abs(np.abs(_response(A, B, C, found)) / level - 1)
    return found[error <= _ON_CURVE]
