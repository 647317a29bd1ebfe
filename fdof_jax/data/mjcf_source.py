"""MuJoCo's compiled model of a text, a file, a specification or another model."""

import copy
import os
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..base.checks import plain, refusal

_EXPECTED = "an XML text, the path of a file, an mujoco.MjModel or an mujoco.MjSpec"


def compiled_model(mujoco: Any, source: Any) -> tuple[Any, list[str]]:
    """Returns a model of its own, and remarks on what was left out of its source.

    A text is read without opening files of the machine; a path finds its own.
    """
    if isinstance(source, mujoco.MjModel):
        return copy.copy(source), []
    if isinstance(source, mujoco.MjSpec):
        return _compiled(source.copy().compile), []
    if isinstance(source, str) and "<" in source:
        return _of_text(mujoco, source, None)
    if not isinstance(source, str | os.PathLike):
        raise refusal("source", _EXPECTED, source)
    path = Path(source)
    try:
        path = path.expanduser()
        there = path.is_file()
    except (ValueError, OSError, RuntimeError):  # such as a null byte
        there = False
    if not there:
        raise refusal("source", f"{_EXPECTED}, and the file to be there", str(source))
    text = path.read_text(encoding="utf-8", errors="replace")
    if "<robot" in text:
        return _of_text(mujoco, text, path.parent)
    return _compiled(lambda: mujoco.MjModel.from_xml_path(str(path))), []


def _compiled(compile_model: Any) -> Any:
    try:
        return compile_model()
    except ValueError as error:
        raise ValueError(
            f"source: expected a model that MuJoCo accepts: {plain(str(error))}"
        ) from None


def _of_text(mujoco: Any, text: str, folder: Path | None) -> tuple[Any, list[str]]:
    """A text's model; what it names in a folder is passed on as bytes."""
    try:
        # Also for safety: what this parser refuses, MuJoCo's own might still open.
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(f"source: expected a model in XML: {error}.") from None
    remarks, assets = [], {}
    if root.tag == "robot":
        remarks = _without_shapes(root)
        text = ElementTree.tostring(root, encoding="unicode")
    for part in root.iter():
        for name, value in part.attrib.items():
            if not name.startswith("file"):
                continue
            if folder is None:
                raise ValueError(
                    "source: expected a text that names no other files, as a text has "
                    f"no folder, got {plain(repr(value))}; give the path of the file."
                )
            file = folder / value.removeprefix("package://")
            if file.is_file():
                assets[file.name] = file.read_bytes()
    return _compiled(lambda: mujoco.MjModel.from_xml_string(text, assets)), remarks


def _without_shapes(robot: ElementTree.Element) -> list[str]:
    """Takes shapes out of a URDF that do not decide its masses; returns remarks."""
    remarks = []
    for link in robot.iter("link"):
        weighed = link.find("inertial") is not None
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            meshes = next(shape.iter("mesh"), None) is not None
            if shape.tag == "visual" or (weighed and meshes):
                link.remove(shape)
                if meshes:
                    name = link.get("name", "")
                    remarks.append(f"meshes of link {name}, which has its inertia")
    for transmission in robot.iter("transmission"):
        name = transmission.get("name", "")
        remarks.append(f"transmission {name}, which MuJoCo does not read")
    return list(dict.fromkeys(remarks))
