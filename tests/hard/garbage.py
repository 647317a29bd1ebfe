"""Values of every kind for every argument: valid ones work, others raise an error.

The error is a ValueError or a TypeError whose message names the argument.
"""

import dataclasses
import datetime
import decimal
import fractions
from typing import Any

import diffrax
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .arguments import ARGUMENTS, ARM, TS, times
from .fuzz_report import Failure, Report


class Hostile:
    """An object that raises when it is converted to an array or shown."""

    def __array__(self, *args, **keywords):
        raise RuntimeError("no array")

    def __repr__(self):
        return "Hostile()"


NUMBERS = st.one_of(
    st.floats(),
    st.sampled_from([0.0, 1.0, -1.0, 1e-320, 1e160, 1e200, -1e308, float("nan")]),
)
SCALARS = st.one_of(
    NUMBERS,
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.integers(-(2**80), 2**80),
    st.complex_numbers(),
    st.text(max_size=5),
    st.sampled_from(["RRR", "PPP", "RPR ", "rrr", "nan", "1", "QRS"]),
    st.binary(max_size=3),
    st.fractions(),
    st.decimals(),
    st.sampled_from(
        [
            np.float16(1),
            np.float32(0.1),
            np.int8(-1),
            np.uint64(2**63),
            np.longdouble(1),
            np.bool_(True),
            np.datetime64("2020-01-01"),
            datetime.timedelta(1),
            decimal.Decimal("NaN"),
            fractions.Fraction(1, 3),
            object(),
            Hostile(),
            dict(a=1),
            {1.0, 2.0},
            frozenset(),
            (),
            [],
            Ellipsis,
            slice(None),
            range(6),
            float,
            len,
            np,
            ARM,
            fj.Linkage,
            jnp.float32(1),
            jnp.ones(3),
            jnp.zeros((2, 3)),
            jnp.ones(6, jnp.bfloat16),
            jax.random.key(0),
            diffrax.RESULTS.successful,
            diffrax.Dopri8,
            np.ma.masked_array([1.0, 2.0, 3.0], [0, 1, 0]),
            np.array([1, 2, 3], dtype=">f8"),
            np.rec.array([(1.0, 2)], dtype=[("a", float), ("b", int)]),
            np.array([], dtype=float),
            memoryview(b"abc"),
        ]
    ),
)
DTYPES = st.one_of(
    hnp.floating_dtypes(), hnp.integer_dtypes(), hnp.unsigned_integer_dtypes(),
    hnp.boolean_dtypes(), hnp.complex_number_dtypes(), hnp.unicode_string_dtypes(),
    hnp.datetime64_dtypes(), st.just(np.dtype(object)),
)  # fmt: skip


def of_shape(shape: tuple) -> st.SearchStrategy:
    """Returns arrays and nested lists of the shape, with one entry of any kind."""

    @st.composite
    def spoiled(draw):
        values = draw(hnp.arrays(float, shape, elements=st.floats(-10, 10))).tolist()
        if not shape:
            return draw(SCALARS)
        row = values
        for size in shape[:-1]:
            row = row[draw(st.integers(0, size - 1))]
        row[draw(st.integers(0, shape[-1] - 1))] = draw(st.one_of(NUMBERS, SCALARS))
        return values

    plain = hnp.arrays(
        st.sampled_from([np.float64, np.float32, np.int32]),
        shape,
        elements=st.integers(-5, 5),
    )
    return st.one_of(
        plain,
        plain.map(lambda a: np.sort(np.abs(a), axis=None).reshape(a.shape)),
        plain.map(lambda a: a.tolist()),
        plain.map(jnp.asarray),
        spoiled(),
    )


ANYTHING = st.one_of(
    SCALARS,
    st.recursive(
        SCALARS,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4),
            st.tuples(inner, inner),
            st.dictionaries(st.text(max_size=2), inner, max_size=2),
        ),
        max_leaves=6,
    ),
    hnp.arrays(
        DTYPES, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6)
    ),
)


@dataclasses.dataclass(frozen=True)
class Case:
    label: str
    value: Any


@st.composite
def cases(draw) -> Case:
    label = draw(st.sampled_from(list(ARGUMENTS)))
    value = draw(st.one_of(of_shape(ARGUMENTS[label].shape), ANYTHING))
    return Case(label, value)


def check_argument(case: Case, report: Report) -> str:
    argument = ARGUMENTS[case.label]
    valid = argument.valid(case.value)
    if valid and argument.only_invalid:
        return "valid, not tried"
    # Each number of times is a program of its own.
    if argument.valid is times and valid and np.shape(case.value) != TS.shape:
        return "valid, not tried"
    try:
        argument.call(case.value)
    except (ValueError, TypeError) as error:
        message = str(error)
        if argument.name not in message:
            raise Failure(
                f"{case.label}: {type(error).__name__} without the argument's name: "
                f"{message[:200]}"
            ) from error
        if valid and not argument.may_refuse:
            raise Failure(
                f"{case.label}: refused a valid value: {message[:200]}"
            ) from error
        return f"{type(error).__name__} naming it"
    if not valid:
        raise Failure(f"{case.label}: took it")
    return "valid, taken"
