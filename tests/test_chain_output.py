"""Tables, files and pictures of chains, and shapes that do not fit a chain."""

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj

RNG = np.random.default_rng(0)
TWO = chains.random_chain("RR", RNG)
REST = fj.State(np.zeros(2), np.zeros(2))


@pytest.fixture(scope="module", params=["R", "RP", "RFPRR"])
def motion(request):
    topology = request.param
    n = len(topology)
    chain = chains.random_chain(topology, np.random.default_rng(n))
    start, forces = (
        fj.State(np.full(n, 0.2), np.zeros(n)),
        (fj.JointDamper(np.ones(n)),),
    )
    solution = fj.simulate(chain, start, np.linspace(0, 0.1, 11), forces, **SHORT)
    return topology, fj.Scene(chain, start, forces, 0.1), solution


def test_tables_have_a_column_per_joint(motion):
    topology, (chain, *_), solution = motion
    names = [f"{kind}{k + 1}" for k, kind in enumerate(topology)]
    columns = list(fj.to_pandas(chain, solution).columns)
    assert [c.split()[0] for c in columns[: len(names)]] == names
    assert fj.to_xarray(chain, solution).joint.values.tolist() == names


def test_files_keep_scenes(motion, tmp_path):
    topology, scene, _ = motion
    fj.save(tmp_path / "scene.json", scene)
    again = fj.load(tmp_path / "scene.json")
    jax.tree.map(np.testing.assert_array_equal, again, scene)
    assert f'"topology": "{topology}"' in (tmp_path / "scene.json").read_text()


def test_pictures_show_all_joints_that_move(motion):
    topology, (chain, _, forces, _), solution = motion
    n, moving = len(topology), len(topology.replace("F", ""))
    curves = lambda fig: [len(ax.lines) for ax in fig.axes]
    assert sum(curves(fj.plotting.motion_profile(chain, solution))) == moving
    efforts = fj.plotting.effort_profile(chain, forces, solution)
    assert sum(curves(efforts)) == moving
    kinetic, potential, _ = curves(fj.plotting.energy_profile(chain, solution))
    assert kinetic == potential == n
    fig, ax = plt.subplots()
    fj.drawing.draw_linkage(chain, solution.q[0], ax)
    film = fj.drawing.animate(chain, solution)
    film._init_draw()  # the first frame
    drawn = film._fig.axes[0].lines
    tip = np.asarray(fj.tip_position(chain, solution.q[0]))
    for lines in (ax.lines, drawn):
        points = np.concatenate([np.array(line.get_data()).T for line in lines])
        assert np.linalg.norm(points - tip, axis=1).min() < 1e-9
    plt.close("all")


MISFITS = {
    "kp": lambda: fj.PDController([1, 1, 1], 1, 1, chains.Hold(jnp.zeros(2))),
    "coefficient": lambda: fj.JointDamper([1, 2, 3]),
    "tau": lambda: fj.JointEffort([1, 2, 3]),
    "inertia": lambda: fj.forces.Armature([1, 2, 3]),
    "lower": lambda: fj.forces.JointStops([-1, -1, -1], 1.0),
    "command.tau": lambda: fj.control.FirstOrderLag(fj.JointEffort([1, 2, 3]), 0.1),
    "reference.start": lambda: fj.PDController(
        1, 1, 1, fj.references.JointMove([0] * 3, [1] * 3, fj.references.Travel(1.0))
    ),
}


@pytest.mark.parametrize("name", MISFITS)
def test_elements_of_other_chains_are_refused(name):
    expected = rf"^forces\[0\]\.{name}: expected numbers for 2 joints, .*got 3"
    forces = (MISFITS[name](),)
    known = lambda q: fj.simulate(TWO, REST._replace(q=q), [0, 0.1], forces)
    for call in (known, jax.jit(known)):
        with pytest.raises(ValueError, match=expected):
            call(REST.q)
    if not name.startswith("command"):  # of a state, which has no linearization
        with pytest.raises(ValueError, match=expected):
            fj.linearize(TWO, REST, forces)


def test_states_and_links_of_other_chains_are_refused():
    three = fj.State(np.zeros(3), np.zeros(3))
    words = "expected an array of 2 real numbers"
    with pytest.raises(ValueError, match=rf"^state0\.q: {words}.*\(3,\)"):
        fj.simulate(TWO, three, [0, 0.1])
    with pytest.raises(ValueError, match=rf"^state\.q: {words}"):
        fj.step(TWO, three, [0, 0], 0.1)
    with pytest.raises(ValueError, match=rf"^state\.q: {words}"):
        fj.linearize(TWO, three)
    with pytest.raises(ValueError, match=rf"^q: {words}"):
        fj.analysis.equilibrium(TWO, np.zeros(3))
    point = fj.Point(3, 0.1)
    ends = fj.Point(0, 0.1), point
    for element in (
        fj.Wrench(point, [1, 0]),
        fj.SpringDamper(*ends, stiffness=1.0),
        fj.LinearActuator(*ends),
    ):
        with pytest.raises(
            ValueError, match=r"^forces\[0\]\..*link: expected 0 .* 1 to 2, got 3"
        ):
            fj.simulate(TWO, REST, [0, 0.1], (element,))
    armature, zeros = (fj.forces.Armature([1, 2, 3]),), np.zeros(2)
    for call in (fj.forward_dynamics, lambda *row: fj.energy(*row[:3], row[4])):
        with pytest.raises(ValueError, match=r"^forces\[0\]\.inertia: .* 2 joints"):
            call(TWO, zeros, zeros, zeros, armature)
    hold = chains.Hold(jnp.zeros(3))
    place = r"^forces\[0\]\.reference"
    with pytest.raises(ValueError, match=f"{place}: {words} for 2 joints"):
        fj.simulate(TWO, REST, [0, 0.1], (fj.PDController(1, 1, 1, hold),))


HOLD = chains.Hold(jnp.zeros(2))
OF_THREE = {
    r"b\.link: expected 0 .* 1 to 2, got 3": fj.SpringDamper(
        fj.Point(0, 0.1), fj.Point(3, 0.1)
    ),
    "joints: expected 1 to 2, got 3": fj.simulation.PrescribedMotion(3, HOLD),
    "model: expected the arm's own topology": fj.control.GravityFeedforward(
        *(1, 1, 1, HOLD), chains.random_chain("RRR", RNG)
    ),
}


@pytest.mark.parametrize("fault", OF_THREE)
def test_values_of_other_chains_are_refused_at_each_door(fault):
    forces, zeros, ts = (OF_THREE[fault],), np.zeros(2), [0, 0.1]
    motion = fj.Solution(
        *(np.zeros(2), np.zeros((2, 2)), np.zeros((2, 2))),
        stats={"num_steps": 1, "time_reached": 0.0},
        result=diffrax.RESULTS.successful,
    )
    both = fj.State(np.zeros((2, 2)), np.zeros((2, 2)))
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * 2), TWO)
    for call in (
        lambda: fj.sweep(TWO, both, ts, forces),
        lambda: fj.sweep(batch, REST, ts, forces),
        lambda: jax.jit(lambda arm: fj.simulate(arm, REST, ts, forces))(TWO),
        lambda: fj.linearize(TWO, REST, forces),
        lambda: fj.joint_efforts(TWO, forces, motion),
        lambda: fj.joint_reactions(TWO, forces, motion),
        lambda: fj.analysis.equilibrium(TWO, zeros, forces),
        lambda: fj.energy(TWO, zeros, zeros, forces),
        lambda: fj.forward_dynamics(TWO, zeros, zeros, zeros, forces),
    ):
        with pytest.raises(ValueError, match=rf"^forces\[0\]\.{fault}"):
            call()


def test_numbers_of_another_arm_are_refused_by_name():
    both = fj.State(np.zeros((2, 2)), np.zeros((2, 2)))
    move = fj.references.JointMove([0] * 3, [1] * 3, fj.references.Travel(1.0))
    with pytest.raises(ValueError, match=r"^forces\[0\]\.reference\.start: expected"):
        fj.sweep(TWO, both, [0, 0.1], (fj.PDController(1, 1, 1, move),))
    plain = lambda t, q, qd, linkage: jnp.zeros(3)
    for call in fj.linearize, lambda *a: fj.analysis.equilibrium(a[0], a[1].q, a[2]):
        with pytest.raises(ValueError, match=r"^forces\[0\]: expected it to return"):
            call(TWO, REST, (plain,))
    for call in fj.analysis.equilibrium, fj.drawing.draw_linkage:
        with pytest.raises(ValueError, match=r"^q: .* for 2 joints"):
            call(TWO, np.zeros(3))
    for name, value in dict(mass=np.ones(3), length=np.ones(4), locked=1.0).items():
        arm = eqx.tree_at(lambda arm, name=name: getattr(arm, name), TWO, value)
        for call in fj.tip_position, jax.jit(fj.tip_position):
            with pytest.raises(ValueError, match=rf"^linkage\.{name}: .* 2 pairs"):
                call(arm, np.zeros(2))
    line = fj.references.Line([9, 0], [9, 1])
    far = fj.TipTask(line, fj.references.Travel(1.0), orientation=None)
    with pytest.raises(ValueError, match="reach on branch"):
        fj.simulate(TWO, REST, [0, 0.1], (fj.PDController(1, 1, 1, far),))


def test_models_of_another_topology_are_refused_and_no_point_is_nowhere():
    model = chains.random_chain("RP", RNG)
    control = fj.control.GravityFeedforward(1, 1, 1, HOLD, model)
    with pytest.raises(ValueError, match=r"^forces\[0\]\.model: expected the arm"):
        fj.linearize(TWO, REST, (control,))
    assert control.fits(model, np.zeros(1)) and not control.fits(TWO, np.zeros(1))
    # A link that is traced is not known to be missing.
    spring = fj.SpringDamper(fj.Point(0, 0.1), fj.Point(3, 0.1), stiffness=1)
    stored = lambda spring: spring.potential_energy(np.zeros(2), TWO)
    assert np.isnan(jax.jit(stored)(spring))


def test_motions_of_other_chains_are_refused():
    motion = fj.Solution(
        *(np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3))),
        stats={"num_steps": 1, "time_reached": 0.0},
        result=diffrax.RESULTS.successful,
    )
    task = fj.CircleTask()
    for call in (
        lambda: fj.to_pandas(TWO, motion),
        lambda: fj.to_xarray(TWO, motion),
        lambda: fj.drawing.chrono_cyclograph(TWO, motion),
        lambda: fj.plotting.energy_profile(TWO, motion),
        lambda: fj.plotting.effort_profile(TWO, (), motion),
        lambda: fj.plotting.tracking_by_error(TWO, task, motion),
        lambda: fj.analysis.closed_loop_modes(TWO, (), motion),
        lambda: fj.joint_efforts(TWO, (), motion),
    ):
        with pytest.raises(ValueError, match="^solution: expected a motion of 2 joint"):
            call()
    with pytest.raises(ValueError, match=r"^motions\['a'\]: expected a motion of 2"):
        fj.drawing.topology_grid({"a": (TWO, motion)})


def test_sizes_are_refused_with_their_reason():
    fields = dict(length=[0, 1, 1], com=np.zeros((2, 2)), mass=[1, 1], inertia=[1, 1])
    for name, words in (
        ("length", "3 real numbers for the ground and 2 moving links"),
        ("mass", "2 real numbers for 2 moving links"),
        ("com", "2x2 real numbers for 2 moving links"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: expected an array of {words}"):
            fj.Linkage("RR", **fields | {name: np.zeros((4, 4))})
    with pytest.raises(ValueError, match="^q: expected .* numbers for 2 joints"):
        fj.tip_position(TWO, [0, 0, 0])
