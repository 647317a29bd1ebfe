"""Models of others: read, rejected by name, and accelerating as in MuJoCo."""

import warnings

import equinox as eqx
import jax
import mjcf_texts as texts
import mujoco
import numpy as np
import pytest
from mjcf_oracle import equal, error_of, in_mujoco
from mjcf_texts import ALIKE, BASE, REFUSED, ROBOT, TEXTS, arm, robot

import fdof_jax as fj

pytestmark = pytest.mark.filterwarnings("ignore:source. contacts are left out")


@pytest.mark.slow
@pytest.mark.parametrize("name", TEXTS)
def test_models_accelerate_as_in_mujoco(name, tmp_path):
    text, joints, drop, tolerance, files = TEXTS[name]
    for file, content in (files | {"arm.xml": text}).items():
        (tmp_path / file).write_text(content)
    source = tmp_path / "arm.xml" if files else text
    assert error_of(source, drop) <= tolerance
    assert len(fj.from_mjcf(source, drop=drop).linkage.mass) == joints


# What accounts tell of additions and of what is left out
TOLD = {
    "undeclared world": "link world added, as parent of joint world-base",
    "neighbours that overlap": "left out between the ground and the first link",
    "plugin of Gazebo": "left out: gazebo of robot arm",
    "locked shoulder with a reference": "joint shoulder is fixed at -0.4",
}


@pytest.mark.parametrize("name", ALIKE)
def test_what_people_write_is_read_as_what_mujoco_reads(name, tmp_path):
    text, plain = ALIKE[name]
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="latin-1" if "Europe" in name else "utf-8")
    expected = fj.from_mjcf(plain, drop=("contacts",))
    for source in (text, path):
        found = fj.from_mjcf(source, drop=("contacts",))
        jax.tree.map(lambda a, b: equal(a, b, 1e-12), found[:3], expected[:3])
    assert TOLD.get(name, "") in str(fj.from_mjcf(text).account)


def test_models_and_specifications_are_sources_and_stay_as_they_are(tmp_path):
    text, file = TEXTS["target on slides, gravity across"].text, tmp_path / "arm.xml"
    file.write_text(text)
    model, _ = in_mujoco(text)
    before = model.opt.gravity.copy(), model.dof_damping.copy()
    first = fj.from_mjcf(text)
    for source in (model, mujoco.MjSpec.from_string(text), str(file), file):
        assert eqx.tree_equal(tuple(first[:3]), tuple(fj.from_mjcf(source)[:3]))
    equal(model.opt.gravity, before[0])
    equal(model.dof_damping, before[1])


def test_numbers_of_the_account_and_of_the_elements():
    """Of an arm whose second hinge turns against the first."""
    servo = '<position joint="elbow" kp="9" kv="2" gear="3" forcerange="-4 4"/>'
    start = '<keyframe><key qpos=".1 .2" qvel=".3 .4" ctrl=".6"/></keyframe>'
    own = 'range="-1 .5" margin=".1" stiffness="4" springref=".2" armature=".1"'
    head, tail = '<compiler angle="radian" autolimits="true"/>', f"{servo}</actuator>"
    rest = dict(head=head, tail=f"<actuator>{tail}{start}", axes=texts.OPPOSITE)
    model = fj.from_mjcf(arm('frictionloss=".3"', own, **rest))
    armature, spring, friction, stops, pd = model.forces
    equal(model.state0, [[0.1, -0.2], [0.3, -0.4]])
    equal(armature.inertia, [0, 0.1])
    equal((spring.stiffness, spring.rest), [[0, 4], [0, -0.2]])
    equal(friction.level, [0.3, 0])
    equal((stops.lower, stops.upper), [[-np.inf, -0.4], [np.inf, 0.9]])
    equal((pd.kp, pd.kd, pd.limit), [[0, 81], [0, 18], [np.inf, 12]])
    equal(pd.reference.q, [0, -0.2])
    for words in ("q = -qpos", "range -0.4 to 0.9", "creeps", "a control of 0.6"):
        assert words in str(model.account)


TIPS = [
    ("", None, (0.3, 0)),  # the end of the capsule
    ('<site name="ee" pos=".2 0 .1"/><site name="pen"/>', None, (0.2, 0.1)),
    ('<site name="ee"/><site name="pen" pos=".3 0 -.1"/>', "pen", (0.3, -0.1)),
    ('<body pos=".3 0 0"><body pos=".1 0 0" name="hand"/></body>', None, (0.4, 0)),
    ('<geom type="box" size=".1 .1 .2" pos=".2 .1 0"/>', None, (0.2, 0)),
]


@pytest.mark.parametrize("last, tip, at", TIPS)
def test_where_the_tip_is(last, tip, at):
    linkage = fj.from_mjcf(arm(last=last, axes=["0 -1 0"] * 2), tip=tip).linkage
    equal(fj.tip_position(linkage, [0, 0]), np.add([0.4, 0.1], at))  # x is that of X


def test_a_stop_is_about_as_stiff_as_in_mujoco():
    text = """<mujoco><compiler autolimits="true"/><option gravity="0 0 0"/><worldbody>
    <body><joint name="s" type="slide" axis="1 0 0" range="-1 1"
    solreflimit=".05 1"/><geom size=".1" mass="2"/></body></worldbody>
    <actuator><motor joint="s"/></actuator></mujoco>"""
    model, data = in_mujoco(text)
    data.ctrl[:], data.qpos[:] = 40, 1
    mujoco.mj_step(model, data, 2000)
    stops, push = fj.from_mjcf(text, controls=[40]).forces
    within = push.tau / stops.stiffness  # where it rests
    np.testing.assert_allclose(within, data.qpos - 1, rtol=0.2)


def test_a_state_at_its_limit_goes_no_further():
    """MuJoCo clips states at the end of its steps."""
    servo = '<intvelocity joint="elbow" kp="40" actrange="-.3 .3"/>'
    text = arm(tail=f"<actuator>{servo}</actuator>")
    model, data = in_mujoco(text)
    end = 0.3 + 1e-12
    for control, start in ((9, end), (9, 0.2), (-9, end), (-9, -end), (9, -end)):
        data.act[:], data.ctrl[:] = start, control
        mujoco.mj_step(model, data)
        linkage, state0, (servo,), _ = fj.from_mjcf(text, controls=[control])
        rate = servo(0.0, *state0, linkage, np.array([start]))[1]
        equal(data.act - start, model.opt.timestep * rate)


def test_a_robot_keeps_its_meshes_apart_and_has_named_links(tmp_path):
    """Meshes of one name in two folders; a fixed link is the tip."""
    links = dict(base="", flange="")
    for name, size in (("a", 0.6), ("b", 1.2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "part.obj").write_text(texts.wedge(size))
        mesh = f'<geometry><mesh filename="{name}/part.obj"/></geometry>'
        links[name] = f"<collision>{mesh}</collision>"
    parts = [f'<link name="{name}">{inside}</link>' for name, inside in links.items()]
    parts += [texts.joint("fixed", "b", "flange", ".3 0 0"), *texts.TURNS]
    file = tmp_path / "arm.urdf"
    file.write_text(robot(*parts))
    linkage = fj.from_mjcf(file, tip="flange", drop=("contacts",)).linkage
    # Of 1000 kg/m^3. MuJoCo 3 mixes up the meshes, so that it is no reference.
    equal(linkage.mass, [36, 288], 1e-6)
    equal(np.hypot(*fj.tip_position(linkage, [0, 0])), np.hypot(0.7, 0.1))


def test_a_missing_mesh_of_a_body_whose_mass_is_given(tmp_path):
    meshes = '<asset><mesh file="hull.stl"/><mesh name="n" file="{}"/></asset>'
    head = '<compiler meshdir="parts"/>' + meshes.format("other/skin.obj")
    shapes = '<geom type="mesh" mesh="hull"/><geom type="mesh" mesh="n" mass="2"/>'
    inertial = '<inertial pos=".2 0 .05" mass="1.5" diaginertia=".01 .02 .02"/>'
    text, path = arm(head=head, between=inertial + shapes), tmp_path / "arm.xml"
    path.write_text(text)
    found, expected = fj.from_mjcf(path), fj.from_mjcf(arm(between=inertial))
    assert eqx.tree_equal(found.linkage, expected.linkage)
    assert "left out: mesh hull, which is not there" in str(found.account)
    with pytest.raises(ValueError, match="names no other files"):
        fj.from_mjcf(text)
    computed = text.replace("<compiler", '<compiler inertiafromgeom="true"')
    for wrong in text.replace(inertial, ""), computed:
        path.write_text(wrong)
        with pytest.raises(ValueError, match="MuJoCo accepts: .*hull.stl"):
            fj.from_mjcf(path)


def test_no_file_is_opened_that_was_not_asked_for(tmp_path, monkeypatch):
    """Not even those that are beside a robot, in parts that are not read."""
    for name in ("control.so", "picture.stl", "hidden.stl"):
        (tmp_path / name).write_bytes(b"")
    path, opened = tmp_path / "arm.urdf", []
    unread = '<gazebo><plugin filename="control.so"/></gazebo><!-- -- <mesh '
    unread += 'filename="hidden.stl"/> --><link name="base"><visual><geometry><mesh '
    unread += 'filename="picture.stl"/></geometry></visual></link>'
    path.write_text(ROBOT.replace(BASE, unread))
    read = type(path).read_bytes
    note = lambda self: opened.append(self) or read(self)
    monkeypatch.setattr(type(path), "read_bytes", note)
    fj.from_mjcf(path)
    assert opened == [path]


def test_a_turned_inertia_is_that_of_its_axes(monkeypatch):
    """Of a hinge about y, after turns about x and z; MuJoCo turned them otherwise."""
    x, z = 0.1, 0.2  # of `link`
    about_x = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    about_z = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    axis = (np.array(about_z) @ about_x)[1]
    inertia = [[0.02, 0.002, 0], [0.002, 0.03, -0.001], [0, -0.001, 0.04]]
    turns = robot(BASE, texts.link("a"), texts.joint("continuous", "base", "a"))
    linkage = fj.from_mjcf(turns).linkage
    np.testing.assert_allclose(linkage.inertia, [axis @ inertia @ axis], rtol=1e-14)
    monkeypatch.setattr(mujoco, "__version__", "3.13.2")
    with pytest.raises(ImportError, match="3.14 or newer"):
        fj.from_mjcf(ROBOT)
    fj.from_mjcf(arm())


def test_options_of_a_model_and_controls_that_are_clipped_to_ranges():
    at = lambda option: fj.from_mjcf(arm("damping='1'", head=f"<option {option}"))
    assert at('gravity="0 5 -2"/>').linkage.gravity == 2
    assert at('><flag gravity="disable"/></option>').linkage.gravity == 0
    newer = "mjDSBL_DAMPER" in mujoco.mjtDisableBit.__members__
    flag = f'><flag {"damper" if newer else "passive"}="disable"/></option>'
    assert len(at("/>").forces) == 1 and not at(flag).forces
    motor = '<motor joint="elbow" gear="-2" forcerange="-.5 .5" ctrlrange="-9 9"/>'
    text = arm(tail=f"<actuator>{motor}</actuator>")
    for control, effort in ((5.0, -1.0), (-20.0, 1.0)):
        model = fj.from_mjcf(text, controls=[control])
        equal(model.forces[0].tau, [0, effort])
        words = dict(model.account.lines)["actuator 0"]
        assert f"a control of {np.clip(control, -9, 9):g}" in words
        assert "range, -9 to 9" in words and "force range, -0.5 to 0.5" in words


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_no_planar_chain_is_rejected_by_name(words):
    with pytest.raises(ValueError, match=f"^source: expected .*{words}"):
        fj.from_mjcf(REFUSED[words])


def test_what_is_no_source_is_rejected(tmp_path):
    (tmp_path / "empty.xml").write_text("")
    for source, words in (
        ("arm.xml", "an XML text, the path .* 'arm.xml'.$"),
        (tmp_path, "and the file to be there"),
        (tmp_path / "empty.xml", "a model that MuJoCo accepts"),
        (12, "an XML text, the path"),
        ("<arm", "a model in XML: .*[^\\n]$"),
        ("<a>" * 9999, "a model in XML: .{,200}$"),
    ):
        with pytest.raises(ValueError, match=f"^source: expected .*{words}"):
            fj.from_mjcf(source)
    for name, keywords in {
        "drop: expected kinds among": dict(drop=("wheels",)),
        "tip: expected a site or a body among": dict(tip="nose"),
        "drop: expected a tuple": dict(drop=None),
        r"controls: .*finite numbers of shape \(0,\)": dict(controls=[1]),
    }.items():
        with pytest.raises(ValueError, match=name):
            fj.from_mjcf(arm(), **keywords)


BIG = '<geom size="9"/>'
PLANE = '<worldbody><geom type="plane" size="9 9 9" contype="1"/></worldbody>'


INSIDE = [
    "",
    '<contact><exclude body1="a" body2="c"/></contact>',
    '<contact><pair geom1="of a" geom2="of b"/></contact>',
    '<option><flag contact="disable"/></option>',
    '<default><geom contype="2" conaffinity="2"/></default>',
    f"<worldbody>{BIG}</worldbody>",
    f'<default><geom contype="0"/></default>{PLANE}',
]


@pytest.mark.parametrize("inside", INSIDE)
@pytest.mark.parametrize("welded", ["", "b"])
@pytest.mark.filterwarnings("ignore:revolute joints . and . coincide")
def test_contacts_are_rejected_at_the_start_and_told_later(inside, welded):
    def chain(distance):
        bodies = ""
        for name in "cba":
            hinge = "" if name == welded else '<joint axis="0 1 0"/>'
            geom = f'<geom name="of {name}" size=".5"/>'
            place = f'pos="{distance} 0 {distance}"'
            bodies = f'<body name="{name}" {place}>{hinge}{bodies}{geom}</body>'
        return texts.mjcf(bodies, head=inside)

    # All geoms overlap, so that MuJoCo reports the contacts that it lets happen.
    model, data = in_mujoco(chain(0))
    mujoco.mj_forward(model, data)
    if data.ncon:
        with pytest.raises(ValueError, match="a contact; drop=.'contacts',"):
            fj.from_mjcf(chain(0))
    far, drop = (0, ("contacts",)) if BIG in inside else (9, ())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        account = str(fj.from_mjcf(chain(far), drop=drop).account)
    about = [w for w in caught if "contacts are left out" in str(w.message)]
    assert len(about) == (data.ncon > 0 and not drop)
    assert all(w.filename == __file__ for w in about)
    assert ("contact" in account) == (data.ncon > 0)
