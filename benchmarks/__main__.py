"""Measures speed against error: `python -m benchmarks`.

Each protocol runs in a process of its own, one after the other. Their results are kept
as JSON lines, and drawn and tabulated at the end.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from . import page, plots
from .worker import JOBS

FOLDER = Path(__file__).parent
RESULTS, PAGE = FOLDER / "results", FOLDER / "README.md"
# Some jobs are measured with an older version of JAX too, for tables on the same page.
OLDER = RESULTS / "older-jax"


def main() -> None:
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="small sizes and few rounds: minutes"
    )
    parser.add_argument(
        "--only",
        default="",
        help="protocols, separated by commas: " + ", ".join(j.name for j in JOBS),
    )
    parser.add_argument(
        "--output",
        type=Path,
        help="folder for JSON lines, plots and tables; by default benchmarks/results, "
        "with --quick fdof-output/benchmarks",
    )
    parser.add_argument(
        "--render",
        action="store_true",
        help="measure nothing: plots and tables from the JSON lines that are there",
    )
    options = parser.parse_args()
    names = [name for name in options.only.split(",") if name]
    unknown = set(names) - {job.name for job in JOBS}
    if unknown:
        parser.error(f"--only: unknown {', '.join(sorted(unknown))}")
    quick = Path("fdof-output") / "benchmarks"
    output = options.output or (quick if options.quick else RESULTS)
    output.mkdir(parents=True, exist_ok=True)
    failed = []
    for job in () if options.render else JOBS:
        wanted = job.name in names if names else not job.asked
        if not wanted:
            continue
        began = time.perf_counter()
        command = [sys.executable, "-m", "benchmarks.worker", job.name]
        command.append(str((output / f"{job.name}.jsonl").resolve()))
        command += ["--quick"] * options.quick
        if subprocess.run(command, cwd=FOLDER.parent, check=False).returncode:
            failed.append(job.name)
        print(f"{job.name}: {time.perf_counter() - began:.0f} s", flush=True)
    points = load(output)
    plots.draw(points, output)
    tables = page.tables(points)
    (output / "tables.md").write_text(
        "\n\n".join(f"## {name}\n\n{text}" for name, text in tables.items()) + "\n"
    )
    if output.resolve() in (RESULTS.resolve(), OLDER.resolve()) and not options.quick:
        newest, older = load(RESULTS), load(OLDER)
        texts = page.tables(newest)
        for name, text in page.tables(older).items():
            texts[f"{name}-older-jax"] = text
        texts["targets"] = page.reached(newest, older)
        PAGE.write_text(page.filled(PAGE.read_text(), texts))
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
