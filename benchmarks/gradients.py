"""What SBC and PPO pull at: how much of their gradients is signal, and how they agree, at a run's newest checkpoint.

    python -m benchmarks.gradients RUN [--chunks 48] [--lambdas 0.95,0.8,0.5] [--json] [key=value ...]

Collects chunks with the checkpoint's policy, which stays as it is, and takes the policy network's gradient of each loss
over each chunk. Printed:

signal    |mean gradient|^2 / mean |gradient|^2, unbiased: the share of a chunk's gradient that another chunk's has,
          too. With a share of 0.01, the mean of 100 chunks is as much signal as noise.
floor     the share of SBC's loss that is exploration noise in the demonstrated actions, which no network can lower
cosine    between SBC's mean gradient and PPO's
share     of SBC in what both pull in the mean, each chunk's gradient cut to ppo.max_grad_norm as in training
"""

import argparse
import json

import numpy as np
import torch

from learner import ppo, sbc
from learner.batch import targets
from learner.state import LearnerState
from motion.errors import InputError
from orchestrator import saved
from orchestrator.folder import config_path
from orchestrator.settings import load
from workers.types import judging
from workers.worker import RolloutWorker


def main():
    """Measure and print."""
    run(__doc__, measure, "0.95,0.8,0.5", "of GAE; the first counts for cosine and share", "{:9.4f}".format)


def run(description, measure, lambdas, meaning, shown):
    """Print what `measure` makes of the run that the command line names, each figure as `shown` gives it.

    lambdas, meaning: default and help of --lambdas.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run's folder")
    parser.add_argument("--chunks", type=int, default=48)
    parser.add_argument("--lambdas", default=lambdas, help=meaning)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("overrides", nargs="*", help="key=value")
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    try:
        config = load(config_path(options.run), options.overrides)
        content, path = saved.load_latest(options.run, config)
    except InputError as error:
        parser.error(str(error))
    if content is None:
        parser.error(f"{options.run}: holds no checkpoint")
    figures = measure(config, content, options.chunks, [float(text) for text in options.lambdas.split(",")])
    print(f"{path}: {options.chunks} chunks of {config.num_envs} x {config.horizon} samples")
    for name, value in figures.items():
        print(f"{name:24s} {shown(value)}")
    if options.json:
        print(json.dumps(figures))


def measure(config, content, chunks, lambdas):
    """{name: number}; see the module's docstring. content: of `saved.load_latest`."""
    state = LearnerState(config, config.seed)
    state.load_state_dict(content["parts"][0])
    rng = np.random.default_rng(0)
    cloning, climbing, losses = [], {lam: [] for lam in lambdas}, []
    for chunk in collect(config, content, chunks):
        gradient, *loss = of_sbc(state, chunk, rng)
        cloning.append(gradient)
        losses.append(loss)
        for lam in lambdas:
            state.config.ppo.gae_lambda = lam
            climbing[lam].append(of_ppo(state, chunk))
    cloned, climbed = (cut(gradients, config.ppo.max_grad_norm) for gradients in (cloning, climbing[lambdas[0]]))
    loss, floor = np.mean(losses, axis=0)
    return {
        "sbc/norm": float(np.mean([np.linalg.norm(gradient) for gradient in cloning])),
        "ppo/norm": float(np.mean([np.linalg.norm(gradient) for gradient in climbing[lambdas[0]]])),
        "sbc/signal": signal(cloning),
        **{f"ppo/signal, lambda {lam:g}": signal(gradients) for lam, gradients in climbing.items()},
        "sbc/floor": float(floor / loss),
        "cosine": float(cloned @ climbed / np.linalg.norm(cloned) / np.linalg.norm(climbed)),
        "sbc/share": float(np.linalg.norm(cloned) / (np.linalg.norm(cloned) + np.linalg.norm(climbed))),
    }


def collect(config, content, count):
    """Chunks that follow each other, all with the checkpoint's newest policy."""
    state, policy, thresholds = content["workers"][0], content["policies"][-1], content["thresholds"][-1]
    worker = RolloutWorker(config, len(state.environment))
    for _ in range(count):
        chunk, _, state = worker.collect(state, policy, thresholds)
        yield chunk


def of_sbc(state, chunk, rng):
    """(gradient of Eq. 17 over as many demonstrations as there are samples, its loss, that of exploration alone)."""
    config = state.config
    pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
    chosen = rng.integers(len(pairs), size=chunk.end.size)
    observation, action = map(torch.as_tensor, sbc.demonstrations(chunk, pairs, chosen, state.config))
    gaps = sbc.gap_weights(pairs.gap()[chosen], len(chunk.end) + 1, config.sbc.gap_weighting)
    weight = torch.as_tensor(gaps)
    loss = sbc.sbc_loss(state.policy(state.observations(observation)), action, weight, config.sbc)
    noise = (chunk.action - chunk.mean)[pairs.step[chosen], pairs.column[chosen]]
    floor = sbc.sbc_loss(torch.zeros_like(action), torch.as_tensor(noise), weight, config.sbc)
    return gradient_of(loss, state.policy), loss.item(), floor.item()


def of_ppo(state, chunk):
    """Gradient of PPO's loss over the exploring samples, the policy standing where it acted."""
    config, samples = state.config, chunk.end.size
    inputs = state.observations(torch.as_tensor(chunk.observation.reshape(samples, -1)))
    rows = torch.as_tensor(np.flatnonzero(np.tile(~judging(chunk.environment, config.policy.judges), len(chunk.end))))
    with torch.no_grad():
        advantage = torch.as_tensor(targets(state, chunk, inputs)[0].reshape(-1))[rows]
    mean, action = state.policy(inputs[rows]), torch.as_tensor(chunk.action.reshape(samples, -1))[rows]
    loss, _, _ = ppo.policy_loss(
        mean, action, mean.detach(), mean.detach(), (advantage - advantage.mean()) / advantage.std(),
        torch.as_tensor(np.exp(chunk.log_sigma.reshape(-1)))[rows], config.ppo.clip,
    )  # fmt: skip
    return gradient_of(loss, state.policy)


def gradient_of(loss, network):
    """The gradient as one float64 vector."""
    parts = torch.autograd.grad(loss, list(network.parameters()))
    return torch.cat([part.reshape(-1) for part in parts]).double().numpy()


def cut(gradients, norm):
    """Mean of gradients after each was cut to `norm`."""
    return np.mean([gradient * min(1.0, norm / np.linalg.norm(gradient)) for gradient in gradients], axis=0)


def signal(gradients):
    """Unbiased estimate of |mean|^2 / mean of |.|^2 of independent vectors; 0 on average where all is noise."""
    n, mean = len(gradients), np.mean(gradients, axis=0)
    square = np.mean([gradient @ gradient for gradient in gradients])
    return float((n * (mean @ mean) - square) / (n - 1) / square)


if __name__ == "__main__":
    main()
