"""Failures that the fuzzer finds, and a report of the other outcomes."""

import collections
import dataclasses
from typing import Any


class Failure(AssertionError):
    """A wrong answer, a wrong refusal or an error that names nothing."""


@dataclasses.dataclass
class Report:
    """Outcomes of the cases by kind, and the worst ratio of error to bound."""

    outcomes: collections.Counter = dataclasses.field(
        default_factory=collections.Counter
    )
    worst: dict = dataclasses.field(default_factory=dict)
    failures: list = dataclasses.field(default_factory=list)

    def note(self, what: str, value: float, case: Any) -> None:
        if value > self.worst.get(what, (0.0, None))[0]:
            self.worst[what] = (value, case)


def table(report: Report) -> str:
    lines = ["kind           outcome                                   cases"]
    for (kind, outcome), count in sorted(report.outcomes.items()):
        lines.append(f"{kind:<14} {outcome:<40} {count:>6}")
    lines += ["", "worst"]
    for what, (value, _) in sorted(report.worst.items()):
        lines.append(f"{what:<40} {value:.3g}")
    return "\n".join(lines)
