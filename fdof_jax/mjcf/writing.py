"""Export to MuJoCo's model format (MJCF)."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, SupportsFloat
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from numpy.typing import ArrayLike

from .. import (
    Element,
    JointDamper,
    JointEffort,
    Linkage,
    PDController,
    SpringDamper,
    State,
)
from ..checks import refusal
from ..forces import (
    Armature,
    HardStops,
    JointFriction,
    JointSpring,
    JointStops,
    elements_on,
)
from ..simulation import accepts_scene
from .chain import FAR
from .checks import real_numbers
from .law import Actuators
from .source import Node, child

Number = SupportsFloat  # also an array of one
# MuJoCo rejects smaller masses and inertias of moving bodies (its mjMINVAL).
_SMALLEST = 1e-15
_IN_JOINTS = JointDamper, Armature, JointSpring, JointStops, HardStops, JointFriction
_ACTUATORS = JointEffort, PDController, Actuators
_KINDS = (*_IN_JOINTS, SpringDamper, *_ACTUATORS)
_THICK = 0.02  # radius of the drawn links, over the length of the arm
_COLOURS = "0.2 0.4 0.7 1", "0.8 0.5 0.2 1"  # of links in turn


@accepts_scene
def to_mjcf(
    linkage: Linkage, forces: tuple[Any, ...] = (), state0: State | None = None
) -> str:
    """Writes a linkage and its force elements, or a scene, as a MuJoCo model (MJCF).

    Joints `joint1`, `joint2`, ... are hinges about z and slides in the plane z = 0;
    `qpos` equals `q` without fixed pairs. A site `tip` marks the tip. Nothing collides.
    Masses and inertias below 1e-15 become 1e-15, MuJoCo's least. The model asks for RK4
    with steps of 1 ms.

    A `JointEffort` becomes motors `effort1`, ...; a `SpringDamper` a spatial tendon; a
    `PDController` actuators `position1`, `velocity1`, ..., whose sum the joint limits.
    The key frame `start` has `state0` and the controls at time 0; set `data.ctrl` as a
    moving reference demands. Stops keep their range, but are soft; friction keeps its
    level, but joints that stick creep.

    **Arguments:** `linkage`: one, with known values; `forces`; `state0`: the start.

    **Raises:** ValueError for traced or batched values, and for elements that MuJoCo
    does not have.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> text = fj.to_mjcf(arm, (fj.JointDamper(2.0),))
    >>> text.count('type="hinge"'), text.count('type="slide"'), text.count("damping")
    (2, 1, 3)
    """
    leaves = jax.tree.leaves((linkage, forces))
    traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    if traced or not isinstance(linkage, Linkage) or np.ndim(linkage.ef) != 1:
        raise refusal("linkage", "one Linkage, and known values", linkage)
    length, com, locked = map(np.asarray, (linkage.length, linkage.com, linkage.locked))
    mass = np.maximum(linkage.mass, _SMALLEST)
    inertia = np.maximum(linkage.inertia, _SMALLEST)
    kinds = linkage.topology
    acting = elements_on(linkage, forces)
    _check_elements(linkage, forces, acting)
    attributes = _of_joints(acting, linkage)

    add = ElementTree.SubElement
    root = ElementTree.Element("mujoco", model="linkage")
    add(root, "compiler", angle="radian")
    gravity = _text(0, -linkage.gravity, 0)
    steps = dict(integrator="RK4", timestep="0.001")  # MuJoCo's Euler is far less exact
    add(add(root, "option", steps, gravity=gravity), "flag", contact="disable")
    world = add(root, "worldbody")
    bodies = [add(world, "body", name="ground", quat=_turn(linkage.base_angle))]
    for k, joint in enumerate(kinds):
        side, turn = (locked[k], 0.0) if joint == "R" else (0.0, locked[k])
        place, name = _text(length[k], side, 0), f"link{k + 1}"
        bodies.append(add(bodies[k], "body", name=name, pos=place, quat=_turn(turn)))
        # Joint axes are given in the frame of the moving body.
        axis = (0, 0, 1) if joint == "R" else (np.sin(turn), np.cos(turn), 0)
        own = dict(type="hinge" if joint == "R" else "slide", axis=_text(*axis))
        if joint != "F":
            name = dict(name=f"joint{k + 1}")
            add(bodies[-1], "joint", name | own | attributes[k])
        own = dict(mass=_text(mass[k]), diaginertia=_text(*[inertia[k]] * 3))
        add(bodies[-1], "inertial", dict(pos=_text(*com[k], 0)) | own)
    add(bodies[-1], "site", name="tip", pos=_text(length[-1], 0, 0))
    _draw(root, bodies, kinds, length, locked)
    _add_springs(root, bodies, acting)
    controls, states = _add_actuators(root, linkage, kinds, acting)
    if controls or state0 is not None:
        start = np.zeros((2, len(kinds)))
        if state0 is not None:
            start = real_numbers("state0", state0, start.shape)
        qpos, qvel = (_text(*row) for row in start[:, np.array(list(kinds)) != "F"])
        frame = dict(name="start", qpos=qpos, qvel=qvel, ctrl=_text(*controls))
        frame |= dict(act=_text(*states)) if states else {}
        add(add(root, "keyframe"), "key", frame)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _check_elements(
    linkage: Linkage, forces: tuple[Any, ...], acting: tuple[Element, ...]
) -> None:
    """Raises ValueError for elements that MuJoCo does not have."""
    counts = Counter(map(type, acting))
    for k, element in enumerate(acting):
        name, expected = type(forces[k]).__name__, None
        if type(element) not in _KINDS:  # subclasses compute something else
            expected = "one of " + ", ".join(kind.__name__ for kind in _KINDS)
        elif isinstance(element, SpringDamper):
            element.check(linkage, jnp.zeros(1))
            if element.side and float(element.damping) > 0:
                expected = "no damping of a cable or bumper, which MuJoCo does not have"
        elif isinstance(element, JointFriction) and np.ndim(element.level) != 1:
            expected = "one friction per joint, as MuJoCo has the same both ways"
        elif counts[type(element)] > 1 and type(element) in (*_IN_JOINTS, PDController):
            expected, name = f"one {name}, as a joint of MuJoCo has", "several"
        elif type(element) in _ACTUATORS:
            others = [e for e in acting if e is not element and type(e) in _ACTUATORS]
            limits, _ = _limits_and_acts(element, linkage)
            if any((limits & _limits_and_acts(e, linkage)[1]).any() for e in others):
                expected = "no limit of efforts where others act; MuJoCo limits a sum"
        if expected:
            raise ValueError(f"forces[{k}]: expected {expected}, got {name}.")


def _limits_and_acts(element: Any, linkage: Linkage) -> tuple[np.ndarray, np.ndarray]:
    """In which joints an actuator limits the effort, and acts, (n,)."""
    count = len(linkage.mass)
    if isinstance(element, JointEffort):
        return np.zeros(count, bool), np.asarray(element.tau, bool)
    if isinstance(element, PDController):
        kp, kd, limit = map(np.asarray, (element.kp, element.kd, element.limit))
        acts = ((kp > 0) | (kd > 0)) & (limit > 0)
        return acts & np.isfinite(limit), acts
    *_, bounded = _ends(element.effort_lower, element.effort_upper, count)
    return bounded, np.any(np.asarray(element.gear), axis=0)


def _draw(
    root: Node, bodies: list[Node], kinds: str, length: np.ndarray, locked: np.ndarray
) -> None:
    """Capsules along links and lines along slides, without mass or contacts."""
    add = ElementTree.SubElement
    visual = add(root, "visual")
    add(visual, "global", azimuth="90", elevation="-90")
    reach = float(np.abs(length).sum() + np.abs(locked).sum())
    add(root, "statistic", center="0 0 0", extent=_text(1.2 * max(reach, 1e-3)))
    add(visual, "headlight", ambient="0.5 0.5 0.5", diffuse="0.6 0.6 0.6")
    size = _THICK * max(float(np.abs(length).sum()), 1e-3)
    # A link ends where the next hinge is, or where the next slide begins.
    sides = [locked[k] if kind == "R" else 0.0 for k, kind in enumerate(kinds)]
    for k, (end, side) in enumerate(zip(length, [*sides, 0.0])):
        own = dict(contype="0", conaffinity="0", mass="0", group="1")
        own |= dict(type="sphere", size=_text(size), rgba=_COLOURS[k % 2])
        if abs(end) + abs(side) > 0:
            own |= dict(type="capsule", fromto=_text(0, 0, 0, end, side, 0))
        add(bodies[k], "geom", own)
        if k < len(kinds) and kinds[k] == "P":
            ends = (bodies[k], end, side), (bodies[k + 1], 0, 0)
            line = dict(name=f"slide{k + 1}", width=_text(size / 3))
            _add_spatial(root, line, ends)


def _add_spatial(
    root: Node, attributes: dict[str, str], ends: Iterable[tuple[Node, Number, Number]]
) -> None:
    """A tendon between two places, (body, along, across) each."""
    tendon = ElementTree.SubElement(child(root, "tendon"), "spatial", attributes)
    for letter, (body, along, across) in zip("ab", ends):
        name = f"{attributes['name']}{letter}"
        ElementTree.SubElement(body, "site", name=name, pos=_text(along, across, 0))
        ElementTree.SubElement(tendon, "site", site=name)


def _of_joints(acting: tuple[Element, ...], linkage: Linkage) -> list[dict[str, str]]:
    """Attributes of joints that stand for elements."""
    count = len(linkage.mass)
    joints: list[dict[str, str]] = [{} for _ in range(count)]

    def add(name: str, *columns: ArrayLike, where: ArrayLike = True) -> None:
        for k in np.flatnonzero(np.broadcast_to(where, count)):
            joints[k][name] = _text(*(np.asarray(column)[k] for column in columns))
            if name.endswith("range"):
                joints[k][name.replace("range", "limited")] = "true"

    for element in acting:
        if isinstance(element, JointDamper):
            add("damping", element.coefficient)
        elif isinstance(element, Armature):
            add("armature", element.inertia)
        elif isinstance(element, JointSpring):
            add("stiffness", element.stiffness)
            add("springref", element.rest)
        elif isinstance(element, JointFriction):
            add("frictionloss", element.level)
        elif isinstance(element, JointStops | HardStops):
            low, high, bounded = _ends(element.lower, element.upper, count)
            add("range", low, high, where=bounded)
        elif isinstance(element, PDController):
            bounded, _ = _limits_and_acts(element, linkage)
            add("actuatorfrcrange", -element.limit, element.limit, where=bounded)
        elif isinstance(element, Actuators):
            low, high, bounded = _ends(
                element.effort_lower, element.effort_upper, count
            )
            add("actuatorfrcrange", low, high, where=bounded)
    return joints


def _ends(
    lower: Array | None, upper: Array | None, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both ends of ranges, as MuJoCo takes them, and whether one is finite."""
    low = np.full(count, -np.inf) if lower is None else np.asarray(lower)
    high = np.full(count, np.inf) if upper is None else np.asarray(upper)
    bounded = np.minimum(abs(low), abs(high)) < FAR
    return np.clip(low, -FAR, FAR), np.clip(high, -FAR, FAR), bounded


def _add_springs(root: Node, bodies: list[Node], acting: tuple[Element, ...]) -> None:
    """Springs between points, as tendons between sites."""
    for k, element in enumerate(acting):
        if not isinstance(element, SpringDamper):
            continue
        rest, side = float(element.rest_length), int(element.side or 0)
        ends = {0: (rest, rest), 1: (0.0, rest), -1: (rest, FAR)}[side]  # no force
        attributes = dict(name=f"spring{k}", stiffness=_text(element.stiffness))
        attributes |= dict(damping=_text(element.damping), springlength=_text(*ends))
        points = element.a, element.b
        places = [(bodies[int(p.link)], p.along, p.across) for p in points]
        _add_spatial(root, attributes, places)


def _add_actuators(
    root: Node, linkage: Linkage, kinds: str, acting: tuple[Element, ...]
) -> tuple[list[float], list[float]]:
    """Adds actuators; returns their controls and states at time 0."""
    controls: list[float] = []
    states: list[float] = []
    uses = Counter[str]()

    def unique(name: str) -> str:
        uses[name] += 1
        return name if uses[name] == 1 else f"{name}_{uses[name]}"

    def add(kind: str, name: str, control: Number, **own: str) -> None:
        own = dict(name=unique(name)) | own
        ElementTree.SubElement(child(root, "actuator"), kind, own)
        controls.append(float(control))

    for place, element in enumerate(acting):
        if isinstance(element, JointEffort):
            drives = [each for each in acting if isinstance(each, _ACTUATORS)]
            limits = [_limits_and_acts(each, linkage)[0] for each in drives]
            for k, tau in enumerate(np.asarray(element.tau)):
                if kinds[k] != "F" and not (np.any(limits, axis=0)[k] and tau == 0):
                    add("motor", f"effort{k + 1}", tau, joint=f"joint{k + 1}")
        elif isinstance(element, PDController):
            target, velocity = element.schedule(jnp.zeros(()), linkage)
            rows = zip(*map(np.asarray, (element.kp, element.kd, element.limit)))
            for k, (kp, kd, limit) in enumerate(rows):
                if kinds[k] != "F" and limit != 0:
                    on: Any = dict(joint=f"joint{k + 1}")
                    add("position", f"position{k + 1}", target[k], **on, kp=_text(kp))
                    add("velocity", f"velocity{k + 1}", velocity[k], **on, kv=_text(kd))
        elif isinstance(element, Actuators):
            laws = _general(element, f"forces[{place}]", linkage)
            for number, (gear, attributes, control, start) in enumerate(laws, start=1):
                ratios = {k: gear[k] for k in np.flatnonzero(gear) if kinds[k] != "F"}
                if len(ratios) == 1:
                    ((k, ratio),) = ratios.items()
                    attributes |= dict(joint=f"joint{k + 1}", gear=_text(ratio))
                elif ratios:
                    # A tendon's length is a sum of joint positions.
                    own = dict(name=unique(f"gear{number}"))
                    tendon = ElementTree.SubElement(child(root, "tendon"), "fixed", own)
                    for k, ratio in ratios.items():
                        part = dict(joint=f"joint{k + 1}", coef=_text(ratio))
                        ElementTree.SubElement(tendon, "joint", part)
                    attributes |= dict(tendon=own["name"])
                if ratios:
                    add("general", f"actuator{number}", control, **attributes)
                    states += start
    return controls, states


def _general(
    element: Actuators, place: str, linkage: Linkage
) -> Iterator[tuple[np.ndarray, dict[str, str], float, list[float]]]:
    """Yields gears, attributes, controls and states of general actuators."""
    gears, gains, bias = map(np.asarray, (element.gear, element.gain, element.bias))
    control = np.asarray(element.value_of("control", jnp.zeros(())))
    low, high, bounded = _ends(element.lower, element.upper, len(gears))
    own = element.activation
    for k, gear in enumerate(gears):
        gain, law, attributes, start = gains[k], bias[k].copy(), {}, []
        if bounded[k]:
            ends = _text(low[k], high[k])
            attributes |= dict(forcelimited="true", forcerange=ends)
        if own is not None and not np.any(np.asarray(own.rate)[k]):
            law[0] += float(own.gain[k] * own.start[k])  # a state that stays
        elif own is not None:
            rate = np.asarray(own.rate)[k]
            lag = -rate[1] if rate[1] < 0 else 0.0
            if gain.any() or (rate != [lag or 1, -lag, 0, 0]).any():
                raise ValueError(
                    f"{place}: expected states that follow or integrate their control, "
                    f"as MuJoCo's general actuators have them, got {rate.tolist()}."
                )
            gain = [float(np.asarray(own.gain)[k]), 0.0, 0.0]
            start = [float(np.asarray(own.start)[k])]
            attributes |= dict(dyntype="integrator")
            if lag:
                attributes |= dict(dyntype="filterexact", dynprm=_text(1 / lag))
            bottom, top, within = _ends(own.lower, own.upper, len(gears))
            if within[k]:
                ends = _text(bottom[k], top[k])
                attributes |= dict(actlimited="true", actrange=ends)
        attributes |= dict(gaintype="affine", gainprm=_text(*gain))
        attributes |= dict(biastype="affine", biasprm=_text(*law))
        yield gear, attributes, float(control[k]), start


def _text(*numbers: Number) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _turn(angle: Array | float) -> str:
    """The quaternion of a turn about z."""
    return _text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
