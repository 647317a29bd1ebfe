"""MuJoCo's compiled model of a text, a file, a specification or another model."""

import copy
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

from .checks import plain, refusal

Model = Any  # an `mujoco.MjModel`, of which type checkers know nothing
Node = ElementTree.Element
_EXPECTED = "an XML text, the path of a file, an mujoco.MjModel or an mujoco.MjSpec"
# Parts of a URDF that MuJoCo does not read.
_UNREAD = "transmission", "gazebo", "ros2_control", "safety_controller"


def compiled_model(mujoco: ModuleType, source: Any) -> tuple[Model, list[str]]:
    """Returns a model of its own, and remarks on what was left out of its source.

    A text is read without opening files of the machine; a path finds its own.
    """
    if isinstance(source, mujoco.MjModel):
        return copy.copy(source), []
    if isinstance(source, mujoco.MjSpec):
        return _compiled(source.copy().compile), []
    if isinstance(source, str) and "<" in source:
        # What was checked is compiled, not the text: parsers differ in what they skip.
        return _of_root(mujoco, _root(source), None)
    path = None
    if isinstance(source, str | os.PathLike):
        path = Path(os.path.expanduser(source))
    if path is None or not os.path.isfile(path):  # which does not raise for any text
        raise refusal("source", f"{_EXPECTED}, and the file to be there", source)
    content = path.read_bytes()
    if b"<robot" in content and (root := _root(content)).tag == "robot":
        return _of_root(mujoco, root, path.parent)
    return _compiled(lambda: mujoco.MjModel.from_xml_path(str(path))), []


def _compiled(compile_model: Callable[[], Model]) -> Model:
    try:
        return compile_model()
    except ValueError as error:
        raise ValueError(
            f"source: expected a model that MuJoCo accepts: {plain(str(error))}"
        ) from None


def _root(text: str | bytes) -> Node:
    try:
        return ElementTree.fromstring(text.strip())
    except (ElementTree.ParseError, ValueError) as error:
        reason = plain(str(error))
        raise ValueError(f"source: expected a model in XML: {reason}.") from None


def _of_root(
    mujoco: ModuleType, root: Node, folder: Path | None
) -> tuple[Model, list[str]]:
    """A model; the files that a URDF names in its folder are passed on as bytes.

    Without a `folder`, as of a text, no file may be named.
    """
    remarks: list[str] = []
    assets: dict[str, bytes] = {}
    meshes = ""
    if root.tag == "robot":
        remarks = _without_shapes(root)
        compiler = child(child(root, "mujoco"), "compiler")
        compiler.attrib.setdefault("fusestatic", "false")  # keeps names of fixed links
        meshes = compiler.attrib.pop("meshdir", "")
    for part in root.iter():
        for name in [name for name in part.attrib if name.startswith("file")]:
            given = part.attrib[name]
            if folder is None:
                raise refusal(
                    "source",
                    "the path of the file, as a text has no folder and names no other "
                    "files",
                    given,
                )
            given = given.removeprefix("package://")
            inner = folder / meshes
            places = folder / given, inner / given, inner / Path(given).name
            file = next(filter(Path.is_file, places), None)
            if file is not None:  # under a name of its own, as folders are left out
                unique = f"{len(assets)}_{file.name}"
                assets[unique] = file.read_bytes()
                part.set(name, unique)
    try:
        text = ElementTree.tostring(root, encoding="unicode")
    except RecursionError:
        raise ValueError("source: expected a model, got one nested too deep.") from None
    return _compiled(lambda: mujoco.MjModel.from_xml_string(text, assets)), remarks


def child(node: Node, tag: str) -> Node:
    """The first child with this tag, made if need be."""
    found = node.find(tag)
    return ElementTree.SubElement(node, tag) if found is None else found


def _without_shapes(robot: Node) -> list[str]:
    """Takes shapes out of a URDF that do not decide its masses; returns remarks."""
    remarks = []
    settings = robot.find("mujoco/compiler")
    by_shape = settings is not None and settings.get("inertiafromgeom") == "true"
    for link in robot.iter("link"):
        weighed = link.find("inertial") is not None and not by_shape
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            meshes = next(shape.iter("mesh"), None) is not None
            if shape.tag == "visual" or (weighed and meshes):
                link.remove(shape)
                if meshes:
                    name = link.get("name", "")
                    remarks.append(f"shapes of link {name}, which has its inertia")
    for material in robot.findall("material"):
        robot.remove(material)
    for tag in _UNREAD:
        for part in robot.iter(tag):
            name = part.get("name") or part.get("reference") or ""
            remarks.append(f"{tag} {name}".strip() + ", which MuJoCo does not read")
    if any("velocity" in limit.attrib for limit in robot.iter("limit")):
        remarks.append("limits of velocities")
    return list(dict.fromkeys(remarks))
