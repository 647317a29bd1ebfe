"""Configurations at rest, and the efforts that hold an arm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..dynamics import bias_force
from ..forces.element import Element, Forces
from ..linkage.linkage import Linkage, per_joint, without_fixed
from ..linkage.topology import fixed_pairs
from .linearization import checked, total_effort


def equilibrium(
    linkage: Linkage, q: ArrayLike, forces: Forces = (), t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """Joint positions near `q` at which the arm stays at rest under its forces.

    An equilibrium is an operating point for `linearize`. Under a PD controller it is
    the position held while the reference stands still, including the sag.

    **Arguments:** `linkage`; `q`: first guess [m or rad]; `forces`: elements without a
    state of their own; `t`: time at which they are evaluated [s].

    **Returns:** positions (n,); NaN if the Levenberg-Marquardt method finds none, for
    instance from a guess at which actuators are at their limits. The equilibrium need
    not be stable: see `linearize`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.analysis.equilibrium(arm, [-1.0, 0.1, 0.1]).tolist()  # it hangs
    [-1.571, 0.0, 0.0]
    """
    forces = checked(linkage, forces)
    return _rest(linkage, forces, per_joint("q", q, linkage), real_array("t", t, ()))


@eqx.filter_jit
def _rest(linkage: Linkage, forces: tuple[Element, ...], q: Array, t: Array) -> Array:
    q = without_fixed(linkage, q)

    def efforts(q):
        lacking = _lacking(linkage, forces, q, t)
        # A fixed pair is in equilibrium at 0.
        return jnp.where(jnp.stack(fixed_pairs(linkage.ef)), -q, -lacking)

    # Efforts relative to their rounding errors' scale: stiff controllers converge as
    # exactly as soft springs.
    slopes = jnp.abs(jax.jacfwd(efforts)(q))
    size = jax.lax.stop_gradient(slopes @ (1 + jnp.abs(q)) + jnp.abs(efforts(q)) + 1)
    tight = 1e3 * float(jnp.finfo(q.dtype).eps)
    method = optimistix.LevenbergMarquardt(rtol=tight, atol=tight)

    def search(function, q):
        relative = lambda q, _: function(q)
        found = optimistix.root_find(relative, method, q, throw=False)
        good = found.result == optimistix.RESULTS.successful
        return jnp.where(good, found.value, jnp.nan)

    # optimistix alone would differentiate the least squares that the method minimises,
    # which takes second derivatives of the efforts.
    return jax.lax.custom_root(
        lambda q: efforts(q) / size,
        q,
        search,
        lambda slope, change: jnp.linalg.solve(jax.jacfwd(slope)(change), change),
    )


@eqx.filter_jit
def _lacking(
    linkage: Linkage, forces: tuple[Element, ...], q: Array, t: Array
) -> Array:
    """Efforts that the arm needs beside the forces to stay at rest."""
    q, still = without_fixed(linkage, q), jnp.zeros_like(q)
    acting = total_effort(linkage, forces, t, q, still)
    return without_fixed(linkage, bias_force(linkage, q, still, forces) - acting)


def holding_efforts(
    linkage: Linkage, q: ArrayLike, forces: Forces = (), t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """The joint efforts that, together with the forces, hold the arm at rest.

    Without forces they balance gravity. Springs and stops carry their part, and masses
    of elements are held too.

    **Arguments:** `linkage`; `q`: joint positions [m or rad]; `forces`: elements
    without a state of their own; `t`: time at which they are evaluated [s].

    **Returns:** efforts (n,), 0 at fixed pairs [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.analysis.holding_efforts(arm, [0, 0, 0]).tolist()
    [58.86, 29.43, 9.81]
    >>> rope = fj.forces.Tension(fj.Point(0, 3, 1), fj.Point(3, 1), tension=9.81)
    >>> fj.analysis.holding_efforts(arm, [0, 0, 0], (rope,)).tolist()  # lifts the tip
    [29.43, 9.81, 0.0]
    """
    forces = checked(linkage, forces)
    q, t = per_joint("q", q, linkage), real_array("t", t, ())
    return _lacking(linkage, forces, q, t)
