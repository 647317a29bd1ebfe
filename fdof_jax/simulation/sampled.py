"""Control in discrete time, with efforts held constant between samples."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import function, is_traced, real_array, refusal, shown, whole_number
from ..base.functions import sharing_functions
from ..forces.element import (
    Element,
    Forces,
    ScalarElement,
    element_of,
    elements,
    elements_on,
)
from ..forces.joints import JointEffort
from ..linkage.coordinates import State, real_state
from ..linkage.linkage import Linkage, check_linkage, joints_of, without_fixed
from ..steps.looped_dopri8 import LoopedDopri8
from .field import has_states, initial_states
from .formulation import clear_of_start
from .simulate import check_elements, simulate
from .solution import Solution


class _Held(ScalarElement):
    """Efforts each held until the next one begins to act, and 0 before the first."""

    begin: Float[Array, " sample"]
    tau: Float[Array, "sample joint"]

    def schedule(self, t, linkage):
        count = jnp.searchsorted(self.begin, t, side="right", method="scan_unrolled")
        return tuple(jnp.where(count > 0, self.tau[count - 1], 0))

    def respond(self, scheduled, q, qd, linkage):
        return scheduled

    @property
    def jump_ts(self) -> Array:
        return self.begin


def step(
    linkage: Linkage,
    state: State,
    tau: ArrayLike,
    dt: ArrayLike,
    forces: Forces = (),
    *,
    t: ArrayLike = 0.0,
    **options: Any,
) -> State:
    """Computes the state after a time `dt` under constant efforts `tau`.

    This is the transition of a discrete-time model, for reinforcement learning and
    predictive control: pure, batched by `jax.vmap`, differentiable in everything.

    **Arguments:**

    - `linkage`, `state`: the arm, and its joint positions and velocities.
    - `tau`: joint efforts, (n,) [N or N m]; `dt`: how long they are held [s].
    - `forces`: other force elements, without states of their own; `t`: the time at the
      start, which the elements receive [s].
    - `options`: keywords of `simulate`.

    **Returns:** the `State` at the end; NaN if the solve failed.

    **Raises:** ValueError for malformed arguments.
    """
    check_linkage(linkage)
    if has_states(linkage, elements_on(linkage, forces)):
        raise ValueError(
            "forces: expected elements without a state of their own, which would be "
            "lost (simulate takes such states as own0 and returns them), got "
            f"{shown(forces)}."
        )
    state = real_state("state", state, linkage)
    dt, t = real_array("dt", dt, (), above=0), real_array("t", t, ())
    ts, acting = jnp.stack([t, t + dt]), (*forces, JointEffort(tau))
    options = dict(throw=False) | options
    solution = simulate(linkage, state, ts, acting, **options)
    return State(solution.q[-1], solution.qd[-1])


def acting_in(motion: Solution, forces: tuple[Element, ...]) -> tuple[Element, ...]:
    """Returns the elements that acted: held efforts in the place of a sampled control.

    Raises ValueError if a motion under sampled control comes without its control.
    """
    if motion.acting is None:
        return forces
    if not forces:
        raise refusal("forces", "(control, *forces) of a sampled motion", forces)
    return _Held(motion.ts, motion.acting), *forces[1:]


def check_joints(name: str, solution: object, linkage: Linkage) -> None:
    """Raises ValueError unless it is a motion with the linkage's number of joints."""
    if not isinstance(solution, Solution):
        raise refusal(name, "a Solution", solution)
    count = jnp.shape(linkage.ef)[-1] // 2  # of a batch too
    if jnp.shape(solution.q)[-1] != count:
        raise ValueError(
            f"{name}: expected a motion of {count} joints, as the linkage has, got "
            f"positions of shape {jnp.shape(solution.q)}."
        )


class _Delay(NamedTuple):
    """A delay in periods.

    - `time`: the delay [s].
    - `whole`: number of whole periods, an array where the delay is traced.
    - `rest`: time beyond them [s]; None if it is known to be 0.
    - `most`: upper bound of `whole`.
    """

    time: Array
    whole: Array | int
    rest: Array | None
    most: int


def _in_periods(delay: Any, period: Any, samples: int) -> _Delay:
    """Splits a delay into periods of a motion of so many samples."""
    traced = is_traced(delay, period)
    xp: Any = jnp if traced else np
    delay, period = xp.asarray(delay, float), xp.asarray(period, float)
    time = jnp.asarray(delay, float)
    rounding = 4 * float(jnp.finfo(time.dtype).eps) * delay
    whole = xp.floor((delay + rounding) / period)  # 2.9999999999999996 is 3
    rest = delay - whole * period
    most = samples + 1  # then no command arrives, as with all longer delays
    whole = xp.minimum(whole, most).astype(int)
    if traced:
        return _Delay(time, whole, rest, most)
    rest = jnp.asarray(rest, float) if rest > rounding else None
    return _Delay(time, int(whole), rest, int(whole))


def simulate_sampled(
    linkage: Linkage,
    state0: State,
    control: Callable,
    period: ArrayLike,
    samples: int,
    forces: Forces = (),
    *,
    t0: ArrayLike = 0.0,
    delay: ArrayLike = 0.0,
    noise: tuple[ArrayLike, ArrayLike] | None = None,
    key: Array | None = None,
    **options: Any,
) -> Solution:
    """Computes a motion under a controller that samples once per period.

    **Arguments:**

    - `linkage`, `state0`: the arm, and its joint positions and velocities.
    - `control`: a force element such as a `PDController`, whose effort is held until
      the next sample. A state, such as a `PIDController`'s, takes one Euler step per
      sample.
    - `period`: time between samples [s]; `samples`: number of samples.
    - `forces`: other force elements.
    - `t0`: time of the first sample [s].
    - `delay`: time from measurement to action [s], which may be longer than a period.
      The effort is zero until the first command acts. The motion has a kink where the
      delay is a whole number of periods; derivatives there are those of longer delays.
      Each number of whole periods takes a program of its own, all traced delays take
      one. A traced delay below 0 ends the motion as not finite.
    - `noise`: standard deviations of the measured positions and velocities (each (n,)
      or one for all), with a `jax.random` `key`.
    - `options`: keywords of `simulate`.

    **Returns:** a `Solution` at the sampling times, the end included, with `tau`.
    Pictures, tables, `joint_efforts` and `joint_reactions` take `(control, *forces)` as
    its `forces`, the controller first. The controller's efforts are then those that
    act, 0 before the first command has arrived.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm, start, (pd,), _ = fj.scenes.fig7()
    >>> motion = fj.simulate_sampled(arm, start, pd, 0.01, 4, delay=0.02)
    >>> motion.tau[:, 0].tolist()  # commanded at the samples
    [15.873, 17.236, 18.321, 13.740]
    >>> motion.acting[:, 0].tolist()  # at the samples and the end
    [0.0, 0.0, 15.873, 17.236, 18.321]
    """
    check_linkage(linkage)
    forces, n = elements("forces", forces), joints_of(linkage)
    expected = "a callable (t, q, qd, linkage) -> tau"
    control = element_of(function("control", control, expected))
    every = real_array("period", period, (), above=0)
    t0 = real_array("t0", t0, ())
    whole_number("samples", samples, 1)
    real_array("delay", delay, (), minimum=0)
    if (noise is None) != (key is None):
        raise ValueError("noise, key: expected both or none of them, got one.")
    spread = None
    if noise is not None:
        if not isinstance(noise, tuple | list) or len(noise) != 2:
            pair = "a pair of standard deviations, of positions and of velocities"
            raise refusal("noise", pair, noise)
        spread = State(
            *(
                real_array(f"noise[{k}]", value, (n,), minimum=0, broadcast=True)
                for k, value in enumerate(noise)
            )
        )
    state0 = real_state("state0", state0, linkage)
    times = t0 + every * jnp.arange(samples + 1)
    check_elements((control, *forces), linkage, times)
    late = _in_periods(delay, period, samples)
    keys = None if key is None else jax.random.split(key, samples)
    options = dict(throw=False) | options
    inputs = linkage, state0, control, times, forces, late, spread, keys
    if options.get("solver") is None and not is_traced(inputs):
        # Traced in `_motion`, `simulate` would take the solver of large batches.
        options["solver"] = LoopedDopri8()

    def run(control, forces):
        others = late, spread, keys, options
        return _motion(linkage, state0, control, times, forces, *others)

    return sharing_functions(run, control=control, forces=forces)


@eqx.filter_jit  # not traced anew at each call
def _motion(
    linkage, state0, control, times, forces, late, spread, keys, options
) -> Solution:
    """Simulates period by period; the noise's `spread` may be None."""

    delay, whole, rest, most = late
    period, within = times[1] - times[0], False  # whether commands arrive within it
    if rest is not None:
        # Beside both ends of a period, as output times have to increase, and a jump at
        # the very start of a solve has no derivative.
        edge = clear_of_start(forces, times)
        within = rest > edge
        rest += jax.lax.stop_gradient(jnp.clip(rest, edge, period - edge) - rest)

    def one(carry, inputs):
        (state, own), memory, under_way, held, result = carry
        k, begin, end, key = inputs
        measured = state
        if spread is not None:
            measured = jax.tree.map(
                lambda value, size, key: (
                    value + size * jax.random.normal(key, size.shape)
                ),
                *(state, spread, State(*jax.random.split(key))),
            )
        tau, rates = control.act(begin, *measured, linkage, memory)
        tau = without_fixed(linkage, real_array("control", tau, measured.q.shape))
        memory = jax.tree.map(lambda m, rate: m + period * rate, memory, rates)
        arrives = tau
        if most > 0:  # a ring: shifting all commands may cost as much as the solves
            under_way = under_way.at[k % (most + 1)].set(tau)
            arrives = under_way[(k - whole) % (most + 1)]
        effort, at = JointEffort(arrives), [begin, end]
        if rest is not None:
            start = begin + rest
            begins = jnp.stack([start - period, start])
            effort = _Held(begins, jnp.stack([held, arrives]))
            at.insert(1, start)
        acting = *forces, effort
        solution = simulate(linkage, state, jnp.stack(at), acting, own0=own, **options)
        rows = State(solution.q, solution.qd), solution.own
        starts = jax.tree.map(lambda rows: rows[0], rows)
        last = jax.tree.map(lambda rows: rows[-1], rows)
        good = result == diffrax.RESULTS.successful
        result = diffrax.RESULTS.where(good, solution.result, result)
        q_begin = None if rest is None else jnp.where(within, *solution.q[1:])
        taken = None if solution.taken is None else solution.taken[jnp.array([0, -1])]
        carry = last, memory, under_way, arrives, result
        return carry, (starts, tau, q_begin, taken)

    own0 = initial_states(linkage, forces), control.initial_state(linkage)
    own0, memory0 = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), own0)
    held = jnp.zeros(joints_of(linkage))
    under_way = jnp.zeros((most + 1, held.size)) if most > 0 else None
    if rest is not None:
        held = jnp.where(delay >= 0, held, jnp.nan)
    start = jax.tree.map(jnp.asarray, state0), own0
    (last, *_, result), (starts, tau, q_begin, taken) = jax.lax.scan(
        one,
        (start, memory0, under_way, held, diffrax.RESULTS.successful),
        (jnp.arange(len(times) - 1), times[:-1], times[1:], keys),
    )
    rows = lambda starts, last: jnp.concatenate([starts, last[None]])
    (q, qd), own = jax.tree.map(rows, starts, last)
    acting = jnp.concatenate([tau, tau[-1:]])
    if rest is not None or whole > 0:
        commands = jnp.concatenate([jnp.zeros((most + 1, held.size)), tau, tau[-1:]])
        first = most + 1 - whole - within
        acting = jax.lax.dynamic_slice_in_dim(commands, first, len(times))
    if taken is not None:
        # Each period counts from 0, and its start may bring a blow.
        at_start, in_period = jnp.append(taken, jnp.zeros((1, 2)), axis=0).T
        taken = jnp.cumsum(in_period) - in_period + at_start
    return Solution(
        times, q, qd, {}, result, own,
        taken=taken, tau=tau, acting=acting, q_begin=q_begin,
    )  # fmt: skip
