"""Events of held joints: what jumps there, which modes follow, and the record."""

import jax
import jax.numpy as jnp
from jax import Array

from ..base.checks import place_of
from ..base.trees import constant
from ..dynamics import energy
from ..forces.element import naming
from ..forces.holders import Brake, HardStops, toward
from ..forces.payload import Payload
from ..forces.reset import Reset, resets_in
from ..linkage.linkage import without_fixed
from ..mechanics.equations import Scalars
from ..mechanics.solve import minus
from ..steps.switch_derivatives import Event
from ..steps.term import Integrated
from .holding import (
    BRAKE,
    FREE,
    FRICTION,
    LOW,
    LOWER,
    MOST_EVENTS,
    STILL,
    UPPER,
    Laws,
    Modes,
    System,
    at_rest,
    laws,
    system_at,
    within_stops,
)
from .prescribed import PrescribedMotion
from .solution import HAPPENINGS, Events
from .vector_field import (
    Args,
    efforts,
    schedule_of,
    vector_field,
    with_prescribed_rates,
)

_STICKS, _SLIPS, _BOUNCES, _RESTS, _LEAVES, _BRAKED, _LET_GO, _STOPPED, _RESET = range(
    len(HAPPENINGS)
)


def resolve(event: Event, y: Integrated, args: Args) -> tuple[Integrated, Modes]:
    """Returns the state and the modes after an event; `args.modes` are those before.

    In this order: resets, impulses of prescribed motions, payloads, brakes, stops. What
    is then at rest is held or begins to slide.
    """
    kinds = {kind for e in args.forces for kind in type(e).__mro__}
    before, law = args.modes, laws(args, event.t)
    energy_taken = jnp.zeros_like(event.t)
    if resets := resets_in(args.forces):
        for element, met in zip(resets, event.resets):
            y, more = _after_reset(element, met, event.t, y, args)
            energy_taken += more
    if PrescribedMotion in kinds:
        # Impulses move what friction and stops hold.
        braked = before._replace(mode=jnp.where(law.braked, BRAKE, FREE))
        y = with_prescribed_rates(event.t, y, args._replace(modes=braked))
    q = args.q0 + jnp.stack(y[0])
    first = before.mode < 0
    fired = jnp.zeros((3, q.size), bool)
    fired = fired.at[: len(event.fired)].set(event.fired)
    slides = ~before.held
    # What is at its stop. Also those that are as near as a flight that is left out:
    # otherwise joints whose impacts throw each other at their stops would hit them in
    # turn without end.
    near = jnp.finfo(q.dtype).eps ** LOW
    at_lower = fired[1] | (q <= law.lower + near)
    at_upper = fired[2] | (q >= law.upper - near)
    touched = jnp.where(at_lower, -1.0, jnp.where(at_upper, 1.0, 0.0))
    stop = jnp.where(at_lower, law.lower, jnp.where(at_upper, law.upper, 0))
    late = jnp.zeros_like(event.t)
    if HardStops in kinds:
        hits = fired[1] | fired[2]
        y, late = _at_impact(event.before, y, hits, stop, args)
    delta, rates_before, *own = y
    q, qd = args.q0 + jnp.stack(delta), jnp.stack(rates_before)
    begun, q = q, jnp.where(touched != 0, stop, q)
    qd = jnp.where(fired[0] & slides, 0, qd)  # came to zero
    may_rest = law.rubs | (touched != 0)
    still = jnp.full_like(q, STILL * jnp.finfo(q.dtype).eps)
    qd = start = _stilled(qd, may_rest, still)

    lost, hit, left_out = energy_taken, jnp.zeros(q.size, bool), 0.0
    if kinds & {Brake, HardStops, Payload}:
        system = system_at(event.t, q, jnp.zeros_like(q), args)
        if Payload in kinds:
            qd, more = _taken(event, q, qd, first, args, law, system)
            lost += more
        energy = lambda qd: qd @ system.momenta(qd) / 2
        lost += energy(qd)
        still = system.still(start, qd)
        qd = system.caught(qd, law.braked)
        if HardStops in kinds:
            qd, hit = _after_impacts(qd, touched, law, system)
            qd = _stilled(qd, may_rest, still)
            net = _net_efforts(event.t, q, qd, own, args)
            qd, left_out = _settled(qd, touched, law, *net)
        qd = _stilled(qd, may_rest, still)
        lost -= energy(qd)
    net = _net_efforts(*constant((event.t, q, qd, own, args)))
    at_qd = laws(args, event.t, q, qd)
    modes = at_rest(qd, touched * (qd == 0), args.modes, at_qd, *net, fired[0])
    slid = before.direction * (jnp.stack(delta) - before.origin)
    slid = toward(law.level, before.direction) * slid
    lost += jnp.sum(jnp.where(first, 0, slid))
    # What leaves its stop, as at the start, keeps its own derivatives.
    apart = ~hit & (modes.mode != LOWER) & (modes.mode != UPPER)
    q = jnp.where(apart, begun - constant(begun) + constant(q), q)
    origin = q - args.q0
    kind = _happenings(before, modes, hit & (modes.mode == FREE), law)
    qd = jnp.where(modes.mode > FREE, 0, qd)
    # Modes in which a motion begins are no events, but impacts at the start are.
    kind = jnp.where(first & (qd == start), -1, kind)
    at = event.t + left_out - late
    events = before.events
    if resets:
        reset = jnp.where(event.resets.any(), _RESET, -1)[None]
        events = _recorded(events, event.t, reset, first=0)
    events = _recorded(events, at, kind)
    modes = modes._replace(origin=origin, taken=before.taken + lost, events=events)
    state = tuple(origin), tuple(qd), *own
    if HardStops in kinds:
        state = _moved(state, late, _rates(event.t, state, args._replace(modes=modes)))
    return state, modes


def _stilled(qd: Array, joints: Array, still: Array) -> Array:
    """Returns rates, 0 where those of `joints` count as zero; derivatives are kept.

    Rounding errors would otherwise free what friction or a stop holds.
    """
    rests = joints & (jnp.abs(constant(qd)) <= constant(still))
    return jnp.where(rests, qd - constant(qd), qd)


def _at_impact(
    t: Array, y: Integrated, hits: Array, stop: Array, args: Args
) -> tuple[Integrated, Array]:
    """Returns the state when the first joint hit its stop, and how long ago that was.

    If only positions moved back onto stops, each impact would add or take energy.
    """
    rates = _rates(t, y, args)
    q, qd, qdd = args.q0 + jnp.stack(y[0]), jnp.stack(y[1]), jnp.stack(rates[1])
    hits = hits & (qd != 0)
    since = jnp.where(hits, (q - stop) / jnp.where(hits, qd, 1), 0)
    # A joint that would turn round in this time hardly comes to its stop.
    since = jnp.where(jnp.abs(since * qdd) < jnp.abs(qd), since, 0)
    late = since[jnp.argmax(jnp.abs(since))]
    return _moved(y, -late, rates), late


def _rates(t: Array, y: Integrated, args: Args) -> Integrated:
    return vector_field(t, y, args, schedule_of(t, args))


def _moved(y: Integrated, time: Array, rates: Integrated) -> Integrated:
    return jax.tree.map(lambda y, rate: y + time * rate, y, rates)


def _taken(
    event: Event, q: Array, qd: Array, first: Array, args: Args, law: Laws,
    system: System,
) -> tuple[Array, Array]:  # fmt: skip
    """Returns the rates after payloads are taken, and the energy lost.

    M+ qd+ = M- qd- + J^T W v, over the joints that no brake holds.
    """
    impulse, lost, taken = jnp.zeros_like(q), jnp.zeros_like(event.t), jnp.array(False)
    for index, element in enumerate(args.forces):
        if not (isinstance(element, Payload) and element.begin is not None):
            continue
        before, after = (
            element.there(args.clock(index, t)) for t in (event.before, event.t)
        )
        new = after & ~before & ~first.any()
        coordinates = lambda q, e=element: e.coordinates(q, args.linkage)
        jacobian = jax.jacfwd(coordinates)(q)
        weights = element.at(args.clock(index, event.t)).weights(args.linkage)
        own, carried = element.arriving, jacobian @ qd
        impulse += jnp.where(new, weights * (own - carried) @ jacobian, 0)
        lost += jnp.where(new, weights @ (own**2 - carried**2) / 2, 0)
        taken = taken | new
    # With the masses after it, M+ (qd+ - qd-) = J^T W (v - J qd-).
    after = qd + jnp.where(taken, system.accelerations(impulse, law.braked), 0)
    lost += (qd @ system.momenta(qd) - after @ system.momenta(after)) / 2
    return after, jnp.where(taken, lost, 0)


def _net_efforts(
    t: Array, q: Array, qd: Array, own: list[Scalars], args: Args
) -> tuple[System, Array]:
    """Returns the system, and the efforts less the bias, with sliding friction."""
    args = args._replace(modes=args.modes._replace(direction=jnp.sign(qd)))
    y = tuple(q - args.q0), tuple(qd), *own
    tau, *_ = efforts(t, y, args, schedule_of(t, args))
    system = system_at(t, q, qd, args)
    return system, jnp.stack(minus(tau, system.equations.bias))


def _after_impacts(
    qd: Array, touched: Array, law: Laws, system: System
) -> tuple[Array, Array]:
    """Returns the rates after all impacts, and which joints were hit.

    The fastest joint comes first. After one impact per joint, what is left is stopped
    at once, without restitution.
    """
    joints, moves = jnp.arange(qd.size), ~law.braked
    outward = lambda qd: constant(jnp.where(moves, touched * qd, 0))

    def impact(state, _):
        qd, hit = state
        k = jnp.argmax(outward(qd))
        one = (joints == k) & (outward(qd) > 0)
        e = law.restitution[k]
        column = system.accelerations(one.astype(qd.dtype), law.braked)
        column = column / jnp.where(one.any(), column[k], 1)
        flying = jnp.where(one, -e * qd, qd - (1 + e) * column * qd[k])
        return (jnp.where(one.any(), flying, qd), hit | one), None

    def stop(state, _):
        qd, caught = state
        caught = caught | (outward(qd) > 0)
        return (system.caught(qd, caught | law.braked), caught), None

    none = jnp.zeros(qd.size, bool)
    (qd, hit), _ = jax.lax.scan(impact, (qd, none), length=qd.size)
    (qd, caught), _ = jax.lax.scan(stop, (qd, none), length=qd.size)
    return qd, hit | caught


def _settled(
    qd: Array, touched: Array, law: Laws, system: System, net: Array
) -> tuple[Array, Array]:
    """Returns the rates with joints stopped that bounce too low, and times left out.

    A joint at rest may hold another at its stop, so this repeats once per joint. For
    elastic joints no time is left out. `net`: the efforts less the bias.
    """
    lowest, elastic = jnp.finfo(qd.dtype).eps ** LOW, law.restitution == 1
    loses = jnp.where(elastic, 1, 1 - law.restitution)  # of its rate, at each bounce

    def settle(state, _):
        qd, left_out = state
        rests = law.braked | ((touched != 0) & (constant(qd) == 0))
        towards = touched * system.accelerations(net, rests)
        pulled = (touched * qd < 0) & (towards > 0)
        towards = jnp.where(pulled, towards, 1)
        low = pulled & (constant(qd**2) <= 2 * towards * lowest)
        left_out += jnp.where(low & ~elastic, 2 * jnp.abs(qd) / (towards * loses), 0)
        qd = jnp.where(low.any(), system.caught(qd, rests | low), qd)
        return (qd, left_out), None

    settled, _ = jax.lax.scan(settle, (qd, jnp.zeros_like(qd)), length=qd.size)
    return settled


def _happenings(before: Modes, after: Modes, hit: Array, law: Laws) -> Array:
    """Returns what happens to each joint, -1 if nothing.

    `hit`: whether it hit a stop that does not hold it.
    """
    was, now = before.mode, after.mode
    at_stop = lambda mode: (mode == LOWER) | (mode == UPPER)
    cases = {
        _BOUNCES: hit & (law.restitution > 0),
        _STOPPED: hit,
        -1: was == now,
        _STICKS: now == FRICTION,
        _RESTS: at_stop(now),
        _BRAKED: now == BRAKE,
        _SLIPS: was == FRICTION,
        _LEAVES: at_stop(was),
        _LET_GO: was == BRAKE,
    }
    kinds = [jnp.full(was.shape, kind) for kind in cases]
    return jnp.select([*cases.values()], kinds, -1)


def _after_reset(
    element: Reset, met: Array, t: Array, y: Integrated, args: Args
) -> tuple[Integrated, Array]:
    """Returns the state after a reset, if it is met, and the energy it takes."""
    arm = args.linkage
    name = f"forces[{place_of(element, args.forces)}]"

    def there(y):
        delta, qd, *own = y
        before = args.q0 + jnp.stack(delta), jnp.stack(qd)
        with naming(name):
            after = element.state_after(t, *before, arm)
        q, qd = (without_fixed(arm, value) for value in after)
        qd = jnp.where(within_stops(args.forces, q, arm), qd, jnp.nan)
        masses = args.masses(t)
        energies = (sum(energy(arm, *state, masses)) for state in (before, (q, qd)))
        return (tuple(q - args.q0), tuple(qd), *own), jnp.subtract(*energies)

    return jax.lax.cond(met, there, lambda y: (y, jnp.zeros_like(t)), y)


def _recorded(events: Events, t: Array, kind: Array, first: int = 1) -> Events:
    """Adds to the events what happens to the joints from number `first` on."""
    happens = kind >= 0
    places = (events.count + jnp.cumsum(happens) - 1) % MOST_EVENTS
    places = jnp.where(happens, places.astype(int), MOST_EVENTS)  # dropped
    numbers = first + jnp.arange(kind.size, dtype=float)
    put = lambda rows, new: rows.at[places].set(
        jnp.broadcast_to(new, kind.shape).astype(rows.dtype), mode="drop"
    )
    return Events(
        put(events.t, t),
        put(events.joint, numbers),
        put(events.kind, kind),
        events.count + jnp.sum(happens),
    )


def in_order(events: Events, valid: Array) -> Events:
    """Returns the events in the order of time, NaN beyond the last.

    Invalid inputs have none: theirs belong to stand-in values.
    """
    count = jnp.where(valid, events.count, 0)
    first = jnp.where(count > MOST_EVENTS, count % MOST_EVENTS, 0).astype(int)
    none = jnp.arange(MOST_EVENTS) >= count
    ordered = lambda row: jnp.where(none, jnp.nan, jnp.roll(row, -first))
    t, joint, kind = map(ordered, (events.t, events.joint, events.kind))
    return Events(t, joint, kind, count)
