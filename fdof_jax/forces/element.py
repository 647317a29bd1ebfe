"""Force elements: forces and torques on the joints besides gravity."""

import inspect
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..base.checks import function, instance, shown
from ..linkage.fields import Foreign, Part, check_joints, default, optional, sized
from ..linkage.linkage import Linkage, joints_of
from ..mechanics.equations import Scalars
from .switches import Switches

Forces = tuple[Any, ...]  # elements, or callables (t, q, qd, linkage) -> tau
OwnStates = tuple[PyTree, ...]  # of `StatefulElement`s, in the order of the forces


class Element(Part):
    """A force element: a pytree that computes joint efforts.

    A subclass implements `__call__`. Joint positions, velocities and efforts have shape
    (n,) [m or rad; m/s or rad/s; N or N m]. All else has a default:

    - `conditions`: yields conditions on values, besides the bounds that `field`
      declares; `conditions_on(linkage)`: those on the arm's joints.
    - `jump_ts`: one or several times [s] at which the efforts jump; steps end there. By
      default, the jumps of its fields.
    - `check(linkage, ts)`: raises ValueError if the element does not fit the arm;
      `simulate` calls it after a failed motion.
    - `potential_energy(q, linkage)`: energy that it stores, () [J]; by default None.
    - `arguments()`: a dictionary of the constructor's arguments, by default the fields;
      `replace(name=...)` returns a checked copy with other values.

    A `StatefulElement` has a state, an `InertialElement` moves masses, a `PointElement`
    acts at points of links.

    >>> import fdof_jax as fj
    >>> import jax.numpy as jnp
    >>> class Drag(fj.Element):
    ...     coefficient: fj.Values = fj.field(unit="N m s^2/rad^2", minimum=0)
    ...     def __call__(self, t, q, qd, linkage):
    ...         return -self.coefficient * abs(qd) * qd
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> Drag(0.5)(0.0, jnp.zeros(2), jnp.array([2.0, -4.0]), arm).tolist()
    [-2.0, 8.0]
    """

    @abstractmethod
    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """Computes the efforts, (n,) [N or N m]."""

    potential_energy = default(lambda self: None)

    def schedule(self, t: Array, linkage: Linkage) -> PyTree:
        """Computes what depends on time alone; a step calls it before its stages."""
        return ()

    def initial_state(self, linkage: Linkage) -> PyTree:
        """Returns the state at the start: an array or a pytree of arrays."""
        return ()

    def act(
        self, t: Array, q: Array, qd: Array, linkage: Linkage, state: PyTree
    ) -> tuple[Array, PyTree]:
        """Returns the efforts (n,) [N or N m] and the rate of the state."""
        return self(t, q, qd, linkage), ()

    def loads_on_points(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[PyTree, ...] | None:
        """Returns the `Load`s that bearings carry, or None if they are unknown."""
        return ()


class ForeignElement(Foreign, Element):
    """A callable `(t, q, qd, linkage) -> tau` of another kind, as an element."""

    potential_energy = optional("potential_energy")

    def opened(self, *arguments: PyTree) -> Element:
        """Returns it with the closure of a plain function as leaves, at arguments."""
        if not inspect.isfunction(self.called):
            return self
        jumping: list[bool | None] = []

        def acting(sides: Array | None, *arguments: PyTree) -> tuple[Any, list[Array]]:
            own = Switches(sides)
            with own.dealt():
                effort = self.called(*arguments)
            jumping[:] = own.jumping
            return effort, own.values

        eqx.filter_eval_shape(acting, None, *arguments)
        closed = eqx.filter_closure_convert(acting, jnp.zeros(len(jumping)), *arguments)
        return _Opened(self.called, closed, tuple(jumping))


class _Opened(ForeignElement):
    closed: Callable
    jumping: tuple[bool | None, ...] = eqx.field(static=True)  # of its switches

    def __call__(self, *arguments: Any) -> Any:
        switches, sides = Switches.dealing(), jnp.zeros(len(self.jumping))
        if switches is not None and (rest := switches.rest()) is not None:
            sides = rest[: len(self.jumping)]
        effort, values = self.closed(sides, *arguments)
        if switches is not None:
            switches.add(values, self.jumping)
        return effort


def element_of(value: Callable) -> Element:
    """Returns an element itself, or a callable `(t, q, qd, linkage) -> tau` as one.

    **Raises:** ValueError for anything else.
    """
    if isinstance(value, Element):
        return value
    return ForeignElement(function("value", value, "a force element"))


def elements(name: str, forces: Forces) -> tuple[Element, ...]:
    """Returns a tuple of callables as elements, or raises ValueError."""
    acts = lambda item: callable(item) and not isinstance(item, type)
    if isinstance(forces, tuple) and all(map(acts, forces)):
        return tuple(map(element_of, forces))
    raise ValueError(
        f"{name}: expected a tuple of callables (t, q, qd, linkage) -> tau, for "
        f"instance (JointDamper(1.0),), got {shown(forces)}."
    )


def elements_on(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Returns forces as elements, with one number for all joints repeated for each.

    **Raises:** ValueError unless `forces` is a tuple of callables whose values suit the
    number of joints.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> fj.forces.elements_on(arm, (fj.JointDamper(2.0),))  # [N s/m or N m s/rad]
    (JointDamper(coefficient=[2, 2, 2]),)
    """
    instance("linkage", linkage, Linkage)
    found = elements("forces", forces)
    for index, element in enumerate(found):
        check_joints(f"forces[{index}].", element, linkage)
    return tuple(sized(element, joints_of(linkage)) for element in found)


# What JAX raises where traced values meet NumPy, or decide in Python.
_UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


@contextmanager
def naming(place: str) -> Iterator[None]:
    """Adds an element's place, such as `forces[0]`, to messages about its values.

    A context: `with naming("command"): ...`.
    """
    try:
        yield
    except _UNTRACEABLE as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise TypeError(
            f"{place}: expected jax.numpy in its functions, and no `if` on t, q or qd "
            f"(use jnp.where or fdof_jax.forces.switch), got: {reason}."
        ) from error
    except ValueError as error:
        name, colon, _ = str(error).partition(": ")
        first, *_ = name.split(".")
        if colon and first.isidentifier() and first not in ("linkage", "ts", "until"):
            raise ValueError(f"{place}.{error}") from error
        raise


class ScalarElement(Element):
    """A force element written in scalars, which fuses with the equations of motion.

    A subclass implements `respond`, and `schedule` if anything in it depends on time.
    """

    @abstractmethod
    def respond(
        self, scheduled: PyTree, q: Scalars, qd: Scalars, linkage: Linkage
    ) -> tuple[Array, ...]:
        """Computes the efforts [N or N m] from the result of `schedule`."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        scheduled = self.schedule(t, linkage)
        return jnp.stack(self.respond(scheduled, tuple(q), tuple(qd), linkage))


class StatefulElement(Element):
    """A force element with a state of its own, such as an integral or a current.

    A subclass implements `initial_state` and `__call__`, which returns efforts [N or N
    m] and the rate of the state.
    """

    @abstractmethod
    def initial_state(self, linkage: Linkage) -> PyTree:
        """Returns the state at the start: an array or a pytree of arrays."""

    @abstractmethod
    def __call__(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t: Array, q: Array, qd: Array, linkage: Linkage, state: PyTree
    ) -> tuple[Array, PyTree]:
        """Returns the efforts (n,) [N or N m] and the rate of the state."""

    def act(self, t, q, qd, linkage, state):
        return self(t, q, qd, linkage, state)


class InertialElement(Element):
    """A force element with masses, which add to the equations of motion.

    Its kinetic energy is the sum of weight * (d coordinate/dt)^2 / 2 [J]. The weight of
    a mass centre's coordinates is the mass, that of an angle the inertia. A subclass
    implements `coordinates` and `weights`, and `at` if its masses depend on time. Mass
    then leaves or arrives with the velocity of the body: M(t) qdd + bias = tau, without
    dM/dt.
    """

    def at(self, t: Array | np.ndarray) -> "InertialElement":
        """Returns an element with the masses of a time; itself if they never change."""
        return self

    @abstractmethod
    def coordinates(self, q: Array, linkage: Linkage) -> Array:
        """Computes places and angles from the joint positions, (n,)."""

    @abstractmethod
    def weights(self, linkage: Linkage) -> Array:
        """Returns the masses and inertias of the coordinates, (n,)."""

    def accelerations(self, q: Array, qd: Array, qdd: Array, linkage: Linkage) -> Array:
        """Computes the second time derivatives of the coordinates, (n,)."""
        coordinates = lambda q: self.coordinates(q, linkage)
        along = lambda q, qd: jax.jvp(coordinates, (q,), (qd,))[1]
        return jax.jvp(along, (q, qd), (qd, qdd))[1]

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """Computes the potential energy, () [J]; 0 unless overridden."""
        return jnp.zeros(())

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """Computes further efforts, (n,) [N or N m]; 0 unless overridden."""
        return jnp.zeros_like(q)

    def loads(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[PyTree, ...] | None:
        """Returns the `Load`s of the masses on points, for `joint_reactions`."""
        return None

    def loads_on_points(self, t, q, qd, qdd, linkage):
        return self.loads(t, q, qd, qdd, linkage)
