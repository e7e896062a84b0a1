"""What an update learns from: the chunks of all workers as one batch of tensors, with advantages and returns."""

from dataclasses import dataclass

import numpy as np
import torch

from learner.gae import advantages
from workers.types import (
    TIMED_OUT,
    Chunk,
    Outcomes,
    concatenate_outcomes,
    concatenate_trials,
    concatenate_windows,
    judging,
)


@dataclass(frozen=True)
class Batch:
    """S = T * N samples of one chunk, as tensors on the learner's device unless said otherwise.

    inputs: (S, 282), normalized observations. action, acting_mean, anchor_mean: (S, 31), as in `ppo.policy_loss`.
    advantage: (S,), of mean 0 and deviation 1 over the exploring samples. wanted_value: (S,), returns in the value
    network's scale. explored: (E,) int array, the exploring environments' samples. minibatches: how many an epoch has.
    sigma: (S,) float64, standard deviation of exploring environments' actions. value_error: the value network's mean
    absolute error, in reward.
    """

    inputs: torch.Tensor
    action: torch.Tensor
    acting_mean: torch.Tensor
    anchor_mean: torch.Tensor
    advantage: torch.Tensor
    wanted_value: torch.Tensor
    explored: np.ndarray
    minibatches: int
    sigma: torch.Tensor
    value_error: float


def prepare(state, chunk):
    """The `Batch` of a chunk for a `LearnerState`, whose normalizer of returns takes the chunk's in."""
    config, samples = state.config, chunk.end.size

    def tensor(array):
        return torch.as_tensor(np.ascontiguousarray(array), device=state.device)

    with torch.no_grad():
        inputs = state.observations(tensor(chunk.observation.reshape(samples, -1)))
        advantage, returns, value_error = targets(state, chunk, inputs)
    state.returns.update(tensor(returns.reshape(-1, 1)))
    return_mean, return_scale = (x.float() for x in state.returns.mean_and_scale())
    action, acting_mean = tensor(chunk.action.reshape(samples, -1)), tensor(chunk.mean.reshape(samples, -1))
    # with no lag the acting policy is the anchor, up to the last bits of another matrix product: take its own numbers
    anchor_mean = acting_mean
    if chunk.version != state.updates:
        with torch.no_grad():
            anchor_mean = state.policy(inputs)
    explored = np.flatnonzero(np.tile(~judging(chunk.environment, config.policy.judges), len(chunk.end)))
    advantage = tensor(advantage.reshape(-1))
    used = advantage[tensor(explored)]
    return Batch(
        inputs=inputs,
        action=action,
        acting_mean=acting_mean,
        anchor_mean=anchor_mean,
        advantage=(advantage - used.mean()) / (used.std(correction=0) + 1e-8),
        wanted_value=(tensor(returns.reshape(-1)) - return_mean) * return_scale,
        explored=explored,
        minibatches=-(-len(explored) // config.ppo.minibatch_size),
        sigma=tensor(np.exp(chunk.log_sigma.reshape(-1))),
        value_error=value_error,
    )


def typical(sigma):
    """The deviation whose 1 / sigma^2 is the mean of those of sigma (n,)."""
    return (1 / sigma**2).mean().item() ** -0.5


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
        windows=concatenate_windows([chunk.windows for chunk in chunks]) if chunks[0].windows is not None else None,
        trials=concatenate_trials([chunk.trials for chunk in chunks]) if chunks[0].trials is not None else None,
        **{
            name: np.concatenate([getattr(chunk, name) for chunk in chunks], axis=1)
            for name in (
                "observation", "action", "mean", "reward", "end", "pose", "next_pose", "pd_target", "log_sigma",
            )  # fmt: skip
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
