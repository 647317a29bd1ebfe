"""Links the library's names in the guides to the reference: a hook of MkDocs."""

import re
from pathlib import Path

ENTRIES = {
    entry.rpartition(".")[2]: entry
    for page in Path(__file__).parent.glob("api/*.md")
    for entry in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)
}
_ROOMS = "|".join({entry.split(".")[-2] for entry in ENTRIES.values()})
# Code such as fj.tune(...) or Solution.outcome, if it begins no heading and no link.
_NAME = re.compile(
    rf'(?<!">)<code>(?:fj\.)?(?:(?:{_ROOMS})\.)?({"|".join(ENTRIES)})'
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
