"""What the derivatives of a policy step cost, in simulated policy steps, side by side in one run.

    python -m benchmarks.derivatives [--states 96] [--rounds 5] [--json] [key=value ...]

Plays the policy of the built-in clips that comes with Segue, and takes states of its episodes. Compared for each state,
on one thread and on two: `workers.derivatives.Derivatives.of`, and the simulations that differences would take, one for
each of a state's 74 tangent coordinates and an action's 31 numbers and one without a push; medians of the rounds.
"""

import argparse
import json
import statistics
import time

import numpy as np
from mujoco.batch import Batch

from benchmarks.throughput import build_config
from motion.state_machine import build_state_machine
from orchestrator import saved
from orchestrator.settings import shipped_policies
from workers.derivatives import TANGENT, Derivatives
from workers.environment import Environment, new_observations
from workers.humanoid import build_model
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF
from workers.library import build_library
from workers.windows import NEVER

PUSHED = 1 + TANGENT + NUM_DOF


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options, overrides = parser.parse_known_args()
    found = measure(build_config(overrides), options.states, options.rounds)
    for threads, row in found.items():
        print(f"{threads} threads: {row['steps']:.1f} steps a state, {row['ratio']:.2f} times as fast as pushes")
    if options.json:
        print(json.dumps(found))


def measure(config, count, rounds):
    """{threads: {steps: simulated policy steps that a state's derivatives cost, ratio: of the time of pushes}}."""
    env, action = states(config, count)
    parts = {}
    for threads in (1, 2):
        derivatives = Derivatives(config, threads)
        batch = Batch(build_model(config.physics), count * PUSHED, threads)
        physics = np.repeat(env.physics, PUSHED, axis=0)

        def differentiate(derivatives=derivatives):
            derivatives.of(env.physics, action, env.target_qpos)

        def push(batch=batch, physics=physics):
            batch.state[:] = physics
            batch.step(None, nstep=config.physics.substeps)

        parts[threads] = differentiate, push
    seconds = {(threads, part): [] for threads in parts for part in range(2)}
    for number in range(rounds + 1):
        for threads, calls in parts.items():
            for part, call in enumerate(calls):
                begun = time.perf_counter()
                call()
                if number:  # the first compiles
                    seconds[threads, part].append(time.perf_counter() - begun)
    found = {}
    for threads in parts:
        own, pushed = (statistics.median(seconds[threads, part]) for part in range(2))
        found[threads] = {"steps": own / pushed * PUSHED, "ratio": pushed / own}
    return found


def states(config, count):
    """(`Environment` of `count` tasks of the built-in clips, some steps into their episodes; actions (count, 31))."""
    policy = saved.load_file(shipped_policies()["builtin"])["policies"][-1].averaged()
    env = Environment(config, build_library(build_state_machine(config.motions)), count)
    network, rows = PolicyNetwork(policy, count), np.arange(count)
    env.plan(0, rows, np.full(count, -1), rows)
    env.begin(rows)
    for step in range(12):
        action = network.mean(env.observe(new_observations(count))).copy()
        env.step(action, NEVER, np.flatnonzero(rows % 12 >= step))
    return env, action


if __name__ == "__main__":
    main()
