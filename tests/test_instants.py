"""Functions that take forces know what holds joints and when masses come, or refuse."""

import inspect

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, HOLDING
from test_package import NAMESPACES

import fdof_jax as fj
from fdof_jax import analysis
from fdof_jax.pictures import drawing, plotting

REST = fj.State([0.3], [0.0])
PD = fj.PDController(9.0, 1.0, np.inf, lambda t, linkage: (jnp.ones(1), jnp.zeros(1)))
ROWS = jnp.zeros(1), jnp.array([[0.3]]), jnp.zeros((1, 1))
ARGUMENTS = dict(
    linkage=BAR, state=REST, q=[0.3], qd=[1], qdd=[0], tau=[0], controller=PD, joint=1,
    frequency=5.0, damping_ratio=0.7,
    solution=fj.Solution(*ROWS, stats={}, result=diffrax.RESULTS.successful),
)  # fmt: skip
# An instant has no modes: these refuse what holds joints.
FREE = {
    fj.linearize, analysis.equilibrium, analysis.holding_efforts,
    analysis.closed_loop_modes, analysis.open_loop, analysis.loop_matrices,
    analysis.closed_loop,
}  # fmt: skip
# These are given no time: they refuse masses that depend on it. What holds joints has
# no mass and no energy, and its efforts are the caller's.
TIMELESS = {
    fj.forward_dynamics, fj.inverse_dynamics, fj.bias_force, fj.mass_matrix, fj.energy,
    analysis.inertia_ratios, fj.control.gains_from_frequency,
}  # fmt: skip
# These compute a motion, take one or a time, draw, or write.
OTHERS = {
    fj.simulate, fj.simulate_sampled, fj.step, fj.sweep, fj.joint_efforts,
    fj.joint_reactions, analysis.response, plotting.effort_profile,
    plotting.energy_stack, plotting.motion_profile, drawing.animate,
    drawing.animate_grid, drawing.draw_linkage, drawing.geometry,
    drawing.topology_grid, fj.to_mjcf, fj.view, fj.forces.elements_on,
    fj.forces.present,
}  # fmt: skip
HOLDERS = fj.forces.JointFriction(9.0), fj.forces.HardStops(0, 1), fj.forces.Brake(1)


class Leaking(fj.forces.Payload):
    def at(self, t):
        return fj.forces.Payload(self.place, self.mass - t)


class Carried(fj.forces.InertialElement):
    """A point mass of 2 kg without weight, which loads the tip of the bar."""

    def coordinates(self, q, linkage):
        return fj.tip_position(linkage, q)

    def weights(self, linkage):
        return 2 * jnp.ones(2)

    def loads(self, t, q, qd, qdd, linkage):
        push = -2 * self.accelerations(q, qd, qdd, linkage)
        return (fj.forces.Load(fj.Point(1, 1.0), push),)


def test_no_function_that_takes_forces_is_left_out():
    rooms = *NAMESPACES, drawing, plotting
    public = {getattr(room, name) for room in rooms for name in room.__all__}
    functions = filter(inspect.isfunction, public)
    taking = {of for of in functions if "forces" in inspect.signature(of).parameters}
    assert taking == FREE | TIMELESS | OTHERS


NAMED = {of.__name__: of for of in FREE | TIMELESS}


@pytest.mark.parametrize("name", sorted(NAMED))  # processes order sets differently
def test_what_an_instant_cannot_know_is_refused(name):
    function = NAMED[name]
    needed = inspect.signature(function).parameters.keys() & ARGUMENTS
    given = {key: ARGUMENTS[key] for key in needed}
    place, kind = fj.Point(1, 1.0), fj.forces.Payload
    loads = kind(place, 2.0, begin=0.5), kind(place, 2.0, end=0.5), Leaking(place, 2.0)
    refused = HOLDERS if function in FREE else loads
    words = "no element that holds" if function in FREE else "masses of one time"
    for element in refused:
        with pytest.raises(ValueError, match=rf"^forces\[1\]: expected {words}"):
            function(**given, forces=(fj.JointDamper(1.0), element))


@pytest.mark.parametrize("element", HOLDERS, ids=lambda e: type(e).__name__)
def test_loops_and_limits_of_held_joints_are_refused(element):
    with pytest.raises(ValueError, match="^controller: expected no element that holds"):
        analysis.open_loop(BAR, [0.3], element, 1)
    scene, limits = fj.Scene(BAR, REST, (PD, element), 1.0), fj.tuning.Limits(effort=1)
    with pytest.raises(ValueError, match=r"^forces\[1\]: expected no element that hol"):
        fj.tuning.tune_within(scene, limits, loss=fj.tuning.joint_errors)


@pytest.mark.slow
@pytest.mark.parametrize("element", HOLDERS[1:], ids=lambda e: type(e).__name__)
def test_stops_and_brakes_of_prescribed_joints_are_refused(element):
    still = fj.simulation.PrescribedMotion(1, PD.reference)
    with pytest.raises(ValueError, match="a joint whose motion is prescribed"):
        fj.simulate(BAR, REST, [0, 1], (still, element))


def test_a_payload_counts_while_it_is_there():
    always = fj.forces.Payload(fj.Point(1, 1.0), 2.0, 0.1)
    load = always.replace(begin=0.2, end=0.6, velocity=[0.1, 0.2])
    for function in (
        lambda t, *forces: analysis.holding_efforts(BAR, [0.3], forces, t),
        lambda t, *forces: fj.linearize(BAR, REST, forces, t).A,
    ):
        found = [function(t, load) for t in (0.1, 0.2, 0.4, 0.7)]
        there, away = function(0.0, always), function(0.0)
        np.testing.assert_allclose(found, [away, there, there, away], rtol=1e-14)
    # M of a bar and a point mass, in closed form
    values = [fj.mass_matrix(BAR, [0.3], (load.at(t),))[0, 0] for t in (0.1, 0.4)]
    np.testing.assert_allclose(values, [1 / 3, 1 / 3 + 2 + 0.1], rtol=1e-14)


def test_bearings_carry_what_an_own_element_declares():
    """Beside a bar that turns at 3 rad/s and carries it at its tip."""
    turns = fj.Solution(*ROWS[:2], jnp.array([[3.0]]), {}, diffrax.RESULTS.successful)
    found = fj.joint_reactions(BAR.replace(gravity=0), (Carried(),), turns)[0, 0]
    pull = -(0.5 + 2) * 3**2 * np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(found, [*pull, 0], atol=1e-12)


def test_what_holds_joints_adds_no_mass_and_no_energy():
    held = tuple(HOLDING[name] for name in ("sticking friction", "hard stops", "brake"))
    arm, q = fj.scenes.fig7().linkage, [0.1, 0.2, 0.3]
    for function, count in (fj.mass_matrix, 1), (fj.bias_force, 2), (fj.energy, 2):
        state = [q] * count
        given, bare = function(arm, *state, held), function(arm, *state)
        np.testing.assert_array_equal(given, bare)
