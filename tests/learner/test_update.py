"""`update` is pure, indifferent to how workers shared the environments, and it learns."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from learner import ppo, sbc
from learner.batch import concatenate_chunks
from learner.normalizer import Normalizer
from learner.state import LearnerState
from learner.update import update
from workers.inference import PolicyNetwork
from workers.rollout import Rollout
from workers.types import REACHED, Chunk, Outcomes


def learner(config, seed=1):
    return LearnerState(config, seed)


def content(state):
    """All that a learner's state is, as plain data."""
    return copy.deepcopy(state.state_dict())


@pytest.mark.parametrize("optimizer", ["adam", "kfac"])
def test_an_update_leaves_its_arguments_as_they_were(optimizer, lessons, make_config, assert_same_bits):
    state = learner(make_config({"ppo.optimizer": optimizer}))
    state, _ = update(state, lessons[:1])  # so that optimizers and normalizers hold something
    chunks = lessons[1:2]
    before, kept = content(state), copy.deepcopy(chunks)
    update(state, chunks)
    assert_same_bits(before, content(state))
    assert_same_bits(kept, chunks)


def test_the_same_seed_gives_the_same_weights_bit_for_bit(lessons, make_config, assert_same_bits):
    results = []
    for _ in range(2):
        torch.manual_seed(np.random.default_rng().integers(2**31))  # global random numbers must not matter
        np.random.seed(np.random.default_rng().integers(2**31))
        state, metrics = learner(make_config()), []
        for chunk in lessons[:3]:
            state, numbers = update(state, [chunk])
            metrics.append(numbers)
        results.append([content(state), metrics, state.snapshot()])
    assert_same_bits(*results)


def test_another_seed_gives_other_weights(lessons, make_config):
    states = [update(learner(make_config(), seed), lessons[:1])[0] for seed in (1, 2)]
    first, second = (torch.cat([p.flatten() for p in s.policy.parameters()]) for s in states)
    assert (first != second).float().mean() > 0.9


@pytest.mark.parametrize("optimizer", ["adam", "kfac"])
@pytest.mark.parametrize("cuts", [[(12, 24), (0, 12)], [(16, 24), (0, 3), (3, 16)]])
def test_chunks_of_several_workers_in_any_order_equal_the_one_chunk(
    cuts, optimizer, lessons, columns, make_config, assert_same_bits
):
    config = make_config({"ppo.timeout": "bootstrap", "ppo.optimizer": optimizer})
    whole = lessons[2]
    parts = [columns(whole, range(*cut)) for cut in cuts]
    assert_same_bits(concatenate_chunks(parts), whole)
    one, metrics = update(learner(config), [whole])
    other, other_metrics = update(learner(config), parts)
    assert_same_bits([content(one), metrics], [content(other), other_metrics])


def test_every_update_step_is_one_step_of_sbc_and_then_one_of_ppo(lessons, make_config, monkeypatch):
    calls = []
    for module, name in ((sbc, "sbc_loss"), (ppo, "policy_loss")):
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, f=original, n=name: (calls.append((n, len(a[0]))), f(*a))[1])
    config = make_config({"ppo.epochs": 2, "ppo.minibatch_size": 50})
    update(learner(config), lessons[:1])
    samples = lessons[0].end.size
    assert [name for name, _ in calls] == ["sbc_loss", "policy_loss"] * (2 * -(-samples // 50))
    # K: as many demonstrations as a minibatch has transitions
    assert {size for name, size in calls if name == "sbc_loss"} == {-(-samples // -(-samples // 50))}


def test_without_sbc_no_pair_is_made_or_drawn(lessons, make_config, monkeypatch, assert_same_bits):
    chunk = lessons[:1]
    with_sbc, _ = update(learner(make_config()), chunk)

    def refuse(*arguments):
        raise AssertionError("SBC is off")

    for name in ("valid_pairs", "demonstrations", "sbc_loss"):
        monkeypatch.setattr(sbc, name, refuse)
    off, metrics = update(learner(make_config({"sbc.enabled": False})), chunk)
    assert metrics["loss/sbc"] == metrics["gradient/sbc"] == metrics["sbc/valid_pairs"] == 0.0
    # the value network never hears of SBC, the policy does
    assert_same_bits(off.value.state_dict(), with_sbc.value.state_dict())
    assert not torch.equal(off.policy[0].weight, with_sbc.policy[0].weight)


def test_the_share_of_valid_pairs_is_reported(lessons, make_config):
    chunk = lessons[0]
    _, metrics = update(learner(make_config()), [chunk])
    pairs = sbc.valid_pairs(chunk.pose, chunk.next_pose, chunk.end)
    assert metrics["sbc/valid_pairs"] == pytest.approx(len(pairs) / (24 * 8 * 9 / 2))


def test_a_chunk_without_valid_pairs_is_learned_from_by_ppo_alone(lessons, make_config, assert_same_bits):
    chunk = replace(lessons[0], next_pose=lessons[0].pose)
    state, metrics = update(learner(make_config()), [chunk])
    assert metrics["loss/sbc"] == 0.0
    off, _ = update(learner(make_config({"sbc.enabled": False})), [chunk])
    assert_same_bits(content(state), content(off))


def test_a_chunk_of_a_single_transition_leaves_the_weights_finite(library, make_config, easy):
    config = make_config()
    rollout = Rollout(config, library, 1, 1, seed=0)
    state = learner(config)
    chunk, _ = rollout.collect(rollout.initial_state(0), state.snapshot(), easy)
    state, metrics = update(state, [chunk])
    assert all(np.isfinite(weight).all() for weight in state.snapshot().weights)
    assert all(np.isfinite(value) for value in metrics.values())


def test_a_learner_recognizes_its_own_policys_actions(library, make_config, easy):
    """Collected with its snapshot, the first minibatch has ratio one: worker and learner see the same mean."""
    config = make_config({"ppo.learning_rate": 0.0, "sbc.enabled": False, "network.output_scale": 1.0})
    rollout = Rollout(config, library, 8, 8, seed=0)
    state, worker = learner(config), rollout.initial_state(0)
    for _ in range(3):
        chunk, worker = rollout.collect(worker, state.snapshot(), easy)
        assert chunk.version == state.updates
        state, metrics = update(state, [chunk])
        assert metrics["policy/kl"] < 1e-6 and metrics["policy/clipped"] == 0.0


def test_normalizers_hold_the_mean_and_deviation_of_all_they_saw(lessons, make_config):
    state = learner(make_config())
    for chunk in lessons[:4]:
        state, _ = update(state, [chunk])
    seen = np.concatenate([c.observation.reshape(-1, 282) for c in lessons[:4]]).astype(np.float64)
    mean, scale = (x.numpy() for x in state.observations.mean_and_scale())
    np.testing.assert_allclose(mean, seen.mean(axis=0), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(scale, 1 / np.sqrt(seen.var(axis=0) + 1e-8), rtol=1e-6)
    snapshot = state.snapshot()
    np.testing.assert_array_equal(snapshot.observation_mean, mean.astype(np.float32))
    np.testing.assert_array_equal(snapshot.observation_scale, scale.astype(np.float32))


def test_a_normalizer_that_is_off_or_new_leaves_vectors_as_they_are():
    batch = torch.randn(20, 5, generator=torch.Generator().manual_seed(0)) * 2 + 1
    off, new = Normalizer(5, False, "cpu"), Normalizer(5, True, "cpu")
    off.update(batch)
    for normalizer in (off, new):
        torch.testing.assert_close(normalizer(batch), batch)
    new.update(batch)
    scaled = new(batch)
    assert scaled.dtype == torch.float32 and scaled.mean(0).abs().max() < 1e-5
    torch.testing.assert_close(scaled.std(0, unbiased=False), torch.ones(5), rtol=1e-4, atol=1e-4)


def test_kfac_takes_over_from_adam_when_asked_and_keeps_the_networks(lessons, make_config, assert_same_bits):
    """Until then all is as with Adam; a saved learner goes on as if it had not been away, before and after."""
    config = make_config({"ppo.optimizer": "kfac", "ppo.kfac_after": 2, "ppo.natural_rate": 0.02})
    state, plain, resumed = learner(config), learner(make_config()), learner(config)
    for i, lesson in enumerate(lessons[:4]):
        state, metrics = update(state, [lesson])
        resumed, _ = update(resumed, [lesson])
        saved, resumed = content(resumed), learner(config)
        resumed.load_state_dict(saved)
        assert_same_bits(content(resumed), content(state))
        if i < 2:
            plain, same = update(plain, [lesson])
            assert_same_bits([content(state), metrics], [content(plain), same])
        else:
            assert metrics["policy/learning_rate"] == 0.02
    assert state.policy_optimizer.state_dict()["seen"] == 2


def test_kfac_has_epochs_of_its_own_when_asked_and_adam_has_none_of_them(lessons, make_config, assert_same_bits):
    kfac = {"ppo.optimizer": "kfac", "ppo.kfac_after": 1, "ppo.natural_epochs": 1, "ppo.epochs": 3}
    first, _ = update(learner(make_config(kfac)), lessons[:1])
    plain, _ = update(learner(make_config({"ppo.epochs": 3})), lessons[:1])
    assert_same_bits(content(first), content(plain))
    own, metrics = update(first, lessons[1:2])
    first.config = make_config({"ppo.optimizer": "kfac", "ppo.kfac_after": 1, "ppo.epochs": 1})
    one, same = update(first, lessons[1:2])
    assert_same_bits([content(own), metrics], [content(one), same])


def test_the_first_updates_have_a_clip_range_of_their_own(lessons, make_config, assert_same_bits):
    config = {"ppo.first_updates": 1, "ppo.first_clip": 0.05, "ppo.clip": 0.4, "ppo.epochs": 2}
    first, metrics = update(learner(make_config(config)), lessons[:1])
    plain, same = update(learner(make_config({"ppo.clip": 0.05, "ppo.epochs": 2})), lessons[:1])
    assert_same_bits([content(first), metrics], [content(plain), same])
    own, metrics = update(first, lessons[1:2])
    plain.config = make_config({"ppo.clip": 0.4, "ppo.epochs": 2})
    after, same = update(plain, lessons[1:2])
    assert_same_bits([content(own), metrics], [content(after), same])
    plain.config = make_config({"ppo.clip": 0.05, "ppo.epochs": 2})
    assert update(plain, lessons[1:2])[1]["policy/clipped"] > metrics["policy/clipped"]


@pytest.mark.parametrize("epochs", [1, 2, 3])
def test_the_step_size_follows_the_divergence_of_the_last_steps(epochs, lessons, make_config, monkeypatch):
    """The last epoch's, or the second half of the only one's: mean KL divergence from the policy before the update."""
    config = make_config({"ppo.epochs": epochs, "ppo.minibatch_size": 32})
    seen, means = [], []
    real = ppo.policy_loss

    def loss(*arguments):
        out = real(*arguments)
        seen.append(float(out[1]))
        return out

    monkeypatch.setattr(ppo, "policy_loss", loss)
    monkeypatch.setattr(ppo, "adapt_learning_rate", lambda rate, mean, *_: means.append(mean) or rate)
    update(learner(config), lessons[:1])
    each = len(seen) // epochs
    assert each % 2 == 0 and each > 2
    late = seen[-each:] if epochs > 1 else seen[each // 2 :]
    assert means == [pytest.approx(np.mean(late), rel=1e-5)]


@pytest.mark.parametrize("optimizer, first", [("adam", 3e-4), ("kfac", 0.1)])
def test_the_learning_rate_in_use_is_the_adapted_one(optimizer, first, lessons, make_config):
    config = make_config({"ppo.target_kl": 1e-9, "ppo.optimizer": optimizer})
    state = learner(config)
    rates = []
    for _ in range(3):
        state, metrics = update(state, lessons[:1])
        rates.append(metrics["policy/learning_rate"])
        assert state.policy_optimizer.param_groups[0]["lr"] == rates[-1]
    np.testing.assert_allclose(rates, [first, first / 1.3, first / 1.3**2])
    assert state.value_optimizer.param_groups[0]["lr"] == 3e-4


def test_the_first_updates_of_a_pipeline_leave_the_weights_finite(library, make_config, easy):
    """Both chunks come from the initial policy, which saw observations unscaled, at the paper's sigma."""
    config = make_config({
        "network.hidden": [256, 128], "policy.log_sigma": -2.9, "ppo.minibatch_size": 512, "ppo.epochs": 4,
    })  # fmt: skip
    rollout = Rollout(config, library, 128, 16, seed=1)
    state, worker = learner(config), rollout.initial_state(0)
    policy = state.snapshot()
    for _ in range(2):
        chunk, worker = rollout.collect(worker, policy, easy)
        state, metrics = update(state, [chunk])
        assert np.isfinite(list(metrics.values())).all(), metrics
        assert all(np.isfinite(weight).all() for weight in state.snapshot().weights)


def test_ppo_learns_from_exploring_environments_only(lessons, make_config, assert_same_bits):
    chunk = lessons[0]
    state = learner(make_config({"policy.judges": 4, "sbc.enabled": False}))
    wanted, _ = update(state, [chunk])
    for environment, same in ((4, True), (5, False)):
        action = chunk.action.copy()
        action[:, environment] += 0.1
        got, _ = update(state, [replace(chunk, action=action)])
        if same:
            assert_same_bits(content(got), content(wanted))
        else:
            assert not np.array_equal(got.snapshot().weights[0], wanted.snapshot().weights[0])


def test_judges_have_the_evaluations_noise_in_radians(make_config):
    config = make_config({"action.scale": 2.5, "policy.judges": 8, "policy.noise_window": 3})
    policy = learner(config).snapshot()
    assert 2.5 * np.exp(policy.judge_log_sigma) == pytest.approx(np.exp(config.evaluation.log_sigma))
    assert (policy.judges, policy.noise_window, policy.log_sigma) == (8, 3, config.policy.log_sigma)


def test_the_average_is_the_mean_of_all_weights_first_and_exponential_then(lessons, make_config):
    """Against the same sum written out; the average itself changes nothing that is learned."""
    decay = 0.7  # the plain mean ends after the third update
    state, plain = (learner(make_config({"policy.average": value})) for value in (decay, 0.0))
    history = []
    for chunk in lessons[:5]:
        state, _ = update(state, [chunk])
        plain, _ = update(plain, [chunk])
        history.append(state.snapshot().weights[0].astype(np.float64))
        share = [1.0 / min(len(history), 3)] * len(history)
        if len(history) > 3:
            share = [decay ** (len(history) - 3) / 3] * 3
            share += [(1 - decay) * decay ** (len(history) - k) for k in range(4, len(history) + 1)]
        wanted = sum(part * weights for part, weights in zip(share, history, strict=True))
        np.testing.assert_allclose(state.snapshot().average_weights[0], wanted, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(state.snapshot().weights[-1], plain.snapshot().weights[-1])
    assert plain.snapshot().average_weights == () and plain.snapshot().averaged() is not None
    averaged = state.snapshot().averaged()
    np.testing.assert_array_equal(averaged.weights[0], state.snapshot().average_weights[0])
    np.testing.assert_array_equal(averaged.biases[-1], state.snapshot().average_biases[-1])


# ----------------------------------------------------------------------------------------------------- skipped updates

COUNTERS = ("updates", "skipped")


def without_counters(state):
    return {name: value for name, value in content(state).items() if name not in COUNTERS}


def poisoned(chunk, name, value):
    """A chunk with one wrong number."""
    array = getattr(chunk, name).copy()
    array[3, 2] = value
    return replace(chunk, **{name: array})


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.parametrize("optimizer", ["adam", "kfac"])
@pytest.mark.parametrize(
    "name, value",
    [("reward", np.nan), ("reward", np.inf), ("reward", 3e38), ("observation", np.nan), ("observation", np.inf),
     ("action", np.nan), ("action", np.inf), ("action", 3e38), ("mean", np.nan)],
)  # fmt: skip
def test_an_update_on_numbers_that_are_not_finite_changes_only_the_counters(
    name, value, optimizer, lessons, make_config, assert_same_bits
):
    """Parameters, optimizers, normalizers and learning rate stay, to the last bit; the same again gives the same."""
    config = make_config({"ppo.target_kl": 0.01, "ppo.learning_rate": 1e-3, "ppo.optimizer": optimizer})
    before, _ = update(learner(config), lessons[:1])
    kept = copy.deepcopy(content(before))
    bad = poisoned(lessons[1], name, value)
    state, metrics = update(before, [bad])
    again, same = update(before, [bad])
    assert_same_bits(content(before), kept)
    assert metrics["update/skipped"] == state.skipped == 1 and state.updates == before.updates + 1
    assert_same_bits(without_counters(state), without_counters(before))
    assert json.dumps(metrics, allow_nan=False) == json.dumps(same, allow_nan=False)
    assert_same_bits(content(state), content(again))


def test_skipped_updates_are_counted_in_a_row_and_learning_goes_on_after_them(lessons, make_config, assert_same_bits):
    config = make_config()
    state, _ = update(learner(config), lessons[:1])
    fresh = copy.deepcopy(state)
    counts = []
    for chunk in (lessons[1], poisoned(lessons[1], "reward", np.nan), poisoned(lessons[2], "reward", np.inf)):
        state, metrics = update(state, [chunk])
        counts.append(metrics["update/skipped"])
    state, metrics = update(state, lessons[3:4])
    assert [*counts, metrics["update/skipped"], state.skipped] == [0, 1, 2, 0, 0]
    # the same as if the two had never been, but for the update's number, which the random numbers depend on
    fresh, _ = update(fresh, lessons[1:2])
    fresh.updates += 2
    fresh, _ = update(fresh, lessons[3:4])
    assert_same_bits(content(state), content(fresh))


@pytest.mark.parametrize("which", ["policy", "value"])
def test_a_gradient_that_is_not_finite_skips_even_in_the_last_step_with_finite_losses(
    which, lessons, make_config, monkeypatch, assert_same_bits
):
    before = learner(make_config({"ppo.epochs": 1, "ppo.minibatch_size": 1000, "sbc.enabled": False}))
    outputs = {"policy": 31, "value": 1}[which]
    clip = torch.nn.utils.clip_grad_norm_

    def overflowing(parameters, max_norm):
        parameters = list(parameters)
        if len(parameters[-1]) == outputs:
            parameters[0].grad[0, 0] = np.inf
        return clip(parameters, max_norm)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", overflowing)
    state, metrics = update(before, lessons[:1])
    assert metrics["update/skipped"] == 1 and metrics[f"gradient/{which}"] is None
    assert metrics["loss/policy"] is not None and metrics["loss/value"] is not None
    assert_same_bits(without_counters(state), without_counters(before))


def test_a_step_too_long_for_float32_is_skipped(lessons, make_config, assert_same_bits):
    """Nothing was wrong with losses and gradients: the parameters after the last step are not finite."""
    config = make_config({
        "ppo.learning_rate": 3e38, "ppo.epochs": 1, "ppo.minibatch_size": 1000, "sbc.enabled": False,
    })  # fmt: skip
    before = learner(config)
    for group in before.value_optimizer.param_groups:
        group["lr"] = 1e39
    state, metrics = update(before, lessons[:1])
    assert metrics["update/skipped"] == 1 and None not in metrics.values()
    assert state.is_finite()
    assert_same_bits(without_counters(state), without_counters(before))


# ------------------------------------------------------------------------------------------------------------ learning


def test_demonstrations_are_learned(lessons, make_config):
    """The SBC loss on one chunk falls, though most of it is noise; with a learning rate of zero it stays."""
    last = {}
    for rate in (3e-3, 0.0):
        config = make_config({
            "ppo.learning_rate": rate, "ppo.normalize_observations": False,
            "sbc.reduction": "mean", "sbc.batch_size": 256,
        })  # fmt: skip
        state, losses = learner(config), []
        for _ in range(9):
            state, metrics = update(state, lessons[:1])
            losses.append(metrics["loss/sbc"])
        last[rate] = np.mean(losses[-4:])
    assert last[0.0] == pytest.approx(losses[0], rel=0.1)
    assert last[3e-3] < 0.85 * last[0.0]


def toy_chunk(policy, seed):
    """One-step episodes whose reward is larger the nearer the action is to 0.3 everywhere."""
    generator = np.random.default_rng(seed)
    steps, n = 4, 64
    observation = generator.normal(size=(steps, n, 282)).astype(np.float32)
    network = PolicyNetwork(policy, n)
    mean = np.stack([network.mean(row).copy() for row in observation])
    action = mean + np.float32(np.exp(policy.log_sigma)) * generator.normal(size=mean.shape).astype(np.float32)
    zeros = np.zeros(0, dtype=np.int64)
    nobody = Outcomes(**{name: zeros for name in Outcomes.__dataclass_fields__})
    still = np.zeros((steps, n, 84), dtype=np.float32)
    return Chunk(
        environment=np.arange(n), observation=observation, action=action, mean=mean,
        reward=-((action - 0.3) ** 2).mean(axis=-1).astype(np.float32), end=np.full((steps, n), REACHED, dtype=np.int8),
        last_observation=observation[0], final_observation=observation.reshape(-1, 282),
        pose=still, next_pose=still,
        pd_target=np.zeros_like(action), outcomes=nobody, version=policy.version,
        log_sigma=np.full((steps, n), policy.log_sigma),
    )  # fmt: skip


def test_ratios_are_those_of_the_noise_that_acted_whatever_the_configuration_says(make_config, assert_same_bits):
    """A learner that starts from another sigma makes the same of a chunk: the curriculum may have made it smaller."""
    states = []
    for log_sigma in (-2.0, -1.0):
        state = learner(make_config({"policy.log_sigma": log_sigma, "sbc.enabled": False}))
        chunk = toy_chunk(replace(state.snapshot(), log_sigma=-2.0), 0)
        states.append(update(state, [chunk])[0].state_dict())
    assert_same_bits(*states)


def test_a_toy_tasks_return_rises_which_a_frozen_network_cannot(make_config):
    last = {}
    for rate in (2e-3, 0.0):
        config = make_config({
            "ppo.learning_rate": rate, "ppo.minibatch_size": 64, "sbc.enabled": False, "policy.log_sigma": -2.0,
        })  # fmt: skip
        state, rewards = learner(config), []
        for k in range(25):
            chunk = toy_chunk(state.snapshot(), k)
            rewards.append(chunk.reward.mean())
            state, _ = update(state, [chunk])
        last[rate] = np.mean(rewards[-5:])
    frozen, learned = last[0.0], last[2e-3]
    noise = -np.exp(-4.0)  # what the policy's noise alone costs
    assert frozen == pytest.approx(-0.09 + noise, abs=0.01)
    assert learned > 0.5 * frozen + 0.5 * noise
