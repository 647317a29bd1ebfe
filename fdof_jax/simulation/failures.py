"""Explains failed motions in words."""

import inspect

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..forces.element import Element, ForeignElement, OwnStates
from ..forces.holders import JointFriction, holders
from ..forces.reset import Reset
from ..linkage.linkage import Linkage, joint_names, moving_joints
from ..mechanics.kinematics import tip_jacobian
from ..steps.derivative_control import linearised
from .formulation import start_of, term_of
from .integrate import Inputs, Settings, last_switched
from .solution import OUTCOMES, Solution
from .solve import solve
from .until import Until
from .vector_field import (
    args_of,
    effort_and_switches,
    element_effort,
    initial_own,
    initial_states,
    with_states,
)

# An explicit method of order 8 is stable for steps up to some 3 to 6 times the time
# scale of a mode. Where accuracy decides, steps are shorter than twice that.
_STABLE = 2.0
# Beyond this condition number of the tip's Jacobian, an effort that inverts it is named
# if it changes by a tenth of itself within so many m or rad.
_NEARLY_SINGULAR, _NEAR = 1e6, 1e-6


def cause(inputs: Inputs, keywords: Settings, solution: Solution) -> str:
    """Returns the known cause of a failed solve, in a sentence."""
    linkage, (q, qd), ts, own0, forces, _ = inputs
    outcome = str(solution.outcome)
    if outcome == "not finite":
        own = own0 or initial_states(linkage, forces)
        for k, element, state in with_states(forces, own):
            effort = element_effort(k, element, ts[0], q, qd, linkage, state)
            if not np.isfinite(effort).all():
                found = f"The effort of forces[{k}] is not finite at the start."
                return found + _of_singular_arm(linkage, q)
    if outcome in ("out of steps", "tolerance out of reach"):
        return _of_steps(inputs, keywords, solution)
    words = _of_joints(linkage, solution)
    if outcome == "not finite" and words.endswith("the state is reset. "):
        return f"{words}Its new values are not finite, or beyond a hard stop."
    if outcome == "too many switches":
        return words + _of_switches(inputs, keywords)
    return words + OUTCOMES[outcome]


def _of_joints(linkage: Linkage, solution: Solution) -> str:
    """Tells what happened last to each joint, within 1e-6 s of the last event."""
    if solution.events is None or not (table := solution.events.table)["joint"].size:
        return ""
    names, times = joint_names(linkage), table["t [s]"]
    recent = times >= times[-1] - 1e-6
    last = dict(zip(table["joint"][recent], table["event"][recent]))
    whose = lambda joint: f"joint {names[joint - 1]}" if joint else "the state"
    happened = (f"{whose(joint)} {event}" for joint, event in last.items())
    return f"Last, {', '.join(happened)}. "


def _of_switches(inputs: Inputs, keywords: Settings) -> str:
    """Names the element and the joint that switch without end, and what helps."""
    linkage, (q, qd), ts, own0, forces, _ = inputs
    names, begin = joint_names(linkage), 0
    switched = np.asarray(eqx.filter_jit(last_switched)(inputs, keywords))
    own = own0 or initial_states(linkage, forces)
    for k, element, state in with_states(forces, own):

        def functions(q, qd, k=k, element=element, state=state):
            at = ts[0], q, qd, linkage, state
            *_, met, _ = effort_and_switches(k, element, *at)
            return np.concatenate([[], *map(np.ravel, met)])

        here = functions(q, qd)
        end = begin + here.size
        one, begin = switched[begin:end], end
        if not one.any():
            continue
        if isinstance(element, Reset):
            return (
                f"forces[{k}] (Reset) resets the state ever faster there, as for a "
                "ball that comes to rest: use HardStops to hold what rests."
            )
        by_rate, by_position = (
            {
                name
                for name, change in zip(names, 1e-3 * np.eye(len(names)))
                if (functions(q + a * change, qd + b * change) != here)[one].any()
            }
            for a, b in ((0, 1), (1, 0))
        )
        joints = by_rate | by_position
        place = f" at joint {min(joints)}" if len(joints) == 1 else ""
        foreign = isinstance(element, ForeignElement)
        kind = type(element.called if foreign else element).__name__
        rubs = len(by_rate) == 1 and not by_position
        sticks = any(isinstance(e, JointFriction) and e.holds for e in forces)
        helps = (
            "JointFriction lets it stick"
            if rubs and not sticks
            else "let the effort change continuously, as by a clipped gain in place of "
            "a sign"
        )
        return (
            f"forces[{k}] ({kind}) chatters there: two branches of its effort{place} "
            f"push towards each other; {helps}."
        )
    what = "Joints are held and let go" if holders(forces) else "Elements switch"
    return f"{what} there without end."


def _of_steps(inputs: Inputs, keywords, solution: Solution) -> str:
    """Compares the steps of a motion with the fastest mode where it stopped."""
    linkage, _, ts, _, forces, _ = inputs
    steps = int(solution.stats["num_steps"])
    covered = float(solution.stats["time_reached"] - ts[0])
    if covered == 0:
        return "No step met the tolerance." + _of_steep_efforts(inputs)
    mean = covered / max(int(solution.stats["num_accepted_steps"]), 1)
    # A little earlier, as rounding may shift the last step.
    share = 1 - 1e3 * float(jnp.finfo(ts.dtype).eps)
    before = jnp.stack([ts[0], ts[0] + share * covered])
    motion, _ = solve(inputs._replace(ts=before), keywords)
    last = jax.tree.map(lambda rows: rows[-1], (motion.q, motion.qd, motion.own))
    fastest = _fastest_mode(linkage, forces, before[-1], *last)
    rate, grows = abs(fastest), fastest.real > abs(fastest) / 2
    implicit = isinstance(keywords["solver"], diffrax.AbstractImplicitSolver)
    if grows and rate * mean > _STABLE:
        return (
            f"There the motion grows by a rate of {rate:.3g}/s, as under a force that "
            "feeds itself. It diverges: more max_steps hardly help."
        )
    if solution.outcome != "out of steps":
        return OUTCOMES[str(solution.outcome)]
    if rate * mean > _STABLE and not implicit:
        return (
            f"A mode of {rate:.3g}/s keeps the steps of an explicit method at "
            f"{mean:.2g} s, whatever the tolerance: such a stiff arm needs an implicit "
            "solver (solver=diffrax.Kvaerno5())."
        )
    needed = float(f"{steps * float(ts[-1] - ts[0]) / covered:.2g}")
    return (
        f"At {mean:.2g} s a step, the whole time takes some {needed:,.0f} steps: "
        "raise max_steps, or loosen the tolerance (rtol, atol)."
    )


def _of_steep_efforts(inputs: Inputs) -> str:
    """Names the element whose effort changes too fast near a singular start."""
    linkage, (q, qd), ts, own0, forces, _ = inputs
    if not (singular := _of_singular_arm(linkage, q)):
        return ""
    own = own0 or initial_states(linkage, forces)
    for k, element, state in with_states(forces, own):
        places = [q, *(q + step for step in _NEAR * np.eye(q.size))]
        here, *beside = (
            np.asarray(element_effort(k, element, ts[0], at, qd, linkage, state))
            for at in places
        )
        if np.abs(np.array(beside) - here).max() > 0.1 * np.abs(here).max():
            return f" The effort of forces[{k}] changes too fast.{singular}"
    return ""


def _of_singular_arm(linkage: Linkage, q: Array) -> str:
    """Returns a sentence if the tip's Jacobian is nearly singular, else nothing."""
    moving = moving_joints(linkage)
    jacobian = np.asarray(tip_jacobian(linkage, q))[: len(moving), moving]
    condition = np.linalg.cond(jacobian)
    if len(moving) < 2 or not condition > _NEARLY_SINGULAR:
        return ""
    return (
        " The tip's Jacobian J is singular there, or nearly (condition number "
        f"{condition:.2g}), as in a straight or folded arm: an effort that inverts J "
        "is unbounded there. The damped inverse, J^T (J J^T + c I)^-1, bounds it."
    )


def _fastest_mode(*scene_and_state: PyTree) -> complex:
    """Returns the fastest eigenvalue of the linearised equations [1/s], or 0."""
    try:
        modes = np.linalg.eigvals(_linearised(*scene_and_state))
    except Exception:  # of a user's function without derivatives, or not finite
        return 0j
    return complex(modes[np.argmax(np.abs(modes))])


@eqx.filter_jit
def _linearised(
    linkage: Linkage, forces: tuple[Element, ...], t: Array, q: Array, qd: Array,
    own: OwnStates | None,
) -> Array:  # fmt: skip
    args, term = args_of(linkage, q, forces), term_of(forces)
    start = start_of(args, qd, initial_own(args, own))
    return linearised(term, t, start, args, term.schedule(t, args))


def check_arguments(forces: tuple[Element, ...]) -> None:
    """Raises TypeError for a plain function with other arguments than an element's."""
    for k, element in enumerate(forces):
        place = "until" if isinstance(element, Until) else f"forces[{k}]"
        functions = {"": element.condition if isinstance(element, Until) else element}
        if isinstance(element, Reset):
            functions = {f".{name}": e for name, e in vars(element).items()}
        for name, one in functions.items():
            if not (isinstance(one, ForeignElement) and inspect.isfunction(one.called)):
                continue
            try:
                inspect.signature(one.called).bind("t", "q", "qd", "linkage")
            except TypeError as error:
                raise TypeError(
                    f"{place}{name}: expected a function (t, q, qd, linkage), got one "
                    f"with other arguments: {error}."
                ) from None
