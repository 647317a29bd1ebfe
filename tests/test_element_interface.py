"""The base of elements and references: declared values, conditions, jumps, adapters."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import PD, Hold, arm

import fdof_jax as fj
from fdof_jax.forces.element import elements
from fdof_jax.simulation.field import args_of, element_effort
from fdof_jax.simulation.known_times import clocks_apart, known_times
from fdof_jax.simulation.simulate import check_elements

ARM, TS = arm("RRR"), jnp.array([0.0, 1.0])


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


def moved(element, where, value):
    return eqx.tree_at(where, element, jnp.asarray(value, float))


def test_a_fault_is_told_by_constructor_door_and_program():
    pulse = Pulse([0.1, 0.2], 3)
    assert pulse.torque.dtype == float and pulse.possible()
    for times, torque, words in (
        ([0.2, 0.1], 3, "jump_ts: expected increasing times, got 0.2 and 0.1"),
        (
            [0.1, 0.2],
            -1,
            r"torque: expected a real number, .*at least 0 \[N m\], got -1",
        ),
        ([0.1, 0.2], np.nan, "torque: expected a real number"),
    ):
        with pytest.raises(ValueError, match="^" + words):
            Pulse(times, torque)
        spoilt = moved(
            moved(pulse, lambda p: p.jump_ts, times), lambda p: p.torque, torque
        )
        with pytest.raises(ValueError, match=r"^forces\[1\]\." + words):
            check_elements((fj.JointDamper(1.0), spoilt), ARM, TS)
        assert not jax.jit(lambda p: p.possible())(spoilt)
        jax.jit(Pulse)(jnp.array(times), jnp.array(torque))  # unknown: not refused


def test_every_element_tells_a_program_what_is_impossible():
    effort = fj.JointEffort([1.0, 2.0, 3.0])
    assert effort.possible()
    assert not moved(effort, lambda e: e.tau, [1.0, np.inf, 3.0]).possible()


class Graded(fj.Element):
    """Numbers that must fall: a condition on an array, which shows one value."""

    levels: fj.Values = fj.field((3,), unit="N m")

    def conditions(self):
        falling = self.levels[1:] < self.levels[:-1]
        yield fj.forces.Condition(falling, "levels", "falling numbers", self.levels)

    def __call__(self, t, q, qd, linkage):
        return self.levels


def test_a_condition_may_be_an_array_and_show_one_value():
    graded = Graded([3, 2, 1])
    assert graded.possible()
    with pytest.raises(ValueError, match=r"^levels: expected falling .*\[3\. 2\. 4"):
        Graded([3, 2, 4])
    spoilt = moved(graded, lambda g: g.levels, [3, 2, 4])
    assert not jax.jit(lambda g: g.possible())(spoilt)


def test_a_number_is_shown_without_a_second_stop():
    with pytest.raises(ValueError, match=r"got -1\.$"):
        fj.JointDamper(np.array(-1.0))


class Unequal(fj.forces.InertialElement):
    def coordinates(self, q, linkage):
        return q[:2]

    def weights(self, linkage):
        return jnp.ones(3)


def test_weights_are_as_many_as_coordinates():
    q = jnp.zeros(3)
    for call in (fj.forward_dynamics, lambda *row: fj.energy(*row[:3], row[4])):
        with pytest.raises(ValueError, match=r"^Unequal: .*one shape .*\(2,\).*\(3,\)"):
            call(ARM, q, q, q, (Unequal(),))


class Lost(fj.forces.StatefulElement):
    """Returns the rate of another state."""

    def initial_state(self, linkage):
        return jnp.zeros(3)

    def __call__(self, t, q, qd, linkage, state):
        return q, state[:2]


def test_messages_on_states_show_shapes():
    q = jnp.zeros(3)
    with pytest.raises(ValueError, match=r"rate .*state, f64\[3\], got f64\[2\]\."):
        element_effort(0, Lost(), 0.0, q, q, ARM, q)


def test_a_fault_within_is_told_with_its_place():
    lag = fj.control.FirstOrderLag(fj.control.SpeedLimit(PD, 1.0, 2.0), 0.1)
    spoilt = eqx.tree_at(lambda e: e.command.command.kp, lag, -PD.kp)
    with pytest.raises(
        ValueError, match=r"^forces\[0\]\.command\.command\.kp: expected"
    ):
        check_elements((spoilt,), ARM, TS)
    assert lag.possible() and not spoilt.possible()


def test_jumps_are_passed_on():
    travel = fj.references.Travel(2.0, begin=1.0)
    move = fj.references.JointMove([0, 0, 0], [1, 1, 1], travel)
    pd = fj.PDController(1.0, 1.0, 1.0, move)
    path = fj.TipTask(fj.references.Line([1, 0], [1, 1]), travel)
    drive = fj.control.FirstOrderLag(pd, 0.1)
    for part in (
        travel,
        move,
        path,
        pd,
        drive,
        fj.simulation.PrescribedMotion(1, move),
    ):
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
        args = args_of(ARM, jnp.zeros(3), (pd, Raised(time)))
        ends.append(known_times(clocks_apart(args, jnp.array([0, 1.0]))))
    np.testing.assert_array_equal(*ends)


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
        at = jnp.array(0.0), jnp.ones(3), jnp.zeros(3), ARM
        opened = element.opened(*at)
        np.testing.assert_array_equal(opened.jump_ts, [1.0])
        assert any(leaf is level for leaf in jax.tree.leaves(opened))
        return jnp.sum(opened(*at))

    assert jax.grad(found)(2.0) == 3.0


def test_a_function_in_place_of_an_array_is_checked_where_it_is_called():
    wrench = fj.Wrench(fj.Point(3, 1.0), lambda t: jnp.zeros(3))
    with pytest.raises(ValueError, match="^force: expected an array of 2 real numbers"):
        wrench(0.0, jnp.zeros(3), jnp.zeros(3), ARM)
    with pytest.raises(ValueError, match="^stiffness: expected"):
        fj.SpringDamper(fj.Point(0), fj.Point(1), stiffness=lambda t: 1.0)


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


@pytest.mark.parametrize(
    "function",
    [
        lambda t, q, qd, linkage: np.sign(qd),
        lambda t, q, qd, linkage: q if t < 0.2 else qd,
        lambda t, q, qd, linkage: -float(q[0]) * qd,
    ],
)
def test_functions_that_cannot_be_traced_are_refused(function):
    (element,), q = elements("forces", (function,)), np.zeros(3)
    with pytest.raises(TypeError, match=r"^forces\[0\]: expected jax\.numpy .*, got: "):
        element_effort(0, element, TS[0], q, q, ARM, ())


def test_a_reference_without_a_motion_is_refused():
    class Nothing(fj.references.Reference):
        pass

    with pytest.raises(TypeError, match="^Nothing: expected a method `__call__`"):
        Nothing()


def test_nothing_else_is_asked_for_attributes():
    """Only the adapter asks; trees and JAX's programs are read by names of fields."""
    folder = Path(fj.__file__).parent
    asking = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*.py")
        if "hasattr(" in path.read_text() or "getattr(" in path.read_text()
    }
    # These of a sweep ask arrays and programs.
    of_sweeps = {"batches/chunks.py", "batches/store.py"}
    assert asking == {"linkage/fields.py", "data/files.py"} | of_sweeps
