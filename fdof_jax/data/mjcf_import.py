"""Import of planar chains from MuJoCo's model format (MJCF)."""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ..base.checks import optional_package, refusal
from ..base.user_warnings import warn, without_warning
from ..forces.actuators import Armature
from ..forces.element import Forces
from ..forces.joints import JointDamper
from ..linkage.linkage import Linkage
from ..linkage.topology import MOST_PAIRS

_SLIDE, _HINGE = 2, 3  # MuJoCo's mjtJoint


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
    _refuse_others(model)
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
    found = (JointDamper, model.dof_damping), (Armature, model.dof_armature)
    return linkage, tuple(kind(values) for kind, values in found if values.any())


class _Link(NamedTuple):
    slides: bool  # along `axis`, rather than turns
    axis: complex
    start: complex  # the hinge, or the start of the link before [m]
    center: complex
    mass: float
    inertia: float


def _refuse_others(model: Any) -> None:
    """Raises ValueError for what the library lacks or models differently."""
    refuse = lambda what: ValueError(f"text: expected a planar chain, got {what}.")
    try:
        nonlinear = (
            (model.jnt_stiffnesspoly, "a nonlinear spring"),
            (model.dof_dampingpoly, "nonlinear damping"),
        )
    except AttributeError:  # in older versions of MuJoCo
        nonlinear = ()
    for kind, name in zip(model.jnt_type, _names(model)):
        if kind not in (_HINGE, _SLIDE):
            raise refuse(f"joint {name}, which is neither a hinge nor a slide")
    for values, what in (
        (model.jnt_stiffness, "a spring (instead, add a PDController without kd)"),
        (model.jnt_limited, "a range (instead, add JointStops)"),
        (model.dof_frictionloss, "friction (instead, add a JointFriction)"),
        *nonlinear,
    ):
        for name, value in zip(_names(model), values):
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
    for body in range(1, model.nbody):
        before = model.body_parentid[body]
        if model.body_weldid[body] and before != body - 1 and model.body_weldid[before]:
            raise refuse(f"body {_body(model, body)} on a branch")
    moved = model.body_weldid > 0
    if (model.body_weldid[model.body_parentid[moved]] == 0).sum() > 1:
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
    first_hinge = np.flatnonzero(model.jnt_type == _HINGE)[0]
    normal = data.xaxis[first_hinge]
    gravity = np.array(model.opt.gravity)
    within = gravity - (gravity @ normal) * normal
    size = np.linalg.norm(within)  # the part across the plane moves nothing
    up = -within / size if size > 1e-9 else np.roll(normal, 1)
    if size <= 1e-9:
        size, up = 0.0, up - (up @ normal) * normal
        if np.linalg.norm(up) < 1e-9:
            up = np.cross(normal, [1.0, 0.0, 0.0])
        up = up / np.linalg.norm(up)
    return np.cross(up, normal), up, float(size)


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
