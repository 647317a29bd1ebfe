"""The table of refusals: what is called, with which arguments, and what errors say.

Most rows follow from what is declared: each argument of each public callable is refused
by its name, and arrays by the bounds of their fields, but for what the annotation
admits. Written out are sound arguments, and what no declaration tells.
"""

import dataclasses
import functools
import inspect
import re
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from fdof_jax import drawing, forces, plotting, references, tuning

ROOMS = (
    fj, fj.analysis, fj.control, fj.data, forces, fj.identification, fj.paper,
    fj.linkage, references, fj.simulation, tuning, drawing, plotting,
)  # fmt: skip
# Records check nothing, bases take nothing, the mathematics is JAX's, and `configure`
# changes the whole process.
LEFT_OUT = """Condition Drive Efforts Element End Events FitResult Frames
InertialElement Linearization Load Margins MjcfModel Modes NextMotion Part
Path PointElement Reference Report Response Scene Sensitivities Solution State
StatefulElement TuneResult TunedWithin Values accepts_scene called clip configure
controller_in field naming of_kind switch without_fixed""".split()

# Sound arguments


def hold(t, linkage):
    return jnp.zeros(3), jnp.zeros(3)


def height(t, q, qd, linkage):
    return q[0]


def step(limit, *others):
    """Returns a scene of one joint, which follows no task."""
    bar = fj.Linkage("R", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0)
    pd = fj.PDController([6.0], [1.0], [limit], references.SetPoint([1.0]))
    return fj.Scene(bar, fj.State([0.0], [0.0]), (pd, *others), 4.0)


def stacked(tree, members=2):
    return jax.tree.map(lambda a: jnp.stack([a] * members), tree)


FIG7, TS, ZERO, CHAIN = fj.scenes.fig7(), np.linspace(0, 1, 5), np.zeros(3), np.zeros(6)
ARM, START = FIG7.linkage, FIG7.state0
STATS = {"num_steps": np.array(3), "time_reached": np.array(1.0)}
ROWS, SUCCESS = np.zeros((5, 3)), diffrax.RESULTS.successful
MOTION = fj.Solution(TS, ROWS, ROWS, STATS, SUCCESS)
DAMPER, TASK, TRAVEL = fj.JointDamper(1.0), fj.CircleTask(), references.Travel(1.0)
PD, LINE = FIG7.forces[0], references.Line([0, 0], [1, 1])
HELD = fj.PDController(1.0, 1.0, 1.0, hold)
FOUND = fj.FitResult(
    {"a": 1.0}, {"a": 1.0}, ("a",), np.eye(1), (), 0.0, 1.0, True, "", np.ones(1)
)
BY_NAME = dict(
    linkage=ARM, state0=START, state=START, scene=FIG7, ts=TS, solution=MOTION, q=ZERO,
    qd=ZERO, qdd=ZERO, tau=ZERO, forces=(), x=CHAIN, xd=CHAIN, force=CHAIN, t=0.0,
    topology="RRR", tip=np.ones(2), orientation=0.0, reference=TASK, task=TASK,
    controller=PD, joint=1, control=DAMPER, period=0.1, dt=0.1, samples=2,
    frequency=1.0, damping_ratio=1.0, scene_at=lambda p: FIG7, start={"a": 1.0},
    observed=np.zeros((5, 3, 2)), experiment=lambda a: lambda p: FIG7, found=FOUND,
    noise=1.0, bounds={"a": (0, 2)}, limits=tuning.Limits(effort=1.0),
    scenes=[FIG7], motions={"a": (ARM, MOTION)}, solutions={"a": MOTION}, tree=ARM,
    path="no/such/file", model=ARM, source=fj.to_mjcf(ARM), g=height, loop=None,
    response=None, residuals=lambda scene, motion: motion.q[-1], z=np.ones(2),
    function=height,
)  # fmt: skip
OWN = {
    "fit_each": dict(observed=np.zeros((1, 5, 3, 2))),
    "geometry": dict(q=ROWS),
    "step_measures": dict(change=TS, rate=np.ones(5), final=1.0),
    "element_of": dict(value=DAMPER),
    "reference_of": dict(value=TASK),
    "response": dict(forces=(HELD,)),
    "sweep": dict(linkage=stacked(ARM), state0=stacked(START)),
    "tune_within": dict(scene=step(0.1), loss=tuning.joint_errors),
}
LAW = elements.WITH_STATE["actuators"]
PARTS = [
    *elements.ALL.values(), *elements.HOLDING.values(), LAW.activation, elements.TIP,
    fj.simulation.PrescribedMotion(1, hold), tuning.Tracking(), TASK, LINE, TRAVEL,
    tuning.Limits(), forces.stribeck(1, 1, 1), references.SetPoint(ZERO),
    references.Ellipse([1, 1], [1, 1]), references.FigureEight([1, 1], [1, 1]),
    references.Spline([[0, 0], [1, 0], [1, 1]]), references.Laps(1.0),
    references.JointMove(ZERO, ZERO, TRAVEL), references.Step(ZERO, ZERO),
    references.Pulse(ZERO, ZERO, begin=0, end=1), fj.TipTask(LINE, TRAVEL),
    references.Ramp(TS, ROWS), forces.Reset(height, lambda *a: (a[1], a[2])),
]  # fmt: skip


def callables():
    """Returns the public callables, and sound arguments of each, by name."""
    parts = {type(part): part.arguments() for part in [ARM, *PARTS]}
    found = {}
    for room in ROOMS:
        for name in sorted({*room.__all__}.difference(LEFT_OUT)):
            if not callable(function := getattr(room, name)):
                continue
            if found.get(name, [function])[0] is not function:
                name = f"paper.{name}"
            known = BY_NAME | OWN.get(name, {})
            needed = [p.name for p in arguments(function) if p.default is p.empty]
            needed += OWN.get(name, {})
            sound = parts.get(function) or {place: known[place] for place in needed}
            found[name] = function, sound
    return found


def arguments(function):
    given = inspect.signature(function).parameters.values()
    return [p for p in given if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]


# Wrong arguments


class Hostile:
    """An object that raises when it is converted to an array or shown."""

    def __repr__(self):
        raise RuntimeError("no text")

    def __array__(self, *args, **keywords):
        raise RuntimeError("no array")


DELETED = jnp.ones(3) + 1
DELETED.delete()
A_CLASS, HUGE = fj.Linkage, 10**5000
TEXTS = ["one", 1_000_000 * "x" + "\x1b[31m\x07"]
LISTS = [[[1.0], [1.0, 2.0]], ["9"] * 10_000]
DICTS = [{}, {f"key {i}\n": i for i in range(10_000)}]
HOSTILE = [DELETED, Hostile(), HUGE]
# Of any argument
WRONG = [
    None, object(), A_CLASS, float("nan"), 1j, b"abc", jax.random.key(0),
    np.zeros((1, 2, 0)), np.array(["a"]), np.ma.masked_array([1.0], True),
    np.full(3, np.datetime64("2020-01-01")), np.zeros(3, [("a", float), ("b", int)]),
    ARM, MOTION, *TEXTS, *LISTS, *DICTS, *HOSTILE,
]  # fmt: skip
WRONG_BY_TYPE = {bool: [1, 0, [True]], int: [1.5, "8", [1]]}
TWO_JOINTS = fj.Solution(TS, ROWS[:, :2], ROWS[:, :2], STATS, SUCCESS)
NOWHERE = fj.Solution(TS, ROWS * np.nan, ROWS, STATS, SUCCESS)
STATES = [[ZERO], (ZERO,) * 3, ([[0], [0, 1]], ZERO), ([0, 0], [0, 0])]
WRONG_BY_NAME = dict(
    linkage=[stacked(ARM)],
    # The last of these are of other numbers of joints.
    forces=[DAMPER, [DAMPER], (DAMPER, 3.0), (ZERO,), (fj.JointDamper,),
            (fj.JointDamper([1.0, 2.0]),)],
    state0=STATES, state=STATES, solution=[ROWS, TWO_JOINTS],
    ts=[[], 0.5, [[0, 1]], [1, 0], [0, 0], [0, 2, 1], [0, np.nan]],
    topology=[
        "R" * 9, "rrr", "RXR", "", 3, [0, 1, 0], [0, 1] * 9, [[0, 1]] * 3,
        [0, 1, 0, 0.5], [0, 1, 0, np.nan], [0, 1, 0, 1j], ["0", "1"],
    ],
    branch=[0, -1.5, "1", True, [1]], max_steps=[0, -1, True], chunk=[0, -1, True],
    samples=[0, True], starts=[0, True], seed=[-1], max_frames=[0], every=[0],
    configurations=[1], direction=[2, True], fps=[0],
    speed=[-1], until=[-1, ()], shard=[-1, 1], of=[0, True], dt0=[0.0, -1e-3],
    rtol=[0], atol=[[1e-6]], own0=[(0.0,)], progress_meter=[3], reduce=[3, "q"],
    adjoint=[diffrax.BacksolveAdjoint(), diffrax.ImplicitAdjoint()],
    solver=[
        diffrax.Tsit5, diffrax.SemiImplicitEuler(), diffrax.KenCarp4(),
        diffrax.EulerHeun(), diffrax.Euler(),
    ],
    forces_axes=[1, -1, True, "0", (0, 0), [0], (1,)], store=[3, True, ""],
    joints=[0, 9, (1, 0), 1.0, (), [1, 2.0], True], one_sided=["rope", True],
    reference=[3.0, (ZERO, ZERO)], motions=[{"b": 3}, {"b": ("RRR", MOTION)}],
)  # fmt: skip
# What is not checked, or by other libraries; what takes some of those by name
SKIPPED = {
    "draw_linkage.color", "draw_linkage.alpha", "stacked.name", "geometry.forces",
    "save.tree", "next_motion.noise", "present.t",
    "reference_of.value",
    "step_measures.change", "step_measures.rate", "step_measures.final",
}  # fmt: skip
OF_ITS_OWN = {
    "elements_on.linkage", "sweep.linkage", "to_mjcf.linkage", "to_pandas.linkage",
    "to_xarray.linkage", "reach_margin.ts", "reachable.ts", "PIDController.limit",
    "fit.observed", "fit_each.observed", "joint_names.linkage", "joints_of.linkage",
    "moving_joints.linkage", "present.forces", "sensitivities.z",
}  # fmt: skip
# Errors of values that cannot be shown or converted are raised as they are.
NOT_HOSTILE = {
    "fit", "fit_each", "from_mjcf", "sweep", "to_mjcf", "view", "simulate.own0",
}  # fmt: skip


def admits(parameter, value, about):
    """Returns whether an annotation or a declaration admits one of the wrong values."""
    text, is_in = str(parameter.annotation), lambda values: id(value) in map(id, values)
    return (
        value is BY_NAME.get(parameter.name)
        or value is None and ("None" in text or about.get("optional", False))
        or value is HUGE and "int" in text
        or value is A_CLASS and parameter.name in ("experiment", "task")
        or is_in(TEXTS) and "str" in text
        or is_in(LISTS) and "Sequence" in text
        or is_in(DICTS) and "Mapping" in text
    )  # fmt: skip


def declared(function, name):
    """Returns what a field declares of an argument."""
    known = getattr(function, "__dataclass_fields__", {})
    return known[name].metadata if name in known else {}


def wrong_numbers(sound, rules):
    """Yields wrong values in place of an array, and how messages go on."""
    shape, array = np.shape(sound), np.asarray(sound, float)
    infinite = [np.inf, -np.inf] if rules.get("finite", True) else []
    rest = rf".*\[{re.escape(rules['unit'])}\]" if rules.get("unit") else ""
    for entry in (np.nan, *infinite):
        yield np.where(np.arange(array.size).reshape(shape) == 0, entry, array), rest
    for bound, words, below in (("minimum", "at least", 1e-9), ("above", "above", 0.0)):
        if (least := rules.get(bound)) is not None:
            yield np.full(shape, least - below), f".*{words} {least:g}{rest}"
    ones = np.ones(shape)
    for value in (ones * 1j, ones > 0, ones[None, None], np.full(shape, "1").tolist()):
        yield value, rest
    yield np.ma.masked_array(ones, True), rest
    if shape and {None, "joint"}.isdisjoint(rules.get("shape", ())):
        yield np.ones((*shape[:-1], 7)), rest


def refused_values(name, function, sound):
    """Yields arguments by name, wrong values of each, and how messages go on."""
    for p in arguments(function):
        place, about = f"{name}.{p.name}", declared(function, p.name)
        if place in SKIPPED:
            continue
        for value in [*WRONG, *WRONG_BY_TYPE.get(p.annotation, [])]:
            hostile = id(value) in map(id, HOSTILE) and {name, place} & NOT_HOSTILE
            if not (hostile or admits(p, value, about)):
                yield p.name, value, ""
        if place in OF_ITS_OWN:
            continue
        yield from ((p.name, value, "") for value in WRONG_BY_NAME.get(p.name, []))
        good = sound.get(p.name)
        if p.annotation is not int and isinstance(good, float | np.ndarray | jax.Array):
            for value, words in wrong_numbers(good, about.get("rules", {})):
                yield p.name, value, words


# Fields are bounded by 0 if their unit is of what resists, or their name of a size.
RESISTING = """kg, kg m^2, kg m^2 or kg, N/m, N/m or N m/rad, N s/m, N s/m or N m s/rad
s/m or s/rad, N/(m s) or N m/(rad s), ohm, H, N m/A or N/A, V, A""".replace("\n", ", ")
SIZES = """limit level static coulomb stall effort effort_rate rest_length radius sizes
time_constant duration settling_time no_load speed smoothing restitution overshoot
modulus_margin""".split()
POSITIVE = """DCMotor.constant DCMotor.current_limit DCMotor.gear DCMotor.resistance
DCMotor.voltage_limit FirstOrderLag.time_constant JointFriction.speed
JointStops.smoothing JointStops.stiffness Limits.effort SpeedLimit.no_load
SpeedLimit.stall Travel.duration stribeck.speed""".split()

# What no declaration tells: rows of how messages begin, what is changed beside sound
# arguments, and the kind of error unless it is a ValueError


def each(words, name, *values):
    return [(words, {name: value}) for value in values]


def acting(words, *acts, error=ValueError, **changes):
    """Returns a row with force elements; "@" stands for the place of the last."""
    place = rf"forces\[{len(acts) - 1}\]"
    return words.replace("@", place), dict(forces=acts, **changes), error


def seven(_):
    return jnp.ones(7)


def returns(value):
    return lambda t, q, qd, linkage: value


def following(motion):
    """Yields rows of a controller, of a lag of it, and of a lag of that."""
    words = "@.reference"
    element = fj.PDController(1.0, 1.0, 1.0, lambda t, linkage: motion)
    for _ in range(3):
        yield acting(words, element)
        words = words.replace("@", r"@.command")
        element = fj.control.FirstOrderLag(element, 0.1)


def spoilt(tree, name, change):
    """Returns the tree with another array, past its constructor."""
    place = lambda tree: getattr(tree, name)
    return eqx.tree_at(place, tree, change(place(tree)))


@dataclasses.dataclass
class Unhashable:
    def __call__(self, *arguments):
        return arguments[0]


class Rows(fj.Element):
    rows: jax.Array

    def __call__(self, t, q, qd, linkage):
        return -qd / len(self.rows)


class Pair(NamedTuple):
    left: Any
    right: Any


class Nowhere(references.Path):
    """A path without a middle."""

    def point(self, share):
        return jnp.stack([share, share])


def past_constructors():
    """Yields elements, spoilt in one array each, and how the door refuses them."""
    for name, place in WITHIN.items():
        of = lambda part, place=place: functools.reduce(getattr, place.split("."), part)
        part = elements.ALL[name]
        spoilt_part = eqx.tree_at(of, part, -jnp.ones(3))
        yield part, spoilt_part, rf"(forces\[0\]\.)?{place}: expected"
    for part in ELEMENTS:
        for name, about in type(part).__dataclass_fields__.items():
            rules, value = about.metadata.get("rules"), getattr(part, name)
            if not rules or not eqx.is_array(value):
                continue
            wrong = [(lambda a: a * np.nan, "")]
            for bound, least in (("minimum", "at least"), ("above", "above")):
                if rules[bound] == 0:
                    wrong.append((lambda a: -1 - a, f".* {least} 0"))
            if rules["shape"] == ("joint",):
                wrong.append((lambda a: jnp.ones(2), "numbers for 3 joints, .* got 2"))
            for change, words in wrong:
                words = rf"forces\[0\]\.({name}|jump_ts): expected {words}"
                yield part, spoilt(part, name, change), words


ELEMENTS = [part for part in PARTS if isinstance(part, fj.Element)]
WITHIN = {"computed torque": "model.mass", "motor with PID": "command.pd.kd"}
LAG, SHAPED = fj.control.FirstOrderLag(DAMPER, 0.1), np.zeros((1, 2, 3))
FRICTION, STOPS = forces.JointFriction(0.4), forces.HardStops(-1, 1)
BRAKE, MOVED = forces.Brake(1), fj.simulation.PrescribedMotion(1, hold)
RESET = forces.Reset(height, lambda t, q, qd, linkage: (q, qd))
FIG5, RRR = fj.scenes.fig5(), fj.scenes.circle_scenes()["RRR"]
ONES, FIXED = np.ones((2, 3)), diffrax.ConstantStepSize()
FLAT = tuple(ONES[:, :2])  # of two joints
UNLIMITED = FIG7._replace(forces=(PD.replace(limit=np.full(3, np.inf)),))
TWO, TWO_STARTS, SEEN = stacked(ARM), stacked(START), np.zeros((5, 3, 2))
SHARED = "linkage, state0, forces"
BARE = fj.Scene(ARM, START, (), 1.0)
# Elements of chains of two or four joints
PER_JOINT, FAR = "expected numbers for 3 joints, .*got 2", fj.Point(4, 0.1)
AT_ZERO = references.SetPoint([0, 0])
FOREIGN = [
    acting(f"@.{words}", element) for words, element in (
        (f"reference.q: {PER_JOINT}", PD.replace(reference=AT_ZERO)),
        (f"command.tau: {PER_JOINT}", LAG.replace(command=fj.JointEffort([1, 2]))),
        ("reference: .* 3 real numbers", PD.replace(reference=lambda *_: FLAT)),
        ("b.link: expected 0 .* 1 to 3, got 4", fj.SpringDamper(fj.Point(0), FAR)),
        ("point.link: expected 0 .* 1 to 3, got 4", fj.Wrench(FAR, [1, 0])),
        ("model: expected the arm's own topology", fj.control.ComputedTorque(
            1, 1, 1, hold, FIG5.linkage)),
    )
]  # fmt: skip
MORE = {
    "Linkage": [
        ("length: .* 4 real numbers for the ground and 3 moving", dict(length=ONES)),
        ("com: .* 3x2 real numbers for 3 moving links", dict(com=ONES)),
        ("mass: .* 3 real numbers for 3 moving links", dict(mass=ONES)),
        *((rf"{name}: .* at least 0, got \[", {name: [1, 1, -1]})
          for name in ("mass", "inertia")),
        *each("topology: .* 1 to 8 letters", "topology", "RXR", [0, 1j]),
        *each("topology: .* joint that moves, got fixed", "topology", "FFF", [0] * 6),
        *each("topology: .* one real joint at most in each", "topology", [0, 1, 1, 1]),
    ],
    "simulate": [
        *FOREIGN,
        ("rtol, atol, max_step: expected none beside a stepsize_controller",
         dict(rtol=1e-6, stepsize_controller=FIXED)),
        *((f"linkage.{named}", dict(linkage=spoilt(ARM, name, change)))
          for named, name, change in (
              ("mass", "mass", lambda a: -a), ("length", "length", lambda a: a / 0),
              ("topology", "ef", lambda a: a * 0), ("locked", "locked", lambda a: a[0]),
          )),
        *((rf"state0\.{name}: expected .+, got ",
           dict(state0=START._replace(**{name: value})))
          for name in ("q", "qd") for value in (None, ZERO[:2], ZERO * 1j)),
        *each(r"until: .* got one of shape \(3,", "until", lambda t, q, *_: q),
        ("until: expected jax.numpy", dict(until=lambda t, *_: 1 - bool(t)), TypeError),
        (r"^until: .* \(t, q, qd, l.* other arg", dict(until=lambda t: t), TypeError),
        ("stepsize_controller: .* a condition that ends the motion",
         dict(until=height, stepsize_controller=FIXED)),
        acting(r"@.when: .* shape \(3,", forces.Reset(lambda t, q, *_: q, RESET.then)),
        *(acting("@.then: expected", forces.Reset(height, returns(value)))
          for value in (ZERO, (ZERO, ONES))),
        *(acting("stepsize_controller: expected an adaptive", element,
                 stepsize_controller=FIXED, dt0=0.01) for element in (FRICTION, RESET)),
        *(acting("@: expected", DAMPER, returns(tau)) for tau in (
            np.zeros(2), 0.0, ZERO * 1j, None, (ZERO, ZERO))),
        *(acting(f"forces: expected one {type(element).__name__}", element, element)
          for element in (STOPS, MOVED)),
        *(acting("@.joints: expected 1 to 3, got 4", element.replace(joints=4))
          for element in (BRAKE, MOVED)),
        acting("@.command: expected an array of 3", LAG.replace(command=returns(5.0))),
        *(acting(f"@.level: {words}", forces.JointFriction(returns(value)))
          for words, value in ((".* array of n", SHAPED), (".* 3 joints", FLAT[0]))),
        *following(None),
        *(next(following(it)) for it in (ZERO, FLAT)),
        acting("@.reference: .* of 3", MOVED.replace(reference=lambda *_: FLAT)),
    ],
    "sweep": [
        (SHARED, dict(linkage=ARM, state0=START)),
        (SHARED, dict(linkage=TWO, state0=stacked(START, 3))),
        (SHARED, jax.tree.map(lambda a: a[:0], dict(linkage=TWO, state0=TWO_STARTS))),
        ("linkage.gravity", dict(linkage=spoilt(TWO, "gravity", lambda a: a[None]))),
        *((r"state0\.q", dict(state0=TWO_STARTS._replace(q=value)))
          for value in (1.0, ZERO[:2], SHAPED, ONES > 0)),
        *each("linkage: .*\\*arms\\) stacks", "linkage", [ARM, ARM]),
        acting(r"linkage, state0, forces.* none on any \(pass forces_axes",
               stacked(fj.JointDamper(1.0)), linkage=ARM, state0=START),
        acting("forces", Unhashable()),
        acting("forces, forces_axes: .*forces_axes=0", Rows(np.ones(2)), forces_axes=0,
               error=TypeError),
        *each("reduce", "reduce", lambda motion: motion.q,
              lambda *_: (1.0, jax.random.key(0))),
        ("store", dict(shard=1, of=2)),
        ("sweep.* unexpected .*'rtoll'", dict(rtoll=1e-6), TypeError),
    ],
    "tune": [
        ("factor", dict(factor=2.0, bounds=(ONES, ONES))),
        *each("over: expected an ensemble", "over", "worst"),
        *each(r"ensemble\[0\]: expected joints", "ensemble", tuning.stacked([RRR])),
        ("loss: expected finite limits",
         dict(loss=tuning.Tracking(effort=1), scene=UNLIMITED)),
        *each("bounds", "bounds", (1, 2, 3), (ONES, ONES[:, :2]), (ONES, 2 * ONES)),
        *each("scene: expected exactly one PDController", "scene", FIG5),
        *each(r"loss\(scene, solution\): expected a", "loss", lambda *_: "a"),
    ],
    "stacked": each(r"scenes\[1\]: expected one like scenes\[0\]", "scenes",
                    [FIG7, FIG5], [RRR, RRR._replace(forces=(*RRR.forces, DAMPER))]),
    "tune_within": [
        *each(".* controller to track a task with a `tip`", "loss", tuning.Tracking()),
        *each("limits.overshoot: .* for 1 joints", "limits", tuning.Limits([0.1, 0.1])),
        *each("forces.*: .* without a state", "scene", step(0.1, LAG)),
    ],
    "fit": [
        *each(r"scene_at\(...\): expected a Scene", "scene_at", lambda p: p["a"]),
        *each("start: expected a value for 'b'", "scene_at", lambda p: p["b"]),
        *each("observed: expected a recording for each", "scene_at", [hold] * 2),
        *each(r"start\['a'\]: expected", "start", {"a": np.nan}, {"a": [[1], [2, 3]]}),
        *each("scale: expected a size for 'a'", "start", {"a": 0.0}),
        *each(r"bounds\['a'\]: expected bounds around", "bounds", {"a": (2, 3)}),
        *each("ts: expected increasing times, two", "ts", TS[::-1], TS[:1]),
        *each("observed: expected a row for each of the 5", "observed", SEEN[:3], 3.0),
        *each("observed: expected the shape", "observed", SEEN[:, :2]),
        *each("observed: expected more readings than the 1", "observed", SEEN * np.nan),
        *each("noise: expected one number, or an array that", "noise", np.ones((4, 2))),
        *each(r"validate\[1\]: expected a row for each", "validate", (hold, SEEN[:3])),
    ],
    "fit_each": each("observed: expected recordings", "observed", 3.0),
    "next_motion": [
        *each(r"bounds\['a'\]: expected", "start", {"a": 9.0}),
        *each("bounds: expected finite ones for all of", "bounds", {}),
        ("start: .* between -1 and 1 .* entry", dict(
            experiment=lambda a: lambda p: step(0.1), within=lambda s, m: m.q + 9)),
    ],
    "simulate_sampled": each("forces", "forces", [LAG])
    + [("noise, key", dict(noise=(0.1, 0.1)))],
    "ode_term": [
        ("scene.*: expected .*no ", dict(scene=BARE._replace(forces=(element,))))
        for element in (FRICTION, STOPS, BRAKE, MOVED, elements.HOLDING["taken"], RESET)
    ],
    "gains_from_frequency": each("frequency: .* for 3 joints", "frequency", [1, 2])
    + each(r"frequency: .* above 0 \[rad/s\]", "frequency", 0),
    "open_loop": [
        *each(r"joint: expected one of \(1, 2, 3\), got [04T]", "joint", 0, 4, True),
        *each("controller: expected one that", "controller", MOVED),
    ],
    "from_chain": each("topology: expected no fixed pair", "topology", "RFR"),
    "present": each("forces", "forces", *WRONG_BY_NAME["forces"][:-1]),
    "reachable": each("reference", "reference", LINE, HELD, lambda t, linkage: None),
    "tip_errors": each("scene", "scene", BARE._replace(forces=(HELD,))),
    "step": [acting("forces: expected elements without", LAG)],
    **{name: [acting("forces.*: expected an element without", e) for e in (LAG, MOVED)]
       for name in ("linearize", "equilibrium", "closed_loop_modes")},
    "response": [
        acting("forces: expected one controller", HELD, HELD),
        *each("since: expected a time before .* 1 s", "since", 6.0),
        *each("solution: .* that reached its end", "solution", NOWHERE),
        acting("solution.own: expected the states",
               fj.control.PIDController(1.0, 1.0, 1.0, 1.0, hold)),
    ],
    "tip_position": [
        (rf"linkage\.{name}: .* 3 pairs", dict(linkage=spoilt(ARM, name, seven)))
        for name in ("com", "length", "mass")],
    "to_xarray": each("solution.ts: expected the same times", "solution",
                      spoilt(stacked(MOTION), "ts", lambda a: a.at[1].add(1.0))),
    "to_mjcf": [
        acting(words, DAMPER, element) for words, element in (
            (".*got GravityFeedforward", fj.control.GravityFeedforward(1, 1, 1, TASK)),
            (".*states that follow", LAW),
            (".*expected one JointDamper", DAMPER),
            (".*no damping of a cable", elements.PLAIN["cable"]),
            (".*link: expected", fj.Wrench(fj.Point(5), [1, 0])),
            *(("@: expected one friction per joint, .* got JointFriction",
               forces.JointFriction(level))
              for level in ([[1] * 3, [2] * 3], forces.stribeck(1, 2, 3))),
        )
    ],
    "view": [
        ("linkage", dict(linkage={"a": BARE}, solution={"b": MOTION})),
        *each("solution", "solution", {}, NOWHERE, {"a": 3}),
        ("forces", dict(solution={"a": MOTION}, forces={"b": ()})),
        *each("path", "path", "", Path(__file__).parent, "no such folder/a.html"),
    ],
    "tracking": each(r"solutions\['a'\]", "solutions", {"a": stacked(MOTION)}),
    **{name: each(r"motions\['a'\]", "motions", {"a": MOTION}, {"a": (ARM, TWO_JOINTS)})
       + each("motions", "motions", {}) + each("forces", "forces", {"b": ()})
       for name in ("topology_grid", "animate_grid")},
    **{name: each("solution", "solution", stacked(MOTION), NOWHERE) for name in (
        "animate", "chrono_cyclograph", "motion_profile", "energy_profile",
        "energy_stack", "tracking_by_error")},
    # Conditions of parts
    **{name: [(words, changes)] for name, words, changes in (
        ("PIDController", "ki: expected 0 where kp is", dict(kp=[1, 1, 0.0])),
        ("DCMotor", "inductance: expected above 0 in all", dict(inductance=[0, 1, 1])),
        ("JointStops", "lower: expected less than upper", dict(lower=9)),
        ("Brake", "begin: expected less than end", dict(begin=2.0)),
        ("Point", "link: expected 0", dict(link=9)),
        ("Step", "after: expected as many numbers as be", dict(before=[0, 1])),
        ("Laps", "period: expected not zero", dict(period=0)),
        ("CircleTask", "period: expected not zero", dict(period=0)),
        ("Travel", "profile: expected one of", dict(profile="linear")),
        ("Spline", "points: expected three or more", dict(points=ROWS[:2, :2])),
    )},
    "JointFriction": [
        ("level: expected .*, or 2 such rows", dict(level=np.ones((3, 2)))),
        *(("static: expected at least the level", dict(level=level, static=1.0))
          for level in (2.0, [[1], [2]])),
        (r"level, static: .* of one length, got shapes \(3,\), \(2,\)",
         dict(level=[1, 2, 3], static=[1, 2])),
        ("static: expected none beside", dict(static=2, speed=1)),
    ],
    **{name: each("model.mass: expected", "model", spoilt(ARM, "mass", lambda a: -a))
       for name in ("GravityFeedforward", "ComputedTorque")},
    "HardStops": each("lower: expected less than upper", "lower", 9)
    + each("restitution: expected at most 1", "restitution", 1.1),
    "Payload": [
        ("begin: expected less than", dict(begin=2, end=1)),
        ("velocity: expected two or", dict(velocity=[1])),
        ("velocity: expected zeros", dict(velocity=[1, 0], begin=None)),
        ("place: expected a point of a moving link", dict(place=fj.Point(0))),
    ],
    "TipTask": each("path: expected a Path that .*`middle`.*got", "path", Nowhere()),
    "EffortHistory": each("ts: expected increasing", "ts", [0, 0, 1, 2], [])
    + each("tau: expected 4 rows", "tau", np.ones((3, 3))),
    "Pulse": [
        ("begin: expected less than end", dict(begin=2)),
        ("inside: expected as", dict(outside=[0, 1], inside=[0, 1, 2])),
    ],
    "Ramp": [
        ("ts: expected two or more increasing", dict(ts=[0.0], q=[[1.0]])),
        ("q: expected 2 rows, one per time, got 1", dict(ts=[0, 1], q=[[1.0]])),
    ],
}  # fmt: skip

# What traces or compiles much
SLOW = "next_motion simulate sweep tune".split()
# Functions for known values alone, and how they tell it
KNOWN_ALONE = {
    "tune": "scene: expected known", "response": "solution: expected known",
    "closed_loop_modes": "solution: expected known", "Brake": "joints: expected known",
    "to_mjcf": "linkage: expected one Linkage, and known",
    "to_pandas": ".*outside of JAX", "to_xarray": ".*outside of JAX",
    "save": "tree.*expected .*outside of jit",
}  # fmt: skip

# Files of JSON

ENDLESS = []
ENDLESS.append(ENDLESS)
(OF_A_FUNCTION,) = forces.elements_on(ARM, (height,))
UNSAVED = [
    (hold, "equinox.Module .* got <function"), (Rows, "class .*Rows"), ("inf", "'inf'"),
    ({1: 2}, r"dicts with text keys, .* got \{1: 2\}"), (DELETED, "real numbers"),
    (np.ma.zeros(2), "real numbers.*masked"), (np.zeros((0, 3)), "at least one"),
    (MOTION, "to_xarray .* got Solution"), (OF_A_FUNCTION, "public class, .*Foreign"),
    *((dataclasses.make_dataclass(name, ["a"], namespace={"__module__": "own"})(1.0),
       "of another name") for name in ("JointDamper", "fdof_jax", "value", "dict")),
    (2**64, "at most 64 bits, got 18446744073709551616"),
    (eqx.nn.MLP(6, 3, 8, 1, key=jax.random.key(0)),
     "equinox.tree_serialise_leaves .*dtype, key"),
    (TWO, "equinox.tree_serialise_leaves .*; topology: .*2, 6"),
]  # fmt: skip
MORE["save"] = [
    ("tree: expected .*without end", dict(tree=ENDLESS)),
    *((rf"tree\.forces\[1\]\.right: expected .*{words}.*\.$",
       dict(tree=FIG7._replace(forces=(DAMPER, Pair(1.0, value)))))
      for value, words in UNSAVED),
]  # fmt: skip


def of(text):
    return f'{{"fdof_jax": "0.2", {text}}}'


def element(name, arguments):
    return of(f'"value": ["x", {{"{name}": {arguments}}}]')


AT = r"tree\[1\]"
UNREADABLE = {
    # No JSON, or that of other programs
    "": "expected JSON, got .*line 1",
    of('"value": 1') + "{}": "expected JSON, got Extra data",
    of('"value": NaN'): 'expected JSON, got NaN, which is no number \\("inf"',
    of('"value": 1e999'): "expected JSON, got 1e999",
    of('"dict": {"a": 1, "a": 2}'): "name twice in one object, of .*'a', 'a'",
    '{"a":' * 100_000: "expected less nesting",
    '{"fdof_jax": "new", "value": 1}': "version of the library, .* got 'new'",
    '{"fdof_jax": "0.99.1", "Unheard": {}}': "or an older version, got '0.99.1'",
    # Objects
    of('"State": {}, "Scene": {}'): r"its name alone, got \['State', 'Scene'\]",
    of('"value": {"value": 1}'): "tree.value: expected named arguments, got 1",
    element("JointDamper", "{}"): f"{AT}: expected the arguments .*'coefficient'",
    element("JointDamper", '{"gain": 1}'): f"{AT}: expected the arguments .*'gain'",
    element("State", '{"q": [1]}'): f"{AT}: expected the arguments of State.*'qd'",
    element("JointDamper", '{"coefficient": -1}'): f"{AT}.coefficient: .*at least 0",
    element("JointStops", '{"lower": 1, "upper": 0}'): f"{AT}.lower: .*less than upper",
    element("Wrench", '{"point": {"Point": {"link": 9}}}'): f"{AT}.point.link: .*got 9",
    element("Element", "{}"): f"{AT}: expected the arguments .*abstract",
    # Arrays
    of('"value": [1, "x"]'): r"tree: expected numbers .*got \[1, 'x'\]",
    of(f'"value": [{2**63}, -1]'): "tree: expected numbers .* 64 bits",
    of(f'"value": {"[" * 99}1{"]" * 99}'): "tree: expected numbers",
}
