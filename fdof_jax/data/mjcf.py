"""Export to other engines' model formats."""

from xml.etree import ElementTree

import numpy as np

from ..checks import is_traced
from ..linkage.linkage import Linkage, check_linkage

# MuJoCo rejects smaller masses and inertias of moving bodies (its mjMINVAL).
_SMALLEST = 1e-15


def to_mjcf(linkage: Linkage) -> str:
    """Exports a linkage as a MuJoCo model (MJCF) of three bodies and three joints.

    Joints `joint1`..`joint3` are hinges about z and slides in the plane z = 0, with
    `qpos` equal to this library's `q`; a site `tip` marks the tip. Nothing collides.
    Masses and moments of inertia below 1e-15, in particular zero, become 1e-15, the
    smallest that MuJoCo accepts.

    **Arguments:** `linkage`: one linkage with concrete values.

    **Returns:** the XML text.

    **Raises:** ValueError for a traced or batched linkage.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> text = fj.to_mjcf(arm)
    >>> text.count('type="hinge"'), text.count('type="slide"')
    (2, 1)
    """
    check_linkage(linkage)
    if is_traced(linkage):
        raise ValueError("linkage: expected concrete values, got traced ones.")
    ef, length, com, locked = (
        np.asarray(a) for a in (linkage.ef, linkage.length, linkage.com, linkage.locked)
    )
    mass = np.maximum(np.asarray(linkage.mass), _SMALLEST)
    inertia = np.maximum(np.asarray(linkage.inertia), _SMALLEST)

    root = ElementTree.Element("mujoco", model="linkage")
    ElementTree.SubElement(root, "compiler", angle="radian")
    option = ElementTree.SubElement(
        root, "option", gravity=_text(0, -float(linkage.gravity), 0)
    )
    ElementTree.SubElement(option, "flag", contact="disable")
    world = ElementTree.SubElement(root, "worldbody")
    parent = ElementTree.SubElement(
        world, "body", name="ground", quat=_turn(float(linkage.base_angle))
    )
    for k in range(3):
        revolute = ef[2 * k + 1] > 0.5
        body = ElementTree.SubElement(
            parent,
            "body",
            name=f"link{k + 1}",
            pos=_text(length[k], locked[k] if revolute else 0, 0),
            quat=_turn(0.0 if revolute else locked[k]),
        )
        # Joint axes are given in the frame of the moving body.
        axis = (0, 0, 1) if revolute else (np.sin(locked[k]), np.cos(locked[k]), 0)
        ElementTree.SubElement(
            body,
            "joint",
            name=f"joint{k + 1}",
            type="hinge" if revolute else "slide",
            axis=_text(*axis),
        )
        ElementTree.SubElement(
            body,
            "inertial",
            pos=_text(*com[k], 0),
            mass=_text(mass[k]),
            diaginertia=_text(*[inertia[k]] * 3),
        )
        parent = body
    ElementTree.SubElement(parent, "site", name="tip", pos=_text(length[3], 0, 0))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _text(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _turn(angle: float) -> str:
    """The quaternion of a turn about z."""
    return _text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
