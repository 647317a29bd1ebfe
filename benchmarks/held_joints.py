"""Joints that are held: against MuJoCo's frictionloss and joint limits, and in sweeps.

MuJoCo's constraints are soft. At each step it is tried with several settings, and the
one of the least error is timed. All have impedances of 0.9999, the most there is, and
direct stiffness and damping: friction stops a joint within a step, and a limit, which
never pulls, has the damping that gives the wanted restitution.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

import fdof_jax as fj
from fdof_jax.forces import HardStops, JointFriction

from .measure import EXACT, Case, Skipped, measure, skipped, worst
from .peers import module
from .problems import chain

PROTOCOL = "held_joints"
GRAVITY, INF = 9.81, np.inf
TOLERANCES = 1e-6, 1e-11  # the second is the default
DEFAULT_STEP = 2e-3  # of MuJoCo [s]
STEPS = 1e-2, 1e-3, 1e-4, 1e-5
INTEGRATORS = "Euler", "implicitfast", "RK4"
NOSLIP = 0, 5  # iterations that correct what softness of friction leaves
TURNS = 0.005, 0.01, 0.02, 0.05, 0.1, 0.2  # of a limit's oscillation in a step [rad]

BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
RISING = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
SLIDING = RISING.replace(gravity=0.0)
HINGE = 'type="hinge" axis="0 -1 0"', "0.5 0 0"
GUIDE = 'type="slide" axis="0 0 1"', "0 0 0"
XML = """<mujoco><compiler angle="radian"/>
<option timestep="{step!r}" gravity="0 0 {gravity!r}" tolerance="1e-14" {option}/>
<worldbody><body><joint {joint}/><inertial pos="{com}" mass="1"
diaginertia="0.08333333333333333 0.08333333333333333 0.08333333333333333"/>
</body></worldbody></mujoco>"""

Errors = tuple[float | None, float | None]


class Scene(NamedTuple):
    """A joint that is held, for both engines.

    - `joint`: MJCF of the joint and its mass centre; `held`: of what holds the joint.
    - `restitution`: of a stop; None for friction.
    - `errors`: returns error and drift of positions and rates at equally spaced times.
    """

    name: str
    linkage: fj.Linkage
    start: float
    end: float
    forces: tuple
    joint: tuple[str, str]
    held: str
    restitution: float | None
    errors: Callable[[np.ndarray, np.ndarray], Errors]


def tops(qd: np.ndarray) -> np.ndarray:
    """Returns the last times before the ends of upward motions, as indices."""
    return np.flatnonzero((qd[:-1] > 0) & (qd[1:] <= 0))


def held_bar(q: np.ndarray, qd: np.ndarray) -> Errors:
    return None, abs(q[-1])


def sprung_slide(q: np.ndarray, qd: np.ndarray) -> Errors:
    """It rests for the second half of the time."""
    rests = q[len(q) // 2]
    return abs(rests - 0.01), abs(q[-1] - rests)


def dropped_mass(q: np.ndarray, qd: np.ndarray) -> Errors:
    """Two rebounds, by their energies, and the place of rest."""
    at = tops(qd)[:2]
    if len(at) < 2:
        return INF, None
    heights = q[at] + qd[at] ** 2 / (2 * GRAVITY)
    return np.abs(heights - [0.25, 0.0625]).max(), abs(q[-1])


def swinging_bar(q: np.ndarray, qd: np.ndarray) -> Errors:
    """It swings back to a place that its energy tells."""
    at = tops(qd)[:1]
    if not len(at):
        return INF, None
    highest = np.arcsin(np.sin(q[at]) + qd[at] ** 2 / (3 * GRAVITY))
    return abs(highest[0] + np.pi / 2 - np.arccos(1 - 0.6**2)), None


LOAD = 1.5 * GRAVITY / 2
SCENES = (
    Scene(
        "level bar, friction", BAR, 0.0, 10.0, (JointFriction(LOAD),), HINGE,
        f'frictionloss="{LOAD}"', None, held_bar,
    ),
    Scene(
        "sprung slide, friction", SLIDING, 0.51, 10.0,
        (JointFriction(2.0), fj.forces.JointSpring(100.0)), GUIDE,
        'stiffness="100" frictionloss="2"', None, sprung_slide,
    ),
    Scene(
        "dropped mass, stop", RISING, 1.0, 2.0,
        (HardStops(0.0, INF, restitution=0.5),), GUIDE,
        'limited="true" range="0 9"', 0.5, dropped_mass,
    ),
    Scene(
        "swinging bar, stop", BAR, 0.0, 2.0,
        (HardStops(-np.pi / 2, INF, restitution=0.6),), HINGE,
        f'limited="true" range="{-np.pi / 2!r} 9"', 0.6, swinging_bar,
    ),
)  # fmt: skip


def own_cases(scene: Scene) -> list[Case]:
    ts = np.linspace(0, scene.end, 201)

    @jax.jit
    def run(start, tolerance):
        return fj.simulate(
            scene.linkage, start, ts, scene.forces, rtol=tolerance, atol=tolerance
        )

    def judge(motion):
        error, drift = scene.errors(*np.array([motion.q, motion.qd])[..., 0])
        return {"error": error, "drift": drift, "steps": motion.stats["num_steps"]}

    start = fj.State(np.array([scene.start]), np.zeros(1))
    return [
        Case("fdof_jax", tolerance, partial(run, start, tolerance), judge)
        for tolerance in TOLERANCES
    ]


def damping_ratio(restitution: float) -> float:
    """Returns that of a contact whose spring and damper never pull.

    It ends at its greatest rate: e = exp(-z (pi - 2 asin z) / sqrt(1 - z^2)).
    """
    z = np.linspace(0, 1, 1_000_001)[:-1]
    e = np.exp(-z * (np.pi - 2 * np.arcsin(z)) / np.sqrt(1 - z**2))
    return float(np.interp(-restitution, -e, z))


def settings(scene: Scene, step: float) -> Iterator[tuple[str, str, str]]:
    """Returns names of settings, and their attributes of options and of the joint."""
    sure = '"0.9999 0.9999 1"'
    for integrator in INTEGRATORS:
        option = f'integrator="{integrator}"'
        if scene.restitution is None:
            # The stiffness counts only for limits; it must not be positive.
            soft = f'solreffriction="-1 {-1 / step!r}" solimpfriction={sure}'
            for count in NOSLIP:
                noslip = f' noslip_iterations="{count}" noslip_tolerance="0"'
                yield f"{integrator}, noslip {count}", option + noslip, soft
        else:
            z = damping_ratio(scene.restitution)
            for turn in TURNS:
                k, b = (turn / step) ** 2, 2 * z * turn / step
                # MuJoCo divides both by the impedance; the stiffness, by its square,
                # is multiplied by it once.
                soft = f'solreflimit="{-0.9999 * k!r} {-0.9999 * b!r}"'
                soft += f" solimplimit={sure}"
                yield f"{integrator}, {turn:g} rad a step", option, soft


def mujoco_run(scene: Scene, step: float, option: str, soft: str) -> Callable[[], Any]:
    mj, rollout = module("mujoco"), module("mujoco.rollout")
    joint, com = scene.joint
    text = XML.format(
        step=step, gravity=-float(scene.linkage.gravity), option=option, com=com,
        joint=f"{joint} {scene.held} {soft}",
    )  # fmt: skip
    model = mj.MjModel.from_xml_string(text)
    data, start = mj.MjData(model), np.array([[0.0, scene.start, 0.0]])
    count = round(scene.end / step)
    return lambda: rollout.rollout(model, data, start, nstep=count)[0][0]


def mujoco_case(scene: Scene, step: float, name: str, option: str, soft: str) -> Case:
    def judge(states):
        error, drift = scene.errors(*states[:, 1:].T)
        return {"error": error, "drift": drift, "steps": len(states)}

    run = mujoco_run(scene, step, option, soft)
    return Case("MuJoCo", step, run, judge, "step", {"how": name})


def mujoco_cases(scene: Scene, steps: tuple[float, ...]) -> Iterator[Case]:
    """Returns MuJoCo with its defaults, and with the best settings for each step."""
    soft = ""
    if scene.restitution is not None:
        soft = f'solreflimit="0.02 {damping_ratio(scene.restitution)!r}"'
    yield mujoco_case(scene, DEFAULT_STEP, "defaults", "", soft)
    for step in steps:
        tried = [mujoco_case(scene, step, *how) for how in settings(scene, step)]
        yield min(tried, key=lambda case: max(EXACT, worst(case.judge(case.run()))))


def chain_cases(members: int, level: float) -> list[Case]:
    """Returns sweeps of chains that come to rest, by friction and by viscous damping.

    Five joints hang from random poses; level and damping are the same numbers.
    """
    arm = chain(5, members).linkage
    poses = np.random.default_rng(1).uniform(-1, 1, (members, 5))
    starts, numbers = fj.State(poses, np.zeros_like(poses)), level * np.arange(5, 0, -1)

    def case(name, element):
        def judge(motions):
            at_rest = (np.asarray(motions.qd[:, -1]) == 0).all(axis=1)
            steps = np.asarray(motions.stats["num_steps"])
            return {
                "error": None, "steps": int(steps.mean()), "most_steps": steps.max(),
                "at_rest": at_rest.mean(),
            }  # fmt: skip

        def run():
            return fj.sweep(arm, starts, np.linspace(0, 30, 4), (element,))

        return Case(name, level, run, judge, "level")

    return [
        case("viscous damping", fj.JointDamper(numbers)),
        case("friction", JointFriction(numbers)),
    ]


def run(quick: bool) -> Iterator[dict]:
    for level in 1.0, 2.0:
        members = 64 if quick else 1000
        yield from measure(
            PROTOCOL, chain_cases(members, level), budget=1 if quick else 25,
            ratio_to="viscous damping", batch=members,
            problem="five joints to rest, by sweep", simulated=30.0,
        )  # fmt: skip
    for scene in SCENES:
        cases = own_cases(scene)
        try:
            cases += mujoco_cases(scene, STEPS[:2] if quick else STEPS)
        except Skipped as reason:
            yield skipped(PROTOCOL, "MuJoCo", str(reason))
        yield from measure(
            PROTOCOL, cases, budget=1 if quick else 8,
            problem=scene.name, simulated=scene.end,
        )  # fmt: skip
