"""Export to MuJoCo's model format (MJCF), and import of planar chains from it."""

from itertools import combinations
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np

from ..base.checks import is_traced, optional_package, refusal
from ..base.user_warnings import warn, without_warning
from ..control.pd import PDController
from ..forces.actuators import Armature
from ..forces.element import Forces, ForeignElement, elements_on
from ..forces.joints import JointDamper, JointFriction, JointStops
from ..forces.points import SpringDamper
from ..linkage.linkage import Linkage, check_linkage
from ..linkage.topology import MOST_PAIRS, letters

# MuJoCo rejects smaller masses and inertias of moving bodies (its mjMINVAL).
_SMALLEST = 1e-15
_FAR = 1e9  # in the place of an infinite end of a range
_SLIDE, _HINGE = 2, 3  # MuJoCo's mjtJoint
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
    mass = np.maximum(linkage.mass, _SMALLEST)
    inertia = np.maximum(linkage.inertia, _SMALLEST)
    kinds, acting = letters(linkage.ef), elements_on(linkage, forces)
    _check_elements(linkage, acting)
    attributes = _of_joints(acting, len(kinds))

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
    springs = {k: e for k, e in enumerate(acting) if isinstance(e, SpringDamper)}
    if springs:
        _add_springs(add(root, "tendon"), bodies, springs)
    for element in acting:
        if isinstance(element, PDController):
            _add_control(root, linkage, kinds, element)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _check_elements(linkage: Linkage, acting: tuple[Any, ...]) -> None:
    """Raises ValueError for elements that MuJoCo does not have."""
    for k, element in enumerate(acting):
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
        elif sum(type(other) is type(element) for other in acting) > 1:
            expected = f"one {name}, as a joint of MuJoCo has"
        if expected:
            raise ValueError(f"forces[{k}]: expected {expected}, got {name}.")


def _of_joints(acting: tuple[Any, ...], count: int) -> list[dict[str, str]]:
    """Attributes of the joints that stand for elements."""
    joints: list[dict[str, str]] = [{} for _ in range(count)]

    def add(name: str, *columns: Any, where: Any = True) -> None:
        columns = np.broadcast_arrays(*columns, where, np.zeros(count))[:-1]
        for joint, (*values, there) in zip(joints, zip(*columns)):
            if there:
                joint[name] = _text(*values)
                if name.endswith("range"):
                    joint[name.replace("range", "limited")] = "true"

    for element in acting:
        if isinstance(element, JointDamper):
            add("damping", element.coefficient)
        elif isinstance(element, Armature):
            add("armature", element.inertia)
        elif isinstance(element, JointFriction):
            add("frictionloss", element.level)
        elif isinstance(element, JointStops):
            low, high = (
                np.clip(e, -_FAR, _FAR) for e in (element.lower, element.upper)
            )
            add("range", low, high, where=np.minimum(abs(low), abs(high)) < _FAR)
        elif isinstance(element, PDController):
            limit = np.asarray(element.limit)
            add("actuatorfrcrange", -limit, limit, where=(0 < limit) & (limit < np.inf))
    return joints


def _add_springs(tendons: Any, bodies: list[Any], springs: dict[int, Any]) -> None:
    """Springs between points, as tendons between sites."""
    for k, element in springs.items():
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
        for kind, gain, value in (("position", "kp", kp), ("velocity", "kv", kd)):
            own = dict(name=f"{kind}{k + 1}", joint=f"joint{k + 1}")
            ElementTree.SubElement(actuators, kind, {gain: _text(value)} | own)
        controls += [target[k], velocity[k]]
    frames = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(frames, "key", name="start", ctrl=_text(*controls))


def _text(*numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _turn(angle: Any) -> str:
    """The quaternion of a turn about z."""
    return _text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))


def from_mjcf(text: str) -> tuple[Linkage, Forces]:
    """Reads a planar chain of hinges and slides from a MuJoCo model (MJCF).

    The plane is seen from where the hinges' axes point, with gravity downwards; `q`
    equals `qpos`. Gravity across the plane has no effect. A body with several joints
    becomes as many links, all but the last without mass. A site `tip` on the last body,
    or on one welded to it, becomes the tip; without one, the tip is the last joint.
    MuJoCo reads the model, which needs `pip install "fdof_jax[test]"`.

    Contacts are left out, with a warning if geoms of two bodies may collide. Such a
    model is not refused, because geoms may collide by default, and most arms move
    without contacts. `<flag contact="disable"/>` avoids the warning.

    An arm written by `to_mjcf` moves alike when it is read again, but its numbers may
    differ: a fixed length may be split otherwise between a link and the slide next to
    it. Springs, stops, friction and controllers that `to_mjcf` writes are refused here.

    **Arguments:** `text`: the XML text itself, not the name of a file.

    **Returns:** the linkage, and its `JointDamper` and `Armature` if it has any.

    **Raises:** ValueError for what a planar chain does not have (branches, other
    joints, axes out of the plane), for a site `tip` on another body, for springs,
    ranges, friction and nonlinear damping of joints, and for actuators, tendons,
    equality constraints, fluids and `gravcomp`.

    >>> import fdof_jax as fj
    >>> arm, forces = fj.from_mjcf('''
    ... <mujoco><worldbody><body><joint axis="0 1 0" damping="2"/>
    ... <geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/></body></worldbody>
    ... </mujoco>''')
    >>> arm.com.shape, forces[0].coefficient.tolist()
    ((1, 2), [2.0])
    """
    mujoco = optional_package("mujoco", "test")
    if not isinstance(text, str) or "<" not in text:
        raise refusal("text", "the XML text of a model, not a file's name", text)
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"text: expected a MuJoCo model in XML: {reason}") from None
    _check_planar_chain(model)
    kinds = mujoco.mjtDisableBit.__members__
    disabled = {kind for kind in kinds if model.opt.disableflags & kinds[kind]}
    if "mjDSBL_GRAVITY" in disabled:
        model.opt.gravity[:] = 0
    if disabled & {"mjDSBL_DAMPER", "mjDSBL_PASSIVE"}:  # in newer and older versions
        model.dof_damping[:] = 0
    colliding = _colliding(model)
    if colliding and "mjDSBL_CONTACT" not in disabled:
        warn(
            f"text: contacts are left out, but bodies {colliding} of this model may "
            "collide."
        )
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

    e1, e2, gravity = _plane(model, data)
    plane = lambda vector: complex(vector @ e1, vector @ e2)
    links = _links(model, data, plane, np.cross(e1, e2))
    tip = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tip")
    end = links[-1].start
    if tip >= 0:
        body, end = model.site_bodyid[tip], plane(data.site_xpos[tip])
        if model.body_weldid[body] != model.jnt_bodyid[-1]:
            raise ValueError(
                "text: expected the site tip on the last body that moves or on one "
                f"welded to it, got it on body {_body(model, body)}."
            )
    # MuJoCo does not have links without mass.
    with without_warning("moves no inertia of link"):
        linkage = _linkage(links, end, gravity)
    parts = (JointDamper, model.dof_damping), (Armature, model.dof_armature)
    return linkage, tuple(kind(values) for kind, values in parts if values.any())


class _Link(NamedTuple):
    slides: bool  # along `axis`, rather than turns
    axis: complex
    start: complex  # the hinge, or the start of the link before [m]
    center: complex
    mass: float
    inertia: float


def _check_planar_chain(model: Any) -> None:
    """Raises ValueError for what the library lacks or models differently."""
    refuse = lambda what: ValueError(f"text: expected a planar chain, got {what}.")
    for kind, name in zip(model.jnt_type, _names(model)):
        if kind not in (_HINGE, _SLIDE):
            raise refuse(f"joint {name}, which is neither a hinge nor a slide")
    for part, what in {
        "jnt_stiffness": "a spring (instead, add a PDController without kd)",
        "jnt_limited": "a range (instead, add JointStops)",
        "dof_frictionloss": "friction (instead, add a JointFriction)",
        "jnt_stiffnesspoly": "a nonlinear spring",  # absent from older versions
        "dof_dampingpoly": "nonlinear damping",
    }.items():
        for name, value in zip(_names(model), getattr(model, part, ())):
            if np.any(value):
                raise refuse(f"joint {name} with {what}")
    if model.njnt > MOST_PAIRS:
        raise refuse(f"{model.njnt} joints, above {MOST_PAIRS}")
    for count, what in (
        (model.nu, "actuators (instead, add force elements, such as a PDController)"),
        (model.ntendon, "tendons"),
        (model.neq, "equality constraints"),
        (model.opt.density, "a fluid (density)"),
        (model.opt.viscosity, "a fluid (viscosity)"),
    ):
        if count:
            raise refuse(what)
    for body in np.flatnonzero(model.body_gravcomp):
        raise refuse(f"body {_body(model, body)} with gravcomp")
    if not model.njnt or _HINGE not in model.jnt_type:
        raise refuse("no hinge")
    welded, before = model.body_weldid, model.body_parentid
    for body in np.flatnonzero((welded > 0) & (welded[before] > 0)):
        if before[body] != body - 1:
            raise refuse(f"body {_body(model, body)} on a branch")
    if ((welded > 0) & (welded[before] == 0)).sum() > 1:
        raise refuse("several chains")


def _names(model: Any) -> list[str]:
    return [model.joint(k).name or str(k) for k in range(model.njnt)]


def _body(model: Any, body: Any) -> str:
    return model.body(body).name or str(body)


def _colliding(model: Any) -> str | None:
    """Names two bodies whose geoms may collide in MuJoCo, if any.

    Geoms of bodies that are welded together, or next to each other in the chain, do
    not; the moving bodies next to the ground may collide with it.
    """
    name = lambda geom: _body(model, model.geom_bodyid[geom])
    named = lambda i, j: f"{name(i)} and {name(j)}"
    if model.npair:
        return named(model.pair_geom1[0], model.pair_geom2[0])
    welded, before = model.body_weldid, model.body_weldid[model.body_parentid]
    for i, j in combinations(range(model.ngeom), 2):
        bodies = model.geom_bodyid[[i, j]]  # in ascending order, as the geoms are
        a, b = welded[bodies]
        next_to = (a and before[b] == a) or (b and before[a] == b)
        kinds = model.geom_contype[[i, j]] & model.geom_conaffinity[[j, i]]
        excluded = (bodies[0] << 16) + bodies[1] in model.exclude_signature
        if a != b and not next_to and kinds.any() and not excluded:
            return named(i, j)
    return None


def _plane(model: Any, data: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Unit vectors to the right and upwards, and gravity [m/s^2]."""
    normal = data.xaxis[np.flatnonzero(model.jnt_type == _HINGE)[0]]
    within = lambda vector: vector - (vector @ normal) * normal
    gravity = np.linalg.norm(within(model.opt.gravity))  # what is across moves nothing
    # Without gravity, some direction in the plane is upwards.
    for vector in (-model.opt.gravity, np.roll(normal, 1), np.cross(normal, [1, 0, 0])):
        up = within(vector)
        if (size := np.linalg.norm(up)) > 1e-9:
            break
    up = up / size
    return np.cross(up, normal), up, float(gravity) if gravity > 1e-9 else 0.0


def _links(model: Any, data: Any, plane: Any, normal: np.ndarray) -> list[_Link]:
    """The link after each joint, in the plane, at joint positions 0."""
    links, start = [], 0j
    for k, name in enumerate(_names(model)):
        slides = model.jnt_type[k] == _SLIDE
        axis, across = data.xaxis[k], data.xaxis[k] @ normal
        if abs(across - (0 if slides else 1)) > 1e-9:
            where = "in the plane" if slides else "along the first hinge's"
            if across < -1 + 1e-9 and not slides:
                where += ", got the opposite: reverse it, and the signs of its numbers"
            else:
                angle = np.arcsin(across) if slides else np.arccos(across)
                where += f", got one {abs(angle):.2g} rad off"
            raise ValueError(f"text: expected the axis of joint {name} {where}.")
        if not slides:
            start = plane(data.xanchor[k])
        body = model.jnt_bodyid[k]
        last = k + 1 == model.njnt or model.jnt_bodyid[k + 1] != body
        center, mass, inertia = start, 0.0, 0.0
        if last:  # with all bodies welded to it
            welded = np.flatnonzero(model.body_weldid == body)
            masses = model.body_mass[welded]
            places = np.array([plane(data.xipos[b]) for b in welded])
            mass = float(masses.sum())
            center = complex(masses @ places / mass)
            turned = data.ximat[welded].reshape(-1, 3, 3)
            own = (turned.transpose(0, 2, 1) @ normal) ** 2 * model.body_inertia[welded]
            inertia = float(own.sum() + masses @ np.abs(places - center) ** 2)
        links.append(_Link(slides, plane(axis), start, center, mass, inertia))
    return links


def _linkage(links: list[_Link], end: complex, gravity: float) -> Linkage:
    """The linkage with `q` = 0 where the links are.

    A link before a slide is at right angles to it; all others are parallel to the next
    one, so that positions of hinges are 0 there.
    """
    turns = [float(np.angle(end - links[-1].start))]
    for link in reversed(links):
        turns.append(float(np.angle(-1j * link.axis)) if link.slides else turns[-1])
    turns.reverse()  # of the ground and the links
    starts = [0j, *(link.start for link in links), end]
    steps = np.diff(starts) * np.exp(-1j * np.array(turns))
    offsets = [
        (link.center - link.start) * np.exp(-1j * turn)
        for link, turn in zip(links, turns[1:])
    ]
    slides = [link.slides for link in links]
    return Linkage(
        "".join("P" if slide else "R" for slide in slides),
        length=steps.real,
        com=np.column_stack([np.real(offsets), np.imag(offsets)]),
        mass=[link.mass for link in links],
        inertia=[link.inertia for link in links],
        locked=np.where(slides, np.diff(turns), steps.imag[:-1]),
        base_angle=turns[0],
        gravity=gravity,
    )
