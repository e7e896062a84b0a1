"""The equations of the project's spec (sbc.md), written from the spec alone: slow, obvious, one pose at a time.

Nothing here imports the packages under test. A pose is `qpos` (47) and `qvel` (37) in MuJoCo's layouts: root
position, root quaternion wxyz, then per joint (the order of FIGURE) a quaternion or, for hinges, an angle; root linear
velocity in the world, root angular velocity in the root's frame, joint velocities in the child's frame. Rotations are
scipy's.
"""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

# section 7: body, parent, offset to the parent in m, joint, kind, zeta
FIGURE = [
    ("pelvis", None, (0, 0, 0), None, "free", None),
    ("torso", "pelvis", (0, 0, 0.236151), "abdomen", "ball", 0),
    ("head", "torso", (0, 0, 0.223894), "neck", "ball", 1),
    ("right_upper_arm", "torso", (-0.02405, -0.18311, 0.2435), "right_shoulder", "ball", 1),
    ("right_lower_arm", "right_upper_arm", (0, 0, -0.274788), "right_elbow", "hinge", 2),
    ("right_hand", "right_lower_arm", (0, 0, -0.258947), "right_hand", "ball", 3),
    ("sword", "right_hand", (0.74, 0, 0), None, "weld", None),
    ("left_upper_arm", "torso", (-0.02405, 0.18311, 0.2435), "left_shoulder", "ball", 1),
    ("left_lower_arm", "left_upper_arm", (0, 0, -0.274788), "left_elbow", "hinge", 2),
    ("shield", "left_lower_arm", (0, 0.07, -0.12), None, "weld", None),
    ("left_hand", "left_lower_arm", (0, 0, -0.258947), None, "weld", None),
    ("right_thigh", "pelvis", (0, -0.084887, 0), "right_hip", "ball", 0),
    ("right_shin", "right_thigh", (0, 0, -0.421546), "right_knee", "hinge", 1),
    ("right_foot", "right_shin", (0, 0, -0.40987), "right_ankle", "ball", 2),
    ("left_thigh", "pelvis", (0, 0.084887, 0), "left_hip", "ball", 0),
    ("left_shin", "left_thigh", (0, 0, -0.421546), "left_knee", "hinge", 1),
    ("left_foot", "left_shin", (0, 0, -0.40987), "left_ankle", "ball", 2),
]
JOINTS = [(joint, kind, zeta) for _, _, _, joint, kind, zeta in FIGURE if joint]
UPPER = ["abdomen", "neck", "right_shoulder", "right_elbow", "right_hand", "left_shoulder", "left_elbow"]
LOWER = ["right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"]
KEY_BODIES = ["right_hand", "left_hand", "right_foot", "left_foot", "sword", "shield"]

# section 7: kp N m/rad, kd N m s/rad
GAINS = {
    "abdomen": (1000, 100),
    "neck": (100, 10),
    "right_shoulder": (400, 40),
    "left_shoulder": (400, 40),
    "right_elbow": (300, 30),
    "left_elbow": (300, 30),
    "right_hand": (100, 10),
    "right_hip": (500, 50),
    "left_hip": (500, 50),
    "right_knee": (500, 50),
    "left_knee": (500, 50),
    "right_ankle": (400, 40),
    "left_ankle": (400, 40),
}


def quaternion(rotation):
    """wxyz of a scipy rotation."""
    return rotation.as_quat(scalar_first=True)


def rotation(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def about_z(angle):
    return Rotation.from_rotvec([0, 0, angle])


# ---------------------------------------------------------------------------------------------------------- one pose


def weight(zeta):
    """Eq. 7."""
    return 1.5 ** (3 - zeta)


def root_rotation(qpos):
    return rotation(qpos[3:7])


def joint_rotations(qpos):
    """Local rotation of each joint by name."""
    out, at = {}, 7
    for name, kind, _ in JOINTS:
        if kind == "ball":
            out[name] = rotation(qpos[at : at + 4])
            at += 4
        else:
            out[name] = Rotation.from_rotvec([0, qpos[at], 0])
            at += 1
    assert at == 47
    return out


def hinge_angles(qpos):
    """Angle of each hinge by name."""
    out, at = {}, 7
    for name, kind, _ in JOINTS:
        if kind == "hinge":
            out[name] = qpos[at]
        at += 4 if kind == "ball" else 1
    return out


def joint_velocities(qvel):
    """The 3 or 1 velocities of each joint by name."""
    out, at = {}, 6
    for name, kind, _ in JOINTS:
        size = 3 if kind == "ball" else 1
        out[name] = qvel[at : at + size]
        at += size
    assert at == 37
    return out


def transform(matrix, position):
    out = np.eye(4)
    out[:3, :3] = matrix
    out[:3, 3] = position
    return out


def forward_kinematics(qpos):
    """The 4 x 4 world transform of every body by name."""
    joints = joint_rotations(qpos)
    world = {}
    for body, parent, offset, joint, kind, _ in FIGURE:
        if kind == "free":
            world[body] = transform(root_rotation(qpos).as_matrix(), qpos[:3])
        else:
            local = joints[joint].as_matrix() if joint else np.eye(3)
            world[body] = world[parent] @ transform(local, offset)
    return world


def heading(qpos):
    """Yaw of the root: the direction of its x axis on the ground."""
    x, y, _ = root_rotation(qpos).apply([1.0, 0.0, 0.0])
    return np.arctan2(y, x)


def heading_frame(qpos):
    """4 x 4: origin at the root, z up, x along the heading."""
    return transform(about_z(heading(qpos)).as_matrix(), qpos[:3])


def key_body_positions(qpos, frame):
    """The 6 key bodies of a pose in a 4 x 4 frame, (6, 3)."""
    world = forward_kinematics(qpos)
    return np.array([(np.linalg.inv(frame) @ world[body][:, 3])[:3] for body in KEY_BODIES])


def normal_tangent(matrix):
    """6 numbers: the turned x axis, then the turned z axis."""
    return np.concatenate([matrix[:, 0], matrix[:, 2]])


# -------------------------------------------------------------------------------------------------- section 2: state


def localized(qpos, qvel, frame):
    """A pose in a heading frame: root position, 137 shared numbers (velocity, orientation, ..., key bodies)."""
    turn = frame[:3, :3].T
    root = root_rotation(qpos).as_matrix()
    position = (np.linalg.inv(frame) @ np.append(qpos[:3], 1.0))[:3]
    joints = joint_rotations(qpos)
    shared = [
        turn @ qvel[:3],
        normal_tangent(turn @ root),
        turn @ root @ qvel[3:6],
        *[normal_tangent(joints[name].as_matrix()) for name, _, _ in JOINTS],
        qvel[6:],
        key_body_positions(qpos, frame).ravel(),
    ]
    return position, np.concatenate(shared)


def observation(qpos, qvel, target_qpos, target_qvel, difference=False):
    """s_t = (p_t, p_tar), 140 + 142 numbers; or p_tar less p_t, but for the root's place."""
    frame = heading_frame(qpos)
    _, own = localized(qpos, qvel, frame)
    position, target = localized(target_qpos, target_qvel, frame)
    return np.concatenate([[qpos[2]], own, position, target - own if difference else target])


# ------------------------------------------------------------------------------------------------- section 3: reward


def joint_distance(qpos, target_qpos):
    """L1 norm of the exponential map of each joint's rotation difference, by name."""
    a, b = joint_rotations(qpos), joint_rotations(target_qpos)
    angles, target_angles = hinge_angles(qpos), hinge_angles(target_qpos)
    out = {}
    for name, kind, _ in JOINTS:
        if kind == "ball":
            out[name] = np.abs((b[name].inv() * a[name]).as_rotvec()).sum()
        else:
            out[name] = abs(angles[name] - target_angles[name])
    return out


def weighted_mean(per_joint, names):
    zetas = {name: zeta for name, _, zeta in JOINTS}
    return sum(weight(zetas[name]) * per_joint[name] for name in names) / len(names)


def d_rp(qpos, qvel, target_qpos, target_qvel):
    return np.linalg.norm(qpos[:3] - target_qpos[:3])


def d_rv(qpos, qvel, target_qpos, target_qvel):
    return np.linalg.norm(qvel[:3] - target_qvel[:3])


def d_rq(qpos, qvel, target_qpos, target_qvel):
    return (root_rotation(target_qpos).inv() * root_rotation(qpos)).magnitude()


def d_kp(qpos, qvel, target_qpos, target_qvel, key_body_frame="common"):
    """common: both poses in the heading frame of the first; own: each in its own."""
    frame = heading_frame(qpos)
    target_frame = frame if key_body_frame == "common" else heading_frame(target_qpos)
    a, b = key_body_positions(qpos, frame), key_body_positions(target_qpos, target_frame)
    return sum(np.linalg.norm(a[e] - b[e]) for e in range(6))


def d_q(distance):
    """distance: `joint_distance` of the pose and its target."""
    return weighted_mean(distance, [name for name, _, _ in JOINTS])


def d_lq(distance):
    return weighted_mean(distance, LOWER)


def d_qv(qpos, qvel, target_qpos, target_qvel):
    a, b = joint_velocities(qvel), joint_velocities(target_qvel)
    difference = {name: np.abs(a[name] - b[name]).sum() for name in a}
    return weighted_mean(difference, list(difference))


def deviations(qpos, qvel, target_qpos, target_qvel, key_body_frame="common"):
    """All of section 3's table; u is the L1 distance of every upper-body joint."""
    poses = (qpos, qvel, target_qpos, target_qvel)
    distance = joint_distance(qpos, target_qpos)
    return SimpleNamespace(
        rp=d_rp(*poses),
        rv=d_rv(*poses),
        rq=d_rq(*poses),
        kp=d_kp(*poses, key_body_frame),
        q=d_q(distance),
        lq=d_lq(distance),
        qv=d_qv(*poses),
        u={name: distance[name] for name in UPPER},
    )


def scaled(x, y):
    """S of Eq. 8."""
    return x - y if x >= y else 2 * (x - y)


def upper_body_improvement(before, after, penalty=True):
    """I^uq of Eq. 6; without the penalty, S is the plain difference."""
    gain = {name: scaled(before.u[name], after.u[name]) for name in UPPER}
    if not penalty:
        gain = {name: before.u[name] - after.u[name] for name in UPPER}
    return weighted_mean(gain, UPPER)


def improvement_reward(before, after, penalty=True):
    """r_imp of Eq. 1."""
    return (
        2.4 * (before.rp - after.rp)
        + 0.1 * (before.rv - after.rv)
        + 0.1 * (before.rq - after.rq)
        + 0.3 * (before.kp - after.kp)
        + 1.6 * upper_body_improvement(before, after, penalty)
    )


def end_reward(end, after):
    """r_end of Eq. 9; end: None, "failure" or "success"."""
    if end == "failure":
        return -3.0
    if end == "success":
        return 3.0 + np.exp(-4 * after.lq) + np.exp(-0.2 * after.qv)
    return 0.0


def direction_changes(velocities_before, velocities):
    """O_t of Eq. 12, of two (31,) joint velocities."""
    return sum(1 for a, b in zip(velocities_before, velocities, strict=True) if a * b < 0)


def tremble_reward(changes, accumulated, tremble=True):
    """r_trem of Eq. 12; accumulated: C_t, which includes O_t."""
    return -0.05 * changes if tremble and accumulated > 100 else 0.0


def reward(before, after, end, changes, accumulated, penalty=True, tremble=True):
    """r_t of Eq. 13."""
    return (
        improvement_reward(before, after, penalty)
        + end_reward(end, after)
        + tremble_reward(changes, accumulated, tremble)
    )


# ------------------------------------------------------------------------------------------ section 4: task planning


def placed_target(source_qpos, source_qvel, clip_qpos, clip_qvel, angle, reference="source", horizon=0.8):
    """The clip's start frame, turned and placed by Eq. 14: (qpos, qvel).

    reference "source": the target's heading is the source's plus the angle; "world": the clip's own plus the angle.
    """
    turn = about_z(angle)
    if reference == "source":
        turn = about_z(heading(source_qpos) + angle - heading(clip_qpos))
    qpos, qvel = np.array(clip_qpos, dtype=float), np.array(clip_qvel, dtype=float)
    offset = source_qpos[:3] + (source_qvel[:3] + 0.0) * horizon / 2
    qpos[0], qpos[1] = offset[0], offset[1]
    qpos[3:7] = quaternion(turn * root_rotation(clip_qpos))
    qvel[:3] = turn.apply(clip_qvel[:3])
    return qpos, qvel


def reached(after, thresholds):
    """thresholds: (rp, kp, q)."""
    return after.rp < thresholds[0] and after.kp < thresholds[1] and after.q < thresholds[2]


def touching_bodies(mujoco, model, qpos, floor, ignored):
    """Names of the bodies whose geoms MuJoCo finds in contact with the floor, other than the ignored ones."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    names = set()
    for contact in data.contact[: data.ncon]:
        pair = [int(contact.geom1), int(contact.geom2)]
        if floor in pair and contact.dist < 0:
            pair.remove(floor)
            names.add(model.body(int(model.geom_bodyid[pair[0]])).name)
    return names - set(ignored)


START = (0.3, 3.0, 1.0)
FLOOR = (0.01, 0.09, 0.15)


class Curriculum:
    """Eq. 16 with a list of (reached, ended), an entry per iteration or per episode.

    After a tightening the list is empty, and only episodes that the new thresholds judged enter it.
    """

    def __init__(self, window=100, unit="iterations", rate=0.88, factor=0.9):
        self.window, self.unit, self.rate, self.factor = window, unit, rate, factor
        self.thresholds, self.results, self.tightenings = START, [], 0

    def iteration(self, hits, judged_by):
        """hits: whether each episode of an iteration reached; judged_by: how often its thresholds had been cut."""
        if self.unit == "episodes":
            for hit in hits:
                if judged_by == self.tightenings:
                    self.add(int(hit), 1)
        elif len(hits) == 0 or judged_by == self.tightenings:
            self.add(sum(map(int, hits)), len(hits))

    def add(self, reached, ended):
        self.results.append((reached, ended))
        self.results = self.results[-self.window :]
        if len(self.results) < self.window or sum(n for _, n in self.results) == 0:
            return
        if sum(r for r, _ in self.results) / sum(n for _, n in self.results) > self.rate:
            new = tuple(max(self.factor * thr, floor) for thr, floor in zip(self.thresholds, FLOOR, strict=True))
            self.tightenings += new != self.thresholds
            self.thresholds, self.results = new, []


# ----------------------------------------------------------------------------------------------- section 5: learning


def gap_weight(kind, gap, poses):
    """g of Eq. 17 for a trajectory of `poses` poses (Algorithm 1's T)."""
    return {"balanced": (poses - 1) / (poses - gap), "inverse": (poses - 1) / gap, "uniform": 1.0}[kind]


def sbc_store(root_positions, next_root_positions, ended):
    """Algorithm 1's exhaustive store for one environment's T steps: a list of (t, k), k up to T.

    root_positions (T, 3) before each step, next_root_positions (T, 3) after it, before any reset; ended (T,): the
    episode ended with this step, so the next step starts elsewhere. Pose k > t is the one after step k - 1.
    """
    steps = len(root_positions)
    store = []
    for t in range(steps):
        for k in range(t + 1, steps + 1):
            if any(ended[t : k - 1]):
                continue
            target = next_root_positions[k - 1]
            before = np.linalg.norm(root_positions[t] - target)
            after = np.linalg.norm(next_root_positions[t] - target)
            if before - after > 0:
                store.append((t, k))
    return store


def gae(rewards, values, next_values, terminal, cut, gamma, lam):
    """Advantages of one environment as explicit sums of discounted residuals.

    terminal (T,): nothing follows, the next value counts as zero; cut (T,): the next step is another episode.
    """
    steps = len(rewards)
    residual = [rewards[t] + (0 if terminal[t] else gamma * next_values[t]) - values[t] for t in range(steps)]
    advantages = []
    for t in range(steps):
        total = 0.0
        for k in range(t, steps):
            total += (gamma * lam) ** (k - t) * residual[k]
            if cut[k]:
                break
        advantages.append(total)
    return np.array(advantages)
