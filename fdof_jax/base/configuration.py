"""Settings that an application makes once, at its start.

Importing the library sets nothing.
"""

import functools
import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax
from jax._src import xla_bridge
from jax.experimental.compilation_cache import compilation_cache
from jaxlib import version

from .checks import shown
from .user_warnings import warn
from .whole_files import folder_path

# XLA on CPU compiles a loop as one kernel if its state has fewer bytes than this sets;
# otherwise it starts a kernel for each operation. XLA reads the option when JAX starts.
# Versions that do not know it ignore it, whereas unknown flags end the process.
_SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_FLAG = f"--xla_backend_extra_options={_SMALL_LOOPS}=400000"
# From this version of jaxlib on, XLA compiles such loops as one kernel by itself.
_BY_ITSELF = (0, 12)
# XLA on CPU uses vectors of 256 bits even where the processor has wider ones. With 512,
# chunks of a sweep take two thirds of the time (AMD EPYC, one core).
_WIDE = {"xla_cpu_prefer_vector_width": 512}

# Before this version of jaxlib, XLA has a second code generator for CPUs. It compiles
# the many small kernels of a loop in half the time, and they run as fast.
_ONE_GENERATOR = (0, 11)


def options_of_loops() -> dict[str, bool]:
    """Returns the compiler options of `jax.jit` for the loops of a few motions."""
    both = version.__version_info__ < _ONE_GENERATOR
    return {"xla_cpu_use_fusion_emitters": False} if both else {}


@functools.cache
def wide_vectors() -> dict[str, Any]:
    """Returns options of `jax.jit` for wide vectors; none unless XLA on CPU has any."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=_WIDE).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:  # no such option
        return {}
    return _WIDE


def configure(
    *, x64: bool | None = None, cache: bool | str | os.PathLike[str] | None = None
) -> None:
    """Sets up JAX for an application; call it once, before anything is computed.

    Before JAX 0.12, `configure` also sets an option of XLA that makes single arms up to
    four times as fast, and their gradients three times.

    **Arguments:** None leaves a setting as it is.

    - `x64`: whether numbers have double precision. Existing arms and elements keep
      their precision; `simulate` warns of them.
    - `cache`: a folder that keeps compiled programs for later processes; True for one
      in the user's cache directory, False for none. Each kind of processor has a
      subfolder. Programs are deleted only if `jax_compilation_cache_max_size` is set.
      JAX keeps no program that calls Python, as `simulate` in your `jax.jit` does
      without `throw=False`.

    **Raises:** ValueError for malformed arguments and for a folder that cannot be
    written. Warns if the option cannot be set, such as after JAX has started.

    >>> import fdof_jax as fj
    >>> fj.configure(x64=True)
    """
    if x64 is not None and not isinstance(x64, bool):
        raise ValueError(f"x64: expected True or False, got {shown(x64)}.")
    if cache is not None:
        _keep_programs(cache)
    if x64 is not None:
        jax.config.update("jax_enable_x64", x64)
    _compile_small_loops_as_kernels()


def _compile_small_loops_as_kernels() -> None:
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if version.__version_info__ >= _BY_ITSELF or _SMALL_LOOPS in flags:
        return
    if xla_bridge.backends_are_initialized():
        reason = "JAX had started before; call configure before anything is computed"
    elif flags and not flags.startswith("-"):
        reason = f"XLA_FLAGS names a file; add {_FLAG} to it"
    else:
        os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}".strip()
        return
    warn(
        "configure: XLA could not be set to compile small loops as one kernel, so "
        f"single arms are simulated more slowly: {reason}."
    )


def _keep_programs(cache: bool | str | os.PathLike[str]) -> None:
    folder = None
    if cache is not False:
        place = _user_cache() if cache is True else cache
        expected = "a folder, True or False"
        folder = folder_path("cache", place, expected, within=_processor()).resolve()
        # By default JAX does not keep programs that compile in less than a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_dir", folder and str(folder))
    compilation_cache.reset_cache()  # JAX opens it only once, with the first program


def _user_cache() -> Path:
    if sys.platform == "win32":
        folder = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        folder = "~/Library/Caches"
    else:
        folder = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(folder) / "fdof_jax"


def _processor() -> str:
    """Names this kind of processor: compiled programs run on no other."""
    facts = [platform.machine(), platform.processor()]
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():  # on Linux
        lines = cpuinfo.read_text(errors="replace").splitlines()
        about = "model name", "flags", "Features", "CPU part"
        facts += sorted({line for line in lines if line.startswith(about)})
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]
