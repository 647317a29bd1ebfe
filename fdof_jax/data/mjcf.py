"""Export to other engines' model formats."""

from xml.etree import ElementTree

import numpy as np

from ..checks import is_traced
from ..linkage.linkage import Linkage, check_linkage
from ..linkage.topology import letters

# MuJoCo rejects smaller masses and inertias of moving bodies (its mjMINVAL).
_SMALLEST = 1e-15


def to_mjcf(linkage: Linkage) -> str:
    """Exports a linkage as a MuJoCo model (MJCF) with a body for each link.

    Joints `joint1`, `joint2`, ... are hinges about z and slides in the plane z = 0,
    with `qpos` equal to this library's `q` without fixed pairs. A site `tip` marks the
    tip. Nothing collides. Masses and moments of inertia below 1e-15, in particular
    zero, become 1e-15, the smallest that MuJoCo accepts.

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
    length, com, locked = map(np.asarray, (linkage.length, linkage.com, linkage.locked))
    mass = np.maximum(np.asarray(linkage.mass), _SMALLEST)
    inertia = np.maximum(np.asarray(linkage.inertia), _SMALLEST)

    add = ElementTree.SubElement
    root = ElementTree.Element("mujoco", model="linkage")
    add(root, "compiler", angle="radian")
    option = add(root, "option", gravity=_text(0, -float(linkage.gravity), 0))
    add(option, "flag", contact="disable")
    world = add(root, "worldbody")
    body = add(world, "body", name="ground", quat=_turn(float(linkage.base_angle)))
    for k, joint in enumerate(letters(linkage.ef)):
        side, turn = (locked[k], 0.0) if joint == "R" else (0.0, locked[k])
        place = _text(length[k], side, 0)
        body = add(body, "body", name=f"link{k + 1}", pos=place, quat=_turn(turn))
        # Joint axes are given in the frame of the moving body.
        axis = (0, 0, 1) if joint == "R" else (np.sin(turn), np.cos(turn), 0)
        kind = "hinge" if joint == "R" else "slide"
        if joint != "F":
            add(body, "joint", name=f"joint{k + 1}", type=kind, axis=_text(*axis))
        own = dict(mass=_text(mass[k]), diaginertia=_text(*[inertia[k]] * 3))
        add(body, "inertial", dict(pos=_text(*com[k], 0)) | own)
    add(body, "site", name="tip", pos=_text(length[-1], 0, 0))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _text(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _turn(angle: float) -> str:
    """The quaternion of a turn about z."""
    return _text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
