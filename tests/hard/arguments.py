"""All public functions and their arguments, with checks of which values are valid.

The checks repeat the library's rules argument by argument, for `garbage` to compare.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

# Valid arguments; each call replaces one of them

LINKS = dict(
    length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
)  # fmt: skip
ZERO, CHAIN = np.zeros(3), np.zeros(6)
TS = np.linspace(0, 1e-3, 5)
SETTINGS = dict(max_steps=4096, throw=False)


def arm(topology="RRR", **changes):
    return fj.Linkage(topology, **{**LINKS, **changes})


ARM = arm()
FORCES = (fj.JointEffort(ZERO), fj.JointDamper(0.0))
PATH = fj.CircleTask(center=[1.5, 0.5], radius=0.2, orientation=0.0)
SOLUTION = fj.Solution(
    jnp.zeros(2), jnp.zeros((2, 3)), jnp.zeros((2, 3)), {}, diffrax.RESULTS.successful
)


def simulate(linkage=ARM, state0=(ZERO, ZERO), ts=TS, forces=FORCES, **changes):
    return fj.simulate(linkage, state0, ts, forces, **{**SETTINGS, **changes})


def sweep(
    linkage=ARM, state0=(np.zeros((2, 3)), ZERO), ts=TS, forces=FORCES, **changes
):
    return fj.sweep(linkage, state0, ts, forces, **{**SETTINGS, **changes})


# Checks of valid values


def numbers(value: Any) -> np.ndarray | None:
    """Returns real numbers as float64, or None if the value is none."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            return None
        with np.errstate(over="ignore"):
            return np.asarray(array, dtype=float)
    except Exception:  # whatever a foreign object raises
        return None


def array_of(*shape, minimum=-np.inf, above=-np.inf, finite=True, broadcast=False):
    def valid(value):
        array = numbers(value)
        if array is None:
            return False
        if array.shape != shape and not (broadcast and array.shape == ()):
            return False
        inside = (array >= minimum) & ((array > above) | (above == -np.inf))
        return bool((inside & (np.isfinite(array) | (not finite))).all())

    return valid


def chain_rates(value):
    """Returns whether an RRR's fictitious slides stand still, apart from rounding."""
    if not array_of(6)(value):
        return False
    rates = np.abs(numbers(value))
    return bool((rates[0::2] <= 8 * np.finfo(float).eps * rates.max()).all())


def times(value):
    array = numbers(value)
    if array is None or array.ndim != 1 or not array.size:
        return False
    return bool(np.isfinite(array).all() and (np.diff(array) > 0).all())


def topology(value):
    if isinstance(value, str):
        return value in "RRR RRP RPR PRR RPP PRP PPR".split()
    try:
        given = np.asarray(value)
    except Exception:
        return False
    if given.dtype.kind not in "biuf" or given.shape != (6,):
        return False
    pairs = given.astype(float).reshape(3, 2).tolist()
    right = ([0.0, 1.0], [1.0, 0.0])
    return all(pair in right for pair in pairs) and pairs != [right[1]] * 3


def batch(value):
    array = numbers(value)
    return array is not None and array.shape[1:] == (3,) and len(array) > 0


def unit(value):
    array = numbers(value)
    return array is not None and array.shape == () and abs(array) == 1


def nothing(value):
    return isinstance(value, tuple) and len(value) == 0


def never(value):
    return False


def whole(value):
    return isinstance(value, int | np.integer) and not isinstance(value, bool | np.bool)


def instance(*kinds):
    return lambda value: isinstance(value, kinds)


@dataclasses.dataclass(frozen=True)
class Argument:
    name: str  # in the message
    call: Callable[[Any], Any]
    valid: Callable[[Any], bool]
    shape: tuple = ()
    # Valid values may be rejected by name for their meaning: a point out of reach.
    may_refuse: bool = False
    # Valid values are not tried: each would compile a program of its own.
    only_invalid: bool = False


ARGUMENTS: dict[str, Argument] = {}


def add(label, *args, **keywords):
    name = label.split()[-1]
    ARGUMENTS[label] = Argument(name, *args, **keywords)


add("Linkage topology", arm, topology, (6,))
add(
    "from_chain topology",
    lambda v: fj.paper.from_chain(v, CHAIN, CHAIN),
    topology,
    (6,),
)
add("existence_factors topology", fj.existence_factors,
    lambda v: isinstance(v, str) and topology(v))  # fmt: skip
for field, shape, keywords in (
    ("length", (4,), {}),
    ("com", (3, 2), {}),
    ("mass", (3,), dict(minimum=0)),
    ("inertia", (3,), dict(minimum=0)),
    ("locked", (3,), dict(broadcast=True)),
    ("base_angle", (), {}),
    ("gravity", (), {}),
):
    add(
        f"Linkage {field}",
        lambda v, field=field: arm(**{field: v}),
        array_of(*shape, **keywords),
        shape,
        may_refuse=field in ("mass", "inertia", "com"),
    )
add("from_chain x", lambda v: fj.paper.from_chain("RRR", v, CHAIN), array_of(6), (6,))
add("from_chain xd", lambda v: fj.paper.from_chain("RRR", CHAIN, v), chain_rates, (6,))
add("from_chain base_angle", lambda v: fj.paper.from_chain("RRR", CHAIN, CHAIN, v),
    array_of())  # fmt: skip
OF_A_LINKAGE = {
    "to_chain": (fj.paper.to_chain, "q qd", 3),
    "joint_positions": (fj.joint_positions, "q", 3),
    "mass_centers": (fj.mass_centers, "q", 3),
    "tip_position": (fj.tip_position, "q", 3),
    "tip_jacobian": (fj.tip_jacobian, "q", 3),
    "forward_dynamics": (fj.forward_dynamics, "q qd tau", 3),
    "inverse_dynamics": (fj.inverse_dynamics, "q qd qdd", 3),
    "energy": (fj.energy, "q qd", 3),
    "link_energies": (fj.link_energies, "q qd", 3),
    "mass_matrix": (fj.paper.mass_matrix, "x", 6),
    "bias_force": (fj.paper.bias_force, "x xd", 6),
    "masked_accelerations": (fj.paper.masked_accelerations, "x xd force", 6),
    "constraint_forces": (fj.paper.constraint_forces, "x xd force", 6),
}
for label, (function, names, size) in OF_A_LINKAGE.items():
    names = names.split()
    zeros = [np.zeros(size)] * len(names)
    add(f"{label} linkage", lambda v, f=function, z=zeros: f(v, *z), never)
    for i, name in enumerate(names):

        def call(v, f=function, z=zeros, i=i):
            return f(ARM, *z[:i], v, *z[i + 1 :])

        add(f"{label} {name}", call, array_of(size), (size,))
add("inverse_kinematics linkage", lambda v: fj.inverse_kinematics(v, [1, 1], 0), never)
add("inverse_kinematics tip", lambda v: fj.inverse_kinematics(ARM, v, 0.0),
    array_of(2), (2,), may_refuse=True)  # fmt: skip
add("inverse_kinematics orientation", lambda v: fj.inverse_kinematics(ARM, [1, 1], v),
    array_of(), may_refuse=True)  # fmt: skip
add("inverse_kinematics branch",
    lambda v: fj.inverse_kinematics(ARM, [1, 1], 0.0, branch=v), unit)  # fmt: skip
add("to_mjcf linkage", fj.to_mjcf, never)
add("JointDamper coefficient", fj.JointDamper,
    array_of(3, minimum=0, broadcast=True), (3,))  # fmt: skip
add("JointEffort tau", fj.JointEffort, array_of(3), (3,))
for field in ("kp", "kd", "limit", "reference"):

    def call(v, field=field):
        gains = dict(kp=1, kd=1, limit=1, reference=PATH)
        return fj.PDController(**{**gains, field: v})

    if field == "reference":
        add(
            "PDController reference",
            call,
            lambda v: callable(v) and type(v) is not type,
        )
    else:
        valid = array_of(3, minimum=0, broadcast=True, finite=field != "limit")
        add(f"PDController {field}", call, valid, (3,))
for field, shape, valid in (
    ("center", (2,), array_of(2)),
    ("radius", (), array_of(minimum=0)),
    ("period", (), lambda v: array_of()(v) and numbers(v) != 0),
    ("phase", (), array_of()),
    ("orientation", (), array_of()),
    ("branch", (), unit),
):
    add(f"CircleTask {field}",
        lambda v, field=field: fj.CircleTask(**{field: v}), valid, shape)  # fmt: skip
add("CircleTask call t", lambda v: PATH(v, ARM), array_of())
add("simulate linkage", lambda v: simulate(linkage=v), never)
add("simulate state0", lambda v: simulate(state0=v), array_of(2, 3), (2, 3))
add("simulate state0.q", lambda v: simulate(state0=fj.State(v, ZERO)),
    array_of(3), (3,))  # fmt: skip
add("simulate state0.qd", lambda v: simulate(state0=fj.State(ZERO, v)),
    array_of(3), (3,))  # fmt: skip
add("simulate ts", lambda v: simulate(ts=v), times, (5,))
add("simulate forces", lambda v: simulate(forces=v), nothing, only_invalid=True)
add("simulate dt0", lambda v: simulate(dt0=TS[1] if v is None else v),
    lambda v: v is None or array_of(above=0)(v))  # fmt: skip
for option, valid in {
    "max_steps": lambda v: v is None or (whole(v) and v > 0),
    "throw": instance(bool),
    "adjoint": never,
    "solver": lambda v: v is None,
    "stepsize_controller": lambda v: v is None,
    "progress_meter": never,
}.items():
    for function in (simulate, sweep):
        add(f"{function.__name__} {option}",
            lambda v, f=function, option=option: f(**{option: v}),
            valid, only_invalid=True)  # fmt: skip
add("sweep linkage", lambda v: sweep(linkage=v), never)
add("sweep state0", lambda v: sweep(state0=(v, ZERO)), batch, (2, 3), only_invalid=True)
add("sweep ts", lambda v: sweep(ts=v), times, (5,), only_invalid=True)
add("sweep forces", lambda v: sweep(forces=v), nothing, only_invalid=True)
add("sweep forces_axes", lambda v: sweep(forces_axes=v), lambda v: v is None,
    only_invalid=True)  # fmt: skip
add("sweep chunk", lambda v: sweep(chunk=v), lambda v: whole(v) and v > 0,
    only_invalid=True)  # fmt: skip
add("sweep dt0", lambda v: sweep(dt0=v),
    lambda v: v is None or array_of(above=0)(v), only_invalid=True)  # fmt: skip
add("joint_efforts linkage", lambda v: fj.joint_efforts(v, FORCES, SOLUTION), never)
add("joint_efforts forces", lambda v: fj.joint_efforts(ARM, v, SOLUTION),
    nothing)  # fmt: skip
add("joint_efforts solution", lambda v: fj.joint_efforts(ARM, FORCES, v), never)
