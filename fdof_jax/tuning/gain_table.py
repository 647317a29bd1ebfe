"""Printed tables of gains: rows of a label, up to four numbers and a remark."""

from collections.abc import Iterable
from html import escape

from ..base.html_table import html_table


def gain_rows(table: dict[str, list]) -> list[list[str]]:
    """Returns a header and a row per gain of a `TuneResult.table`."""
    rows = [["", "start", "tuned", "least", "greatest", ""]]
    for gain, joint, unit, *values, held in zip(*table.values()):
        cells = [f"{value:.5g}" for value in values]
        mark = "at its bound" if held else ""
        rows.append([f"{gain} of {joint} [{unit}]", *cells, mark])
    return rows


def as_text(rows: list[list[str]], remarks: Iterable[str]) -> str:
    """Returns rows and the remarks below them in columns."""
    lines = [
        f"{label:24}" + "".join(f"{cell:>12}" for cell in cells) + f"  {mark}"
        for label, *cells, mark in rows
    ]
    return "\n".join([*map(str.rstrip, lines), *remarks])


def as_html(rows: list[list[str]], remarks: Iterable[str]) -> str:
    """Returns rows as an HTML table, and the remarks as paragraphs."""
    header, *others = rows
    below = "".join(f"<p>{escape(remark)}</p>" for remark in remarks)
    return html_table(others, header) + below
