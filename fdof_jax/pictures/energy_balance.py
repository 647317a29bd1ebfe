"""The energy balance of a motion: what there is, and what elements put in and take."""

import jax
import numpy as np

from ..dynamics import energy
from ..forces.added_inertia import present
from ..forces.element import Forces, InertialElement, elements
from ..forces.holders import Holder
from ..linkage.linkage import Linkage
from ..simulation.efforts import acting_in, joint_efforts
from ..simulation.solution import Solution
from .axes import reached


def energy_balance(
    linkage: Linkage, forces: Forces, solution: Solution
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Returns times, energies by name, and what was there and put in, their sum [J].

    Work is the trapezoidal integral of the power tau * qd from sample to sample, taken
    over q as the integral of tau. It does not resolve what efforts do in between:
    contacts, blows beside dampers, jumps, and commands that begin to act with a delay.
    """
    ts, q, qd = reached(linkage, solution)
    forces = acting_in(solution, elements("forces", forces))
    energies = lambda t, q, qd: energy(linkage, q, qd, present(forces, t))
    kinetic, potential = map(np.asarray, jax.vmap(energies)(ts, q, qd))
    potential = potential - potential.min()

    efforts = np.asarray(joint_efforts(linkage, forces, solution).elements)
    changes, changed = [], np.zeros(len(ts) - 1, bool)  # from sample to sample [J]
    for k, (element, tau) in enumerate(zip(forces, efforts)):
        if isinstance(element, InertialElement):
            weights = jax.vmap(lambda t, of=element: of.at(t).weights(linkage))(ts)
            changed |= np.diff(weights, axis=0).any(axis=1)
        if isinstance(element, Holder) and element.counted:
            continue  # `solution.taken` has it, exactly
        tau = np.nan_to_num(tau[: len(ts)])  # a command that ends a motion is NaN
        held = solution.acting is not None and k == 0  # until the next sample
        effort = tau[:-1] if held else (tau[1:] + tau[:-1]) / 2
        work = np.sum(effort * np.diff(q, axis=0), axis=1)
        # Efforts of an inertial element are without those of its potential energy.
        if element.potential_energy and not isinstance(element, InertialElement):
            stored = lambda q, of=element.potential_energy: of(q, linkage)
            work = work + np.diff(jax.vmap(stored)(q))
        changes.append(work)
    if solution.taken is not None:
        changes.append(-np.diff(solution.taken[: len(ts)]))
    # Where masses come or go, what else would be missing is their energy.
    missing = np.diff(kinetic + potential) - sum(changes)
    changes.append(np.where(changed, missing, 0))

    put_in, taken_out = (
        np.append(0, np.maximum(sign * np.stack(changes), 0).sum(axis=0).cumsum())
        for sign in (1, -1)
    )
    bands = {"kinetic": kinetic, "potential": potential}
    if forces:
        bands["taken out"] = taken_out
    return ts, bands, kinetic[0] + potential[0] + put_in
