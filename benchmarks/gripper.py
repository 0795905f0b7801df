"""A gripper in MuJoCo that lifts an object, and what its pads feel.

Two fingers press three pads each against a box or cylinder that moves freely. Every pad stands on
springs, across and along the lift, and its friction falls with its slip speed (Stribeck). Contacts
of MuJoCo creep by millimetres a second where they should stick, unless friction is stiffer than the
normal direction, which only a ``pair`` of geoms can say (``solreffriction``): here they creep by
less than .02 mm/s at rest. Sliding pads chatter at hundreds of hertz with stiff contacts, and sink
into the object with soft ones; springs that are damped more than critically across the lift cure
both.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP_S = 0.0005
_ROWS = 3  # of pads on a finger
_PADS = [f"{side}{row}" for side in ("left", "right") for row in range(_ROWS)]
_PAD_KG = 0.002
_DEAD_BAND_MM_S = 0.2  # of slip speed, more than the solver creeps by
_CAMERA = 'pos="0.17 -0.33 0.2" xyaxes="0.89 0.46 0 -0.13 0.26 0.96"'


def _model_xml(shape: str, mass_kg: float) -> str:
    """The gripper and its object on a table, in MuJoCo's language."""
    springs = "".join(
        f'<joint type="slide" axis="{axis}" stiffness="{n_m:g}" '
        f'damping="{2 * ratio * np.sqrt(n_m * _PAD_KG):.4f}"/>'
        for axis, n_m, ratio in (("1 0 0", 4000.0, 2.0), ("0 0 1", 1500.0, 1.5))
    )

    def finger(name: str, side: int) -> str:
        pads = "".join(
            f'<body name="{name}{row}" pos="0 0 {0.012 * (row - 1):.3f}">{springs}'
            f'<geom name="{name}{row}" type="sphere" size=".006" mass="{_PAD_KG}" contype="0" '
            'conaffinity="0" rgba=".2 .4 .8 1"/></body>'
            for row in range(_ROWS)
        )
        return (
            f'<body pos="{0.03 * side} 0 .1"><joint name="{name}" type="slide" axis="{-side} 0 0" '
            f'damping="20"/><geom type="box" size=".003 .01 .022" pos="{0.006 * side} 0 0" '
            f'mass=".1" contype="0" conaffinity="0" rgba=".5 .5 .5 1"/>{pads}</body>'
        )

    pairs = "".join(
        f'<pair geom1="{pad}" geom2="object" condim="3" friction="1 1" solref=".01 1" '
        'solimp=".9 .95 .001" solreffriction=".002 1"/>'
        for pad in _PADS
    )
    size = ".02 .02 .06" if shape == "box" else ".02 .06"
    return f"""<mujoco><option timestep="{STEP_S}" cone="elliptic" impratio="1000" solver="Newton"
        noslip_iterations="5" iterations="30" tolerance="1e-10" integrator="implicitfast"/>
      <visual><headlight ambient=".5 .5 .5"/></visual>
      <asset><texture type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="8"/></asset>
      <worldbody><light pos="0 -.3 .6" dir="0 .4 -1"/><camera name="side" {_CAMERA}/>
        <geom type="plane" size=".3 .3 .01" pos="0 0 .04" friction=".1 .005 .0001"/>
        <body><joint name="lift" type="slide" axis="0 0 1" damping="1"/>
          <geom type="box" size=".05 .01 .005" pos="0 0 .18" mass=".5" contype="0"
            conaffinity="0" rgba=".3 .3 .3 1"/>{finger("left", -1)}{finger("right", 1)}</body>
        <body name="object" pos="0 0 .1"><freejoint/>
          <geom name="object" type="{shape}" size="{size}" mass="{mass_kg}"
            friction=".1 .001 .0001" rgba=".9 .6 .2 1"/></body></worldbody>
      <contact>{pairs}</contact>
      <actuator><motor joint="left"/><motor joint="right"/>
        <position joint="lift" kp="20000" kv="400"/></actuator></mujoco>"""


class Pads(NamedTuple):
    """What the pads feel in a step, ``[6]`` each: three of the left finger, three of the right.

    Attributes:
        normal_n: that presses.
        friction_n: along the surface.
        slip_mm_s: of the object over the pad, 0 within the dead band.
        inertia_n: of the pad.
    """

    normal_n: Array
    friction_n: Array
    slip_mm_s: Array
    inertia_n: Array


class Gripper:
    """The gripper with an object between its open fingers.

    Args:
        shape: of the object, ``"box"`` or ``"cylinder"``.
        mass_kg: of the object.
        mu_s: static friction of each pad, ``[6]``.
        mu_ratio: kinetic over static friction.
        stribeck_mm_s: speed over which the one becomes the other.

    Attributes:
        model: of MuJoCo.
        data: of MuJoCo.
    """

    def __init__(
        self, shape: str, mass_kg: float, mu_s: Array, mu_ratio: float, stribeck_mm_s: float
    ) -> None:
        import mujoco  # of an extra

        self._step = mujoco.mj_step
        self.model: Any = mujoco.MjModel.from_xml_string(_model_xml(shape, mass_kg))
        self.data: Any = mujoco.MjData(self.model)
        self._mu_s, self._mu_ratio, self._stribeck_mm_s = mu_s, mu_ratio, stribeck_mm_s
        self._bodies = np.array([self.model.body(name).id for name in _PADS])
        self._object = self.model.body("object").id
        self._pad_of_geom = np.full(self.model.ngeom, -1)
        self._pad_of_geom[[self.model.geom(name).id for name in _PADS]] = range(len(_PADS))
        self._pad_speeds = self.model.body_dofadr[self._bodies] + 1  # along the lift
        self._lift = int(self.model.jnt_dofadr[self.model.joint("lift").id])
        self._slip_mm_s = np.zeros(2 * _ROWS)

    def step(self, grip_n: float, lift_m: float, pull_n: float, tap_n: float = 0.0) -> Pads:
        """One step of ``STEP_S``.

        Args:
            grip_n: of each finger.
            lift_m: height of the gripper above where it began.
            pull_n: that draws the object down beside its weight.
            tap_n: that pushes it aside, along its faces that are free.
        """
        model, data = self.model, self.data
        data.ctrl[:] = grip_n, grip_n, lift_m
        data.xfrc_applied[self._object, 1:3] = tap_n, -pull_n
        fall = np.exp(-((self._slip_mm_s / self._stribeck_mm_s) ** 2))
        ratio = self._mu_ratio + (1.0 - self._mu_ratio) * fall
        model.pair_friction[:, :2] = (self._mu_s * ratio)[:, None]
        self._step(model, data)
        normal_n, friction_n = np.zeros(2 * _ROWS), np.zeros(2 * _ROWS)
        pads, at = self._pad_of_geom[data.contact.geom].max(axis=1), data.contact.efc_address
        is_pad = (pads >= 0) & (at >= 0)
        pads, at = pads[is_pad], at[is_pad]  # a contact's force: along its normal and two tangents
        normal_n[pads] = data.efc_force[at]
        friction_n[pads] = np.hypot(data.efc_force[at + 1], data.efc_force[at + 2])
        speed = data.qvel
        x, y, z = (data.xpos[self._bodies] - data.xpos[self._object]).T
        spin = data.xmat[self._object].reshape(3, 3) @ speed[-3:]
        across = speed[-5] + spin[2] * x - spin[0] * z
        pad_speed = speed[self._lift] + speed[self._pad_speeds]
        slip_mm_s = 1e3 * np.hypot(across, speed[-4] + spin[0] * y - spin[1] * x - pad_speed)
        self._slip_mm_s = np.where(normal_n > 0, slip_mm_s, 0.0)
        felt = np.where(self._slip_mm_s < _DEAD_BAND_MM_S, 0.0, self._slip_mm_s)
        inertia_n = _PAD_KG * data.qacc[self._pad_speeds]
        return Pads(normal_n, friction_n, felt, np.where(normal_n > 0, inertia_n, 0.0))
