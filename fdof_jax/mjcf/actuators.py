"""Actuators of a MuJoCo model, and the elements that act alike."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import Element, JointEffort, PDController
from ..references import SetPoint
from .chain import Chain, Reader
from .checks import real_numbers
from .law import Activation, Actuators
from .source import Model


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


class _Row(NamedTuple):
    """An actuator, in the terms of `Actuators`: its law, and where it acts."""

    gain: _Affine
    bias: _Affine
    state: _OwnState | None = None
    name: str = ""
    gear: np.ndarray = np.zeros(0)  # (n,)
    control: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    control_range: np.ndarray | None = None


def _gear(read: Reader, chain: Chain, actuator: int) -> np.ndarray | None:
    """Ratios of an actuator to q; None if it acts elsewhere."""
    model, kinds = read.model, read.mujoco.mjtTrn
    target = model.actuator_trnid[actuator, 0]
    kind = kinds(int(model.actuator_trntype[actuator]))
    if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
        gear = chain.signs * (chain.joints == target)
    elif kind != kinds.mjTRN_TENDON or (gear := sum_of(read, chain, target)) is None:
        return None
    return gear * model.actuator_gear[actuator, 0]


def sum_of(read: Reader, chain: Chain, tendon: int) -> np.ndarray | None:
    """Ratios of a fixed tendon's length to q; None if other joints take part."""
    model, wraps = read.model, read.path_of_tendon(tendon)
    if (model.wrap_type[wraps] != int(read.mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return None
    coefficients = np.zeros(model.njnt)
    np.add.at(coefficients, model.wrap_objid[wraps], model.wrap_prm[wraps])
    here = coefficients[chain.joints] * chain.signs
    return None if here.any() and np.delete(coefficients, chain.joints).any() else here


def inertias_of_actuators(read: Reader, chain: Chain) -> np.ndarray:
    """Damping and armature that newer actuators add to joints, (2, n)."""
    model, sums = read.model, np.zeros((2, len(chain.joints)))
    if "actuators" in read.drop or not hasattr(model, "actuator_armature"):
        return sums
    for actuator in range(len(model.actuator_trntype)):
        values = model.actuator_damping[actuator], model.actuator_armature[actuator]
        bent = read.has("actuator_dampingpoly", actuator)
        if not any(values) and not bent:
            continue
        gear = _gear(read, chain, actuator)
        if bent or gear is None or np.count_nonzero(gear) > 1:
            name = f"actuator {read.name_of('actuator', actuator)}"
            read.leave("actuators", name, "damping or armature that joints do not have")
        else:
            sums += np.outer(values, gear**2)
    return sums


def actuators(read: Reader, chain: Chain, controls: ArrayLike | None) -> list[Element]:
    """PD controllers and efforts where these will do, else `Actuators`."""
    model = read.model
    if controls is None:
        controls = model.key_ctrl[0] if model.nkey else np.zeros(model.nu)
    controls = real_numbers("controls", controls, (model.nu,))
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
        elif "actuators" in read.drop:
            read.note(name, "left out, as asked")
        elif (gear := _gear(read, chain, actuator)) is None:
            kind = read.mujoco.mjtTrn(int(model.actuator_trntype[actuator]))
            what = f"a transmission ({kind.name[6:].lower()}) beyond the chain's joints"
            read.leave("actuators", name, what)
        elif not gear.any():
            read.note(name, "left out, as it acts on nothing of the chain")
        elif isinstance(law := _law(read, actuator, controls, states), str):
            read.leave("actuators", name, law)
        elif not any(law.gain) and not any(law.bias) and law.state is None:
            read.note(name, "left out, as its gains are 0")
        else:
            lower, upper = map(float, read.bounds("actuator_force", actuator))
            place = _places(model, actuator)[0]
            within = ranges[place] if clamped[place] else None
            own = name, gear, float(controls[place]), lower, upper, within
            rows.append(_Row(*law[:3], *own))
    lower, upper = read.bounds("jnt_actfrc", chain.joints, chain.signs)
    if not rows:
        return []
    forces = _simple(rows, lower, upper) or [_general(rows, lower, upper)]
    kinds = " and ".join(type(force).__name__ for force in forces)
    for row in rows:
        if len(forces) > 1:
            kinds = "PDController" if any(row.bias[1:]) else "JointEffort"
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
    """Places of an actuator's controls, of which newer versions have several."""
    if not hasattr(model, "actuator_ctrladr"):
        return range(actuator, actuator + 1)
    first = int(model.actuator_ctrladr[actuator])
    return range(first, first + int(model.actuator_ctrlnum[actuator]))


def _law(
    read: Reader, actuator: int, controls: np.ndarray, states: np.ndarray
) -> _Row | str:
    """The law of an actuator, or what it has that `Actuators` do not."""
    model, mujoco = read.model, read.mujoco
    kind = lambda names, value: names(int(value)).name.rpartition("_")[2]
    dynamics = kind(mujoco.mjtDyn, model.actuator_dyntype[actuator])
    gain_kind = kind(mujoco.mjtGain, model.actuator_gaintype[actuator])
    bias_kind = kind(mujoco.mjtBias, model.actuator_biastype[actuator])
    if model.actuator_plugin[actuator] >= 0:
        return "a plugin"
    if read.has("actuator_delay", actuator):
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
        own = state if dynamics == "PID" else None
        inputs = int(model.actuator_ctrlspec[actuator])
        return _pid(dynprm, gainprm, bias, own, given, inputs)
    if gain_kind not in ("FIXED", "AFFINE") or bias_kind not in ("NONE", "AFFINE"):
        return f"a law of the kinds {gain_kind.lower()} and {bias_kind.lower()}"
    gain = _Affine(*gainprm[: 3 if gain_kind == "AFFINE" else 1])
    if dynamics == "NONE":
        return _Row(gain, bias)
    if dynamics not in ("INTEGRATOR", "FILTER", "FILTEREXACT"):
        return f"dynamics of the kind {dynamics.lower()}"
    if any(gain[1:]):
        return "a state whose gain depends on its length or speed"
    rate = 1 / max(dynprm[0], 1e-15)
    rates = (1.0, 0.0) if dynamics == "INTEGRATOR" else (rate, -rate)
    own = state._replace(gain=gain.constant, rate=(*rates, 0.0, 0.0))
    return _Row(_Affine(), bias, own)


def _pid(
    dynprm: list[float], gainprm: list[float], bias: _Affine, state: _OwnState | None,
    given: list[float], inputs: int,
) -> _Row | str:  # fmt: skip
    """A PID controller: its own state is the integral of the position's error."""
    limit, slew, *_ = dynprm
    if slew > 0:
        return "a limit of the slew rate"
    # The inputs are bits: a position, a velocity and an effort, in this order.
    if not inputs & 1:
        return "no position among the inputs of its controller"
    target = dict(zip([bit for bit in (1, 2, 4) if inputs & bit], given))
    known = -bias.speed * target.get(2, 0.0) + target.get(4, 0.0)
    law = _Row(_Affine(-bias.length), bias._replace(constant=known))
    if state is None:
        return law
    state = state._replace(gain=gainprm[0], rate=(1.0, 0.0, -1.0, 0.0))
    if limit > 0:
        state = state._replace(lower=-limit, upper=limit)
    return law._replace(state=state)


def _dc_motor(
    dynprm: list[float], gainprm: list[float], biasprm: list[float], state: _OwnState
) -> _Row | str:
    """A DC motor: with inductance, its own state is the current."""
    resistance, constant, *others = gainprm
    time, *more = dynprm  # of the winding [s]
    if any(others) or any(more) or any(biasprm):
        return "a DC motor with more than winding, constant and inductance"
    if time == 0:
        drag = constant**2 / resistance
        return _Row(_Affine(constant / resistance), _Affine(speed=-drag))
    inductance = time * resistance
    rate = 1 / inductance, -1 / time, 0.0, -constant / inductance
    return _Row(_Affine(), _Affine(), state._replace(gain=constant, rate=rate))


def _columns(rows: list[_Row]) -> list[Any]:
    names = "gear", "gain", "bias", "control", "lower", "upper"
    return [np.array([getattr(row, name) for row in rows]) for name in names]


def _general(rows: list[_Row], lower: np.ndarray, upper: np.ndarray) -> Actuators:
    finite = lambda values: values if np.isfinite(values).any() else None
    activation = None
    if any(row.state for row in rows):
        states = (row.state or _OwnState() for row in rows)
        gain, rate, start, low, high = zip(*states)
        ends = finite(np.array(low)), finite(np.array(high))
        activation = Activation(gain, rate, start, *ends)
    values = _columns(rows)
    values[4:] = map(finite, (*values[4:], lower, upper))
    return Actuators(*values, activation=activation)


def _simple(
    rows: list[_Row], lower: np.ndarray, upper: np.ndarray
) -> list[Element] | None:
    """The actuators as efforts and a PD controller, or None where these will not do.

    `lower`, `upper`: limits of the sum on each joint, which couple its actuators.
    """
    gear, gain, bias, control, low, high = _columns(rows)
    on, servo = gear != 0, bias[:, 1:].any(axis=1)
    bounded = servo & np.isfinite([low, high]).any(axis=0)
    servos, motors, bounds = (on[who].sum(axis=0) for who in (servo, ~servo, bounded))
    coupled = (bounds > 0) & (servos > 1) | (servos * motors > 0) & np.isfinite(upper)
    if (
        any(row.state for row in rows)
        or gain[:, 1:].any()
        or (on.sum(axis=1) > 1).any()
        or coupled.any()
        or (lower != -upper).any()
        or (low != -high)[bounded].any()
    ):
        return None
    push = gain[:, 0] * control + bias[:, 0]
    at_place = servo & (bias[:, 1] != 0)
    at_rate = servo & ~at_place
    kp, kd = 0 - bias[:, 1:].T @ gear**2  # never -0
    place, rate = (gear[who].T @ push[who] for who in (at_place, at_rate))
    if (kp < 0).any() or (kd < 0).any() or place[kp == 0].any() or rate[kd == 0].any():
        return None
    effort = gear[~servo].T @ np.clip(push, low, high)[~servo]
    ratio = abs(gear[bounded])
    own = np.where(ratio > 0, ratio * high[bounded, None], np.inf)
    most = np.minimum(upper, own.min(axis=0, initial=np.inf))
    limit = np.where(servos > 0, most, np.inf)
    forces: list[Element] = []
    if servo.any():
        target, speed = place / np.where(kp > 0, kp, 1), rate / np.where(kd > 0, kd, 1)
        forces.append(PDController(kp, kd, limit, SetPoint(target, speed)))
    if not servo.all():
        forces.append(JointEffort(np.clip(effort, -upper, upper)))
    return forces
