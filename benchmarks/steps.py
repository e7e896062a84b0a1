"""What a step of the policy gains: PPO's and SBC's gradients, each as a step of plain descent, of Adam and of K-FAC.

    python -m benchmarks.steps RUN [--chunks 48] [--lambdas 1,0.8,0.5] [--json] [key=value ...]

Collects chunks with the policy of a run's newest checkpoint, which stays as it is. The gradient over each chunk gives a
step v; what it gains is its slope along the mean gradient g over all other chunks, per distance of the policies:

gain      g' v / sqrt(v' F v), F the Fisher information of the policy: the slope per distance, which is the root of
          twice the KL divergence. g: of PPO's loss at the first of the lambdas, which has the least bias and the most
          noise. In units of the standard deviation of the first lambda's advantages.

The steps: `plain` the gradient, `adam` divided by the root of the optimizer's second moments (only of a run with Adam),
`kfac` by Kronecker factors of PPO's inputs in the last chunks, with the run's `ppo.damping`. A negative gain of SBC: it
pulls against PPO.
"""

import math

import numpy as np
import torch

from benchmarks.gradients import collect, of_ppo, of_sbc, run
from learner.kfac import KFAC
from learner.state import LearnerState


def main():
    """Measure and print."""
    meaning = "of GAE; the first tells what is gained"
    run(__doc__, measure, "1,0.8,0.5", meaning, lambda figure: "{:9.4f} +- {:.4f}".format(*figure))


def measure(config, content, chunks, lambdas):
    """{"loss, step": (mean gain, its standard error)}; see the module's docstring. The errors are without the noise of
    the mean gradient, which all have in common."""
    state = LearnerState(config, config.seed)
    state.load_state_dict(content["parts"][0])
    kfac, rng = KFAC(state.policy, 1.0, config.ppo.damping), np.random.default_rng(0)
    descents = {f"ppo, lambda {lam:g}": [] for lam in lambdas} | {"sbc": []}
    inputs, sigma = [], []
    for chunk in collect(config, content, chunks):
        for lam in lambdas:
            state.config.ppo.gae_lambda = lam
            descents[f"ppo, lambda {lam:g}"].append(-of_ppo(state, chunk))
        descents["sbc"].append(-of_sbc(state, chunk, rng)[0])
        with torch.no_grad():
            observation = torch.as_tensor(chunk.observation.reshape(chunk.end.size, -1))
            some = slice(None, None, max(1, len(observation) // 256))
            inputs.append(state.observations(observation)[some])
            sigma.append(torch.as_tensor(np.exp(chunk.log_sigma.reshape(-1)[some])))
            kfac.observe(inputs[-1], sigma[-1])
    inputs, sigma = torch.cat(inputs), torch.cat(sigma)
    true = np.array(descents[f"ppo, lambda {lambdas[0]:g}"])
    return {
        f"{loss}, {name}": gain(true, [step(d) for d in some], lambda v: distance(state.policy, inputs, sigma, v))
        for name, step in steps(state, kfac).items()
        for loss, some in descents.items()
    }


def steps(state, kfac):
    """{name: function from a descent direction to a step}, both flat."""
    found = {"plain": lambda d: d}
    if state.method == "adam":
        moments = [state.policy_optimizer.state[p]["exp_avg_sq"] for p in state.policy.parameters()]
        root = torch.cat([moment.flatten() for moment in moments]).double().sqrt().numpy() + 1e-8
        found["adam"] = lambda d: d / root
    found["kfac"] = lambda d: flat(kfac.natural(parts(state.policy, d)))
    return found


def gain(true, tried, distance):
    """(mean, standard error) of what steps gain along the mean of all other chunks' true gradients."""
    n, total = len(true), true.sum(axis=0)
    gains = [(total - own) / (n - 1) @ v / distance(v) for own, v in zip(true, tried, strict=True)]
    return float(np.mean(gains)), float(np.std(gains, ddof=1) / math.sqrt(n))


def distance(policy, inputs, sigma, v):
    """sqrt(v' F v) of a flat step: root mean square over the inputs of how far the means move, in units of sigma."""
    named = dict(policy.named_parameters())
    tangent = dict(zip(named, parts(policy, v), strict=True))
    values = {name: value.detach() for name, value in named.items()}
    with torch.no_grad():
        _, moved = torch.func.jvp(lambda w: torch.func.functional_call(policy, w, (inputs,)), (values,), (tangent,))
    return math.sqrt(((moved / sigma[:, None]) ** 2).sum(dim=-1).mean().item())


def parts(policy, vector):
    """A flat vector as tensors of the parameters' shapes."""
    found, start = [], 0
    for parameter in policy.parameters():
        end = start + parameter.numel()
        found.append(torch.as_tensor(vector[start:end], dtype=parameter.dtype).reshape(parameter.shape))
        start = end
    return found


def flat(tensors):
    """Tensors as one float64 vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors]).double().numpy()


if __name__ == "__main__":
    main()
