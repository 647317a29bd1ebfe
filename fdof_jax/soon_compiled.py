"""Compilation in two thirds of the time, of programs that the host calls."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


@functools.cache
def _options() -> dict[str, Any]:
    """XLA's older code generator for CPUs, if it is there.

    Such programs, of many operations on few numbers, run as fast with it.
    """
    options = {"compiler_options": {"xla_cpu_use_fusion_emitters": False}}
    try:
        jax.jit(lambda: 0, **options)()  # pyright: ignore[reportArgumentType]
    except jax.errors.JaxRuntimeError:  # no option of this version of XLA
        return {}
    return options


@functools.cache
def soon_compiled(function: Callable) -> Any:
    """`equinox.filter_jit(function)`, compiled sooner.

    JAX takes options for whole programs only: not for use under its transformations.
    """
    return eqx.filter_jit(function, **_options())
