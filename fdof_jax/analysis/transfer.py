"""Transfer functions of one input and one output: crossings and peaks, exactly."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

# A peak is known to this part.
_EXACT = 1e-8


class Transfer(NamedTuple):
    """The transfer function C (s I - A)^-1 B + D, in NumPy.

    `A` (state, state), `B`, `C` (state,), `D` a number.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: float = 0.0

    def __call__(self, frequency: ArrayLike) -> np.ndarray:
        """Computes the response at frequencies [rad/s]; infinite at undamped modes."""
        unit = np.eye(len(self.A))
        at = np.asarray(frequency, float)[..., None, None] * 1j * unit - self.A
        undamped = np.linalg.det(at) == 0
        at = np.where(undamped[..., None, None], unit, at)
        through = (np.linalg.solve(at, self.B[:, None]) * self.C[:, None]).sum((-2, -1))
        return np.where(undamped, np.inf, through + self.D)

    @property
    def balanced(self) -> tuple[np.ndarray, np.ndarray]:
        """`B` and `C`, made equally large by a factor moved between them."""
        if not (self.B.any() and self.C.any()):
            return self.B, self.C
        factor = np.sqrt(np.linalg.norm(self.C) / np.linalg.norm(self.B))
        return self.B * factor, self.C / factor

    def crossings(self, level: float) -> np.ndarray:
        """Finds the frequencies above 0 at which the magnitude passes a level.

        They are the imaginary eigenvalues of a Hamiltonian matrix (Boyd, Balakrishnan
        and Kabamba, 1989), or with rounding eigenvalues beside the imaginary axis.
        """
        room = level**2 - self.D**2
        if not 0 < level < np.inf or not room or not (self.B.any() and self.C.any()):
            return np.zeros(0)
        b, c = self.balanced
        own = self.A + self.D / room * np.outer(b, c)
        across = np.outer(b, b) / room, -(level**2) / room * np.outer(c, c)
        found = np.imag(
            scipy.linalg.eigvals(np.block([[own, across[0]], [across[1], -own.T]]))
        )
        limited = lambda w: min(float(np.abs(self(w))) / level - 1, 1.0)  # if infinite
        return _changes_of_sign(limited, found[found > 0])

    def real_at(self) -> np.ndarray:
        """Finds the frequencies above 0 at which the response is real."""
        # H(s) - H(-s) is zero there.
        states = 2 * len(self.A)
        pencil = np.zeros((states + 1, states + 1))
        pencil[:-1, :-1] = scipy.linalg.block_diag(self.A, -self.A)
        pencil[:-1, -1], pencil[-1, :-1] = (np.tile(part, 2) for part in self.balanced)
        zeros = scipy.linalg.eigvals(pencil, np.diag([1.0] * states + [0.0]))
        found = np.abs(np.imag(zeros[np.isfinite(zeros)]))
        angle = lambda w: float(np.sin(np.angle(self(w))))
        return _changes_of_sign(angle, found[found > 0])

    def peak(self) -> float:
        """Finds the largest magnitude of a stable function at all frequencies.

        Each pass looks between the frequencies at which the magnitude passes the
        largest value so far (Bruinsma and Steinbuch, 1990).
        """
        poles = scipy.linalg.eigvals(self.A)
        tried = np.concatenate([[0.0], np.abs(poles), np.abs(np.imag(poles))])
        most, beyond = 0.0, np.append(np.abs(self(tried)), abs(self.D)).max()
        while beyond > most * (1 + _EXACT):
            most = float(beyond)
            found = np.append(0.0, self.crossings(most * (1 + _EXACT)))
            beyond = np.abs(self((found[1:] + found[:-1]) / 2)).max(initial=0.0)
        return most


def _changes_of_sign(of: Callable[[float], float], found: np.ndarray) -> np.ndarray:
    """Returns the frequencies at which `of` changes its sign, roughly `found`.

    Rounding moves eigenvalues, so that they only divide the frequencies into parts.
    """
    found = np.unique(found)
    if not found.size:
        return found
    between = np.sqrt(found[:-1] * found[1:])
    parts = np.log(np.concatenate([[found[0] / 2], between, [2 * found[-1]]]))
    at = lambda log: of(np.exp(log))
    signs = np.array([at(log) > 0 for log in parts])
    passed = np.flatnonzero(signs[1:] != signs[:-1])
    return np.exp(
        np.array([scipy.optimize.brentq(at, *parts[[k, k + 1]]) for k in passed])
    )
