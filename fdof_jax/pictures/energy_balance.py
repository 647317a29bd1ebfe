"""The energy balance of a motion: what there is, and what elements put in and take."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..base.user_warnings import warn
from ..dynamics import energy
from ..forces.added_inertia import present
from ..forces.element import Forces, InertialElement, elements
from ..forces.holders import Holder
from ..forces.payload import Payload
from ..linkage.linkage import Linkage
from ..simulation.efforts import acting_in, joint_efforts
from ..simulation.solution import Solution
from .axes import reached


class Balance(NamedTuple):
    """Energies over time (time,) [J].

    - `bands`: those there are, by name, and those taken out; together they are `line`.
    - `line`: the energy at the start, and what was put in since.
    """

    ts: np.ndarray
    bands: dict[str, np.ndarray]
    line: np.ndarray


def energy_balance(linkage: Linkage, forces: Forces, solution: Solution) -> Balance:
    """Returns the energy balance of a motion; warns if it does not close."""
    ts, q, qd = reached(linkage, solution)
    forces = acting_in(solution, elements("forces", forces))
    put_in, taken_out = _works(linkage, forces, solution, ts)
    exchanged, lost = put_in + taken_out, np.zeros(len(ts))
    if solution.taken is not None:
        taken = np.asarray(solution.taken)[: len(ts)]
        lost = taken - taken[0]
    taken_out = taken_out + lost

    def energies(t, q, qd):
        return energy(linkage, q, qd, present(forces, t))

    clock = ts + _rounding(ts)
    kinetic, potential = map(np.asarray, jax.vmap(energies)(clock, q, qd))
    potential = potential - potential.min()
    balance = kinetic + potential + taken_out - put_in
    brought = _brought(forces, clock, balance)
    put_in = put_in + np.maximum(brought, 0).cumsum()
    taken_out = taken_out + np.maximum(-brought, 0).cumsum()
    bands = {"kinetic": kinetic, "potential": potential}
    if forces:
        bands["taken out"] = taken_out
    line = kinetic[0] + potential[0] + put_in
    gaps = line - sum(bands.values())
    gap, accepted = np.abs(gaps).max(), 0.01 * line.max()
    if gap > accepted:
        grows = np.abs(np.diff(gaps))
        worst = grows.argmax()
        # At a kink of the power, Simpson's rule is of the second order.
        factor = max(2, int(np.ceil(np.sqrt(gap / accepted))))
        closer = f", and samples closer in time (try {factor} times as many)"
        # Integrals are not off by more than what elements exchange at a blow or catch.
        at_event = np.diff(lost)[worst] > accepted
        if at_event and grows[worst] > np.diff(exchanged)[worst]:
            closer = ""
        warn(
            f"energy_stack: the balance is off by {gap:.3g} J of {line.max():.3g} J, "
            f"and the error grows most at t = {ts[worst]:.4g} s: expected the forces "
            f"of the solution{closer}."
        )
    return Balance(ts, bands, line)


def _powers(linkage: Linkage, forces: Forces, solution: Solution) -> np.ndarray:
    """Power of each element on the arm (element, time) [W].

    Exchange with an element's own potential energy (of a spring) does not count, nor
    does what holders take, which the solution has exactly.
    """
    efforts = joint_efforts(linkage, forces, solution).elements
    powers = jnp.einsum("etj,tj->et", efforts, solution.qd)
    for k, element in enumerate(forces):
        if isinstance(element, Holder) and element.holds:
            powers = powers.at[k].set(0)
        # The efforts of an inertial element exclude those of its potential energy.
        if isinstance(element, InertialElement) or element.potential_energy is None:
            continue
        stored = lambda q, of=element.potential_energy: of(q, linkage)
        _, rates = jax.jvp(jax.vmap(stored), (solution.q,), (solution.qd,))
        powers = powers.at[k].add(rates)
    return np.asarray(powers)


def _works(
    linkage: Linkage, forces: Forces, solution: Solution, ts: np.ndarray
) -> list[np.ndarray]:
    """Energies put in and taken out by the elements up to each of `ts` (time,) [J]."""
    powers = _powers(linkage, forces, solution)[:, : len(ts)]
    signs = (1, -1)
    if solution.acting is None:
        # Where rates or accelerations, and with them powers, may jump [s].
        payloads = (e for e in forces if isinstance(e, Payload))
        times = [e.jump_ts for e in payloads if e.jump_ts is not None]
        if solution.events is not None:
            times.append(solution.events.t)
        jumps = np.concatenate([*times, []])
        return [_integral(np.maximum(sign * powers, 0), ts, jumps) for sign in signs]
    # The power of held efforts jumps, but their work is known: in each period that of
    # what acts at its sample, until the next command begins to act, and that of this.
    q, acting = (np.asarray(rows)[: len(ts)] for rows in (solution.q, forces[0].tau))
    acting = np.nan_to_num(acting)  # a command that ends the motion does no work
    begin = q[1:] if solution.q_begin is None else np.asarray(solution.q_begin)
    begin = begin[: len(ts) - 1]
    works = acting[:-1] * (begin - q[:-1]), acting[1:] * (q[1:] - begin)
    works = np.sum(works, axis=-1)
    return [
        _integral(np.maximum(sign * powers[1:], 0), ts)
        + np.append(0, np.maximum(sign * works, 0).sum(axis=0).cumsum())
        for sign in signs
    ]


def _rounding(ts: np.ndarray) -> float:
    """Time before a jump in which states may already be those after it [s]."""
    return 8 * np.spacing(np.abs(ts).max())


def _integral(powers: np.ndarray, ts: np.ndarray, jumps: ArrayLike = ()) -> np.ndarray:
    """Integrals up to each time (time,): Simpson's rule from jump to jump."""
    power, jumps = powers.sum(axis=0), np.sort(jumps) - _rounding(ts)
    jumps = jumps[(ts[0] < jumps) & (jumps <= ts[-1])]
    after = np.searchsorted(ts, jumps)  # the first samples after them
    steps = np.zeros(len(ts) - 1)
    for piece in np.split(np.arange(len(ts)), np.unique(after)):
        whole = scipy.integrate.cumulative_simpson(power[piece], x=ts[piece], initial=0)
        steps[piece[:-1]] = np.diff(whole)
    for t, k in zip(jumps, after):
        steps[k - 1] = power[k - 1] * (t - ts[k - 1]) + power[k] * (ts[k] - t)
    return np.append(0, steps.cumsum())


def _brought(forces: Forces, ts: np.ndarray, balance: np.ndarray) -> np.ndarray:
    """Energies that payloads bring, or take away, since the sample before (time,) [J].

    They are what the balance jumps by where a payload is taken or let go.
    """
    changed = np.zeros(len(ts) - 1, bool)
    for element in forces:
        if isinstance(element, Payload):
            there = np.broadcast_to(element.there(ts), ts.shape)
            changed |= np.diff(there)
    return np.append(0, np.where(changed, np.diff(balance), 0))
