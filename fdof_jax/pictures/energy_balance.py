"""The energy balance of a motion."""

import jax
import numpy as np

from .. import Linkage, Solution, energy, joint_efforts
from ..forces import (
    Brake,
    HardStops,
    InertialElement,
    JointFriction,
    elements_on,
    present,
)
from .axes import reached


def energy_balance(
    linkage: Linkage, forces: tuple, solution: Solution
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Returns times, energies by name, and what was there and put in, their sum [J].

    Work is the integral of tau over q, by the trapezoidal rule.
    """
    ts, q, qd = reached(linkage, solution)
    efforts = np.asarray(joint_efforts(linkage, forces, solution).elements)
    controls = int(solution.acting is not None)  # which hold until the next sample
    acting = elements_on(linkage, forces[controls:])
    energies = lambda t, q, qd: energy(linkage, q, qd, present(acting, t))
    kinetic, potential = map(np.asarray, jax.vmap(energies)(ts, q, qd))
    potential = potential - potential.min()

    # The command that ended a motion may be NaN.
    efforts = np.nan_to_num(efforts[:, : len(ts)])
    between = (efforts[:, 1:] + efforts[:, :-1]) / 2
    between[:controls] = efforts[:controls, :-1]
    works = np.sum(between * np.diff(q, axis=0), axis=2)
    changes = [*works[:controls]]  # from sample to sample [J]
    changed = np.zeros(len(ts) - 1, bool)
    for element, work in zip(acting, works[controls:]):
        if isinstance(element, InertialElement):
            weights = jax.vmap(lambda t, of=element: of.at(t).weights(linkage))(ts)
            changed |= np.diff(weights, axis=0).any(axis=1)
        if isinstance(element, JointFriction | HardStops | Brake) and element.counted:
            continue  # `solution.taken` has it, exactly
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
