"""Links the library's names in the guides to the reference: a hook of MkDocs."""

import re
from pathlib import Path

_LISTED = sorted(
    (
        entry
        for page in Path(__file__).parent.glob("api/*.md")
        for entry in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)
    ),
    key=len,
    reverse=True,
)
# A name alone is that of the shortest entry: `mass_matrix` is not `paper.mass_matrix`.
ENTRIES = {entry.removeprefix("fdof_jax."): entry for entry in _LISTED}
ENTRIES |= {entry.rpartition(".")[2]: entry for entry in _LISTED}
_ROOMS = "|".join({entry.split(".")[-2] for entry in _LISTED})
# Code such as fj.tune(...) or Solution.outcome, if it begins no heading and no link.
_NAME = re.compile(
    rf'(?<!">)<code>(?:fj\.)?(?:(?:{_ROOMS})\.)??({"|".join(ENTRIES)})'
    r"(?:\.\w+|\([^<()]*\))?</code>"
)


def on_page_content(html, page, **_):
    """Makes a link of each public name; entries of the reference stay as they are."""
    if page.file.src_uri.startswith("api/"):
        return html
    return _NAME.sub(
        lambda found: f'<autoref identifier="{ENTRIES[found[1]]}">{found[0]}</autoref>',
        html,
    )
