"""What an application sets once, at its start: `configure`.

The library itself sets nothing when it is imported.
"""

import hashlib
import os
import platform
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import jaxlib
from jax._src import xla_bridge
from jax.experimental.compilation_cache import compilation_cache

# Loops whose state is smaller than so many bytes are compiled as one kernel, where XLA
# on CPU starts a kernel for each operation otherwise. XLA reads it when JAX starts. It
# ignores names that it does not know among these options: no version refuses this one.
_SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_FLAG = f"--xla_backend_extra_options={_SMALL_LOOPS}=100000"
# From this version on XLA does so by itself.
_BY_ITSELF = (0, 12)


def _flags() -> str:
    return os.environ.get("XLA_FLAGS", "")


def small_loops_are_kernels() -> bool:
    """Whether XLA compiles the loops of a single arm's motion as one kernel."""
    version = tuple(map(int, jaxlib.__version__.split(".")[:2]))
    return version >= _BY_ITSELF or _SMALL_LOOPS in _flags()


def _started() -> bool:
    return xla_bridge.backends_are_initialized()


def configure(
    *, x64: bool | None = None, cache: bool | str | os.PathLike[str] | None = None
) -> None:
    """Set up JAX for an application, once and before it computes anything.

    Besides what its arguments say, it lets XLA compile small loops as one kernel, where
    the installed version needs to be told (JAX before 0.12): single arms are then
    simulated up to ten times as fast, and their gradients five times.

    **Arguments:** what is not given stays as it is.

    - `x64`: whether numbers are of double precision.
    - `cache`: a folder in which compiled programs are kept for the next process; True
      for one in the user's cache directory, False for none. Programs for unlike
      processors are kept apart.

    **Raises:** ValueError for malformed arguments. Warns if JAX had started before, and
    of what could not be set for that reason.

    >>> import fdof_jax as fj
    >>> fj.configure(x64=True)
    """
    if x64 is not None:
        if not isinstance(x64, bool):
            raise ValueError(f"x64: expected True or False, got {x64!r}.")
        jax.config.update("jax_enable_x64", x64)
    if cache is not None:
        _keep_programs(cache)
    if not small_loops_are_kernels():
        if _started():
            warnings.warn(
                "configure: JAX had started before, so XLA could not be told to "
                "compile small loops as one kernel; single arms are simulated more "
                "slowly. Call configure before anything is computed.",
                stacklevel=2,
            )
        elif "xla_backend_extra_options" in _flags():
            warnings.warn(
                f"configure: XLA_FLAGS sets xla_backend_extra_options; add "
                f"{_SMALL_LOOPS}=100000 to it.",
                stacklevel=2,
            )
        else:
            os.environ["XLA_FLAGS"] = f"{_flags()} {_FLAG}".strip()


def _keep_programs(cache: Any) -> None:
    if cache is False:
        folder = None
    elif cache is True:
        folder = _user_cache() / "fdof_jax"
    elif isinstance(cache, str | os.PathLike) and os.fspath(cache):
        folder = Path(cache).expanduser()
    else:
        raise ValueError(f"cache: expected a folder, True or False, got {cache!r}.")
    if folder is not None:
        folder = folder.resolve() / _processor()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(
                f"cache: expected a folder that can be written, got {cache!r} "
                f"({error.strerror})."
            ) from error
        # JAX's own defaults leave out what compiles in less than a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_dir", folder and str(folder))
    compilation_cache.reset_cache()  # it is opened once, with the first program


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))


def _processor() -> str:
    """A name for this kind of processor, by what programs are compiled for."""
    told = [platform.machine(), platform.processor()]
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        about = "model name", "flags", "Features", "CPU part"
        told += sorted({line for line in lines if line.startswith(about)})
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]
