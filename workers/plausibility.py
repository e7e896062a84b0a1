"""How far a motion is from what the figure could do by itself: root residual wrench and joint torques.

**Convention.** Poses at a fixed frame rate are differentiated by central differences over neighbouring frames, without
smoothing: the acceleration of a frame is what a viewer of three frames would compute. `mj_inverse` gives the force on
every degree of freedom that this acceleration takes under gravity, joint damping included, contacts and joint limits
left out. From it contact forces are taken: those, inside the simulation's friction pyramids, at points of the figure
less than REACH above the floor or below it, in the frame, the one before or the one after, that leave the least on the
root. What is left on the six degrees of freedom of the root is the **residual wrench**: the force and moment that an
invisible hand would have to apply. Zero is physically possible. Moments are about the centre of mass.

**Why not MuJoCo's own contact forces.** They are those of a stiff spring: feet 1 cm inside the floor, as captured ones
are, make several body weights, feet 1 mm above it none. That would measure the capture's floor level, and a simulated
motion would be judged by the very formula that made it. The best contact forces give every motion the benefit of the
doubt, simulated and blended ones alike. `model_residual` is the other one, for accelerations that a simulation made.

**Torques** are what the actuators, whose damping is the joints', have to give besides the contact forces; among contact
forces that leave as little on the root, those with the smallest torques are taken.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import nnls

from motion import rotations, skeleton
from workers.action import control
from workers.humanoid import build_model

# m; captured soles float up to this high in stance: at 2 cm, half of what a captured run does would seem impossible
REACH = 0.03
# Torques of 100 % of all limits weigh as much as a residual of 1 % of the body weight
_TORQUE_WEIGHT = 0.01
_MARGIN = 1e-3  # share of a torque limit by which rounding may exceed it


@dataclass(frozen=True)
class Plausibility:
    """Of n frames. force: (n,) N, moment: (n,) N m, sizes of the residual wrench. torques: (n, 31) N m, by actuator.

    weight: N, height: m, of the figure. limits: (31,) N m.
    """

    force: np.ndarray
    moment: np.ndarray
    torques: np.ndarray
    weight: float
    height: float
    limits: np.ndarray

    @property
    def relative_force(self):
        """(n,) residual force in body weights."""
        return self.force / self.weight

    @property
    def relative_moment(self):
        """(n,) residual moment in body weight times body height."""
        return self.moment / (self.weight * self.height)

    @property
    def torque_excess(self):
        """(n,) bool: whether a joint torque is above its actuator's limit."""
        return (np.abs(self.torques) > self.limits * (1 + _MARGIN)).any(axis=1)


def derivatives(qpos, fps):
    """qvel and qacc (T - 2, 37), in MuJoCo's layout, of poses (T, 47) but the first and last, by central differences.

    With v the constant velocity that leads from one frame to the next: qvel is the mean of those before and after a
    frame, qacc their difference times fps. The rotation from frame to frame is about an axis that is the same in both
    frames, so angular ones are in the moving frame, as MuJoCo's.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    rate = np.empty((len(qpos) - 1, skeleton.NV))
    rate[:, :3] = np.diff(qpos[:, :3], axis=0)
    rate[:, 3:6] = _turned(qpos[:, 3:7])
    for joint, start, dof in zip(skeleton.JOINTS, 7 + skeleton.JOINT_QPOS, 6 + skeleton.JOINT_DOF):
        if joint.dof == 3:
            rate[:, dof : dof + 3] = _turned(qpos[:, start : start + 4])
        else:
            rate[:, dof] = np.diff(qpos[:, start])
    rate *= fps
    return (rate[1:] + rate[:-1]) / 2, np.diff(rate, axis=0) * fps


def _turned(quaternion):
    return rotations.to_exponential_map(rotations.multiply(rotations.conjugate(quaternion[:-1]), quaternion[1:]))


class Judge:
    """Judges motions of the figure of a `workers.config.PhysicsConfig`."""

    def __init__(self, physics):
        self.model = build_model(physics)
        self.data = mujoco.MjData(self.model)
        self._floor = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
        # candidates for contact, found with a margin; the model is this judge's own
        self.model.geom_margin[self._floor] = REACH
        self.limits = self.model.actuator_forcerange[:, 1].copy()
        self.weight = float(self.model.body_subtreemass[0] * -self.model.opt.gravity[2])
        self.height = _height(self.model)
        friction = self.model.geom_friction[self._floor, 0]
        self._edges = np.array([(friction, 0, 1), (-friction, 0, 1), (0, friction, 1), (0, -friction, 1)])

    def judge(self, qpos, fps):
        """`Plausibility` of poses (T, 47) at `fps` but the first and the last; of no frame if T < 3."""
        qvel, qacc = derivatives(qpos, fps)
        contacts = [self._contacts(pose) for pose in qpos]
        forces, moments, torques = [], [], []
        for k in range(len(qvel)):
            need, transform = self._needed(qpos[k + 1], qvel[k], qacc[k])
            points = list(dict.fromkeys(point for near in contacts[k : k + 3] for point in near))
            left = self._without_contacts(need, transform, points)
            forces.append(np.linalg.norm(left[:3]))
            moments.append(np.linalg.norm(left[3:6]))
            torques.append(left[6:])
        torques = np.reshape(torques, (-1, len(self.limits)))
        return Plausibility(np.array(forces), np.array(moments), torques, self.weight, self.height, self.limits)

    def _contacts(self, pose):
        """[(body, point in its frame)] of what is near the floor in a pose."""
        model, data = self.model, self.data
        data.qpos[:] = pose
        model.opt.disableflags = 0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        out = []
        for pair, position in zip(data.contact.geom, data.contact.pos):
            if self._floor in pair:
                body = int(model.geom_bodyid[pair[0] if pair[1] == self._floor else pair[1]])
                local = data.xmat[body].reshape(3, 3).T @ (position - data.xpos[body])
                # to a tenth of a millimetre, so that a point that stays is the same in three frames
                out.append((body, tuple(np.round(local, 4))))
        return out

    def _needed(self, pose, velocity, acceleration):
        """Forces (37,) that an acceleration takes, and the matrix (37, 37) that puts the root's into world axes about
        the centre of mass."""
        model, data = self.model, self.data
        data.qpos[:], data.qvel[:], data.qacc[:] = pose, velocity, acceleration
        model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        mujoco.mj_inverse(model, data)
        transform = np.eye(model.nv)
        transform[3:6, 3:6] = data.xmat[1].reshape(3, 3)
        x, y, z = data.xpos[1] - data.subtree_com[0]
        transform[3:6, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        return transform @ data.qfrc_inverse, transform

    def _without_contacts(self, need, transform, points):
        """What of the forces `need` (37,) the best contact forces at `points` leave."""
        if not points:
            return need
        columns, jacobian = [], np.zeros((3, self.model.nv))
        for body, local in points:
            place = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ local
            mujoco.mj_jac(self.model, self.data, jacobian, None, place, body)
            columns.append(transform @ jacobian.T @ self._edges.T)
        columns = np.concatenate(columns, axis=1)
        scale = np.concatenate(
            [np.full(3, 1 / self.weight), np.full(3, 1 / (self.weight * self.height)), _TORQUE_WEIGHT / self.limits]
        )[:, None]
        # in body weights, for a well-scaled problem
        found, _ = nnls(columns * scale * self.weight, need * scale[:, 0], maxiter=100 * columns.shape[1])
        return need - columns @ found * self.weight


def _height(model):
    """Height (m) of the figure standing straight, from the soles to the top of the head."""
    head, foot = skeleton.BODY_INDEX["head"], skeleton.BODY_INDEX["right_foot"]
    position, _ = skeleton.forward_kinematics(skeleton.assemble_qpos(np.zeros(3), rotations.IDENTITY, np.zeros(31)))
    tops = [
        position[head, 2] + model.geom_pos[g, 2] + model.geom_size[g, 0]
        for g in np.flatnonzero(model.geom_bodyid == head + 1)
    ]
    bottoms = [
        position[foot, 2] + model.geom_pos[g, 2] - model.geom_size[g, 2]
        for g in np.flatnonzero(model.geom_bodyid == foot + 1)
    ]
    return float(max(tops) - min(bottoms))


def model_residual(physics, qpos, qvel, qacc):
    """(n, 6) N, N m: what `mj_inverse` with MuJoCo's own contact forces leaves on the root, for states (n, 47), (n, 37)
    and discrete accelerations (n, 37), the change of velocity in a physics step over its length.

    Zero, but for the solver's tolerance, for the states of a simulation.
    """
    model = build_model(physics)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    data, out = mujoco.MjData(model), []
    for position, velocity, acceleration in zip(qpos, qvel, qacc):
        data.qpos[:], data.qvel[:], data.qacc[:] = position, velocity, acceleration
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse[:6].copy())
    return np.array(out)


def physics_steps(physics, qpos, qvel, pd_target):
    """qpos (n + 1, 47), qvel (n + 1, 37) at every physics step of an episode that begins at qpos (47,), qvel (37,).

    pd_target: (T, 31) of its policy steps; n = T * substeps. A recording at the policy's rate becomes one at the
    physics' rate by simulating it again.
    """
    model = build_model(physics)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    states = [(data.qpos.copy(), data.qvel.copy())]
    for target in pd_target:
        control(np.asarray(target, dtype=np.float64), data.qpos, data.ctrl)
        for _ in range(physics.substeps):
            mujoco.mj_step(model, data)
            states.append((data.qpos.copy(), data.qvel.copy()))
    return tuple(np.array(column) for column in zip(*states))
