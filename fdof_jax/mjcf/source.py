"""MuJoCo's compiled model of a text, a file, or a model."""

import copy
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from ..checks import plain, refusal

Model = Any  # a `mujoco.MjModel`, of which type checkers know nothing
Node = ElementTree.Element
_EXPECTED = "an XML text, the path of a file, a mujoco.MjModel or a mujoco.MjSpec"
# MuJoCo reads bare ampersands, and dashes in comments; XML has neither.
_LOOSE = re.compile(r"<!--.*?(?:-->|\Z)|&(?!#?\w+;)", re.DOTALL)
# What is kept of a URDF. MuJoCo does not read others, or makes pictures of them.
_KEPT = {
    "robot": ("mujoco", "link", "joint"),
    "link": ("inertial", "collision"),
    "joint": ("parent", "child", "origin", "axis", "limit", "dynamics"),
}


def compiled_model(mujoco: ModuleType, source: Any) -> tuple[Model, list[str], bool]:
    """Returns a model of its own, remarks on its source, and whether it was a URDF.

    A text may open no files.
    """
    if isinstance(source, mujoco.MjModel):
        return copy.copy(source), [], False
    if isinstance(source, mujoco.MjSpec):
        return _compiled(source.copy().compile), [], False
    if isinstance(source, str) and "<" in source:
        # What was checked is compiled, not the text: parsers differ in what they skip.
        return _of_root(mujoco, _root(source), None)
    named = isinstance(source, str | os.PathLike)
    path = Path(os.path.expanduser(source) if named else "")
    if not os.path.isfile(path):  # which does not raise for any text
        raise refusal("source", f"{_EXPECTED}, and the file to be there", source)
    content = path.read_bytes()
    if b"<robot" in content:
        root = _root(content.decode("utf-8-sig", "replace"))
        if root.tag == "robot":
            return _of_root(mujoco, root, path.parent)
    spec = _compiled(lambda: mujoco.MjSpec.from_file(str(path)))
    remarks = _without_missing_meshes(spec, path.parent)
    return _compiled(spec.compile), remarks, False


def _compiled(compile_model: Callable[[], Any]) -> Any:
    try:
        return compile_model()
    except ValueError as error:
        raise ValueError(
            f"source: expected a model that MuJoCo accepts: {plain(str(error))}"
        ) from None


def _root(text: str) -> Node:
    """Parses as leniently as MuJoCo: prefixes, declared or not, are parts of names."""
    # Lines keep their numbers, for messages.
    strict = lambda found: "&amp;" if found[0] == "&" else "\n" * found[0].count("\n")
    text = _LOOSE.sub(strict, text.strip())
    if "<!ENTITY" in text:
        raise refusal("source", "a model in XML without entities", "<!ENTITY")
    if "<xacro:" in text or "${" in text:
        words = "a model, and not xacro: `xacro arm.xacro > arm.urdf` of ROS expands it"
        raise refusal("source", words, "xacro")
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, ValueError) as error:
        reason = plain(str(error))
        raise ValueError(f"source: expected a model in XML: {reason}.") from None
    return builder.close()


def _of_root(
    mujoco: ModuleType, root: Node, folder: Path | None
) -> tuple[Model, list[str], bool]:
    """A model with the files that it names; without a `folder` it may name none."""
    remarks: list[str] = []
    assets: dict[str, bytes] = {}
    meshes, robot = "", root.tag == "robot"
    if robot:
        remarks = _as_in_ros(root)
        if [*map(int, mujoco.__version__.split(".")[:2])] < [3, 14]:
            raise ImportError("mujoco: expected 3.14 or newer, for inertias of a URDF.")
        compiler = child(child(root, "mujoco"), "compiler")
        own = dict(fusestatic="false")  # keeps names of fixed links
        # MuJoCo rejects less of what moves; this is read as 0.
        own |= dict.fromkeys(("boundmass", "boundinertia"), "1e-15")
        compiler.attrib = own | compiler.attrib
        meshes = compiler.attrib.pop("meshdir", "")
    for part in root.iter():
        for name in [name for name in part.attrib if name.startswith("file")]:
            given = part.attrib[name]
            if folder is None:
                words = "the path of a file, as a text names no other files"
                raise refusal("source", words, given)
            file = _found(folder, meshes, given.removeprefix("package://"))
            if file is not None:  # under a name of its own, as folders are left out
                unique = f"{len(assets)}_{file.name}"
                assets[unique] = file.read_bytes()
                part.set(name, unique)
    root.attrib = {k: v for k, v in root.attrib.items() if not k.startswith("xmlns")}
    try:
        text = ElementTree.tostring(root, encoding="unicode")
    except RecursionError:
        raise ValueError("source: expected a model, got one nested too deep.") from None
    model = _compiled(lambda: mujoco.MjModel.from_xml_string(text, assets))
    return model, remarks, robot


def _found(folder: Path, meshes: str, given: str) -> Path | None:
    """The file that a mesh names, if it is there."""
    inner = folder / meshes
    places = folder / given, inner / given, inner / Path(given).name
    return next(filter(Path.is_file, places), None)


def child(node: Node, tag: str) -> Node:
    """The first child with this tag, made if need be."""
    found = node.find(tag)
    return ElementTree.SubElement(node, tag) if found is None else found


def _without_missing_meshes(spec: Any, folder: Path) -> list[str]:
    """Takes missing meshes out of bodies with given masses; returns remarks."""
    remarks: list[str] = []
    missing = {
        mesh.name or Path(mesh.file).stem: mesh
        for mesh in spec.meshes
        if mesh.file and _found(folder, spec.meshdir, mesh.file) is None
    }
    for body in spec.bodies:
        weighed = body.explicitinertial and spec.compiler.inertiafromgeom != 1  # all
        for geom in body.geoms:
            if weighed and geom.meshname in missing:
                remarks.append(f"left out: mesh {geom.meshname}, which is not there")
                spec.delete(geom)
    for name in missing.keys() - {geom.meshname for geom in spec.geoms}:
        spec.delete(missing[name])
    return list(dict.fromkeys(remarks))


def _as_in_ros(robot: Node) -> list[str]:
    """Makes a URDF one that MuJoCo reads as ROS does; returns remarks."""
    remarks: list[str] = []
    links, joints = robot.findall("link"), robot.findall("joint")
    by_shape = robot.find("mujoco/compiler[@inertiafromgeom='true']") is not None
    for part in (robot, *links, *joints):
        weighed = part.find("inertial") is not None and not by_shape
        for inner in [*part]:
            if inner.tag == "mimic":  # which not all versions of MuJoCo read
                raise ValueError(
                    "source: expected joints that move freely, got joint "
                    f"{part.get('name')}, which mimics joint {inner.get('joint')}."
                )
            shape = inner.find("geometry/*")
            idle = shape is None or (weighed and shape.tag == "mesh")
            if inner.tag not in _KEPT[part.tag] or (inner.tag == "collision" and idle):
                part.remove(inner)
                if inner.tag not in ("visual", "material"):
                    where = f"of {part.tag} {part.get('name')}"
                    remarks.append(f"left out: {inner.tag} {where}")
    for inertial in robot.iter("inertial"):  # without inertia, a point mass
        inertia = child(inertial, "inertia")
        for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
            inertia.attrib.setdefault(name, "0")
    declared = {link.get("name") for link in links}
    for joint in joints:
        for end in ("parent", "child"):
            name = child(joint, end).get("link", "")
            if name in declared:
                continue
            where = f"as {end} of joint {joint.get('name')}"
            if (end, name) != ("parent", "world"):
                raise refusal("source", f"a declared link {where}", name)
            robot.insert(0, ElementTree.Element("link", name=name))
            declared.add(name)
            remarks.append(f"link world added, {where}")
    if any({"velocity", "effort"} & {*limit.attrib} for limit in robot.iter("limit")):
        remarks.append("left out: limits of velocities and efforts")
    return list(dict.fromkeys(remarks))
