"""The errors of derivatives through switches as a table."""

from .markdown import number, table


def switches_table(points: list[dict]) -> str:
    """Returns a row per scene and tolerance: the largest error and mean steps."""
    ways = list(dict.fromkeys(p["solver"] for p in points))
    rows: dict[tuple, dict[str, dict]] = {}
    for p in points:
        rows.setdefault((p["problem"], p["setting"]), {})[p["solver"]] = p
    body = []
    for (name, tolerance), by in rows.items():
        p = by[ways[0]]
        cells = [number(p[key]) for key in ("batch", "parameters", "switches")]
        for way in ways:
            known = by.get(way, {"error": None, "steps": None})
            cells += [number(known["error"]), number(known["steps"])]
        body.append([name, *cells, number(tolerance)])
    head = ["", "scenes", "parameters", "switches"]
    head += [cell for way in ways for cell in (way, "steps")]
    return table([*head, "tolerance"], body)
