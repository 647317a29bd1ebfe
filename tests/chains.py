"""Chains of any number of joints, and the same in MuJoCo, written without the library.

The MJCF here shares no line with `fdof_jax.to_mjcf`.
"""

import mujoco
import numpy as np
from helpers import Hold as Hold, random_linkage as random_chain

__all__ = ["Hold", "in_mujoco", "moving", "random_chain", "random_topology"]


def random_topology(pairs, rng):
    """Returns letters R, P and F that the library accepts."""
    while True:
        name = "".join(rng.choice(list("RPF"), pairs, p=[0.5, 0.3, 0.2]))
        moving = name.replace("F", "")
        if moving and ("R" in moving or len(moving) < 3):
            return name


def moving(topology):
    """Returns whether the joint of each pair is real."""
    return np.array([joint != "F" for joint in topology])


def in_mujoco(topology, chain):
    """Returns MuJoCo's model and data; its joints are the real ones, in order.

    Each body's frame is turned as its link is at q = 0; a slide moves along the y axis
    of the body before it.
    """
    value = {name: np.asarray(leaf) for name, leaf in vars(chain).items()}
    inner = "<site name='tip' pos='{} 0 0'/>".format(value["length"][-1])
    for k in reversed(range(len(topology))):
        kind, locked = topology[k], value["locked"][k]
        x, y = value["length"][k], locked if kind == "R" else 0.0
        turn = 0.0 if kind == "R" else locked
        axis = "0 0 1" if kind == "R" else f"{np.sin(turn)} {np.cos(turn)} 0"
        joint = f"<joint type='{'hinge' if kind == 'R' else 'slide'}' axis='{axis}'/>"
        inertia = " ".join([str(value["inertia"][k])] * 3)
        inner = f"""
          <body pos='{x} {y} 0' euler='0 0 {turn}'>
            {"" if kind == "F" else joint}
            <inertial pos='{value["com"][k, 0]} {value["com"][k, 1]} 0'
                      mass='{value["mass"][k]}' diaginertia='{inertia}'/>
            {inner}
          </body>"""
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco>
        <compiler angle='radian'/>
        <option gravity='0 {-value["gravity"]} 0'>
          <flag contact='disable' energy='enable'/>
        </option>
        <worldbody>
          <body euler='0 0 {value["base_angle"]}'>{inner}</body>
        </worldbody>
      </mujoco>""")
    return model, mujoco.MjData(model)
