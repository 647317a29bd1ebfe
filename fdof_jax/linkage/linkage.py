"""The linkage: its joints and its links.

Pair k of the chain P-R-P-R-P-R joins link k to link k + 1. Its prismatic joint slides
by B_k across link k; its revolute joint is at the start of link k + 1. Link 1 is the
ground. One joint of each pair is real; the other is fictitious and held at its initial
value.
"""

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

from ..checks import is_traced, known, real_array
from .singularity import check_singularity
from .topology import pairs_of, real_joints


class Linkage(eqx.Module):
    """A planar chain of three moving links, as in Fig 1 of the paper.

    Link n starts at its characteristic point. Its vector A_n runs along the link. The
    slide B_n of the next prismatic joint is perpendicular to A_n (90 degrees
    counter-clockwise). The mass centre lies p_n along and q_n across the link. Every
    field is an array, so linkages of different topologies share one compilation and can
    be stacked into a batch.

    **Arguments:**

    - `topology`: one of `TOPOLOGIES`, or six existence factors; stored as `ef`.
    - `length`: A1..A4 [m]; A1 belongs to the ground.
    - `com`: (p_n, q_n) of the three moving links [m].
    - `mass`: masses m2..m4 of the moving links [kg].
    - `inertia`: moments of inertia I2..I4 about the mass centres [kg m^2].
    - `locked`: position of the fictitious joint of each pair: B_k [m] where the real
      joint is revolute, th_{k+1} - th_k [rad] where it is prismatic.
    - `base_angle`: th1, the angle of the ground's vector A1 [rad].
    - `gravity`: acceleration along -y [m/s^2].

    **Raises:** ValueError for malformed input and for linkages in which some joint
    moves no inertia in any configuration. Warns if the mass matrix may be singular in
    some configuration, and if one of two joints is redundant (the paper's rules (i) and
    (ii)).

    >>> import fdof_jax as fj
    >>> pendulum = fj.Linkage("RRR", length=[0, 1, 1, 1], com=[[1, 0]] * 3,
    ...                       mass=[1, 1, 1], inertia=[0, 0, 0])
    >>> pendulum.mass.shape
    (3,)
    """

    ef: Float[Array, " 6"]
    length: Float[Array, " 4"]
    com: Float[Array, "3 2"]
    mass: Float[Array, " 3"]
    inertia: Float[Array, " 3"]
    locked: Float[Array, " 3"]
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
        ef = topology if pairs is None else pairs.reshape(6)
        self.ef = jnp.asarray(ef, dtype=float)
        self.length = real_array("length", length, (4,))
        self.com = real_array("com", com, (3, 2))
        self.mass = real_array("mass", mass, (3,), minimum=0)
        self.inertia = real_array("inertia", inertia, (3,), minimum=0)
        self.locked = real_array("locked", locked, (3,), broadcast=True)
        self.base_angle = real_array("base_angle", base_angle, ())
        self.gravity = real_array("gravity", gravity, ())
        if not is_traced(list(vars(self).values())):
            check_singularity(self)

    def replace(self, **values: Any) -> "Linkage":
        """Returns a copy with other values of some fields, checked as a new linkage.

        **Arguments:** those of the constructor.

        **Raises:** ValueError for malformed values and for unknown names.

        >>> import fdof_jax as fj
        >>> fj.scenes.fig5().linkage.replace(mass=[1, 1, 5]).mass.tolist()  # [kg]
        [1.0, 1.0, 5.0]
        """
        fields = vars(self)
        now = {"topology": fields["ef"]} | {k: fields[k] for k in fields if k != "ef"}
        for name in values:
            if name not in now:
                raise ValueError(
                    f"{name}: expected one of {', '.join(now)}, got another name."
                )
        return Linkage(**now | values)

    def __repr__(self) -> str:
        """Shows the values of a single linkage, or the shapes of a batch."""
        if np.size(self.ef) != 6 or not known(self):
            return super().__repr__()
        topology = "".join(name[0] for name in joint_names(self))
        values = {name: _short(value) for name, value in vars(self).items()}
        del values["ef"]
        fields = (f"{name}={value}" for name, value in values.items())
        return f"Linkage({topology!r}, {', '.join(fields)})"


def _short(value: Array) -> str:
    """Formats the numbers on one line."""
    number: Any = {"float_kind": lambda value: f"{value:.6g}"}
    text = np.array2string(
        np.asarray(value), separator=", ", threshold=12, formatter=number
    )
    return " ".join(text.split())


def joint_names(linkage: Linkage) -> list[str]:
    """Returns the names of the real joints in order, for instance R1, P2, R3."""
    revolute = real_joints(np.asarray(linkage.ef))
    return [f"{'R' if turns else 'P'}{k + 1}" for k, turns in enumerate(revolute)]


_T = TypeVar("_T")


def compiled(
    **doors: tuple[int, ...] | Callable[[Any], Any],
) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Decorates a function of a linkage and arrays: checks arguments, then compiles.

    Each keyword names an argument and gives the shape of its array, or a function that
    checks and converts it. The decorated function accepts anything that converts to
    such an array. Without compilation, a call outside of `jax.jit` would dispatch
    hundreds of single operations.
    """

    def decorate(function: Callable[..., _T]) -> Callable[..., _T]:
        inner = eqx.filter_jit(function)  # force elements may hold functions
        signature = inspect.signature(function)

        @functools.wraps(function)
        def checked(*args: Any, **kwargs: Any) -> _T:
            arguments = signature.bind(*args, **kwargs).arguments
            check_linkage(arguments["linkage"])
            for name, door in doors.items():
                if callable(door):
                    if name in arguments:
                        arguments[name] = door(arguments[name])
                else:
                    arguments[name] = real_array(name, arguments[name], door)
            return inner(**arguments)

        return checked

    return decorate


def check_linkage(linkage: Any) -> None:
    """Raises ValueError unless the argument is one linkage, not a batch.

    Values are checked again, because `equinox.tree_at` bypasses the constructor.
    """
    if not isinstance(linkage, Linkage):
        raise ValueError(f"linkage: expected a Linkage, got {linkage!r}.")
    if jnp.shape(linkage.ef) != (6,):
        raise ValueError(
            "linkage: expected one linkage (use jax.vmap for a batch), got existence "
            f"factors of shape {jnp.shape(linkage.ef)}."
        )
    if is_traced(linkage):
        return
    values = jax.tree.map(np.asarray, linkage)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(values)) or not (
        possible(values)
    ):
        try:
            linkage.replace()
        except ValueError as error:
            raise ValueError(f"linkage.{error}") from None


def possible(linkage: Linkage) -> Array:
    """Returns whether the constructor would accept the values; works on traced ones.

    Checks that existence factors are 0 or 1 and complementary in each pair, that one
    joint at least is revolute, and that masses and inertias are not negative. Singular
    mass matrices are not checked.
    """
    pairs = linkage.ef.reshape(3, 2)
    factors = ((pairs == 0) | (pairs == 1)).all() & (pairs.sum(axis=1) == 1).all()
    return (
        factors
        & pairs[:, 1].any()
        & (linkage.mass >= 0).all()
        & (linkage.inertia >= 0).all()
    )
