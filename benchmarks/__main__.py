"""Measures speed against error: `python -m benchmarks`.

Each job runs in a process of its own, one after the other. Their results are kept as
JSON lines, from which the page is drawn; it takes those of one commit only.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import page
from .worker import JOBS

FOLDER = Path(__file__).parent
RESULTS, PAGE = FOLDER / "results", FOLDER / "README.md"


def main() -> None:
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="small sizes and few rounds: 5 minutes"
    )
    names = ", ".join(job.name for job in JOBS)
    parser.add_argument("--only", default="", help=f"jobs, by commas: {names}")
    parser.add_argument(
        "--output", type=Path,
        help="folder for results and pictures; by default benchmarks/results, with "
        "--quick fdof-output/benchmarks",
    )  # fmt: skip
    parser.add_argument(
        "--beside", metavar="PYTHON",
        help="another environment, whose first results stand beside this one's",
    )  # fmt: skip
    parser.add_argument(
        "--render", action="store_true", help="measure nothing, draw what is there"
    )
    options = parser.parse_args()
    names = [name for name in options.only.split(",") if name]
    if unknown := set(names) - {job.name for job in JOBS}:
        parser.error(f"--only: unknown {', '.join(sorted(unknown))}")
    quick = Path("fdof-output") / "benchmarks"
    output = options.output or (quick if options.quick else RESULTS)
    output.mkdir(parents=True, exist_ok=True)
    failed = []
    for job in () if options.render else JOBS:
        if not (job.name in names if names else job.cpu):
            continue
        began = time.perf_counter()
        file = (output / f"{job.name}.jsonl").resolve()
        file.unlink(missing_ok=True)
        beside = [options.beside] * bool(options.beside and job.name == "compile_times")
        for python in (sys.executable, *beside):
            command = [python, "-m", "benchmarks.worker", job.name, str(file)]
            command += ["--quick"] * options.quick
            with tempfile.TemporaryDirectory() as cache:
                # heyoka would take its programs from those of an earlier run.
                env = {**os.environ, "XDG_CACHE_HOME": cache}
                done = subprocess.run(command, cwd=FOLDER.parent, env=env, check=False)
            if done.returncode:
                failed.append(job.name)
        print(f"{job.name}: {time.perf_counter() - began:.0f} s", flush=True)
    points = load(output)
    if output.resolve() == RESULTS.resolve() and not names:
        PAGE.write_text(page.filled(PAGE.read_text(), page.texts(points)))
    else:
        for name, rows in points.items():
            if rows and (name in names or not names):
                print(f"\n{name}\n\n{page.CLAIMS[name](rows)}")
    page.pictures(points, output)
    if failed:
        sys.exit(f"did not finish: {', '.join(failed)}")


def load(folder: Path) -> dict[str, list[dict]]:
    """Returns the points of each measured job, by the job's name."""
    points = {}
    for job in JOBS:
        file = folder / f"{job.name}.jsonl"
        if file.exists():
            points[job.name] = list(map(json.loads, file.read_text().splitlines()))
    return points


if __name__ == "__main__":
    main()
