"""Motions that follow each other, joined to one."""

from collections.abc import Sequence
from functools import reduce
from itertools import pairwise
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import instance, known, refusal
from ..forces.element import OwnStates
from .solution import Events, Solution, Statistics

_MEETS = 1e-9  # a share of the time, within which two motions meet
_GAP = 1e-5  # positions may be rounded on their way [m or rad]
# How statistics of two phases are joined; numbers of steps and switches add up.
_STATISTICS = {"accuracy": jnp.maximum, "slowest_crossing": jnp.minimum}
_Outcome = tuple[Statistics, diffrax.RESULTS]  # statistics and result


def concatenate(motions: Sequence[Solution]) -> Solution:
    """Joins motions that follow each other, the phases of one, on one time axis.

    What acts may differ between them, and so may the numbers of the arm. Where two
    phases meet, the sample is that of the later one, after any blow at its start.

    **Arguments:** `motions`: one or more, of the same joints and batch; each begins at
    the time at which the one before ends.

    **Returns:** their `Solution`. Its numbers of steps and switches are sums, and what
    was `taken` adds up. `own` is () unless elements with the same kinds of states act
    in all phases. The result is that of the first phase that failed, if any; rows of
    those after it stay as they are.

    **Raises:** ValueError for malformed arguments, and unless known times and positions
    meet.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> loaded = (fj.forces.Payload(fj.Point(3, 0.5), 0.2),)
    >>> first = fj.simulate(arm, start, np.linspace(0, 1, 101), loaded)
    >>> there = fj.State(first.q[-1], first.qd[-1])
    >>> second = fj.simulate(arm, there, np.linspace(1, 2, 101))
    >>> fj.simulation.concatenate([first, second])
    Solution(motions: 1; times: 201, 0 to 2 s; outcome: successful; steps: 106)
    """
    if not isinstance(motions, list | tuple) or not motions:
        raise refusal("motions", "a list of one or more Solutions", motions)
    for index, motion in enumerate(motions):
        instance(f"motions[{index}]", motion, Solution)
    for index, (before, after) in enumerate(pairwise(motions)):
        _check_meeting(index, before, after)
    batch = np.ndim(motions[0].q) - 2
    events = [m.events for m in motions if m.events is not None]
    stats, result = reduce(_outcome, [(m.stats, m.result) for m in motions])
    modes = taken = None
    if events:
        modes = _rows([_or_zeros(m.modes, m.q) for m in motions], batch)
        taken = _totals([_or_zeros(m.taken, m.q[..., 0]) for m in motions])
    return Solution(
        ts=_rows([m.ts for m in motions], -1),
        q=_rows([m.q for m in motions], batch),
        qd=_rows([m.qd for m in motions], batch),
        stats=stats,
        result=result,
        own=_states([m.own for m in motions], batch),
        modes=modes,
        taken=taken,
        events=reduce(_events, events) if events else None,
    )


def _check_meeting(index: int, before: Solution, after: Solution) -> None:
    name = f"motions[{index + 1}]"
    *batch, _, joints = before.q.shape
    *others, _, more = after.q.shape
    if (batch, joints) != (others, more):
        expected = f"{joints} joints and the batch {tuple(batch)}, as before it"
        raise refusal(name, expected, f"{more} and {tuple(others)}")
    end, begin = before.ts[..., -1], after.ts[..., 0]
    if known(end, begin) and not np.allclose(end, begin, _MEETS, _MEETS):
        expected = f"one that begins where the one before ends, at {np.max(end):g} s"
        raise refusal(name, expected, f"one that begins at {np.max(begin):g} s")
    q, there = before.q[..., -1, :], after.q[..., 0, :]
    if known(q, there):
        gap = np.nanmax(np.abs(np.subtract(q, there)), initial=0)  # NaN after a failure
        if gap > _GAP * (1 + np.nanmax(np.abs(q), initial=0)):
            expected = "one that begins at the positions at which the one before ends"
            raise refusal(name, expected, f"a gap of {gap:.3g} m or rad")


def _rows(pieces: list[Array], axis: int) -> Array:
    """Joins pieces along the time axis, but for the last row of each but the last."""
    *first, last = map(jnp.asarray, pieces)
    first = [jax.lax.slice_in_dim(piece, 0, -1, axis=axis) for piece in first]
    return jnp.concatenate([*first, last], axis=axis)


def _or_zeros(rows: Array | None, like: Array) -> Array:
    return jnp.zeros_like(like) if rows is None else rows


def _totals(pieces: list[Array]) -> Array:
    totals, before = [], 0.0
    for piece in pieces:
        totals.append(piece + before)
        before = totals[-1][..., -1:]
    return _rows(totals, -1)


def _states(pieces: list[OwnStates], axis: int) -> OwnStates:
    if len({jax.tree.structure(piece) for piece in pieces}) > 1:
        return ()
    return jax.tree.map(lambda *rows: _rows([*rows], axis), *pieces)


def _outcome(first: _Outcome, second: _Outcome) -> _Outcome:
    """Returns statistics and result of two phases, from those of each."""
    (stats, result), (more, following) = first, second
    ok = result == diffrax.RESULTS.successful

    def joined(name: str) -> Any:
        if not (name in stats and name in more):
            return stats.get(name, more.get(name))
        if name == "time_reached":
            return jnp.where(ok, more[name], stats[name])
        return _STATISTICS.get(name, jnp.add)(stats[name], more[name])

    both = {name: joined(name) for name in stats | more}
    # RESULTS.where takes no batch.
    first_failure = lambda a, b: jnp.where(ok, b, a)
    return both, jax.tree.map(first_failure, result, following)


def _events(first: Events, second: Events) -> Events:
    join = lambda *rows: jnp.concatenate(rows, axis=-1)
    t = join(first.t, second.t)
    order = jnp.argsort(t, axis=-1)  # NaN comes last
    ordered = lambda row: jnp.take_along_axis(row, order, axis=-1)
    joint, kind = join(first.joint, second.joint), join(first.kind, second.kind)
    count = first.count + second.count
    return Events(ordered(t), ordered(joint), ordered(kind), count)
