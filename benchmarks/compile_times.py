"""Times from the start of a process to its first result, and of compilation.

Every sample is a process of its own: without `configure`; with it and an empty folder
for compiled programs; with it and a folder that another process has filled.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import numpy as np

from .first_result import CASES
from .measure import FEWEST, record

PROTOCOL = "compile_times"
PLAIN, EMPTY, FILLED = "without configure", "empty folder", "filled folder"


def _sample(case: str, *folder: str) -> dict[str, float]:
    output = subprocess.run(
        [sys.executable, "-m", "benchmarks.first_result", case, *folder],
        # The worker has configured itself. Precision is the same for all.
        env={**os.environ, "JAX_ENABLE_X64": "1", "XLA_FLAGS": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    if output.returncode:
        raise RuntimeError(output.stderr.strip().splitlines()[-1])
    return json.loads(output.stdout.splitlines()[-1])


def run(quick: bool) -> Iterator[dict]:
    samples = 1 if quick else FEWEST
    for case in list(CASES)[:1] if quick else CASES:
        found: dict[str, list] = {PLAIN: [], EMPTY: [], FILLED: []}
        failure = None
        try:
            for _ in range(samples):
                found[PLAIN].append(_sample(case))
                with tempfile.TemporaryDirectory() as folder:
                    found[EMPTY].append(_sample(case, folder))
                    found[FILLED].append(_sample(case, folder))
        except RuntimeError as error:
            failure = str(error)[:200]
        for how, taken in found.items():
            fields = {"status": "failed", "reason": failure}
            if failure is None:
                times = [sample["first"] for sample in taken]
                low, median, high = np.percentile(times, [25, 50, 75])
                calls = [sample["first"] - sample["imported"] for sample in taken]
                fields = {
                    "times": times,
                    "time_min": min(times),
                    "time_median": median,
                    "time_quartiles": [low, high],
                    "first_calls": calls,
                    "compile_time": np.median(calls),
                    "again": [sample["again"] for sample in taken],
                }
            yield record(protocol=PROTOCOL, problem=case, solver=how, **fields)
