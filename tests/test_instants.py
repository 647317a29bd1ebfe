"""Functions that take forces know what holds joints and when masses come, or refuse."""

import inspect

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import HOLDING
from test_package import NAMESPACES

import fdof_jax as fj
from fdof_jax import analysis
from fdof_jax.pictures import drawing, plotting

BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
Q, REST = [0.3], fj.State([0.3], [0.0])
PD = fj.PDController(9.0, 1.0, np.inf, lambda t, linkage: (jnp.ones(1), jnp.zeros(1)))
STEP = fj.Scene(BAR, REST, (PD,), 1.0)
MOTION = fj.Solution(
    *(jnp.zeros(1), jnp.array([Q]), jnp.zeros((1, 1))),
    stats={}, result=diffrax.RESULTS.successful,
)  # fmt: skip

# An instant has no modes: these refuse what holds joints.
FREE = {
    fj.linearize: lambda forces: fj.linearize(BAR, REST, forces),
    analysis.equilibrium: lambda forces: analysis.equilibrium(BAR, Q, forces),
    analysis.holding_efforts: lambda forces: analysis.holding_efforts(BAR, Q, forces),
    analysis.closed_loop_modes: lambda forces: analysis.closed_loop_modes(
        BAR, forces, MOTION
    ),
    analysis.open_loop: lambda forces: analysis.open_loop(BAR, Q, PD, 1, forces),
    analysis.loop_matrices: lambda forces: analysis.loop_matrices(BAR, Q, PD, forces),
    analysis.closed_loop: lambda forces: analysis.closed_loop(BAR, Q, PD, 1, forces),
}
# These are given no time: they refuse masses that depend on it. What holds joints has
# no mass and no energy, and its efforts are the caller's.
TIMELESS = {
    fj.forward_dynamics: lambda forces: fj.forward_dynamics(BAR, Q, [1], [0], forces),
    fj.inverse_dynamics: lambda forces: fj.inverse_dynamics(BAR, Q, [1], [0], forces),
    fj.bias_force: lambda forces: fj.bias_force(BAR, Q, [1], forces),
    fj.mass_matrix: lambda forces: fj.mass_matrix(BAR, Q, forces),
    fj.energy: lambda forces: fj.energy(BAR, Q, [1], forces),
    analysis.inertia_ratios: lambda forces: analysis.inertia_ratios(BAR, Q, forces),
    fj.control.gains_from_frequency: lambda forces: fj.control.gains_from_frequency(
        BAR, Q, 5.0, 0.7, forces
    ),
}
# These compute a motion, take one or a time, draw, or write.
OTHERS = {
    fj.simulate, fj.simulate_sampled, fj.step, fj.sweep, fj.joint_efforts,
    fj.joint_reactions, analysis.response, plotting.effort_profile,
    plotting.energy_stack, plotting.motion_profile, drawing.animate,
    drawing.animate_grid, drawing.draw_linkage, drawing.geometry,
    drawing.topology_grid, fj.to_mjcf, fj.view, fj.forces.elements_on,
    fj.forces.present,
}  # fmt: skip


def test_no_function_that_takes_forces_is_left_out():
    rooms = *NAMESPACES, drawing, plotting
    public = {getattr(room, name) for room in rooms for name in room.__all__}
    functions = filter(inspect.isfunction, public)
    taking = {of for of in functions if "forces" in inspect.signature(of).parameters}
    assert taking == FREE.keys() | TIMELESS.keys() | OTHERS


HOLDERS = [fj.forces.JointFriction(9.0), fj.forces.HardStops(0, 1), fj.forces.Brake(1)]


@pytest.mark.parametrize("function", FREE, ids=lambda of: of.__name__)
@pytest.mark.parametrize("element", HOLDERS, ids=lambda e: type(e).__name__)
def test_what_holds_joints_is_refused_at_an_instant(function, element):
    words = (
        rf"^forces\[1\]: expected no element that holds .*{type(element).__name__}\("
    )
    with pytest.raises(ValueError, match=words):
        FREE[function]((fj.JointDamper(1.0), element))


@pytest.mark.parametrize("element", HOLDERS, ids=lambda e: type(e).__name__)
def test_loops_and_limits_of_held_joints_are_refused(element):
    with pytest.raises(ValueError, match="^controller: expected no element that holds"):
        analysis.open_loop(BAR, Q, element, 1)
    scene = STEP._replace(forces=(PD, element))
    with pytest.raises(ValueError, match=r"^forces\[1\]: expected no element that hol"):
        fj.tuning.tune_within(
            scene, fj.tuning.Limits(effort=1.0), loss=fj.tuning.joint_errors
        )


class Leaking(fj.forces.Payload):
    def at(self, t):
        return fj.forces.Payload(self.place, self.mass - t)


@pytest.mark.parametrize("function", TIMELESS, ids=lambda of: of.__name__)
def test_masses_that_depend_on_time_need_one(function):
    place, kind = fj.Point(1, 1.0), fj.forces.Payload
    loads = kind(place, 2.0, begin=0.5), kind(place, 2.0, end=0.5), Leaking(place, 2.0)
    for load in loads:
        with pytest.raises(ValueError, match=r"^forces\[1\]: expected masses of one t"):
            TIMELESS[function]((fj.JointDamper(1.0), load))


def test_a_payload_counts_while_it_is_there():
    always = fj.forces.Payload(fj.Point(1, 1.0), 2.0, 0.1)
    load = always.replace(begin=0.2, end=0.6, velocity=[0.1, 0.2])
    functions = [
        lambda t, *forces: analysis.holding_efforts(BAR, Q, forces, t),
        lambda t, *forces: fj.linearize(BAR, REST, forces, t).A,
    ]
    for function in functions:
        found = [function(t, load) for t in (0.1, 0.2, 0.4, 0.7)]
        there, away = function(0.0, always), function(0.0)
        np.testing.assert_allclose(found, [away, there, there, away], rtol=1e-14)
    # M and V of a bar and a point mass, in closed form
    values = [fj.mass_matrix(BAR, Q, (load.at(t),))[0, 0] for t in (0.1, 0.4)]
    np.testing.assert_allclose(values, [1 / 3, 1 / 3 + 2 + 0.1], rtol=1e-14)


def test_what_holds_joints_adds_no_mass_and_no_energy():
    held = tuple(HOLDING[name] for name in ("sticking friction", "hard stops", "brake"))
    arm, q = fj.scenes.fig7().linkage, [0.1, 0.2, 0.3]
    for function in fj.mass_matrix, fj.bias_force, fj.energy:
        state = (q,) if function is fj.mass_matrix else (q, q)
        np.testing.assert_array_equal(
            function(arm, *state, held), function(arm, *state)
        )
