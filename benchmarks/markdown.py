"""Tables and numbers in Markdown."""

from collections.abc import Iterable


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, digits: int = 2) -> str:
    """Formats a number to some digits, with powers of ten only where they help."""
    if value is None or value != value:
        return "-"
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        return f"{float(f'{value:.{digits}g}'):g}"
    return f"{value:.{digits - 1}e}".replace("e-0", "e-").replace("e+0", "e")
