"""The results of a simulation: motions, with their outcomes."""

import itertools
from collections.abc import Iterable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from ..base.checks import is_traced, known, refusal
from ..base.report import html_table
from ..forces.element import OwnStates
from ..linkage.linkage import Linkage
from ..linkage.topology import rate_unit
from ..steps.tolerances import SINGLE_TOLERANCE, TOLERANCE
from .until import End

Statistics = dict[str, Any]  # arrays by name, and diffrax's `max_steps`

# In the order of `outcome_numbers`: what an outcome means, and what helps.
OUTCOMES = {
    "successful": "",
    "ill-conditioned": "The mass matrix is singular there, or nearly so (see "
    "inertia_ratios).",
    "not finite": "The accelerations are not finite there, for instance because a "
    "reference is out of reach (references.reach_margin says by how much).",
    "out of steps": "All max_steps were taken before the end.",
    "tolerance out of reach": "Not even the shortest step meets the tolerance, because "
    "of rounding or of an effort that jumps there (forces.switch makes steps end at "
    "jumps).",
    "too many switches": "Elements switch there without end, as between branches that "
    "push towards each other: let joints stick by a JointFriction, or let the effort "
    "change continuously, as by a clipped gain in place of a sign.",
    "solver failed": "The method itself failed.",
}

# Modes of a joint, in the order of their numbers: free, or held by what.
MODES = "free", "friction", "lower stop", "upper stop", "brake"
# What happens to a joint, in the order of its number.
HAPPENINGS = (
    "sticks", "slips", "bounces", "rests on its stop", "leaves its stop",
    "is braked", "is let go", "is stopped", "is reset",
)  # fmt: skip
_MOST_SHOWN = 8  # events in a line
# Slower crossings are near to grazing, where no derivative exists.
SLOW = 0.01


def flags(words: Iterable[str]) -> dict[str, list[int] | str]:
    """Attributes of stored numbers that say what each means (CF conventions)."""
    meanings = [word.replace(" ", "_") for word in words]
    values = [*range(len(meanings))]
    return {"flag_values": values, "flag_meanings": " ".join(meanings)}


def attributes_in(unit: str) -> dict[str, dict[str, Any]]:
    """Returns names and units of a solution's arrays, from the joints' unit."""
    named = lambda name, unit: {"long_name": name, "units": unit}
    return {
        "q": named("joint position", unit),
        "qd": named("joint velocity", rate_unit(unit)),
        "modes": {"long_name": "what holds the joint"} | flags(MODES),
        "taken": named("energy taken by what holds joints", "J"),
        "num_steps": named("number of steps", "1"),
        "time_reached": named("time reached", "s"),
    }


def outcome_numbers(result: diffrax.RESULTS) -> Array | np.ndarray:
    """Returns the places of results in `OUTCOMES`, in NumPy unless traced."""
    results = diffrax.RESULTS
    ordered = (
        results.successful, results.singular, results.nonfinite,
        results.max_steps_reached, results.dt_min_reached, results.max_steps_rejected,
    )  # fmt: skip
    xp = jnp if is_traced(result) else np
    cases = [xp.asarray(result == one) for one in ordered]
    return xp.select(cases, [*range(len(cases))], default=len(cases))


class Events(eqx.Module):
    """The last 64 events of joints that elements hold: when, where and what.

    - `t`: times [s]; `joint`: numbers of joints, from 1, or 0 for a reset of the state;
      `kind`: codes of the words in `table`. All are NaN beyond the last event.
    - `count`: number of all events, as a float.
    - `table`: the events as columns. An event is one of: sticks, slips, bounces, rests
      on its stop, leaves its stop, is braked, is let go, is stopped, is reset.
    """

    t: Float[Array, " event"]
    joint: Float[Array, " event"]
    kind: Float[Array, " event"]
    count: Float[Array, ""]

    @property
    def table(self) -> dict[str, np.ndarray]:
        """A dictionary of the columns "t [s]", "joint" and "event".

        For a batch, the first column, "motion", is the motion's place in it.
        """
        t, joint, kind = map(np.asarray, (self.t, self.joint, self.kind))
        there = np.isfinite(t)
        words = np.array(HAPPENINGS)[kind[there].astype(int)]
        columns = {"t [s]": t[there], "joint": joint[there].astype(int), "event": words}
        batch = np.nonzero(there)[:-1]
        return dict(zip(("motion",), batch)) | columns

    def __repr__(self) -> str:
        if is_traced(self.count) or np.ndim(self.count):
            return super().__repr__()
        rows = zip(*self.table.values())
        words = [
            f"{t:.4g} s: {f'joint {joint}' if joint else 'the state'} {event}"
            for t, joint, event in itertools.islice(rows, _MOST_SHOWN)
        ]
        more = [] if self.count <= len(words) else ["..."]
        return f"Events({'; '.join([f'{self.count:.0f} events', *words, *more])})"


class Solution(eqx.Module):
    """A simulated motion, with its statistics and outcome.

    - `ts`: output times [s].
    - `q`, `qd`: joint positions [m or rad] and velocities at `ts`, the first after any
      impacts at the start; NaN after a failure.
    - `stats`: diffrax's statistics, such as `num_steps`, `time_reached` [s], and those
      below.
    - `result`: diffrax's result, one per trajectory; `outcome` states it in words.
    - `own`: states of the `StatefulElement`s, in the order of the forces, each like its
      `initial_state` with a leading time axis.

    In `stats`:

    - `accuracy`, of adaptive steps: the rounding unit (2.2e-16 in float64) over the
      least of the `inertia_ratios` at the steps. Relative errors of accelerations are
      of this order, and larger in joints that accelerate less than others or where
      efforts cancel. Steps do not chase errors below it.
    - `num_switches`, with elements that switch, and `slowest_crossing`: the least speed
      at which a switching function passed its zero, relative to its size in the step,
      or to the speed at which it would turn back at its size. Near 0 a contact grazes,
      and the motion has no derivative.
    - `one_sided`, if efforts jump at switches: the number of places where derivatives
      may hold on one side only, because the motion starts on a switch or meets two at
      once.

    With elements that hold joints (`JointFriction`, `HardStops`, `Brake`), a `Payload`
    or a `Reset`, else None:

    - `modes`: what holds each joint at `ts`: 0 nothing, 1 friction, 2 its lower stop, 3
      its upper stop, 4 a brake. At an event, `modes` and `qd` are as before or after.
    - `taken`: energy taken up to `ts` by friction, impacts, brakes, resets and the
      catching of payloads [J]. Friction whose level is a function is not counted.
    - `events`: the `Events`, whose times have derivatives.

    With `until`, else None:

    - `end`: the `End` of the motion. Rows after it are NaN.

    After `simulate_sampled`, else None:

    - `tau`: efforts commanded at each sample (samples, n), 0 at fixed pairs [N or N m].
    - `acting`: efforts that act, or begin to act, at `ts` [N or N m].

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> motion.outcome.item(), motion.q.shape, float(motion.stats["time_reached"])
    ('successful', (101, 3), 1.0)
    """

    ts: Float[Array, " time"]
    q: Float[Array, "time joint"]
    qd: Float[Array, "time joint"]
    stats: Statistics
    result: diffrax.RESULTS
    own: OwnStates = ()
    modes: Float[Array, "time joint"] | None = None
    taken: Float[Array, " time"] | None = None
    events: Events | None = None
    tau: Float[Array, "sample joint"] | None = None
    acting: Float[Array, "time joint"] | None = None
    end: End | None = None

    @property
    def states(self) -> tuple[PyTree, ...]:
        """The results that have derivatives in the inputs."""
        joints = self.q, self.qd, self.own, self.taken, self.events
        end = None if self.end is None else self.end[:-1]
        return *joints, self.tau, end

    @property
    def ended(self) -> Array:
        """True for each trajectory that a condition of `until` ended."""
        if self.end is None:
            return jnp.zeros(jnp.shape(self.q)[:-2], bool)
        return self.end.condition >= 0

    @property
    def outcome(self) -> np.ndarray:
        """Outcome of each trajectory in words, an array of the batch's shape.

        - `"successful"`; `"ended"`: successful, up to a condition of `until`.
        - `"ill-conditioned"`: the mass matrix is nearly singular (see
          `inertia_ratios`).
        - `"not finite"`: the accelerations are not finite, for instance if a reference
          is out of reach (see `references.reach_margin`).
        - `"out of steps"`; `"solver failed"`.
        - `"tolerance out of reach"`: even the shortest step misses it, because of
          rounding or of an effort that jumps.
        - `"too many switches"`: endless, as of branches that push towards each other.

        **Raises:** ValueError under JAX's transformations.
        """
        if is_traced(self.result):
            raise ValueError(
                "outcome: expected a computed motion, got a traced one; while tracing, "
                "compare `result`: motion.result == diffrax.RESULTS.successful."
            )
        words = np.asarray(np.array([*OUTCOMES])[outcome_numbers(self.result)])
        return words if self.end is None else np.where(self.ended, "ended", words)

    def __repr__(self) -> str:
        facts = "; ".join(f"{name}: {value}" for name, value in self._facts().items())
        return f"{type(self).__name__}({facts})" if facts else super().__repr__()

    def _repr_html_(self) -> str | None:
        facts = self._facts()
        return html_table(facts.items()) if facts else None

    def _facts(self) -> dict[str, str]:
        """Returns the known facts; none without arrays of a motion."""
        if len(np.shape(self.q)) < 2:
            return {}
        *batch, count, _ = self.q.shape
        motions = " x ".join(map(str, batch)) if batch else "1"
        facts = {"motions": motions, "times": f"{count}"}
        result = isinstance(self.result, diffrax.RESULTS)
        if not result or not known(self.ts, self.result):
            return facts
        ts = np.asarray(self.ts)
        facts["times"] += f", {ts.min():g} to {ts.max():g} s"
        outcomes = zip(*np.unique(self.outcome, return_counts=True))
        facts["outcome"] = ", ".join(
            f"{number} {word}" if batch else word for word, number in outcomes
        )
        if not known(self.stats):
            return facts
        if "num_steps" in self.stats:
            facts["steps"] = _span(self.stats["num_steps"])
        if np.max(self.stats.get("num_switches", 0)) > 0:
            facts["switches"] = _span(self.stats["num_switches"])
        if remarks := _remarks_on_derivatives(self.stats):
            facts["derivatives"] = ", ".join(remarks)
        if known(self.q) and (remark := _remark_on_resolution(np.asarray(self.q))):
            facts["positions"] = remark
        return facts


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


def _span(numbers: ArrayLike) -> str:
    least, most = np.min(numbers), np.max(numbers)
    return f"{least}" if least == most else f"{least} to {most}"


def _remark_on_resolution(q: np.ndarray) -> str | None:
    """Returns how far positions are resolved, if less than by default."""
    largest = np.max(np.abs(q), initial=0, where=np.isfinite(q))
    step = np.spacing(largest)
    if step <= (TOLERANCE if q.dtype == np.float64 else SINGLE_TOLERANCE):
        return None
    return f"up to {largest:.2g} m or rad, resolved to {step:.2g} in {q.dtype}"


def _remarks_on_derivatives(stats: Statistics) -> list[str]:
    words = []
    if np.min(stats.get("slowest_crossing", np.inf)) < SLOW:
        words.append(
            "a switch nearly grazes: derivatives hold in a small neighbourhood only"
        )
    if np.max(stats.get("one_sided", 0)) > 0:
        words.append(
            "efforts jump at the start, or at two switches at once: derivatives may "
            "hold on one side only"
        )
    return words
