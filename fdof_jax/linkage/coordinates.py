"""States of an arm in joint coordinates."""

from typing import NamedTuple

from numpy.typing import ArrayLike

from ..base.checks import shown
from .linkage import Linkage, per_joint


class State(NamedTuple):
    """Joint positions and velocities, which functions check on use.

    - `q` (n,): the slide B_k [m] of a prismatic joint or the relative angle th_{k+1} -
      th_k [rad] of a revolute joint, in joint order. Ignored at fixed pairs.
    - `qd` (n,): the rates of `q`.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> start = fj.State(q=[0.5, 0, 0], qd=[0, 0, 0])
    >>> fj.tip_position(arm, start.q).tolist()
    [2.633, 1.438]
    """

    q: ArrayLike
    qd: ArrayLike


def real_state(name: str, value: State, linkage: Linkage) -> State:
    """Returns `value` as a state of the linkage's joints, or raises ValueError.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.double_pendulum()
    >>> fj.checks.real_state("start", start, arm).q.tolist()
    [0.5, 0.5]
    """
    try:
        q, qd = value
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a deleted array
        raise ValueError(
            f"{name}: expected a State(q, qd), got {shown(value)}."
        ) from None
    parts = ("q", q), ("qd", qd)
    return State(*(per_joint(f"{name}.{part}", row, linkage) for part, row in parts))
