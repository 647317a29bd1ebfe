"""Processor time from the start of a process to its first result.

Every sample is a process of its own: without a folder for compiled programs, and with
one that another process has filled.
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


def _sample(case: str, *folder: str) -> dict[str, float]:
    output = subprocess.run(
        [sys.executable, "-m", "benchmarks.first_result", case, *folder],
        # The worker has configured itself.
        env={**os.environ, "XLA_FLAGS": ""},
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
        with tempfile.TemporaryDirectory() as folder:
            new = [_sample(case) for _ in range(samples)]
            _sample(case, folder)
            filled = [_sample(case, folder) for _ in range(samples)]
        for how, taken in (("new", new), ("programs kept", filled)):
            yield record(
                protocol="compile_times", problem=case, solver=how,
                times=[sample["first"] for sample in taken],
                time_median=np.median([sample["first"] for sample in taken]),
                imported=np.median([sample["imported"] for sample in taken]),
                again=np.median([sample["again"] for sample in taken]),
            )  # fmt: skip
