"""The base of elements and references: values, conditions, jumps, adapters, copies.

The bounds of all fields of the library's own elements are in refusals.py.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import PD, SHORT, arm

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


FAULTS = [
    ("jump_ts", [0.2, 0.1], "expected increasing times, got 0.2 and 0.1"),
    ("torque", -1.0, r"expected a real number, .*at least 0 \[N m\], got -1\.$"),
]


@pytest.mark.parametrize("name, value, words", FAULTS)
def test_a_fault_is_told_by_constructor_door_and_program(name, value, words):
    right = dict(jump_ts=[0.1, 0.2], torque=3)
    part, wrong = Pulse(**right), right | {name: value}
    assert part.possible() and part.torque.dtype == float
    with pytest.raises(ValueError, match=f"^{name}: {words}"):
        Pulse(**wrong)
    spoilt = eqx.tree_at(lambda e: getattr(e, name), part, jnp.asarray(value))
    with pytest.raises(ValueError, match=rf"^forces\[1\]\.{name}: {words}"):
        check_elements((fj.JointDamper(1.0), spoilt), ARM, TS)
    assert not jax.jit(lambda e: e.possible())(spoilt)
    traced = {name: jnp.array(value, float) for name, value in wrong.items()}
    jax.eval_shape(lambda values: Pulse(**values), traced)  # unknown: not refused


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
    (element,) = elements("forces", (element,))
    return element_effort(0, element, TS[0], ZERO, ZERO, ARM, state)


ONE_SHAPE = r"^Unequal: .*one shape .*\(2,\).*\(3,\)"
UNTRACED = r"^forces\[0\]: expected jax\.numpy .*, got: "
RETURNED = [
    (lambda: fj.mass_matrix(ARM, ZERO, (Unequal(),)), ONE_SHAPE),
    (lambda: fj.energy(ARM, ZERO, ZERO, (Unequal(),)), ONE_SHAPE),
    (lambda: effort_of(Lost(), ZERO), r"^forces\[0\]: .*rate .*state, f64\[3\], got "),
    (
        lambda: effort_of(fj.Wrench(fj.Point(3), lambda t: ZERO)),
        r"force: .* 2 real num",
    ),
    (lambda: effort_of(lambda t, q, qd, linkage: np.sign(qd)), UNTRACED),
    (lambda: effort_of(lambda t, q, qd, linkage: q if t < 0.2 else qd), UNTRACED),
    (lambda: effort_of(lambda t, q, qd, linkage: -float(q[0]) * qd), UNTRACED),
]


@pytest.mark.parametrize("call, words", RETURNED)
def test_what_elements_return_is_checked(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


# Jumps


def test_jumps_are_passed_on():
    travel = fj.references.Travel(2.0, begin=1.0)
    move = fj.references.JointMove([0, 0, 0], [1, 1, 1], travel)
    pd = fj.PDController(1.0, 1.0, 1.0, move)
    path = fj.TipTask(fj.references.Line([1, 0], [1, 1]), travel)
    drive = fj.control.FirstOrderLag(pd, 0.1)
    prescribed = fj.simulation.PrescribedMotion(1, move)
    for part in travel, move, path, pd, drive, prescribed:
        np.testing.assert_array_equal(part.jump_ts, [1, 3])
    assert PD.jump_ts is None and fj.JointDamper(1.0).jump_ts is None


class Pushes(fj.Element):
    """A force whose times no field declares."""

    jump_ts: list | tuple | np.ndarray

    def __call__(self, t, q, qd, linkage):
        return jnp.ones_like(q)


def pushing(jump_ts):
    push = lambda t, q, qd, linkage: jnp.ones_like(q)
    push.jump_ts = jump_ts
    return push


def led(jump_ts):
    stand = lambda t, linkage: (jnp.ones(1), jnp.zeros(1))
    stand.jump_ts = jump_ts
    return fj.PDController(1.0, 1.0, 1.0, stand)


SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], base_angle=np.pi / 2
)
PUSHED = Pushes, pushing, led


@pytest.mark.parametrize("make", PUSHED)
def test_times_of_jumps_may_be_a_list_or_one_time(make):
    for times in ([0.3, 0.7], (0.3, 0.7), np.array([0.3, 0.7]), np.array(0.3)):
        forces = elements("forces", (make(times),))
        check_elements(forces, SLIDE, TS)
        found, _ = known_times(clocks_apart(args_of(SLIDE, ZERO[:1], forces), TS))
        np.testing.assert_array_equal(found, np.ravel(times))
    forces = elements("forces", (make([]),))
    assert known_times(args_of(SLIDE, ZERO[:1], forces)) == (None, ())


@pytest.mark.parametrize("make", PUSHED)
@pytest.mark.parametrize("value", ["x", [0.3, None], [[0.3], [0.7, 1]], [np.nan]])
def test_other_times_of_jumps_are_refused(make, value):
    name = "reference.jump_ts" if make is led else "jump_ts"
    words = rf"(?s)^forces\[1\]\.{name}: expected .*real number.*\[s\], got "
    with pytest.raises(ValueError, match=words):
        check_elements((fj.JointDamper(0.0), make(value)), SLIDE, TS)


class Shifts(fj.forces.element.ScalarElement):
    """Efforts from a table: which, and whether, are a whole number and a flag."""

    levels: fj.Values = fj.field((None,), unit="N m")

    def schedule(self, t, linkage):
        return jnp.floor(4 * t).astype(int), t < 0.6

    def respond(self, scheduled, q, qd, linkage):
        which, on = scheduled
        effort = self.levels[jnp.minimum(which, 3)]
        return tuple(jnp.where(~on, 0.0, effort) for _ in qd)


@pytest.mark.slow
def test_a_schedule_of_whole_numbers_and_flags():
    """Derivatives of the way of a slide from rest."""
    still = fj.State([0.0], [0.0])
    levels = np.array([1.0, -2.0, 3.0, 5.0])
    end = lambda x: fj.simulate(SLIDE, still, TS, (Shifts(x),), **SHORT).q[-1, 0]
    slope = jax.grad(end)(levels)
    # Of an impulse of h, (1 - its middle) is left to go, as SLIDE has 1 kg.
    h, middle = np.array([0.25, 0.25, 0.1, 0.0]), np.array([0.125, 0.375, 0.55, 0.0])
    np.testing.assert_allclose(slope, h * (1 - middle), rtol=1e-10, atol=1e-14)


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


def test_a_reference_of_one_s_own():
    """Its velocities are the rates of its positions."""

    class Parabola(fj.references.Reference):
        bend: fj.Values = fj.field(unit="rad/s^2")

        def assembly(self, t, linkage):
            return self.bend * t**2, 1.0

    q, qd = Parabola(3)(2.0, ARM)
    assert (q.tolist(), qd.tolist()) == ([12.0] * 3, [12.0] * 3)
    with pytest.raises(TypeError, match="^Nothing: expected a method `__call__`"):
        type("Nothing", (fj.references.Reference,), {})()


# Copies


def test_a_copy_is_equal_or_has_other_numbers():
    """Elements are made again of their arguments for each file, too: test_files.py."""
    eight = fj.references.FigureEight([1.6, 0.4], [0.5, 0.3])
    task = fj.TipTask(eight, fj.references.Laps(period=4.0))
    for part in task, fj.simulation.PrescribedMotion((1, 3), lambda t, linkage: 0):
        assert eqx.tree_equal(part.replace(), part, typematch=True), part
        assert eqx.tree_equal(jax.tree.map(jax.device_get, part).replace(), part), part
    spring = fj.SpringDamper(fj.Point(0), fj.Point(1, 1), stiffness=2, damping=3)
    stiff = spring.__replace__(stiffness=4.0, one_sided="cable")  # by `copy.replace`
    assert (float(stiff.stiffness), float(stiff.damping), int(stiff.side)) == (4, 3, 1)
    assert stiff.replace(one_sided=False, stiffness=2.0).side is None
    for values, words in [
        ({"stiffness": -1}, "^stiffness: expected .* at least 0"),
        (
            {"ends": None},
            r"^ends: expected an argument of SpringDamper \(a, b, .*\), got",
        ),
        ({300 * "z": 1}, r"^z{197}\.\.\.: expected an argument"),
    ]:
        with pytest.raises(ValueError, match=words):
            stiff.replace(**values)
