"""The motions of a page: one, several by title, or those of a batch."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import Linkage, Scene, Solution
from ..checks import check_known, instance, refusal
from ..forces import elements_on


class Motion(NamedTuple):
    """A motion of one arm, up to its last finite row."""

    title: str
    linkage: Linkage
    solution: Any  # a Solution, in NumPy
    forces: tuple[Any, ...]
    rows: int


def motions_of(linkage: Any, solution: Any, forces: Any) -> list[Motion]:
    """Returns the motions to show, or raises ValueError."""
    given = {"linkage": linkage, "solution": solution, "forces": forces}
    if not isinstance(solution, Mapping):
        for name in "linkage", "forces":
            if isinstance(given[name], Mapping):
                expected = "no dictionary beside a single solution"
                raise refusal(name, expected, given[name])
        return _members("", given, "")
    if isinstance(linkage, Scene):  # whose forces need not be those of all solutions
        expected = "a dictionary of Scenes, as the solutions are in one"
        raise refusal("linkage", expected, linkage)
    if not solution:
        raise refusal("solution", "at least one motion", solution)
    for name, value in given.items():
        if isinstance(value, Mapping) and value.keys() != solution.keys():
            expected = f"the titles of the motions, {[*solution]}"
            raise refusal(name, expected, [*value])
    found = []
    for title in solution:
        if not isinstance(title, str):
            raise refusal("solution", "titles that are texts", title)
        own = {
            name: value[title] if isinstance(value, Mapping) else value
            for name, value in given.items()
        }
        found += _members(title, own, f"[{ascii(title)}]")
    return found


def _members(title: str, given: dict[str, Any], place: str) -> list[Motion]:
    """Returns a motion, or those of a batch; `place` is for messages."""
    scene, forces = given["linkage"], given["forces"]
    if isinstance(scene, Scene):
        if forces is not None:
            raise refusal("forces", "none beside a Scene, which has its own", forces)
        given = given | {"linkage": scene.linkage, "forces": scene.forces}
    elif forces is None:
        given = given | {"forces": ()}
    for name, kind in ("linkage", Linkage), ("solution", Solution):
        instance(name + place, given[name], kind)
        check_known(name + place, given[name])
    linkage, solution = jax.device_get((given["linkage"], given["solution"]))
    batch, joints = np.shape(solution.q)[:-2], np.shape(linkage.ef)[-1] // 2
    if np.ndim(solution.q) < 2 or np.shape(solution.q)[-1] != joints:
        expected = f"a motion of {joints} joints, as the linkage has"
        raise refusal("solution" + place, expected, solution)
    if np.shape(linkage.ef)[:-1] not in ((), batch):
        expected = f"one arm, or a batch of shape {batch}, as the motions are"
        raise refusal("linkage" + place, expected, linkage)
    found = []
    for index in np.ndindex(batch):
        arm = linkage if np.ndim(linkage.ef) == 1 else _at(index, batch, linkage)
        one = _at(index, batch, solution)
        finite = np.isfinite(one.q).all(axis=1)
        member = "member " + ", ".join(map(str, index)) if batch else ""
        words = ": ".join(filter(None, (title, member))) or f"{arm.topology} arm"
        found.append(Motion(words, arm, one, given["forces"], int(finite.sum())))
    found = [motion for motion in found if motion.rows]
    if not found:
        raise refusal("solution" + place, "at least one finite row", solution)
    if batch:
        try:
            elements_on(found[0].linkage, given["forces"])
        except ValueError as error:
            hint = "All members are drawn with one set of forces."
            raise ValueError(f"{error} {hint}") from error
    return found


def _at(index: tuple[int, ...], batch: tuple[int, ...], tree: Any) -> Any:
    """Returns a member; what has no batch axes is common to all."""
    has = lambda leaf: batch and np.shape(leaf)[: len(batch)] == batch
    return jax.tree.map(lambda leaf: leaf[index] if has(leaf) else leaf, tree)
