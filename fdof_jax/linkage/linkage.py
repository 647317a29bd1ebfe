"""The linkage: its joints and its links."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import (
    instance,
    is_traced,
    known,
    radians,
    real_array,
    real_numbers,
    shown,
)
from ..base.frozen import Frozen
from ..base.functions import sharing_functions
from ..base.known_values import known_array
from .singularity import Numbers, check_singularity
from .topology import check_angles, fixed_pairs, letters, pairs_of, real_joints


class Linkage(Frozen):
    """A planar chain of n moving links, 1 to 8, as in Fig 1 of the paper.

    Pair k has a prismatic joint, then a revolute one. At most one of them is real; a
    fictitious joint stands still. Link 1 is the ground; each other link starts at its
    revolute joint. The vector A_k runs along link k; the slide B_k of the next
    prismatic joint is perpendicular to it, 90 degrees counter-clockwise.

    Every field is an array, so linkages of different topologies share one compilation
    and can be stacked into a batch. `replace(mass=...)` returns a checked copy.

    **Arguments:**

    - `topology`: a letter per pair: R (revolute), P (prismatic) or F (fixed), such as
      "RPR"; or two existence factors per pair. Stored as `ef` (2n,); the attribute
      `topology` has the letters, `fixed` a bool per pair.
    - `length`: A1, A2, ... of the ground and the moving links (n + 1,) [m].
    - `com`: mass centres, along and across each moving link (n, 2) [m].
    - `mass`: of the moving links (n,) [kg].
    - `inertia`: about the mass centres (n,) [kg m^2].
    - `locked`: where fictitious joints stand (n,): B_k [m] beside a revolute joint,
      th_{k+1} - th_k [rad] elsewhere.
    - `base_angle`: th1, the angle of A1 [rad].
    - `gravity`: acceleration along -y [m/s^2].

    **Raises:** ValueError for malformed arguments, and if a joint moves no inertia in
    any configuration. Warns if the mass matrix may be singular in some, and of
    redundant joints (the paper's rules (i) and (ii)).

    >>> import fdof_jax as fj
    >>> pendulum = fj.Linkage("RRR", length=[0, 1, 1, 1], com=[[1, 0]] * 3,
    ...                       mass=[1, 1, 1], inertia=[0, 0, 0])
    >>> pendulum.mass.shape
    (3,)
    """

    ef: Float[Array, " factor"]
    length: Float[Array, " length"]
    com: Float[Array, "link 2"]
    mass: Float[Array, " link"]
    inertia: Float[Array, " link"]
    locked: Float[Array, " joint"]
    base_angle: Float[Array, ""]
    gravity: Float[Array, ""]

    def __init__(
        self,
        topology: str | ArrayLike,
        *,
        length: ArrayLike,
        com: ArrayLike,
        mass: ArrayLike,
        inertia: ArrayLike,
        locked: ArrayLike = 0.0,
        base_angle: ArrayLike = 0.0,
        gravity: ArrayLike = 9.81,
    ):
        pairs = pairs_of(topology)
        if pairs is None:
            self.ef = jnp.asarray(topology, dtype=float)
        else:
            self.ef = known_array(pairs.ravel())  # programs leave out other joints
        n = self.ef.size // 2
        links, pairs = f"{n} moving links", f"{n} pairs of joints"
        ground = f"the ground and {links}"
        self.length = real_array("length", length, (n + 1,), of=ground)
        self.com = real_array("com", com, (n, 2), of=links)
        self.mass = real_array("mass", mass, (n,), minimum=0, of=links)
        self.inertia = real_array("inertia", inertia, (n,), minimum=0, of=links)
        self.locked = real_array("locked", locked, (n,), broadcast=True, of=pairs)
        self.base_angle = real_array("base_angle", base_angle, (), unit="rad")
        self.gravity = real_array("gravity", gravity, ())
        values = [vars(self)[name] for name in Numbers._fields]
        if not is_traced(values):
            numbers = Numbers(*map(np.asarray, values))
            radians("locked", np.where(real_joints(numbers.ef), 0, numbers.locked))
            check_singularity(numbers)

    def arguments(self) -> dict[str, Any]:
        fields = dict(vars(self))
        return {"topology": fields.pop("ef")} | fields

    @property
    def topology(self) -> str:
        """The letters of a single linkage with a known topology, such as RPR."""
        return letters(self.ef)

    @property
    def fixed(self) -> Array:
        """Whether each pair is fixed (n,), also of a traced linkage."""
        return jnp.stack(fixed_pairs(self.ef))

    def __repr__(self) -> str:
        if np.ndim(self.ef) != 1 or not known(self):
            return super().__repr__()
        _, *fields = vars(self).items()
        others = (f"{name}={short(value)}" for name, value in fields)
        return f"Linkage({self.topology!r}, {', '.join(others)})"


def short(value: Array | np.ndarray) -> str:
    """Formats the numbers on one line."""
    number: Any = {"float_kind": lambda value: f"{value:.6g}"}
    text = np.array2string(
        np.asarray(value), separator=", ", threshold=12, formatter=number
    )
    return " ".join(text.split())


def joint_names(linkage: Linkage) -> list[str]:
    """Returns the names of the joints in order, such as R1, P2, F3.

    **Raises:** ValueError if `linkage` is not a linkage.
    """
    instance("linkage", linkage, Linkage)
    return [f"{kind}{k + 1}" for k, kind in enumerate(linkage.topology)]


def moving_joints(linkage: Linkage) -> list[int]:
    """Returns the indices, from 0, of the joints that are not fixed.

    **Raises:** ValueError if `linkage` is not a linkage.
    """
    instance("linkage", linkage, Linkage)
    return [k for k, kind in enumerate(linkage.topology) if kind != "F"]


def joints_of(linkage: Linkage) -> int:
    """Returns the number of joints, fixed pairs included.

    **Raises:** ValueError if `linkage` is not a linkage.
    """
    instance("linkage", linkage, Linkage)
    return jnp.size(linkage.ef) // 2


def per_joint(name: str, values: ArrayLike, linkage: Linkage) -> Array | np.ndarray:
    """Returns one value per joint as an array (n,), of NumPy or JAX.

    **Arguments:** `name`: the argument's name, for messages; `values`: such as joint
    positions [m or rad].

    **Raises:** ValueError for all but n finite real numbers. Warns of known values
    named "q" that look like degrees.
    """
    instance("linkage", linkage, Linkage)
    n = joints_of(linkage)
    if isinstance(values, jax.Array | np.ndarray) and values.ndim > 1:
        raise ValueError(
            f"{name}: expected numbers for {n} joints at one instant (use jax.vmap for "
            f"many), got shape {np.shape(values)}."
        )
    # Programs take NumPy's array in a fortieth of the time in which JAX makes its own.
    array = real_numbers(name, values, (n,), of=f"{n} joints")
    if name.rpartition(".")[2] == "q":  # positions, also those of a state
        check_angles(name, array, linkage.ef)
    return array


def without_fixed(linkage: Linkage, values: ArrayLike) -> Array:
    """Returns values (..., n) of the joints with 0 at fixed pairs.

    >>> import fdof_jax as fj
    >>> links = dict(length=[0, 1, 1], com=[[0, 0]] * 2, mass=[1, 1], inertia=[0, 0])
    >>> arm = fj.Linkage("RF", **links)
    >>> fj.linkage.joints_of(arm), fj.linkage.without_fixed(arm, [1.0, 2.0]).tolist()
    (2, [1.0, 0.0])
    """
    return jnp.where(linkage.fixed, 0, jnp.asarray(values))


_T = TypeVar("_T")


def compiled(
    *joint_values: str, **doors: tuple[int, ...] | Callable[[Linkage, Any], object]
) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Decorates a function of a linkage and arrays: checks arguments, then compiles.

    `joint_values` names arguments with a value per joint. Each keyword names another
    argument, and gives the shape of its array or a function of linkage and argument
    that checks and converts it.
    """

    def decorate(function: Callable[..., _T]) -> Callable[..., _T]:
        signature = inspect.signature(function)

        @eqx.filter_jit  # force elements may hold functions
        @functools.wraps(function)
        def inner(*args: Any, **kwargs: Any) -> _T:
            arguments = signature.bind(*args, **kwargs).arguments
            for name in joint_values:
                moving = without_fixed(arguments["linkage"], arguments[name])
                arguments[name] = moving
            return function(**arguments)

        @functools.wraps(function)
        def checked(*args: Any, **kwargs: Any) -> _T:
            arguments = signature.bind(*args, **kwargs).arguments
            linkage = arguments["linkage"]
            check_linkage(linkage)
            for name in joint_values:
                arguments[name] = per_joint(name, arguments[name], linkage)
            for name, door in doors.items():
                if callable(door):
                    if name in arguments:
                        arguments[name] = door(linkage, arguments[name])
                else:
                    arguments[name] = real_numbers(name, arguments[name], door)
            run = lambda *values: inner(**dict(zip(arguments, values)))
            return sharing_functions(run, **arguments)

        return checked

    return decorate


def check_linkage(linkage: object) -> None:
    """Raises ValueError unless the argument is one valid linkage, not a batch."""
    if not isinstance(linkage, Linkage):
        raise ValueError(f"linkage: expected a Linkage, got {shown(linkage)}.")
    if jnp.ndim(linkage.ef) != 1:
        raise ValueError(
            "linkage: expected one linkage (use jax.vmap for a batch), got existence "
            f"factors of shape {jnp.shape(linkage.ef)}."
        )
    n = joints_of(linkage)
    # `equinox.tree_at` bypasses the constructor.
    shapes = (2 * n,), (n + 1,), (n, 2), (n,), (n,), (n,), (), ()
    for (name, value), shape in zip(vars(linkage).items(), shapes, strict=True):
        if np.shape(value) != shape:
            raise ValueError(
                f"linkage.{name}: expected an array of shape {shape} for {n} pairs of "
                f"joints, got shape {np.shape(value)}."
            )
    if is_traced(linkage):
        return
    values = jax.tree.map(np.asarray, linkage)
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(values))
    if not (finite and possible(values)):
        try:
            linkage.replace()
        except ValueError as error:
            raise ValueError(f"linkage.{error}") from None


def possible(linkage: Linkage) -> Array:
    """Returns whether the constructor would accept the values, known or traced.

    It does not look for singular mass matrices.
    """
    pairs = linkage.ef.reshape(-1, 2)
    factors = ((pairs == 0) | (pairs == 1)).all() & (pairs.sum(axis=1) <= 1).all()
    weights = (linkage.mass >= 0).all() & (linkage.inertia >= 0).all()
    return factors & pairs.any() & weights
