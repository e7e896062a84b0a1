"""What a policy step does to the figure, learned: a network whose derivatives by pose and action are those of physics.

On a flat floor the next pose, seen from this one's heading frame, is a function of p_t and of the joints' PD targets.
The network gives the change of p_t and of the frame; p_tar, which stands still in the world, follows by geometry.
"""

import numpy as np
import torch
from torch import nn

from learner.encoding import join, split
from learner.networks import build_mlp
from learner.normalizer import Normalizer
from learner.rotations import about_z, matrices, rotation
from motion import rotations, skeleton
from motion.errors import InputError
from workers.observation import JOINT_AXES, POSE_SIZE

_JOINTS = skeleton.NUM_JOINTS
_INPUTS = POSE_SIZE + 6 * _JOINTS
_OUTPUTS = 4 + POSE_SIZE - 1  # displacement 3, turn 1, change of all of p_t but the height
_RATE = 3e-4


class Dynamics:
    """The network, its optimizer and its scales."""

    def __init__(self, hidden, encoding, generator, device):
        """hidden: units of the hidden layers. encoding: `EnvConfig`, what observations and actions mean. generator: of
        torch, for the first weights."""
        # smooth: its derivatives are what counts
        network = build_mlp([_INPUTS, *hidden, _OUTPUTS], generator, 1.0, hidden_gain=1.0, activation=nn.SiLU)
        self.network = network.to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=_RATE, fused=True)
        self._inputs, self._outputs = Normalizer(_INPUTS, True, device), Normalizer(_OUTPUTS, True, device)
        self._action = encoding.action
        self._difference = encoding.observation.target == "difference"

    def state_dict(self):
        """Plain tensors and numbers for a checkpoint."""
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state):
        """The inverse of `state_dict`; InputError if another version, which gave its network other numbers, made it."""
        given = len(state["inputs"]["mean"])
        if given != _INPUTS:
            raise InputError(
                f"arrival.weight: the checkpoint's learned physics sees {given} numbers, this version's {_INPUTS}; "
                "go on with the version that made it, or from start.checkpoint with arrival.weight=0"
            )
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self):
        return {
            "network": self.network, "optimizer": self._optimizer, "inputs": self._inputs, "outputs": self._outputs,
        }  # fmt: skip

    def learn(self, observation, action, following, move, batches):
        """One pass over S steps; their mean squared error, in standard deviations.

        observation, following: (S, 282), s_t and the s_t+1 that followed. action: (S, 31). move: (S, 4), see `moved`.
        batches: the steps' numbers, minibatch by minibatch.
        """
        pose, _ = self.split(observation)
        after, _ = self.split(following)
        with torch.no_grad():
            inputs = self._given(observation, action)
            outputs = torch.cat([move, after[:, 1:] - pose[:, 1:]], dim=1)
            self._inputs.update(inputs)
            self._outputs.update(outputs)
            inputs, outputs = self._inputs(inputs), self._outputs(outputs)
        errors = []
        for rows in batches:
            loss = ((self.network(inputs[rows]) - outputs[rows]) ** 2).mean()
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self._optimizer.step()
            errors.append(loss.detach())
        return torch.stack(errors).mean()

    def step(self, observation, action):
        """The s_t+1 (B, 282) that actions (B, 31) lead to from s_t (B, 282), differentiable by both."""
        pose, target = self.split(observation)
        mean, scale = (x.to(pose.dtype) for x in self._outputs.mean_and_scale())
        change = self.network(self._inputs(self._given(observation, action))) / scale + mean
        displacement, turn = change[:, :3], change[:, 3]
        after = torch.cat([pose[:, :1] + displacement[:, 2:], pose[:, 1:] + change[:, 4:]], dim=1)
        return self.join(after, seen_from(target, displacement, turn))

    def split(self, observation):
        """`learner.encoding.split` of s_t (B, 282), as the run encodes it."""
        return split(observation, self._difference)

    def join(self, pose, target):
        """The inverse of `split`."""
        return join(pose, target, self._difference)

    def _given(self, observation, action):
        pose, _ = self.split(observation)
        return torch.cat([pose, self._aim(observation, action)], dim=1)

    def _aim(self, observation, action):
        """(B, 78): how far the joints' rotations are from their PD targets', as `action.mode` means them."""
        pose, target = self.split(observation)
        joints = pose[:, JOINT_AXES]
        aimed = rotation(self._action.scale * by_joint(action))
        if self._action.mode != "absolute":
            base = joints if self._action.mode == "current" else target[:, 2:][:, JOINT_AXES]
            aimed = matrices(base.reshape(-1, _JOINTS, 6)) @ aimed
        return torch.cat([aimed[..., 0], aimed[..., 2]], dim=-1).reshape(len(action), -1) - joints


def by_joint(numbers):
    """Exponential maps (B, 13, 3) of joint coordinates (B, 31); a hinge turns about y."""
    padded = torch.cat([numbers, numbers.new_zeros(len(numbers), 1)], dim=1)
    at = [
        [start, start + 1, start + 2] if joint.dof == 3 else [-1, start, -1]
        for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_DOF)
    ]
    return padded[:, torch.tensor(at, device=numbers.device)]


def moved(place, after):
    """(..., 4): displacement in the heading frame of `place` and change of heading, of the root's qpos (..., >= 7)."""
    place, after = (np.asarray(one, dtype=np.float64) for one in (place, after))
    before = rotations.heading(place[..., 3:7])
    shift = rotations.rotate(rotations.about_z(-before), after[..., :3] - place[..., :3])
    turn = np.remainder(rotations.heading(after[..., 3:7]) - before + np.pi, 2 * np.pi) - np.pi
    return np.concatenate([shift, turn[..., None]], axis=-1)


def seen_from(target, displacement, turn):
    """p_tar (B, 142) seen from a frame that is displaced (B, 3) and turned (B,) from the one that it is seen from."""
    places = torch.cat([target[:, :3], target[:, 124:]], dim=1).reshape(len(target), -1, 3) - displacement[:, None]
    places = about_z(places, -turn)
    directions = about_z(target[:, 3:15].reshape(len(target), -1, 3), -turn).reshape(len(target), -1)
    return torch.cat([places[:, 0], directions, target[:, 15:124], places[:, 1:].reshape(len(target), -1)], dim=1)
