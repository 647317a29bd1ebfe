"""Control in discrete time, with efforts held between samples."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import function, is_traced, real_array, refusal, shown, whole_number
from ..forces.element import Forces, element_of, elements, elements_on
from ..forces.joints import JointEffort
from ..linkage.coordinates import State, real_state
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..steps.landing import Clock, clearance
from .sampler import Arrivals, Sampler
from .simulate import check_elements, simulate
from .solution import Solution
from .vector_field import has_states


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

    The function is pure, batched by `jax.vmap`, and differentiable in everything.

    **Arguments:**

    - `linkage`, `state`: the arm, and its joint positions and velocities.
    - `tau`: joint efforts, (n,) [N or N m]; `dt`: how long they are held [s].
    - `forces`: other force elements, without states of their own; `t`: their time at
      the start [s].
    - `options`: keywords of `simulate`; `throw` is False by default.

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


class _Delay(NamedTuple):
    """A delay in whole periods, at most `most`, and the rest.

    - `whole`: their number, an array if traced; `rest`: time beyond [s], None if 0.
    """

    whole: Array | int
    rest: Array | None
    most: int


def _in_periods(delay: Any, period: Any, samples: int) -> _Delay:
    """Splits a delay into periods, in a motion of so many samples."""
    traced = is_traced(delay, period)
    xp: Any = jnp if traced else np
    delay, period = xp.asarray(delay, float), xp.asarray(period, float)
    rounding = 4 * float(jnp.finfo(jnp.result_type(float)).eps) * delay
    whole = xp.floor((delay + rounding) / period)  # 2.9999999999999996 is 3
    rest = delay - whole * period
    most = samples + 1  # then no command arrives, as with all longer delays
    whole = xp.minimum(whole, most).astype(int)
    if traced:
        rest -= jax.lax.stop_gradient(jnp.minimum(rest, 0))  # of rounding
        return _Delay(whole, jnp.where(delay >= 0, rest, jnp.nan), most)
    rest = jnp.asarray(rest, float) if rest > rounding else None
    return _Delay(int(whole), rest, int(whole))


def _noise(spread: State, key: Any, samples: int) -> Any:
    """Draws noise of the measured state, a row per sample."""

    def drawn(key):
        keys = State(*jax.random.split(key))
        normal = lambda size, key: size * jax.random.normal(key, size.shape)
        return jax.tree.map(normal, spread, keys)

    return jax.vmap(drawn)(jax.random.split(key, samples))


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

    - `linkage`, `state0`, `forces`: as in `simulate`; `t0`: time of the first sample
      [s].
    - `control`: a force element such as a `PDController`, whose effort is held until
      the next sample. A state, such as a `PIDController`'s, takes one Euler step per
      sample.
    - `period`: time between samples [s]; `samples`: their number.
    - `delay`: time from measurement to action [s], possibly longer than a period. The
      effort is zero until the first command acts. At whole numbers of periods,
      derivatives are those of longer delays. Each number of whole periods compiles its
      own program; all traced delays share one. A traced delay below 0 ends the motion
      as not finite.
    - `noise`: standard deviations of the measured positions and velocities (each (n,)
      or one for all), with a `jax.random` `key`.
    - `options`: keywords of `simulate`; `max_steps` is by default 65536 and 64 more per
      sample.

    **Returns:** a `Solution` at the sampling times and the end, with `tau` and
    `acting`. For pictures, tables, `joint_efforts` and `joint_reactions`, its `forces`
    are `(control, *forces)`.

    **Raises:** ValueError for malformed arguments; RuntimeError for a failed solve,
    unless `throw=False`.

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
    samples = whole_number("samples", samples, 1, np.iinfo(np.int32).max)
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
    clock = Clock(t0, every, jnp.asarray(samples))
    times = clock.at(jnp.arange(samples + 1))
    check_elements((control, *forces), linkage, times)
    late = _in_periods(delay, every, samples)
    added = None if spread is None else _noise(spread, key, samples)
    rest, arrivals, within = late.rest, (), False
    if rest is not None:
        within = rest > clearance(times)
        arrivals = (Arrivals(clock._replace(first=t0 + rest)),)
    sampler = Sampler(clock, control, added, rest, late.whole, late.most)
    options = dict(max_steps=65536 + 64 * samples) | options
    acting = *forces, *arrivals, sampler
    motion = simulate(linkage, state0, times, acting, **options)
    assert motion.tau is not None
    tau = motion.tau[:-1]
    none = jnp.zeros((late.most + 1, joints_of(linkage)))
    commands = jnp.concatenate([none, tau, tau[-1:]])
    first = late.most + 1 - late.whole - within
    acting = jax.lax.dynamic_slice_in_dim(commands, first, len(times))
    return dataclasses.replace(motion, tau=tau, acting=acting)
