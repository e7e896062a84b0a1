"""Whether a figure could stand where a transition ends: clips whose root was captured or exported too high float."""

import numpy as np

from workers.kinematics import NQ, NUM_BODIES, NV, forward_kinematics
from workers.library import build_library, sample_pose
from workers.termination import lowest

FLOATS = 0.08  # m between the floor and the lowest point; clips with both feet down have up to 0.04 of it


def floating_targets(state_machine):
    """[(name, height in m)] of the states of a `motion.state_machine.StateMachine` that a transition may end in and
    that have nothing within `FLOATS` of the floor at their start point."""
    library, found = build_library(state_machine), []
    qpos, qvel = np.empty(NQ), np.empty(NV)
    position, rotation = np.empty((NUM_BODIES, 3)), np.empty((NUM_BODIES, 4))
    for i in np.unique(library.groups[:, 1]):
        clip = library.first[i], library.frames[i], library.fps[i]
        sample_pose(library.qpos, library.qvel, *clip, library.start[i], qpos, qvel)
        forward_kinematics(qpos, position, rotation)
        height, _ = lowest(position, rotation, np.ones(NUM_BODIES, dtype=np.bool_))
        if height > FLOATS:
            found.append((state_machine.states[i].name, float(height)))
    return found
