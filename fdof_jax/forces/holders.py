"""Elements that hold joints for a while: dry friction, hard stops, brakes."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, PyTree
from numpy.typing import ArrayLike

from ..base.checks import refusal
from ..linkage.fields import Condition, Part, Values, each, field
from ..linkage.joint_numbers import among_joints, numbered, numbers_in
from ..linkage.linkage import Linkage, joints_of
from ..mechanics.equations import Scalars
from .element import Forces, ScalarElement


class Holder(ScalarElement):
    """The base of elements that hold joints.

    Called by itself, an element returns its efforts at joints that are not held.
    """

    @property
    def holds(self) -> bool:
        """True if joints stand exactly still by its law."""
        return True

    @property
    def counted(self) -> bool:
        """True if `Solution.taken` has all the energy that it takes."""
        return self.holds

    def levels(self, joints: int, *at: Any) -> tuple[Array, Array]:
        """Returns the sliding and the static friction of the joints (see `toward`).

        `at`: t, q, qd, linkage. Without them, functions of these count as almost 0.
        """
        return jnp.zeros(joints), jnp.zeros(joints)

    def against(
        self, sliding: Scalars, scheduled: PyTree, q: Scalars, qd: Scalars,
        linkage: Linkage,
    ) -> Scalars:  # fmt: skip
        """Returns the efforts at joints that slide: `sliding` has their signs."""
        return tuple(jnp.zeros_like(rate) for rate in sliding)

    def braking(self, t: Array, linkage: Linkage) -> Array:
        """Returns which joints a brake holds at a time, (n,)."""
        return jnp.zeros(joints_of(linkage), bool)

    def respond(self, scheduled, q, qd, linkage):
        return self.against(qd, scheduled, q, qd, linkage)


def toward(friction: Array, direction: ArrayLike | Scalars) -> Array:
    """Returns the friction (n,) that resists motions in these directions.

    `friction`: (n,), or (2, n) for motions to positive and to negative positions.
    """
    if jnp.ndim(friction) < 2:
        return friction
    return jnp.where(jnp.asarray(direction) > 0, *friction)


class JointFriction(Holder):
    """Coulomb friction of the joints, which sticks, or is rounded off with `speed`.

    A sliding joint has the effort -level * sign(qd). When its rate reaches zero, it
    stands exactly still as long as the static friction can hold its load.

    With `speed`, the effort is -level * tanh(qd / speed). Joints then never stick, and
    creep under loads below the level. A small `speed` makes the equations stiff.

    **Arguments:** one per joint or one for all.

    - `level`: sliding friction, not negative [N or N m].
    - `static`: greatest friction at rest, at least the level; by default the level [N
      or N m].
    - `speed`: positive [m/s or rad/s].

    `level` and `static` may have two rows (2, n), for the positive and the negative
    direction. Each may be a function `(t, q, qd, linkage)` that returns such numbers,
    positive and smooth in each direction, such as `stribeck`. The value at qd = 0 holds
    joints at rest; an attribute `jump_ts` lists times at which the function jumps.
    Negative values, and static friction below the level, end a motion as not finite.
    `Solution.taken` does not count friction whose level is a function.

    **Raises:** ValueError for malformed arguments, and for `static` beside `speed`.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.forces.JointFriction(5)(0.0, [0, 0, 0], [0.0, 0.01, -1.0], arm).tolist()
    [0.0, -5.0, 5.0]
    """

    level: Any = field(unit="N or N m", minimum=0, rows=2, function=True)
    static: Any = field(unit="N or N m", minimum=0, rows=2, function=True, default=None)
    speed: Values | None = field(
        unit="m/s or rad/s", above=0, default=None, kw_only=True
    )

    @property
    def holds(self):
        return self.speed is None

    @property
    def counted(self):
        return self.holds and not callable(self.level)

    def conditions(self):
        if self.static is not None:
            alone = self.speed is None
            yield Condition(alone, "static", "none beside speed", self.static)
            both = self.static, self.level
            if not any(map(callable, both)):
                enough = (self.static >= self.level).all()
                yield Condition(enough, "static", "at least the level", both)

    def schedule(self, t, linkage):
        return t if callable(self.level) else ()

    def levels(self, joints, *at):
        level = self._of_joints("level", joints, at)
        if self.static is None:
            return level, level
        static = self._of_joints("static", joints, at)
        if at and (callable(self.level) or callable(self.static)):
            level, static = jnp.broadcast_arrays(level, static)
            level = jnp.where(static < level, jnp.nan, level)
        return level, static

    def _of_joints(self, name: str, joints: int, at: tuple[Any, ...]) -> Array:
        """Returns friction with an entry per joint, (n,) or (2, n)."""
        friction = vars(self)[name]
        varies = callable(friction)
        if varies and not at:
            friction = jnp.zeros(())
        elif varies:
            t, q, qd, linkage = at
            state = jnp.asarray(q), jnp.asarray(qd)
            friction = self.value_of(name, t, *state, linkage)
            if jnp.ndim(friction) and friction.shape[-1] != joints:
                expected = f"it to return numbers for {joints} joints"
                got = f"shape {friction.shape}"
                raise ValueError(f"{name}: expected {expected}, got {got}.")
            friction = jnp.where(friction < 0, jnp.nan, friction)
        if jnp.ndim(friction) < 2:
            friction = jnp.broadcast_to(friction, joints)
            if not varies:
                return friction
        # Never 0, as the modes tell directions only where there may be friction.
        return friction + jnp.finfo(friction.dtype).eps ** 2

    def against(self, sliding, scheduled, q, qd, linkage):
        if self.speed is None:
            signs = map(jnp.sign, sliding)
        else:
            rates = zip(each(self.speed, sliding), sliding)
            signs = (jnp.tanh(rate / speed) for speed, rate in rates)
        level, _ = self.levels(len(sliding), scheduled, q, qd, linkage)
        levels = toward(level, sliding)
        return tuple(-x * sign for x, sign in zip(levels, signs))


class stribeck(Part):  # named as the function that it is
    """Friction that falls from static to sliding friction as a joint moves faster.

    A `level` for `JointFriction`: coulomb + (static - coulomb) exp(-(qd / speed)^2).

    **Arguments:** one per joint or one for all.

    - `coulomb`, `static`: friction at high speed and at rest, not negative [N or N m].
    - `speed`: where most of the difference is gone, positive [m/s or rad/s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> level = fj.forces.stribeck(1.0, static=1.5, speed=0.1)
    >>> level(0.0, [0, 0], np.array([0.0, 9.0]), arm).tolist()
    [1.5, 1.0]
    >>> friction = fj.forces.JointFriction(level)  # needs no static friction beside it
    """

    coulomb: Values = field(unit="N or N m", minimum=0)
    static: Values = field(unit="N or N m", minimum=0)
    speed: Values = field(unit="m/s or rad/s", above=0)

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        peak = jnp.exp(-jnp.square(qd / self.speed))
        return self.coulomb + (self.static - self.coulomb) * peak


class HardStops(Holder):
    """Rigid stops at the ends of the joints' ranges: impacts, bouncing and resting.

    A joint that hits its stop at a rate v leaves it at -restitution * v. The impact
    changes the rates of the other joints, and breaks the hold of friction, but not of
    brakes. A joint whose bounces fall below 1e-11 m or rad (in float32, 1e-5) rests
    until something pulls it away; the bounces left out last about 1e-5 s (1e-3 s). Use
    the soft `JointStops` where the give matters, or several contacts share a load.

    **Arguments:** one per joint or one for all.

    - `lower`, `upper`: ends of the range [m or rad]; may be infinite.
    - `restitution`: from 0, the default (no rebound), to 1 (elastic).

    **Raises:** ValueError for malformed arguments, and unless lower < upper.

    >>> import fdof_jax as fj
    >>> mass = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
    >>> floor = fj.forces.HardStops(0.0, float("inf"), restitution=0.5)
    >>> motion = fj.simulate(mass, fj.State([1.0], [0.0]), [0, 2.0], (floor,))
    >>> motion.q[-1].tolist(), motion.modes[-1].tolist()  # it rests on the lower stop
    ([0.0], [2.0])
    """

    lower: Values = field(unit="m or rad", finite=False)
    upper: Values = field(unit="m or rad", finite=False)
    restitution: Values = field(unit="1", minimum=0, default=0.0, kw_only=True)

    def conditions(self):
        yield from self.ordered("lower", "upper")
        e = self.restitution
        yield Condition((e <= 1).all(), "restitution", "at most 1", e)


class Brake(Holder):
    """A brake that holds joints between two known times, whatever their load.

    When it engages, an impulse stops its joints and changes the rates of the others. If
    it holds at the start, the first rates of a motion are those after its impulse.

    **Arguments:**

    - `joints`: one or several numbers of joints, from 1.
    - `begin`, `end`: times at which the brake engages and lets go [s]; by default it
      always holds.

    **Raises:** ValueError for malformed arguments, and unless begin < end.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> brake = fj.forces.Brake([2, 3], begin=0.5)
    >>> motion = fj.simulate(arm, start, [0, 0.5, 1.0], (brake,))
    >>> motion.modes[-1].tolist()  # the first joint is free, a brake holds the others
    [0.0, 4.0, 4.0]
    """

    joints: Bool[Array, " number"]
    begin: Values = field((), unit="s", finite=False, default=-np.inf)
    end: Values = field((), unit="s", finite=False, default=np.inf)

    def __init__(
        self,
        joints: ArrayLike | Sequence[int],
        begin: ArrayLike = -np.inf,
        end: ArrayLike = np.inf,
    ):
        self.joints = numbered(joints)
        self.begin, self.end = begin, end  # pyright: ignore[reportAttributeAccessIssue]

    def arguments(self) -> dict[str, Any]:
        ends = {"begin": self.begin, "end": self.end}
        return {"joints": numbers_in(self.joints)} | ends

    def conditions(self):
        yield from self.ordered("begin", "end")

    def conditions_on(self, linkage):
        yield among_joints(self.joints, linkage)

    @property
    def jump_ts(self) -> Array:
        return jnp.stack([self.begin, self.end])

    def braking(self, t, linkage):
        return self.joints[: joints_of(linkage)] & (self.begin <= t) & (t < self.end)


def holders(forces: Forces) -> tuple[Holder, ...]:
    """Returns the elements that hold joints; raises ValueError for several stops."""
    found = tuple(e for e in forces if isinstance(e, Holder) and e.holds)
    if sum(isinstance(e, HardStops) for e in found) > 1:
        raise ValueError("forces: expected one HardStops at most, got several.")
    return found


def check_free(name: str, element: object) -> None:
    """Raises ValueError for an element that holds joints, where all must be free.

    >>> import fdof_jax as fj
    >>> fj.checks.check_free("forces[0]", fj.JointDamper(1.0))
    """
    if isinstance(element, Holder) and element.holds:
        raise refusal(
            name,
            "no element that holds joints, because only motions have modes (leave it "
            "out for free joints, or hold a joint by a fixed pair, F; JointStops and "
            "JointFriction with a speed hold none)",
            element,
        )
