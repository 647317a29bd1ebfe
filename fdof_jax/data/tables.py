"""Motions as xarray Datasets and pandas DataFrames (optional packages)."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import check_known, instance, optional_package
from ..linkage.linkage import Linkage
from ..linkage.topology import common_unit, names_and_units, rate_unit
from ..simulation.solution import MODES, Solution, attributes_in, check_joints

if TYPE_CHECKING:
    import pandas
    import xarray


def _checked(linkage: Linkage, solution: Solution) -> tuple[np.ndarray, list[str]]:
    """The common times of all motions, and names of the batch axes."""
    instance("linkage", linkage, Linkage)
    check_joints("solution", solution, linkage)
    check_known("solution", solution, linkage)
    ts = np.asarray(solution.ts).reshape((-1, solution.q.shape[-2]))
    if (ts != ts[0]).any():
        raise ValueError(
            "solution.ts: expected the same times for all motions, got different ones."
        )
    axes = solution.q.ndim - 2
    batch = ["batch"] if axes == 1 else [f"batch_{k + 1}" for k in range(axes)]
    return ts[0], batch


def to_xarray(linkage: Linkage, solution: Solution) -> "xarray.Dataset":
    """Converts a solution to an xarray Dataset, with names and units.

    The Dataset holds `q` and `qd` over `time` and `joint`, and `outcome`, `num_steps`
    and `time_reached` for each trajectory (of `simulate_sampled`, `outcome` alone).
    Where elements hold joints, it also holds `modes`, as numbers, and the energy
    `taken` (see `Solution`). Joints are named R1, P2 and so on, with the coordinate
    `unit`; a joint of both kinds within a batch is named by its number. Batch axes come
    first, as `batch`, or `batch_1`, `batch_2` and so on;
    `.rename(batch="payload").assign_coords(payload=masses)` names one and gives it
    values. States of elements and events are left out.

    **Arguments:** `linkage`: one or a batch; `solution`: one motion or a batch at the
    same times [s].

    **Returns:** the Dataset; its variables have an attribute `units`.

    **Raises:** ImportError without xarray, which `fdof_jax[data]` installs; ValueError
    for malformed arguments.
    """
    xarray = optional_package("xarray", "data")
    times, batch = _checked(linkage, solution)
    names, units = names_and_units(linkage.ef)
    named = lambda label, unit="": {"long_name": label, "units": unit}
    labels = attributes_in(common_unit(units)) | {
        "outcome": named("how the trajectory ended"),
        "time": named("time", "s"),
        "joint": named("joint"),
        "unit": named("unit of the joint's position"),
    }
    rows = [*batch, "time", "joint"]
    arrays: dict[str, tuple[list[str], ArrayLike]]
    arrays = {"q": (rows, solution.q), "qd": (rows, solution.qd)}
    for name in ("num_steps", "time_reached"):
        if name in solution.stats:
            arrays[name] = batch, solution.stats[name]
    if solution.modes is not None and solution.taken is not None:
        arrays["modes"] = rows, solution.modes
        arrays["taken"] = rows[:-1], solution.taken
    arrays["outcome"] = batch, solution.outcome
    arrays |= {"time": (["time"], times), "joint": (["joint"], names)}
    arrays["unit"] = ["joint"], units
    variables = {
        name: (dims, np.asarray(values), labels[name])
        for name, (dims, values) in arrays.items()
    }
    return xarray.Dataset(variables).set_coords("unit")


def to_pandas(linkage: Linkage, solution: Solution) -> "pandas.DataFrame":
    """Converts a solution to a pandas DataFrame with a row per time.

    Its columns are joint positions and velocities, named `R1 [rad]`, `P2 [m/s]` and so
    on, and the `outcome` of the row's trajectory. Where elements hold joints, there is
    a column `R1 held by` with what holds the joint (or `free`), and one of the energy
    taken, `taken [J]`. The index is `time [s]`, after the levels `batch` (or `batch_1`,
    `batch_2` and so on) of a batch.

    **Arguments:** as in `to_xarray`.

    **Raises:** ImportError without pandas, which `fdof_jax[data]` installs; ValueError
    for malformed arguments.
    """
    pandas = optional_package("pandas", "data")
    times, batch = _checked(linkage, solution)
    columns = {}
    for values, unit_of in ((solution.q, str), (solution.qd, rate_unit)):
        for k, (name, unit) in enumerate(zip(*names_and_units(linkage.ef))):
            columns[f"{name} [{unit_of(unit)}]"] = np.asarray(values)[..., k].ravel()
    if solution.modes is not None:
        for k, name in enumerate(names_and_units(linkage.ef)[0]):
            modes = np.nan_to_num(np.asarray(solution.modes)[..., k].ravel())
            columns[f"{name} held by"] = np.array(MODES)[modes.astype(int)]
        columns["taken [J]"] = np.asarray(solution.taken).ravel()
    columns["outcome"] = np.repeat(solution.outcome, len(times))
    index = pandas.Index(times, name="time [s]")
    if batch:
        levels = [*map(range, solution.q.shape[:-2]), times]
        index = pandas.MultiIndex.from_product(levels, names=[*batch, "time [s]"])
    return pandas.DataFrame(columns, index)
