"""Control in discrete time, with efforts held constant between samples."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import (
    concrete,
    function,
    is_traced,
    real_array,
    refusal,
    whole_number,
)
from ..forces.element import Element, Forces, ScalarElement, element_of, elements
from ..forces.joints import JointEffort
from ..linkage.coordinates import State, real_state
from ..linkage.linkage import Linkage, check_linkage, joints_of, without_fixed
from .field import initial_states, stateful
from .looped_dopri8 import LoopedDopri8
from .simulate import check_elements, simulate
from .solution import Solution, WithOutcome


class _Switched(ScalarElement):
    """Efforts that switch from one constant to another at a time."""

    before: Float[Array, " joint"]
    after: Float[Array, " joint"]
    switch: Float[Array, ""]

    def schedule(self, t, linkage):
        return tuple(jnp.where(t < self.switch, self.before, self.after))

    def respond(self, scheduled, q, qd, linkage):
        return scheduled

    @property
    def jump_ts(self) -> Array:
        return self.switch[None]


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
    if stateful(elements("forces", forces)):
        raise ValueError(
            "forces: expected elements without a state of their own, which would be "
            "lost (simulate takes such states as own0 and returns them), got "
            f"{forces!r}."
        )
    check_linkage(linkage)
    state = real_state("state", state, linkage)
    dt, t = real_array("dt", dt, (), above=0), real_array("t", t, ())
    ts, acting = jnp.stack([t, t + dt]), (*forces, JointEffort(tau))
    options = dict(throw=False) | options
    solution = simulate(linkage, state, ts, acting, **options)
    return State(solution.q[-1], solution.qd[-1])


class _Held(ScalarElement):
    """The efforts of a sampled motion, each held from its sample to the next."""

    ts: Float[Array, " time"]
    tau: Float[Array, "sample joint"]

    def schedule(self, t, linkage):
        sample = jnp.searchsorted(self.ts[1:-1], t, side="right")
        return tuple(self.tau[sample])

    def respond(self, scheduled, q, qd, linkage):
        return scheduled


class SampledMotion(WithOutcome):
    """A motion under sampled control.

    - `ts`: sampling times, including the end (samples + 1,) [s].
    - `q`, `qd`: joint positions and velocities at `ts`; NaN after a failure.
    - `tau`: efforts commanded at each sample (samples, n), 0 at fixed pairs
      [N or N m].
    - `result`: diffrax's result: `successful`, or that of the first failed period.
      `outcome` states it in words.
    - `own`: the states of the forces' `StatefulElement`s at `ts`.

    Pictures, tables, `joint_efforts` and `joint_reactions` take it as they take a
    `Solution`. Its `forces` are there `(control, *forces)`, the controller first, whose
    efforts are `tau`.
    """

    ts: Float[Array, " time"]
    q: Float[Array, "time joint"]
    qd: Float[Array, "time joint"]
    tau: Float[Array, "sample joint"]
    result: diffrax.RESULTS
    own: tuple[Any, ...]

    def __iter__(self) -> Iterator[Any]:
        """Yields the fields in order; version 0.1 returned a named tuple."""
        return iter([vars(self)[field.name] for field in dataclasses.fields(self)])

    def __getitem__(self, index: Any) -> Any:
        """Returns fields by their places, as of a named tuple."""
        return tuple(self)[index]

    def acting(self, forces: tuple[Element, ...]) -> tuple[Element, ...]:
        """Returns `(control, *forces)` with the held efforts in the first place."""
        if not forces:
            raise ValueError(
                "forces: expected (control, *forces) of a SampledMotion, got ()."
            )
        return _Held(self.ts, self.tau), *forces[1:]


Motion = Solution | SampledMotion


def check_joints(name: str, solution: Any, linkage: Linkage) -> None:
    """Raises ValueError unless it is a motion with the linkage's number of joints."""
    if not isinstance(solution, Motion):
        raise refusal(name, "a Solution or a SampledMotion", solution)
    count = jnp.shape(linkage.ef)[-1] // 2  # of a batch too
    if jnp.shape(solution.q)[-1] != count:
        raise ValueError(
            f"{name}: expected a motion of {count} joints, as the linkage has, got "
            f"positions of shape {jnp.shape(solution.q)}."
        )


def simulate_sampled(
    linkage: Linkage,
    state0: State,
    control: Any,
    period: ArrayLike,
    samples: int,
    forces: Forces = (),
    *,
    t0: ArrayLike = 0.0,
    delay: ArrayLike = 0.0,
    noise: tuple[ArrayLike, ArrayLike] | None = None,
    key: Array | None = None,
    **options: Any,
) -> SampledMotion:
    """Computes a motion under a controller that samples once per period.

    **Arguments:**

    - `linkage`, `state0`: the arm, and its joint positions and velocities.
    - `control`: a force element such as a `PDController`, whose effort is held until
      the next sample. A state, such as a `PIDController`'s, takes one Euler step per
      sample.
    - `period`: time between samples [s]; `samples`: number of samples.
    - `forces`: other force elements.
    - `t0`: time of the first sample [s].
    - `delay`: time from measurement to action, less than a period [s]. The effort is
      zero until the first command acts. A traced delay that is too long ends the motion
      as not finite.
    - `noise`: standard deviations of the measured positions and velocities (each (n,)
      or one for all), with a `jax.random` `key`.
    - `options`: keywords of `simulate`.

    **Returns:** a `SampledMotion`.

    **Raises:** ValueError for malformed arguments.
    """
    check_linkage(linkage)
    forces, n = elements("forces", forces), joints_of(linkage)
    expected = "a callable (t, q, qd, linkage) -> tau"
    control = element_of(function("control", control, expected))
    every = real_array("period", period, (), above=0)
    t0 = real_array("t0", t0, ())
    whole_number("samples", samples, 1)
    late = real_array("delay", delay, (), minimum=0)
    # Within `jax.jit`, arrays made of known numbers are traced.
    known, longest = concrete(delay), concrete(period)
    if known is not None and longest is not None and not known < longest:
        raise ValueError(
            f"delay: expected less than the period of {longest} s, got {known} s."
        )
    if (noise is None) != (key is None):
        raise ValueError("noise, key: expected both or none of them, got one.")
    spread = None
    if noise is not None:
        if not isinstance(noise, tuple | list) or len(noise) != 2:
            raise ValueError(
                "noise: expected a pair of standard deviations, of positions and of "
                f"velocities, got {noise!r}."
            )
        spread = State(
            *(
                real_array(f"noise[{k}]", value, (n,), minimum=0, broadcast=True)
                for k, value in enumerate(noise)
            )
        )
    state0 = real_state("state0", state0, linkage)
    times = t0 + every * jnp.arange(samples + 1)
    check_elements((control, *forces), linkage, times)
    late = None if known is not None and known == 0 else late
    keys = None if key is None else jax.random.split(key, samples)
    options = dict(throw=False) | options
    inputs = linkage, state0, control, times, forces, late, spread, keys
    if options.get("solver") is None and not is_traced(inputs):
        # Traced in `_motion`, `simulate` would take the solver of large batches.
        options["solver"] = LoopedDopri8()
    return _motion(*inputs, options)


@eqx.filter_jit  # not traced anew at each call
def _motion(
    linkage, state0, control, times, forces, delay, spread, keys, options
) -> SampledMotion:
    """Simulates period by period; `delay` and the noise's `spread` may be None."""

    period = times[1] - times[0]

    def one(carry, inputs):
        (state, own), memory, held, result = carry
        begin, end, key = inputs
        seen = state
        if spread is not None:
            seen = jax.tree.map(
                lambda value, size, key: (
                    value + size * jax.random.normal(key, size.shape)
                ),
                *(state, spread, State(*jax.random.split(key))),
            )
        tau, rates = control.act(begin, *seen, linkage, memory)
        tau = without_fixed(linkage, real_array("control", tau, seen.q.shape))
        memory = jax.tree.map(lambda m, rate: m + period * rate, memory, rates)
        effort = (
            JointEffort(tau) if delay is None else _Switched(held, tau, begin + delay)
        )
        acting, two = (*forces, effort), jnp.stack([begin, end])
        solution = simulate(linkage, state, two, acting, own0=own, **options)
        rows = State(solution.q, solution.qd), solution.own
        begun = jax.tree.map(lambda rows: rows[0], rows)
        last = jax.tree.map(lambda rows: rows[-1], rows)
        good = result == diffrax.RESULTS.successful
        result = diffrax.RESULTS.where(good, solution.result, result)
        return (last, memory, tau, result), (begun, tau)

    own0 = initial_states(linkage, forces), control.initial_state(linkage)
    own0, memory0 = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), own0)
    held = jnp.zeros(joints_of(linkage))
    if delay is not None:
        held = jnp.where(delay < period, held, jnp.nan)
    first = jax.tree.map(jnp.asarray, state0), own0
    (last, *_, result), (begun, tau) = jax.lax.scan(
        one,
        (first, memory0, held, diffrax.RESULTS.successful),
        (times[:-1], times[1:], keys),
    )
    rows = lambda begun, last: jnp.concatenate([begun, last[None]])
    (q, qd), own = jax.tree.map(rows, begun, last)
    return SampledMotion(times, q, qd, tau, result, own)
