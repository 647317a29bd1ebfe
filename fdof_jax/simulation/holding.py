"""Joints that are held for a while: their modes, and what ends these.

H are the joints held, F the others; c is the effort of the holders (the paper's
generalised constraint force), tau that of all others:

    qdd_H = 0,   M_FF qdd_F = tau_F - b_F,   c_H = M_HF qdd_F + b_H - tau_H

Guards are positive while a mode lasts. Steps end at their zeros, where `resolve`
(events.py) finds the next modes.
"""

from collections.abc import Callable
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..base.one_loop import in_one_loop
from ..base.trees import constant
from ..forces.added_inertia import added_inertia
from ..forces.element import Forces
from ..forces.holders import Brake, HardStops, Holder, holders, toward
from ..forces.payload import Payload
from ..forces.reset import resets_in
from ..linkage.fields import Truth
from ..linkage.linkage import Linkage, joints_of
from ..linkage.topology import real_joints
from ..mechanics.equations import Constants, Equations, Upper, equations, with_held
from ..mechanics.rates import efforts_of_fixed
from ..mechanics.solve import divided, solver_of, times, with_added
from ..steps.term import Integrated
from .prescribed import prescribed
from .solution import MODES, Events
from .vector_field import Args, Schedules, applied, args_of

FREE, FRICTION, LOWER, UPPER, BRAKE = range(len(MODES))
MOST_EVENTS = 64  # recorded; of more, the last ones
# A flight that is lower than this power of the unit of rounding is left out [m or rad].
LOW = 0.7
# Distances from stops are in this part of a metre or rad, so that the distance by which
# steps end beyond zeros is short even for a joint that bounces slowly.
_STOPS_IN = 100
# Rates of so many units of rounding count as zero [m/s or rad/s]; after an impact also
# as many of the rate that a joint would have with all kinetic energy.
STILL = 500
# What was found at its limit is held only if it needs this much less, as a share.
_SURE = 1e-7


class Modes(NamedTuple):
    """The modes of the joints, as part of the integrated state.

    - `mode` (n,): FREE, FRICTION, LOWER, UPPER or BRAKE; negative before the start.
    - `direction` (n,): 1 or -1 where friction resists sliding, else 0.
    - `origin` (n,): displacements at which sliding began [m or rad].
    - `taken`: energy that holders took before [J].
    """

    mode: Array
    direction: Array
    origin: Array
    taken: Array
    events: Events

    @property
    def held(self) -> Array:
        return self.mode > FREE


class Laws(NamedTuple):
    """The laws of all holders, (n,) each in joint order; frictions as in `toward`."""

    level: Array
    static: Array
    lower: Array
    upper: Array
    restitution: Array
    braked: Array

    @property
    def rubs(self) -> Array:
        return toward(self.static, 1) > 0


def _sum(friction: Array, more: Array) -> Array:
    """Returns the sum of frictions, either of which may have two rows."""
    return jnp.add(*jnp.broadcast_arrays(friction, more))


def laws(args: Args, t: Array, *state: Array) -> Laws:
    """Returns the laws of all holders at a time, positions and rates.

    Without the latter, friction that depends on them counts as almost 0.
    """
    joints = joints_of(args.linkage)
    fixed = args.linkage.fixed
    if (moved := args.moved) is not None:
        fixed = fixed | moved
    level, static = jnp.zeros(joints), jnp.zeros(joints)
    lower, upper = jnp.full(joints, -jnp.inf), jnp.full(joints, jnp.inf)
    restitution, braked = jnp.zeros(joints), jnp.zeros(joints, bool)
    for index, element in enumerate(args.forces):
        if not (isinstance(element, Holder) and element.holds):
            continue
        at = args.clock(index, t), *state, args.linkage
        more, most = element.levels(joints, *(at if state else ()))
        level, static = _sum(level, more), _sum(static, most)
        braked = braked | element.braking(at[0], args.linkage)
        if isinstance(element, HardStops):
            whole_size = lambda x: jnp.broadcast_to(x, joints)
            ends = element.lower, element.upper, element.restitution
            lower, upper, restitution = map(whole_size, ends)
    none = lambda x, value=0.0: jnp.where(fixed, value, x)
    return Laws(
        none(level),
        none(static),
        none(lower, -jnp.inf),
        none(upper, jnp.inf),
        restitution,
        braked & ~fixed,
    )


def unknown_modes(args: Args) -> tuple[Modes, int]:
    """Returns the modes before the start, and the number of guards."""
    q0 = args.q0
    stops = any(isinstance(e, HardStops) for e in args.forces)
    none, zero = jnp.zeros(MOST_EVENTS, q0.dtype), jnp.zeros((), q0.dtype)
    events = Events(none, none, none, zero)
    zeros = jnp.zeros_like(q0)
    return Modes(zeros - 1, zeros, zeros, zero, events), q0.size * (3 if stops else 1)


def _reserve(static: Array, mode: Array, effort: Array, inertia: Array) -> Array:
    """Returns by how much efforts may grow before held joints come free.

    Near a limit of friction it is a share of the limit; at a stop it is per inertia
    [m/s^2 or rad/s^2]. So it has similar sizes in large machines and in tiny ones.
    """
    ahead, behind = toward(static, 1), toward(static, -1)
    mean = (ahead + behind) / 2
    mean = jnp.where(mean > 0, mean, 1)
    kinds = [mode == FRICTION, mode == LOWER, mode == UPPER]
    rubs = (ahead + effort) / mean * ((behind - effort) / mean) / 2
    pushes = [(ahead + effort) / inertia, (behind - effort) / inertia]
    return jnp.select(kinds, [rubs, *pushes], 1)


def guarded_switching(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Array, tuple[bool, ...]]:
    """Returns the switching functions of all efforts, and after them the guards.

    Each joint has one, positive as long as it stays held, or goes on sliding. With
    stops, two more are its distances from them while it is free.
    """
    at = applied(t, y, args, schedule)
    driven = at.delta, at.qd, at.tau, at.added
    effort = jnp.stack(efforts_of_fixed(args.moving(), *driven))
    delta, qd = jnp.stack(at.delta), jnp.stack(at.qd)
    law, modes = laws(args, t, args.q0 + delta, qd), args.modes
    held, direction = modes.held, modes.direction
    rubs = law.rubs & ~held & (direction != 0)
    sliding = jnp.where(rubs, direction * qd, 1)
    c = args.constants
    inertia = jnp.where(
        *map(jnp.stack, (real_joints(args.linkage.ef), c.second, c.carried))
    )
    inertia = jnp.where(inertia > 0, inertia, 1)
    reserve = _reserve(law.static, modes.mode, effort, inertia)
    guards = [jnp.where(held, reserve, sliding)]
    if any(isinstance(e, HardStops) for e in args.forces):
        room = delta - (law.lower - args.q0), law.upper - args.q0 - delta
        guards += [jnp.where(held, 1, _STOPS_IN * distance) for distance in room]
    values = jnp.concatenate([at.switches.all_values(args.q0.dtype), *guards])
    at_guards = [True] * sum(guard.size for guard in guards)  # efforts jump there
    return values, (*at.switches.jumping, *at_guards)


class System(NamedTuple):
    constants: Constants
    equations: Equations
    added: Upper | None

    def accelerations(
        self, efforts: Array, held: Array, once: Callable = lambda x: x
    ) -> Array:
        """Returns the accelerations, 0 at joints that are held."""
        constants = with_held(self.constants, tuple(held))
        solve, _ = solver_of(constants, self.equations, self.added, divided)
        return jnp.stack(once(solve(tuple(efforts))))

    def momenta(self, qd: Array) -> Array:
        return jnp.stack(times(self.equations.mass, tuple(qd)))

    def still(self, *rates: Array) -> Array:
        """Returns the rates (n,) that count as zero after an impact."""
        energies = jnp.stack([qd @ self.momenta(qd) for qd in rates])
        inertia = jnp.where(self.inertia > 0, self.inertia, jnp.inf)
        return (
            STILL
            * jnp.finfo(rates[0].dtype).eps
            * (1 + jnp.sqrt(jnp.max(energies) / inertia))
        )

    @property
    def inertia(self) -> Array:
        return jnp.stack([row[0] for row in self.equations.mass])

    def caught(self, qd: Array, held: Array) -> Array:
        """Returns the rates after an impact that stops joints.

        M_FF qd_F+ = M_FF qd_F + M_FB qd_B, with B the joints stopped.
        """
        change = self.accelerations(self.momenta(jnp.where(held, qd, 0)), held)
        return jnp.where(held, 0, qd + change)


def system_at(t: Array, q: Array, qd: Array, args: Args) -> System:
    """Returns the system at a configuration, with the bias at these rates.

    Prescribed joints are fixed pairs; the bias includes what they take.
    """
    added, more = added_inertia(args.linkage, args.masses(t), q, qd)
    m = with_added(added, equations(args.constants, tuple(q - args.q0), tuple(qd)))
    bias = tuple(jnp.stack(m.bias) + more)
    if (motion := prescribed(args.forces)) is not None:
        *_, qdd = motion.schedule(t, args.linkage)
        given = jnp.where(motion.prescribes(args.linkage), qdd, 0)
        bias = tuple(map(add, bias, times(m.mass, tuple(given))))
    return System(args.moving(jnp.zeros(q.size, bool)), m._replace(bias=bias), added)


def within_stops(forces: Forces, q: Array, linkage: Linkage) -> Truth:
    """Returns whether real joints are within their hard stops, but for rounding."""
    near = jnp.sqrt(jnp.finfo(q.dtype).eps)
    stops = [e for e in forces if isinstance(e, HardStops)]
    if not stops:
        return True
    inside = [
        linkage.fixed | (q >= e.lower - near) & (q <= e.upper + near) for e in stops
    ]
    return jnp.stack(inside).all()


def leaves_prescribed(forces: Forces, linkage: Linkage) -> Truth:
    """Returns whether prescribed joints have no stop and no brake."""
    if (motion := prescribed(forces)) is None:
        return True
    moved, alone = motion.prescribes(linkage), jnp.array(True)
    for element in forces:
        stopped = jnp.array(False)
        if isinstance(element, HardStops):
            stopped = jnp.isfinite(element.lower) | jnp.isfinite(element.upper)
        elif isinstance(element, Brake):
            stopped = element.joints[: moved.size]
        alone &= ~jnp.any(moved & stopped)
    return alone


def changes(forces: Forces) -> bool:
    """Returns whether elements hold joints, take masses or reset the state."""
    taking = (isinstance(e, Payload) and e.begin is not None for e in forces)
    return bool(holders(forces) or resets_in(forces)) or any(taking)


def at_rest(
    qd: Array, touched: Array, before: Modes, law: Laws, system: System, net: Array,
    fired: Array,
) -> Modes:  # fmt: skip
    """Returns the modes of joints with these rates, and directions of sliding.

    Accelerations of joints at rest minimise (qdd - a)^T M (qdd - a) / 2 + sum level
    abs(qdd), which is convex. One joint after the other changes its mode, until all
    agree with their laws (Murty's principal pivoting).
    """
    qd, touched, law, system, net = constant((qd, touched, law, system, net))
    m, efforts = in_one_loop((system.equations, tuple(net)))
    system, net = system._replace(equations=m), jnp.stack(efforts)
    inertia = system.inertia
    rest = (qd == 0) & (law.rubs | (touched != 0) | law.braked)
    held_as = jnp.where(touched < 0, LOWER, jnp.where(touched > 0, UPPER, FRICTION))
    held_as = jnp.where(law.braked, BRAKE, held_as)
    static = jnp.where(law.braked, jnp.inf, law.static)
    least = jnp.where(held_as == UPPER, -jnp.inf, -toward(static, 1))
    most = jnp.where(held_as == LOWER, jnp.inf, toward(static, -1))
    size = jnp.abs(net) + toward(law.static, net)
    pulled = system.momenta(system.accelerations(net, before.held, in_one_loop)) - net
    leaves = [before.mode == LOWER, before.mode == UPPER, before.mode == FRICTION]
    forced = jnp.select(leaves, [1.0, -1.0, -jnp.sign(pulled)])
    count, joints = qd.size, jnp.arange(qd.size)

    def solved(slide):
        held = rest & (slide == 0)
        rubbing = toward(law.level, slide) * slide
        qdd = system.accelerations(net - rubbing, held, in_one_loop)
        effort = jnp.where(held, system.momenta(qdd) - net, 0)
        low, high = (effort - least) / size, (most - effort) / size
        # A joint that slides must not accelerate the other way.
        back = slide * qdd * inertia / size
        wrong = jnp.where(held, jnp.minimum(low, high), jnp.where(rest, back, 0))
        wrong = jnp.where(size > 0, wrong, 0)
        limit = jnp.where(held, 0, -_SURE * jnp.abs(slide))
        towards = jnp.where(low < high, 1.0, -1.0)
        return jnp.where(wrong < limit, wrong, 0), towards, held

    def changed(state):
        slide, tries, wrong, towards, held = state
        worst, lowest = jnp.argmin(wrong), jnp.argmax(wrong < 0)
        k = jnp.where(tries < 2 * count, worst, lowest)
        new = jnp.where(held, towards, 0)
        slide = jnp.where(joints == k, new, slide)
        return slide, tries + 1, *solved(slide)

    unsettled = lambda state: (state[2] < 0).any() & (state[1] < 8 * count)
    start = jnp.where(rest & fired, forced, 0)
    slide, *_ = jax.lax.while_loop(unsettled, changed, (start, 0, *solved(start)))
    held = rest & (slide == 0)
    direction = jnp.where(held, 0, jnp.where(rest, slide, jnp.sign(qd)))
    return before._replace(
        mode=jnp.where(held, held_as, FREE).astype(qd.dtype),
        direction=jnp.where(law.rubs, direction, 0),
    )


def taken_at(args: Args, ts: Array, modes: Modes, q: Array) -> Array:
    """Returns the energy that holders have taken (time,) [J], from modes at times."""

    def taken(t, direction, origin, before, q):
        slide = direction * (q - args.q0 - origin)
        return before + jnp.sum(toward(laws(args, t).level, direction) * slide)

    rows = modes.direction, modes.origin, modes.taken
    return jax.vmap(taken)(ts, *rows, q)


def efforts_of_holders(
    linkage: Linkage, forces: Forces, t: Array, q: Array, qd: Array, tau: Array
) -> Array:
    """Computes the effort by which each element holds joints, (element, n).

    `tau`: the sum of all others. Held joints are exactly at rest. A stop pushes, and
    friction takes what would pull at it.
    """
    args = args_of(linkage, q, forces)
    modes, _ = unknown_modes(args)
    law, near = laws(args, t, q, qd), jnp.sqrt(jnp.finfo(q.dtype).eps)
    touched = 1.0 * (q >= law.upper - near) - 1.0 * (q <= law.lower + near)
    system = system_at(t, q, qd, args)
    net = tau - jnp.stack(system.equations.bias)
    none = jnp.zeros(q.size, bool)
    modes = at_rest(qd, touched * (qd == 0), modes, law, system, net, none)
    slide = jnp.where(qd == 0, modes.direction, 0)
    starts = -toward(law.level, slide) * slide
    qdd = system.accelerations(net + starts, modes.held)
    c = jnp.where(modes.held, system.momenta(qdd) - net, 0)
    mode = modes.mode
    pushes = (mode == LOWER) & (c > 0) | (mode == UPPER) & (c < 0)
    rubs = jnp.where(pushes | (mode == BRAKE), 0, c + starts)
    braked, rows = law.braked, []
    for index, element in enumerate(forces):
        share = jnp.zeros_like(q)
        if isinstance(element, HardStops):
            share = jnp.where(pushes, c, 0)
        elif isinstance(element, Brake):
            holds = element.braking(args.clock(index, t), linkage)
            share, braked = jnp.where(braked & holds, c, 0), braked & ~holds
        elif isinstance(element, Holder) and element.holds:
            at = args.clock(index, t), q, qd, linkage
            _, static = element.levels(q.size, *at)
            static, most = toward(static, -rubs), toward(law.static, -rubs)
            share = static / jnp.where(law.rubs, most, 1) * rubs
        rows.append(share)
    return jnp.stack(rows)
