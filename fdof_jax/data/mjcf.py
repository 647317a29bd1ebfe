"""Export to MuJoCo's model format (MJCF)."""

from typing import Any
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np

from ..base.checks import is_traced
from ..control.pd import PDController
from ..forces.actuators import Armature
from ..forces.element import Forces, ForeignElement, elements_on
from ..forces.joints import JointDamper, JointFriction, JointStops
from ..forces.points import SpringDamper
from ..linkage.linkage import Linkage, check_linkage
from ..linkage.topology import letters

# MuJoCo rejects smaller masses and inertias of moving bodies (its mjMINVAL).
_SMALLEST = 1e-15
_FAR = 1e9  # in the place of an infinite end of a range
_KINDS = (JointDamper, Armature, SpringDamper, JointStops, JointFriction, PDController)


def to_mjcf(linkage: Linkage, forces: Forces = ()) -> str:
    """Exports a linkage and its force elements as a MuJoCo model (MJCF).

    Joints `joint1`, `joint2`, ... are hinges about z and slides in the plane z = 0,
    with `qpos` equal to this library's `q` without fixed pairs. A site `tip` marks the
    tip. Nothing collides. Masses and moments of inertia below 1e-15, in particular
    zero, become 1e-15, the smallest that MuJoCo accepts.

    Exported as they are: `JointDamper`, `Armature`, `SpringDamper` (a spatial tendon;
    one-sided ones without damping) and `PDController`. The latter becomes actuators
    `position1`, `velocity1`, ..., whose sum the joint limits. Their controls are the
    reference's positions and velocities: the key frame `start` has those at time 0; set
    `data.ctrl` as a moving reference demands. The model asks for MuJoCo's RK4 with
    steps of 1 ms, as its own default, Euler with 2 ms, is far less exact. MuJoCo has
    other models of stops and friction: of `JointStops` it takes the range alone and
    stops softly by its own `solref`; of `JointFriction` the level alone, and joints
    stick at rest.

    **Arguments:** `linkage`: one linkage with concrete values; `forces`: elements.

    **Returns:** the XML text.

    **Raises:** ValueError for traced or batched values, and for elements that MuJoCo
    does not have.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> text = fj.to_mjcf(arm, (fj.JointDamper(2.0),))
    >>> text.count('type="hinge"'), text.count('type="slide"'), text.count("damping")
    (2, 1, 3)
    """
    check_linkage(linkage)
    if is_traced(linkage, forces):
        raise ValueError("linkage: expected concrete values, got traced ones.")
    length, com, locked = map(np.asarray, (linkage.length, linkage.com, linkage.locked))
    mass = np.maximum(np.asarray(linkage.mass), _SMALLEST)
    inertia = np.maximum(np.asarray(linkage.inertia), _SMALLEST)
    kinds = letters(linkage.ef)
    found = elements_on(linkage, forces)
    _refuse_others(linkage, found)
    attributes = _of_joints(found, len(kinds))

    add = ElementTree.SubElement
    root = ElementTree.Element("mujoco", model="linkage")
    add(root, "compiler", angle="radian")
    gravity = _text(0, -float(linkage.gravity), 0)
    steps = dict(integrator="RK4", timestep="0.001")  # MuJoCo's Euler is far less exact
    option = add(root, "option", steps, gravity=gravity)
    add(option, "flag", contact="disable")
    world = add(root, "worldbody")
    body = add(world, "body", name="ground", quat=_turn(float(linkage.base_angle)))
    bodies = [body]
    for k, joint in enumerate(kinds):
        side, turn = (locked[k], 0.0) if joint == "R" else (0.0, locked[k])
        place = _text(length[k], side, 0)
        body = add(body, "body", name=f"link{k + 1}", pos=place, quat=_turn(turn))
        bodies.append(body)
        # Joint axes are given in the frame of the moving body.
        axis = (0, 0, 1) if joint == "R" else (np.sin(turn), np.cos(turn), 0)
        own = dict(type="hinge" if joint == "R" else "slide", axis=_text(*axis))
        if joint != "F":
            add(body, "joint", dict(name=f"joint{k + 1}") | own | attributes[k])
        own = dict(mass=_text(mass[k]), diaginertia=_text(*[inertia[k]] * 3))
        add(body, "inertial", dict(pos=_text(*com[k], 0)) | own)
    add(body, "site", name="tip", pos=_text(length[-1], 0, 0))
    _add_springs(root, bodies, found)
    for element in found:
        if isinstance(element, PDController):
            _add_control(root, linkage, kinds, element)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _refuse_others(linkage: Linkage, found: tuple[Any, ...]) -> None:
    """Raises ValueError for the elements that MuJoCo does not have."""
    for k, element in enumerate(found):
        name, expected = type(element).__name__, None
        if type(element) not in _KINDS:  # subclasses compute something else
            expected = "one of " + ", ".join(kind.__name__ for kind in _KINDS)
            if isinstance(element, ForeignElement):
                name = type(element.called).__name__
        elif isinstance(element, SpringDamper):
            element.check(linkage, jnp.zeros(1))
            if element.side and float(element.damping) > 0:
                expected = (
                    "no damping of a cable or a bumper, which MuJoCo does not have"
                )
        elif sum(type(other) is type(element) for other in found) > 1:
            expected = f"one {name}, as a joint of MuJoCo has"
        if expected:
            raise ValueError(f"forces[{k}]: expected {expected}, got {name}.")


def _of_joints(found: tuple[Any, ...], count: int) -> list[dict[str, str]]:
    """Attributes of the joints that stand for elements."""
    each = lambda value: np.broadcast_to(value, count).tolist()
    joints: list[dict[str, str]] = [{} for _ in range(count)]
    for element in found:
        values: dict[str, Any] = {}
        if isinstance(element, JointDamper):
            values["damping"] = each(element.coefficient)
        elif isinstance(element, Armature):
            values["armature"] = each(element.inertia)
        elif isinstance(element, JointFriction):
            values["frictionloss"] = each(element.level)
        elif isinstance(element, JointStops):
            ends = np.clip([each(element.lower), each(element.upper)], -_FAR, _FAR)
            values["range"] = [e if np.abs(e).min() < _FAR else None for e in ends.T]
        elif isinstance(element, PDController):
            values["actuatorfrcrange"] = [
                (-x, x) if 0 < x < np.inf else None for x in each(element.limit)
            ]
        for name, rows in values.items():
            for joint, row in zip(joints, rows):
                if row is not None:
                    joint[name] = _text(*np.ravel(row))
                if row is not None and name.endswith("range"):
                    limited = {"range": "limited"}.get(name, "actuatorfrclimited")
                    joint[limited] = "true"
    return joints


def _add_springs(root: Any, bodies: list[Any], found: tuple[Any, ...]) -> None:
    """Springs between points, as tendons between sites."""
    springs = [(k, e) for k, e in enumerate(found) if isinstance(e, SpringDamper)]
    if not springs:
        return
    tendons = ElementTree.SubElement(root, "tendon")
    for k, element in springs:
        rest, side = float(element.rest_length), int(element.side or 0)
        ends = {0: (rest, rest), 1: (0.0, rest), -1: (rest, _FAR)}[side]  # no force
        tendon = ElementTree.SubElement(
            tendons, "spatial", name=f"spring{k}", stiffness=_text(element.stiffness),
            damping=_text(element.damping), springlength=_text(*ends),
        )  # fmt: skip
        for end, point in (("a", element.a), ("b", element.b)):
            place = _text(point.along, point.across, 0)
            site = dict(name=f"spring{k}{end}", pos=place)
            ElementTree.SubElement(bodies[int(point.link)], "site", site)
            ElementTree.SubElement(tendon, "site", site=site["name"])


def _add_control(root: Any, linkage: Linkage, kinds: str, pd: PDController) -> None:
    """Actuators of a PD controller, and the key frame of its reference at time 0."""
    actuators = ElementTree.SubElement(root, "actuator")
    target, velocity = pd.schedule(jnp.zeros(()), linkage)
    rows = np.broadcast_arrays(pd.kp, pd.kd, pd.limit, np.zeros(len(kinds)))[:3]
    controls = []
    for k, (kp, kd, limit) in enumerate(zip(*rows)):
        if kinds[k] == "F" or limit == 0:
            continue
        for kind, gain in (("position", {"kp": kp}), ("velocity", {"kv": kd})):
            own = {name: _text(value) for name, value in gain.items()}
            own |= dict(name=f"{kind}{k + 1}", joint=f"joint{k + 1}")
            ElementTree.SubElement(actuators, kind, own)
        controls += [target[k], velocity[k]]
    frames = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(frames, "key", name="start", ctrl=_text(*controls))


def _text(*numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _turn(angle: float) -> str:
    """The quaternion of a turn about z."""
    return _text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
