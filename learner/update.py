"""`update`: one update of the learner, a pure function of (learner state, chunks)."""

import copy
import math

import numpy as np
import torch

from learner import ppo, sbc
from learner.gae import advantages
from learner.kfac import KFAC
from learner.networks import build_networks, snapshot
from learner.normalizer import Normalizer
from workers.observation import OBSERVATION_SIZE
from workers.types import TIMED_OUT, Chunk, Outcomes, concatenate_outcomes, judging

# Streams of the learner's random numbers
_SHUFFLE, _DEMONSTRATIONS = 0, 1


class LearnerState:
    """All that the learner is between two updates: networks, optimizers, normalizers, the policy's learning rate.

    config: `learner.config.LearnerConfig`. `updates` counts the updates so far, `skipped` those of the last ones in a
    row that changed nothing (see `update`). A demonstration's action is expressed in `action`
    (`workers.config.ActionConfig`), which the acting policy used.
    """

    def __init__(self, config, action, seed, device="cpu"):
        self.config, self.action, self.seed, self.device = config, action, seed, device
        self.policy, self.value = build_networks(config.network, seed, device)
        self.average = copy.deepcopy(self.policy) if config.policy.average else None
        self.descend_by(config.ppo.method(0))
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=config.ppo.learning_rate, fused=True)
        self.observations = Normalizer(OBSERVATION_SIZE, config.ppo.normalize_observations, device)
        self.returns = Normalizer(1, config.ppo.normalize_values, device)
        self.updates = self.skipped = 0

    _PARTS = ("policy", "value", "policy_optimizer", "value_optimizer", "observations", "returns")
    _NUMBERS = ("learning_rate", "updates", "skipped")

    @property
    def method(self):
        """`adam` or `kfac`: how the policy descends."""
        return "kfac" if isinstance(self.policy_optimizer, KFAC) else "adam"

    def descend_by(self, method):
        """Let the policy begin anew with `adam` or `kfac`."""
        config = self.config.ppo
        if method == "kfac":
            self.learning_rate = config.natural_rate
            self.policy_optimizer = KFAC(self.policy, self.learning_rate, config.damping)
        else:
            self.learning_rate = config.learning_rate
            self.policy_optimizer = torch.optim.Adam(self.policy.parameters(), lr=self.learning_rate, fused=True)

    def snapshot(self):
        """The `workers.types.Policy` to act with."""
        return snapshot(
            self.policy, self.average, self.observations, self.config.policy, self.action.scale, self.updates
        )

    def state_dict(self):
        """Plain tensors and numbers for a checkpoint; shares memory with the networks."""
        parts = {name: getattr(self, name).state_dict() for name in self._PARTS}
        parts["average"] = self.average and self.average.state_dict()
        numbers = {name: getattr(self, name) for name in self._NUMBERS}
        return {**parts, **numbers}

    def load_state_dict(self, state):
        """Become the learner that made `state`."""
        self.descend_by("kfac" if "factors" in state["policy_optimizer"] else "adam")
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        if self.average:
            self.average.load_state_dict(state["average"] or state["policy"])
        for name in self._NUMBERS:
            setattr(self, name, state[name])

    def is_finite(self):
        """Whether every parameter and every normalizer's number is."""
        tensors = [*self.policy.parameters(), *self.value.parameters()]
        for normalizer in (self.observations, self.returns):
            tensors += [normalizer.mean, normalizer.squares]
        return bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors]).all())


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
    config, device = state.config, state.device
    chunk = concatenate_chunks(chunks)
    horizon, n = chunk.end.shape
    samples = horizon * n

    def tensor(array):
        return torch.as_tensor(np.ascontiguousarray(array), device=device)

    observation = tensor(chunk.observation.reshape(samples, -1))
    with torch.no_grad():
        inputs = state.observations(observation)
        advantage, returns, value_error = targets(state, chunk, inputs)
    state.returns.update(tensor(returns.reshape(-1, 1)))
    return_mean, return_scale = (x.float() for x in state.returns.mean_and_scale())
    wanted_value = (tensor(returns.reshape(-1)) - return_mean) * return_scale
    action, acting_mean = tensor(chunk.action.reshape(samples, -1)), tensor(chunk.mean.reshape(samples, -1))
    # with no lag the acting policy is the anchor, up to the last bits of another matrix product: take its own numbers
    anchor_mean = acting_mean if chunk.version == state.updates else _no_grad(state.policy, inputs)
    explored = np.flatnonzero(np.tile(~judging(chunk.environment, config.policy.judges), horizon))
    advantage = tensor(advantage.reshape(-1))
    used = advantage[tensor(explored)]
    advantage = (advantage - used.mean()) / (used.std(correction=0) + 1e-8)

    sigma = math.exp(chunk.log_sigma)
    batches = -(-len(explored) // config.ppo.minibatch_size)
    demonstrator = _Demonstrator(state, chunk, config.sbc.batch_size or -(-len(explored) // batches))
    shuffle = _generator(state, _SHUFFLE)
    if state.method != config.ppo.method(state.updates):
        state.descend_by(config.ppo.method(state.updates))
    for group in state.policy_optimizer.param_groups:
        group["lr"] = state.learning_rate
    if state.method == "kfac":
        # both losses' inputs: where PPO's hardly vary, their own curvature alone would let steps of SBC diverge
        some = shuffle.permutation(explored)[: config.ppo.minibatch_size]
        state.policy_optimizer.observe(torch.cat([inputs[tensor(some)], *demonstrator.inputs()]), sigma)
    sums, steps, divergence_sum = {}, 0, 0.0
    for epoch in range(config.ppo.epochs):
        for rows in np.array_split(shuffle.permutation(explored), batches):
            rows = tensor(rows)
            record = demonstrator.step()
            loss, divergence, clipped = ppo.policy_loss(
                state.policy(inputs[rows]), action[rows], acting_mean[rows], anchor_mean[rows], advantage[rows],
                sigma, config.ppo.clip,
            )  # fmt: skip
            norm = _descend(loss, state.policy, state.policy_optimizer, config.ppo.max_grad_norm)
            value_loss = ((state.value(inputs[rows]).squeeze(-1) - wanted_value[rows]) ** 2).mean()
            value_norm = _descend(value_loss, state.value, state.value_optimizer, config.ppo.max_grad_norm)
            record.update({
                "loss/policy": loss.detach(), "loss/value": value_loss.detach(), "policy/kl": divergence,
                "policy/clipped": clipped, "gradient/policy": norm, "gradient/value": value_norm,
            })  # fmt: skip
            for name, number in record.items():
                sums[name] = sums.get(name, 0.0) + number
            if epoch == config.ppo.epochs - 1:
                divergence_sum += divergence
            steps += 1
    metrics = {name: float(total) / steps for name, total in sums.items()}
    metrics["policy/learning_rate"] = state.learning_rate
    metrics["policy/sigma"] = sigma * state.action.scale
    metrics["value/error"] = value_error
    metrics["sbc/valid_pairs"] = demonstrator.valid_share
    # after the epochs, so that they see observations as the acting policy did
    state.observations.update(observation)
    finite = all(map(math.isfinite, metrics.values())) and state.is_finite()
    if finite:
        _average(state)
        state.learning_rate = ppo.adapt_learning_rate(
            state.learning_rate, float(divergence_sum) / batches, ppo.target_divergence(config.ppo, state.updates),
            ppo.LARGEST_RATE[state.method],
        )  # fmt: skip
        state.skipped = 0
    else:
        state = copy.deepcopy(before)
        state.skipped += 1
        metrics = {name: number if math.isfinite(number) else None for name, number in metrics.items()}
    state.updates += 1
    metrics["update/skipped"] = state.skipped
    return state, metrics


def concatenate_chunks(chunks):
    """One chunk of all environments, in the order of their index in the run, whoever collected them."""
    if len(chunks) == 1:
        return chunks[0]
    chunks = sorted(chunks, key=lambda chunk: chunk.environment[0])
    outcomes = [chunk.outcomes for chunk in chunks]
    order = Outcomes(*(np.concatenate(arrays) for arrays in zip(*(vars(item).values() for item in outcomes)))).order()
    return Chunk(
        environment=np.concatenate([chunk.environment for chunk in chunks]),
        last_observation=np.concatenate([chunk.last_observation for chunk in chunks]),
        final_observation=np.concatenate([chunk.final_observation for chunk in chunks])[order],
        outcomes=concatenate_outcomes(outcomes),
        version=chunks[0].version,
        log_sigma=chunks[0].log_sigma,
        **{
            name: np.concatenate([getattr(chunk, name) for chunk in chunks], axis=1)
            for name in ("observation", "action", "mean", "reward", "end", "pose", "next_pose", "pd_target")
        },
    )


def targets(state, chunk, inputs):
    """(advantage, return), each (T, N), and the value network's mean absolute error, in units of reward.

    inputs: the normalized observations of the chunk, (T * N, 282).
    """
    horizon, n = chunk.end.shape
    mean, scale = (x.float() for x in state.returns.mean_and_scale())

    def value(observation):
        return (state.value(observation).squeeze(-1) / scale + mean).cpu().numpy()

    def value_of(array):
        return value(state.observations(torch.as_tensor(array, device=state.device)))

    values = value(inputs).reshape(horizon, n)
    timeout_value = np.zeros_like(values)
    if state.config.ppo.timeout == "bootstrap":
        # final_observation lists the ended episodes by step, then by environment: the order of nonzero
        at = np.nonzero(chunk.end)
        late = chunk.end[at] == TIMED_OUT
        if late.any():
            timeout_value[at[0][late], at[1][late]] = value_of(chunk.final_observation[late])
    advantage, returns = advantages(
        chunk.reward, values, value_of(chunk.last_observation), chunk.end, timeout_value,
        state.config.ppo.gamma, state.config.ppo.gae_lambda,
    )  # fmt: skip
    return advantage, returns, float(np.abs(advantage).mean())


class _Demonstrator:
    """Draws demonstrations from a chunk and does the SBC steps of one update."""

    def __init__(self, state, chunk, batch_size):
        self._state, self._chunk, self._size = state, chunk, batch_size
        self.valid_share = 0.0
        self._pairs = ()
        if state.config.sbc.enabled:
            self._pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
            horizon, n = chunk.end.shape
            self.valid_share = len(self._pairs) / (n * horizon * (horizon + 1) / 2)
            self._random = _generator(state, _DEMONSTRATIONS)

    def inputs(self):
        """The policy's inputs of one draw of demonstrations, or of none: [(K, 282)] or []."""
        return [self._draw()[0]] if len(self._pairs) else []

    def step(self):
        """One gradient step on `batch_size` demonstrations, drawn uniformly from all valid pairs; its metrics."""
        if not len(self._pairs):
            return {"loss/sbc": 0.0, "gradient/sbc": 0.0}
        state, config = self._state, self._state.config.sbc
        inputs, action, weight = self._draw()
        loss = sbc.sbc_loss(state.policy(inputs), action, weight, config)
        norm = _descend(loss, state.policy, state.policy_optimizer, state.config.ppo.max_grad_norm)
        return {"loss/sbc": loss.detach(), "gradient/sbc": norm}

    def _draw(self):
        """(policy's inputs (K, 282), action (K, 31), gap weight (K,)) of demonstrations, as tensors."""
        state, chosen = self._state, self._random.integers(len(self._pairs), size=self._size)
        observation, action = sbc.demonstrations(self._chunk, self._pairs, chosen, state.action)
        weighting = state.config.sbc.gap_weighting
        weight = sbc.gap_weights(self._pairs.gap()[chosen], len(self._chunk.end) + 1, weighting)
        observation, action, weight = (
            torch.as_tensor(array, device=state.device) for array in (observation, action, weight)
        )
        with torch.no_grad():
            return state.observations(observation), action, weight


def _descend(loss, network, optimizer, max_norm):
    """One optimizer step down the gradient, clipped to max_norm; returns the norm before clipping."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), max_norm)
    optimizer.step()
    return norm


def _average(state):
    """Move the averaged weights towards the policy's: a plain mean at first, an exponential one in the long run."""
    if state.average is None:
        return
    decay = min(state.config.policy.average, state.updates / (state.updates + 1))
    with torch.no_grad():
        for mean, weight in zip(state.average.parameters(), state.policy.parameters(), strict=True):
            mean.lerp_(weight, 1 - decay)


def _no_grad(network, inputs):
    with torch.no_grad():
        return network(inputs)


def _generator(state, stream):
    """The random numbers of one purpose in this update, a function of (seed, purpose, update)."""
    return np.random.Generator(np.random.Philox(key=[state.seed, 2**32 * stream + state.updates]))
