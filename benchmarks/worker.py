"""Runs one protocol in its own process, pinned to cores before JAX has threads."""

import argparse
import importlib
import json
import math
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple


class Job(NamedTuple):
    """A measurement of a process: a function of a module, and a number of cores."""

    name: str
    module: str = ""  # by default of the same name
    function: str = "run"
    cores: int = 1
    x64: bool = True
    cpu: bool = True  # others run only when named


JOBS = (
    Job("batches"),
    Job("cores", "batches", "run_two_cores", cores=2),
    Job("joints"),
    Job("single_arms"),
    Job("gradients"),
    Job("switches"),
    Job("held_joints"),
    Job("hard_cases"),
    Job("compile_times"),
    Job("gpu", "batches", "run_accelerator", cpu=False),
    Job("gpu-float32", "batches", "run_accelerator", x64=False, cpu=False),
)


def _plain(value: Any) -> Any:
    """Returns valid JSON: NumPy numbers as numbers, NaN and infinity as null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("job", choices=[job.name for job in JOBS])
    parser.add_argument("output", type=Path, help="JSON lines, to which this adds")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    job = next(job for job in JOBS if job.name == options.job)
    available = sorted(os.sched_getaffinity(0))
    # A GPU's host threads are not measured, so they keep their cores.
    if job.cpu:
        os.sched_setaffinity(0, available[: job.cores])
        os.environ["JAX_PLATFORMS"] = "cpu"
    import fdof_jax as fj

    fj.configure(x64=job.x64)
    # Each export warns of masses at an arm's own joints, which Fig 5 has.
    warnings.filterwarnings("ignore", module="fdof_jax")
    from .measure import skipped

    if job.cpu and len(available) < job.cores:
        points = [skipped(job.name, job.name, f"needs {job.cores} cores")]
    else:
        module = importlib.import_module(f"benchmarks.{job.module or job.name}")
        points = getattr(module, job.function)(options.quick)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with options.output.open("a") as file:
        for point in points:
            point = {"job": job.name, **point}
            file.write(json.dumps(_plain(point), allow_nan=False) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
