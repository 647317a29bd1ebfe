"""Text and HTML of results, both from the same rows."""

from collections.abc import Iterable, Sequence
from html import escape
from itertools import zip_longest

import equinox as eqx

Rows = Sequence[Sequence[str]]


class Report(eqx.Module):
    """A result that prints itself: a verdict, a table and remarks.

    A notebook shows it as HTML.
    """

    def _verdict(self) -> list[str]:
        """Returns the lines above the table."""
        return []

    def _rows(self) -> list[list[str]]:
        """Returns the table below its header, which is empty over columns of words."""
        return []

    def _remarks(self) -> list[str]:
        """Returns the lines below the table."""
        return []

    def __str__(self) -> str:
        return "\n".join([*self._verdict(), *_lines(self._rows()), *self._remarks()])

    def _repr_html_(self) -> str:
        above, below = (
            "".join(f"<p>{escape(line)}</p>" for line in lines)
            for lines in (self._verdict(), self._remarks())
        )
        header, *rows = self._rows() or [[]]
        header = header if any(header) else []
        return above + (html_table(rows, header) if rows else "") + below


def _lines(rows: Rows) -> list[str]:
    """Returns rows in columns: words to the left, numbers to the right."""
    columns = list(zip_longest(*rows, fillvalue=""))
    widths = [max(map(len, column)) for column in columns]

    def line(row: Sequence[str]) -> str:
        cells = (
            cell.rjust(width) if column[0] else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns)
        )
        return "  ".join(cells).rstrip()

    return [line(row) for row in rows if row is not rows[0] or any(row)]


def html_table(rows: Iterable[Iterable[str]], header: Iterable[str] = ()) -> str:
    """Returns an HTML table; the first cell of each row is its heading."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = ""
    for first, *cells in rows:
        rest = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        body += f"<tr><th>{escape(first)}</th>{rest}</tr>"
    return f"<table><tr>{head}</tr>{body}</table>" if head else f"<table>{body}</table>"
