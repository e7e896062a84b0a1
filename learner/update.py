"""`update`: one update of the learner, a pure function of (learner state, chunks)."""

import copy
import math

import numpy as np
import torch

from learner import ppo
from learner.arrival import Arrival
from learner.batch import concatenate_chunks, prepare, typical
from learner.demonstrator import Demonstrator
from learner.state import SHUFFLE


def update(state, chunks):
    """(LearnerState, metrics) after one update from `state` on a list of chunks; `state` is left as it was.

    Every epoch uses every transition of every exploring environment once (see `PolicyConfig.judges`), in minibatches of
    equal size to within one. Each update step does one SBC step (if enabled), then one PPO step (section 5). The
    chunks' order does not matter: they are put in the order of their environments. metrics: dict of float.

    If a loss, a gradient or what they make of the state is not finite, the update is skipped: the state is as it was
    but for the counters `updates` and `skipped`. metrics: `update/skipped` is the second of these (0: not skipped), a
    number that is not finite is None.
    """
    before, state = state, copy.deepcopy(state)
    config, chunk = state.config, concatenate_chunks(chunks)
    batch = prepare(state, chunk)
    demonstrator = Demonstrator(state, chunk, config.sbc.batch_size or -(-len(batch.explored) // batch.minibatches))
    arrival = Arrival(state, chunk)
    metrics, divergence = _epochs(state, batch, demonstrator, arrival)
    metrics["policy/learning_rate"] = state.learning_rate
    metrics["policy/sigma"] = typical(batch.sigma[batch.explored]) * state.config.action.scale
    metrics["value/error"] = batch.value_error
    metrics["sbc/valid_pairs"] = demonstrator.valid_share
    # after the epochs, so that they see observations as the acting policy did
    observation = chunk.observation.reshape(chunk.end.size, -1)
    state.observations.update(torch.as_tensor(np.ascontiguousarray(observation), device=state.device))
    if all(map(math.isfinite, metrics.values())) and state.is_finite():
        if not _waits(state):
            state.follow()
            state.learning_rate = ppo.adapt_learning_rate(
                state.learning_rate, *_aim(state, batch, arrival, divergence), ppo.LARGEST_RATE[state.method]
            )
        state.skipped = 0
    else:
        state = copy.deepcopy(before)
        state.skipped += 1
        metrics = {name: number if math.isfinite(number) else None for name, number in metrics.items()}
    state.updates += 1
    metrics["update/skipped"] = state.skipped
    return state, metrics


def _epochs(state, batch, demonstrator, arrival):
    """All steps of an update; ({metric: mean over the steps}, mean KL divergence of the last epoch).

    Of a single epoch it is that of the second half: what `target_kl` means is then much the same as with two.
    """
    shuffle = state.random(SHUFFLE)
    _ready(state, batch, demonstrator, arrival, shuffle)
    sums, divergences = {}, []
    epochs = state.config.ppo.passes(state.method)
    for _ in range(epochs):
        for rows in np.array_split(shuffle.permutation(batch.explored), batch.minibatches):
            rows = torch.as_tensor(rows, device=state.device)
            record = {}
            if not _waits(state):
                record = {**demonstrator.step(arrival.rest), **_improve(state, batch, arrival, rows)}
            record.update(_judge(state, batch, rows))
            for name, number in record.items():
                sums[name] = sums.get(name, 0.0) + number
            divergences.append(record.get("policy/kl", 0.0))
    late = divergences[-(batch.minibatches if epochs > 1 else -(-batch.minibatches // 2)) :]
    steps = len(divergences)
    return {name: float(total) / steps for name, total in sums.items()}, float(sum(late)) / len(late)


def _aim(state, batch, arrival, divergence):
    """(the KL divergence of an update, the one that it was to have)."""
    config = state.config
    if not arrival.descends or config.arrival.target_kl is None:
        return divergence, ppo.target_divergence(config.ppo, state.updates)
    target = ppo.straight(config.arrival.target_kl, config.arrival.final_kl, state.updates, config.ppo.kl_updates)
    # windows are of the evaluation's noise, and exploration's may be much larger while thresholds are loose
    return divergence * (typical(batch.sigma[batch.explored]) / state.judge_sigma) ** 2, target


def _ready(state, batch, demonstrator, arrival, shuffle):
    """The policy's optimizer made ready for this update's steps."""
    method = state.config.ppo.method(state.updates)
    if state.method != method:
        state.descend_by(method)
    for group in state.policy_optimizer.param_groups:
        group["lr"] = state.learning_rate
    if method == "kfac":
        # all losses' inputs: where PPO's hardly vary, their own curvature alone would let steps of SBC diverge
        some = shuffle.permutation(batch.explored)[: state.config.ppo.minibatch_size]
        rows = torch.as_tensor(some, device=state.device)
        inputs = torch.cat([batch.inputs[rows], *demonstrator.inputs(), *arrival.inputs()])
        sigma = batch.sigma.new_full([len(inputs)], typical(batch.sigma[rows]))
        sigma[: len(rows)] = batch.sigma[rows]
        state.policy_optimizer.observe(inputs, sigma)


def _waits(state):
    """Whether the policy stays as it is in the next update (`PPOConfig.policy_after`)."""
    return state.updates < state.config.ppo.policy_after


def _improve(state, batch, arrival, rows):
    """One step of the policy on rows (B,) of a batch; the metrics."""
    loss, divergence, clipped = ppo.policy_loss(
        state.policy(batch.inputs[rows]), batch.action[rows], batch.acting_mean[rows], batch.anchor_mean[rows],
        batch.advantage[rows], batch.sigma[rows], state.config.ppo.clip_range(state.updates),
    )  # fmt: skip
    added, record = arrival.gradient()
    norm = state.descend("policy", loss, arrival.rest, added)
    return {
        "loss/policy": loss.detach(), "policy/kl": divergence, "policy/clipped": clipped, "gradient/policy": norm,
        **record,
    }  # fmt: skip


def _judge(state, batch, rows):
    """One step of the value network on rows (B,) of a batch; the metrics."""
    value = state.value(batch.inputs[rows]).squeeze(-1)
    loss = ((value - batch.wanted_value[rows]) ** 2).mean()
    return {"loss/value": loss.detach(), "gradient/value": state.descend("value", loss)}
