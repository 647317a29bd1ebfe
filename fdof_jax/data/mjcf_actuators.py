"""Actuators of a MuJoCo model: their laws, and the elements that act alike."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..control.actuators import Activation, Actuators
from ..control.pd import PDController
from ..forces.element import Element
from ..forces.joints import JointEffort
from ..references.task import SetPoint
from .mjcf_chain import Chain, Reader
from .mjcf_source import Model


class _Affine(NamedTuple):
    """A law constant + length * actuator's length + speed * its speed."""

    constant: float = 0.0
    length: float = 0.0
    speed: float = 0.0


class _OwnState(NamedTuple):
    """An actuator's state, in the terms of `Activation`."""

    gain: float = 0.0
    rate: tuple[float, ...] = (0.0,) * 4
    start: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf


class _Law(NamedTuple):
    gain: _Affine
    bias: _Affine
    state: _OwnState | None = None


class _Row(NamedTuple):
    """An actuator, in the terms of `Actuators`."""

    name: str
    gear: np.ndarray  # (n,)
    control: float
    lower: float
    upper: float
    gain: _Affine
    bias: _Affine
    state: _OwnState | None
    control_range: np.ndarray | None

    @property
    def joint(self) -> int:
        """The joint that it acts on most."""
        return int(np.argmax(abs(self.gear)))

    @property
    def is_servo(self) -> bool:
        """Whether it pushes by itself against a position or a velocity."""
        return bool(self.bias.length or self.bias.speed)


def _gear(read: Reader, chain: Chain, actuator: int) -> np.ndarray | None:
    """Ratios of an actuator to the joint positions q; None if it acts elsewhere."""
    model, kinds = read.model, read.mujoco.mjtTrn
    target = model.actuator_trnid[actuator, 0]
    kind = kinds(int(model.actuator_trntype[actuator]))
    coefficients = np.zeros(model.njnt)
    if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
        coefficients[target] = 1
    elif kind == kinds.mjTRN_TENDON:
        wraps = read.path_of_tendon(target)
        if (model.wrap_type[wraps] != int(read.mujoco.mjtWrap.mjWRAP_JOINT)).any():
            return None
        np.add.at(coefficients, model.wrap_objid[wraps], model.wrap_prm[wraps])
    else:
        return None
    beside = np.delete(coefficients, chain.joints)
    here = coefficients[chain.joints] * chain.signs
    if here.any() and beside.any():
        return None
    return here * model.actuator_gear[actuator, 0]


def inertias_of_actuators(
    read: Reader, chain: Chain
) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yields gears, damping and armature of actuators, in newer versions."""
    model = read.model
    if "actuators" in read.drop or not hasattr(model, "actuator_armature"):
        return
    for actuator in range(len(model.actuator_trntype)):
        values = model.actuator_damping[actuator], model.actuator_armature[actuator]
        poly = getattr(model, "actuator_dampingpoly", None)
        bent = poly is not None and np.any(poly[actuator])
        if not any(values) and not bent:
            continue
        name = f"actuator {read.name_of('actuator', actuator)}"
        gear = _gear(read, chain, actuator)
        if bent or gear is None or np.count_nonzero(gear) > 1:
            read.leave("actuators", name, "damping or armature that joints do not have")
        else:
            yield gear, *values


def actuators(read: Reader, chain: Chain, controls: ArrayLike | None) -> list[Element]:
    """The actuators: PD controllers and efforts where these will do, or `Actuators`."""
    model = read.model
    if controls is None:
        controls = model.key_ctrl[0] if model.nkey else np.zeros(model.nu)
    controls = np.array(real_array("controls", controls, (model.nu,)))
    clamped = np.asarray(model.actuator_ctrllimited).astype(bool).ravel()
    clamped &= not read.disabled("CLAMPCTRL")
    ranges = np.asarray(model.actuator_ctrlrange).reshape(-1, 2)
    controls = np.where(clamped, np.clip(controls, *ranges.T), controls)
    states = model.key_act[0] if model.nkey else np.zeros(model.na)
    rows = []
    for actuator in range(len(model.actuator_trntype)):
        name = f"actuator {read.name_of('actuator', actuator)}"
        group = int(model.actuator_group[actuator])
        off = 0 <= group < 31 and model.opt.disableactuator & (1 << group)
        if off or read.disabled("ACTUATION"):
            read.note(name, "left out, switched off")
            continue
        if "actuators" in read.drop:
            read.note(name, "left out, as asked")
            continue
        gear = _gear(read, chain, actuator)
        if gear is None:
            kind = read.mujoco.mjtTrn(int(model.actuator_trntype[actuator]))
            what = f"a transmission ({kind.name[6:].lower()}) beyond the chain's joints"
            read.leave("actuators", name, what)
        elif not gear.any():
            read.note(name, "left out, as it acts on nothing of the chain")
        else:
            law = _law(read, actuator, controls, states)
            if isinstance(law, str):
                read.leave("actuators", name, law)
                continue
            if not any(law.gain) and not any(law.bias) and law.state is None:
                read.note(name, "left out, as its gains are 0")
                continue
            ends = map(float, read.bounds("actuator_force", actuator))
            place = _places(model, actuator)[0]
            within = ranges[place] if clamped[place] else None
            rows.append(_Row(name, gear, controls[place], *ends, *law, within))
    lower, upper = read.bounds("jnt_actfrc", chain.joints, chain.signs)
    if not rows:
        return []
    forces = _simple(rows, lower, upper) or [_general(rows, lower, upper)]
    kinds = " and ".join(type(force).__name__ for force in forces)
    for row in rows:
        if len(forces) > 1:
            kinds = "PDController" if row.is_servo else "JointEffort"
        words, limits = f"{kinds}, at a control of {row.control:.4g}", {}
        if row.control_range is not None:
            limits["range"] = row.control_range
        if kinds == "JointEffort" and np.isfinite([row.lower, row.upper]).any():
            limits["force range"] = row.lower, row.upper
        for name, (low, high) in limits.items():
            words += f"; its {name}, {low:.4g} to {high:.4g}, is not kept for others"
        read.note(row.name, words)
    return forces


def _places(model: Model, actuator: int) -> range:
    """Where the controls of an actuator are; newer versions have several of one."""
    if not hasattr(model, "actuator_ctrladr"):
        return range(actuator, actuator + 1)
    first = int(model.actuator_ctrladr[actuator])
    return range(first, first + int(model.actuator_ctrlnum[actuator]))


def _law(
    read: Reader, actuator: int, controls: np.ndarray, states: np.ndarray
) -> _Law | str:
    """The law of an actuator, or what it has that `Actuators` do not."""
    model, mujoco = read.model, read.mujoco
    kind = lambda names, value: names(int(value)).name.rpartition("_")[2]
    dynamics = kind(mujoco.mjtDyn, model.actuator_dyntype[actuator])
    gain_kind = kind(mujoco.mjtGain, model.actuator_gaintype[actuator])
    bias_kind = kind(mujoco.mjtBias, model.actuator_biastype[actuator])
    if model.actuator_plugin[actuator] >= 0:
        return "a plugin"
    if hasattr(model, "actuator_delay") and model.actuator_delay[actuator]:
        return "a delay"
    numbers = model.actuator_dynprm, model.actuator_gainprm, model.actuator_biasprm
    dynprm, gainprm, biasprm = (array[actuator].tolist() for array in numbers)
    state = _OwnState()
    if (place := model.actuator_actadr[actuator]) >= 0:
        lower, upper = map(float, read.bounds("actuator_act", actuator))
        state = state._replace(start=float(states[place]), lower=lower, upper=upper)
    if gain_kind == "DCMOTOR":
        return _dc_motor(dynprm, gainprm, biasprm, state)
    bias = _Affine(*biasprm[:3]) if bias_kind == "AFFINE" else _Affine()
    if gain_kind == "PID":
        given = [float(controls[k]) for k in _places(model, actuator)]
        inputs = int(model.actuator_ctrlspec[actuator])
        own = state if dynamics == "PID" else None
        return _pid(dynprm, gainprm, bias, own, given, inputs)
    if gain_kind not in ("FIXED", "AFFINE") or bias_kind not in ("NONE", "AFFINE"):
        return f"a law of the kinds {gain_kind.lower()} and {bias_kind.lower()}"
    gain = _Affine(*gainprm[: 3 if gain_kind == "AFFINE" else 1])
    if dynamics == "NONE":
        return _Law(gain, bias)
    if dynamics not in ("INTEGRATOR", "FILTER", "FILTEREXACT"):
        return f"dynamics of the kind {dynamics.lower()}"
    if any(gain[1:]):
        return "a state whose gain depends on its length or speed"
    rate = 1 / max(dynprm[0], 1e-15)
    rates = (1.0, 0.0) if dynamics == "INTEGRATOR" else (rate, -rate)
    own = state._replace(gain=gain.constant, rate=(*rates, 0.0, 0.0))
    return _Law(_Affine(), bias, own)


def _pid(
    dynprm: list[float], gainprm: list[float], bias: _Affine, state: _OwnState | None,
    given: list[float], inputs: int,
) -> _Law | str:  # fmt: skip
    """A PID controller: its own state is the integral of the position's error."""
    limit, slew, *_ = dynprm
    if slew > 0:
        return "a limit of the slew rate"
    # The inputs are bits: a position, a velocity and an effort, in this order.
    if not inputs & 1:
        return "no position among the inputs of its controller"
    target = dict(zip([bit for bit in (1, 2, 4) if inputs & bit], given))
    known = -bias.speed * target.get(2, 0.0) + target.get(4, 0.0)
    law = _Law(_Affine(-bias.length), bias._replace(constant=known))
    if state is None:
        return law
    state = state._replace(gain=gainprm[0], rate=(1.0, 0.0, -1.0, 0.0))
    if limit > 0:
        state = state._replace(lower=-limit, upper=limit)
    return law._replace(state=state)


def _dc_motor(
    dynprm: list[float], gainprm: list[float], biasprm: list[float], state: _OwnState
) -> _Law | str:
    """A DC motor: with inductance, its own state is the current."""
    resistance, constant, *others = gainprm
    time, *more = dynprm  # of the winding [s]
    if any(others) or any(more) or any(biasprm):
        return "a DC motor with more than winding, constant and inductance"
    if time == 0:
        drag = constant**2 / resistance
        return _Law(_Affine(constant / resistance), _Affine(speed=-drag))
    inductance = time * resistance
    rate = 1 / inductance, -1 / time, 0.0, -constant / inductance
    return _Law(_Affine(), _Affine(), state._replace(gain=constant, rate=rate))


def _general(rows: list[_Row], lower: np.ndarray, upper: np.ndarray) -> Actuators:
    column = lambda name: np.array([getattr(row, name) for row in rows])
    finite = lambda values: values if np.isfinite(values).any() else None
    activation = None
    if any(row.state for row in rows):
        states = (row.state or _OwnState() for row in rows)
        gain, rate, start, low, high = zip(*states)
        ends = finite(np.array(low)), finite(np.array(high))
        activation = Activation(gain, rate, start, *ends)
    return Actuators(
        gear=column("gear"),
        gain=column("gain"),
        bias=column("bias"),
        control=column("control"),
        lower=finite(column("lower")),
        upper=finite(column("upper")),
        effort_lower=finite(lower),
        effort_upper=finite(upper),
        activation=activation,
    )


def _simple(
    rows: list[_Row], lower: np.ndarray, upper: np.ndarray
) -> list[Element] | None:
    """The actuators as efforts and a PD controller, or None where these will not do."""
    for row in rows:
        if np.count_nonzero(row.gear) > 1 or row.state or any(row.gain[1:]):
            return None
    if (lower != -upper).any():
        return None
    joints = [
        _of_joint([row for row in rows if row.joint == k], most)
        for k, most in enumerate(upper)
    ]
    if None in joints:
        return None
    kp, kd, limit, target, rate, effort = np.array(joints).T
    servos = [row.is_servo for row in rows]
    forces: list[Element] = []
    if any(servos):
        forces.append(PDController(kp, kd, limit, SetPoint(target, rate)))
    if not all(servos):
        forces.append(JointEffort(effort))
    return forces


def _of_joint(rows: list[_Row], most: float) -> tuple[float, ...] | None:
    """kp, kd, limit, position, velocity and effort of the actuators on a joint.

    `most`: the limit of their sum. None if they are more than a PD controller and a
    motor that no limit couples.
    """
    ratio = lambda row: float(row.gear[row.joint])
    push = lambda row: row.gain.constant * row.control + row.bias.constant
    servos = [row for row in rows if row.is_servo]
    motors = [row for row in rows if not row.is_servo]
    effort = sum(ratio(r) * np.clip(push(r), r.lower, r.upper) for r in motors)
    if not servos:
        return 0.0, 0.0, np.inf, 0.0, 0.0, np.clip(effort, -most, most)
    bounded = [row for row in servos if np.isfinite([row.lower, row.upper]).any()]
    if bounded and (len(servos) > 1 or bounded[0].lower != -bounded[0].upper):
        return None
    if motors and np.isfinite(most):
        return None
    kp = -sum(ratio(row) ** 2 * row.bias.length for row in servos)
    kd = -sum(ratio(row) ** 2 * row.bias.speed for row in servos)
    at = sum(ratio(row) * push(row) for row in servos if row.bias.length)
    speed = sum(ratio(row) * push(row) for row in servos if not row.bias.length)
    if min(kp, kd) < 0 or (at and not kp) or (speed and not kd):
        return None
    limit = min(most, *(abs(ratio(row)) * row.upper for row in bounded), np.inf)
    return kp, kd, limit, at / kp if kp else 0.0, speed / kd if kd else 0.0, effort
