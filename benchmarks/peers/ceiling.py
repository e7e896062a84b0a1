"""What no library can beat on a machine: physics alone, collecting alone, and collecting with one epoch of learning.

Each is measured on one thread and counted as if all cores did nothing else, with nothing lost between them.
"""

import os
import statistics

import torch

from benchmarks.throughput import rollout_parts, seconds
from learner.networks import build_networks
from workers.observation import OBSERVATION_SIZE


def ceilings(config, rounds=3):
    """{what: samples/s} of the best that all cores could do for a `Config`."""
    collect, physics = rollout_parts(config)
    works = {"physics": physics(1), "collecting": collect, "epoch": epoch(config)}
    works["epoch"]()  # warm
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        times = [{name: seconds(work) for name, work in works.items()} for _ in range(rounds)]
    finally:
        torch.set_num_threads(threads)
    took = {name: statistics.median(one[name] for one in times) for name in works}
    together = os.cpu_count() * config.samples_per_iteration
    return {
        "physics alone": together / took["physics"],
        "collecting alone": together / took["collecting"],
        "collecting and one epoch": together / (took["collecting"] + took["epoch"]),
    }


def epoch(config):
    """A callable: gradients of both networks by every sample of an iteration once, in minibatches; no loss to speak of,
    no optimizer, nothing prepared."""
    networks = build_networks(config.network, config.seed, "cpu")
    generator = torch.Generator().manual_seed(config.seed)
    inputs = torch.randn(config.samples_per_iteration, OBSERVATION_SIZE, generator=generator)
    batches = inputs.split(config.ppo.minibatch_size)

    def work():
        for batch in batches:
            for network in networks:
                torch.autograd.grad(network(batch).mean(), list(network.parameters()))

    return work
