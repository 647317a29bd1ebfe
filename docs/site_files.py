"""Adds files outside of docs/ to the site: a hook of MkDocs."""

import re
from importlib.resources import files as package_files
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ["notebooks/README.md", *sorted(
    path.relative_to(ROOT).as_posix() for path in ROOT.glob("notebooks/*.ipynb")
)]  # fmt: skip
NO_TEXT = 'alt="No description has been provided for this image"'  # nbconvert's


def on_config(config):
    for entry in config.nav:
        if "Notebooks" in entry:
            entry["Notebooks"] = NOTEBOOKS


@event_priority(50)  # before the plugins, one of which takes the notebooks
def on_files(files, config):
    pages = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md"]
    pages += ["CITATION.cff", *NOTEBOOKS]
    pictures = [
        path.relative_to(ROOT).as_posix()
        for path in ROOT.glob("benchmarks/results/*.png")
    ]
    sources = [
        path.relative_to(ROOT).as_posix()
        for path in ROOT.glob("benchmarks/*")
        if path.suffix in {".py", ".c"}
    ]
    mathjax = Path(str(package_files("jupyter_server_mathjax"))) / "static"
    for uri in [*pages, *pictures]:
        files.append(File(uri, str(ROOT), config.site_dir, config.use_directory_urls))
    for uri in sources:  # which the page of the benchmarks links to
        file = File(uri, str(ROOT), config.site_dir, config.use_directory_urls)
        file.inclusion = InclusionLevel.INCLUDED  # although mkdocs.yml leaves out *.py
        files.append(file)
    for path in mathjax.rglob("*"):
        if path.is_file() and "a11y" not in path.parts:
            uri = f"mathjax/{path.relative_to(mathjax).as_posix()}"
            files.append(File.generated(config, uri, abs_src_path=str(path)))


def on_page_markdown(markdown, page, **_):
    """Adapts links to the site, in which the pages of docs/ are at the top."""
    if "/" not in page.file.src_uri:
        markdown = markdown.replace("](../", "](")
    return re.sub(r"(\]\((?:\.\./)*)docs/", r"\1", markdown)


def _with_alternative_text(html):
    """Describes each picture of a notebook by the title of its section."""
    parts = re.split(r"(<h[1-6].*?</h[1-6]>)", html, flags=re.DOTALL)
    for k in range(2, len(parts), 2):
        title = re.sub(r"<.*?>|¶", "", parts[k - 1]).strip()
        parts[k] = parts[k].replace(NO_TEXT, f'alt="Picture: {title}"')
    return "".join(parts)


def on_page_content(html, page, **_):
    """Turns links of notebooks to files into links to their pages."""
    if page.file.src_uri.endswith(".ipynb"):
        html = _with_alternative_text(html)
        html = re.sub(r'(href="(?:\.\./)*)docs/', r"\1", html)
        html = re.sub(r'(href="(?!https?:)[^"]*?)README\.md', r"\1index.html", html)
        html = re.sub(r'(href="(?!https?:)[^"]*?)\.(?:md|ipynb)\b', r"\1.html", html)
    return html
