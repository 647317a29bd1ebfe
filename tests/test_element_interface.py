"""The base of elements and references: values, conditions, jumps, adapters, copies."""

from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import ALL, HOLDING, PD, Hold, arm

import fdof_jax as fj
from fdof_jax.forces.element import elements
from fdof_jax.simulation.formulation import clocks_apart, known_times
from fdof_jax.simulation.simulate import check_elements
from fdof_jax.simulation.vector_field import args_of, element_effort

ARM, TS, ZERO = arm("RRR"), jnp.array([0.0, 1.0]), jnp.zeros(3)

# Values


class Pulse(fj.Element):
    """A torque between two times: a field as times of jumps, and a condition on it."""

    jump_ts: fj.Values = fj.field((2,), unit="s")
    torque: fj.Values = fj.field((), unit="N m", minimum=0)

    def conditions(self):
        begin, end = self.jump_ts
        yield fj.forces.Condition(
            begin < end, "jump_ts", "increasing times", (begin, end)
        )

    def __call__(self, t, q, qd, linkage):
        on = (t >= self.jump_ts[0]) & (t < self.jump_ts[1])
        return jnp.where(on, self.torque, 0.0) * jnp.array([1.0, 0.0, 0.0])


class Graded(fj.Element):
    """Numbers that must fall: a condition on an array, which shows one value."""

    levels: fj.Values = fj.field((3,), unit="N m")

    def conditions(self):
        falling = self.levels[1:] < self.levels[:-1]
        yield fj.forces.Condition(falling, "levels", "falling numbers", self.levels)

    def __call__(self, t, q, qd, linkage):
        return self.levels


FAULTS = [
    (Pulse, dict(jump_ts=[0.2, 0.1]), "expected increasing times, got 0.2 and 0.1"),
    (Pulse, dict(torque=-1.0), r"expected a real number, .*at least 0 \[N m\], got -1"),
    (Pulse, dict(torque=np.nan), "expected a real number"),
    (Graded, dict(levels=[3.0, 2, 4]), r"expected falling .*\[3\. 2\. 4"),
]


@pytest.mark.parametrize("kind, values, words", FAULTS)
def test_a_fault_is_told_by_constructor_door_and_program(kind, values, words):
    right = (
        dict(jump_ts=[0.1, 0.2], torque=3) if kind is Pulse else dict(levels=[3, 2, 1])
    )
    part, ((name, value),) = kind(**right), values.items()
    assert part.possible() and all(
        leaf.dtype == float for leaf in jax.tree.leaves(part)
    )
    with pytest.raises(ValueError, match=f"^{name}: {words}"):
        kind(**right | values)
    spoilt = eqx.tree_at(lambda e: getattr(e, name), part, jnp.asarray(value))
    with pytest.raises(ValueError, match=rf"^forces\[1\]\.{name}: {words}"):
        check_elements((fj.JointDamper(1.0), spoilt), ARM, TS)
    assert not jax.jit(lambda e: e.possible())(spoilt)
    traced = {name: jnp.array(value, float) for name, value in (right | values).items()}
    jax.jit(lambda values: kind(**values))(traced)  # unknown: not refused


class Unequal(fj.forces.InertialElement):
    def coordinates(self, q, linkage):
        return q[:2]

    def weights(self, linkage):
        return jnp.ones(3)


class Lost(fj.forces.StatefulElement):
    """Returns the rate of another state."""

    def initial_state(self, linkage):
        return jnp.zeros(3)

    def __call__(self, t, q, qd, linkage, state):
        return q, state[:2]


def effort_of(element, state=()):
    return element_effort(0, element, TS[0], ZERO, ZERO, ARM, state)


one_shape = r"^Unequal: .*one shape .*\(2,\).*\(3,\)"
REFUSED = [
    (lambda: fj.JointDamper(np.array(-1.0)), r"got -1\.$"),  # not two full stops
    (lambda: fj.mass_matrix(ARM, ZERO, (Unequal(),)), one_shape),
    (lambda: fj.energy(ARM, ZERO, ZERO, (Unequal(),)), one_shape),
    (
        lambda: effort_of(Lost(), ZERO),
        r"^forces\[0\]: .*rate .*state, f64\[3\], got f64\[2\]\.",
    ),
    (
        lambda: fj.Wrench(fj.Point(3, 1.0), lambda t: ZERO)(0.0, ZERO, ZERO, ARM),
        "^force: expected an array of 2 real numbers",
    ),
    (
        lambda: fj.SpringDamper(fj.Point(0), fj.Point(1), stiffness=lambda t: 1.0),
        "^stiffness: expected",
    ),
]


@pytest.mark.parametrize("call, words", REFUSED)
def test_what_elements_return_is_checked(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    "function",
    [
        lambda t, q, qd, linkage: np.sign(qd),
        lambda t, q, qd, linkage: q if t < 0.2 else qd,
        lambda t, q, qd, linkage: -float(q[0]) * qd,
    ],
)
def test_functions_that_cannot_be_traced_are_refused(function):
    (element,) = elements("forces", (function,))
    with pytest.raises(TypeError, match=r"^forces\[0\]: expected jax\.numpy .*, got: "):
        effort_of(element)


# Jumps


def test_jumps_are_passed_on():
    travel = fj.references.Travel(2.0, begin=1.0)
    move = fj.references.JointMove([0, 0, 0], [1, 1, 1], travel)
    pd = fj.PDController(1.0, 1.0, 1.0, move)
    path = fj.TipTask(fj.references.Line([1, 0], [1, 1]), travel)
    drive = fj.control.FirstOrderLag(pd, 0.1)
    prescribed = fj.simulation.PrescribedMotion(1, move)
    for part in (travel, move, path, pd, drive, prescribed):
        np.testing.assert_array_equal(part.jump_ts, [1, 3])
    assert PD.jump_ts is None and fj.JointDamper(1.0).jump_ts is None


class Raised(fj.references.Reference):
    """A reference that jumps, of which one time or several are given."""

    jump_ts: jax.Array

    def __call__(self, t, linkage):
        raised = jnp.where(t < jnp.max(self.jump_ts), 0.0, 0.3)
        return jnp.full(3, raised), jnp.zeros(3)


def test_one_time_of_a_jump_needs_no_list():
    ends = []
    for time in (jnp.array(0.05), jnp.array([0.05])):
        pd = fj.PDController(10.0, 1.0, 100.0, Raised(time))
        check_elements((pd,), ARM, TS)
        np.testing.assert_array_equal(pd.jump_ts, [0.05])
        args = args_of(ARM, ZERO, (pd, Raised(time)))
        ends.append(known_times(clocks_apart(args, TS))[0])
    np.testing.assert_array_equal(*ends)


class Pushes(fj.Element):
    """A force between times that a list holds, which no field declares."""

    jump_ts: list | tuple | np.ndarray

    def __call__(self, t, q, qd, linkage):
        begin, end = self.jump_ts
        return jnp.where((t >= begin) & (t < end), 2.0, 0.0) * jnp.ones_like(q)


def pushing(jump_ts):
    def push(t, q, qd, linkage):
        begin, end = 0.3, 0.7
        return jnp.where((t >= begin) & (t < end), 2.0, 0.0) * jnp.ones_like(q)

    push.jump_ts = jump_ts
    return push


def led(jump_ts):
    def stand(t, linkage):
        return jnp.ones(1), jnp.zeros(1)

    stand.jump_ts = jump_ts
    return fj.PDController(1.0, 1.0, 1.0, stand)


SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], base_angle=np.pi / 2
)
PUSHED = Pushes, pushing, led


@pytest.mark.parametrize("make", PUSHED)
@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_times_of_jumps_may_be_a_list(make, kind):
    forces = elements("forces", (make(kind([0.3, 0.7])),))
    check_elements(forces, SLIDE, TS)
    found, _ = known_times(clocks_apart(args_of(SLIDE, ZERO[:1], forces), TS))
    np.testing.assert_array_equal(found, [0.3, 0.7])


@pytest.mark.parametrize("make", PUSHED)
def test_an_empty_list_of_times_is_none(make):
    forces = elements("forces", (make([]),))
    assert known_times(args_of(SLIDE, ZERO[:1], forces)) == (None, ())


@pytest.mark.parametrize("make", PUSHED)
@pytest.mark.parametrize("value", ["x", [0.3, None], [[0.3], [0.7, 1]], [np.nan], [1j]])
def test_other_times_of_jumps_are_refused(make, value):
    name = "reference.jump_ts" if make is led else "jump_ts"
    words = rf"(?s)^forces\[1\]\.{name}: expected .*real number.*\[s\], got "
    with pytest.raises(ValueError, match=words):
        fj.simulate(
            SLIDE, fj.State([0.0], [0.0]), TS, (fj.JointDamper(0.0), make(value))
        )


@pytest.mark.slow
@pytest.mark.parametrize("make", PUSHED[:2])
def test_steps_end_at_times_in_a_list(make):
    still = fj.State([0.0], [0.0])
    motion = fj.simulate(SLIDE, still, TS, (make([0.3, 0.7]),))
    # 2 N on 1 kg for 0.4 s, then 0.3 s at 0.8 m/s
    np.testing.assert_allclose(motion.q[-1], 0.16 + 0.24, rtol=1e-13)
    assert motion.stats["num_rejected_steps"] == 0


class Shifts(fj.forces.element.ScalarElement):
    """Efforts from a table: which, and whether, are a whole number and a flag."""

    levels: fj.Values = fj.field((None,), unit="N m")

    @property
    def jump_ts(self):
        return jnp.array([0.25, 0.5, 0.6, 0.75])

    def schedule(self, t, linkage):
        return jnp.floor(4 * t).astype(int), t < 0.6

    def respond(self, scheduled, q, qd, linkage):
        which, on = scheduled
        effort = self.levels[jnp.minimum(which, 3)]
        return tuple(jnp.where(~on, 0.0, effort) - rate for rate in qd)


def test_a_schedule_of_whole_numbers_and_flags():
    forward = dict(adjoint=diffrax.ForwardMode())
    start = fj.State(ZERO, ZERO)

    def ends(levels, **options):
        return fj.simulate(ARM, start, TS, (Shifts(levels),), **options).q[-1]

    levels = np.array([1.0, -2.0, 3.0, 5.0])
    slopes = jax.jacfwd(lambda x: ends(x, **forward))(levels)
    steps = 1e-4 * np.eye(4)
    differences = [(ends(levels + d) - ends(levels - d)) / 2e-4 for d in steps]
    np.testing.assert_allclose(slopes, np.transpose(differences), atol=1e-7)
    assert not slopes[:, 3].any() and (abs(slopes[:, :3]) > 1e-3).all()


# Callables of other kinds


class Foreign(eqx.Module):
    """A callable of another kind, with some of an element's attributes."""

    jump_ts: jax.Array
    size: jax.Array

    def __call__(self, t, q, qd, linkage):
        return -self.size * q

    def check(self, linkage, ts):
        if self.size > 5:
            raise ValueError("size: too much")

    def possible(self):
        return self.size >= 0

    def potential_energy(self, q, linkage):
        return self.size * jnp.sum(q**2) / 2


def test_attributes_of_other_callables_count():
    (element,) = elements("forces", (Foreign(TS, jnp.array(1.0)),))
    assert isinstance(element, fj.Element) and element.possible()
    np.testing.assert_array_equal(element.jump_ts, TS)
    assert elements("forces", (element, PD)) == (element, PD)  # adapted once
    for size, words in (
        (9.0, r"^forces\[0\]\.size: too much"),
        (-1.0, r"^forces\[0\]: expected values"),
    ):
        with pytest.raises(ValueError, match=words):
            check_elements((Foreign(TS, jnp.array(size)),), ARM, TS)
    q = jnp.array([1.0, 2.0, 2.0])
    with_spring = fj.energy(ARM, q, 0 * q, (Foreign(TS, jnp.array(2.0)),))
    np.testing.assert_allclose(with_spring[1] - fj.energy(ARM, q, 0 * q)[1], 9.0)
    drive = fj.control.SpeedLimit(Foreign(TS, jnp.array(1.0)), 1.0, 2.0)
    np.testing.assert_array_equal(drive.jump_ts, TS)


def test_an_opened_function_keeps_its_jumps():
    """Reverse mode opens closures, for derivatives in what they hold."""

    def found(level):
        def pushed(t, q, qd, linkage):
            return level * jnp.where(t < 1, q, qd)

        pushed.jump_ts = jnp.array([1.0])
        (element,) = elements("forces", (pushed,))
        at = jnp.array(0.0), jnp.ones(3), ZERO, ARM
        opened = element.opened(*at)
        np.testing.assert_array_equal(opened.jump_ts, [1.0])
        assert any(leaf is level for leaf in jax.tree.leaves(opened))
        return jnp.sum(opened(*at))

    assert jax.grad(found)(2.0) == 3.0


def test_nothing_else_is_asked_for_attributes():
    """Only the adapter asks; trees and JAX's programs are read by names of fields."""
    folder = Path(fj.__file__).parent
    asking = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*.py")
        if "hasattr(" in path.read_text() or "getattr(" in path.read_text()
    }
    # These ask arrays, programs, root finders, and MuJoCo's models of all versions.
    others = {"batches/chunks.py", "batches/store.py", "steps/tolerances.py"}
    others |= {"mjcf/actuators.py", "mjcf/chain.py"}
    assert asking == {"linkage/fields.py", "data/files.py"} | others


# References


def test_a_reference_of_one_s_own():
    """Its velocities are the rates of its positions."""

    class Parabola(fj.references.Reference):
        bend: fj.Values = fj.field(unit="rad/s^2")

        def assembly(self, t, linkage):
            return self.bend * t**2, 1.0

    q, qd = Parabola(3)(2.0, ARM)
    assert (q.tolist(), qd.tolist()) == ([12.0] * 3, [12.0] * 3)
    assert Parabola(3).tip is None and fj.CircleTask().tip is not None
    assert fj.PDController(1.0, 1.0, 1.0, Hold(q)).jump_ts is None
    with pytest.raises(TypeError, match="^Nothing: expected a method `__call__`"):
        type("Nothing", (fj.references.Reference,), {})()


# Copies

EIGHT = fj.references.FigureEight([1.6, 0.4], [0.5, 0.3])


@pytest.mark.parametrize(
    "part",
    [
        *(ALL | HOLDING).values(),
        fj.Point(1, 0.5),
        fj.CircleTask(),
        fj.TipTask(EIGHT, fj.references.Laps(period=4.0)),
        fj.references.Spline([[0, 0], [1, 1], [2, 0]], closed=True),
        fj.simulation.PrescribedMotion((1, 3), lambda t, linkage: 0),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_copy_is_equal_in_values_and_structure(part):
    assert eqx.tree_equal(part.replace(), part, typematch=True)
    in_numpy = jax.tree.map(jax.device_get, part)
    assert eqx.tree_equal(in_numpy.replace(), part)


def test_a_copy_has_other_numbers_of_an_element():
    spring = fj.SpringDamper(fj.Point(0), fj.Point(1, 1), stiffness=2, damping=3)
    stiff = spring.__replace__(stiffness=4.0, one_sided="cable")  # by `copy.replace`
    assert (float(stiff.stiffness), float(stiff.damping), int(stiff.side)) == (4, 3, 1)
    assert stiff.replace(one_sided=False, stiffness=2.0).side is None
    pid = fj.control.PIDController(1.0, 2.0, 3.0, 4.0, fj.CircleTask())
    assert float(pid.replace(kp=5.0).pd.kp) == 5
    for values, words in [
        ({"stiffness": -1}, "^stiffness: expected .* at least 0"),
        ({"ends": None}, "^ends: expected one of a, b, .*, one_sided, got another"),
        ({300 * "z": 1}, r"^z{197}\.\.\.: expected one of"),
    ]:
        with pytest.raises(ValueError, match=words):
            stiff.replace(**values)


def test_a_copy_needs_the_arguments_of_its_constructor():
    class Doubled(fj.Element):
        gain: fj.Values = fj.field(unit="N m")

        def __init__(self, half):
            self.gain = 2 * half

        def __call__(self, t, q, qd, linkage):
            return self.gain * q

    with pytest.raises(TypeError, match="^Doubled: .* `arguments`, .* no fields: half"):
        Doubled(1.0).replace(half=2.0)
