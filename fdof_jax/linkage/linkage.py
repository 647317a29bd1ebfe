"""The linkage: which joints it has, its links, and its two sets of coordinates.

Pair k of the chain P-R-P-R-P-R joins link k to link k + 1; its prismatic joint
slides by B_k across link k, its revolute joint sits at the start of link k + 1.
Link 1 is the ground. One joint of each pair is real, the other is fictitious and
held at its initial value.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, instance, is_traced, known, real_array
from ..xla.array_namespace import in_numpy, namespace
from .singularity import check_singularity

TOPOLOGIES = ("RRR", "RRP", "RPR", "PRR", "RPP", "PRP", "PPR")


def _pairs_of(topology: Any) -> np.ndarray | None:
    """(3, 2) existence factors (prismatic, revolute), or None while traced."""
    if isinstance(topology, str):
        if topology not in TOPOLOGIES:
            detail = ""
            if topology == "PPP":
                detail = " (PPP cannot orient its last link: the paper excludes it)"
            raise ValueError(
                f"topology: expected one of {', '.join(TOPOLOGIES)}, "
                f"got {topology!r}{detail}."
            )
        return np.array([[j == "P", j == "R"] for j in topology], dtype=float)
    if is_traced(topology):
        if jnp.shape(topology) != (6,):
            raise ValueError(
                "topology: expected a name or 6 existence factors, got shape "
                f"{jnp.shape(topology)}."
            )
        return None
    try:
        given = np.asarray(topology)
        ef = given.astype(float) if given.dtype.kind in "biuf" else np.empty(0)
    except (TypeError, ValueError):
        ef = np.empty(0)
    if ef.shape != (6,) or not np.isin(ef, (0, 1)).all():
        raise ValueError(
            f"topology: expected one of {', '.join(TOPOLOGIES)} or six existence "
            f"factors of 0 or 1, got {topology!r}."
        )
    pairs = ef.reshape(3, 2)
    if not (pairs.sum(axis=1) == 1).all():
        raise ValueError(
            "topology: expected exactly one real joint in each (prismatic, revolute) "
            f"pair of existence factors (equation 4), got {ef.astype(int).tolist()}."
        )
    if pairs[:, 0].all():
        raise ValueError(
            "topology: expected at least one revolute joint, got PPP, which cannot "
            "orient its last link."
        )
    return pairs


def existence_factors(topology: str) -> Float[Array, " 6"]:
    """Existence factors EF1..EF6 of a topology, equation (4).

    Prismatic before revolute in each pair, 1 for a real joint and 0 for a
    fictitious one: "RPR" gives 0, 1, 1, 0, 0, 1.

    **Arguments:** `topology`: one of `TOPOLOGIES`.

    **Raises:** ValueError for any other name.

    >>> import fdof_jax as fj
    >>> fj.existence_factors("RPR").tolist()
    [0.0, 1.0, 1.0, 0.0, 0.0, 1.0]
    """
    instance("topology", topology, str)
    pairs = _pairs_of(topology)
    assert pairs is not None  # a name is not traced
    return jnp.asarray(pairs.reshape(6), dtype=float)


class Linkage(eqx.Module):
    """A planar chain of three moving links, as in Fig 1 of the paper.

    Link n starts at its characteristic point. Its vector A_n runs along the link,
    the slide of the next prismatic joint B_n perpendicular to it (90 degrees
    counter-clockwise), and the mass centre lies p_n along and q_n across. Every
    field is an array, so linkages of different topologies share one compilation and
    can be stacked into a batch.

    **Arguments:**

    - `topology`: one of `TOPOLOGIES`, or six existence factors. Kept as `ef`.
    - `length`: A1..A4 [m]; A1 belongs to the ground.
    - `com`: (p_n, q_n) of the three moving links [m].
    - `mass`: masses m2..m4 of the moving links [kg].
    - `inertia`: moments of inertia I2..I4 about the mass centres [kg m^2].
    - `locked`: position at which the fictitious joint of each pair stands still: B_k
      [m] where the real joint is revolute, th_{k+1} - th_k [rad] where it is
      prismatic.
    - `base_angle`: th1, the angle of the ground's vector A1 [rad].
    - `gravity`: acceleration along -y [m/s^2].

    **Raises:** ValueError for malformed input and for linkages that can carry no
    load at some joint in any configuration. Warns where a configuration exists in
    which the mass matrix may be singular, and where two joints do the same thing
    (the paper's rules (i) and (ii)).

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
        pairs = _pairs_of(topology)
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

    def __repr__(self) -> str:
        """With the values of one linkage; with the shapes of a batch."""
        if np.size(self.ef) != 6 or not known(self):
            return super().__repr__()
        topology = "".join(name[0] for name in joint_names(self))
        values = {name: _short(value) for name, value in vars(self).items()}
        del values["ef"]
        fields = (f"{name}={value}" for name, value in values.items())
        return f"Linkage({topology!r}, {', '.join(fields)})"


def _short(value: Array) -> str:
    """The numbers in brackets, on one line."""
    number: Any = {"float_kind": lambda value: f"{value:.6g}"}
    text = np.array2string(
        np.asarray(value), separator=", ", threshold=12, formatter=number
    )
    return " ".join(text.split())


def joint_names(linkage: Linkage) -> list[str]:
    """Of the real joints in order, for instance R1, P2, R3."""
    kinds = np.where(np.asarray(linkage.ef)[1::2] > 0.5, "R", "P")
    return [f"{kind}{k + 1}" for k, kind in enumerate(kinds)]


class State(NamedTuple):
    """Joint positions and velocities; a bare pytree, checked where it is used.

    `q`: the slide B_k [m] of a prismatic joint, the relative angle th_{k+1} - th_k
    [rad] of a revolute joint, in joint order (3,). `qd`: their rates (3,).

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> start = fj.State(q=[0.5, 0, 0], qd=[0, 0, 0])
    >>> fj.tip_position(arm, start.q).tolist()
    [2.633, 1.438]
    """

    q: ArrayLike
    qd: ArrayLike


def real_state(name: str, value: Any) -> State:
    """`value` as a state of arrays (3,), else ValueError."""
    try:
        q, qd = value
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected a State(q, qd), got {value!r}.") from None
    return State(real_array(f"{name}.q", q, (3,)), real_array(f"{name}.qd", qd, (3,)))


_T = TypeVar("_T")


def compiled(
    **doors: tuple[int, ...] | Callable[[Any], Any],
) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Decorate a function of a linkage and arrays: check at the door, compile inside.

    Each keyword names an array argument and its shape, and the decorated function takes
    anything that converts to such an array; or an argument and a function that checks
    and converts it. Without the compilation a call outside of `jax.jit` would dispatch
    hundreds of single operations.
    """

    def decorate(function: Callable[..., _T]) -> Callable[..., _T]:
        inner = eqx.filter_jit(function)  # elements may hold functions
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
    """Raise ValueError unless the argument is one linkage, not a batch.

    Its values are looked at again: `equinox.tree_at` asks no constructor.
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
        fields = vars(linkage)
        try:
            Linkage(fields["ef"], **{k: fields[k] for k in fields if k != "ef"})
        except ValueError as error:
            raise ValueError(f"linkage.{error}") from None


def possible(linkage: Linkage) -> Array:
    """Whether the values are ones that the constructor takes, also if traced.

    All but a singular mass matrix: existence factors of 0 and 1, complementary in each
    pair, one revolute joint at least, masses and inertias not negative.
    """
    pairs = linkage.ef.reshape(3, 2)
    factors = ((pairs == 0) | (pairs == 1)).all() & (pairs.sum(axis=1) == 1).all()
    return (
        factors
        & pairs[:, 1].any()
        & (linkage.mass >= 0).all()
        & (linkage.inertia >= 0).all()
    )


def real_joints(ef: Array) -> tuple[Array, Array, Array]:
    """Whether the real joint of each pair is the revolute one."""
    return ef[1] > 0.5, ef[3] > 0.5, ef[5] > 0.5


@compiled(q=(3,), qd=(3,))
def to_chain(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, " 6"], Float[Array, " 6"]]:
    """Chain coordinates (B1, th2, B2, th3, B3, th4) and their rates, from joint ones.

    Angles are absolute, as in the paper; fictitious joints stand at `linkage.locked`.

    **Arguments:** `q`, `qd`: joint positions [m or rad] and velocities.

    **Returns:** `x` [m, rad] and `xd` [m/s, rad/s].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> x, xd = fj.to_chain(arm, [0.5, 2.5, 0.0], [1.0, 0.0, 0.0])
    >>> x.tolist(), xd.tolist()  # a slide keeps its angle
    ([0.0, 0.5, 2.5, 2.071, 0.0, 2.071], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    """
    revolute = jnp.stack(real_joints(linkage.ef))
    slide = jnp.where(revolute, linkage.locked, q)
    turn = jnp.where(revolute, q, linkage.locked)
    x = jnp.stack([slide, linkage.base_angle + jnp.cumsum(turn)], axis=1)
    xd = jnp.stack(
        [jnp.where(revolute, 0, qd), jnp.cumsum(jnp.where(revolute, qd, 0))], axis=1
    )
    return x.reshape(6), xd.reshape(6)


def from_chain(
    topology: str | ArrayLike,
    x: ArrayLike,
    xd: ArrayLike,
    base_angle: ArrayLike = 0.0,
) -> tuple[Float[Array, " 3"], State]:
    """Locked positions and joint state, from the paper's lists of initial conditions.

    **Arguments:**

    - `topology`: one of `TOPOLOGIES`, or six existence factors.
    - `x`, `xd`: (B1, th2, B2, th3, B3, th4), absolute angles [m, rad], and rates.
    - `base_angle`: th1 [rad].

    **Returns:** `locked` for `Linkage`, and the `State`.

    **Raises:** ValueError for malformed input and for velocities that would move a
    fictitious joint (the paper's method stops accelerations only: such a start would
    drift).

    >>> import fdof_jax as fj
    >>> locked, state = fj.from_chain("RPR", [0, 1.5, 2.5, 2.5, 0, 2], [0] * 6)
    >>> locked.tolist(), state.q.tolist()
    ([0.0, 1.0, 0.0], [1.5, 2.5, -0.5])
    """
    pairs = _pairs_of(topology)
    given = (
        real_array("x", x, (6,)),
        real_array("xd", xd, (6,)),
        real_array("base_angle", base_angle, ()),
    )
    chain, chain_rate, ground = in_numpy(given)
    ef = jnp.asarray(topology) if pairs is None else pairs
    xp = namespace(ef, chain, chain_rate, ground)
    revolute = ef.reshape(3, 2)[:, 1] > 0.5
    slide, turn = chain[0::2], xp.diff(chain[1::2], prepend=ground)
    slide_rate, turn_rate = chain_rate[0::2], xp.diff(chain_rate[1::2], prepend=0)
    held = concrete(xp.where(revolute, slide_rate, turn_rate))
    if held is not None and pairs is not None:
        # Differences of absolute rates carry their rounding.
        scale = np.abs(np.asarray(chain_rate)).max()
        for k in np.flatnonzero(np.abs(held) > 8 * np.finfo(held.dtype).eps * scale):
            rate = (
                f"B{k + 1} rate 0"
                if pairs[k, 1]
                else (f"th{k + 2} rate equal to th{k + 1} rate" if k else "th2 rate 0")
            )
            raise ValueError(
                f"xd: expected {rate}, because that joint is fictitious, got a "
                f"difference of {held[k]:g}."
            )
    locked = jnp.asarray(xp.where(revolute, slide, turn), dtype=float)
    q = jnp.asarray(xp.where(revolute, turn, slide), dtype=float)
    qd = jnp.asarray(xp.where(revolute, turn_rate, slide_rate), dtype=float)
    return locked, State(q, qd)
