"""The C kernel of native.c: compiled on first use, called by ctypes."""

import ctypes
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import diffrax
import numpy as np

import fdof_jax as fj

from .measure import Skipped
from .pendulums import Constants, absolute, constants, relative

SIMD = 32  # several vectors at a time hide each other's latency
RK4 = (
    np.array([[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]]),
    np.array([1, 2, 2, 1]) / 6,
)


def _dormand_prince_8() -> tuple[np.ndarray, np.ndarray]:
    tableau = diffrax.Dopri8.tableau
    stages = len(tableau.a_lower)  # without the last, the next step's first
    a = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower[:-1]):
        a[i + 1, : i + 1] = row
    return a, np.asarray(tableau.b_sol)[:stages]


@cache
def _library(method: str, lanes: int) -> ctypes.CDLL:
    if shutil.which("gcc") is None:
        raise Skipped("gcc is not installed")
    a, b = RK4 if method == "RK4" else _dormand_prince_8()
    rows = ",\n".join("{" + ", ".join(map(repr, row)) + "}" for row in a.tolist())
    header = (
        f"#define STAGES {len(b)}\n"
        f"static const double A[STAGES][STAGES] = {{{rows}}};\n"
        f"static const double B[STAGES] = {{{', '.join(map(repr, b.tolist()))}}};\n"
    )
    folder = Path(tempfile.mkdtemp(prefix="fdof-native-"))
    (folder / "tableau.h").write_text(header)
    compiled, output = folder / "native.o", folder / "native.so"
    command = "gcc -O3 -march=native -mprefer-vector-width=512 -ffast-math -fPIC"
    source = str(Path(__file__).with_name("native.c"))
    command = [*command.split(), f"-DLANES={lanes}", f"-I{folder}"]
    subprocess.run([*command, "-c", source, "-o", str(compiled)], check=True)
    # Linked with -ffast-math too, it would flush subnormal numbers to zero in all of
    # the process that loads it.
    subprocess.run(["gcc", "-shared", str(compiled), "-o", str(output)], check=True)
    library = ctypes.CDLL(str(output))
    shutil.rmtree(folder)  # once loaded, the file is not needed
    library.integrate.restype = None
    return library


def _arm(arm: Constants) -> np.ndarray:
    """Returns the fields of the kernel's `Arm`."""
    return np.concatenate(
        [[arm.gravity], arm.step.ravel(), arm.first.ravel(), arm.second]
    )


class Kernel:
    """One method with fixed steps, for one arm and one or many starts.

    **Arguments:** `method`: "RK4" or "order 8"; `q`, `qd`: (3,) or (batch, 3);
    `threads`: the number of threads that share a batch.
    """

    def __init__(
        self,
        method: str,
        linkage: fj.Linkage,
        q: np.ndarray,
        qd: np.ndarray,
        threads: int = 1,
    ):
        self.constants = constants(linkage)
        if len(self.constants.second) != 3:
            raise Skipped("the kernel has three links")
        q, qd = np.atleast_2d(q), np.atleast_2d(qd)
        self.batch, self.lanes = len(q), SIMD if len(q) > 1 else 1
        self.library = _library(method, self.lanes)
        self.arm = _arm(self.constants)
        blocks = -(-self.batch // self.lanes)
        state = absolute(self.constants, q, qd)
        # The last block is filled up with copies of its last member.
        state = np.pad(
            state, ((0, blocks * self.lanes - self.batch), (0, 0)), mode="edge"
        )
        self.start = state.reshape(blocks, self.lanes, 6).transpose(0, 2, 1).copy()
        self.parts = np.array_split(np.arange(blocks), min(threads, blocks))
        self.pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def __call__(self, step: float, steps: int, saves: int = 1) -> np.ndarray:
        """Returns states after each of `saves` times `steps` steps.

        The shape is (blocks, saves, 6, lanes). Angles and rates are absolute,
        as the kernel leaves them: see `joints`.
        """
        state = self.start.copy()
        saved = np.empty((len(state), saves, 6, self.lanes))

        def part(blocks: np.ndarray) -> None:
            first = blocks[0]
            self.library.integrate(
                _pointer(self.arm),
                ctypes.c_double(step),
                ctypes.c_long(steps),
                ctypes.c_long(saves),
                ctypes.c_long(len(blocks)),
                _pointer(state[first:]),
                _pointer(saved[first:]),
            )

        if self.pool is None:
            part(self.parts[0])
        else:
            list(self.pool.map(part, self.parts))
        return saved

    def joints(self, saved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns joint positions and rates of saved states: (batch, saves, 3) each."""
        blocks, saves = saved.shape[:2]
        state = saved.transpose(0, 3, 1, 2).reshape(blocks * self.lanes, saves, 6)
        return relative(self.constants, state[: self.batch])


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
