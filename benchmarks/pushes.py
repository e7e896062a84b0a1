"""How far a push of one step moves the figure, and whether a tenth of it moves it a tenth as far.

    python -m benchmarks.pushes RUN [--tasks 512] [--steps 10] [--seed 0] [--json] [key=value ...]

The newest checkpoint's policy plays tasks of a run's grid with the evaluation's noise; then the same again with one
more draw of that noise added to the actions of one step, whole, a tenth and a hundredth of it. Printed is how far the
root is then from where it was without, in mm, divided by the size of the push: median and root mean square over the
tasks, after 1, 2, ... steps. Where physics is smooth the rows agree. Where contacts decide, small pushes move the
figure farther for their size: nobody can learn to foresee that, nor correct it before it is seen. `physics.sole=0` or
`physics.sole=0.02` as key=value plays the same policy on other feet.
"""

import json
import math
from dataclasses import replace

import numpy as np

from benchmarks.limits import NEVER, command_line, opened
from orchestrator.tasks import TaskGrid
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF
from workers.library import build_library
from workers.types import FELL

SIZES = (1.0, 0.1, 0.01)  # of a push, in units of the evaluation's noise
BEFORE = 4  # steps that come before it


def main():
    """Measure and print."""
    parser, options = command_line(
        __doc__, tasks=(512, 1, None), steps=(10, 1, "policy steps from the push on")
    )  # fmt: skip
    config, policy, machine = opened(parser, options)
    found = measure(config, policy, build_library(machine), options.tasks, options.steps, options.seed)
    print(f"{found['tasks']} tasks that stand throughout; mm per size of the push, after 1, 2, ... steps")
    for size, row in zip(SIZES, found["rows"]):
        for name in ("median", "rms"):
            print(f"push of {size:<4g} {name:>6}: " + " ".join(f"{value:7.2f}" for value in row[name]))
    if options.json:
        print(json.dumps(found))


def measure(config, policy, library, tasks, steps, seed):
    """{tasks: how many stand throughout; rows: of every size {median, rms: (steps,) mm per size}}.

    policy: `workers.types.Policy`, whose mean acts. tasks: how many of the grid, at most. steps: from the push on.
    """
    grid = TaskGrid(library, replace(config.evaluation, max_tasks=tasks))
    drawn = grid.tasks(grid.numbers(0, len(grid)))
    env, network = Environment(config, library, len(drawn)), PolicyNetwork(policy, len(drawn))
    rng, size = np.random.default_rng(seed), (len(drawn), NUM_DOF)
    deviation = math.exp(config.evaluation.log_sigma) / config.action.scale
    noise = rng.normal(0.0, deviation, (BEFORE + steps, *size))
    push = rng.normal(0.0, deviation, size)

    def play(share):
        """(places (steps, N, 3) from the push on, standing (N,)) with a share of the push."""
        env.task[:] = drawn
        env.begin(np.arange(len(drawn)))
        places, standing = [], np.ones(len(drawn), dtype=bool)
        for t, drawn_noise in enumerate(noise):
            mean = network.mean(env.observe(new_observations(len(drawn))))
            env.step((mean + drawn_noise + (share * push if t == BEFORE else 0.0)).astype(np.float32), NEVER)
            standing &= env.end != FELL
            places.append(env.qpos[:, :3].copy())
        return np.array(places[BEFORE:]), standing

    first, standing = play(0.0)
    played = [play(share) for share in SIZES]
    for _, still in played:
        standing = standing & still
    rows = []
    for share, (places, _) in zip(SIZES, played):
        moved = np.linalg.norm(places - first, axis=2)[:, standing] * 1000 / share
        rows.append(
            {"median": np.median(moved, axis=1).tolist(), "rms": np.sqrt((moved**2).mean(axis=1)).tolist()}
        )  # fmt: skip
    return {"tasks": int(standing.sum()), "rows": rows}


if __name__ == "__main__":
    main()
