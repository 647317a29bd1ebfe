"""Every malformed argument raises an error that names it, before any computation."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import drawing


def make(topology="RRR", **changes):
    arguments = dict(
        length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
    )
    return fj.Linkage(topology, **{**arguments, **changes})


LINKAGE = make()
ZERO, CHAIN = np.zeros(3), np.zeros(6)
STATE = fj.State(ZERO, ZERO)
TS = [0.0, 0.01]
SOLUTION = fj.Solution(
    jnp.zeros(2), jnp.zeros((2, 3)), jnp.zeros((2, 3)), {}, diffrax.RESULTS.successful
)


def reference(t, linkage):
    return jnp.zeros(3), jnp.zeros(3)


def controller(kp=1, kd=1, limit=1, reference=reference):
    return fj.PDController(kp, kd, limit, reference)


def simulate(linkage=LINKAGE, state0=STATE, ts=TS, forces=(), **keywords):
    return fj.simulate(linkage, state0, ts, forces, **keywords)


def refused(name, call, *arguments):
    """Checks that the message states the argument, the expectation and the value."""
    with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .+, got .+\.$"):
        call(*arguments)


def start(**parts):
    return simulate(state0=fj.State(parts["state0.q"], parts["state0.qd"]))


# Arrays of real numbers: functions and good arguments, one of which is replaced.

AT, IN_CHAIN = dict(linkage=LINKAGE, q=ZERO), dict(linkage=LINKAGE, x=CHAIN)
CALLS = [
    (make, dict(length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3)),
    (make, dict(inertia=[1] * 3, locked=ZERO, base_angle=0.0, gravity=9.81)),
    (fj.paper.to_chain, AT | dict(qd=ZERO)),
    (fj.paper.from_chain, dict(topology="RRR", x=CHAIN, xd=CHAIN, base_angle=0.0)),
    (fj.joint_positions, AT),
    (fj.mass_centers, AT),
    (fj.tip_position, AT),
    (fj.tip_jacobian, AT),
    (fj.inverse_kinematics, dict(linkage=LINKAGE, tip=[1, 1], orientation=0.0)),
    (fj.paper.mass_matrix, IN_CHAIN),
    (fj.paper.bias_force, IN_CHAIN | dict(xd=CHAIN)),
    (fj.paper.masked_accelerations, IN_CHAIN | dict(xd=CHAIN, force=CHAIN)),
    (fj.paper.constraint_forces, IN_CHAIN | dict(xd=CHAIN, force=CHAIN)),
    (fj.forward_dynamics, AT | dict(qd=ZERO, tau=ZERO)),
    (fj.inverse_dynamics, AT | dict(qd=ZERO, qdd=ZERO)),
    (fj.energy, AT | dict(qd=ZERO)),
    (fj.link_energies, AT | dict(qd=ZERO)),
    (fj.JointDamper, dict(coefficient=ZERO)),
    (fj.JointEffort, dict(tau=ZERO)),
    (controller, dict(kp=ZERO, kd=ZERO, limit=ZERO)),
    (fj.CircleTask, dict(center=[-4, 2], radius=1.0, period=1.0)),
    (fj.CircleTask, dict(phase=0.0, orientation=0.0)),
    (fj.CircleTask().tip, dict(t=0.0)),
    (fj.CircleTask().__call__, dict(t=0.0, linkage=fj.scenes.fig7().linkage)),
    (start, {"state0.q": ZERO, "state0.qd": ZERO}),
    (simulate, dict(linkage=LINKAGE, ts=TS)),
]
ARRAYS = {
    f"{function.__name__} {name}": (
        name,
        np.shape(good[name]),
        lambda v, f=function, good=good, name=name: f(**good | {name: v}),
    )
    for function, good in CALLS
    for name in good
    if name not in ("linkage", "topology")
}
UNBOUNDED = {"controller limit"}  # infinity means no limit
ANY_LENGTH = {  # of time, or of another arm
    "simulate ts", "JointDamper coefficient", "JointEffort tau", "controller kp",
    "controller kd", "controller limit",
}  # fmt: skip

MALFORMED = {
    "None": lambda shape: None,
    "text": lambda shape: "one",
    "texts": lambda shape: np.full(shape, "1").tolist(),
    "complex": lambda shape: np.ones(shape) * 1j,
    "bool": lambda shape: np.ones(shape, dtype=bool),
    "a bool": lambda shape: True,
    "object": lambda shape: object(),
    "dict": lambda shape: {"a": 1.0},
    "nan": lambda shape: with_entry(shape, np.nan),
    "inf": lambda shape: with_entry(shape, np.inf),
    "minus inf": lambda shape: with_entry(shape, -np.inf),
    "extra axis": lambda shape: np.ones((1, *shape)),
    "too long": lambda shape: np.ones((*shape[:-1], 7)),
    "ragged": lambda shape: [[1.0], [1.0, 2.0]],
    "masked": lambda shape: np.ma.masked_array(np.ones(shape), True),
    "no array": lambda shape: Hostile(),
    "dates": lambda shape: np.full(shape, np.datetime64("2020-01-01")),
    "bytes": lambda shape: b"abc",
    "a key": lambda shape: jax.random.key(0),
    "deleted": lambda shape: DELETED,
    "a class": lambda shape: float,
    "records": lambda shape: np.zeros(shape, [("a", float), ("b", int)]),
    "empty": lambda shape: np.zeros((*shape, 0)),
}


DELETED = jnp.ones(3) + 1
DELETED.delete()


class Hostile:
    """An object that raises when it is converted to an array or shown."""

    def __repr__(self):
        raise RuntimeError("no text")

    def __array__(self, *args, **keywords):
        raise RuntimeError("no array")


def with_entry(shape, entry):
    values = np.cumsum(np.ones(shape)).reshape(shape)
    values[(0,) * len(shape)] = entry
    return values


@pytest.mark.parametrize("kind", MALFORMED)
@pytest.mark.parametrize("argument", ARRAYS)
def test_arrays_are_refused(argument, kind):
    name, shape, call = ARRAYS[argument]
    value = MALFORMED[kind](shape)
    if argument in {"inf": UNBOUNDED, "too long": ANY_LENGTH}.get(kind, ()):
        return
    if kind == "None" and argument == "inverse_kinematics orientation":
        name = "linkage"  # None is for an arm of two joints
    refused(name, call, value)


@pytest.mark.parametrize(
    "argument",
    ["make mass", "make inertia", "JointDamper coefficient", "CircleTask radius"]
    + ["controller kp", "controller kd", "controller limit"],
)
def test_negative_values_are_refused(argument):
    name, shape, call = ARRAYS[argument]
    refused(name, call, with_entry(shape, -1e-9))
    call(with_entry(shape, 1e-9))


@pytest.mark.parametrize("kind", [np.float16, np.float32, ">f8", np.int8, np.uint64])
def test_real_numbers_of_any_type_are_taken(kind):
    for function, good in CALLS:
        for name in good.keys() - {"linkage", "topology", "ts"}:
            function(**good | {name: np.asarray(good[name]).astype(kind)})


# Topologies


LETTERS = "1 to 8 letters"
TOPOLOGY_WORDS = {
    LETTERS: [
        "R" * 9, "rrr", "RXR", "", None, 3, [0, 1, 0], [0, 1] * 9, [[0, 1]] * 3,
        [0, 1, 0, 0.5], [0, 1, 0, np.nan], [0, 1, 0, 1j], np.array([0, 1 + 0j]),
        ["0", "1"],
    ],
    "one real joint at most in each": [[0, 1, 1, 1], [1, 1, 0, 1]],
    "a joint that moves, got fixed pairs": ["FFF", [0] * 6],
}  # fmt: skip


@pytest.mark.parametrize("words", TOPOLOGY_WORDS)
def test_unknown_topologies_are_refused(words):
    for topology in TOPOLOGY_WORDS[words]:
        with pytest.raises(ValueError, match=f"^topology: expected.* {words}"):
            make(topology)
        refused("topology", make, topology)
        refused("topology", fj.existence_factors, topology)
        refused("topology", fj.paper.from_chain, topology, CHAIN, CHAIN)


# Linkages

OF_A_LINKAGE = {f.__name__: (f, good) for f, good in CALLS if "linkage" in good} | {
    "joint_efforts": (fj.joint_efforts, dict(forces=(), solution=SOLUTION))
}


@pytest.mark.parametrize("name", OF_A_LINKAGE)
@pytest.mark.parametrize("kind", ["name", "None", "stacked"])
def test_what_is_not_one_linkage_is_refused(name, kind):
    stacked = jax.tree.map(lambda a: jnp.stack([a, a]), LINKAGE)
    value = {"name": "RRR", "None": None, "stacked": stacked}[kind]
    function, good = OF_A_LINKAGE[name]
    refused("linkage", lambda: function(**good | {"linkage": value}))


# Simulation


DAMPER = fj.JointDamper(1.0)
BAD = {
    "ts": [[], 0.5, [[0, 1]], [1, 0], [0, 0], [0, 2, 1], [0, np.nan]],
    "state0": [None, 3, [ZERO], (ZERO, ZERO, ZERO)],
    # The class is no element.
    "forces": [
        None,
        DAMPER,
        [DAMPER],
        (DAMPER, 3.0),
        (ZERO,),
        (type(DAMPER),),
        "damper",
    ],
    "adjoint": [diffrax.BacksolveAdjoint(), diffrax.ImplicitAdjoint()],
    "dt0": [0.0, -1e-3, np.nan, "1e-3"],
}


@pytest.mark.parametrize("name", BAD)
def test_arguments_of_simulate_are_refused(name):
    for value in BAD[name]:
        refused(name, lambda v: simulate(**{name: v}), value)
        if name == "forces":
            refused(name, fj.joint_efforts, LINKAGE, value, SOLUTION)


def test_a_single_time_is_refused_with_an_example():
    with pytest.raises(ValueError, match=r"^ts: .* for instance \[0, 2\.0\], .* 2\.0"):
        simulate(ts=2.0)


@pytest.mark.parametrize(
    "tau",
    [jnp.zeros(2), jnp.zeros((3, 1)), 0.0, jnp.zeros(3) * 1j, jnp.ones(3, bool)]
    + [None, "text", (jnp.zeros(3), jnp.zeros(3))],
    ids=str,
)
def test_elements_that_return_no_effort_are_refused(tau):
    forces = (DAMPER, lambda t, q, qd, linkage: tau)
    refused(r"forces\[1\]", lambda: simulate(forces=forces))
    refused(r"forces\[1\]", lambda: fj.joint_efforts(LINKAGE, forces, SOLUTION))


def test_what_is_not_a_solution_is_refused():
    refused("solution", lambda: fj.joint_efforts(LINKAGE, (), None))


def test_modes_that_the_adjoint_does_not_serve_name_the_cure():
    def end(q, **settings):
        return simulate(state0=fj.State(q, ZERO), **settings).q[-1, 0]

    with pytest.raises(TypeError, match=r"adjoint=diffrax\.ForwardMode\(\)"):
        jax.jacfwd(end)(jnp.zeros(3))
    slope = jax.grad(lambda q: end(q, adjoint=diffrax.ForwardMode()))
    with pytest.raises(RuntimeError, match="^reverse-mode .* default adjoint"):
        jax.eval_shape(slope, jnp.zeros(3))


def test_one_effort_for_all_joints():
    found = fj.JointEffort(1.5)(0.0, ZERO, ZERO, LINKAGE)
    np.testing.assert_array_equal(found, [1.5] * 3)


@pytest.mark.parametrize(
    "coefficient, batch", [(np.ones(2), False), (np.ones((4, 3)), True)], ids=str
)
def test_a_batch_is_hinted_at_only_where_one_may_be_meant(coefficient, batch):
    if batch:  # as `jax.vmap` makes them; the constructor takes one element
        damper = jax.vmap(fj.JointDamper)(coefficient)
    else:
        damper = fj.JointDamper(coefficient)
    with pytest.raises(
        ValueError, match=r"coefficient: expected .* 3 joints"
    ) as raised:
        simulate(forces=(damper,))
    assert ("forces_axes" in str(raised.value)) == batch


# What is of another type is told by its type, if not by its text


ACTUATOR = dict(gear=[[1, 0, 0]], gain=[[8, 0, 0]], bias=[[0, -8, -2]], control=[0.5])
OTHER_TYPES = [
    ("activation", lambda value: fj.control.Actuators(**ACTUATOR, activation=value)),
    ("joints", fj.forces.Brake),
    ("samples", lambda v: fj.simulate_sampled(LINKAGE, STATE, DAMPER, 0.01, v)),
    ("force", lambda value: fj.Wrench(fj.Point(1), value)),
    ("point", fj.Wrench),
    ("link", fj.Point),
    ("follows", lambda value: fj.Wrench(fj.Point(1), follows=value)),
    ("mass_centers", lambda v: drawing.draw_linkage(LINKAGE, ZERO, mass_centers=v)),
    (
        "mass_centers",
        lambda v: drawing.chrono_cyclograph(LINKAGE, SOLUTION, mass_centers=v),
    ),
    (
        "configurations",
        lambda v: drawing.topology_grid({"a": (LINKAGE, SOLUTION)}, configurations=v),
    ),
    ("linkage", lambda value: simulate(value)),
    ("state0", lambda value: simulate(state0=value)),
    ("topology", make),
    ("loss", lambda value: fj.tune(fj.scenes.fig7(), loss=value)),
]


@pytest.mark.parametrize("name, call", OTHER_TYPES)
def test_other_types_are_refused(name, call):
    key, huge = jax.random.key(0), 10**400
    classes = fj.control.Activation, fj.Point, fj.Linkage, fj.tuning.Tracking
    for value in (key, huge, 10**5000, DELETED, Hostile(), *classes):
        refused(name, call, value)
    with pytest.raises(ValueError, match="got a value of type ArrayImpl"):
        call(DELETED)


# Messages are short


class Long:
    def __repr__(self):
        return "Long(" + 200_000 * "9" + "\x1b[31m\x00)"


LONG = {
    "text": 1_000_000 * "x" + "\x1b[31m\x07",
    "list": ["9"] * 100_000,
    "array": np.full(100_000, "a"),
    "object": Long(),
    "dict": {f"key {i}\n": i for i in range(10_000)},
}


@pytest.mark.parametrize("kind", LONG)
@pytest.mark.parametrize(
    "call",
    [
        lambda value: fj.Linkage(value, length=0, com=0, mass=1, inertia=1),
        lambda value: fj.JointDamper(value),
        lambda value: simulate(state0=value),
        lambda value: simulate(forces=value),
        lambda value: simulate(solver=value),
        lambda value: simulate(rtol=value),
        lambda value: fj.sweep(LINKAGE, value, [0, 1]),
        lambda value: fj.energy(value, ZERO, ZERO),
        lambda value: fj.PDController(1.0, 1.0, 1.0, value),
        lambda value: fj.forces.SpringDamper(value, value, 1.0, 1.0),
        lambda value: fj.tune(value),
        lambda value: fj.tuning.stacked([value, 1.0]),
        lambda value: fj.identification.fit(lambda p: p, value, [0, 1], value),
        lambda value: fj.configure(cache=[value]),
        lambda value: fj.references.JointMove(value, 0, value),
    ],
)
def test_messages_repeat_little_of_what_was_given(call, kind):
    with pytest.raises((ValueError, TypeError)) as raised:
        call(LONG[kind])
    words = str(raised.value)
    assert len(words) < 600
    assert all(letter.isprintable() for letter in words)


@pytest.mark.parametrize("hold", [list, tuple, lambda x: [fj.State(x, x)]])
def test_little_is_formatted(hold):
    formatted = []

    class Noted:
        def __repr__(self):
            formatted.append(self)
            return "Noted"

    refused("point", fj.Wrench, hold([Noted() for _ in range(100_000)]))
    assert 0 < len(formatted) <= 400
