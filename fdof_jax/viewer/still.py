"""A still picture of a motion, as SVG, for pages without scripts."""

from html import escape

import numpy as np

from .data import box_of, geometry
from .motions import Motion

_FAINT = (0.15, 0.4, 1.0)  # of the first, the middle and the last row
_MOST = 400  # points of the tip's path


def still_picture(motion: Motion) -> str:
    """Returns the arm at three times, from faint to full, and its tip's path."""
    g = geometry(motion)
    left, low, right, high = box_of(g.points)
    size = max(right - left, high - low, 1e-9)
    pad = 0.06 * size
    digits = 3 - int(np.floor(np.log10(size)))

    def path(points: np.ndarray) -> str:
        pen, words = "M", []
        for x, y in zip(np.real(points) - left, high - np.imag(points)):
            if np.isnan(x):
                pen = "M"
            else:
                words.append(f"{pen}{round(x, digits):g} {round(y, digits):g}")
                pen = "L"
        return "".join(words)

    def stroke(points: np.ndarray, color: str, width: float, more: str = "") -> str:
        return (
            f'<path d="{path(points)}" fill="none" stroke="var(--{color})" '
            f'stroke-width="{width}" vector-effect="non-scaling-stroke" '
            f'stroke-linecap="round" stroke-linejoin="round"{more}/>'
        )

    tips = g.points[f"tip {len(g.kinds)}"][:, 0]
    few = np.linspace(0, len(tips) - 1, min(_MOST, len(tips))).round().astype(int)
    drawn = [stroke(tips[few], "tip", 1.2)]
    rows = np.linspace(0, len(tips) - 1, len(_FAINT)).round().astype(int)
    for row, opacity in zip(rows, _FAINT):
        drawn.append(f'<g opacity="{opacity}">')
        for name, points in g.points.items():
            kind, number = name.split()
            if kind in ("pin", "slider", "tip") and not np.isnan(points[row]).any():
                x, y = points[row, 0].real - left, high - points[row, 0].imag
                fill = "tip" if kind == "tip" else "bg"
                drawn.append(
                    f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{0.012 * size:.3g}" '
                    f'fill="var(--{fill})" stroke="var(--ink)" stroke-width="1.5" '
                    'vector-effect="non-scaling-stroke"/>'
                )
            elif kind == "link":
                color = f"c{(int(number) - 1) % 6}" if number != "0" else "ink"
                drawn.append(stroke(points[row], color, 4 if number != "0" else 1.2))
            elif kind != "mass":
                dashes = ' stroke-dasharray="5 4"' if kind == "commanded" else ""
                drawn.append(stroke(points[row], "ink", 1.2, dashes))
        drawn.append("</g>")
    box = -pad, -pad, right - left + 2 * pad, high - low + 2 * pad
    view_box = " ".join(f"{number:.4g}" for number in box)
    times = motion.solution.ts[[0, motion.rows - 1]]
    words = escape(f"{motion.title}, {times[0]:g} to {times[1]:g} s")
    return (
        f'<svg viewBox="{view_box}" role="img" aria-label="{words}">'
        f"{''.join(drawn)}</svg><p>{words}. It moves where scripts are on.</p>"
    )
