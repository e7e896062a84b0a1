"""The 31-DOF sword & shield figure: bodies, joints, and forward kinematics of batches of poses.

One pose is `qpos` (47): root position (3, m), root quaternion (4, wxyz), then every joint in `JOINTS` order: a
quaternion (4) for a spherical joint, an angle (1, rad) for a hinge. Its velocity is `qvel` (37): root linear velocity
in the world (3, m/s), root angular velocity in the root's own frame (3, rad/s), then per joint the angular velocity in
the child's frame (3) or the hinge rate (1). Both are MuJoCo's layouts (sbc.md section 7).
"""

from dataclasses import dataclass

import numpy as np

from motion import rotations


@dataclass(frozen=True)
class Body:
    """A rigid body: `offset` (3, m) is its origin in its parent's frame."""

    name: str
    parent: int
    offset: tuple


@dataclass(frozen=True)
class Joint:
    """A joint that moves `body`; `dof` is 3 (spherical) or 1 (hinge about y). `chain` is zeta of Eq. 7."""

    name: str
    body: int
    dof: int
    chain: int
    upper: bool


_BODIES = [  # name, parent, offset, joint (or ""), dof, zeta, upper body
    ("pelvis", "", (0, 0, 0), "", 0, 0, False),
    ("torso", "pelvis", (0, 0, 0.236151), "abdomen", 3, 0, True),
    ("head", "torso", (0, 0, 0.223894), "neck", 3, 1, True),
    ("right_upper_arm", "torso", (-0.02405, -0.18311, 0.2435), "right_shoulder", 3, 1, True),
    ("right_lower_arm", "right_upper_arm", (0, 0, -0.274788), "right_elbow", 1, 2, True),
    ("right_hand", "right_lower_arm", (0, 0, -0.258947), "right_hand", 3, 3, True),
    ("sword", "right_hand", (0.74, 0, 0), "", 0, 0, False),
    ("left_upper_arm", "torso", (-0.02405, 0.18311, 0.2435), "left_shoulder", 3, 1, True),
    ("left_lower_arm", "left_upper_arm", (0, 0, -0.274788), "left_elbow", 1, 2, True),
    ("shield", "left_lower_arm", (0, 0.07, -0.12), "", 0, 0, False),
    ("left_hand", "left_lower_arm", (0, 0, -0.258947), "", 0, 0, False),
    ("right_thigh", "pelvis", (0, -0.084887, 0), "right_hip", 3, 0, False),
    ("right_shin", "right_thigh", (0, 0, -0.421546), "right_knee", 1, 1, False),
    ("right_foot", "right_shin", (0, 0, -0.40987), "right_ankle", 3, 2, False),
    ("left_thigh", "pelvis", (0, 0.084887, 0), "left_hip", 3, 0, False),
    ("left_shin", "left_thigh", (0, 0, -0.421546), "left_knee", 1, 1, False),
    ("left_foot", "left_shin", (0, 0, -0.40987), "left_ankle", 3, 2, False),
]

BODY_NAMES = tuple(row[0] for row in _BODIES)
BODY_INDEX = {name: i for i, name in enumerate(BODY_NAMES)}
BODIES = tuple(
    Body(name, BODY_INDEX[parent] if parent else -1, tuple(map(float, offset)))
    for name, parent, offset, *_ in _BODIES
)
JOINTS = tuple(
    Joint(joint, BODY_INDEX[name], dof, chain, upper) for name, _, _, joint, dof, chain, upper in _BODIES if joint
)
JOINT_NAMES = tuple(joint.name for joint in JOINTS)
JOINT_INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}

NUM_BODIES = len(BODIES)  # 17
NUM_JOINTS = len(JOINTS)  # 13
NUM_DOF = sum(joint.dof for joint in JOINTS)  # 31
NQ = 7 + sum(4 if joint.dof == 3 else 1 for joint in JOINTS)  # 47
NV = 6 + NUM_DOF  # 37

# first entry of each joint in qpos[7:], and in the 31 degrees of freedom
JOINT_QPOS = np.cumsum([0] + [4 if joint.dof == 3 else 1 for joint in JOINTS])[:-1]
JOINT_DOF = np.cumsum([0] + [joint.dof for joint in JOINTS])[:-1]

# Section 2: the end effectors whose positions the state holds
KEY_BODY_NAMES = ("right_hand", "left_hand", "right_foot", "left_foot", "sword", "shield")
KEY_BODIES = np.array([BODY_INDEX[name] for name in KEY_BODY_NAMES])
FOOT_BODIES = np.array([BODY_INDEX["right_foot"], BODY_INDEX["left_foot"]])

# Eq. 7: w_j = 1.5^(3 - zeta_j)
JOINT_WEIGHTS = np.array([1.5 ** (3 - joint.chain) for joint in JOINTS])
UPPER_JOINTS = np.array([i for i, joint in enumerate(JOINTS) if joint.upper])
LOWER_JOINTS = np.array([i for i, joint in enumerate(JOINTS) if not joint.upper])

PARENTS = np.array([body.parent for body in BODIES])
OFFSETS = np.array([body.offset for body in BODIES])

_TABLES = (
    JOINT_QPOS, JOINT_DOF, KEY_BODIES, FOOT_BODIES, JOINT_WEIGHTS, UPPER_JOINTS, LOWER_JOINTS, PARENTS, OFFSETS,
)  # fmt: skip
for _table in _TABLES:
    _table.flags.writeable = False


def joint_quaternions(qpos):
    """Local rotation of every joint as a quaternion, (..., 47) -> (..., 13, 4)."""
    qpos = np.asarray(qpos, dtype=np.float64)
    out = np.empty(qpos.shape[:-1] + (NUM_JOINTS, 4))
    for i, joint in enumerate(JOINTS):
        a = 7 + JOINT_QPOS[i]
        out[..., i, :] = qpos[..., a : a + 4] if joint.dof == 3 else rotations.about_y(qpos[..., a])
    return out


def joint_coordinates(qpos):
    """The 31 joint coordinates: exponential maps of spherical joints, angles of hinges, (..., 47) -> (..., 31)."""
    qpos = np.asarray(qpos, dtype=np.float64)
    out = np.empty(qpos.shape[:-1] + (NUM_DOF,))
    for i, joint in enumerate(JOINTS):
        a, d = 7 + JOINT_QPOS[i], JOINT_DOF[i]
        if joint.dof == 3:
            out[..., d : d + 3] = rotations.to_exponential_map(qpos[..., a : a + 4])
        else:
            out[..., d] = qpos[..., a]
    return out


def assemble_qpos(root_position, root_quaternion, joints):
    """qpos (..., 47) of root position (..., 3), root quaternion (..., 4) and joint coordinates (..., 31)."""
    joints = np.asarray(joints, dtype=np.float64)
    out = np.empty(joints.shape[:-1] + (NQ,))
    out[..., :3] = root_position
    out[..., 3:7] = root_quaternion
    for i, joint in enumerate(JOINTS):
        a, d = 7 + JOINT_QPOS[i], JOINT_DOF[i]
        if joint.dof == 3:
            out[..., a : a + 4] = rotations.from_exponential_map(joints[..., d : d + 3])
        else:
            out[..., a] = joints[..., d]
    return out


def forward_kinematics(qpos):
    """World positions (..., 17, 3) and quaternions (..., 17, 4) of every body of poses (..., 47)."""
    qpos = np.asarray(qpos, dtype=np.float64)
    local = {joint.body: quaternion for joint, quaternion in zip(JOINTS, np.moveaxis(joint_quaternions(qpos), -2, 0))}
    position = np.empty(qpos.shape[:-1] + (NUM_BODIES, 3))
    rotation = np.empty(qpos.shape[:-1] + (NUM_BODIES, 4))
    position[..., 0, :], rotation[..., 0, :] = qpos[..., :3], qpos[..., 3:7]
    for i in range(1, NUM_BODIES):
        parent = PARENTS[i]
        position[..., i, :] = position[..., parent, :] + rotations.rotate(rotation[..., parent, :], OFFSETS[i])
        own = local.get(i, rotations.IDENTITY)
        rotation[..., i, :] = rotations.multiply(rotation[..., parent, :], own)
    return position, rotation


def velocities(qpos, fps):
    """qvel (T, 37) of a sequence of poses (T, 47) by central differences (one-sided at the ends).

    The rate of an exponential map is that of the relative rotation between frames, log(q_a^-1 q_b) / dt, in the
    moving frame: MuJoCo's convention for free and ball joints.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    frames = len(qpos)
    if frames < 2:
        return np.zeros((frames, NV))
    before = np.maximum(np.arange(frames) - 1, 0)
    after = np.minimum(np.arange(frames) + 1, frames - 1)
    dt = ((after - before) / fps)[:, None]
    out = np.empty((frames, NV))
    out[:, :3] = (qpos[after, :3] - qpos[before, :3]) / dt
    out[:, 3:6] = _rate(qpos[:, 3:7], before, after) / dt
    for i, joint in enumerate(JOINTS):
        a, d = 7 + JOINT_QPOS[i], 6 + JOINT_DOF[i]
        if joint.dof == 3:
            out[:, d : d + 3] = _rate(qpos[:, a : a + 4], before, after) / dt
        else:
            out[:, d] = (qpos[after, a] - qpos[before, a]) / dt[:, 0]
    return out


def _rate(quaternion, before, after):
    return rotations.to_exponential_map(
        rotations.multiply(rotations.conjugate(quaternion[before]), quaternion[after])
    )
