"""Plots of energies over time."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..base.user_warnings import warn
from ..dynamics import energy, link_energies
from ..forces.element import Forces, InertialElement, elements
from ..linkage.linkage import Linkage
from ..simulation.efforts import joint_efforts
from ..simulation.sampled import Motion, SampledMotion, acting_in
from .arms import link_color
from .axes import (
    BLACK,
    LIGHT_GREY,
    SERIES,
    axes_or_new,
    figure_or_new,
    legend,
    reached,
    time_panels,
)


def energy_profile(
    linkage: Linkage, solution: Motion, fig: Figure | None = None
) -> Figure:
    """Plots kinetic and potential energy of each link and of all over time [J]."""
    ts, q, qd = reached(linkage, solution)
    energies = jax.vmap(lambda q, qd: link_energies(linkage, q, qd))(q, qd)
    kinetic, potential = (np.asarray(each) for each in energies)
    links = range(1, kinetic.shape[1] + 1)
    names, colors = [f"link {k}" for k in links], [link_color(k) for k in links]
    sums = kinetic.sum(axis=1), potential.sum(axis=1), (kinetic + potential).sum(axis=1)
    whole = zip(("kinetic", "potential", "total"), sums, (*SERIES[3:5], BLACK))
    panels = [
        ("kinetic energy [J]", list(zip(names, kinetic.T, colors))),
        ("potential energy [J]", list(zip(names, potential.T, colors))),
        ("of all links [J]", list(whole)),
    ]
    fig = figure_or_new(fig, 3.5, 6.0)
    top, _, bottom = time_panels(fig, ts, panels)
    legend(top)
    legend(bottom)
    return fig


def _powers(linkage: Linkage, forces: Forces, solution: Motion) -> np.ndarray:
    """Power of each element on the arm (element, time) [W].

    Exchange with an element's own potential energy (of a spring) does not count.
    """
    efforts = joint_efforts(linkage, forces, solution).elements
    powers = jnp.einsum("etj,tj->et", efforts, solution.qd)
    for k, element in enumerate(forces):
        # The efforts of an inertial element exclude those of its potential energy.
        if isinstance(element, InertialElement) or element.potential_energy is None:
            continue

        def stored(q: Array, qd: Array, element: Any = element) -> Array:
            energy = lambda q: element.potential_energy(q, linkage)
            return jax.jvp(energy, (q,), (qd,))[1]

        powers = powers.at[k].add(jax.vmap(stored)(solution.q, solution.qd))
    return np.asarray(powers)


def _works(
    linkage: Linkage, forces: Forces, solution: Motion, ts: np.ndarray
) -> list[np.ndarray]:
    """Energies put in and taken out by the elements up to each of `ts` (time,) [J]."""
    powers = _powers(linkage, forces, solution)[:, : len(ts)]
    signs = (1, -1)
    if not isinstance(solution, SampledMotion):
        return [_integral(np.maximum(sign * powers, 0), ts) for sign in signs]
    # The power of held efforts jumps, but their work is known: in each period that of
    # the last command, until the next one begins to act, and that of the next.
    q, tau = np.asarray(solution.q)[: len(ts)], np.asarray(solution.tau)[: len(ts) - 1]
    begin = q if solution.q_begin is None else np.asarray(solution.q_begin)
    begin = begin[: len(tau)]
    last = np.append(np.zeros_like(tau[:1]), tau[:-1], axis=0)
    works = np.sum([last * (begin - q[:-1]), tau * (q[1:] - begin)], axis=-1)
    return [
        _integral(np.maximum(sign * powers[1:], 0), ts)
        + np.append(0, np.maximum(sign * works, 0).sum(axis=0).cumsum())
        for sign in signs
    ]


def _integral(powers: np.ndarray, ts: np.ndarray) -> np.ndarray:
    return scipy.integrate.cumulative_simpson(powers.sum(axis=0), x=ts, initial=0)


def energy_stack(
    linkage: Linkage, forces: Forces, solution: Motion, ax: Axes | None = None
) -> Axes:
    """Plots the energy balance over time, stacked [J].

    The stack is kinetic energy, potential energy above its least (springs and masses of
    force elements included), and the energy taken out by the forces since the start.
    The dashed line is the energy at the start plus the energy put in by the forces; it
    is level if none is put in. The top of the stack lies on this line up to errors of
    the motion and of the integrals of power over its samples (Simpson's rule).

    A force element puts energy in while its power is positive, and takes it out while
    its power is negative. A motor may do both.

    **Arguments:** `forces`: those of the solution.

    **Raises:** ValueError for malformed arguments. Warns if top and line differ by more
    than a hundredth of the energy, with the time at which they part most: the samples
    are then too far apart there, or the forces are not those of the solution.
    """
    ts, q, qd = reached(linkage, solution)
    forces = acting_in(solution, elements("forces", forces))
    put_in, taken_out = _works(linkage, forces, solution, ts)
    energies = jax.vmap(lambda q, qd: energy(linkage, q, qd, forces))(q, qd)
    kinetic, potential = map(np.asarray, energies)
    potential = potential - potential.min()
    bands = {"kinetic": kinetic, "potential": potential}
    if forces:
        bands["taken out"] = taken_out
    line = kinetic[0] + potential[0] + put_in
    gaps = line - sum(bands.values())
    gap, accepted = np.abs(gaps).max(), 0.01 * line.max()
    if gap > accepted:
        worst = ts[np.abs(np.diff(gaps)).argmax()]
        # At a kink of the power, Simpson's rule is of the second order.
        factor = max(2, int(np.ceil(np.sqrt(gap / accepted))))
        warn(
            f"energy_stack: the balance is off by {gap:.3g} J of {line.max():.3g} J, "
            f"and the error grows most at t = {worst:.4g} s: expected the forces of "
            f"the solution, and samples closer in time (try {factor} times as many)."
        )
    ax = axes_or_new(ax, 2.6)
    colors = [*SERIES[3:5], LIGHT_GREY]
    ax.stackplot(ts, list(bands.values()), labels=list(bands), colors=colors)
    driven = put_in.max() > 1e-5 * line.max()  # more than rounding errors
    label = "start + put in" if driven else "at the start"
    ax.plot(ts, line, "--", color=BLACK, lw=1.2, label=label)
    ax.set(xlabel="time [s]", ylabel="energy [J]", xlim=(ts[0], ts[-1]))
    legend(ax)
    return ax
