"""Tables for notebooks."""

from collections.abc import Iterable
from html import escape


def html_table(rows: Iterable[Iterable[str]], header: Iterable[str] = ()) -> str:
    """Returns an HTML table; the first cell of each row is its heading."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = ""
    for first, *cells in rows:
        rest = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        body += f"<tr><th>{escape(first)}</th>{rest}</tr>"
    return f"<table><tr>{head}</tr>{body}</table>" if head else f"<table>{body}</table>"
