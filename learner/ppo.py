"""Proximal policy optimisation with a Gaussian policy whose deviation is given, not learned (section 5)."""

import math

import torch

LARGEST_RATE = {"adam": 3e-3, "kfac": 100.0}  # that a policy's learning rate may adapt to
_LOG_LIMIT = 20.0  # of any log ratio
_LOG_WEIGHT = math.log(2.0)  # of the weight of a sample in the pipelined loss


def log_probability(action, mean, sigma):
    """Log density (n,) of actions (n, 31) of deviation sigma (n,), up to a constant, which cancels in ratios."""
    return -_distance(action, mean, sigma)


def _distance(one, other, sigma):
    """Half the squared distance of rows (n, 31) in units of sigma (n,): KL divergence of Gaussians with these means."""
    return ((one - other) ** 2).sum(dim=-1) / (2 * sigma**2).to(one.dtype)


def policy_loss(mean, action, acting_mean, anchor_mean, advantage, sigma, clip):
    """(clipped surrogate loss, mean KL divergence from the anchor, share of clipped ratios); means (n, 31).

    sigma: (n,), standard deviation of the actions.

    acting_mean: of the policy that collected the action; anchor_mean: of the learner's policy when the update began.
    With pipeline_depth = 0 the two are the same and this is PPO. With depth 1 the acting policy is one update older;
    clipping around it would stop the gradient of samples that the last update has already moved, so the ratio is
    clipped around the anchor and weighted by anchor / acting (decoupled PPO: Hilton et al., "Batch size-invariance for
    policy optimization", 2022). The weight is truncated at 2: a sample that the acting policy hardly knew counts no
    more than twice, one that the learner has given up hardly at all.
    """
    anchor = log_probability(action, anchor_mean, sigma)
    weight = torch.exp((anchor - log_probability(action, acting_mean, sigma)).clamp(-_LOG_LIMIT, _LOG_WEIGHT))
    # clamped before the exponential: infinity times a clipped gradient of zero would be NaN
    ratio = torch.exp((log_probability(action, mean, sigma) - anchor).clamp(-_LOG_LIMIT, _LOG_LIMIT))
    loss = -(weight * torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)).mean()
    with torch.no_grad():
        divergence = _distance(mean, anchor_mean, sigma).mean()
        clipped = ((ratio - 1).abs() > clip).float().mean()
    return loss, divergence, clipped


def target_divergence(config, updates):
    """The KL divergence that a `PPOConfig` aims at after so many updates; None: the learning rate is fixed."""
    if config.target_kl is None:
        return None
    if updates < config.first_updates:
        return config.first_kl * (_line(config, config.first_updates) / config.first_kl) ** (
            updates / config.first_updates
        )
    return _line(config, updates)


def _line(config, updates):
    """From `target_kl` to `final_kl`."""
    return straight(config.target_kl, config.final_kl, updates, config.kl_updates)


def straight(first, last, updates, over):
    """What goes from `first` to `last` in a straight line over so many updates; without `last` it stays."""
    if last is None:
        return first
    return first + (min(updates / over, 1.0) if over else 1.0) * (last - first)


def adapt_learning_rate(rate, divergence, target, largest):
    """The next learning rate: smaller if the KL divergence of the last epoch is over 1.5 target, larger below 1/1.5."""
    if target is None:
        return rate
    if divergence > 1.5 * target:
        return max(rate / 1.3, 1e-7)
    if divergence < target / 1.5:
        return min(rate * 1.3, largest)
    return rate
