"""`view`: a page that plays motions in a browser, in one file."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from .. import Linkage, Scene, Solution
from .data import page_data
from .motions import motions_of, refusal
from .still import still_picture

_TEMPLATE = Path(__file__).with_name("page.html")
_MOST_NAMED = 5  # motions in the title of the page


@dataclass(frozen=True)
class View:
    """A page that plays motions: its file's `path`, and its text, `html`."""

    path: Path
    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{escape(self.html)}" title="motion" allowfullscreen '
            'style="width:100%;height:700px;border:0"></iframe>'
        )


def view(
    linkage: Linkage | Scene | Mapping[str, Linkage | Scene],
    solution: Solution | Mapping[str, Solution],
    forces: tuple[Any, ...] | Mapping[str, tuple[Any, ...]] | None = None,
    path: str | os.PathLike[str] = "motion.html",
) -> View:
    """Writes a page that plays a motion in any browser, beside its curves over time.

    The page is one file, which needs no network. It draws the arm and what acts on it
    as `drawing.draw_linkage` does, plots positions [rad, m], velocities, efforts and
    energies [J], and marks events and held joints. It interpolates positions linearly.
    Numbers have 32 bits.

    **Arguments:**

    - `solution`: that of one `simulate`, or of one `simulate_sampled`, whose forces are
      `(control, *forces)`; of a failed one, the rows reached are shown. A batch shows
      one member in full, the others as ghosts. A dictionary, title -> solution,
      compares motions.
    - `linkage`, `forces`: those of the simulation, or a `Scene` in place of both. With
      a dictionary of solutions, each may be a dictionary of the same titles; Scenes
      must be in one. A batch of arms needs a batch of motions; its members share their
      forces.
    - `path`: of the file, which is replaced.

    **Returns:** a `View`; last in a notebook's cell, it shows the page.

    **Raises:** ValueError for malformed arguments and a file that cannot be written.

    >>> import fdof_jax as fj
    >>> scene = fj.scenes.fig5()
    >>> motion = fj.simulate(scene, [0, 0.05, 0.1])
    >>> folder = getfixture("tmp_path")
    >>> fj.view(scene, motion, path=folder / "fall.html").path.name
    'fall.html'
    """
    motions = motions_of(linkage, solution, forces)
    if not isinstance(path, str | os.PathLike) or not os.fspath(path):
        raise refusal("path", "the path of a file", path)
    # No text in the data ends the script that holds it.
    data = json.dumps(page_data(motions)).replace("<", "\\u003c")
    title = ", ".join(motion.title for motion in motions[:_MOST_NAMED])
    if len(motions) > _MOST_NAMED:
        title += ", ..."
    html = _TEMPLATE.read_text(encoding="utf-8")
    for name, text in (
        ("title", escape(title)),
        ("still", still_picture(motions[0])),
        ("data", data),
    ):
        html = html.replace(f"<!--{name}-->", text, 1)
    file = Path(path)
    try:
        file.write_text(html, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise refusal("path", "the path of a file that can be written", path) from error
    return View(file, html)
