"""Random arms and states: no silent errors, hangs or crashes.

`python -m tests.hard.fuzz --cases 10000` draws cases of two kinds and prints their
outcomes; `test_fuzz.py` runs 220 in pytest.

A case ends with a named outcome or raises `Failure`. Ill-conditioned arms are judged by
the effect of rounding alone. The oracle computes the bounds at the case, from the sizes
of the terms that a computation in float64 adds up.
"""

import argparse
import collections
import faulthandler
import re
import sys
import time
import warnings
from typing import Any

import hypothesis

import fdof_jax as fj

from .fuzz_accelerations import check_accelerations
from .fuzz_motions import check_motion
from .fuzz_report import Failure, Report, table
from .random_scenes import scenes

SLOWEST = 20.0  # [s] of the processor, compilation included: more counts as a hang
KINDS = {"accelerations": check_accelerations, "motions": check_motion}


def check(kind: str, case: Any, report: Report) -> None:
    """Runs one case; raises `Failure` unless it ends with a named outcome."""
    before = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # arms that may be singular somewhere
        try:
            outcome = KINDS[kind](case, report)
        except Failure:
            raise
        except Exception as error:
            raise Failure(f"{type(error).__name__}: {str(error)[:300]}") from error
    seconds = time.process_time() - before
    report.note(f"seconds, {kind}", seconds, case)
    if seconds > SLOWEST:
        raise Failure(f"took {seconds:.0f} s")
    report.outcomes[kind, outcome] += 1


def run(kind: str, cases: int, report: Report, *, seed: int | None = None) -> None:
    """Draws cases of a kind, always the same ones without a seed; raises failures."""

    def one(case):
        try:
            check(kind, case, report)
        except Failure as failure:
            if seed is None:
                raise  # and let hypothesis find a simpler case
            report.outcomes[kind, "FAILED"] += 1
            report.failures.append((kind, failure, case))

    phases = [hypothesis.Phase.generate]
    drawn = hypothesis.settings(
        max_examples=cases,
        deadline=None,
        database=None,
        derandomize=seed is None,
        phases=phases + [hypothesis.Phase.shrink] * (seed is None),
        suppress_health_check=list(hypothesis.HealthCheck),
    )(hypothesis.given(scenes())(one))
    if seed is not None:
        drawn = hypothesis.seed(seed)(drawn)
    drawn()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, help="only these")
    arguments = parser.parse_args()
    fj.configure(x64=True)
    # A hang in compiled code cannot be interrupted, but it can be shown.
    faulthandler.dump_traceback_later(7200, exit=True)
    report = Report()
    for kind in [arguments.kind] if arguments.kind else KINDS:
        run(kind, arguments.cases // 2, report, seed=arguments.seed)
    print(table(report))
    kinds = collections.defaultdict(list)
    for kind, failure, case in report.failures:
        words = re.sub(r"[^a-zA-Z_. ].*", "", str(failure).partition(":")[2]).split()
        group = kind, str(failure).partition(":")[0], " ".join(words[:4])
        kinds[group].append((len(repr(case)), str(failure), repr(case)))
    for (kind, *_), found in sorted(kinds.items()):
        _, failure, case = min(found)  # the shortest is the easiest to read
        print(f"\n{len(found)} of {kind}: {failure}\n{case}")
    print(f"\n{len(report.failures)} failures")
    return bool(report.failures)


if __name__ == "__main__":
    sys.exit(main())
